"""Initialisation: relative poses of pairs, spanning tree, twisted pairs, triangulation."""

from __future__ import annotations

import doctest
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch

from torchstickcal import Observations, RigError, calibrate, errors, metrics
from torchstickcal.config import InitialiseSettings, load_config
from torchstickcal.geometry import triangulation
from torchstickcal.geometry.triangulation import triangulate, triangulate_robustly
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline import adjust
from torchstickcal.pipeline import initialise as initialising
from torchstickcal.pipeline.adjust import adjust_cameras, begin
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.initialise import initialise
from torchstickcal.pipeline.initialise.graph import Edge, propagate, spanning_tree
from torchstickcal.pipeline.initialise.pairs import Pair, RelativePose, relate
from torchstickcal.pipeline.initialise.views import Views
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.selection import ModelSelection
from torchstickcal.quality.handedness import mirrored_share
from torchstickcal.simulate import Lens, Noise, SessionSpec, golf_session


@pytest.mark.parametrize("cameras", [2, 3, 5])
def test_rig_is_found_up_to_scale(cameras: int):
    observations, truth = golf_session(cameras=cameras, frames=40, noise=Noise(0.5, missing=0.1, outliers=0.05))
    state = initialise(Measurements.of(observations), InitialiseSettings(), [str(k) for k in range(cameras)])
    relative = truth.rotations @ truth.rotations[0].mT
    rotations, translations = state.rotations[0], state.translations[0]
    assert metrics.rotation_angle(rotations @ relative.mT).rad2deg().max() < 1.5
    assert torch.equal(rotations[0], torch.eye(3, dtype=torch.float64))
    centres = -(relative.mT @ (truth.translations - (relative @ truth.translations[0]))[..., None])[..., 0]
    found = -(rotations.mT @ translations[..., None])[..., 0]
    ratios = found[1:].norm(dim=1) / centres[1:].norm(dim=1)
    assert (ratios.max() / ratios.min()) < 1.1


def test_spanning_tree_has_the_strongest_pairs_and_relates_only_the_necessary_ones():
    inliers = {(0, 1): 90, (0, 2): 20, (0, 3): 30, (1, 2): 80, (1, 3): 30, (2, 3): 70}
    common = np.full((4, 4), 100)
    common[0, 3] = common[3, 0] = 40
    common[1, 3] = common[3, 1] = 60
    pose = RelativePose(np.eye(3), np.array([0.0, 0, 1]), 1)
    related: list[tuple[int, int]] = []

    def relate(first: int, second: int) -> Pair:
        related.append((first, second))
        return Pair(int(common[first, second]), inliers[first, second], 1.0, (pose,))

    edges = spanning_tree(common, relate, ["a", "b", "c", "d"], 20)
    assert [(edge.parent, edge.child) for edge in edges] == [(0, 1), (1, 2), (2, 3)]
    assert sorted(related) == [(0, 1), (0, 2), (1, 2), (2, 3)]


