"""Is an old calibration still valid for a new recording of the same cameras?

The points of the new recording are triangulated by the old cameras. The camera whose change explains most of the residuals is
placed again, and the points with it, until no camera is left that the old calibration contradicts. So few cameras that moved
are distinguished from many that did not.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor

from torchstickcal.config import InitialiseSettings
from torchstickcal.errors import ObservationError
from torchstickcal.geometry import se3
from torchstickcal.metrics import rotation_angle
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import estimate_sigma_px
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.pipeline.initialise import triangulated
from torchstickcal.quality.finding import Finding, Severity
from torchstickcal.quality.linear import FramePulls, variance_of_sums
from torchstickcal.quality.moved import motion_of
from torchstickcal.quality.resection import resected
from torchstickcal.quality.verdict import Quality
from torchstickcal.result import Calibration
from torchstickcal.workers import on_worker

_MOST_FRAMES = 240
"""Frames that are looked at, evenly spaced."""
_REJECT_SIGMAS = 6.0
_LEAST_EVIDENCE = 45.0
"""Squared length of a change in its standard deviations, from which on a camera has moved."""
_BLOCKS = (12, 24)
"""Numbers of blocks of frames from whose scatter the variance of a change is estimated."""
_PRIOR_M, _PRIOR_RAD = 0.3, 0.2
_HARMLESS_DEG, _HARMLESS_M = 0.05, 0.003
"""A change that no lab would calibrate again for."""
_LEAST_AGREEING, _SOUND_SHARE = 0.5, 0.6
_BEHIND_OTHERS, _LOST_SHARE = 0.85, 0.3
"""Share of a camera over the median, below which it is looked at whether its keypoints ceased to agree at some frame, and the
share that must have."""
_WRONG_LENGTH_SHARE = 0.02


@dataclass(frozen=True)
class OldRig:
    """Cameras as an old calibration has them.

    Args:
        rotations: (C, 3, 3), world to camera.
        translations: (C, 3), metres.
        covariance: (6 (C - 1), 6 (C - 1)) of the tangents of all cameras but the first; None where it is not known.
    """

    rotations: Tensor
    translations: Tensor
    covariance: Tensor | None = None

    def variance_of(self, camera: int) -> Tensor:
        """Covariance (6, 6) of the tangent of a camera among the others; of the first, the mean of the others'."""
        if self.covariance is None:
            return torch.zeros(6, 6, dtype=torch.float64)
        blocks = self.covariance.double().unflatten(0, (-1, 6)).unflatten(2, (-1, 6)).diagonal(dim1=0, dim2=2).movedim(-1, 0)
        return blocks.mean(0) if camera == 0 else blocks[camera - 1]


def check(calibration: Calibration | OldRig, observations: Observations) -> Quality:
    """Whether an old calibration is still valid for a new recording of the same cameras.

    Cameras are matched by their order. The intrinsics are those of the new recording.

    Args:
        calibration: the old one.
        observations: the new recording, with keypoints of the same cameras at the same time. Sticks are compared too.

    Returns:
        The verdict: good where no camera moved, else with a finding for each camera that did: how far, and since when.

    Raises:
        ObservationError: if the number of cameras differs.

    Example:
        >>> from torchstickcal import calibrate, check
        >>> from torchstickcal.simulate import Noise, SessionSpec
        >>> old, new = (SessionSpec("swing", "golf", 1, 4, 60, path_m=m, regimes=(Noise(1.0),)).generate() for m in (0.5, 0.6))
        >>> print(check(calibrate(old.observations), new.observations).verdict)
        good
    """
    cpu = torch.device("cpu")  # where so little is quickest
    covariance = None if calibration.covariance is None else calibration.covariance.to(cpu)
    rig = OldRig(calibration.rotations.to(cpu), calibration.translations.to(cpu), covariance)
    if len(rig.rotations) != observations.num_cameras:
        raise ObservationError(
            "the number of cameras differs",
            where="observations",
            got=f"{observations.num_cameras} cameras",
            expected=f"{len(rig.rotations)} as in the calibration",
        )
    return on_worker(cpu, _checked, rig, observations.to("cpu"))


