"""Cameras that moved during a session: when, and how far.

A camera that is turned or shifted at some frame pulls its keypoints one way before and the other way after. For each camera
and each frame, the change of pose from this frame on that the keypoints ask for is compared with its own standard deviation
(score test). The points, and the poses of all cameras, may follow. Errors that are alike from frame to frame make such pulls
by themselves: the variance is estimated from blocks of frames, not taken from the noise of single keypoints.

A knock moves the whole image: it is found as a turn of the camera about its centre, also where the camera was shifted. The
other three numbers of a change add more noise than evidence. They count only where they are strong.
"""

from __future__ import annotations

from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.singular import covariance_of
from torchstickcal.quality.linear import FramePulls, variance_of_sums

LEAST_EVIDENCE, LEAST_EVIDENCE_OF_ANY = 24.0, 150.0
"""Squared length of the change in its standard deviations, from which on a camera is said to have moved: of a turn, and of a
change of any kind. Chance reaches the first in less than 1 % of sound sessions, where 3 numbers are fitted at the best of many
frames and cameras. Measured on sound sessions, see docs/quality.md."""
_PRIOR_M, _PRIOR_RAD = 0.03, 0.02
"""A change is expected to be smaller than this; it keeps the test finite where a direction is not determined."""
_LEAST_FRAMES = 12
_EDGE = 0.04
"""Share of a session at each end in which no change is looked for: too few frames speak for it."""
_BLOCKS = (12, 24, 48)
"""Numbers of blocks of frames from whose scatter the variance is estimated."""
_LEAST_VARIANCE, _VARIANCE_BY_KERNEL = 0.4, 0.55
"""Least variance of the pulls, over that of independent errors, and what the robust kernel makes of it. Of keypoints without
noise only rounding errors are left."""
_CERTAIN = 0.95
_NOT_A_TURN = 11.3
"""Evidence that a change has beyond a turn of the camera, from which on it was no turn: three more numbers have less by chance
in 99 % of all sessions."""


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
    """whether a turn explains it as well, which is then the change; a shift across the axis looks like a turn across it"""
    variance: float
    """of the pulls, over that of independent errors"""

    def share(self, frames: int) -> Tensor:
        """(F,), the share of the change that there is in each frame."""
        return torch.linspace(-0.5, 0.5, frames) if self.gradual else (torch.arange(frames) >= self.frame).double()

    def beside(self, slow_variance: float, least: float) -> Motion:
        """The same with less evidence, where errors of single points change slowly by themselves.

        Args:
            slow_variance: of their changes, over that of independent errors.
            least: evidence from which on it is a change.
        """
        share = min(1.0, self.variance / (_VARIANCE_BY_KERNEL * slow_variance))
        return self._replace(evidence=share * self.evidence, rival=share * self.rival, least=least)


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
    poses = list(zip(rotations, translations, strict=True))
    found = _best_changes(system, _motions(rotations, translations))
    order = sorted(range(len(found)), key=lambda camera: -found[camera].strength)
    camera, best = order[0], found[order[0]]
    like_turn = best.like_turn
    tangent = best.asked.tangent(best.chosen, 3 if like_turn else 6)
    before, after = poses[camera], se3.retract(*poses[camera], tangent)
    return Motion(
        camera=camera,
        frame=0 if best.gradual else pulls.first_frame(best.part),
        frame_error=round(best.part_error * len(pulls.part) / pulls.parts),
        evidence=best.strength * best.least,
        least=best.least,
        rival=found[order[1]].strength * best.least if len(found) > 1 else 0.0,
        rotation_deg=float(tangent[3:].norm().rad2deg()),
        shift_m=float((se3.camera_centres(*after) - se3.camera_centres(*before)).norm()),
        tangent=tangent,
        gradual=best.gradual,
        like_turn=like_turn,
        variance=best.variance,
    )


class _System(NamedTuple):
    """What the keypoints of K parts of a session say about the poses of its cameras, around the best poses that stay."""

    pull: Tensor
    """(K, C, 6), half the gradient by the tangents"""
    information: Tensor
    """(K, 6 C, 6 C)"""
    covariance: Tensor
    """(6 C, 6 C), of the poses by all parts together"""

    @staticmethod
    def of(pulls: FramePulls) -> _System:
        pull, information = pulls.gradient_by_part, pulls.information
        cameras = pull.shape[1]
        prior = pull.new_tensor([1 / _PRIOR_M**2] * 3 + [1 / _PRIOR_RAD**2] * 3).diag()
        covariance = covariance_of(information.sum(0) + torch.block_diag(*[1e-2 * prior] * cameras))
        common = covariance @ pull.sum(0).flatten()
        return _System(pull - (information @ common).unflatten(1, (cameras, 6)), information, covariance)


