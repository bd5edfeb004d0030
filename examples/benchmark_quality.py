"""How well the verdict on a calibration knows: sound and bad sessions, cameras that move, and lengths that took no part.

    python examples/benchmark_quality.py --sound 300 --bad 300 --pairs 60 --steps 180 --lengths 60

Every table is printed as soon as it is complete. All sessions are simulated, so that the truth is known.
"""

from __future__ import annotations

import argparse
import collections
import itertools
import re
import time
from collections.abc import Callable
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import numpy as np
import torch

from torchstickcal import CalibrationError, ObservationError, Observations, Stick, calibrate
from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Lens, SessionSpec, SimulatedSession
from torchstickcal.simulate.regimes import DetectorNoise, Gaps, Outliers, SelfOcclusion

SPORTS = ("golf", "baseball", "hockey", "kendo", "wand")
LAYOUTS = ("ring", "hemisphere", "random", "arena")
FOCAL_PX = 1200.0
_MOST_DRAWS = 20
_STEPS = ((0.1, 0.0), (0.0, 0.005), (0.1, 0.0), (0.0, 0.005), (0.3, 0.0), (0.0, 0.015))
"""Degrees and metres by which a camera moves, in turn."""
_DRAWS = 1000
"""Simulated errors of an ideal observer."""

Each = Callable[..., Any]
"""Applies a function to the numbers of sessions, as ``map`` does."""


def session(
    number: int, rng: np.random.Generator, cameras: int | None = None, outliers: float | None = None
) -> SimulatedSession:
    """A session with the errors of a detector, in which the stick is seen at all."""
    for _ in range(_MOST_DRAWS):
        try:
            return drawn(number, rng, cameras, outliers)
        except ObservationError:
            continue
    raise RuntimeError(f"no usable session in {_MOST_DRAWS} draws")


def drawn(number: int, rng: np.random.Generator, cameras: int | None, outliers: float | None) -> SimulatedSession:
    """A session with the errors of a detector.

    Raises:
        ObservationError: if no two cameras see the stick at the same time.
    """
    return SessionSpec(
        f"session{number}",
        SPORTS[number % len(SPORTS)],
        seed=int(rng.integers(2**31)),
        cameras=int(rng.integers(2, 11)) if cameras is None else cameras,
        frames=int(rng.choice([60, 100, 160])),
        layout=str(rng.choice(LAYOUTS)),
        lens=Lens(focal_px=FOCAL_PX),
        radius_m=4.5,
        path=str(rng.choice(["stay", "circle", "figure8"])),
        regimes=(
            DetectorNoise(float(rng.uniform(1.5, 3.5)), 1.5),
            SelfOcclusion(),
            Outliers(float(rng.uniform(0, 0.2)) if outliers is None else outliers),
            Gaps(0.1),
        ),
    ).generate()


def projected(given: SimulatedSession, camera: int, rotations: torch.Tensor, translations: torch.Tensor) -> torch.Tensor:
    """What a camera would see from other places, (F, P, 2), for poses (F, 3, 3) and (F, 3)."""
    truth = given.truth
    assert truth.points is not None
    assert truth.intrinsics is not None
    lens = Intrinsics(truth.intrinsics, truth.distortion)[camera : camera + 1]
    in_camera = torch.einsum("fij,fpj->fpi", rotations, truth.points) + translations[:, None]
    return lens.project(in_camera.flatten(0, 1)[None])[0].view(*truth.points.shape[:2], 2)


def displacement(
    given: SimulatedSession, camera: int, share: torch.Tensor, turn_deg: float, shift_m: float, angle: float
) -> torch.Tensor:
    """How far keypoints move, (F, P, 2), where their camera is turned and shifted, across its axis, by a share (F,) in each
    frame."""
    across = torch.tensor([np.cos(angle), np.sin(angle), 0.0], dtype=torch.float64)
    rotation, translation = given.truth.rotations[camera], given.truth.translations[camera]
    turns, _ = se3.exp(torch.cat([torch.zeros(3), across * np.radians(turn_deg)]).double()[None] * share[:, None])
    rotations = turns @ rotation
    translations = (turns @ translation[:, None])[..., 0] - share[:, None] * across * shift_m
    frames = len(share)
    before = projected(given, camera, rotation.expand(frames, 3, 3), translation.expand(frames, 3))
    return projected(given, camera, rotations, translations) - before