def in_parts(*parts: str, frames: int = 30) -> Observations:
    """A session whose cameras, one a letter, see the athlete in the frames of their part only."""
    names = "".join(sorted("".join(parts)))
    observations, _ = golf_session(cameras=len(names), frames=frames, noise=Noise(0.5))
    keypoints = observations.keypoints.clone()
    for number, part in enumerate(parts):
        for name in part:
            seen = torch.zeros(frames, dtype=torch.bool)
            seen[number * frames // len(parts) : (number + 1) * frames // len(parts)] = True
            keypoints[names.index(name), ~seen] = torch.nan
    return replace(observations, keypoints=keypoints, camera_names=list(names))


def test_parts_of_a_rig_are_named_the_smallest_first_with_what_they_share():
    with pytest.raises(
        RigError, match=r"2 parts: c, d; a, b, e\. At best, a and c share 0 points; expected .*20 points"
    ) as caught:
        calibrate(in_parts("abe", "cd"))
    assert caught.value.parts == (("c", "d"), ("a", "b", "e"))


@pytest.mark.parametrize("parts", [("abd", "ce"), ("be", "acd"), ("bcd", "a")])
def test_on_request_the_largest_part_is_calibrated_and_the_others_are_named(parts: tuple[str, ...]):
    session = in_parts(*parts)
    largest = max(parts, key=len)
    others = {
        "extends": "default",
        "incomplete": "largest",
        "refine": ["focal"],
        "camera_groups": list(session.camera_names or ()),
    }
    found = calibrate(session, others)
    alone = calibrate(session.of_cameras([session.camera_labels.index(name) for name in largest]), refine=["focal"])
    assert found.camera_names == tuple(largest)
    assert found.left_out == tuple(sorted(set("".join(parts)) - set(largest)))
    assert any(sentence.endswith(f"{', '.join(found.left_out)}.") for sentence in found.warnings)
    torch.testing.assert_close(found.rotations, alone.rotations, rtol=0, atol=0)
    torch.testing.assert_close(found.translations, alone.translations, rtol=0, atol=0)


def test_a_third_camera_resolves_a_twisted_pair():
    """The rig is right even if wrong poses of the first pair have more points in front of both cameras."""
    observations, truth = golf_session(cameras=3, frames=30)
    views = Views(Measurements.of(observations))
    relate_pair = partial(relate, views, max_points=200, threshold_px=2.0)
    edges = spanning_tree(views.common(), relate_pair, ["0", "1", "2"], 20)
    first = edges[0]
    wrong_first = tuple(
        RelativePose(pose.rotation, pose.translation, count)
        for pose, count in zip(reversed(first.poses), (200, 190, 180, 180), strict=True)
    )
    rotations, _ = propagate([Edge(first.parent, first.child, wrong_first), *edges[1:]], views, scale=0.02)
    relative = (truth.rotations @ truth.rotations[0].mT).numpy()
    assert np.abs(rotations - relative).max() < 0.05


@pytest.mark.parametrize("seed", [146, 191])
def test_distant_cameras_that_face_each_other_are_placed_from_a_third(seed: int):
    """90 % of the points of such a pair fit a wrong essential matrix, but half of them lie behind a camera."""
    spec = SessionSpec("facing", "baseball", seed, 8, 40, 20.0, "arena", regimes=(Noise(1.0),))
    session = spec.generate()
    measurements = Measurements.of(session.observations)
    pair = relate(Views(measurements), 0, 2, max_points=200, threshold_px=4.0)
    assert pair.inliers < 0.9 * pair.common
    state = initialise(measurements, InitialiseSettings(), [str(k) for k in range(8)])
    relative = session.truth.rotations @ session.truth.rotations[0].mT
    assert metrics.rotation_angle(state.rotations[0] @ relative.mT).rad2deg().max() < 20


def test_triangulation_is_exact_and_robust():
    observations, truth = golf_session(cameras=5, frames=4)
    measurements = Measurements.of(observations)
    rays = measurements.cameras[0].undistort(measurements.pixels[0].movedim(1, -1)).movedim(-1, 1)
    expected = truth.points.flatten(0, 1).mT
    weights = measurements.confidence[0].clone()
    found = triangulate(truth.rotations, truth.translations, rays, weights, scale=0.01)
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-10)
    rays[2, :, 7] += 0.2
    found = triangulate(truth.rotations, truth.translations, rays, weights, scale=0.01, iterations=20)
    assert (found - expected)[:, 7].norm() < 0.01
    weights[1:, 3] = 0
    assert triangulate(truth.rotations, truth.translations, rays, weights, scale=0.01)[:, 3].isnan().all()


