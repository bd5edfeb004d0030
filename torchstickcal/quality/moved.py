"""Cameras that moved during a session: when, and how far.

A camera that is turned or shifted at some frame pulls its keypoints one way before and the other way after. For each camera
and each frame, the change of pose from this frame on that the keypoints ask for is compared with its own standard deviation
(score test). The points, and the poses of all cameras, may follow. Errors that are alike from frame to frame make such pulls
by themselves: the variance is estimated from blocks of frames, not taken from the noise of single keypoints.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.singular import covariance_of
from torchstickcal.quality.linear import FramePulls, variance_of_sums

LEAST_EVIDENCE = 32.0
"""Squared length of the change in its standard deviations, from which on a camera is said to have moved: 6 numbers are fitted
at the best of many frames and cameras. Measured on sound sessions, see docs/quality.md."""
_PRIOR_M, _PRIOR_RAD = 0.03, 0.02
"""A change is expected to be smaller than this; it keeps the test finite where a direction is not determined."""
_LEAST_FRAMES = 12
_EDGE = 0.04
"""Share of a session at each end in which no change is looked for: too few frames speak for it."""
_BLOCKS = (12, 24, 48)
"""Numbers of blocks of frames from whose scatter the variance is estimated."""
_LEAST_VARIANCE = 0.25
"""Least variance of the pulls, over that of independent errors: of keypoints without noise only rounding errors are left."""


class Motion(NamedTuple):
    """The change of one camera's pose that explains most."""

    camera: int
    frame: int
    """the first frame after it; for a drift the first of all"""
    evidence: float
    """squared length of the change in its standard deviations"""
    rival: float
    """the same for the best other camera"""
    rotation_deg: float
    shift_m: float
    """of the camera's centre"""
    tangent: Tensor
    """(6,), of the pose afterwards: ``T Exp(tangent)``"""
    gradual: bool
    """whether it went on during the whole session, rather than at once"""


def motion_of(pulls: FramePulls, rotations: Tensor, translations: Tensor) -> Motion | None:
    """The most evident change of a camera's pose during a session; None where the session is too short to tell.

    Args:
        pulls: of the keypoints.
        rotations: (C, 3, 3), world to camera.
        translations: (C, 3), world to camera.
    """
    if pulls.parts < _LEAST_FRAMES:
        return None
    gradient, information = pulls.gradient_by_part, pulls.information
    cameras = gradient.shape[1]
    prior = gradient.new_tensor([1 / _PRIOR_M**2] * 3 + [1 / _PRIOR_RAD**2] * 3).diag()
    total = information.sum(0) + torch.block_diag(*[1e-2 * prior] * cameras)
    inverse = covariance_of(total)
    common = inverse @ gradient.sum(0).flatten()
    gradient = gradient - (information @ common).unflatten(1, (cameras, 6))
    edge = max(2, round(_EDGE * pulls.parts))
    steps = torch.arange(edge, pulls.parts - edge + 1, device=gradient.device)
    found = [_changes(c, gradient, information, inverse, prior, steps) for c in range(cameras)]
    order = sorted(range(cameras), key=lambda c: -found[c].evidence)
    best = found[order[0]]
    rotation, translation = rotations[order[0]], translations[order[0]]
    moved = se3.retract(rotation, translation, best.tangent)
    shift = se3.camera_centres(*moved) - se3.camera_centres(rotation, translation)
    return Motion(
        camera=order[0],
        frame=pulls.first_frame(best.part),
        evidence=best.evidence,
        rival=found[order[1]].evidence if cameras > 1 else 0.0,
        rotation_deg=float(best.tangent[3:].norm().rad2deg()),
        shift_m=float(shift.norm()),
        tangent=best.tangent,
        gradual=best.gradual,
    )


class _Change(NamedTuple):
    evidence: float
    part: int
    tangent: Tensor
    gradual: bool


def _changes(camera: int, gradient: Tensor, information: Tensor, inverse: Tensor, prior: Tensor, steps: Tensor) -> _Change:
    """The best change of one camera: at once, before one of some parts, or gradually over the session."""
    place = slice(6 * camera, 6 * camera + 6)
    pull, rows = gradient[:, camera], information[:, place]
    parts = len(pull)
    after, rows_after = _from(pull)[steps], _from(rows)[steps]
    changes, evidence = _scored(after, rows_after[..., place], rows_after, inverse, prior)
    best = int(evidence.argmax())
    step = torch.arange(parts, device=pull.device) >= steps[best]
    variance = variance_of_sums(pull - _explained(rows[..., place], step.to(pull), changes[best]), rows[..., place], _BLOCKS)
    ramp = torch.linspace(-0.5, 0.5, parts).to(pull)
    drawn = (ramp[:, None] * pull).sum(0), (ramp[:, None, None] * rows).sum(0)
    squared = (ramp.square()[:, None, None] * rows[..., place]).sum(0)
    drift, drift_evidence = _scored(drawn[0][None], squared[None], drawn[1][None], inverse, prior)
    gradual = float(drift_evidence) > float(evidence[best])
    if gradual:
        variance = variance_of_sums(pull - _explained(rows[..., place], ramp, drift[0]), rows[..., place], _BLOCKS)
    strongest = max(float(drift_evidence), float(evidence[best]))
    tangent, part = (drift[0], 0) if gradual else (changes[best], int(steps[best]))
    return _Change(strongest / max(variance, _LEAST_VARIANCE), part, tangent, gradual)


def _scored(pull: Tensor, own: Tensor, rows: Tensor, inverse: Tensor, prior: Tensor) -> tuple[Tensor, Tensor]:
    """Changes (n, 6) that pulls (n, 6) ask for, and their squared lengths in standard deviations, (n,)."""
    left = own - rows @ inverse @ rows.mT + prior
    change = torch.linalg.solve(left, pull[..., None])[..., 0]
    return -change, (pull * change).sum(-1)


def _explained(own: Tensor, share: Tensor, change: Tensor) -> Tensor:
    """Pulls (K, 6) that a change explains, of which each part has a share (K,), up to a constant."""
    share = share - share.mean()
    return -share[:, None] * (own @ change)


def _from(values: Tensor) -> Tensor:
    """Sums of values (K, ...) from each place to the end."""
    return values.flip(0).cumsum(0).flip(0)
