"""Frames of the world: everything of a calibration moves together, up is up, and the floor is at the feet."""

from __future__ import annotations

import math
from dataclasses import replace

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import Calibration, CalibrationError, calibrate
from torchstickcal.geometry import se3
from torchstickcal.io import Rig, Truth, write_calibration
from torchstickcal.io.worlds import world_of_calibration, world_of_points
from torchstickcal.observations import Observations
from torchstickcal.simulate import SPORTS, Noise, SessionSpec, golf_session
from torchstickcal.world import Frame, World, athlete_frame, frame_of_cameras, frame_of_points
from torchstickcal.world.body import Body
from torchstickcal.world.upright import upright


@pytest.fixture(scope="module")
def session() -> tuple[Observations, Truth]:
    return golf_session(cameras=4, frames=40, noise=Noise(1.0))


@pytest.fixture(scope="module")
def calibration(session: tuple[Observations, Truth]) -> Calibration:
    return calibrate(session[0])


def turned(vector: list[float]) -> torch.Tensor:
    return torch.from_numpy(cv2.Rodrigues(np.array(vector, dtype=float))[0])


def frame(vector: list[float] = (0.4, -1.2, 2.0), shift: list[float] = (3.0, -1.0, 0.5)) -> Frame:
    return Frame(turned(vector), torch.tensor(shift, dtype=torch.float64), World("points"))


@pytest.mark.parametrize("world", ["athlete", "floor", frame()], ids=["athlete", "floor", "own"])
def test_a_frame_changes_no_image_and_no_deviation(calibration: Calibration, world: str | Frame):
    moved = calibration.in_world(world)
    for name in ("camera_std_m", "camera_std_deg", "scale_std", "points_std_m", "residuals_px", "stick_lengths_m"):
        assert torch.allclose(getattr(moved, name), getattr(calibration, name), rtol=1e-9, equal_nan=True), name
    for points, poses in ((calibration.points, calibration), (moved.points, moved)):
        seen = se3.moved(poses.rotations[None], poses.translations[None], points.flatten(0, 1).mT[None])
        assert torch.allclose(seen, se3.moved(
            calibration.rotations[None], calibration.translations[None], calibration.points.flatten(0, 1).mT[None]
        ), equal_nan=True)  # fmt: skip
    assert not torch.allclose(moved.translations, calibration.translations)


def test_predicted_deviations_follow_the_frame(calibration: Calibration):
    own = frame()
    point = calibration.points[3, 4][None]
    before, after = calibration.predict_std(point), calibration.in_world(own).predict_std(own.points(point.double()))
    assert torch.allclose(before.square().sum(), after.square().sum())


def test_the_way_back_is_the_first_camera(calibration: Calibration):
    back = calibration.in_world("athlete").in_world(frame()).in_world("camera")
    assert back.world == World()
    for name in ("rotations", "translations", "points", "covariance"):
        assert torch.allclose(getattr(back, name), getattr(calibration, name), atol=1e-12, equal_nan=True), name


def test_the_covariance_is_that_of_tangents_in_the_frame():
    """Errors of cameras, drawn and moved into another frame, have the covariance that is stated there."""
    generator = torch.Generator().manual_seed(0)
    rotations, translations = turned([0.3, 0.2, -1.0])[None], torch.tensor([[1.0, 2.0, 3.0]], dtype=torch.float64)
    own = frame()
    tangents = 1e-5 * torch.randn(4000, 6, generator=generator, dtype=torch.float64) @ torch.diag(torch.arange(1.0, 7)).double()
    stated = own.covariance(tangents.mT @ tangents / len(tangents))
    true = [own.poses(*se3.retract(rotations, translations, tangent[None])) for tangent in tangents]
    moved = own.poses(rotations, translations)
    # T_true = T Exp(xi): xi from the relative transform, to first order
    relative = [(moved[0].mT @ r, (moved[0].mT @ (t - moved[1])[..., None])[..., 0]) for r, t in true]
    found = torch.stack([torch.cat([shift[0], se3.vee(turn)[0]]) for turn, shift in relative])
    measured = found.mT @ found / len(found)
    assert torch.allclose(measured, stated, rtol=1e-3, atol=1e-14)


