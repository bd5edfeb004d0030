"""The verdict: what is said of sound and of bad sessions, of lengths that took no part, and of old calibrations."""

from __future__ import annotations

import copy
import json
import pickle
import re
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from torch import Tensor

from torchstickcal import Calibration, Finding, Observations, Quality, Severity, Stick, Verdict, calibrate, check
from torchstickcal.cli import main
from torchstickcal.errors import ObservationError
from torchstickcal.geometry import se3
from torchstickcal.io import load_session, write_npz
from torchstickcal.model.unknowns import all_unknowns
from torchstickcal.quality.ends import change_at_end
from torchstickcal.quality.evidence import Evidence, without_depth
from torchstickcal.quality.findings.causes import _closer
from torchstickcal.quality.findings.images import _off_centre
from torchstickcal.quality.findings.unknowns import _all_focals, _contradicted, _different, _little_in_common
from torchstickcal.quality.judge import _as_effects
from torchstickcal.quality.lags import frames_are_apart
from torchstickcal.quality.linear import FramePulls
from torchstickcal.quality.moved import motion_of
from torchstickcal.quality.registry import FAMILIES, Family, findings
from torchstickcal.quality.resection import Resection, resected
from torchstickcal.quality.single_points import SlowChanges, estimated
from torchstickcal.quality.trials import without
from torchstickcal.result import CameraParameter
from torchstickcal.simulate import Noise, SessionSpec, SimulatedSession, golf_session
from torchstickcal.solvers.elimination.normal_equations import NormalEquations


def session(sport: str = "golf", cameras: int = 5, frames: int = 60, seed: int = 1, sigma_px: float = 1.5) -> SimulatedSession:
    regimes = (Noise(sigma_px, missing=0.05, outliers=0.05),)
    return SessionSpec(sport, sport, seed, cameras, frames, layout="ring", path="circle", regimes=regimes).generate()


def knocked(given: SimulatedSession, camera: int, first: int, turn_deg: float, shift_m: float) -> Observations:
    """One camera is turned about its vertical axis and shifted sideways from a frame on."""
    truth, keypoints = given.truth, given.observations.keypoints.clone()
    assert truth.points is not None
    lens = given.observations.cameras[camera : camera + 1]
    turn = torch.tensor([0.0, 0, 0, 0, turn_deg, 0]).double()
    turn[3:] = turn[3:].deg2rad()
    in_camera = truth.points @ truth.rotations[camera].mT + truth.translations[camera]
    after = in_camera @ se3.exp(turn)[0].mT - torch.tensor([shift_m, 0, 0])

    def seen(points: Tensor) -> Tensor:
        return lens.project(points.flatten(0, 1)[None])[0].view(*points.shape[:2], 2)

    keypoints[camera, first:] += (seen(after) - seen(in_camera))[first:]
    return replace(given.observations, keypoints=keypoints)


def codes(quality: Quality) -> list[str]:
    return [finding.code for finding in quality.findings]


@pytest.mark.parametrize("stick_alone", [True, False])
def test_sticks_alone_do_not_say_that_the_athlete_is_small(stick_alone: bool):
    given = session(cameras=3, frames=30).observations
    ends = list(given.sticks[0].ends)
    points = ends if stick_alone else list(range(given.keypoints.shape[2]))
    few = Observations(
        given.keypoints[:, :, points],
        given.intrinsics,
        Stick(points.index(ends[0]), points.index(ends[1]), given.sticks[0].length_m),
        image_size=(19200, 10800),
        fps=given.fps,
    )
    assert ("athlete_small" in codes(calibrate(few).quality)) != stick_alone


@pytest.mark.parametrize(("sport", "cameras"), [("golf", 3), ("kendo", 6)])
def test_a_sound_session_is_good(sport: str, cameras: int):
    calibration = calibrate(session(sport, cameras).observations)
    quality = calibration.quality
    assert quality.verdict is Verdict.GOOD
    assert not quality.reasons
    assert calibration.warnings == tuple(finding.text for finding in quality.findings)
    assert quality is calibration.quality


def with_camera(observations: Observations, camera: int, change: Callable[[Tensor], Tensor]) -> Observations:
    keypoints = observations.keypoints.clone()
    keypoints[camera] = change(keypoints[camera])
    return replace(observations, keypoints=keypoints)


def mirrored(keypoints: Tensor) -> Tensor:
    return torch.stack([1919 - keypoints[..., 0], keypoints[..., 1]], dim=-1)


def corner_points(keypoints: Tensor) -> Tensor:
    """Every third keypoint marked as missing by zeros."""
    return torch.where((torch.arange(keypoints.shape[1]) % 3 == 0)[:, None], 0.0, keypoints)


@pytest.mark.parametrize(
    ("change", "code"),
    [
        (lambda s: with_camera(s.observations, 2, mirrored), "camera_mirrored"),
        (lambda s: with_camera(s.observations, 0, mirrored), "camera_mirrored"),
        (lambda s: replace(s.observations, keypoints=mirrored(s.observations.keypoints)), "scene_mirrored"),
        (lambda s: with_camera(replace(s.observations, image_size=None), 1, lambda k: k / 2), "intrinsics_other_resolution"),
        (lambda s: with_camera(replace(s.observations, image_size=None), 0, lambda k: 2 * k), "intrinsics_other_resolution"),
        (lambda s: with_camera(s.observations, 3, lambda k: s.observations.keypoints[1]), "same_video"),
        (lambda s: with_camera(s.observations, 2, corner_points), "keypoints_at_corner"),
        (lambda s: s.observations.with_stick_length(3.28), "athlete_height"),
        (lambda s: replace(s.observations, sticks=[*s.observations.sticks, Stick(0, 1, 0.5)]), "stick_lengths_contradict"),
        (lambda s: knocked(s, 2, 25, 0.5, 0.0), "camera_moved"),
        (lambda s: knocked(s, 0, 35, 0.0, 0.04), "camera_moved"),
        (lambda s: knocked(s, 1, 30, 8.0, 0.3), "camera_moved"),
    ],
)  # fmt: skip
def test_the_cause_is_named_first(change: Callable[[SimulatedSession], Observations], code: str):
    quality = calibrate(change(session())).quality
    assert quality.verdict in (Verdict.POOR, Verdict.FAILED)
    assert codes(quality)[0] == code
    assert quality.findings[0].is_cause