@pytest.mark.parametrize("noise", [Noise(0.5), Noise(2.0, missing=0.2), Noise(2.0, outliers=0.2)])
def test_triangulation_ends_where_no_point_moves(noise: Noise, monkeypatch: pytest.MonkeyPatch):
    observations, truth = golf_session(cameras=5, frames=6, noise=noise)
    measurements = Measurements.of(observations)
    rays = measurements.cameras[0].undistort(measurements.pixels[0].movedim(1, -1)).movedim(-1, 1).nan_to_num()
    solved: list[int] = []
    solve = triangulation.solve
    monkeypatch.setattr(triangulation, "solve", lambda *given: solved.append(0) or solve(*given))

    def points(same_place: float) -> tuple[torch.Tensor, int]:
        monkeypatch.setattr(triangulation, "_SAME_PLACE", same_place)
        solved.clear()
        weights = measurements.confidence[0]
        found = triangulate(truth.rotations, truth.translations, rays, weights, scale=0.02, iterations=40)
        return found, len(solved)

    (early, rounds), (late, most) = points(triangulation._SAME_PLACE), points(0.0)
    assert rounds < most
    torch.testing.assert_close(early, late, rtol=0, atol=1e-4, equal_nan=True)


def test_points_of_several_sets_of_cameras_are_triangulated_at_once_as_one_by_one():
    observations, truth = golf_session(cameras=5, frames=4, noise=Noise(2.0, missing=0.2, outliers=0.1))
    measurements = Measurements.of(observations)
    rays = measurements.cameras[0].undistort(measurements.pixels[0].movedim(1, -1)).movedim(-1, 1)
    every = (truth.rotations, truth.translations, rays.nan_to_num(), measurements.confidence[0])
    sets = torch.tensor([[0, 1, 2], [4, 1, 3], [2, 3, 4]])
    found = triangulate(*(given[sets] for given in every), scale=0.01)
    for points, cameras in zip(found, sets, strict=True):
        torch.testing.assert_close(points, triangulate(*(given[cameras] for given in every), scale=0.01), equal_nan=True)


def test_pairs_of_views_propose_points_a_few_at_a_time_as_all_at_once(monkeypatch: pytest.MonkeyPatch):
    observations, truth = golf_session(cameras=5, frames=6, noise=Noise(1.0))
    measurements = Measurements.of(observations)
    rays = measurements.cameras[0].undistort(measurements.pixels[0].movedim(1, -1)).movedim(-1, 1)
    generator = torch.Generator().manual_seed(0)
    wrong = torch.rand(5, 1, rays.shape[2], generator=generator) < 0.3
    rays = torch.where(wrong, rays + torch.randn(rays.shape, generator=generator, dtype=rays.dtype), rays)
    given = (truth.rotations, truth.translations, rays, measurements.confidence[0])
    assert truth.points is not None
    at_once = triangulate_robustly(*given, scale=0.01)
    monkeypatch.setattr(triangulation, "_POINTS_AT_ONCE", 1)
    torch.testing.assert_close(triangulate_robustly(*given, scale=0.01), at_once)
    expected, agreeing = truth.points.flatten(0, 1).mT, (~wrong).sum((0, 1)) >= 3
    assert (at_once - expected).norm(dim=0)[agreeing].median() < 0.02


def test_example_of_the_errors_runs():
    assert doctest.testmod(errors).failed == 0


def test_depths_are_reversed_in_all_cameras_and_nothing_else():
    case, truth = golf_session(cameras=4, frames=10)
    assert truth.points is not None
    points = truth.points.flatten(0, 1).mT[None].contiguous()
    state = State.of(truth.rotations[None], truth.translations[None], points)
    there = state.depth_reversed(Measurements.of(case).active)
    before, after = state.in_cameras()[0], there.in_cameras()[0]
    torch.testing.assert_close(after[:, :2], before[:, :2])
    depths = (before + after)[:, 2]
    torch.testing.assert_close(depths, depths[:, :1].expand_as(depths))
    assert (after[:, 2] - before[:, 2]).abs().amax(1).min() > 0.3


