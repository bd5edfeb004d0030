"""What is estimated: poses, points, and what else is unknown of the cameras."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.model.unknowns import Columns
from torchstickcal.shapes import extended


@dataclass(frozen=True)
class State:
    """The estimate at some moment, of B sessions, in float64. One session is a batch of one.

    Args:
        rotations: (B, C, 3, 3), world to camera.
        translations: (B, C, 3), world to camera, metres.
        points: (B, 3, N), metres.
        unknowns: (B, K), values of the further unknowns of the cameras.
    """

    rotations: Tensor
    translations: Tensor
    points: Tensor
    unknowns: Tensor

    @staticmethod
    def of(rotations: Tensor, translations: Tensor, points: Tensor) -> State:
        """A state of cameras of which nothing but the poses is unknown."""
        return State(rotations, translations, points, points.new_zeros(len(points), 0))

    @staticmethod
    def stack(states: Sequence[State]) -> State:
        """The states of several sessions as one batch."""
        return _each(lambda *tensors: torch.cat(tensors), *states)

    def __getitem__(self, sessions: slice) -> State:
        """The states of some of the sessions."""
        return _each(lambda tensor: tensor[sessions], self)

    def replaced(self, where: Tensor, other: State) -> State:
        """The state with some sessions (B,), True where, taken from another."""
        return _each(lambda mine, theirs: torch.where(extended(where, mine.ndim), theirs, mine), self, other)

    def scaled(self, factors: Tensor) -> State:
        """The same scenes, each enlarged by its factor (B,)."""
        factor = factors[:, None, None]
        return replace(self, translations=self.translations * factor, points=self.points * factor)

    def depth_reversed(self, known: Tensor) -> State:
        """The scenes with depths reversed about their middle, and the poses from which they look almost the same.

        The depths are those of the first camera, which is the world. In parallel projection the images would be the same.

        Args:
            known: (B, N), the points whose middle it is.
        """
        across = torch.tensor([1.0, 1.0, -1.0]).to(self.rotations)
        middle = self.points.where(known[:, None], torch.nan).nanmedian(-1, keepdim=True).values.nan_to_num()
        rotations = across[:, None] * self.rotations * across
        translations = self.translations + ((self.rotations - rotations) @ middle[:, None])[..., 0]
        points = middle + across[:, None] * (self.points - middle)
        return replace(self, rotations=rotations, translations=translations, points=points)

    def retracted(self, camera_step: Tensor, point_step: Tensor, unknown_step: Tensor | None = None) -> State:
        """The state after a step.

        Args:
            camera_step: tangents (B, C - 1, 6) of all cameras but the first, or (B, 0, 6) for none.
            point_step: (B, 3, N).
            unknown_step: (B, K); None or (B, 0) for none.
        """
        rotations, translations, unknowns = self.rotations, self.translations, self.unknowns
        if camera_step.shape[1]:
            moved = se3.retract(rotations[:, 1:], translations[:, 1:], camera_step)
            rotations = torch.cat([rotations[:, :1], moved[0]], dim=1)
            translations = torch.cat([translations[:, :1], moved[1]], dim=1)
        if unknown_step is not None and unknown_step.shape[1]:
            unknowns = unknowns + unknown_step
        return State(rotations, translations, self.points + point_step, unknowns)

    def leaves(self) -> State:
        """The same state, whose tensors are leaves that require gradients."""
        return _each(lambda tensor: tensor.detach().requires_grad_(), self)

    def gradient(self, value: Tensor) -> State:
        """The gradient of a number by the tensors of the state, zero where it does not depend on them."""
        tensors = [getattr(self, field.name) for field in fields(State)]
        return State(*torch.autograd.grad(value, tensors, allow_unused=True, materialize_grads=True))

    def in_cameras(self, columns: Columns = slice(None), dtype: torch.dtype = torch.float64) -> Tensor:
        """The points in every camera's frame, (B, C, 3, N), computed in float64 and then rounded."""
        return se3.moved(self.rotations, self.translations, self.points[..., columns]).to(dtype)


def _each(function: Callable[..., Tensor], *states: State) -> State:
    """A state made of others, tensor by tensor."""
    return State(*(function(*(getattr(state, field.name) for state in states)) for field in fields(State)))
