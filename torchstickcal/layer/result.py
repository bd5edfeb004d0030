"""What a layer gives back."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import torch
from torch import Tensor
from torch.utils import _pytree as pytree

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline.adjustment import WarmStart
from torchstickcal.pipeline.relabel import Labels
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.verdict import Acceptance, LengthErrors, Quality, Verdict


@dataclass(frozen=True)
class LayerResult:
    """Calibrated rigs, in the frame of each session's first camera; leading B only where the keypoints had it.

    Poses, lenses, clocks and points carry gradients, and have the dtype and device of the keypoints.

    It behaves as a tensor does: ``result.detach()``, ``result.to(...)``, and for a batch ``len(result)``, ``result[2]`` (one
    session), ``result[1:]`` (some sessions) and ``for session in result``. It is a pytree of ``torch.utils``: functions such as
    ``torch.utils._pytree.tree_map`` and ``torch.func.vmap`` see its tensors. ``torch.save`` writes it, and ``torch.load`` reads
    it with ``weights_only=True`` once this class has been imported.

    Example:
        >>> from torchstickcal import CalibrationLayer
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=10)
        >>> result = CalibrationLayer(observations.sticks)(observations.keypoints, observations.cameras)
        >>> result.status, result.points.shape
        (('converged',), torch.Size([10, 21, 3]))
        >>> result.to(torch.float32).points.dtype
        torch.float32
    """

    rotations: Tensor
    """(B, C, 3, 3), world to camera; the identity where a session could not be calibrated"""
    translations: Tensor
    """(B, C, 3), metres; zero where a session could not be calibrated"""
    intrinsics: Tensor
    """(B, C, 3, 3), camera matrices, pixels, as given or as estimated; as given where a session could not be calibrated"""
    distortion: Tensor | None
    """(B, C, D), likewise; None for perfect lenses"""
    time_offsets: Tensor
    """(B, C), time by which the middle rows of a camera's frames are exposed after those of the first camera, in frames; zero
    where not estimated"""
    readout: Tensor
    """(B, C), time from the first row of an image to the last, in frames; zero where not estimated"""
    unknowns: Tensor
    """(B, K), what was estimated of the cameras beside their poses, as deviations from what was given"""
    points: Tensor
    """(B, F, P, 3), metres; zero where ``known`` is False"""
    known: Tensor
    """(B, F, P), True where two cameras or more see a point"""
    inliers: Tensor
    """(B, C, F, P), True where a keypoint was used"""
    keypoint_index: Tensor
    """(B, C, F, P), the point whose given keypoint each point uses: its own, except where label errors were undone"""
    other_person: Tensor
    """(B, C, F), True where all keypoints of a camera's frame were set aside: they show another person"""
    sigma_px: Tensor
    """(B, P), estimated noise of each point's keypoints, pixels"""
    converged: Tensor
    """(B,); the gradients of a session that has not converged are zero"""
    status: tuple[str, ...]
    """``converged``, or why not, for each session"""
    verdict: Tensor | None = None
    """(B,), whether the result can be used: 0 good, 1 usable, 2 poor, 3 failed; None unless the layer judges, as in the next"""
    agreement: Tensor | None = None
    """(B, C), share of each camera's keypoints that agree with the other cameras"""
    metre_m: Tensor | None = None
    """(B,), half the width of the 95 % interval of a length of 1 m, metres; NaN where that cannot be said"""
    qualities: tuple[Quality, ...] | None = None
    """the verdict on each session with its reasons, as :attr:`torchstickcal.Calibration.quality`"""

    @staticmethod
    def of(
        data: Measurements,
        state: State,
        inliers: Tensor,
        sigma_px: Tensor,
        labels: Labels,
        status: Sequence[str],
        dtype: torch.dtype,
    ) -> LayerResult:
        """A result in a dtype.

        Args:
            data: what was measured.
            state: the estimate.
            inliers: (B, C, N), the keypoints that were used.
            sigma_px: (B, P).
            labels: which given keypoint each point uses.
            status: of each session.
            dtype: of what floats.
        """
        known, cameras = data.by_frame(inliers.any(1)), data.cameras_at(state).to(dtype)
        found, zero = data.unknowns.by_name(state.unknowns), torch.zeros_like(data.cameras.focal_px)[..., None]
        return LayerResult(
            rotations=state.rotations.to(dtype),
            translations=state.translations.to(dtype),
            intrinsics=cameras.matrix,
            distortion=cameras.distortion,
            time_offsets=found.get("time_offset", zero)[..., 0].to(dtype),
            readout=found.get("readout", zero)[..., 0].to(dtype),
            unknowns=state.unknowns.to(dtype),
            points=data.by_frame(state.points).movedim(1, -1).where(known[..., None], 0.0).to(dtype),
            known=known,
            inliers=data.by_frame(inliers),
            keypoint_index=labels.index,
            other_person=labels.other_person,
            sigma_px=sigma_px.to(dtype),
            converged=torch.tensor([said == "converged" for said in status], device=known.device),
            status=tuple(status),
        )

    @staticmethod
    def of_tensors(
        tensors: Mapping[str, Any], status: Sequence[str], qualities: tuple[Quality, ...] | None = None
    ) -> LayerResult:
        """A result of what :meth:`tensors` gives, and the status and the quality of each session."""
        every: dict[str, Any] = dict.fromkeys(_TENSORS)
        return LayerResult(**every | dict(tensors), status=tuple(status), qualities=qualities)

    def with_qualities(self, qualities: Sequence[Quality], agreement: Tensor) -> LayerResult:
        """The result with the quality of each session.

        Args:
            qualities: of each session.
            agreement: (B, C), share of each camera's keypoints that agree with the other cameras.
        """
        dtype, device = self.rotations.dtype, self.rotations.device
        metres = [torch.nan if one.acceptance is None else one.acceptance.metre_m for one in qualities]
        return replace(
            self,
            verdict=torch.tensor([list(Verdict).index(one.verdict) for one in qualities], device=device),
            agreement=agreement.to(device=device, dtype=dtype),
            metre_m=torch.tensor(metres, device=device, dtype=dtype),
            qualities=tuple(qualities),
        )

    def each(self, function: Callable[[Tensor], Tensor]) -> LayerResult:
        """A result made of this one, tensor by tensor."""
        return replace(self, **{name: function(tensor) for name, tensor in self.tensors().items()})

    def tensors(self) -> dict[str, Tensor]:
        """All tensors by their names, without a distortion of None."""
        tensors = {name: getattr(self, name) for name in _TENSORS}
        return {name: tensor for name, tensor in tensors.items() if tensor is not None}

    def detach(self) -> LayerResult:
        """The same values without gradients."""
        return self.each(Tensor.detach)

    def to(self, *arguments: Any, **keywords: Any) -> LayerResult:
        """The same on another device or in another floating-point type; arguments as of ``torch.Tensor.to``."""
        device = self.rotations.to(*arguments, **keywords).device
        return self.each(lambda t: t.to(*arguments, **keywords) if t.is_floating_point() else t.to(device))

    @property
    def batched(self) -> bool:
        """Whether the tensors have the leading B."""
        return self.rotations.ndim == 4

    def __len__(self) -> int:
        """The number of sessions of a batch."""
        self._check_batched()
        return len(self.rotations)

    def __getitem__(self, chosen: int | slice) -> LayerResult:
        """One session of a batch, without the leading B, or several."""
        self._check_batched()
        numbers = range(len(self))[chosen]  # raises an IndexError for a session that does not exist
        every = [numbers] if isinstance(numbers, int) else list(numbers)
        place = every[0] if isinstance(numbers, int) else every
        said = tuple(self.status[number] for number in every)
        qualities = None if self.qualities is None else tuple(self.qualities[number] for number in every)
        return replace(self.each(lambda tensor: tensor[place]), status=said, qualities=qualities)

    def __iter__(self) -> Iterator[LayerResult]:
        """The sessions of a batch."""
        return (self[session] for session in range(len(self)))

    def __bool__(self) -> bool:
        """True for every result, also for one of no sessions."""
        return True

    def _check_batched(self) -> None:
        """Refuse to count or choose sessions where there is no batch.

        Raises:
            TypeError: as Python and torch do.
        """
        if not self.batched:
            raise TypeError(
                "this is the result of one session, not of a batch: it has no length and no sessions to choose from"
            )

    def warm_start(self, session: int) -> WarmStart | None:
        """Where a session may start from another time; None after a failure."""
        if not bool(self.converged[session]):
            return None
        points = self.points[session].detach()
        return WarmStart(
            self.rotations[session].detach(),
            self.translations[session].detach(),
            points.where(self.known[session][..., None], torch.nan),
            self.unknowns[session].detach(),
            self.inliers[session],
            self.sigma_px[session].detach(),
        )

    @staticmethod
    def together(results: Sequence[LayerResult], sessions: Sequence[int]) -> LayerResult:
        """Results of some sessions each as one result of all, in the order of the sessions' numbers."""
        order = sorted(range(len(sessions)), key=lambda place: sessions[place])
        status = [said for result in results for said in result.status]

        def joined(name: str) -> Tensor | None:
            tensors = [getattr(result, name) for result in results]
            return None if tensors[0] is None else torch.cat(tensors)[order]

        tensors: dict[str, Any] = {name: joined(name) for name in _TENSORS}
        qualities = [one for result in results for one in result.qualities or ()]
        return LayerResult(
            **tensors,
            status=tuple(status[place] for place in order),
            qualities=tuple(qualities[place] for place in order) if len(qualities) == len(status) > 0 else None,
        )


_TENSORS = [field.name for field in fields(LayerResult) if field.name not in ("status", "qualities")]


def _flattened(result: LayerResult) -> tuple[list[Any], Any]:
    """The tensors of a result for torch's pytrees, and the rest."""
    tensors = result.tensors()
    return list(tensors.values()), (tuple(tensors), result.status, result.qualities)


def _flattened_with_names(result: LayerResult) -> tuple[list[tuple[Any, Any]], Any]:
    """The same, with a name for each tensor."""
    values, rest = _flattened(result)
    return [(pytree.GetAttrKey(name), value) for name, value in zip(rest[0], values, strict=True)], rest


def _unflattened(values: Any, rest: Any) -> LayerResult:
    """A result of tensors, or of whatever a function has put in their places."""
    names, status, qualities = rest
    return LayerResult.of_tensors(dict(zip(names, values, strict=True)), status, qualities)


pytree.register_pytree_node(
    LayerResult,
    _flattened,
    _unflattened,
    serialized_type_name="torchstickcal.LayerResult",
    flatten_with_keys_fn=_flattened_with_names,
)
torch.serialization.add_safe_globals([LayerResult, Quality, Finding, Severity, Acceptance, LengthErrors])
