"""Cameras that moved during a session: when, and how far.

A camera that is turned or shifted at some frame pulls its keypoints one way before and the other way after. For each camera
and each frame, the change of pose from this frame on that the keypoints ask for is compared with its own standard deviation
(score test). The points, and the poses of all cameras, may follow. Errors that are alike from frame to frame make such pulls
by themselves: the variance is estimated from blocks of frames, not taken from the noise of single keypoints.

A knock moves the whole image: it is found as a turn across the optical axis, which has two numbers, also where the camera was
shifted. The four other numbers of a change add more noise than evidence. They count only where they are strong.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.singular import covariance_of
from torchstickcal.quality.linear import FramePulls, variance_of_sums

LEAST_EVIDENCE, LEAST_EVIDENCE_OF_ANY = 22.0, 150.0
"""Squared length of the change in its standard deviations, from which on a camera is said to have moved, where its image moved,
and for a change of any kind. The first is where chance reaches it in less than 1 % of sound sessions: 2 numbers are fitted at
the best of many frames and cameras. Measured on sound sessions, see docs/quality.md."""
_PRIOR_M, _PRIOR_RAD = 0.03, 0.02
"""A change is expected to be smaller than this; it keeps the test finite where a direction is not determined."""
_LEAST_FRAMES = 12
_EDGE = 0.04
"""Share of a session at each end in which no change is looked for: too few frames speak for it."""
_BLOCKS = (12, 24, 48)
"""Numbers of blocks of frames from whose scatter the variance is estimated."""
_LEAST_VARIANCE = 0.6
"""Least variance of the pulls, over that of independent errors. Robust noise makes it 0.7; of keypoints without noise only
rounding errors are left."""
_CERTAIN = 0.95
_NOT_A_TURN = 13.3
"""Evidence that a change has beyond a turn of the camera across its axis, from which on it was no such turn: four more numbers
have less by chance in 99 % of all sessions."""


class Motion(NamedTuple):
    """The change of one camera's pose that explains most."""

    camera: int
    frame: int
    """the first frame after it; for a drift the first of all"""
    frame_error: int
    """frames by which this may be wrong (95 %)"""
    evidence: float
    """squared length of the change in its standard deviations"""
    least: float
    """evidence from which on such a change is one"""
    rival: float
    """the same as ``evidence`` for the best other camera"""
    rotation_deg: float
    shift_m: float
    """of the camera's centre"""
    tangent: Tensor
    """(6,), of the pose afterwards: ``T Exp(tangent)``"""
    gradual: bool
    """whether it went on during the whole session, rather than at once"""
    like_turn: bool
    """whether a turn across the axis explains it as well, which is then the change; a shift across the axis looks alike"""


def motion_of(pulls: FramePulls, rotations: Tensor, translations: Tensor) -> Motion | None:
    """The most evident change of a camera's pose during a session; None where the session is too short to tell.

    Args:
        pulls: of the keypoints.
        rotations: (C, 3, 3), world to camera.
        translations: (C, 3), world to camera.
    """
    if pulls.parts < _LEAST_FRAMES:
        return None
    system = _System.of(pulls)
    across = _turns_across(rotations, translations)
    found = [_best_change(system, camera, across[camera]) for camera in range(len(rotations))]
    order = sorted(range(len(found)), key=lambda camera: -found[camera].strength)
    camera, best = order[0], found[order[0]]
    rotation, translation = rotations[camera], translations[camera]
    moved = se3.retract(rotation, translation, best.tangent)
    shift = se3.camera_centres(*moved) - se3.camera_centres(rotation, translation)
    return Motion(
        camera=camera,
        frame=pulls.first_frame(best.part),
        frame_error=round(best.part_error * len(pulls.part) / pulls.parts),
        evidence=best.strength * best.least,
        least=best.least,
        rival=found[order[1]].strength * best.least if len(found) > 1 else 0.0,
        rotation_deg=float(best.tangent[3:].norm().rad2deg()),
        shift_m=float(shift.norm()),
        tangent=best.tangent,
        gradual=best.gradual,
        like_turn=best.like_turn,
    )


class _System(NamedTuple):
    """What the keypoints of K parts of a session say about the poses of its cameras, around the best poses that stay."""

    pull: Tensor
    """(K, C, 6), half the gradient by the tangents"""
    information: Tensor
    """(K, 6 C, 6 C)"""
    covariance: Tensor
    """(6 C, 6 C), of the poses by all parts together"""
    prior: Tensor
    """(6, 6), information about a change that is there without any keypoints"""

    @staticmethod
    def of(pulls: FramePulls) -> _System:
        pull, information = pulls.gradient_by_part, pulls.information
        cameras = pull.shape[1]
        prior = pull.new_tensor([1 / _PRIOR_M**2] * 3 + [1 / _PRIOR_RAD**2] * 3).diag()
        covariance = covariance_of(information.sum(0) + torch.block_diag(*[1e-2 * prior] * cameras))
        common = covariance @ pull.sum(0).flatten()
        return _System(pull - (information @ common).unflatten(1, (cameras, 6)), information, covariance, prior)


