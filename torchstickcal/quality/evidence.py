"""What findings look at: one session where its calibration ended, and what is computed of it once for all of them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.config import Config
from torchstickcal.geometry import se3
from torchstickcal.geometry.vectors import directions, lengths
from torchstickcal.lazy import cached_property
from torchstickcal.model.correlation import error_correlation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.ranks import nanquantile
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import all_unknowns
from torchstickcal.observations import Observations
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.synchronise import ClockEstimate
from torchstickcal.quality.acceptance import accepted
from torchstickcal.quality.ends import ChangeAtEnd, change_at_end
from torchstickcal.quality.linear import FramePulls
from torchstickcal.quality.moved import LEAST_EVIDENCE, Motion, motion_of
from torchstickcal.quality.single_points import Explanation, SlowChanges, estimated, slow_changes
from torchstickcal.quality.verdict import Acceptance
from torchstickcal.result import CameraParameter
from torchstickcal.solvers.uncertainty import centre_covariances, relative_scale_std

_CONSISTENT_SHARE, _BEHIND_OTHERS, _NOISY_MRAD = 0.62, 0.85, 10.0
"""Least share of a camera's keypoints that agree, also over that of the median camera, and noise of the keypoints, of a rig
whose cameras see one scene. Sound cameras keep 84 % and more, with 20 % of wrong keypoints 66 %."""
DOUBTFUL_SHARE = 0.78
"""Share of a camera's keypoints that agree, below which it is doubted where the other cameras have more."""
_MISFIT_SHARE, _LASTING = 0.92, 0.3
"""Share of a camera's keypoints that agree, over that of the median camera, below which, and correlation of its errors from
frame to frame, beyond that of the median camera, above which it shows something else. Sound cameras have 0.97 and more, and
differ by 0.1 at most. Mirrored and alien ones that fit at another place have 0.87 and less, and differ by 0.4 and more."""
_EVIDENT = 1.5
"""Evidence of a motion of a camera, over its limit, from which on it may be why the camera fits worse."""
_NEAR_FOCAL = 0.3
"""Logarithm of an estimated or suggested over the given focal length: from here on, something else is wrong."""
_FAR_SIGMAS = 5.0
_MOST_SHARE, _MOST_PLACES, _OUTSIDE = (0.05, 0.95), 20_000, 1.2
"""Quantiles of the keypoints between which the rest are wrong ones, the number of keypoints that is looked at, and the distance
from the principal point, over its own from the corner of the image, beyond which there is no image."""
_SAID_BY_IMAGES = 2.0
"""Factor of the evidence against the clocks where the motion in the images, by itself, speaks against them too."""
CONSTANT_SIGMAS = 0.5
"""Errors that are always the same, over the noise, from which on they matter."""
_LARGEST_SIGMAS = 6.0
"""Residual, in standard deviations, beyond which a point was lost."""
_LEAST_FRAMES = 20
"""Least number of frames in which a camera sees a point, for the mean of its errors to be known."""
_OTHER_PERSON_SHARE = 0.2
"""Share of a camera's frames that were set aside as those of another person, from which on the camera itself is doubted."""

_RUN_SHARE, _LEAST_RUN_SHARE = 0.9, 0.1
"""Share of the frames that were set aside, and least share of all frames, that is one run at an end of the session."""
_LEAST_PARALLAX_DEG = 3.0
"""Angle between two rays below which the depth of a point is hardly known."""


