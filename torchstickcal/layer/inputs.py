"""What a layer is given, checked and with a batch dimension throughout."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from torchstickcal.arrays import names_of, tensor_of, truth_of
from torchstickcal.errors import CalibrationError, ObservationError, RigError
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.observations import Observations, coefficients_of
from torchstickcal.pipeline.relabel import Labels
from torchstickcal.stick import Stick, check_ends

_OF_THE_KEYPOINTS = ("keypoints", "sticks")
"""Where the errors of observations say that the fault is, if it is in what the detector saw."""


@dataclass(frozen=True)
class LayerInputs:
    """Arguments of a forward pass on B sessions of C cameras, F frames, P points and S sticks."""

    keypoints: Tensor
    """(B, C, F, P, 2), float32 or float64, pixels, NaN where not seen"""
    confidence: Tensor | None
    """(B, C, F, P)"""
    cameras: Intrinsics
    """(B, C, ...), float64"""
    lengths_m: Tensor
    """(B, S), float64"""
    image_size: Tensor | None
    """(B, C, 2), width and height, pixels"""
    sticks: tuple[Stick, ...]
    point_names: tuple[str, ...] | None

    @staticmethod
    def of(
        keypoints: Tensor,
        intrinsics: Any,
        stick_lengths: Any,
        confidence: Any,
        image_size: Any,
        sticks: Sequence[Stick],
        point_names: Sequence[str] | None,
    ) -> LayerInputs:
        """Arguments with keypoints (B, C, F, P, 2), the others broadcast to as many sessions and cameras.

        Raises:
            ObservationError: if they are no arrays, or their shapes do not fit.
        """
        if keypoints.ndim != 5 or keypoints.shape[-1] != 2 or 0 in keypoints.shape[2:] or keypoints.shape[1] < 2:
            raise ObservationError(
                "keypoints have the wrong shape",
                where="keypoints",
                got=tuple(keypoints.shape),
                expected="(B, cameras, frames, points, 2) or (cameras, frames, points, 2), of two cameras or more",
            )
        sessions, cameras, _, points, _ = keypoints.shape
        check_ends(sticks, points)
        if stick_lengths is None:
            stick_lengths = [stick.between_m for stick in sticks]
        lens = intrinsics if isinstance(intrinsics, Intrinsics) else Intrinsics(intrinsics)
        fisheye, distortion = truth_of(lens.fisheye, "fisheye"), None
        if lens.distortion is not None:
            distortion = coefficients_of(tensor_of(lens.distortion, "distortion", keep_graph=True), fisheye)
        if distortion is not None:
            distortion = _expanded("distortion", distortion, (sessions, cameras, distortion.shape[-1]), keypoints)
        if image_size is not None:
            image_size = _expanded("image_size", image_size, (sessions, cameras, 2), keypoints)
        return LayerInputs(
            keypoints,
            None if confidence is None else _confidence(confidence, keypoints),
            Intrinsics(_expanded("intrinsics", lens.matrix, (sessions, cameras, 3, 3), keypoints), distortion, fisheye),
            _expanded("stick_lengths", stick_lengths, (sessions, len(sticks)), keypoints),
            image_size,
            tuple(sticks),
            names_of(point_names, "point_names", points),
        )

    def no_gradient(self) -> Tensor:
        """Zero, through which a gradient of zero flows back to everything that was given."""
        return sum((tensor[..., :0].sum().double() for tensor in self.tensors().values()), self.lengths_m.new_zeros(()))

    def tensors(self) -> dict[str, Tensor]:
        """Everything through which gradients flow, by name."""
        named = {
            "keypoints": self.keypoints,
            "confidence": self.confidence,
            "matrix": self.cameras.matrix,
            "distortion": self.cameras.distortion,
            "lengths_m": self.lengths_m,
        }
        return {name: tensor for name, tensor in named.items() if tensor is not None}

    def with_tensors(self, tensors: Mapping[str, Tensor]) -> LayerInputs:
        """The same arguments with other :meth:`tensors`, of as many sessions or more."""
        sessions, image_size = len(tensors["keypoints"]), self.image_size
        if image_size is not None and len(image_size) != sessions:  # under a transform that adds sessions
            image_size = image_size.repeat(sessions // len(image_size), 1, 1)
        return LayerInputs(
            tensors["keypoints"],
            tensors.get("confidence"),
            Intrinsics(tensors["matrix"], tensors.get("distortion"), self.cameras.fisheye),
            tensors["lengths_m"],
            image_size,
            self.sticks,
            self.point_names,
        )

    def of_sessions(self, chosen: list[int]) -> LayerInputs:
        """Some of the sessions."""
        return replace(
            self,
            keypoints=self.keypoints[chosen],
            confidence=None if self.confidence is None else self.confidence[chosen],
            cameras=self.cameras[chosen],
            lengths_m=self.lengths_m[chosen],
            image_size=None if self.image_size is None else self.image_size[chosen],
        )

    def relabelled(self, labels: Labels) -> LayerInputs:
        """The keypoints where they belong by the labels of the sessions."""
        confidence = self.confidence
        return replace(
            self,
            keypoints=self.keypoints.gather(3, labels.index[..., None].expand(-1, -1, -1, -1, 2)),
            confidence=None if confidence is None else confidence.gather(3, labels.index),
        )

    def observations(self, session: int) -> Observations:
        """One session, without gradients.

        Raises:
            ObservationError: if it cannot be used; :func:`is_of_session` says whether its keypoints are the reason.
        """
        distortion = self.cameras.distortion
        lengths = self.lengths_m[session].tolist()
        observations = Observations(
            self.keypoints[session],
            self.cameras.matrix[session],
            [replace(stick, length_m=length) for stick, length in zip(self.sticks, lengths, strict=True)],
            distortion=None if distortion is None else distortion[session],
            confidence=None if self.confidence is None else self.confidence[session],
            image_size=None if self.image_size is None else self.image_size[session],
            point_names=self.point_names,
            fisheye=self.cameras.fisheye,
        )
        if not observations.visible.any():
            expected = "points seen by two cameras or more"
            raise ObservationError(
                "points are never seen", where="keypoints", got="no keypoint that was seen", expected=expected
            )
        return observations

    def measurements(
        self, seen: Measurements, solved: Measurements, refined: Sequence[str], groups: Sequence[str]
    ) -> Measurements:
        """The measurements that were solved, with gradients by what was given.

        Args:
            seen: the measurements as detected.
            solved: the same, moved to common times and weighted.
            refined: what was estimated of the cameras beside their poses.
            groups: a label for each camera.
        """
        visible = seen.by_frame(seen.visible)
        keypoints = torch.where(visible[..., None], self.keypoints.double(), 0.0)
        confidence = visible.double() if self.confidence is None else self.confidence.double().where(visible, 0.0)
        weight = (solved.confidence / seen.confidence).where(seen.visible, 0.0)
        return replace(
            solved,
            pixels=keypoints.movedim(-1, 2).flatten(3) + (solved.pixels - seen.pixels),
            confidence=confidence.flatten(2) * weight,
            cameras=self.cameras,
            lengths_m=self.lengths_m,
            unknowns=RigUnknowns.of(refined, self.cameras, groups),
        )

    def unseen(self, refined: Sequence[str], groups: Sequence[str]) -> Measurements:
        """Measurements of the same shape in which no keypoint was seen; arguments as of :meth:`measurements`."""
        sessions, cameras, frames, points, _ = self.keypoints.shape
        return Measurements(
            pixels=self.lengths_m.new_zeros(sessions, cameras, 2, frames * points),
            confidence=self.lengths_m.new_zeros(sessions, cameras, frames * points),
            cameras=self.cameras,
            frames=frames,
            sticks=torch.tensor([stick.ends for stick in self.sticks], device=self.keypoints.device),
            lengths_m=self.lengths_m,
            stick_sigma_m=torch.tensor([stick.sigma_m for stick in self.sticks], dtype=torch.float64),
            unknowns=RigUnknowns.of(refined, self.cameras, groups),
        )


def is_of_session(error: CalibrationError) -> bool:
    """Whether an error is about the keypoints of one session. Otherwise an argument is wrong."""
    return isinstance(error, RigError) or error.where.startswith(_OF_THE_KEYPOINTS)


def _confidence(value: Any, keypoints: Tensor) -> Tensor:
    """One confidence per keypoint, (B, C, F, P).

    Raises:
        ObservationError: if its shape does not fit.
    """
    confidence, expected = (
        tensor_of(value, "confidence", device=keypoints.device, masked=0.0, keep_graph=True),
        keypoints.shape[:-1],
    )
    if confidence.shape not in (expected, expected[1:]):
        raise ObservationError(
            "confidence has the wrong shape",
            where="confidence",
            got=tuple(confidence.shape),
            expected=f"{tuple(expected)} or {tuple(expected[1:])}, one per keypoint",
        )
    return confidence.expand(expected)


def _expanded(name: str, value: Any, shape: tuple[int, ...], like: Tensor) -> Tensor:
    """An array as a tensor in float64, expanded to a shape.

    Raises:
        ObservationError: if it is no array, or does not fit.
    """
    tensor = tensor_of(value, name, device=like.device, keep_graph=True).double()
    try:
        return tensor.expand(shape)
    except RuntimeError as error:
        expected = f"{shape}, or fewer dimensions where all are alike"
        raise ObservationError("the wrong shape", where=name, got=tuple(tensor.shape), expected=expected) from error