def knocked(
    given: SimulatedSession, camera: int, share: torch.Tensor, turn_deg: float, shift_m: float, rng: np.random.Generator
) -> torch.Tensor:
    """Keypoints of a session in which one camera is turned and shifted, across its axis, by a share (F,) in each frame."""
    keypoints = given.observations.keypoints.clone()
    keypoints[camera] += displacement(given, camera, share, turn_deg, shift_m, rng.uniform(0, 2 * np.pi))
    return keypoints


def step_at(frames: int, frame: int) -> torch.Tensor:
    return (torch.arange(frames) >= frame).double()


@dataclass(frozen=True)
class Kind:
    """A kind of bad session.

    Args:
        make: makes the bad observations of a sound session and the number of a camera.
        codes: of the findings that name the cause.
        tellable: whether the keypoints can tell.
        cameras: least number of cameras.
        elsewhere: the cameras, counted from the bad one, that are not where the session has them and so are not compared.
    """

    make: Callable[[SimulatedSession, int, np.random.Generator], Observations]
    codes: tuple[str, ...]
    tellable: bool = True
    cameras: int = 3
    elsewhere: tuple[int, ...] = ()


def with_camera(observations: Observations, camera: int, keypoints: torch.Tensor) -> Observations:
    changed = observations.keypoints.clone()
    changed[camera] = keypoints
    return replace(observations, keypoints=changed)


def with_matrix(observations: Observations, cameras: list[int], change: Callable[[torch.Tensor], torch.Tensor]) -> Observations:
    matrix = observations.cameras.matrix.clone()
    for camera in cameras:
        matrix[camera] = change(matrix[camera])
    return replace(observations, intrinsics=matrix)


def mirrored(keypoints: torch.Tensor, width: float) -> torch.Tensor:
    changed = keypoints.clone()
    changed[..., 0] = width - 1 - changed[..., 0]
    return changed