@dataclass(frozen=True)
class Evidence:
    """One session where its calibration ended.

    Args:
        ended: the session.
        unknowns: what may be unknown of the cameras, as found and as the keypoints suggest.
        noise: covariance of the cameras' tangents and unknowns by the errors of the keypoints.
        ruler: the covariance that the errors of the sticks' given lengths add.
        clocks: what a search for time offsets has found; None without one.
        unsynchronised: says whether the motion contradicts the clocks, which were not estimated.
        left_out: names of the cameras that are no part of the rig.
        config: the configuration.
        start_contradicted: whether poses were given as a start that the keypoints contradict.
        check: what the keypoints say of lenses and clocks; None where the cameras were given.
    """

    ended: Adjustment
    unknowns: Mapping[str, CameraParameter]
    noise: Tensor
    ruler: Tensor
    clocks: ClockEstimate | None
    unsynchronised: Callable[[], bool]
    left_out: tuple[str, ...]
    config: Config
    start_contradicted: bool = False
    check: CameraCheck | None = None

    @property
    def observations(self) -> Observations:
        """The session as it was given."""
        return self.ended.observations[0]

    @property
    def measurements(self) -> Measurements:
        """All keypoints that could take part, inliers and outliers."""
        return self.ended.measurements

    @cached_property
    def kept(self) -> Measurements:
        """The keypoints that took part to the end."""
        return self.ended.kept

    @property
    def state(self) -> State:
        """The estimate."""
        return self.ended.state

    @property
    def sigma_px(self) -> Tensor:
        """(P,), noise of each point's keypoints, pixels."""
        return self.ended.last.sigma_px[0]

    @property
    def cameras(self) -> int:
        """C"""
        return self.measurements.num_cameras

    def camera(self, index: int) -> str:
        """The name of a camera."""
        return self.observations.camera_label(index)

    def point(self, index: int) -> str:
        """The name of a point."""
        return self.observations.point_label(index)

    def named(self, cameras: Sequence[int]) -> str:
        """The names of some cameras."""
        return ", ".join(map(self.camera, cameras))

    def keypoints_of(self, camera: int) -> Tensor:
        """(F, P, 2), the keypoints of a camera as they were given; NaN where not seen, and at exactly (0, 0)."""
        seen = (self.observations.visible & ~self.observations.at_corner)[camera]
        return self.observations.keypoints[camera].double().where(seen[..., None], torch.nan)

    @property
    def synchronous(self) -> bool:
        """Whether the frames of all cameras were taken as they were given, one beside the other."""
        return not self.ended.frames[0].apart and self.measurements.frames == self.observations.num_frames

    @cached_property
    def agreement(self) -> Tensor:
        """(C,), share of each camera's keypoints that agree with the other cameras; 1 where it has none. Those at exactly
        (0, 0), with which some detectors mark missing ones, do not count."""
        at_corner = (self.ended.seen.pixels[0] == 0).all(1)
        seen, kept = ((m.visible[0] & ~at_corner).sum(-1).double() for m in (self.measurements, self.kept))
        return (kept / seen.clamp_min(1)).where(seen > 0, 1.0)

    @cached_property
    def uneven(self) -> Tensor:
        """(C,), standard deviation between a camera's points of the share of their keypoints that agree, beyond chance.

        A detector that fails now and then is wrong at any point. A camera that shows something else agrees at some points,
        which hardly move, and not at others.
        """
        seen, kept = (m.by_frame(m.visible[0]).sum(1).double() for m in (self.measurements, self.kept))
        share = (kept.sum(-1) / seen.sum(-1).clamp_min(1))[:, None]
        squared = (kept - share * seen).square() - seen * share * (1 - share)
        return (squared.sum(-1) / seen.square().sum(-1).clamp_min(1)).clamp_min(0.0).sqrt()

    @cached_property
    def doubtful(self) -> Tensor:
        """(C,), whether clearly fewer keypoints of a camera agree than of the others."""
        return (self.agreement < DOUBTFUL_SHARE) & (self.agreement < _BEHIND_OTHERS * self.agreement.median())

    @cached_property
    def misfits(self) -> Tensor:
        """(C,), whether a camera seems to show something else than the others: fewer of its keypoints agree, and the errors of
        those that do last. Not one that moved."""
        behind = self.agreement < _MISFIT_SHARE * self.agreement.median()
        if bool(behind.any()):
            behind = behind & self.errors_last_alone
        if bool(behind.any()) and self.motion is not None and self.motion.evidence > _EVIDENT * self.motion.least:
            behind[self.motion.camera] = False
        return behind

    @property
    def hidden(self) -> Tensor:
        """(C,), whether a camera among three may show something else, though its keypoints agree: the points give way to it."""
        return self.errors_last_alone & (self.cameras == 3)

    @cached_property
    def errors_last_alone(self) -> Tensor:
        """(C,), whether the errors of a camera stay alike from frame to frame, while those of the other cameras do not."""
        products, squares = torch.zeros(2, self.cameras, dtype=torch.float64, device=self.sigma_px.device)
        for _, errors, _ in self._errors_px:
            scaled = errors / self.sigma_px
            before, after = scaled[:, :, :-1], scaled[:, :, 1:]
            both = (before != 0) & (after != 0)
            products += (before * after).flatten(1).sum(1)
            squares += (before.square() + after.square()).where(both, 0.0).flatten(1).sum(1) / 2
        correlation = products / squares.clamp_min(1e-9)
        return (correlation > correlation.median() + _LASTING) & (self.cameras > 2)

    @cached_property
    def set_aside_at_end(self) -> Tensor:
        """(C,), whether frames of a camera that were set aside as those of another person are the first or the last of the
        session: so they are where the camera moved far."""
        other = self.ended.labels.other_person[0]
        count, frames = other.sum(1, keepdim=True), torch.arange(other.shape[1], device=other.device)
        runs = torch.stack([frames < count, frames >= other.shape[1] - count])
        at_end = (runs & other).sum(-1).amax(0) > _RUN_SHARE * count[:, 0]
        return at_end & (count[:, 0] >= _LEAST_RUN_SHARE * other.shape[1])

    @cached_property
    def changes_at_end(self) -> dict[int, ChangeAtEnd]:
        """By camera, why its frames at an end of the session were set aside, where that is known."""
        other = self.ended.labels.other_person[0]
        if not bool(other.any()) or not self.synchronous:
            return {}
        found: dict[int, ChangeAtEnd] = {}
        for camera in other.any(1).nonzero().flatten().tolist():
            pose = self.state.rotations[0, camera], self.state.translations[0, camera]
            own = self.measurements.cameras[0][camera : camera + 1]
            change = change_at_end(other[camera], self.points, self.keypoints_of(camera), self.sigma_px, own, pose)
            if change is not None:
                found[camera] = change
        return found

    @cached_property
    def in_common(self) -> Tensor:
        """(C,), share of each camera's keypoints that another camera sees at the same time; 1 where it has none. Of a camera
        that has more than others, as many count."""
        seen, compared = self.observations.visible.flatten(1).sum(1).double(), self.measurements.visible[0].sum(-1)
        return (compared / seen.minimum(seen.median()).clamp_min(1)).clamp_max(1.0).where(seen > 0, 1.0)

    @cached_property
    def consistent(self) -> bool:
        """Whether all cameras agree with each other as those of one scene do, so that linearising tells small errors."""
        least, median = float(self.agreement.min()), float(self.agreement.median())
        agree = least > max(_CONSISTENT_SHARE, _BEHIND_OTHERS * median)
        person = float(self.ended.labels.other_person[0].double().mean(1).max()) < _OTHER_PERSON_SHARE
        near = not bool(self.absurd_focals.any())
        return self.ended.converged and agree and person and near and self.noise_mrad < _NOISY_MRAD

    @cached_property
    def absurd_focals(self) -> Tensor:
        """(C,), whether the keypoints ask for a focal length so far from the given one that something else must be wrong."""
        focal = self.unknowns["focal"]
        wanted = focal.value if focal.refined else focal.suggested
        far = (wanted / focal.given).clamp_min(1e-3).log().abs() > _NEAR_FOCAL
        known = self.observations.intrinsics_known
        return far & (self.contradictions["focal"] > _FAR_SIGMAS**2) if known else torch.zeros_like(far)

    @cached_property
    def common_focal(self) -> tuple[float, float] | None:
        """Logarithm of the factor on all focal lengths that the keypoints suggest, and its standard deviation; None where focal
        lengths were estimated, or are those of several groups."""
        if self.check is None or self.unknowns["focal"].refined:
            return None
        values, stds = self.check.suggestion_for_all("focal_shared")
        return (float(values), float(stds)) if len(values) == 1 else None

    @cached_property
    def off_centre(self) -> Tensor:
        """(C,), whether a camera's keypoints lie where the images of its intrinsics do not: all of them above and to the left
        of the principal point, or many far outside. So they do where the intrinsics are those of another resolution."""
        observations = self.observations
        centre = observations.cameras.matrix[:, :2, 2].double()
        if not observations.intrinsics_known:
            return torch.zeros(self.cameras, dtype=torch.bool, device=centre.device)
        thinned = slice(None, None, 1 + observations.keypoints[0, ..., 0].numel() // _MOST_PLACES)
        keypoints, visible = observations.keypoints[:, thinned], observations.visible[:, thinned, :, None]
        places = (keypoints.double() / centre[:, None, None] - 1).where(visible, torch.nan).flatten(1, 2).mT
        low_share, high_share = _MOST_SHARE
        high = nanquantile(places, high_share)
        found = (high < 0).all(1)
        if observations.image_size is None:
            found |= (nanquantile(places, low_share).abs().maximum(high.abs()) > _OUTSIDE).any(1)
        return found

    @cached_property
    def centres(self) -> Tensor:
        """(C, 3), the cameras' centres, metres."""
        return se3.camera_centres(self.state.rotations[0], self.state.translations[0])

    @cached_property
    def centre_std_m(self) -> Tensor:
        """(C,), standard deviation of each camera's centre by the errors of the keypoints, metres; NaN where cameras were not
        estimated."""
        poses = slice(0, 6 * (self.cameras - 1))
        return centre_covariances(self.centres, self.noise[poses, poses]).diagonal(dim1=1, dim2=2).sum(1).sqrt()

    @cached_property
    def scale_std(self) -> float:
        """Standard deviation of the rig's scale, as a share of it."""
        return float(relative_scale_std(self.centres, self._pose_covariance))

    @property
    def _pose_covariance(self) -> Tensor:
        poses = slice(0, 6 * (self.cameras - 1))
        return (self.noise + self.ruler)[poses, poses]

    @cached_property
    def rig_m(self) -> float:
        """Largest distance between two cameras, metres."""
        return float(torch.cdist(self.centres, self.centres).max())

    @cached_property
    def noise_mrad(self) -> float:
        """Median noise of the keypoints, as an angle."""
        return 1000 * float(self.sigma_px.median() / self.measurements.cameras.focal_px.mean())

    @cached_property
    def points(self) -> Tensor:
        """(3, F, P), metres; NaN where a point is not known."""
        known = self.kept.active[0]
        return self.measurements.by_frame(self.state.points[0].where(known, torch.nan))

    @cached_property
    def points_with_depth(self) -> Tensor:
        """(3, F, P), those of :attr:`points` whose distance from the cameras is known; NaN elsewhere."""
        m = self.kept
        unknown = without_depth(self.state.points[0], self.centres.to(self.state.points), m.visible[0])
        return self.points.masked_fill(m.by_frame(unknown), torch.nan)

    @cached_property
    def constant_errors_px(self) -> Tensor:
        """(C, 2, P), mean residual of each point in each camera, pixels; 0 where it is seen in too few frames to tell."""
        m = self.kept
        sums = torch.zeros(self.cameras, 2, m.points_per_frame, dtype=torch.float64, device=m.pixels.device)
        for _, errors, _ in self._errors_px:
            sums += errors.sum(-2)
        count = m.by_frame(m.visible[0]).sum(1)[:, None]
        return (sums / count.clamp_min(1)).where(count >= _LEAST_FRAMES, 0.0)

    @property
    def _errors_px(self) -> Iterator[tuple[slice, Tensor, Tensor]]:
        """Residuals (C, 2, f, P) of the keypoints that took part, 0 elsewhere, and which they are, (C, 1, f, P), by chunks of
        columns. Large ones are those of a point that was lost, and are drawn in."""
        m, largest = self.kept, _LARGEST_SIGMAS * self.sigma_px
        for columns, residuals, _ in m.residuals(self.state):
            seen = m.visible[0][:, None, columns].unflatten(-1, (-1, m.points_per_frame))
            errors = residuals[0].double().unflatten(-1, seen.shape[-2:])
            yield columns, errors.where(seen, 0.0).clamp(-largest, largest), seen

    @cached_property
    def constant_errors_sigmas(self) -> float:
        """Root mean square of :attr:`constant_errors_px`, divided by the noise; 0 where no point is seen in enough frames."""
        told = self.constant_errors_px != 0
        return float((self.constant_errors_px / self.sigma_px)[told].square().mean().sqrt()) if bool(told.any()) else 0.0

    @cached_property
    def motion(self) -> Motion | None:
        """The most evident change of a camera's pose during the session; None where nothing can be said."""
        if self.cameras < 2 or not bool(self.kept.active.any()):
            return None
        found = self._motion_among(torch.ones_like(self.sigma_px))
        if found is None or found.evidence < found.least:
            return found
        times = self._varying_times
        found = self._motion_among(times) if bool((times > 1).any()) else found
        if found is None or found.evidence < found.least:
            return found
        slow = self._slow_changes(Explanation.by_motion(self.kept, self.state, found))
        freedom = min(slow.freedom, 6.0 * (self.measurements.frames - 2))  # of the variances that the evidence is divided by
        return found.beside(slow.variance, max(found.least, estimated(LEAST_EVIDENCE, freedom)))

    def slow_changes_beside(self, camera: int, focal_factor: float) -> SlowChanges:
        """How much the errors of single points change slowly, beside what another focal length of a camera explains."""
        return self._slow_changes(Explanation.by_focal(self.kept, self.state, self.ended.last.sigma_px, camera, focal_factor))

    def _slow_changes(self, explanation: Explanation) -> SlowChanges:
        return slow_changes(self.kept, self.state, self.ended.last.sigma_px, self._varying_times, explanation)

    def _motion_among(self, times: Tensor) -> Motion | None:
        """The same, where of each point as many keypoints as ``times`` (P,) count as one."""
        m = self.measurements
        pixels = m.pixels + self.constant_errors_px.to(m.pixels).repeat(1, 1, m.frames)
        varying = replace(m, pixels=pixels, confidence=(m.by_frame(m.confidence) / times.to(m.confidence)).flatten(-2))
        pulls = FramePulls.of(varying, self.state, self.ended.last.sigma_px)
        return motion_of(pulls, self.state.rotations[0], self.state.translations[0])

    @cached_property
    def _varying_times(self) -> Tensor:
        """(P,), as many keypoints of a point are worth one: for how many frames their errors last, beside those that are always
        the same, and those by which the image of a camera is shifted and turned, as if it had moved."""
        m = self.kept
        pixels = m.pixels.clone()
        for columns, errors, seen in self._errors_px:
            count = seen.sum(-1, keepdim=True).clamp_min(1)
            places = m.pixels[0, :, :, columns].unflatten(-1, (-1, m.points_per_frame)).where(seen, 0.0)
            x, y = (places - places.sum(-1, keepdim=True) / count).where(seen, 0.0).unbind(1)
            turn = (x * errors[:, 1] - y * errors[:, 0]).sum(-1) / (x.square() + y.square()).sum(-1).clamp_min(1e-9)
            turned = turn[:, None, :, None] * torch.stack([-y, x], dim=1)
            shared = errors.sum(-1, keepdim=True) / count + turned
            pixels[0, :, :, columns] += shared.flatten(-2).to(pixels)
        alone = replace(m, pixels=pixels)
        return error_correlation(alone, self.state, self.ended.last.sigma_px).varying_times[0]

    @cached_property
    def contradictions(self) -> dict[str, Tensor]:
        """(C,), by the name of what may be unknown of the cameras: squared length, in standard deviations, of the difference
        between what the keypoints suggest and what was given; 0 where it is not known."""
        found: dict[str, Tensor] = {}
        for name, parameter in self.unknowns.items():
            difference = (parameter.by_component("suggested") - parameter.by_component("given")).double()
            squared = (difference / parameter.by_component("suggested_std").double()).square().sum(1)
            found[name] = squared.nan_to_num(0.0, 0.0, 0.0)
        return found

    def explains_most(self, name: str) -> bool:
        """Whether a cause explains more of the residuals than any other that is small enough to be found by linearising.

        Args:
            name: ``motion``, or a family of unknowns: ``lens`` or ``clock``.
        """
        strengths = {"motion": 0.0 if self.motion is None else self.motion.evidence, "lens": 0.0, "clock": 0.0}
        for unknown, squared in self.contradictions.items():
            family = all_unknowns()[unknown].family
            if not self.unknowns[unknown].refined:
                strengths[family] = max(strengths[family], float(squared.max()))

        def most(clock_factor: float) -> bool:
            weighed = strengths | {"clock": clock_factor * strengths["clock"]}
            return weighed[name] >= max(weighed.values())

        alone, said_by_images = most(1.0), most(_SAID_BY_IMAGES)
        return alone if alone == said_by_images or not self.unsynchronised() else said_by_images

    @cached_property
    def acceptance(self) -> Acceptance | None:
        """Errors in millimetres; None where nothing can be tested."""
        return accepted(self.ended, self.noise, self.ruler, self._by_focal_m)

    @property
    def _by_focal_m(self) -> float:
        """By how much cameras are misplaced where each given focal length is wrong by 1 %; NaN where these were estimated."""
        if self.check is None or self.unknowns["focal"].refined:
            return torch.nan
        covariances = centre_covariances(self.centres, self.check.tangents_by("focal", 0.01))[1:]
        return float(covariances.diagonal(dim1=1, dim2=2).sum(1).mean().sqrt())


def median_distances(places: Tensor, seen: Tensor) -> dict[tuple[int, int], float]:
    """Of each two cameras that have some places in common, the median distance between the places in one and in the other.

    Args:
        places: (C, d, N).
        seen: which of them a camera has, (C, N).
    """
    found: dict[tuple[int, int], float] = {}
    for first in range(len(places) - 1):
        squared = (places[first] - places[first + 1 :]).square().sum(1).where(seen[first] & seen[first + 1 :], torch.nan)
        medians = squared.nanmedian(1).values.sqrt().tolist()
        found |= {(first, second): distance for second, distance in enumerate(medians, first + 1) if not math.isnan(distance)}
    return found


def without_depth(points: Tensor, centres: Tensor, seen: Tensor) -> Tensor:
    """Which points (N,) cameras see from nearly one place, so that nothing is known of how far away they are.

    Args:
        points: (3, N), metres.
        centres: of the cameras, (C, 3).
        seen: which camera sees which point, (C, N).
    """
    mean = torch.zeros_like(points)
    for centre, own in zip(centres, seen, strict=True):
        mean += directions(points - centre[:, None]) * own
    length = lengths(mean) / seen.sum(0).clamp_min(1)
    return length > math.cos(math.radians(_LEAST_PARALLAX_DEG / 2))