def test_the_frame_is_saved(calibration: Calibration, tmp_path):
    moved = calibration.in_world("floor")
    moved.save(tmp_path / "c.npz")
    loaded = Calibration.load(tmp_path / "c.npz")
    assert loaded.world == moved.world
    assert torch.equal(loaded.covariance, moved.covariance)


def test_unknown_frames_are_refused(calibration: Calibration):
    with pytest.raises(CalibrationError, match=r"unknown frame of the world.*'alhtete'.*camera, athlete, floor"):
        calibration.in_world("alhtete")


# --- the athlete -------------------------------------------------------------------------------------------------------------


def error_deg(up: torch.Tensor, true: torch.Tensor) -> float:
    return math.degrees(math.acos(min(1.0, float(up @ true))))


@pytest.mark.parametrize("sport", list(SPORTS))
@pytest.mark.parametrize("path", ["stay", "circle"])
def test_up_and_floor_of_every_sport(sport: str, path: str):
    """With cameras on tripods: up within 1 degree, the floor within 3 cm, and nobody upside down."""
    truth = SessionSpec(sport, sport, seed=3, path=path, layout="ring").generate()
    own, true = frame(), truth.truth
    found = athlete_frame(
        own.points(true.points), truth.observations.point_names, own.poses(true.rotations, true.translations)[0]
    )
    up = found.rotation[2]
    assert error_deg(up, own.rotation[:, 2]) < 1.0
    floor = own.points(torch.zeros(1, 3, dtype=torch.float64) + true.points[0, [15, 18]].mean(0) * torch.tensor([1.0, 1, 0]))
    assert abs(float(found.points(floor)[0, 2])) < 0.03
    assert float(found.points(own.points(true.points))[..., 6, 2].min()) > 0.9


@pytest.mark.parametrize("sport", list(SPORTS))
def test_the_vertical_comes_from_the_body_where_cameras_are_rolled(sport: str):
    """Each camera is rolled by some angle: the error stays within three stated deviations, which are larger then."""
    truth = SessionSpec(sport, sport, seed=4, path="circle").generate().truth
    body = Body.of(truth.points, SessionSpec(sport, sport, frames=5).generate().observations.point_names)
    rolled = torch.stack([turned([0, 0, 0.9 * n + 0.4]) @ r for n, r in enumerate(truth.rotations)])
    found, level = upright(body, rolled), upright(body, truth.rotations)
    assert found.std_deg > 1.5 * level.std_deg
    assert error_deg(found.up, torch.tensor([0, 0, 1.0]).double()) < 3 * found.std_deg


def test_cameras_on_their_side_count_as_upright():
    truth = SessionSpec("golf", "golf", seed=5).generate()
    body = Body.of(truth.truth.points, truth.observations.point_names)
    sideways = torch.stack([turned([0, 0, math.pi / 2 * (n % 4)]) @ r for n, r in enumerate(truth.truth.rotations)])
    assert torch.allclose(upright(body, sideways).up, upright(body, truth.truth.rotations).up, atol=1e-9)


def test_a_leg_that_swings_does_not_tilt_the_world():
    """Standing on the left leg while the right one is held out: the foot that stands still carries."""
    frames = 100
    time = torch.linspace(0, 1, frames, dtype=torch.float64)
    out = 0.8 * torch.sin(math.pi * time)

    def still(x: float, y: float, z: float) -> torch.Tensor:
        return torch.tensor([x, y, z], dtype=torch.float64).expand(frames, 3).clone()

    points = {"left_ankle": still(0, 0.0, 0.07), "right_ankle": still(0, -0.2, 0.07), "hip": still(0.03, -0.02, 0.95)}
    points["right_ankle"] += torch.stack([0 * out, -out, 0.5 * out], dim=1)
    points |= {"left_shoulder": still(0.03, 0.15, 1.4), "right_shoulder": still(0.03, -0.2, 1.4), "nose": still(0.1, 0.0, 1.6)}
    body = Body.of(torch.stack(list(points.values()), dim=1), list(points))
    rolled = torch.stack([turned([0, 0, 0.7 * n]) @ turned([1.5, 0.4 * n, 0]) for n in range(4)])
    assert error_deg(upright(body, rolled).up, torch.tensor([0, 0, 1.0]).double()) < 5.0


