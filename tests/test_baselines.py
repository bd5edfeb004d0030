"""Baselines: exact without noise, plausible errors with it, clear messages for missing inputs, and registration."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError, Observations
from torchstickcal.benchmark.baselines import BASELINES, BONES, Inputs, MissingInputError, bone_lengths, limb_orientations
from torchstickcal.benchmark.baselines.frame_adjustment import CameraPrior, adjust
from torchstickcal.benchmark.baselines.kineo import RelatedPair, average_rotations, average_translations, refine_by_sampson
from torchstickcal.geometry.se3 import exp
from torchstickcal.io import Truth
from torchstickcal.losses import ReprojectionLoss, StickLengthLoss
from torchstickcal.metrics import pose_errors, rotation_angle
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.simulate import Cube, CubeViews, golf_session
from torchstickcal.simulate.rigs import CameraRig
from torchstickcal.simulate.skeleton import STANDING_HEIGHT_M
from torchstickcal.solvers import Termination, gauss_newton


def session(sigma_px: float = 0.0, seed: int = 0, middle: bool = False) -> tuple[Inputs, Truth]:
    """Swings while the athlete walks and turns, so that the stick leaves the plane of a single swing."""
    observations, truth = golf_session(cameras=4, frames=30)
    assert truth.points is not None
    assert observations.point_names is not None
    turns, steps = torch.zeros(30, 6).double(), torch.linspace(0, 1, 30).double()
    turns[:, 5], turns[:, 0], turns[:, 1] = 5 * steps, 0.4 * torch.cos(5 * steps), 0.4 * torch.sin(5 * steps)
    rotations, translations = exp(turns)
    points = truth.points @ rotations.mT + translations[:, None]
    names = list(observations.point_names)
    if middle:
        points = torch.cat([points, 0.4 * points[:, 19:20] + 0.6 * points[:, 20:21]], dim=1)
        names.append("stick_middle")
    in_cameras = torch.einsum("cij,fpj->cfpi", truth.rotations, points) + truth.translations[:, None, None]
    keypoints = observations.cameras.project(in_cameras)
    noise = sigma_px * torch.randn(keypoints.shape, generator=torch.Generator().manual_seed(seed)).double()
    observations = dataclasses.replace(observations, keypoints=keypoints + noise, point_names=names)
    ankles = points[:, [names.index("left_ankle"), names.index("right_ankle")]].mean(1)
    inputs = Inputs(
        observations,
        height_m=float((points[:, names.index("head_top")] - ankles).norm(dim=1).mean()),
        bone_lengths_m=bone_lengths(points, names),
        cube=views_of_cube(observations, truth, sigma_px),
        orientations=limb_orientations(truth.rotations, points, 5.0 if sigma_px else 0.0, seed),
    )
    return inputs, Truth(truth.rotations, truth.translations, points)


def views_of_cube(observations: Observations, truth: Truth, sigma_px: float) -> CubeViews:
    assert observations.distortion is not None
    rig = CameraRig(
        truth.rotations.numpy(),
        truth.translations.numpy(),
        observations.intrinsics.numpy(),
        observations.distortion.numpy(),
        (1920, 1080),
    )
    return Cube(edge_m=0.3).seen_by(rig, sigma_px, np.random.default_rng(0))


EXACT = ["human_height", "human_bones", "aruco_cube", "calib_person", "extra_calib", "kineo", "ewand"]
"""The baselines whose estimate is exact without noise."""


@pytest.fixture(scope="module")
def exact() -> tuple[Inputs, Truth]:
    return session()


@pytest.fixture(scope="module")
def noisy() -> tuple[Inputs, Truth]:
    return session(sigma_px=1.0)


def errors(estimate, truth):
    return pose_errors(estimate.rotations, estimate.translations, truth.rotations, truth.translations)


@pytest.mark.parametrize("name", EXACT)
def test_estimates_are_exact_without_noise(exact: tuple[Inputs, Truth], name: str):
    inputs, truth = exact
    estimate = BASELINES[name](inputs)
    found = errors(estimate, truth)
    assert estimate.status == "converged"
    assert found.rotation_deg.max() < 1e-5
    assert found.translation_m.max() < 1e-6
    torch.testing.assert_close(estimate.rotations[0], torch.eye(3).double(), rtol=0, atol=1e-12)
    torch.testing.assert_close(estimate.translations[0], torch.zeros(3).double(), rtol=0, atol=1e-12)


@pytest.mark.parametrize(("name", "offset"), [("human_guessed_low", -0.1), ("human_guessed_high", 0.1)])
def test_a_guessed_height_scales_the_rig(exact: tuple[Inputs, Truth], name: str, offset: float):
    inputs, _ = exact
    true, guessed = BASELINES["human_height"](inputs), BASELINES[name](inputs)
    assert inputs.height_m is not None
    factor = 1 + offset / inputs.height_m
    torch.testing.assert_close(guessed.translations, true.translations * factor, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "rotation_deg", "translation_m"),
    [
        ("human_height", 0.1, 0.01),
        ("human_bones", 0.1, 0.01),
        ("ewand", 0.3, 0.02),
        ("aruco_cube", 3.0, 0.15),
        ("calib_person", 0.1, 0.01),
        ("extra_calib", 0.1, 0.01),
        ("kineo", 0.2, 0.02),
    ],
)
def test_noise_leaves_a_plausible_error(noisy: tuple[Inputs, Truth], name: str, rotation_deg: float, translation_m: float):
    inputs, truth = noisy
    estimate = BASELINES[name](inputs)
    found = errors(estimate, truth)
    assert estimate.status == "converged"
    assert 1e-3 < found.mean_rotation_deg < rotation_deg
    assert 1e-4 < found.mean_translation_m < translation_m


@pytest.mark.parametrize(
    ("name", "missing"),
    [
        ("human_height", "height_m"),
        ("human_guessed_low", "height_m"),
        ("human_bones", "bone_lengths_m"),
        ("aruco_cube", "cube"),
        ("calib_person", "orientations"),
        ("calib_person", "height_m"),
        ("extra_calib", "height_m"),
        ("kineo", "height_m"),
    ],
)
def test_a_missing_input_is_named(exact: tuple[Inputs, Truth], name: str, missing: str):
    with pytest.raises(MissingInputError, match=f"Inputs.{missing}"):
        BASELINES[name](dataclasses.replace(exact[0], **{missing: None}))


def test_a_wand_needs_a_stick(exact: tuple[Inputs, Truth]):
    inputs, _ = exact
    without = dataclasses.replace(inputs, observations=dataclasses.replace(inputs.observations, sticks=()))
    with pytest.raises(MissingInputError, match="no stick"):
        BASELINES["ewand"](without)


def test_unknown_bones_are_refused(exact: tuple[Inputs, Truth]):
    with pytest.raises(CalibrationError, match="no such point"):
        BASELINES["human_bones"](dataclasses.replace(exact[0], bone_lengths_m={("knee", "nose"): 1.0}))
    with pytest.raises(CalibrationError, match="no bone of known length"):
        BASELINES["human_bones"](dataclasses.replace(exact[0], bone_lengths_m={}))


def test_a_camera_that_sees_too_little_of_the_cube_is_named(exact: tuple[Inputs, Truth]):
    inputs, truth = exact
    assert inputs.cube is not None
    keypoints = inputs.cube.keypoints.copy()
    keypoints[2, np.flatnonzero(np.isfinite(keypoints[2, :, 0]))[3:]] = np.nan
    estimate = BASELINES["aruco_cube"](dataclasses.replace(inputs, cube=dataclasses.replace(inputs.cube, keypoints=keypoints)))
    assert estimate.status == "cam03 sees 3 corners of the cube, fewer than 4"
    assert estimate.translations.isnan().any(1).tolist() == [False, False, True, False]
    kept = [0, 1, 3]
    found = pose_errors(estimate.rotations[kept], estimate.translations[kept], truth.rotations[kept], truth.translations[kept])
    assert found.translation_m.max() < 1e-9


def test_one_face_of_the_cube_is_enough_without_noise(exact: tuple[Inputs, Truth]):
    inputs, truth = exact
    assert inputs.cube is not None
    keypoints = inputs.cube.keypoints.copy()
    for camera in keypoints:
        camera[np.flatnonzero(np.isfinite(camera[:, 0]))[4:]] = np.nan
    estimate = BASELINES["aruco_cube"](dataclasses.replace(inputs, cube=dataclasses.replace(inputs.cube, keypoints=keypoints)))
    assert errors(estimate, truth).translation_m.max() < 1e-6


def test_limb_orientations_are_as_noisy_as_asked(exact: tuple[Inputs, Truth]):
    _, truth = exact
    assert truth.points is not None
    perfect, disturbed = (limb_orientations(truth.rotations, truth.points, sigma, 1) for sigma in (0.0, 5.0))
    assert perfect.shape == (4, 30, len(BONES), 3)
    np.testing.assert_allclose(np.linalg.norm(disturbed, axis=-1), 1)
    angles = np.rad2deg(np.arccos((perfect * disturbed).sum(-1)))
    assert np.sqrt(np.mean(angles**2)) == pytest.approx(5 * np.sqrt(2), rel=0.05)
    np.testing.assert_array_equal(disturbed, limb_orientations(truth.rotations, truth.points, 5.0, 1))


def test_bone_lengths_are_those_of_the_skeleton(exact: tuple[Inputs, Truth]):
    lengths = exact[0].bone_lengths_m
    assert lengths is not None
    assert list(lengths) == list(BONES)
    assert lengths["left_elbow", "left_wrist"] == pytest.approx(0.148 * STANDING_HEIGHT_M)
    assert lengths["right_shoulder", "right_elbow"] == pytest.approx(0.175 * STANDING_HEIGHT_M)


def test_a_third_point_keeps_the_wand_straight():
    """With a third point in a line with the ends the cameras come out better, and exactly without noise."""
    inputs, truth = session(middle=True)
    assert errors(BASELINES["ewand"](inputs), truth).translation_m.max() < 1e-6
    bent, straight = [], []
    for seed in range(6):
        inputs, truth = session(sigma_px=1.0, seed=seed, middle=True)
        straight.append(errors(BASELINES["ewand"](inputs), truth).mean_rotation_deg)
        names = [*(inputs.observations.point_names or ())[:-1], "elsewhere"]
        renamed = dataclasses.replace(inputs.observations, point_names=names)
        bent.append(errors(BASELINES["ewand"](dataclasses.replace(inputs, observations=renamed)), truth).mean_rotation_deg)
    assert np.mean(straight) < np.mean(bent)


def start(truth: Truth) -> State:
    """The truth in the frame of the first camera, moved a little."""
    assert truth.points is not None
    relative = truth.rotations @ truth.rotations[0].mT
    points = truth.points @ truth.rotations[0].mT + truth.translations[0]
    translations = truth.translations - relative @ truth.translations[0]
    state = State.of(relative[None], translations[None], points.flatten(0, 1).mT.contiguous()[None])
    generator = torch.Generator().manual_seed(0)
    return state.retracted(
        0.02 * torch.randn(1, 3, 6, generator=generator).double(),
        0.02 * torch.randn(state.points.shape, generator=generator).double(),
    )


def test_the_dense_adjustment_reaches_the_minimum_of_the_library_s_solver(noisy: tuple[Inputs, Truth]):
    inputs, truth = noisy
    measurements = Measurements.of(inputs.observations)
    (first, second), length_m = measurements.sticks[0], measurements.lengths_m[0]

    def length(points: torch.Tensor) -> torch.Tensor:
        return ((points[:, second] - points[:, first]).norm(dim=1, keepdim=True) - length_m) / 0.001

    found = adjust(measurements, start(truth), ReprojectionLoss(), length)
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(), "length": StickLengthLoss(0.001)})
    expected = gauss_newton(
        objective, start(truth), cameras_free=True, termination=Termination(), stage="", listener=lambda record: None
    )
    assert found.converged
    torch.testing.assert_close(found.state.translations, expected.state.translations, rtol=0, atol=1e-5)
    torch.testing.assert_close(found.state.points, expected.state.points, rtol=0, atol=1e-5)


def test_a_firm_prior_holds_the_cameras_and_a_weak_one_lets_them_go(noisy: tuple[Inputs, Truth]):
    inputs, truth = noisy
    measurements, begun = Measurements.of(inputs.observations), start(truth)
    moved = []
    for sigma in (1e-6, 1.0):
        information = (torch.eye(6).double() / sigma**2).expand(3, 6, 6)
        prior = CameraPrior(begun.rotations, begun.translations, information)
        found = adjust(measurements, begun, ReprojectionLoss(), prior=prior).state
        moved.append(float((found.translations - begun.translations).norm(dim=-1).max()))
    assert moved[0] < 1e-4 < 1e-2 < moved[1]


def related(truth: Truth) -> list[RelatedPair]:
    r, t = truth.rotations, truth.translations
    pairs = []
    for i, j in ((0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)):
        rotation = r[j] @ r[i].mT
        pairs.append(RelatedPair(i, j, rotation, torch.nn.functional.normalize(t[j] - rotation @ t[i], dim=0), 100.0))
    return pairs


def test_averaged_rotations_ignore_a_wrong_pair(exact: tuple[Inputs, Truth]):
    _, truth = exact
    pairs = related(truth)
    wrong = exp(torch.tensor([0.0, 0, 0, 0.3, -0.5, 0.2]).double())[0]
    pairs[3] = dataclasses.replace(pairs[3], rotation=wrong @ pairs[3].rotation)
    rotations = average_rotations(4, pairs)
    assert rotation_angle(rotations @ (truth.rotations @ truth.rotations[0].mT).mT).max() < 1e-4


def test_averaged_translations_are_exact_up_to_scale(exact: tuple[Inputs, Truth]):
    _, truth = exact
    rotations = truth.rotations @ truth.rotations[0].mT
    expected = truth.translations - rotations @ truth.translations[0]
    found = average_translations(rotations, related(truth))
    torch.testing.assert_close(found * expected.norm() / found.norm(), expected, rtol=0, atol=1e-9)


def test_sampson_refinement_finds_the_pair(exact: tuple[Inputs, Truth]):
    _, truth = exact
    assert truth.points is not None
    pair = related(truth)[0]
    in_cameras = truth.points.flatten(0, 1) @ truth.rotations[:2].mT + truth.translations[:2, None]
    first, second = in_cameras / in_cameras[..., 2:]
    off = exp(torch.tensor([0.0, 0, 0, 0.02, -0.01, 0.02]).double())[0]
    direction = torch.nn.functional.normalize(pair.direction + 0.02 * torch.ones(3).double(), dim=0)
    rotation, direction = refine_by_sampson(off @ pair.rotation, direction, first, second, 0.01)
    torch.testing.assert_close(rotation, pair.rotation, rtol=0, atol=1e-9)
    torch.testing.assert_close(direction, pair.direction, rtol=0, atol=1e-9)