@pytest.mark.parametrize("seed", range(2))
def test_a_start_with_reversed_depths_is_left(seed: int):
    session = SessionSpec("s", "hockey", seed=seed, cameras=4, frames=30, layout="hemisphere", lens=Lens(), regimes=())
    case = session.generate()
    cameras, _, points, _ = case.observations.keypoints.shape
    offsets = torch.randn(cameras, 1, points, 2, dtype=torch.float64, generator=torch.Generator().manual_seed(seed))
    noisy = case.observations.keypoints + 6 * offsets
    run = Run(load_config("default"))
    begun = begin(replace(case.observations, keypoints=noisy), run)
    begun = replace(begun, state=begun.state.depth_reversed(begun.measurements.active))
    ended = adjust_cameras(begun, run)
    found, truth = ended.state, case.truth
    errors = metrics.pose_errors(found.rotations[0], found.translations[0], truth.rotations, truth.translations)
    assert errors.mean_rotation_deg < 10  # on the wrong side it is more than 90


@pytest.mark.parametrize("sport", ["golf", "kendo"])
def test_a_reversed_scene_is_turned_back_where_the_body_says_so(sport: str, monkeypatch: pytest.MonkeyPatch):
    case = SessionSpec("s", sport, seed=1, cameras=3, frames=40, lens=Lens(), regimes=(Noise(2.0),)).generate()
    given = case.observations
    selection = ModelSelection(given, run := Run(load_config("default")))
    sound, _ = selection.adjusted(None)
    reverse = replace(sound[0], state=sound.state.depth_reversed(sound.measurements.active))
    with monkeypatch.context() as patched:
        patched.setattr(adjust, "_on_the_right_side", lambda stages, ended, run: ended)
        wrong = adjust_cameras(reverse, run)

    def error_deg(found: Adjustment) -> float:
        rotations, translations = found.state.rotations[0], found.state.translations[0]
        return metrics.pose_errors(rotations, translations, case.truth.rotations, case.truth.translations).mean_rotation_deg

    assert error_deg(wrong) > 45
    assert error_deg(selection._turned_back(wrong)) < 2
    assert selection._turned_back(sound) is sound
    across = torch.tensor([-1.0, 1.0], dtype=given.keypoints.dtype)
    mirrored = replace(given, keypoints=given.keypoints * across + (1 - across) * given.intrinsics[0, 0, 2])
    ended, _ = ModelSelection(mirrored, run).adjusted(None)
    assert mirrored_share(ended.measurements.by_frame(ended.state.points[0]), given.point_names) > 0.8, "nothing to turn back"
    assert ended.converged


@pytest.mark.filterwarnings("ignore::torchstickcal.errors.ObservationWarning")
@pytest.mark.parametrize("place", [(0.0, 0.0), (-1.0, -1.0), (960.0, 540.0)])
def test_keypoints_that_never_move_do_not_start_the_rig(place: tuple[float, float]):
    session = SessionSpec("stuck", "kendo", seed=71, cameras=3, frames=40, regimes=(Noise(2.0),)).generate()
    keypoints = session.observations.keypoints.clone()
    keypoints[1, :, ::3] = torch.tensor(place, dtype=torch.float64)
    found = calibrate(replace(session.observations, keypoints=keypoints))
    truth = session.truth
    found_errors = metrics.pose_errors(found.rotations, found.translations, truth.rotations, truth.translations)
    assert found_errors.mean_translation_m < 0.03


@pytest.mark.parametrize("intrinsics", ["given", "unknown"])
def test_the_ends_of_the_sticks_can_be_the_start(intrinsics: str, monkeypatch: pytest.MonkeyPatch):
    """Whatever else is unknown where they are tried: here they always are, and are always taken."""
    monkeypatch.setattr(initialising, "_RIGID", 0.0)
    monkeypatch.setattr(initialising, "_CLEARLY_LESS", 1e9)
    monkeypatch.setattr(initialising, "_AS_GOOD", 1e9)
    given, truth = golf_session(cameras=3, frames=60, noise=Noise(0.5))
    observations = Observations(
        given.keypoints,
        None if intrinsics == "unknown" else given.intrinsics,
        given.sticks,
        image_size=(1920, 1080),
        distortion=None if intrinsics == "unknown" else given.distortion,
    )
    found = calibrate(observations)
    assert found.converged
    off = metrics.pose_errors(found.rotations, found.translations, truth.rotations, truth.translations)
    assert float(off.mean_translation_m) < 0.2