class _Asked(NamedTuple):
    """Changes that n weighted sums of the pulls at one camera ask for: three turns about its centre, then three shifts.

    They are those before one of some parts, and at last that which goes on over the whole session.
    """

    root: Tensor
    """(n, 6, 6), Cholesky factor of the information about the change"""
    pull: Tensor
    """(n, 6), the pull in its standard deviations: of turns, and of what shifts have beyond turns"""
    of_turn: Tensor
    """(n,), squared length of the turn in its standard deviations"""
    of_any: Tensor
    """(n,), the same of the whole change"""
    strength: Tensor
    """(n,), evidence over the least that a change needs, without regard to lasting errors"""
    motions: Tensor
    """(6, 6), tangents of the turns and shifts"""

    @staticmethod
    def by(pull: Tensor, own: Tensor, rows: Tensor, covariance: Tensor, motions: Tensor) -> list[_Asked]:
        """Of each camera, by sums of the pulls (C, n, 6), of the information about the camera (C, n, 6, 6), and about all of
        them (C, n, 6, 6 C), with the covariance of all poses and the motions (C, 6, 6)."""
        prior = pull.new_tensor([1 / _PRIOR_RAD**2] * 3 + [1 / _PRIOR_M**2] * 3).diag()
        each = motions[:, None]
        left = each.mT @ (own - rows @ covariance @ rows.mT) @ each + prior
        root = torch.linalg.cholesky_ex(left).L
        pulled = torch.linalg.solve_triangular(root, (pull @ motions)[..., None], upper=False)[..., 0].nan_to_num()
        of_turn, of_any = pulled[..., :3].square().sum(-1), pulled.square().sum(-1)
        strength = torch.maximum(of_turn / LEAST_EVIDENCE, of_any / LEAST_EVIDENCE_OF_ANY)
        return list(map(_Asked, root, pulled, of_turn, of_any, strength, motions))

    def is_turn(self, index: int) -> bool:
        """Whether one of the changes is found as a turn, rather than as a change of any kind."""
        return float(self.of_turn[index]) / LEAST_EVIDENCE > float(self.of_any[index]) / LEAST_EVIDENCE_OF_ANY

    def tangent(self, index: int, size: int) -> Tensor:
        """(6,), one of the changes: a turn for a size of 3, the whole change for 6."""
        upper, pull = self.root[index, :size, :size].mT, self.pull[index, :size, None]
        return -self.motions[:, :size] @ torch.linalg.solve_triangular(upper, pull, upper=True)[:, 0]


class _Change(NamedTuple):
    """The best change of one camera: of those asked for, one of them."""

    asked: _Asked
    chosen: int
    turned: bool
    """whether it is found as a turn, rather than as a change of any kind"""
    variance: float
    """of the pulls, over that of independent errors"""
    part: int
    gradual: bool

    @property
    def least(self) -> float:
        """The least evidence that it needs."""
        return LEAST_EVIDENCE if self.turned else LEAST_EVIDENCE_OF_ANY

    @property
    def strength(self) -> float:
        """Evidence over the least that it needs."""
        return float(self.asked.strength[self.chosen]) / self.variance

    @property
    def like_turn(self) -> bool:
        """Whether a turn explains it as well."""
        return float((self.asked.of_any - self.asked.of_turn)[self.chosen]) < _NOT_A_TURN * self.variance

    @property
    def part_error(self) -> int:
        """Parts by which it may be at another one, by the likelihood of the others; 0 for a drift."""
        if self.gradual:
            return 0
        evidence = (self.asked.of_turn if self.turned else self.asked.of_any)[:-1]
        likelihood = torch.softmax(evidence / (2 * self.variance), dim=0)
        distances = (torch.arange(len(evidence), device=evidence.device) - self.chosen).abs()
        within = torch.zeros_like(likelihood).index_add_(0, distances, likelihood)
        return int((within.cumsum(0) < _CERTAIN).sum())


def _motions(rotations: Tensor, translations: Tensor) -> Tensor:
    """Tangents (C, 6, 6) that turn each camera about its centre, around its own axes, and that shift it along them."""
    axes = rotations.mT
    centres = se3.camera_centres(rotations, translations)
    turns = torch.cat([torch.linalg.cross(centres[..., None].expand_as(axes), axes, dim=1), axes], dim=1)
    return torch.cat([turns, torch.cat([axes, torch.zeros_like(axes)], dim=1)], dim=2)


def _best_changes(system: _System, motions: Tensor) -> list[_Change]:
    """The best change of each camera: at once, before one of some parts, or gradually over the session."""
    parts, cameras = system.pull.shape[:2]
    edge = max(2, round(_EDGE * parts))
    steps = torch.arange(edge, parts - edge + 1, device=system.pull.device)
    ramp = torch.linspace(-0.5, 0.5, parts).to(system.pull)
    shares = torch.cat([(torch.arange(parts, device=steps.device) >= steps[:, None]).to(ramp), ramp[None]])  # (n, K)
    pull, rows = system.pull.transpose(0, 1), system.information.unflatten(1, (cameras, 6)).transpose(0, 1)
    own = rows.unflatten(3, (cameras, 6)).diagonal(dim1=0, dim2=3).movedim(-1, 0)  # (C, K, 6, 6)
    changed = torch.einsum("nk,ckij->cnij", shares, rows)
    about_own = torch.einsum("nk,ckij->cnij", shares.square(), own)
    asked = _Asked.by(shares @ pull, about_own, changed, system.covariance, motions)
    best = [int(one.strength.argmax()) for one in asked]
    turned = [one.is_turn(n) for one, n in zip(asked, best, strict=True)]
    change = torch.stack([one.tangent(n, 3 if turn else 6) for one, n, turn in zip(asked, best, turned, strict=True)])
    chosen = torch.stack([changed[camera, n] for camera, n in enumerate(best)])
    others = system.covariance @ (chosen.mT @ change[..., None])
    explained = (rows @ others[:, None])[..., 0] - shares[best][..., None] * (own @ change[:, None, :, None])[..., 0]
    variances = variance_of_sums(pull - explained, own, _BLOCKS).clamp_min(_LEAST_VARIANCE).tolist()
    return [
        _Change(one, n, turn, variance, edge + n, gradual=n == len(steps))
        for one, n, turn, variance in zip(asked, best, turned, variances, strict=True)
    ]