class _Rig:
    """The cameras during the check, and what the keypoints say of them."""

    def __init__(self, old: OldRig, observations: Observations) -> None:
        frames = torch.linspace(0, observations.num_frames - 1, min(observations.num_frames, _MOST_FRAMES)).round().long()
        self.frames = frames
        self.old = old
        self.measurements = _of_frames(observations, frames)
        self.rotations, self.translations = old.rotations.double().clone(), old.translations.double().clone()
        self.moved: list[int] = []
        self._looked()

    def _looked(self) -> None:
        """Triangulate with the cameras as they are now, and linearise."""
        m = self.measurements
        poses = self.rotations[None], self.translations[None]
        points = triangulated(m, *poses, InitialiseSettings())
        self.state = State.of(*poses, points)
        squared = m.squared_residuals(self.state)
        self.sigma_px = estimate_sigma_px(m, squared)
        limits = (_REJECT_SIGMAS * self.sigma_px).square()
        self.agreeing = (m.by_frame(squared) <= limits[:, None, None]) & m.by_frame(m.visible)
        self.pulls = FramePulls.of(m, self.state, self.sigma_px)

    @property
    def shares(self) -> Tensor:
        """(C,), share of each camera's keypoints that agree with the points."""
        return self.agreeing[0].flatten(1).sum(1) / self.measurements.visible[0].sum(1).clamp_min(1)

    def evidence(self, camera: int, exact: bool = False) -> float:
        """Squared length, in standard deviations, of the change that a camera's keypoints ask for.

        Args:
            camera: which.
            exact: whether the old calibration counts as exact.
        """
        place = slice(6 * camera, 6 * camera + 6)
        pull, own = self.pulls.gradient[:, camera].sum(0), self.pulls.information[:, place, place].sum(0)
        prior = pull.new_tensor([1 / _PRIOR_M**2] * 3 + [1 / _PRIOR_RAD**2] * 3).diag()
        change = torch.linalg.solve(own + prior, pull)
        parts = self.pulls.information[:, place, place]
        left = self.pulls.gradient_by_part[:, camera] - parts @ change
        scatter = max(1.0, float(variance_of_sums(left, parts, _BLOCKS)))
        covariance = scatter * torch.linalg.inv(own + prior)
        if not exact:
            covariance = covariance + self.old.variance_of(camera).to(pull)
        return float(change @ torch.linalg.solve(covariance, change))

    def place_again(self, camera: int, first: int = 0) -> None:
        """Give a camera the place that its keypoints ask for from a frame on, by the points of the others."""
        m = self.measurements
        others = [other for other in range(m.num_cameras) if other != camera]
        weights = torch.zeros_like(m.confidence)
        weights[:, others] = 1
        rest = m.keeping(weights > 0) if len(others) > 1 else m
        points = triangulated(rest, self.rotations[None], self.translations[None], InitialiseSettings())[0]
        chosen = m.visible[0, camera] & rest.active[0]
        chosen[: first * m.points_per_frame] = False
        sigma = self.sigma_px[0].repeat(m.frames)[chosen]
        lens = m.cameras[0][camera : camera + 1]
        pixels = m.pixels[0, camera][:, chosen].double()
        start = self.rotations[camera], self.translations[camera]
        near = resected(points[:, chosen], pixels, sigma, lens, start)
        if near is None or near.share < _SOUND_SHARE:
            far = resected(points[:, chosen], pixels, sigma, lens)
            near = far if far is not None and (near is None or far.share > near.share) else near
        if near is not None:
            self.rotations[camera], self.translations[camera] = near.rotation, near.translation
        self.moved.append(camera)
        self._looked()


def _checked(old: OldRig, observations: Observations) -> Quality:
    rig = _Rig(old, observations)
    cameras = range(observations.num_cameras)
    found: list[Finding] = []
    if (step := _step_within(rig)) is not None and len(cameras) > 2:
        camera, place, strength = step
        rig.place_again(camera, place)
        found.append(_change(rig, observations, camera, strength, place))
    for _ in range(max(1, len(cameras) - 2)):
        left = [camera for camera in cameras if camera not in rig.moved]
        doubtful = [camera for camera in left if float(rig.shares[camera]) < _LEAST_AGREEING]
        camera = max(doubtful or left, key=lambda one: rig.evidence(one, exact=True))
        strength = rig.evidence(camera)
        if strength < _LEAST_EVIDENCE and not doubtful:
            break
        rig.place_again(camera)
        found.append(_change(rig, observations, camera, strength))
    share = float(rig.shares.min())
    if share < _LEAST_AGREEING:
        name = observations.camera_label(int(rig.shares.argmin()))
        found.append(
            Finding(
                "camera_contradicts",
                Severity.FATAL,
                f"{name}: only {100 * share:.0f} % of its keypoints agree with the calibration, wherever it is.",
                "Check that the recording is of the same cameras in the same order, and that all show the same athlete at the "
                "same time.",
                cameras=(name,),
                figure=share,
                limit=_LEAST_AGREEING,
                unit="share",
            )
        )
    found += _lengths(rig, observations)
    return Quality.of(found)