class _Change(NamedTuple):
    """The best change of one camera."""

    strength: float
    """evidence over the least that a change needs"""
    least: float
    part: int
    part_error: int
    tangent: Tensor
    gradual: bool
    like_turn: bool


class _Asked(NamedTuple):
    """Changes that n weighted sums of the pulls at one camera ask for."""

    change: Tensor
    """(n, 6), tangents"""
    evidence_of_any: Tensor
    """(n,), squared length of the change in its standard deviations"""
    turn: Tensor
    """(n, 6), the change that only turns the camera across its axis"""
    evidence: Tensor
    """(n,), the same of it"""

    @staticmethod
    def by(pull: Tensor, own: Tensor, rows: Tensor, system: _System, across: Tensor) -> _Asked:
        """By sums of the pulls (n, 6), of the information about the camera (n, 6, 6), and about all of them (n, 6, 6 C)."""
        left = own - rows @ system.covariance @ rows.mT
        change = torch.linalg.solve(left + system.prior, pull[..., None])[..., 0]
        own_pull = pull @ across
        of_turns = across.mT @ left @ across + torch.eye(2).to(pull) / _PRIOR_RAD**2
        angles = torch.linalg.solve(of_turns, own_pull[..., None])[..., 0]
        return _Asked(-change, (pull * change).sum(-1), -angles @ across.mT, (own_pull * angles).sum(-1))

    @property
    def strength(self) -> Tensor:
        """(n,), evidence over the least that a change needs, without regard to lasting errors."""
        return torch.maximum(self.evidence / LEAST_EVIDENCE, self.evidence_of_any / LEAST_EVIDENCE_OF_ANY)


def _turns_across(rotations: Tensor, translations: Tensor) -> Tensor:
    """Tangents (C, 6, 2) that turn each camera about its centre, around the two axes of its image."""
    axes = rotations[:, :2].mT
    centres = se3.camera_centres(rotations, translations)
    return torch.cat([torch.linalg.cross(centres[..., None].expand_as(axes), axes, dim=1), axes], dim=1)


def _best_change(system: _System, camera: int, across: Tensor) -> _Change:
    """The best change of one camera: at once, before one of some parts, or gradually over the session."""
    place = slice(6 * camera, 6 * camera + 6)
    pull, rows = system.pull[:, camera], system.information[:, place]
    own, parts = rows[..., place], len(pull)
    edge = max(2, round(_EDGE * parts))
    steps = torch.arange(edge, parts - edge + 1, device=pull.device)
    rows_after = _from(rows)[steps]
    at_once = _Asked.by(_from(pull)[steps], rows_after[..., place], rows_after, system, across)
    ramp = torch.linspace(-0.5, 0.5, parts).to(pull)
    rows_along = torch.einsum("k,kij->ij", ramp, rows)[None]
    squared = torch.einsum("k,kij->ij", ramp.square(), own)[None]
    along = _Asked.by((ramp @ pull)[None], squared, rows_along, system, across)
    best = int(at_once.strength.argmax())
    gradual = float(along.strength[0]) > float(at_once.strength[best])
    asked, index = (along, 0) if gradual else (at_once, best)
    share = ramp if gradual else (torch.arange(parts, device=pull.device) >= steps[best]).to(pull)
    turns = float(asked.evidence[index]) / LEAST_EVIDENCE > float(asked.evidence_of_any[index]) / LEAST_EVIDENCE_OF_ANY
    change = asked.turn[index] if turns else asked.change[index]
    others = system.covariance @ ((rows_along[0] if gradual else rows_after[best]).mT @ change)
    explained = rows @ others - share[:, None] * (own @ change)
    variance = max(variance_of_sums(pull - explained, own, _BLOCKS), _LEAST_VARIANCE)
    like_turn = float(asked.evidence_of_any[index] - asked.evidence[index]) < _NOT_A_TURN * variance
    return _Change(
        strength=float(asked.strength[index]) / variance,
        least=LEAST_EVIDENCE if turns else LEAST_EVIDENCE_OF_ANY,
        part=0 if gradual else int(steps[best]),
        part_error=0 if gradual else _error(at_once.evidence if turns else at_once.evidence_of_any, best, variance),
        tangent=asked.turn[index] if like_turn else asked.change[index],
        gradual=gradual,
        like_turn=like_turn,
    )


def _error(evidence: Tensor, best: int, variance: float) -> int:
    """Places by which the best of some (n,) may be wrong, by the likelihood of the others."""
    likelihood = torch.softmax(evidence / (2 * variance), dim=0)
    distances = (torch.arange(len(evidence), device=evidence.device) - best).abs()
    within = torch.zeros(len(evidence), dtype=evidence.dtype, device=evidence.device).index_add_(0, distances, likelihood)
    return int((within.cumsum(0) < _CERTAIN).sum())


def _from(values: Tensor) -> Tensor:
    """Sums of values (K, ...) from each place to the end."""
    return values.flip(0).cumsum(0).flip(0)