def test_axes_are_those_of_the_athlete(session, calibration: Calibration):
    """x where the athlete faces, y to the left, z up, the feet at the origin, in the first frame."""
    moved = calibration.in_world("athlete")
    names = list(moved.point_names)
    left, right = (moved.points[0, names.index(f"{side}_shoulder")] for side in ("left", "right"))
    ankles = moved.points[0, [names.index("left_ankle"), names.index("right_ankle")]].mean(0)
    across = left - right
    assert across[1] > 0.9 * across.norm()
    assert abs(float(across[0])) < 0.1
    assert ankles[:2].abs().max() < 1e-6
    assert 0.04 < ankles[2] < 0.1
    assert 1.3 < moved.points[0, names.index("head_top"), 2] < 1.8
    assert (moved.camera_centres[:, 2] > 0).all()


def test_the_frame_grows_with_the_body(calibration: Calibration):
    """A scene that is twice as large has the same axes, and a floor that is twice as far from the ankles."""
    one = athlete_frame(calibration.points, calibration.point_names, calibration.rotations)
    two = athlete_frame(2 * calibration.points, calibration.point_names, calibration.rotations)
    assert torch.allclose(one.rotation, two.rotation)
    assert torch.allclose(2 * one.translation, two.translation)


@pytest.mark.parametrize("missing", ["head", "ankles", "names", "extent"])
def test_without_a_standing_body_the_frame_is_refused(calibration: Calibration, missing: str):
    gone = {"head": ("head", "head_top"), "ankles": ("left_ankle",)}.get(missing, ())
    points = calibration.points.clone()
    if missing == "extent":
        points[:] = points[:1, :1]
    names = calibration.point_names if missing != "names" else None
    for name in gone:
        points[:, calibration.point_names.index(name)] = torch.nan
    without = replace(calibration, points=points, point_names=names)
    for world in ("athlete", "floor"):
        with pytest.raises(CalibrationError, match="no standing body"):
            without.in_world(world)


@pytest.mark.parametrize("gone", [["left_shoulder"], ["pelvis"], ["left_shoulder", "right_shoulder", "pelvis"], ["spine"]])
def test_the_vertical_survives_points_that_are_never_known(calibration: Calibration, gone: list[str]):
    points = calibration.points.clone()
    points[:, [calibration.point_names.index(name) for name in gone]] = torch.nan
    moved, whole = replace(calibration, points=points).in_world("athlete"), calibration.in_world("athlete")
    assert error_deg(moved.rotations[0].mT @ whole.rotations[0][:, 2], torch.tensor([0, 0, 1.0]).double()) < 2.0


@pytest.mark.parametrize("every", [2, 5, 30])
def test_the_vertical_survives_frames_in_which_a_foot_is_not_known(calibration: Calibration, every: int):
    """Also where a foot is still before and after such a frame."""
    points = calibration.points.clone()
    ankle = calibration.point_names.index("left_ankle")
    points[:, ankle] = points[0, ankle]
    points[::every, ankle] = torch.nan
    assert replace(calibration, points=points).in_world("athlete").rotations.isfinite().all()


def test_one_frame_is_enough(calibration: Calibration):
    points = calibration.points.clone()
    points[1:] = torch.nan
    assert replace(calibration, points=points).in_world("athlete").rotations.isfinite().all()


# --- what is known of the scene ----------------------------------------------------------------------------------------------