def _step_within(rig: _Rig) -> tuple[int, int, float] | None:
    """The camera that moved during the recording, the first of the frames after it, and the evidence; None if none did.

    After a large step few keypoints of the camera agree, after a small one they pull at it.
    """
    shares = rig.shares
    camera = int(shares.argmin())
    if float(shares[camera]) < _BEHIND_OTHERS * float(shares.median()):
        m = rig.measurements
        seen = m.by_frame(m.visible[0])[camera].sum(-1).double()
        missing = rig.agreeing[0, camera].sum(-1).double() - float(shares[camera]) * seen
        place = int(missing.cumsum(0).argmax()) + 1
        before, after = (
            float(rig.agreeing[0, camera][part].sum() / seen[part].sum().clamp_min(1))
            for part in (slice(place), slice(place, None))
        )
        if before - after > _LOST_SHARE and 0 < place < m.frames:
            return camera, place, torch.inf
    since = motion_of(rig.pulls, rig.rotations, rig.translations)
    if since is None or since.evidence < _LEAST_EVIDENCE or since.gradual:
        return None
    return since.camera, since.frame, since.evidence


def _change(rig: _Rig, observations: Observations, camera: int, strength: float, place: int = 0) -> Finding:
    """What is said of one camera that moved, before one of the frames that are looked at; 0 for before the recording."""
    before = rig.old.rotations[camera].double(), rig.old.translations[camera].double()
    after = rig.rotations[camera], rig.translations[camera]
    angle = float(rotation_angle(after[0] @ before[0].mT).rad2deg())
    shift = float((se3.camera_centres(*after) - se3.camera_centres(*before)).norm())
    name, frame = observations.camera_label(camera), int(rig.frames[place])
    within = 2 * -(-observations.num_frames // len(rig.frames))
    when = f"at frame {frame} (± {within}) of the recording" if place else "before the recording began"
    harmless = angle < _HARMLESS_DEG and shift < _HARMLESS_M
    return Finding(
        "camera_moved",
        Severity.CAUTION if harmless else Severity.SERIOUS,
        f"{name} moved by {angle:.2g} degrees and {1000 * shift:.2g} mm, {when}.",
        "Calibrate again.",
        cameras=(name,),
        frames=(frame, observations.num_frames - 1),
        figure=strength**0.5,
        limit=_LEAST_EVIDENCE**0.5,
        unit="standard deviations",
        is_cause=True,
    )


def _lengths(rig: _Rig, observations: Observations) -> list[Finding]:
    """Sticks that have another length by the old cameras."""
    found: list[Finding] = []
    m = rig.measurements
    kept = m.keeping(rig.agreeing.flatten(2))
    lengths = kept.stick_lengths_m(rig.state.points)[0].nanmedian(0).values.tolist()
    for ends, given, sigma, length in zip(
        m.sticks.tolist(), m.lengths_m[0].tolist(), m.stick_sigma_m.tolist(), lengths, strict=True
    ):
        limit = max(_WRONG_LENGTH_SHARE * given, 4 * sigma)
        if abs(length - given) > limit:
            names = tuple(map(observations.point_label, ends))
            found.append(
                Finding(
                    "stick_length_differs",
                    Severity.SERIOUS,
                    f"The stick {' - '.join(names)} is {length:.4g} m long by the calibration, but {given:.4g} m was given.",
                    "Check the length of the stick, and calibrate again if it is right.",
                    points=names,
                    figure=abs(length - given),
                    limit=limit,
                    unit="m",
                )
            )
    return found


def _of_frames(observations: Observations, frames: Tensor) -> Measurements:
    """The measurements of some frames."""
    m = Measurements.of(observations)
    pixels, confidence = m.by_frame(m.pixels)[..., frames, :], m.by_frame(m.confidence)[..., frames, :]
    return replace(m, pixels=pixels.flatten(-2).contiguous(), confidence=confidence.flatten(-2), frames=len(frames))