@pytest.mark.parametrize(("factor", "said"), [(0.75, True), (4 / 3, True), (1.05, False)])
def test_focal_lengths_of_other_proportions_are_said(factor: float, said: bool):
    given = session(cameras=3, frames=20).observations
    changed = replace(given, intrinsics=given.cameras.matrix * torch.tensor([[factor, 1, 1], [1, 1, 1], [1, 1, 1]]).double())
    found = codes(calibrate(changed).quality)
    assert found.count("pixels_not_square") == (3 if said else 0)


@pytest.mark.parametrize(("cameras", "code"), [(3, "stick_not_rigid"), (4, "points_noisy")])
def test_an_end_that_is_a_mark_on_the_floor_is_no_end(cameras: int, code: str):
    given = session(cameras=cameras, frames=60).observations
    keypoints, head = given.keypoints.clone(), given.sticks[0].ends[1]
    keypoints[:, :, head] = keypoints[:, :, head].nanmedian(1, keepdim=True).values
    quality = calibrate(replace(given, keypoints=keypoints)).quality
    assert quality.verdict is Verdict.POOR
    assert code in codes(quality)[:2]


@pytest.mark.parametrize(
    ("frames_alike", "worse", "error_px", "alien"),
    [(12, [4], 7.0, True), (12, [0], 7.0, True), (1, [4], 3.5, False), (12, [0, 1, 2, 3, 4], 7.0, False)],
)
def test_a_camera_that_fits_worse_for_long_shows_something_else(
    frames_alike: int, worse: list[int], error_px: float, alien: bool
):
    """Not where its errors change from frame to frame, nor where those of all cameras last."""
    given = session(frames=80)
    draws = torch.randn(5, 80 // frames_alike + 2, 21, 2, generator=torch.Generator().manual_seed(3), dtype=torch.float64)
    slow = torch.nn.functional.interpolate(draws.flatten(2).mT, scale_factor=frames_alike, mode="linear").mT[:, :80]
    errors = torch.zeros(5, 80, 21, 2).double()
    errors[worse] = error_px * slow.unflatten(2, (21, 2))[worse]
    calibration = calibrate(replace(given.observations, keypoints=given.observations.keypoints + errors))
    evidence = evidence_of(calibration)
    assert evidence.misfits.tolist() == [alien and camera in worse for camera in range(5)]
    assert ("camera_alien" in codes(calibration.quality)) == alien


@pytest.mark.parametrize(("camera", "sport", "seed"), [(2, "hockey", 20), (1, "kendo", 22)])
def test_points_that_give_way_to_a_camera_among_three_are_an_effect(camera: int, sport: str, seed: int):
    other = session(sport, cameras=3, frames=40, seed=seed).observations.keypoints
    found = calibrate(with_camera(session(cameras=3, frames=40, seed=2).observations, camera, lambda _: other[camera])).quality
    assert found.verdict in (Verdict.POOR, Verdict.FAILED)
    assert codes(found)[0] == "camera_alien"
    assert "points_noisy" in codes(found)


@pytest.mark.parametrize(("lasting", "severity"), [(True, Severity.SERIOUS), (False, Severity.CAUTION)])
def test_keypoints_off_centre_are_serious_where_errors_last(lasting: bool, severity: Severity):
    given = session(cameras=3, frames=10).observations
    found = SimpleNamespace(
        off_centre=torch.tensor([False, True, False]),
        errors_last_alone=torch.tensor([False, lasting, False]),
        observations=given,
        camera=given.camera_label,
    )
    (finding,) = _off_centre(cast("Evidence", found))
    assert (finding.severity, finding.cameras) == (severity, ("cam02",))


@pytest.mark.parametrize("turn_deg", [3.0, 6.0])
def test_a_camera_that_follows_the_athlete_is_named(turn_deg: float):
    """It turns to one side and back."""
    given = session(frames=60)
    truth, share = given.truth, torch.sin(torch.linspace(0, 2 * torch.pi, 60).double())
    assert truth.points is not None
    turns, _ = se3.exp(share[:, None] * torch.tensor([0, 0, 0, 0, turn_deg * torch.pi / 180, 0]).double())
    in_camera = torch.einsum("ij,fpj->fpi", truth.rotations[1], truth.points) + truth.translations[1]
    seen = [given.observations.cameras[1:2].project(x.flatten(0, 1)[None])[0] for x in (in_camera, in_camera @ turns.mT)]
    shift = (seen[1] - seen[0]).view(60, -1, 2)
    quality = calibrate(with_camera(given.observations, 1, lambda keypoints: keypoints + shift)).quality
    assert codes(quality)[0] == "camera_moving"
    (angle,) = re.findall(r"by up to ([\d.]+) degrees", quality.findings[0].meaning)
    assert float(angle) == pytest.approx(2 * turn_deg, rel=0.3)


@pytest.mark.parametrize(
    ("camera", "step", "severity"), [(0, 2, Severity.CAUTION), (2, 3, Severity.CAUTION), (1, 40, Severity.NOTE)]
)
def test_frames_that_are_copies_are_said_and_not_used(camera: int, step: int, severity: Severity):
    given = session(frames=60)
    copied = torch.arange(60) // step * step
    if severity is Severity.NOTE:
        copied = torch.where(torch.arange(60) == step, step - 1, torch.arange(60))
    calibration = calibrate(with_camera(given.observations, camera, lambda keypoints: keypoints[copied]))
    (finding,) = (finding for finding in calibration.quality.findings if finding.code == "frames_repeated")
    assert (finding.severity, finding.cameras) == (severity, (calibration.camera_names[camera],))
    expected = with_camera(
        given.observations, camera, lambda keypoints: keypoints.where((copied == torch.arange(60))[:, None, None], torch.nan)
    )
    assert torch.equal(calibration.translations, calibrate(expected).translations)


def test_missing_keypoints_at_the_corner_do_not_make_a_camera_doubtful():
    calibration = calibrate(with_camera(session(cameras=3, frames=30).observations, 1, corner_points))
    agreement = evidence_of(calibration).agreement
    assert float(agreement.min()) > 0.85
    assert not {"camera_doubtful", "image_upside_down"} & set(codes(calibration.quality))


def evidence_of(calibration: Calibration) -> Evidence:
    assert isinstance(calibration.judgement, partial)
    return calibration.judgement.args[0]


@pytest.mark.parametrize(("cameras", "frames"), [(3, 20), (5, 80)])
def test_keypoints_without_noise_are_no_motion_of_a_camera(cameras: int, frames: int):
    quality = calibrate(golf_session(cameras=cameras, frames=frames)[0]).quality
    assert quality.verdict is Verdict.GOOD


@pytest.mark.parametrize("seed", [2, 10])
def test_errors_that_stay_are_no_motion_of_a_camera(seed: int):
    """A detector that places each joint differently in each view."""
    given = session(cameras=4, frames=80, seed=seed)
    offsets = 6.0 * torch.randn(4, 1, 21, 2, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)
    offsets[:, :, -2:] = 0.0
    calibration = calibrate(replace(given.observations, keypoints=given.observations.keypoints + offsets))
    evidence = evidence_of(calibration)
    biased = FramePulls.of(evidence.measurements, evidence.state, evidence.ended.last.sigma_px)
    as_motion = motion_of(biased, evidence.state.rotations[0], evidence.state.translations[0])
    assert evidence.constant_errors_sigmas > 0.5
    assert evidence.motion is not None
    assert as_motion is not None
    assert evidence.motion.evidence < 0.8 * as_motion.evidence
    assert "camera_moved" not in codes(calibration.quality)


@pytest.mark.parametrize(
    ("share", "sigmas", "constant", "cameras", "slow", "said"),
    [
        (0.05, 3.5, 0.2, 3, 1.0, True),
        (0.05, 3.5, 0.8, 3, 1.0, False),
        (0.025, 3.5, 0.2, 3, 1.0, False),
        (0.025, 4.5, 0.8, 3, 1.0, True),
        (0.05, 2.5, 0.2, 3, 1.0, False),
        (0.05, 3.3, 0.2, 3, 1.0, True),
        (0.05, 3.3, 0.2, 8, 1.0, False),
        (0.05, 3.5, 0.2, 3, 2.0, False),
        (0.05, 8.0, 0.2, 8, 2.0, True),
        (0.18, 3.7, 0.9, 6, 1.0, True),
    ],
)
def test_a_large_error_of_a_focal_length_needs_less_evidence(
    share: float, sigmas: float, constant: float, cameras: int, slow: float, said: bool
):
    """The more cameras are looked at, and the more single points change by themselves, the more."""
    given, change = torch.full((cameras,), 1200.0), share * torch.eye(cameras)[1]
    std = torch.full((cameras,), share / sigmas)
    suggested = (given * (1 + change), 1200 * std)
    focal = CameraParameter("focal length", "px", ("focal",), False, given, given, given, 0.1 * given, suggested)
    evidence = SimpleNamespace(
        observations=session(cameras=3, frames=2).observations,
        cameras=cameras,
        check=SimpleNamespace(suggestion_of_one=lambda name: (change.log1p()[:, None], std[:, None])),
        unknowns={"focal": focal},
        slow_changes_beside=lambda camera, factor: SlowChanges(slow, 1000.0),
        constant_errors_sigmas=constant,
        camera=lambda camera: f"cam{camera}",
        explains_most=lambda family: True,
    )
    found = list(_contradicted(cast(Evidence, evidence), all_unknowns()["focal"], focal))
    assert [(finding.code, finding.severity) for finding in found] == said * [("focal_contradicted", Severity.SERIOUS)]


@pytest.mark.parametrize(
    ("wanted", "std", "said"),
    [
        (0.06, 0.012, [("focal_contradicted", Severity.SERIOUS)]),
        (-0.06, 0.017, [("focal_contradicted", Severity.CAUTION)]),
        (0.06, 0.03, [("focal_unchecked", Severity.NOTE)]),
        (0.02, 0.004, []),
        (0.0, 0.01, []),
        (None, 0.0, []),
    ],
)
def test_focal_lengths_that_are_all_wrong(wanted: float | None, std: float, said: list[tuple[str, Severity]]):
    evidence = SimpleNamespace(
        observations=session(cameras=3, frames=2).observations,
        common_focal=None if wanted is None else (wanted, std),
        explains_most=lambda family: True,
    )
    found = list(_all_focals(cast(Evidence, evidence)))
    assert [(finding.code, finding.severity) for finding in found] == said


def test_several_cameras_together_show_a_wrong_focal_length_that_none_shows_alone():
    given = session(cameras=4, frames=60, sigma_px=3.0).observations
    assert "focal_contradicted" not in codes(calibrate(given).quality)
    longer = given.intrinsics.clone()
    longer[:, [0, 1], [0, 1]] *= 1.06
    found = [one for one in calibrate(replace(given, intrinsics=longer)).quality.findings if one.code == "focal_contradicted"]
    assert found
    assert found[0].severity > Severity.NOTE


@pytest.mark.parametrize(("share", "severity"), [(0.7, None), (0.55, Severity.CAUTION), (0.3, Severity.SERIOUS)])
def test_recordings_with_little_in_common_are_doubted_after_a_search(share: float, severity: Severity | None):
    evidence = SimpleNamespace(in_common=torch.tensor([0.9, share]), clocks=object(), camera=lambda camera: f"cam{camera}")
    found = [finding.severity for finding in _little_in_common(cast(Evidence, evidence))]
    assert found == ([] if severity is None else [severity])
    assert not list(_little_in_common(cast(Evidence, SimpleNamespace(**vars(evidence) | {"clocks": None}))))


def test_a_camera_without_which_no_stick_is_seen_cannot_be_tried():
    observations = session(cameras=3, frames=20).observations
    keypoints = observations.keypoints.clone()
    keypoints[2, :, -2:] = torch.nan
    evidence = evidence_of(calibrate(replace(observations, keypoints=keypoints)))
    assert without(evidence, 0) is None
    assert without(evidence, 2) is not None


def test_what_explains_something_serious_comes_first():
    effect, note = Finding("effect", Severity.FATAL, "."), Finding("note", Severity.NOTE, ".", is_cause=True)
    small = Finding("small", Severity.CAUTION, ".", is_cause=True)
    large = Finding("large", Severity.SERIOUS, ".", is_cause=True)
    assert codes(Quality.of([note, effect, small])) == ["small", "effect", "note"]
    assert codes(Quality.of([small, effect, large])) == ["large", "effect", "small"]
    assert codes(Quality.of([note, small, Finding("caution", Severity.CAUTION, ".")]))[0] == "small"


@pytest.mark.parametrize("refine", [[], ["time_offset"]])
def test_what_wrong_focal_lengths_would_do_is_what_they_do(refine: list[str]):
    observations = session(cameras=3, frames=30).observations
    calibration = calibrate(observations, {"extends": "default", "refine": refine})
    squared = 0.0
    for camera in range(3):
        intrinsics = observations.cameras.matrix.clone()
        intrinsics[camera, [0, 1], [0, 1]] *= 1.001
        wrong = calibrate(replace(observations, intrinsics=intrinsics), {"extends": "default", "refine": refine})
        squared += float((wrong.camera_centres - calibration.camera_centres)[1:].square().sum(1).mean())
    acceptance = calibration.quality.acceptance
    assert acceptance is not None
    assert acceptance.by_focal_m == pytest.approx(10 * squared**0.5, rel=0.02)
    assert f"about {1000 * acceptance.by_focal_m:.2g} mm" in acceptance.focal_sentence


def test_estimated_focal_lengths_are_not_taken_as_right():
    acceptance = calibrate(session(cameras=4, frames=40).observations, refine=["focal"]).quality.acceptance
    assert acceptance is not None
    assert acceptance.focal_sentence == ""


def test_every_keypoint_is_used_or_set_aside():
    given = session(cameras=3, frames=40)
    keypoints = given.observations.keypoints.clone()
    keypoints[0, ::3, 4:8] = torch.nan
    keypoints[1, ::2, 4:8] = torch.nan
    observations = replace(given.observations, keypoints=keypoints)
    calibration = calibrate(observations)
    kinds = ("keypoints_unused", "keypoints_rejected")
    counts = [int(f.meaning.split(" ")[0]) for f in calibration.quality.findings if f.code in kinds]
    others = int((observations.visible & calibration.other_person[..., None]).sum())
    assert len(counts) == 2
    assert sum(counts) + others == int(observations.visible.sum() - calibration.inliers.sum())


def test_keypoints_that_contradict_are_counted_where_labels_were_exchanged_and_some_are_missing():
    given = session(cameras=3, frames=40)
    names = given.observations.point_names
    assert names is not None
    left, right = ([names.index(f"{side}_{joint}") for joint in ("knee", "ankle", "wrist")] for side in ("left", "right"))
    keypoints = given.observations.keypoints.clone()
    keypoints[:, ::2, left[0]] = torch.nan
    keypoints[:, 1::2, right[0]] = torch.nan
    for one, other in [(names.index(name), names.index(name.replace("left", "right"))) for name in names if "left" in name]:
        keypoints[1, 10:30, [one, other]] = keypoints[1, 10:30, [other, one]]
    calibration = calibrate(replace(given.observations, keypoints=keypoints))
    assert bool(calibration.relabelled[1, 10:30].any())
    seen = keypoints.isfinite().all(-1).gather(2, calibration.keypoint_index)
    contradict = int((seen & (seen.sum(0) > 1)).sum() - calibration.inliers.sum())
    said = [finding for finding in calibration.quality.findings if finding.code == "keypoints_rejected"]
    assert [int(finding.meaning.split(" ")[0]) for finding in said] == [contradict] * bool(contradict)


@pytest.mark.parametrize(("camera", "sport", "seed"), [(2, "hockey", 8)])
def test_another_recording_in_one_of_three_cameras_is_named(camera: int, sport: str, seed: int):
    """The points give way to it: it makes noise, and few of its keypoints disagree."""
    other = session(sport, cameras=3, frames=24, seed=seed).observations.keypoints
    calibration = calibrate(with_camera(session(cameras=3, frames=24, seed=2).observations, camera, lambda _: other[camera]))
    quality = calibration.quality
    assert codes(quality)[0] == "camera_alien"
    assert quality.findings[0].cameras == (f"cam{camera + 1:02d}",)


def test_another_recording_in_one_camera_is_named():
    other = session("kendo", seed=7).observations.keypoints
    quality = calibrate(with_camera(session().observations, 4, lambda _: other[4])).quality
    assert not quality.verdict.acceptable
    assert any(
        finding.cameras == ("cam05",) and finding.code in ("camera_alien", "camera_unknown") for finding in quality.findings
    )


@pytest.mark.parametrize(
    ("camera", "first", "turn_deg", "shift_m"), [(0, 20, 0.1, 0.0), (3, 38, 0.2, 0.0), (0, 38, 0.0, 0.005), (3, 20, 0.0, 0.01)]
)
def test_a_small_step_is_found_where_it_is_and_as_large_as_it_is(camera: int, first: int, turn_deg: float, shift_m: float):
    calibration = calibrate(knocked(session(), camera, first, turn_deg, shift_m))
    motion = evidence_of(calibration).motion
    found = [finding for finding in calibration.quality.findings if finding.code == "camera_moved"]
    assert [finding.cameras for finding in found] == [(f"cam{camera + 1:02d}",)]
    assert found[0].frames is not None
    assert abs(found[0].frames[0] - first) <= 2
    assert motion is not None
    assert motion.like_turn
    assert motion.frame_error <= 2
    distance_m = 4.0
    expected = turn_deg + torch.rad2deg(torch.tensor(shift_m / distance_m))
    assert motion.rotation_deg == pytest.approx(float(expected), rel=0.3)


@pytest.mark.parametrize("seed", [1, 5])
def test_errors_that_last_are_no_motion_of_a_camera(seed: int):
    """A detector that errs alike for some ten frames."""
    given, keep = session(seed=seed), 0.9
    generator = torch.Generator().manual_seed(seed)
    keypoints = given.observations.keypoints.clone()
    errors = torch.randn(5, 21, 2, generator=generator, dtype=torch.float64)
    for frame in range(keypoints.shape[1]):
        keypoints[:, frame] += 2.5 * errors
        errors = keep * errors + (1 - keep**2) ** 0.5 * torch.randn(errors.shape, generator=generator, dtype=torch.float64)
    calibration = calibrate(replace(given.observations, keypoints=keypoints))
    evidence = evidence_of(calibration)
    as_independent = evidence._motion_among(torch.ones_like(evidence.sigma_px))
    assert as_independent is not None
    assert as_independent.evidence > as_independent.least
    assert evidence.motion is not None
    assert evidence.motion.evidence < evidence.motion.least
    assert "camera_moved" not in codes(calibration.quality)


@pytest.mark.parametrize(
    ("camera", "first", "turn_deg", "shift_m"), [(2, 11, 4.0, 0.0), (1, 14, 3.0, 0.0), (0, 54, 12.0, 0.4), (3, 5, 20.0, 0.1)]
)
def test_a_camera_that_moved_far_near_an_end_is_no_other_person(camera: int, first: int, turn_deg: float, shift_m: float):
    """All its keypoints contradict the others on one side of the move, and are set aside."""
    calibration = calibrate(knocked(session(), camera, first, turn_deg, shift_m))
    assert int(calibration.other_person[camera].sum()) >= min(first, 60 - first) - 2
    found = calibration.quality.findings[0]
    assert (found.code, found.cameras) == ("camera_moved", (f"cam{camera + 1:02d}",))
    assert found.frames is not None
    assert abs(found.frames[0] - first) <= 2
    assert found.figure == pytest.approx(turn_deg, abs=1.0)
    assert "other_person" not in codes(calibration.quality)


@pytest.mark.parametrize(("camera", "first"), [(1, 50), (2, 8)])
def test_another_person_near_an_end_is_no_camera_that_moved(camera: int, first: int):
    given = session()
    other = session("kendo", seed=9).observations.keypoints[camera, :, :17] + 120.0
    keypoints = given.observations.keypoints.clone()
    wrong = slice(first, None) if first > 30 else slice(0, first)
    keypoints[camera, wrong, :17] = other[wrong].to(keypoints)
    quality = calibrate(replace(given.observations, keypoints=keypoints)).quality
    assert "camera_moved" not in codes(quality)
    assert "other_person" in codes(quality)


@pytest.mark.parametrize(("later", "first"), [(9, 70), (-7, 40)])
def test_frames_at_an_end_that_belong_to_another_time(later: int, first: int):
    """Frames that were lost, or recorded twice: the camera did not move, its frames are those of other times."""
    given = session(frames=100, seed=3)
    points, keypoints = given.truth.points, given.observations.keypoints[1].double()
    assert points is not None
    set_aside = torch.arange(100) >= first
    shifted = torch.where(set_aside[:, None, None], keypoints.roll(-later, 0), keypoints)
    shifted[len(shifted) - max(later, 0) :] = torch.nan
    pose = given.truth.rotations[1].double(), given.truth.translations[1].double()
    sigma_px = torch.full((points.shape[1],), 1.5, dtype=torch.float64)
    camera = given.observations.cameras[1:2]
    change = change_at_end(set_aside, points.double().permute(2, 0, 1), shifted, sigma_px, camera, pose)
    assert change is not None
    assert (change.frame, change.at_start, change.later) == (first, False, later)
    assert change_at_end(~set_aside & set_aside, points.double().permute(2, 0, 1), shifted, sigma_px, camera, pose) is None


@pytest.mark.parametrize(("squared", "freedom", "expected"), [(24.0, 1e6, 24.0), (24.0, 25.0, 40.3), (16.0, 100.0, 17.4)])
def test_a_squared_length_in_estimated_standard_deviations(squared: float, freedom: float, expected: float):
    assert estimated(squared, freedom) == pytest.approx(expected, rel=0.01)


def two_balls(sport: str, cameras: int, seed: int, error: float) -> Observations:
    """A stick whose ends are marked with balls, and no athlete. One end is seen off along the stick, as its view has it."""
    given = SessionSpec("balls", sport, seed, cameras, 120, fps=120, regimes=(Noise(0.12),)).generate()
    points = given.truth.points
    assert points is not None
    start, end = given.observations.sticks[0].ends
    ends = points[:, [start, end]].double()
    rotations, translations = given.truth.rotations.double(), given.truth.translations.double()
    in_camera = torch.einsum("cij,fpj->cfpi", rotations, ends) + translations[:, None, None]
    along, view = in_camera[:, :, 1] - in_camera[:, :, 0], in_camera.mean(2)
    slant = torch.nn.functional.cosine_similarity(along, view, dim=-1).abs()
    keypoints = given.observations.keypoints[:, :, [start, end]].double()
    direction = torch.nn.functional.normalize(keypoints[:, :, 1] - keypoints[:, :, 0], dim=-1)
    keypoints[:, :, 0] += error * torch.where(slant > 0.8, 0.3, torch.where(slant > 0.3, 0.1, 0.02))[..., None] * direction
    stick = replace(given.observations.sticks[0], start=0, end=1)
    return Observations(keypoints, given.observations.intrinsics, stick, image_size=given.observations.image_size, fps=120)


@pytest.mark.parametrize(
    ("sport", "cameras", "seed", "error"),
    [("baseball", 4, 1, 1.0), ("hockey", 4, 6, 1.0), ("baseball", 4, 13, 1.0), ("hockey", 3, 18, 1.0), ("golf", 6, 8, 3.0)],
)
def test_errors_that_depend_on_the_view_of_few_points_are_no_motion_of_a_camera(
    sport: str, cameras: int, seed: int, error: float
):
    quality = calibrate(two_balls(sport, cameras, seed, error)).quality
    assert not {"camera_moved", "camera_drifted", "focal_contradicted"} & set(codes(quality))


@pytest.mark.parametrize(
    ("sport", "cameras", "error", "step_px"), [("baseball", 4, 1.0, 1.0), ("kendo", 5, 0.0, 0.5), ("golf", 4, 1.0, 3.0)]
)
def test_a_camera_that_moved_is_found_by_two_balls(sport: str, cameras: int, error: float, step_px: float):
    observations = two_balls(sport, cameras, 2, error)
    keypoints = observations.keypoints.clone()
    keypoints[1, 70:, :, 0] += step_px
    quality = calibrate(replace(observations, keypoints=keypoints)).quality
    (found,) = [finding for finding in quality.findings if finding.code == "camera_moved"]
    assert found.cameras == ("camera 1",)
    assert found.frames is not None
    assert abs(found.frames[0] - 70) <= 2


@pytest.mark.parametrize(
    ("share", "at_start", "at_end"), [(0.5, True, False), (0.2, False, True), (0.05, True, False), (0.3, False, False)]
)
def test_frames_set_aside_at_an_end(share: float, at_start: bool, at_end: bool):
    evidence = evidence_of(calibrate(session(cameras=3, frames=20).observations))
    other = torch.zeros(1, 3, 20, dtype=torch.bool)
    count = round(share * 20)
    first = 0 if at_start else 20 - count if at_end else 7
    other[0, 1, first : first + count] = True
    labels = replace(evidence.ended.labels, other_person=other)
    changed = replace(evidence, ended=replace(evidence.ended, labels=labels))
    assert changed.set_aside_at_end.tolist() == [False, (at_start or at_end) and share >= 0.1, False]


@pytest.mark.parametrize(
    ("shares", "distances", "closer"),
    [((0.97, 0.96), (1.4, 1.3), True), ((0.97, 0.96), (1.4, 3.3), False), ((0.97, 0.8), (1.4, 1.3), False)],
)
def test_two_places_are_compared_with_another_explanation(
    shares: tuple[float, float], distances: tuple[float, float], closer: bool
):
    """A camera that moved agrees as often with intrinsics of another resolution, but less closely."""

    def placed(share: float, distance_sigmas: float) -> Resection:
        agreeing = torch.arange(100) < 100 * share
        return Resection(torch.eye(3), torch.zeros(3), agreeing, torch.eye(6), distance_sigmas)

    assert _closer([placed(*one) for one in zip(shares, distances, strict=True)], placed(0.95, 3.5)) is closer


@pytest.mark.parametrize(("direct", "severity"), [(False, Severity.FATAL), (True, Severity.FATAL), (False, Severity.SERIOUS)])
def test_what_is_fatal_is_an_effect_of_the_cause_that_a_trial_found(direct: bool, severity: Severity):
    look = FAMILIES["agreement"].look
    family = Family("large", look, direct=direct)
    found = {
        family: [Finding("large", severity, ".", is_cause=True)],
        Family("s", look, small=True): [Finding("s", severity, ".")],
    }
    (left,) = _as_effects(found)
    assert left.is_cause is (direct or severity < Severity.FATAL)


@pytest.mark.parametrize(("angles", "unknown"), [((0.0, 1.0), True), ((0.0, 8.0), False), ((0.0, 1.0, 90.0), False)])
def test_points_seen_from_one_place_have_no_depth(angles: tuple[float, ...], unknown: bool):
    at = torch.tensor(angles, dtype=torch.float64).deg2rad()
    centres = 4 * torch.stack([at.cos(), at.sin(), 0 * at], dim=1)
    points = torch.tensor([[0.0], [0.0], [0.3]]).double().expand(3, 2)
    seen = torch.ones(len(at), 2, dtype=torch.bool)
    seen[2:, 1] = False  # the second point, by the first two cameras only
    assert without_depth(points, centres, seen).tolist() == [unknown, angles[1] < 3]


@pytest.mark.parametrize(
    ("offset_px", "estimate", "severity"),
    [(-60.0, 1.18, Severity.SERIOUS), (-60.0, 1.05, None), (-100.0, 1.0, Severity.CAUTION)],
)
def test_a_principal_point_beside_a_focal_length_far_off(offset_px: float, estimate: float, severity: Severity | None):
    """A focal length that is estimated takes up most of what a principal point explains."""
    given, at = torch.full((3,), 1200.0).double(), torch.tensor([[960.0, 540.0]]).double().expand(3, 2)
    suggested = at + torch.tensor([[0.0, 0.0], [offset_px, 0.0], [0.0, 0.0]])
    std = torch.full_like(at, 10.0)
    unknowns = {
        "focal": CameraParameter(
            *("focal length", "px", ("focal",), True), given * torch.tensor([1.0, estimate, 1.0]), given, given, given,
            (given, given),
        ),
        "principal_point": CameraParameter(
            *("principal point", "px", ("x", "y"), False), at, at, at, torch.full_like(at, 24.0), (suggested, std)
        ),
    }  # fmt: skip
    evidence = SimpleNamespace(
        observations=session(cameras=3, frames=2).observations,
        unknowns=unknowns,
        contradictions={"principal_point": ((suggested - at) / std).square().sum(1)},
        camera=lambda camera: f"cam{camera}",
        explains_most=lambda family: True,
    )
    unknown = all_unknowns()["principal_point"]
    found = [finding.severity for finding in _different(cast(Evidence, evidence), unknown, unknowns["principal_point"])]
    assert found == ([] if severity is None else [severity])


def test_a_camera_that_rolled_is_found():
    """About its axis, which moves no image as a whole."""
    given = session(frames=60)
    centre = given.observations.cameras.matrix[2, :2, 2]
    turn = torch.tensor(0.5).deg2rad().double()
    turned = torch.stack([torch.stack([turn.cos(), -turn.sin()]), torch.stack([turn.sin(), turn.cos()])])
    keypoints = given.observations.keypoints.clone()
    keypoints[2, 30:] = (keypoints[2, 30:] - centre) @ turned.mT + centre
    calibration = calibrate(replace(given.observations, keypoints=keypoints))
    (found,) = [finding for finding in calibration.quality.findings if finding.code == "camera_moved"]
    assert found.cameras == ("cam03",)
    assert found.frames is not None
    assert abs(found.frames[0] - 30) <= 2
    assert "across" not in found.meaning


def test_pulls_are_the_reduced_camera_system_frame_by_frame():
    calibration = calibrate(session(cameras=3, frames=20).observations)
    assert not isinstance(calibration.judgement, Quality)
    evidence = calibration.judgement.args[0]  # type: ignore[attr-defined]
    pulls = FramePulls.of(evidence.kept, evidence.state, evidence.ended.last.sigma_px)
    from torchstickcal.losses import ReprojectionLoss
    from torchstickcal.losses.robust import GemanMcClure
    from torchstickcal.model.objective import Objective

    loss = ReprojectionLoss(evidence.ended.last.sigma_px[:, None, None], kernel=GemanMcClure(4.0))
    system = NormalEquations(Objective(evidence.kept, {"reprojection": loss}), evidence.state, cameras_free=True)
    torch.testing.assert_close(pulls.information.sum(0)[6:, 6:], system.reduced[0])
    torch.testing.assert_close(pulls.gradient.sum(0)[1:].flatten(), system.reduced_gradient[0], rtol=1e-6, atol=1e-6)
    assert motion_of(pulls, evidence.state.rotations[0], evidence.state.translations[0]) is not None


@pytest.mark.parametrize("known", [True, False])
def test_a_camera_is_placed_by_known_points(known: bool):
    given = session(cameras=2, frames=10)
    truth = given.truth
    assert truth.points is not None
    lens, points = given.observations.cameras[1:2], truth.points.flatten(0, 1).mT
    pixels = lens.project((truth.rotations[1] @ points + truth.translations[1][:, None]).mT[None])[0].mT
    pixels[:, ::7] += 80.0
    start = (truth.rotations[0], truth.translations[0]) if known else None
    if start is not None:
        start = se3.retract(truth.rotations[1], truth.translations[1], torch.full((6,), 0.01).double())
    placed = resected(points, pixels, torch.ones(points.shape[1]).double(), lens, start)
    assert placed is not None
    assert placed.share == pytest.approx(6 / 7, abs=0.01)
    torch.testing.assert_close(placed.translation, truth.translations[1], rtol=0, atol=1e-3)


@pytest.mark.parametrize("cameras", [2, 5])
def test_lengths_that_took_no_part_are_inside_their_intervals(cameras: int):
    inside, frames = 0.0, 0
    for seed in range(4):
        acceptance = calibrate(session(cameras=cameras, seed=seed).observations).quality.acceptance
        assert acceptance is not None
        (errors,) = acceptance.lengths
        inside, frames = inside + errors.inside * errors.frames, frames + errors.frames
        assert abs(errors.mean_m) < 5 * errors.std_m
        assert 0.2 < 1000 * acceptance.metre_m < 100
        assert "A length of 1 m measured here is right to" in acceptance.sentence
    assert 0.88 < inside / frames < 0.99


def test_the_fitted_length_does_not_report_on_itself():
    """A stick with a wrong end in some views has a wrong length, however well it was fitted."""
    noisy = session(sigma_px=6.0)
    acceptance = calibrate(noisy.observations).quality.acceptance
    assert acceptance is not None
    fitted = calibrate(noisy.observations).stick_lengths_m
    assert acceptance.lengths[0].std_m > 3 * float(fitted[fitted.isfinite()].std())


def test_a_quality_survives_files_and_processes(tmp_path: Path):
    calibration = calibrate(knocked(session(cameras=3, frames=30), 1, 15, 2.0, 0.0))
    quality = calibration.quality
    assert Quality.from_json(json.loads(json.dumps(quality.as_json()))) == quality
    calibration.save(tmp_path / "c.npz")
    assert Calibration.load(tmp_path / "c.npz").quality == quality
    for other in (copy.deepcopy(calibration), pickle.loads(pickle.dumps(calibration))):
        assert other.quality == quality


def test_a_family_of_findings_of_ones_own():
    @findings("test_slow", "sessions of a low frame rate", replace=True)
    def slow(evidence):
        if evidence.observations.fps < 100:
            yield Finding("low_frame_rate", Severity.CAUTION, "The frame rate is low.", "Record faster.")

    try:
        quality = calibrate(session(cameras=3, frames=30).observations).quality
    finally:
        FAMILIES._things.pop("test_slow")
    assert quality.verdict is Verdict.USABLE
    assert [finding.text for finding in quality.reasons] == ["The frame rate is low. Record faster."]


class TestOffsets:
    """A stick whose detected point lies inside its end."""

    @staticmethod
    def length_of(given: SimulatedSession, start: int, end: int) -> float:
        points = given.truth.points
        assert points is not None
        return float((points[:, end] - points[:, start]).norm(dim=-1).mean())

    @pytest.mark.parametrize(
        ("sport", "offset_m", "at_start"), [("golf", 0.15, True), ("kendo", 0.08, False), ("golf", -0.03, True)]
    )
    def test_a_second_length_tells_the_offset(self, sport: str, offset_m: float, at_start: bool):
        given = session(sport)
        start, end = given.observations.sticks[0].ends
        length_m = self.length_of(given, start, end)
        names = given.observations.point_names
        assert names is not None
        forearm = names.index("left_elbow"), names.index("left_wrist")
        unknown = Stick(start, end, length_m + offset_m, **{"start_offset_m" if at_start else "end_offset_m": None})
        second = Stick(*forearm, self.length_of(given, *forearm))
        calibration = calibrate(replace(given.observations, sticks=[unknown, second]))
        found = next(f for f in calibration.quality.findings if f.code == "stick_offset")
        assert found.figure == pytest.approx(offset_m, abs=0.01)
        assert found.points == (names[start if at_start else end],)
        assert "stick_offset_undetermined" not in codes(calibration.quality)
        assert calibration.stick_lengths_m.shape[1] == 2

    @pytest.mark.parametrize("offset_m", [0.15, -0.05])
    def test_a_known_offset_is_part_of_the_length(self, offset_m: float):
        given = session()
        start, end = given.observations.sticks[0].ends
        plain = Stick(start, end, self.length_of(given, start, end))
        longer = Stick(start, end, plain.length_m + offset_m, end_offset_m=offset_m)
        assert longer.between_m == pytest.approx(plain.length_m)
        centres = [calibrate(replace(given.observations, sticks=stick)).camera_centres for stick in (plain, longer)]
        torch.testing.assert_close(*centres, rtol=0, atol=1e-6)

    def test_the_only_stick_does_not_tell_its_offset(self):
        given = session()
        start, end = given.observations.sticks[0].ends
        sticks = Stick(start, end, 1.0), Stick(start, end, 1.0, start_offset_m=None)
        known, unknown = (calibrate(replace(given.observations, sticks=stick)) for stick in sticks)
        torch.testing.assert_close(known.camera_centres, unknown.camera_centres)
        found = next(f for f in unknown.quality.findings if f.code == "stick_offset_undetermined")
        assert found.severity == Severity.SERIOUS
        assert "1 % too long" in found.text

    def test_offsets_are_kept_in_files(self, tmp_path: Path):
        given = session()
        start, end = given.observations.sticks[0].ends
        sticks = Stick(start, end, 1.1, end_offset_m=0.1), Stick(0, 1, 0.5, start_offset_m=None)
        write_npz(tmp_path / "a.npz", replace(given.observations, sticks=sticks))
        assert load_session(tmp_path / "a.npz").observations.sticks == sticks

    def test_offsets_that_cannot_be_are_refused(self, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
        for offsets in ({"start_offset_m": None, "end_offset_m": None}, {"start_offset_m": 1.2}, {"end_offset_m": "long"}):
            with pytest.raises(ObservationError, match="offset"):
                Stick(0, 1, 1.0, **offsets)
        write_npz(tmp_path / "a.npz", session().observations)
        arguments = [
            "calibrate",
            str(tmp_path / "a.npz"),
            "--stick",
            "club_grip",
            "club_head",
            "1.1",
            "--out",
            str(tmp_path / "o"),
        ]
        for offset, message in ((["club_head", "far"], "not a length"), (["left_wrist", "0.1"], "no end of a stick")):
            assert main([*arguments, "--stick-offset", *offset]) == 2
            assert message in capsys.readouterr().err


class TestOldCalibration:
    new = session(seed=1, frames=50)
    old = calibrate(session(seed=1, frames=80, sigma_px=1.0).observations)

    def test_cameras_that_did_not_move_are_good(self):
        assert check(self.old, self.new.observations).verdict is Verdict.GOOD

    @pytest.mark.parametrize(("camera", "turn_deg", "shift_m"), [(2, 0.3, 0.0), (4, 0.0, 0.03), (0, 0.5, 0.0), (1, 6.0, 0.2)])
    def test_a_camera_that_moved_is_named_with_the_amount(self, camera: int, turn_deg: float, shift_m: float):
        quality = check(self.old, knocked(self.new, camera, 0, turn_deg, shift_m))
        (found,) = [finding for finding in quality.findings if finding.code == "camera_moved"]
        assert found.cameras == (f"cam{camera + 1:02d}",)
        assert not quality.verdict.acceptable
        assert "before the recording" in found.meaning

    def test_a_camera_that_moves_during_the_recording_is_dated(self):
        quality = check(self.old, knocked(self.new, 3, 30, 1.0, 0.0))
        found = quality.findings[0]
        assert found.cameras == ("cam04",)
        assert found.frames is not None
        assert abs(found.frames[0] - 30) <= 2

    def test_another_number_of_cameras_is_refused(self):
        with pytest.raises(ObservationError, match="number of cameras"):
            check(self.old, self.new.observations.of_cameras([0, 1, 2]))


def test_a_camera_that_moved_can_be_split():
    given = session()
    calibration = calibrate(knocked(given, 2, 30, 3.0, 0.0).with_camera_split(2, 30))
    assert calibration.quality.verdict is Verdict.GOOD
    assert calibration.camera_names[-1] == "cam03 from frame 30"
    turned = calibration.rotations[5] @ calibration.rotations[2].mT
    assert float(torch.arccos((turned.diagonal().sum() - 1) / 2).rad2deg()) == pytest.approx(3.0, abs=0.3)
    with pytest.raises(ObservationError, match="cannot be split"):
        given.observations.with_camera_split(2, 0)


def test_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    given = session()
    write_npz(tmp_path / "good.npz", given.observations, given.truth)
    write_npz(tmp_path / "moved.npz", knocked(given, 1, 0, 1.0, 0.0), given.truth)
    write_npz(tmp_path / "during.npz", knocked(given, 1, 30, 1.0, 0.0), given.truth)
    good, moved, during = (str(tmp_path / f"{name}.npz") for name in ("good", "moved", "during"))
    out = str(tmp_path / "out")
    assert main(["calibrate", good, "--out", out]) == 0
    assert capsys.readouterr().out.startswith("verdict: good (nothing speaks against the result)\nA length of 1 m")
    assert json.loads((tmp_path / "out" / "report.json").read_text())["quality"]["verdict"] == "good"
    assert main(["check", out, good]) == 0
    assert main(["check", out, moved, "--json", str(tmp_path / "check.json")]) == 3
    assert json.loads((tmp_path / "check.json").read_text())["findings"][0]["cameras"] == ["cam02"]
    assert main(["check", str(tmp_path / "out" / "calibration.toml"), moved]) == 3
    capsys.readouterr()
    assert main(["calibrate", during, "--out", out, "--refine", "none"]) == 3
    assert "verdict: poor" in capsys.readouterr().out
    assert main(["calibrate", during, "--out", out, "--refine", "none", "--split-moved"]) == 0
    assert "cam02 from frame 30" in capsys.readouterr().out
    assert main(["evaluate", str(tmp_path / "out" / "calibration.toml"), good]) == 2
    assert main(["calibrate", good, "--out", out]) == 0
    capsys.readouterr()
    assert main(["evaluate", out, good]) == 0
    assert "aligned before the comparison: all 5 camera centres" in capsys.readouterr().out


@pytest.mark.parametrize(("cameras", "late", "apart"), [(4, 0, False), (4, 4, True), (2, 0, None)])
def test_equal_frames_are_compared_with_others(cameras: int, late: int, apart: bool | None):
    observations = session("kendo", cameras).observations
    keypoints = observations.keypoints.clone()
    keypoints[1] = keypoints[1].roll(late, 0)
    judgement = calibrate(replace(observations, keypoints=keypoints)).judgement
    assert isinstance(judgement, partial)
    assert frames_are_apart(judgement.args[0]) is apart
