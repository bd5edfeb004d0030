"""The paper's measure of success: rotation and translation errors of cameras after a rigid alignment without scale.

The errors are differentiable, and :class:`PoseErrorMetric` accumulates them over sessions and processes.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal, get_args

import torch
import torch.distributed as dist
from torch import Tensor

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import ObservationError, quoted
from torchstickcal.geometry import se3

Alignment = Literal["rigid", "similarity", "first_camera", "none"]
_COLLINEAR = 1e-6


@dataclass(frozen=True)
class PoseErrors:
    """Errors of each camera."""

    rotation_deg: Tensor
    """(..., C)"""
    translation_m: Tensor
    """(..., C), distance of the camera centres"""
    aligned_by: str = "camera centres"
    """what was laid onto the truth before the comparison, and how"""

    @property
    def mean_rotation_deg(self) -> float:
        """Mean over the cameras."""
        return float(self.rotation_deg.detach().mean())

    @property
    def mean_translation_m(self) -> float:
        """Mean over the cameras."""
        return float(self.translation_m.detach().mean())


def pose_errors(
    rotations: Any,
    translations: Any,
    true_rotations: Any,
    true_translations: Any,
    alignment: Alignment = "rigid",
) -> PoseErrors:
    """Errors of estimated poses (..., C, 3, 3), (..., C, 3), world to camera, against the true ones.

    The true poses are (C, 3, 3), (C, 3), or have the leading dimensions of the estimated ones. Computed in float64, of tensors,
    arrays or lists. The errors carry gradients with respect to tensors that require them, and can be a loss; where an error is
    zero its gradient is zero.

    Args:
        rotations: estimated, world to camera.
        translations: estimated, metres.
        true_rotations: true, world to camera.
        true_translations: true, metres.
        alignment: how the estimated world is laid onto the true one before they are compared. ``rigid``: by the rotation and
            translation of least squares of the camera centres (Kabsch and Umeyama, no scale). Where the true centres lie on one
            line, as two cameras always do, they leave a rotation open, and the first camera's pose serves instead.
            ``similarity``: likewise, with a scale. ``first_camera``: by the first camera's pose. ``none``: not at all.

    Raises:
        ObservationError: if they are not numbers, or their shapes do not fit, or for another alignment.

    Example:
        >>> rotations, translations = torch.eye(3).repeat(3, 1, 1), torch.randn(3, 3).requires_grad_()
        >>> errors = pose_errors(rotations, translations, rotations, [[0, 0, 0], [1, 0, 0], [0, 1, 0]])
        >>> errors.translation_m.mean().backward()
        >>> translations.grad.shape
        torch.Size([3, 3])
    """
    r, t, r_true, t_true = _poses(
        rotations=rotations, translations=translations, true_rotations=true_rotations, true_translations=true_translations
    )
    centres, true_centres = se3.camera_centres(r, t), se3.camera_centres(r_true, t_true)
    by_first = r_true[..., 0, :, :].mT @ r[..., 0, :, :]
    scale, on_line = centres.new_ones(()), _collinear(true_centres)
    if alignment in ("rigid", "similarity"):
        collinear = on_line[..., None, None]
        by_centres, _ = align(centres, true_centres)
        rotation = by_first.where(collinear, by_centres)
        moved = centres @ rotation.mT
        if alignment == "similarity":
            from_mean = moved - moved.mean(-2, keepdim=True)
            scale = (from_mean * true_centres).sum((-2, -1)) / from_mean.square().sum((-2, -1))
        at_first = true_centres[..., 0, :] - scale[..., None] * moved[..., 0, :]
        offset = at_first.where(collinear[..., 0], true_centres.mean(-2) - scale[..., None] * moved.mean(-2))
    elif alignment == "first_camera":
        rotation = by_first
        offset = true_centres[..., 0, :] - (rotation @ centres[..., 0, :, None])[..., 0]
    elif alignment == "none":
        rotation, offset = torch.eye(3).to(r), r.new_zeros(3)
    else:
        expected = ", ".join(get_args(Alignment))
        raise ObservationError("no such alignment", where="alignment", got=quoted(alignment), expected=expected)
    laid = scale[..., None, None] * (centres @ rotation.mT) + offset[..., None, :]
    return PoseErrors(
        rotation_deg=rotation_angle(r_true @ rotation[..., None, :, :] @ r.mT).rad2deg(),
        translation_m=(laid - true_centres).norm(dim=-1),
        aligned_by=_aligned_by(alignment, r_true.shape[-3], on_line),
    )


def _aligned_by(alignment: Alignment, cameras: int, on_line: Tensor) -> str:
    """What was laid onto the truth, in words."""
    scale = "and scale" if alignment == "similarity" else "no scale"
    if alignment == "none":
        return "nothing: the worlds are the same"
    if alignment == "first_camera":
        return "pose of the first camera, rotation and translation, no scale"
    if bool(on_line.all()):
        return f"pose of the first camera, rotation and translation, {scale} (the camera centres lie on one line)"
    return f"all {cameras} camera centres, rotation and translation, {scale}"


def _collinear(centres: Tensor) -> Tensor:
    """Whether camera centres (..., C, 3) lie on one line, (...)."""
    spread = torch.linalg.svdvals((centres - centres.mean(-2, keepdim=True)).detach())
    return spread[..., 1] <= _COLLINEAR * spread[..., 0]


class PoseErrorMetric:
    """Errors of camera poses over many sessions, with the interface of torchmetrics.

    ``update`` adds sessions, ``compute`` gives the errors of all of them so far, and ``reset`` begins anew. Called as a
    function it adds sessions and gives the errors of these alone. Where ``torch.distributed`` has been initialised, ``compute``
    is over the sessions of all processes, and all of them have to call it.

    Args:
        alignment: as of :func:`pose_errors`.

    Example:
        >>> from torchstickcal import CalibrationLayer
        >>> from torchstickcal.simulate import golf_session
        >>> metric = PoseErrorMetric()
        >>> for seed in range(2):
        ...     observations, truth = golf_session(cameras=3, frames=10, seed=seed)
        ...     result = CalibrationLayer(observations.sticks)(observations.keypoints, observations.cameras)
        ...     metric.update(result.rotations, result.translations, truth.rotations, truth.translations, result.converged)
        >>> sorted(metric.compute())
        ['calibrated', 'rotation_deg', 'rotation_median_deg', 'translation_m', 'translation_median_m']
        >>> float(metric.compute()["calibrated"])
        1.0
    """

    def __init__(self, alignment: Alignment = "rigid") -> None:
        self.alignment: Alignment = alignment
        self.reset()

    def update(
        self,
        rotations: Any,
        translations: Any,
        true_rotations: Any,
        true_translations: Any,
        converged: Any = True,
    ) -> None:
        """Add sessions.

        Args:
            rotations: (..., C, 3, 3), and the others as of :func:`pose_errors`.
            translations: (..., C, 3).
            true_rotations: (C, 3, 3) or (..., C, 3, 3).
            true_translations: (C, 3) or (..., C, 3).
            converged: (...), False for a session that could not be calibrated. It counts in ``calibrated`` alone.
        """
        self._samples.append(self._errors(rotations, translations, true_rotations, true_translations, converged))

    def compute(self) -> dict[str, Tensor]:
        """Errors over all sessions so far, and over all processes.

        Returns:
            ``rotation_deg`` and ``translation_m``, means over the calibrated sessions of the mean over their cameras;
            ``rotation_median_deg`` and ``translation_median_m``, medians of these means; ``calibrated``, the share of sessions
            that could be calibrated. NaN where there are no such sessions.
        """
        samples = [torch.cat([torch.empty(0, 3, dtype=torch.float64), *self._samples])]
        if dist.is_available() and dist.is_initialized():
            gathered: list[Any] = [None] * dist.get_world_size()
            dist.all_gather_object(gathered, samples[0])
            samples = gathered
        return _summary(torch.cat(samples))

    def reset(self) -> None:
        """Forget all sessions."""
        self._samples: list[Tensor] = []

    def __call__(self, *arguments: Any, **keywords: Any) -> dict[str, Tensor]:
        """Add sessions, and give their errors."""
        self.update(*arguments, **keywords)
        return _summary(self._samples[-1])

    @torch.no_grad()
    def _errors(self, rotations: Any, translations: Any, true_rotations: Any, true_translations: Any, converged: Any) -> Tensor:
        """Mean rotation and translation error of each session, and whether it was calibrated, (n, 3)."""
        errors = pose_errors(rotations, translations, true_rotations, true_translations, self.alignment)
        means = errors.rotation_deg.mean(-1), errors.translation_m.mean(-1)
        calibrated = torch.as_tensor(converged).to(means[0]).expand_as(means[0])
        return torch.stack([*means, calibrated], dim=-1).reshape(-1, 3).cpu()


def align(source: Tensor, target: Tensor) -> tuple[Tensor, Tensor]:
    """The rotations (..., 3, 3) and translations (..., 3) that lay points (..., N, 3) onto others by least squares.

    They carry the exact gradients, also where the points are spread alike in two directions, as the cameras of a ring are; the
    gradients of the singular vectors do not exist there.
    """
    centre, target_centre = source.mean(-2), target.mean(-2)
    moments = (target - target_centre[..., None, :]).mT @ (source - centre[..., None, :])
    u, _, vh = torch.linalg.svd(moments.detach())
    sign = torch.ones_like(centre)
    sign[..., 2] = torch.det(u @ vh).sign()
    rotation = u @ (sign[..., None] * vh)
    if moments.requires_grad:
        rotation = rotation + rotation @ se3.hat(_newton_step(rotation.mT @ moments))
    return rotation, target_centre - (rotation @ centre[..., None])[..., 0]


def rotation_angle(rotations: Tensor) -> Tensor:
    """Angles (...) of rotations (..., 3, 3), radians; exact near zero, where an arc cosine loses half the digits."""
    trace = rotations.diagonal(dim1=-2, dim2=-1).sum(-1)
    return torch.atan2(2 * se3.vee(rotations).norm(dim=-1), trace - 1)


def _newton_step(turned: Tensor) -> Tensor:
    """A step (..., 3) of Newton's method at the best rotation, of moments (..., 3, 3) that were turned by it.

    It is zero up to rounding, but its derivative by the moments is that of the best rotation (implicit function theorem).
    """
    symmetric = (turned + turned.mT).detach() / 2
    trace = symmetric.diagonal(dim1=-2, dim2=-1).sum(-1)[..., None, None]
    curvature = trace * torch.eye(3).to(symmetric) - symmetric
    return 2 * (torch.linalg.pinv(curvature, hermitian=True) @ se3.vee(turned)[..., None])[..., 0]


def _poses(**given: Any) -> tuple[Tensor, ...]:
    """Estimated and true poses in float64, on one device.

    Raises:
        ObservationError: if they are not numbers, or their shapes do not fit.
    """
    device = tensor_of(given["rotations"], "rotations").device
    poses = tuple(tensor_of(value, name, device=device, keep_graph=True).double() for name, value in given.items())
    r, t, r_true, t_true = poses
    cameras = r_true.shape[-3] if r_true.ndim >= 3 else 0
    leading = r.shape[:-3]
    expected = ((*leading, cameras, 3, 3), (*leading, cameras, 3))
    true = [(tuple(r_true.shape), tuple(t_true.shape)), expected, ((cameras, 3, 3), (cameras, 3))]
    if not cameras or (r.shape, t.shape) != expected or true[0] not in true[1:]:
        raise ObservationError(
            "poses have the wrong shape",
            where=", ".join(given),
            got=", ".join(str(tuple(value.shape)) for value in poses),
            expected="(..., C, 3, 3), (..., C, 3), and true poses (C, 3, 3), (C, 3) or of the same shape",
        )
    return poses


def _summary(samples: Tensor) -> dict[str, Tensor]:
    """Means and medians over the calibrated of n sessions (n, 3)."""
    rotation, translation = samples[samples[:, 2] > 0, :2].unbind(1)
    return {
        "rotation_deg": rotation.mean(),
        "translation_m": translation.mean(),
        "rotation_median_deg": _median(rotation),
        "translation_median_m": _median(translation),
        "calibrated": samples[:, 2].mean(),
    }


def _median(values: Tensor) -> Tensor:
    return values.quantile(0.5) if len(values) else values.new_tensor(torch.nan)