def scaled(factor: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda matrix: matrix * torch.tensor([[factor], [factor], [1.0]], dtype=matrix.dtype)


def zoomed(factor: float) -> Callable[[torch.Tensor], torch.Tensor]:
    change = torch.tensor([[factor, 1, 1], [1, factor, 1], [1, 1, 1]], dtype=torch.float64)
    return lambda matrix: matrix * change


def shifted(x: float, y: float) -> Callable[[torch.Tensor], torch.Tensor]:
    return lambda matrix: matrix + torch.tensor([[0, 0, x], [0, 0, y], [0, 0, 0]], dtype=matrix.dtype)


def turned(matrix: torch.Tensor) -> torch.Tensor:
    changed = matrix.clone()
    changed[0, 2], changed[1, 2] = matrix[1, 2], matrix[0, 2]
    return changed


def without_size(observations: Observations) -> Observations:
    return replace(observations, image_size=None)


def another(given: SimulatedSession, camera: int, rng: np.random.Generator, same_sport: bool) -> Observations:
    """Another person, or another recording of the same, in one camera."""
    frames = given.observations.num_frames
    truth = given.truth
    sport = SPORTS[int(rng.integers(len(SPORTS)))]
    number = int(rng.integers(10**6))
    spec = SessionSpec("other", sport, seed=number, cameras=2, frames=frames, path="circle", path_m=0.8, tempo=0.8)
    points = torch.from_numpy(spec.motion.points(np.arange(frames) / 60.0 + rng.uniform(1, 5)))
    if not same_sport:
        points = points + torch.tensor([*rng.choice([-1.0, 1.0], 2), 0.0], dtype=torch.float64)
    shown = replace(given, truth=replace(truth, points=points))
    pose = truth.rotations[camera].expand(frames, 3, 3), truth.translations[camera].expand(frames, 3)
    noise = torch.from_numpy(2.0 * rng.standard_normal((frames, points.shape[1], 2)))
    return with_camera(given.observations, camera, projected(shown, camera, *pose) + noise)


def later(given: SimulatedSession, camera: int, frames: int) -> Observations:
    """The frames of one camera are some frames behind those of the others."""
    keypoints = given.observations.keypoints[camera]
    return with_camera(given.observations, camera, torch.cat([keypoints[frames:], keypoints[:frames] * torch.nan]))


def dropped(given: SimulatedSession, camera: int, frame: int, count: int) -> Observations:
    """One camera that lost some frames, without saying so."""
    keypoints = given.observations.keypoints[camera]
    left = torch.cat([keypoints[:frame], keypoints[frame + count :], keypoints[:count] * torch.nan])
    return with_camera(given.observations, camera, left)


def doubled(given: SimulatedSession, camera: int) -> Observations:
    """One camera each frame of which was written twice, as where its video was converted to a higher frame rate."""
    keypoints = given.observations.keypoints[camera]
    return with_camera(given.observations, camera, keypoints[torch.arange(len(keypoints)) // 2 * 2])


def stopped(given: SimulatedSession, camera: int, rng: np.random.Generator) -> Observations:
    """One camera whose video stops at some frame."""
    keypoints = given.observations.keypoints[camera]
    last = int(rng.uniform(0.3, 0.7) * len(keypoints))
    return with_camera(given.observations, camera, keypoints[torch.arange(len(keypoints)).clamp_max(last)])


def following(given: SimulatedSession, camera: int, rng: np.random.Generator) -> Observations:
    """One camera that turns to and fro to keep the athlete in its middle."""
    frames = given.observations.num_frames
    share = torch.sin(torch.linspace(0, float(rng.uniform(1, 3)) * torch.pi, frames).double())
    return replace(given.observations, keypoints=knocked(given, camera, share, float(rng.uniform(2, 8)), 0.0, rng))


def second_view(given: SimulatedSession, camera: int, shift_m: float, rng: np.random.Generator) -> torch.Tensor:
    """What a camera sees from beside another."""
    other = (camera + 1) % given.observations.num_cameras
    frames = given.observations.num_frames
    rotation, translation = given.truth.rotations[other], given.truth.translations[other].clone()
    translation[0] += shift_m
    seen = projected(given, other, rotation.expand(frames, 3, 3), translation.expand(frames, 3))
    return seen + torch.from_numpy(1.5 * rng.standard_normal(seen.shape))


def no_baseline(given: SimulatedSession, rng: np.random.Generator) -> Observations:
    """All cameras within a few centimetres."""
    observations = given.observations
    for camera in range(observations.num_cameras):
        source = replace(given)
        frames = observations.num_frames
        rotation, translation = source.truth.rotations[0], source.truth.translations[0].clone()
        translation[:2] += torch.from_numpy(rng.uniform(-0.02, 0.02, 2))
        seen = projected(source, 0, rotation.expand(frames, 3, 3), translation.expand(frames, 3))
        observations = with_camera(observations, camera, seen + torch.from_numpy(1.5 * rng.standard_normal(seen.shape)))
    return observations


def corner(given: SimulatedSession, camera: int, rng: np.random.Generator) -> Observations:
    """Missing keypoints written as (0, 0)."""
    keypoints = given.observations.keypoints.nan_to_num()
    keypoints[camera][torch.from_numpy(rng.random(keypoints.shape[1:3]) < 0.3)] = 0.0
    return replace(given.observations, keypoints=keypoints)


def wrong_forearm(given: SimulatedSession) -> Observations:
    names = given.observations.point_names
    assert names is not None
    assert given.truth.points is not None
    elbow, wrist = names.index("left_elbow"), names.index("left_wrist")
    length = float((given.truth.points[0, wrist] - given.truth.points[0, elbow]).norm())
    return replace(given.observations, sticks=[*given.observations.sticks, Stick(elbow, wrist, 1.2 * length)])


ALIEN = ("camera_alien", "other_person", "little_in_common")
MOVED = ("camera_moved", "camera_drifted")
CLOCK = ("clock_apart", "unsynchronised", "time_offset_contradicted", "time_offset_uncertain")
LENS = ("focal_contradicted", "intrinsics_other_resolution", "principal_point_off_centre", "intrinsics_turned")
SAME = ("same_video", "same_view", "no_baseline")
KINDS: dict[str, Kind] = {
    "one camera mirrored": Kind(
        lambda s, c, r: with_camera(s.observations, c, mirrored(s.observations.keypoints[c], 1920)), ("camera_mirrored",)
    ),
    "all cameras mirrored": Kind(
        lambda s, c, r: replace(s.observations, keypoints=mirrored(s.observations.keypoints, 1920)), ("scene_mirrored",)
    ),
    "another person": Kind(lambda s, c, r: another(s, c, r, False), ALIEN),
    "another recording": Kind(lambda s, c, r: another(s, c, r, True), ALIEN),
    "one camera's intrinsics of half resolution": Kind(
        lambda s, c, r: without_size(with_matrix(s.observations, [c], scaled(0.5))), LENS
    ),
    "one camera's intrinsics of double resolution": Kind(lambda s, c, r: with_matrix(s.observations, [c], scaled(2.0)), LENS),
    "all intrinsics of half resolution": Kind(
        lambda s, c, r: with_matrix(s.observations, list(range(s.observations.num_cameras)), scaled(0.5)), LENS
    ),
    "one camera's intrinsics turned": Kind(lambda s, c, r: with_matrix(s.observations, [c], turned), LENS),
    "one focal length 25 % wrong": Kind(lambda s, c, r: with_matrix(s.observations, [c], zoomed(1.25)), LENS),
    "one focal length 5 % wrong": Kind(lambda s, c, r: with_matrix(s.observations, [c], zoomed(0.95)), LENS),
    "all focal lengths 20 % wrong": Kind(
        lambda s, c, r: with_matrix(s.observations, list(range(s.observations.num_cameras)), zoomed(1.2)), LENS
    ),
    "one principal point 150 px off": Kind(
        lambda s, c, r: with_matrix(s.observations, [c], shifted(150, 100)), (*LENS, "principal_point_contradicted")
    ),
    "keypoints of one camera at half scale": Kind(
        lambda s, c, r: without_size(with_camera(s.observations, c, s.observations.keypoints[c] / 2)), LENS
    ),
    "the same video twice": Kind(
        lambda s, c, r: with_camera(s.observations, c, s.observations.keypoints[(c + 1) % s.observations.num_cameras]),
        SAME,
        elsewhere=(0,),
    ),
    "two cameras at one place": Kind(
        lambda s, c, r: with_camera(s.observations, c, second_view(s, c, 0.01, r)), SAME, elsewhere=(0,)
    ),
    "no baseline": Kind(lambda s, c, r: no_baseline(s, r), (*SAME, "noise_large"), cameras=2),
    "a camera moved 0.5 degrees": Kind(
        lambda s, c, r: replace(s.observations, keypoints=knocked(s, c, _half(s, r), 0.5, 0.0, r)), MOVED, elsewhere=(0,)
    ),
    "a camera moved 30 mm": Kind(
        lambda s, c, r: replace(s.observations, keypoints=knocked(s, c, _half(s, r), 0.0, 0.03, r)), MOVED, elsewhere=(0,)
    ),
    "a camera moved 8 degrees and 0.3 m": Kind(
        lambda s, c, r: replace(s.observations, keypoints=knocked(s, c, _half(s, r), 8.0, 0.3, r)), MOVED, elsewhere=(0,)
    ),
    "a camera drifted 1 degree": Kind(
        lambda s, c, r: replace(
            s.observations, keypoints=knocked(s, c, torch.linspace(0, 1, s.observations.num_frames).double(), 1.0, 0.0, r)
        ),
        MOVED,
        elsewhere=(0,),
    ),
    "a camera follows the athlete": Kind(lambda s, c, r: following(s, c, r), ("camera_moving", *MOVED), elsewhere=(0,)),
    "a camera's video stops": Kind(lambda s, c, r: stopped(s, c, r), ("frames_repeated",)),
    "a camera of half the frame rate": Kind(lambda s, c, r: doubled(s, c), ("frames_repeated",)),
    "one camera 8 frames late": Kind(lambda s, c, r: later(s, c, 8), CLOCK),
    "one camera lost 6 frames": Kind(lambda s, c, r: dropped(s, c, s.observations.num_frames // 2, 6), (*CLOCK, *MOVED)),
    "stick given in feet": Kind(
        lambda s, c, r: s.observations.with_stick_length(s.observations.sticks[0].length_m * 3.28),
        ("athlete_height",),
        cameras=2,
    ),
    "stick given half as long": Kind(
        lambda s, c, r: s.observations.with_stick_length(s.observations.sticks[0].length_m / 2), ("athlete_height",), cameras=2
    ),
    "stick given 5 % too long": Kind(
        lambda s, c, r: s.observations.with_stick_length(s.observations.sticks[0].length_m * 1.05),
        (),
        tellable=False,
        cameras=2,
    ),
    "sticks that contradict each other": Kind(lambda s, c, r: wrong_forearm(s), ("stick_lengths_contradict",), cameras=2),
    "missing keypoints at (0, 0)": Kind(lambda s, c, r: corner(s, c, r), ("keypoints_at_corner",)),
}
"""The kinds of bad sessions."""


def combined(first: Kind, second: Kind) -> Kind:
    """Two kinds at once, of two cameras. The cause of either counts as right, whichever is named first."""

    def made(given: SimulatedSession, camera: int, rng: np.random.Generator) -> Observations:
        half = replace(given, observations=first.make(given, camera, rng))
        return second.make(half, (camera + 1) % given.observations.num_cameras, rng)

    elsewhere = (*first.elsewhere, *(1 + number for number in second.elsewhere))
    return Kind(made, first.codes + second.codes, cameras=4, elsewhere=elsewhere)


def _half(given: SimulatedSession, rng: np.random.Generator) -> torch.Tensor:
    frames = given.observations.num_frames
    return step_at(frames, int(rng.uniform(0.3, 0.7) * frames))


@dataclass
class Outcome:
    """What was said of one session, and how wrong it is."""

    name: str
    cameras: int
    verdict: str
    codes: list[str]
    error_m: float = float("nan")
    std_m: float = float("nan")
    rig_m: float = 1.0
    seconds: float = 0.0
    judging: float = 0.0
    right: bool = True

    @property
    def confidently_wrong(self) -> bool:
        """Said to be good or usable, but more than 5 standard deviations and 1 % of the rig wrong."""
        return self.verdict in ("good", "usable") and self.error_m > max(5 * self.std_m, 0.01 * self.rig_m)


def judged(
    given: SimulatedSession, observations: Observations, auto: bool, name: str = "", compared: list[int] | None = None
) -> Outcome:
    try:
        began = time.process_time()
        calibration = calibrate(observations, refine="auto" if auto else None)
        middle = time.process_time()
        quality = calibration.quality
        judging = time.process_time() - middle
    except CalibrationError as error:
        return Outcome(name, observations.num_cameras, "refused", [type(error).__name__])
    own = list(range(observations.num_cameras)) if compared is None else compared
    truth = given.truth.rotations[own], given.truth.translations[own]
    errors = pose_errors(calibration.rotations[own], calibration.translations[own], *truth)
    centres = calibration.camera_centres
    found = [finding.code for finding in quality.findings if finding.severity > 0]
    return Outcome(
        name,
        observations.num_cameras,
        str(quality.verdict),
        found,
        float(errors.translation_m.max()),
        float(calibration.camera_std_m.max()),
        float(torch.cdist(centres, centres).max()),
        middle - began,
        judging,
    )


def sound_session(number: int, seed: int) -> Outcome:
    """What is said of one sound session."""
    given = session(number, np.random.default_rng((seed, number)))
    return judged(given, given.observations, bool(number % 2), given.name)


def sound(count: int, seed: int, each: Each) -> None:
    """False alarms among sound sessions, and what the judgement costs."""
    outcomes = list(each(partial(sound_session, seed=seed), range(count)))
    for number, outcome in enumerate(outcomes):
        if outcome.verdict not in ("good", "usable"):
            print("   ", number, SPORTS[number % 5], outcome, flush=True)
    verdicts = collections.Counter(outcome.verdict for outcome in outcomes)
    alarms = sum(outcome.verdict in ("poor", "failed") for outcome in outcomes)
    usable = collections.Counter(code for o in outcomes for code in o.codes)
    share = [o.judging / o.seconds for o in outcomes if o.seconds and o.verdict in ("good", "usable")]
    print(f"\nSound sessions: {count}; {dict(verdicts)}; false alarms (poor or failed): {100 * alarms / count:.1f} %")
    print(f"findings above notes: {dict(usable)}")
    print(f"confidently wrong: {sum(o.confidently_wrong for o in outcomes)}")
    print(f"cameras said to have moved: {sum(bool({*MOVED} & {*o.codes}) for o in outcomes)}")
    print(
        f"time of the judgement over that of the calibration: median {100 * np.median(share):.1f} %, "
        f"mean {100 * np.mean(share):.1f} %",
        flush=True,
    )


def _compared(kind: Kind, camera: int, cameras: int) -> list[int]:
    """The cameras whose places are compared."""
    return [other for other in range(cameras) if (other - camera) % cameras not in kind.elsewhere]


def bad_session(number: int, seed: int) -> Outcome:
    """What is said of one bad session, of the kinds in turn; with clocks and lenses as given, and with ``auto``."""
    names = list(KINDS)
    name = names[number % len(names)]
    return _said_of(number, np.random.default_rng((seed, number, 7)), name, KINDS[name], bool(number // len(names) % 2))


def bad_pair(number: int, seed: int) -> Outcome:
    """What is said of one session with two bad kinds at once; with clocks and lenses as given, and with ``auto``."""
    rng = np.random.default_rng((seed, number, 8))
    single = [name for name, kind in KINDS.items() if kind.tellable and kind.cameras == 3 and not name.startswith("all")]
    names = [str(name) for name in rng.choice(single, 2, replace=False)]
    return _said_of(number, rng, " and ".join(names), combined(KINDS[names[0]], KINDS[names[1]]), bool(number % 2))


def _said_of(number: int, rng: np.random.Generator, name: str, kind: Kind, auto: bool) -> Outcome:
    cameras = int(rng.integers(kind.cameras, 9))
    given = session(number, rng, cameras, outliers=float(rng.uniform(0, 0.1)))
    camera = int(rng.integers(cameras))
    try:
        observations = kind.make(given, camera, rng)
    except CalibrationError as error:
        return Outcome(name, cameras, "refused", [type(error).__name__])
    outcome = judged(given, observations, auto, name, _compared(kind, camera, cameras))
    outcome.right = not kind.codes or bool(outcome.codes and outcome.codes[0] in kind.codes)
    outcome.right |= outcome.verdict in ("good", "usable") and outcome.error_m < 0.01 * outcome.rig_m  # mended by itself
    return outcome


def pairs(count: int, seed: int, each: Each) -> None:
    """Sessions with two bad kinds at once."""
    outcomes = list(each(partial(bad_pair, seed=seed), range(count)))
    for number, outcome in enumerate(outcomes):
        if outcome.confidently_wrong or not outcome.right:
            print("   ", number, outcome, flush=True)
    verdicts = collections.Counter(outcome.verdict for outcome in outcomes)
    named = [outcome.right for outcome in outcomes if outcome.verdict != "refused"]
    print(f"\nSessions with two kinds at once: {count}; {dict(verdicts)}")
    print(
        f"confidently wrong: {sum(o.confidently_wrong for o in outcomes)}; "
        f"one of the causes first: {sum(named)} of {len(named)}",
        flush=True,
    )


def bad(count: int, seed: int, each: Each) -> None:
    """Bad sessions of every kind."""
    outcomes: dict[str, list[Outcome]] = collections.defaultdict(list)
    for number, outcome in enumerate(each(partial(bad_session, seed=seed), range(count))):
        outcomes[outcome.name].append(outcome)
        if outcome.confidently_wrong or not outcome.right:
            print("   ", number, outcome, flush=True)
    print(
        f"\n{'kind of bad session':46} {'n':>3} {'good':>5} {'usable':>6} {'poor':>5} {'failed':>6} {'refused':>7} "
        f"{'conf. wrong':>11} cause"
    )
    wrong = counted = right = 0
    for name, found in outcomes.items():
        verdicts = collections.Counter(outcome.verdict for outcome in found)
        own, named = sum(o.confidently_wrong for o in found), [o.right for o in found if o.verdict != "refused"]
        said = f"{sum(named)}/{len(named)}" if KINDS[name].codes else "cannot be recognised"
        row = [verdicts[v] for v in ("good", "usable", "poor", "failed", "refused")]
        print(f"{name:46} {len(found):3} {row[0]:5} {row[1]:6} {row[2]:5} {row[3]:6} {row[4]:7} {own:11} {said}")
        if KINDS[name].tellable:
            wrong, counted, right = wrong + own, counted + len(named), right + sum(named)
    print(
        f"confidently wrong, of the kinds that can be recognised: {wrong}; "
        f"right cause first: {100 * right / max(counted, 1):.0f} % of {counted}",
        flush=True,
    )


def ideal_share(given: SimulatedSession, camera: int, frame: int, moved: torch.Tensor, rng: np.random.Generator) -> float:
    """How often an ideal observer names the frame of a step within two frames.

    It knows the cameras, the step, and the noise of each keypoint, and chooses the five frames with the largest likelihood. The
    points it knows by the keypoints of their own frame.

    Args:
        given: the session without the step.
        camera: which moves.
        frame: the first frame after the step.
        moved: (F, P, 2), how far the step moves the camera's keypoints.
        rng: of the errors.
    """
    points, frames = given.truth.points, len(moved)
    assert points is not None
    own: list[torch.Tensor] = []
    for number, (rotation, translation) in enumerate(zip(given.truth.rotations, given.truth.translations, strict=True)):
        pose = number, rotation.expand(frames, 3, 3), translation.expand(frames, 3)
        ahead, behind = (
            [projected(replace(given, truth=replace(given.truth, points=points + step * axis)), *pose) for axis in torch.eye(3)]
            for step in (1e-5, -1e-5)
        )
        own.append((torch.stack(ahead, dim=-1) - torch.stack(behind, dim=-1)) / 2e-5)
    seen = torch.from_numpy(given.inliers) & given.observations.visible
    weights = torch.where(seen, 1 / torch.from_numpy(given.sigma_px), 0.0)[..., None]
    by_point, change = (weights[..., None] * torch.stack(own)).nan_to_num(), (weights[camera] * moved).nan_to_num()
    information = torch.einsum("cfpij,cfpik->fpjk", by_point, by_point) + 1e-9 * torch.eye(3)
    pull = torch.einsum("fpij,fpi->fpj", by_point[camera], change)
    followed = (pull * torch.linalg.solve(information, pull[..., None])[..., 0]).sum(-1)
    evidence = (change.square().sum(-1) - followed).sum(-1).clamp_min(0.0).numpy()
    errors = evidence**0.5 * rng.standard_normal((_DRAWS, frames)) - evidence / 2
    ratio = np.zeros((_DRAWS, frames + 1))
    ratio[:, frame + 1 :] = errors[:, frame:].cumsum(1)
    ratio[:, :frame] = errors[:, :frame][:, ::-1].cumsum(1)[:, ::-1]
    likelihood = np.pad(np.exp(ratio - ratio.max(1, keepdims=True)), ((0, 0), (2, 2)))
    windows = np.lib.stride_tricks.sliding_window_view(likelihood, 5, axis=1).sum(-1)
    return float((np.abs(windows.argmax(1) - frame) <= 2).mean())


def step_of_a_camera(number: int, seed: int) -> tuple[str, tuple[float, ...]]:
    """The step; whether it is found, of the right camera, within two frames, and within as many as are said; and how often an
    ideal observer would be within two frames."""
    rng = np.random.default_rng((seed, number, 9))
    given = session(number, rng, int(rng.integers(3, 9)))
    frames, cameras = given.observations.num_frames, given.observations.num_cameras
    frame, camera = int(rng.uniform(0.2, 0.8) * frames), int(rng.integers(cameras))
    turn, shift = _STEPS[number % len(_STEPS)]
    moved = displacement(given, camera, torch.ones(frames).double(), turn, shift, rng.uniform(0, 2 * np.pi))
    keypoints = given.observations.keypoints.clone()
    keypoints[camera, frame:] += moved[frame:]
    quality = calibrate(replace(given.observations, keypoints=keypoints)).quality
    said = [f for f in quality.findings if f.code == "camera_moved"]
    own = [f for f in said if f.cameras == (given.observations.camera_label(camera),) and f.frames]
    off = min((abs(f.frames[0] - frame) for f in own if f.frames), default=frames)
    uncertain = max((int(frames) for f in own for frames in re.findall(r"\(± (\d+)\)", f.meaning)), default=-1)
    label = f"{turn:g} degrees" if turn else f"{1000 * shift:g} mm"
    ideal = ideal_share(given, camera, frame, moved, rng)
    return label, (bool(said), bool(own), off <= 2, off <= uncertain, ideal)


def steps(count: int, seed: int, each: Each) -> None:
    """A step of 0.1 degrees or 5 mm of one camera."""
    found: dict[str, list[tuple[float, ...]]] = collections.defaultdict(list)
    for number, (label, rightly) in enumerate(each(partial(step_of_a_camera, seed=seed), range(count))):
        found[label].append(rightly)
        if not rightly[2]:
            print("   ", number, label, rightly, flush=True)
    print(f"\nSteps of one camera, {count} sessions of 60 to 160 frames, 3 to 8 cameras, shares in per cent")
    print(
        f"{'step':12} {'n':>4} {'found':>6} {'right camera':>13} {'within 2 frames':>16} {'ideal observer':>15} {'as said':>8}"
    )
    for label, values in found.items():
        said, own, near, as_said, ideal = 100 * np.mean(values, axis=0)
        print(f"{label:12} {len(values):4} {said:6.0f} {own:13.0f} {near:16.0f} {ideal:15.1f} {as_said:8.0f}", flush=True)


def biased(given: SimulatedSession, rng: np.random.Generator, sigma_px: float) -> Observations:
    """A detector that errs in the same way for some ten frames."""
    shape = given.observations.keypoints.shape
    errors = np.zeros(shape)
    errors[:, 0] = rng.standard_normal(shape[:1] + shape[2:])
    keep = np.exp(-1 / 10)
    for frame in range(1, shape[1]):
        errors[:, frame] = keep * errors[:, frame - 1] + (1 - keep**2) ** 0.5 * rng.standard_normal(shape[:1] + shape[2:])
    return replace(given.observations, keypoints=given.observations.keypoints + torch.from_numpy(sigma_px * errors))


def left_out_lengths(number: int, seed: int, sigma_px: float) -> list[tuple[float, int, float]]:
    """Of each stick: the share of its lengths inside their intervals, their number, and what is said of a metre."""
    rng = np.random.default_rng((seed, number, 11))
    given = session(number, rng)
    observations = biased(given, rng, sigma_px) if sigma_px else given.observations
    quality = calibrate(observations).quality
    if not quality.verdict.acceptable or quality.acceptance is None:
        return []
    return [(one.inside, one.frames, quality.acceptance.metre_m) for one in quality.acceptance.lengths]


def lengths(count: int, seed: int, each: Each) -> None:
    """How many lengths that took no part lie inside their 95 % interval, and how right the sentence about a metre is."""
    for label, sigma_px in (("independent errors", 0.0), ("and errors of 2 px that last 10 frames", 2.0)):
        one_by_one = each(partial(left_out_lengths, seed=seed, sigma_px=sigma_px), range(count))
        inside, weights, metre = zip(*itertools.chain.from_iterable(one_by_one), strict=True)
        total = np.average(inside, weights=weights)
        print(
            f"\nLengths that took no part, {len(inside)} sessions, {label}: {100 * total:.1f} % inside their 95 % intervals; "
            f"by session: 5 % below {100 * np.quantile(inside, 0.05):.0f} %, median {100 * np.median(inside):.0f} %; "
            f"a metre: median ± {1000 * np.median(metre):.1f} mm",
            flush=True,
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else "")
    parser.add_argument("--sound", type=int, default=0, metavar="N", help="sound sessions")
    parser.add_argument("--bad", type=int, default=0, metavar="N", help="bad sessions")
    parser.add_argument("--pairs", type=int, default=0, metavar="N", help="sessions that are bad in two ways at once")
    parser.add_argument("--steps", type=int, default=0, metavar="N", help="sessions with a step")
    parser.add_argument("--lengths", type=int, default=0, metavar="N", help="sessions whose left-out lengths are looked at")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=1, metavar="N", help="processes")
    options = parser.parse_args()
    parts = (sound, bad, pairs, steps, lengths)
    if not any(getattr(options, part.__name__) for part in parts):
        parser.print_help()
    with ProcessPoolExecutor(options.jobs) as pool:
        for part in parts:
            if count := getattr(options, part.__name__):
                part(count, options.seed, pool.map)


if __name__ == "__main__":
    main()