def test_known_points_fix_the_frame(calibration: Calibration, tmp_path):
    """Joints at rest and in single frames, from a table, with names in another spelling."""
    own = frame()
    table = "point,frame,x,y,z\n"
    for number, name in ((0, "left_ankle"), (7, "club_head"), (12, "head_top"), (30, "right_knee")):
        place = own.points(calibration.points[number, calibration.point_names.index(name)].double())
        table += f"{name.replace('left_ankle', 'LAnkle')},{number},{','.join(map(repr, place.tolist()))}\n"
    (tmp_path / "known.csv").write_text(table)
    moved = calibration.in_world(world_of_points(tmp_path / "known.csv")(calibration))
    expected = calibration.in_world(own)
    assert torch.allclose(moved.translations, expected.translations, atol=1e-9)
    assert moved.world.name == "points"


@pytest.mark.parametrize(
    ("table", "problem"),
    [
        ("point,x,y,z\nhead_top,0,0,1\nclub_head,0,0,2\n", "2 points"),
        ("point,x,y,z\nhead_top,0,0,1\nclub_head,0,0,2\nclub_grip,0,0,3\n", "on one line"),
        ("point,x,y,z\nhead_top,0,0,1\nclub_head,0,9,2\nclub_grip,4,0,3\n", "other distances"),
        ("point,x,y,z\nhead_top,0,0,1\ntip,0,9,2\nclub_grip,4,0,3\n", "not tracked.*tip"),
        ("point,frame,x,y,z\nhead_top,99,0,0,1\nclub_head,0,0,9,2\nclub_grip,0,4,0,3\n", "not in the recording.*99"),
        ("point,x,y\nhead_top,0,0\n", "damaged.*'z'"),
        ("", "damaged"),
    ],
)
def test_points_that_fix_no_frame_are_refused(calibration: Calibration, tmp_path, table: str, problem: str):
    (tmp_path / "known.csv").write_text(table)
    with pytest.raises(CalibrationError, match=problem):
        calibration.in_world(world_of_points(tmp_path / "known.csv")(calibration))


def test_another_calibration_fixes_the_frame(calibration: Calibration, tmp_path):
    """With some of the cameras, in another order, in a file of another program."""
    expected = calibration.in_world(frame())
    rig = Rig.of_calibration(expected)
    some = replace(
        rig, names=tuple(rig.names[n] for n in (3, 1)), intrinsics=rig.intrinsics[[3, 1]], distortion=rig.distortion[:2],
        fisheye=rig.fisheye[:2], image_size=rig.image_size[[3, 1]], rotations=rig.rotations[[3, 1]],
        translations=rig.translations[[3, 1]],
    )  # fmt: skip
    write_calibration(tmp_path / "old.toml", some, "freemocap")
    moved = calibration.in_world(world_of_calibration(tmp_path / "old.toml")(calibration))
    assert torch.allclose(moved.translations, expected.translations, atol=1e-9)
    other = replace(some, names=("x", "y"))
    write_calibration(tmp_path / "other.toml", other, "pose2sim")
    with pytest.raises(CalibrationError, match=r"no camera in common.*got x, y"):
        world_of_calibration(tmp_path / "other.toml")(calibration)


def test_frames_of_noisy_cameras_and_points_are_least_squares():
    generator = torch.Generator().manual_seed(1)
    points = torch.randn(40, 3, generator=generator, dtype=torch.float64)
    own = frame()
    noisy = own.points(points) + 0.01 * torch.randn(40, 3, generator=generator, dtype=torch.float64)
    found = frame_of_points(points, noisy)
    assert (found.points(points) - own.points(points)).norm(dim=1).max() < 0.02
    poses = {f"c{n}": (turned([0.1 * n, 1, 0.3]), torch.randn(3, generator=generator, dtype=torch.float64)) for n in range(5)}
    known = {name: tuple(part[0] for part in own.poses(r[None], t[None])) for name, (r, t) in poses.items()}
    exact = frame_of_cameras(poses, known)
    assert torch.allclose(exact.rotation, own.rotation)
    assert torch.allclose(exact.translation, own.translation)
