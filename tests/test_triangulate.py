"""Another recording by cameras that were calibrated before: as precise as the cameras, whatever is wrong with the keypoints."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from torchstickcal import Calibration, CalibrationError, Observations, Reconstruction, calibrate, triangulate
from torchstickcal.geometry import se3
from torchstickcal.io import Rig, RigCamera
from torchstickcal.simulate import Noise, SessionSpec
from torchstickcal.simulate.clocks import Clocks
from torchstickcal.simulate.regimes import Outliers
from torchstickcal.simulate.session import SimulatedSession

SPEC = SessionSpec("a", "golf", seed=3, cameras=4, frames=60, regimes=(Noise(1.0),))


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibrate(SPEC.generate().observations)


def errors_m(found: Reconstruction, session: SimulatedSession) -> torch.Tensor:
    """Distances (G, P) of the points from the truth, in the frame of the first camera."""
    truth = session.truth
    true = truth.points @ truth.rotations[0].mT + truth.translations[0]
    at = (found.times * session.fps).round().long() if found.times is not None else torch.arange(len(found.points))
    inside = (at >= 0) & (at < len(true))
    return (found.points - true[at.clamp(0, len(true) - 1)]).norm(dim=-1)[inside]


@pytest.mark.parametrize("regimes", [(), (Noise(1.0, missing=0.2), Outliers(0.05))], ids=["clean", "gaps and outliers"])
def test_points_are_as_precise_as_stated(calibration: Calibration, regimes):
    session = replace(SPEC, path="circle", regimes=regimes).generate()
    found = triangulate(session.observations, calibration)
    errors = errors_m(found, session)
    known = errors.isfinite()
    assert float(known.double().mean()) > 0.9
    assert errors[known].median() < 0.004
    assert errors[known].quantile(0.99) < 0.03
    assert float(((errors / found.points_std_m)[known] < 3).double().mean()) > 0.97
    assert found.time_offsets.abs().max() == 0
    seen = session.observations.visible
    assert not (found.inliers & ~seen).any()
    if regimes:
        wrong = seen & ~torch.from_numpy(session.inliers)
        assert float((found.inliers & wrong).sum() / wrong.sum()) < 0.2


def test_the_length_of_the_stick_is_not_used(calibration: Calibration):
    """A wrong length changes nothing, and the true one is found."""
    session = SPEC.generate()
    found = triangulate(session.observations.with_stick_length(2.0), calibration)
    assert abs(float(found.stick_lengths_m.nanmedian()) - 1.0) < 0.01
    none = triangulate(replace(session.observations, sticks=()), calibration)
    assert torch.equal(none.points.nan_to_num(), found.points.nan_to_num())
    assert none.stick_lengths_m.shape == (60, 0)


@pytest.mark.parametrize("offset_s", [0.006, 0.3])
def test_clocks_of_the_new_recording_are_found(calibration: Calibration, offset_s: float):
    session = replace(SPEC, path="circle", frames=120, clocks=Clocks(offset_s)).generate()
    found = triangulate(session.observations, calibration)
    difference = found.time_offsets - session.truth.time_offsets_s
    assert difference.abs().max() < 5e-4
    assert (difference[1:].abs() < 5 * found.time_offsets_std[1:] + 1e-4).all()
    assert errors_m(found, session).nanmedian() < 0.005
    held = triangulate(session.observations, calibration, {"extends": "default", "synchronise": False})
    assert held.time_offsets.abs().max() == 0
    assert errors_m(held, session).nanmedian() > 1.1 * errors_m(found, session).nanmedian()


def test_label_errors_are_undone(calibration: Calibration):
    session = SPEC.generate()
    keypoints = session.observations.keypoints.clone()
    names = list(session.observations.point_names)
    left = [n for n, name in enumerate(names) if name.startswith("left_")]
    right = [names.index(names[n].replace("left_", "right_")) for n in left]
    keypoints[1, 20:40][:, left + right] = keypoints[1, 20:40][:, right + left]
    found = triangulate(replace(session.observations, keypoints=keypoints), calibration)
    assert (found.keypoint_index[1, 20:40][:, left] == torch.tensor(right)).double().mean() > 0.9
    assert any("exchanged in" in warning for warning in found.warnings)
    assert errors_m(found, session).nanmedian() < 0.005


def test_points_are_in_the_frame_of_the_calibration(calibration: Calibration):
    session = SPEC.generate()
    in_camera, in_world = (triangulate(session.observations, c) for c in (calibration, calibration.in_world("athlete")))
    assert in_world.world.name == "athlete"
    moved = se3.moved(*(part[None, :1] for part in (
        calibration.in_world("athlete").rotations, calibration.in_world("athlete").translations)),
        in_world.points.flatten(0, 1).mT[None])[0, 0].mT.view_as(in_world.points)  # fmt: skip
    assert torch.allclose(moved, in_camera.points, atol=1e-6, equal_nan=True)
    assert torch.allclose(in_world.points_std_m, in_camera.points_std_m, rtol=1e-4, equal_nan=True)


def test_some_of_the_cameras_in_another_order(calibration: Calibration):
    """By name; deviations are relative to the first of those that there are."""
    session = SPEC.generate()
    order = [3, 1, 2]
    given = session.observations
    some = replace(
        given, keypoints=given.keypoints[order], intrinsics=given.intrinsics[order], confidence=None,
        camera_names=tuple(given.camera_names[n] for n in order),
    )  # fmt: skip
    found = triangulate(some, calibration)
    assert errors_m(found, session).nanmedian() < 0.006
    whole = triangulate(given, calibration)
    assert found.points_std_m.nanmedian() > whole.points_std_m.nanmedian() * 0.5
    shuffled = replace(calibration, camera_names=tuple(reversed(calibration.camera_names)))
    assert errors_m(triangulate(given, shuffled), session).nanmedian() > 0.05
    with pytest.raises(CalibrationError, match="cameras of the calibration are others"):
        triangulate(replace(some, camera_names=("x", "y", "z")), calibration)


def test_cameras_of_a_file_are_enough(calibration: Calibration):
    session = SPEC.generate()
    truth = session.truth
    cameras = [
        RigCamera(name, truth.intrinsics[n], (), False, (1920, 1080), truth.rotations[n], truth.translations[n])
        for n, name in enumerate(session.observations.camera_names)
    ]
    found = triangulate(session.observations, Rig.of(cameras))
    assert (found.points - truth.points).norm(dim=-1).nanmedian() < 0.003
    assert found.points_std_m.nanmedian() < triangulate(session.observations, calibration).points_std_m.nanmedian()
    with pytest.raises(CalibrationError, match="unit of length is not known"):
        triangulate(session.observations, Rig.of(cameras, None))


@pytest.mark.parametrize("turned", ["left", "right", "back"])
def test_images_that_were_turned_after_the_calibration(calibration: Calibration, turned: str):
    session = SPEC.generate()
    given = session.observations
    (width, height), (x, y) = given.image_size.expand(4, 2)[0].tolist(), given.keypoints.unbind(-1)
    pixels = {"right": (height - 1 - y, x), "left": (y, width - 1 - x), "back": (width - 1 - x, height - 1 - y)}[turned]
    size = (width, height) if turned == "back" else (height, width)
    phone = Observations(
        torch.stack(pixels, dim=-1), None, given.sticks, image_size=size, fps=given.fps, point_names=given.point_names,
        camera_names=given.camera_names,
    )  # fmt: skip
    found = triangulate(phone, calibration, turned=turned)
    straight = triangulate(replace(given, confidence=None), calibration)
    assert (found.points - straight.points).norm(dim=-1).nanmedian() < 1e-6
    if turned != "back":
        with pytest.raises(CalibrationError, match=r"turned after the calibration.*--turned"):
            triangulate(phone, calibration)


def test_images_of_another_size(calibration: Calibration):
    session = SPEC.generate()
    given = session.observations
    half = Observations(
        (given.keypoints + 0.5) / 2 - 0.5, None, given.sticks, image_size=(960, 540), fps=given.fps,
        point_names=given.point_names, camera_names=given.camera_names,
    )  # fmt: skip
    found = triangulate(half, calibration)
    assert errors_m(found, session).nanmedian() < 0.004
    assert any("0.5 times as large" in warning for warning in found.warnings)


def test_the_same_recording_gives_the_same_bytes(calibration: Calibration):
    first, second = (triangulate(SPEC.generate().observations, calibration) for _ in range(2))
    assert first.points.numpy().tobytes() == second.points.numpy().tobytes()
    assert triangulate(SPEC.generate().observations, calibration, "paper").points.shape == first.points.shape


# --- a calibration that starts from elsewhere --------------------------------------------------------------------------------


@pytest.mark.parametrize("scale", [1e-3, 1.0, 400.0])
def test_a_calibration_starts_from_poses_of_another_program(calibration: Calibration, scale: float):
    """In any frame and at any scale, a few degrees off: the same minimum is found."""
    session = SPEC.generate()
    generator = torch.Generator().manual_seed(0)
    off = 0.05 * torch.randn(4, 6, generator=generator, dtype=torch.float64)
    rotations, translations = se3.retract(session.truth.rotations, session.truth.translations, off)
    start = replace(
        Rig.of_calibration(calibration), rotations=rotations, translations=scale * translations, unit=None, image_size=None
    )
    found = calibrate(session.observations, initial=start)
    assert found.converged
    assert (found.translations - calibration.translations).abs().max() < 1e-3
    assert not any("start" in warning for warning in found.warnings)


def test_a_start_saves_cameras_that_share_too_little(calibration: Calibration):
    """Without it, a pair of cameras that see few common points cannot be placed; with it, they are."""
    session = SPEC.generate()
    keypoints = session.observations.keypoints.clone()
    keypoints[0, 30:] = torch.nan
    keypoints[1:, 5:30] = torch.nan
    keypoints[:, :5, ::2] = torch.nan
    sparse = replace(session.observations, keypoints=keypoints, confidence=None)
    found = calibrate(sparse, {"extends": "default", "initialise": {"min_common_points": 8}}, initial=calibration)
    assert (found.translations - calibration.translations).norm(dim=1).max() < 0.2


def test_without_intrinsics_those_of_the_start_are_the_start(calibration: Calibration):
    session = SPEC.generate()
    given = session.observations
    unknown = Observations(
        given.keypoints, None, given.sticks, image_size=given.image_size, camera_names=given.camera_names,
        point_names=given.point_names,
    )  # fmt: skip
    found = calibrate(unknown, initial=calibration)
    assert found.refined == ("focal_shared",)
    assert (found.translations - calibration.translations).norm(dim=1).max() < 0.05


def test_an_unusable_start_is_refused_or_not_used(calibration: Calibration):
    session = SPEC.generate()
    rig = Rig.of_calibration(calibration)
    for function in (lambda: calibrate(session.observations, initial="colmap"), lambda: triangulate(session.observations, "x")):
        with pytest.raises(CalibrationError, match=r"not a calibration.*got str"):
            function()
    with pytest.raises(CalibrationError, match="a start without poses"):
        calibrate(session.observations, initial=replace(rig, rotations=None, translations=None))
    together = replace(rig, translations=torch.zeros(4, 3), rotations=rig.rotations)
    with pytest.raises(CalibrationError, match="all in one place"):
        calibrate(session.observations, initial=together)
    one = Rig.of([RigCamera("a", rig.intrinsics[0], (), False, None, rig.rotations[0], rig.translations[0])])
    with pytest.raises(CalibrationError, match="cameras of the calibration are others"):
        calibrate(session.observations, initial=one)
    found = calibrate(session.observations, initial=replace(rig, rotations=rig.rotations.roll(1, 0)))
    assert (found.translations - calibration.translations).abs().max() < 1e-3
    assert any("given as a start, which were not used" in warning for warning in found.warnings)
