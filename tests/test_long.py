"""Long sessions: what is done in another way there gives what the plain way gives. Here some hundred frames count as long."""

from __future__ import annotations

import weakref
from dataclasses import replace

import pytest
import torch

from torchstickcal import Calibration, Observations, calibrate, triangulate
from torchstickcal.losses import Cauchy, GemanMcClure, ReprojectionLoss, SmoothnessLoss, StickLengthLoss
from torchstickcal.model.measurements import Measurements, count_of, views_of
from torchstickcal.model.noise import NEAR_SIGMAS, near_keypoints
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.noise import Chosen
from torchstickcal.pipeline.part import part_of
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.solvers import IterationRecord, Termination
from torchstickcal.solvers.following import minimum_with_points_following
from torchstickcal.solvers.gauss_newton import gauss_newton
from torchstickcal.solvers.linearised import Linearised
from torchstickcal.solvers.newton import minimum_near
from torchstickcal.solvers.windows import can_be_divided, gauss_newton_by_windows
from torchstickcal.workers import map_on_workers, map_with_idle_workers

IMAGES = {"reprojection": ReprojectionLoss(1.0, kernel=GemanMcClure(8.0))}
NEAR = Termination(cost_tolerance=1e-3)


@pytest.fixture
def long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("torchstickcal.model.measurements.LONG_KEYPOINTS", 1000)
    monkeypatch.setattr("torchstickcal.pipeline.part._PART_KEYPOINTS", 6000)
    monkeypatch.setattr("torchstickcal.pipeline.part._RUN_FRAMES", 40)
    monkeypatch.setattr("torchstickcal.pipeline.part._LEAST_TIMES_LONGER", 1)
    monkeypatch.setattr("torchstickcal.solvers.windows._FRAMES", 70)
    monkeypatch.setattr("torchstickcal.solvers.windows._MARGIN_FRAMES", 40)


def session(kind: str) -> Observations:
    """160 frames of 4 cameras, with whatever may be wrong with them."""
    noise = Noise(1.0, missing=0.1, outliers=0.03) if kind == "outliers" else Noise(1.0)
    observations, _ = golf_session(cameras=4, frames=160, noise=noise, seed=4)
    keypoints = observations.keypoints.clone()
    if kind == "labels":
        names = observations.point_names or ()
        left, right = ([names.index(f"{side}_{part}") for part in ("knee", "shin", "ankle")] for side in ("left", "right"))
        keypoints[1, 20:35, left + right] = keypoints[1, 20:35, right + left]
        keypoints[2, 120:140, left + right] = keypoints[2, 120:140, right + left]
    if kind == "lasting":
        errors = torch.randn(4, 40, *keypoints.shape[2:], generator=torch.Generator().manual_seed(2), dtype=torch.float64)
        keypoints += errors.repeat_interleave(4, dim=1)
    if kind == "pauses":
        keypoints[:, 30:60] = torch.nan
        keypoints[3, :60] = torch.nan
    return replace(observations, keypoints=keypoints)


def assert_alike(found: Calibration, plain: Calibration) -> None:
    """Equal up to a small part of the standard deviations; of the keypoints, a few at the limit of what takes part differ."""
    std = plain.covariance.diagonal().sqrt().view(-1, 6)[:, :3]
    assert found.status == plain.status == "converged"
    assert float(((found.translations - plain.translations)[1:].abs() / std).max()) < 0.2
    assert float((found.inliers != plain.inliers).double().mean()) < 2e-3
    assert torch.equal(found.keypoint_index, plain.keypoint_index)
    assert float((found.points - plain.points).abs().nanmedian()) < 1e-4
    assert torch.allclose(found.covariance.diagonal(), plain.covariance.diagonal(), rtol=0.05)
    assert torch.allclose(found.sigma_px, plain.sigma_px, rtol=0.02)


@pytest.mark.parametrize("kind", ["plain", "outliers", "labels", "lasting", "pauses"])
def test_a_long_session_ends_where_a_short_one_ends(kind: str, request: pytest.FixtureRequest):
    observations = session(kind)
    plain = calibrate(observations)
    request.getfixturevalue("long")
    found = calibrate(observations)
    assert [stage.name for stage in found.stages].count("refined") > [stage.name for stage in plain.stages].count("refined")
    assert_alike(found, plain)


def test_single_precision_too(request: pytest.FixtureRequest):
    observations, config = session("outliers"), {"extends": "default", "precision": "float32"}
    plain = calibrate(observations, config)
    request.getfixturevalue("long")
    assert_alike(calibrate(observations, config), plain)


def test_a_scale_that_no_loss_determines(request: pytest.FixtureRequest):
    observations = session("plain")
    plain = calibrate(observations, "human_only")
    request.getfixturevalue("long")
    found = calibrate(observations, "human_only")
    assert found.status == "converged"
    assert torch.allclose(found.translations, plain.translations, atol=0.003)


def test_triangulation_too(request: pytest.FixtureRequest):
    observations = session("outliers")
    calibration = calibrate(observations)
    plain = triangulate(observations, calibration)
    request.getfixturevalue("long")
    found = triangulate(observations, calibration)
    assert float((found.inliers != plain.inliers).double().mean()) < 1e-3
    assert float((found.points - plain.points).abs().nanmedian()) < 1e-6


def test_lenses_too(request: pytest.FixtureRequest):
    observations = session("plain")
    plain = calibrate(observations, refine=("focal",))
    request.getfixturevalue("long")
    found = calibrate(observations, refine=("focal",))
    std = plain.unknowns["focal"].std
    assert float(((found.unknowns["focal"].value - plain.unknowns["focal"].value).abs() / std).max()) < 0.1


@pytest.mark.parametrize("why", ["far", "unseen"])
def test_where_a_part_does_not_tell_all_frames_do(why: str, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch):
    observations = session("plain")
    if why == "unseen":  # a camera sees nothing in any frame of the part
        monkeypatch.setattr("torchstickcal.pipeline.part._RUN_FRAMES", 10)
        keypoints = observations.keypoints.clone()
        keypoints[3, 20:140] = torch.nan
        observations = replace(observations, keypoints=keypoints)
    request.getfixturevalue("long")
    monkeypatch.setattr("torchstickcal.solvers.windows._FRAMES", 1000)
    monkeypatch.setattr("torchstickcal.pipeline.part._PART_KEYPOINTS", 3000)
    if why == "far":
        monkeypatch.setattr("torchstickcal.pipeline.part._FARTHER", 0.0)
    found = calibrate(observations)
    monkeypatch.setattr("torchstickcal.pipeline.calibrate.adjusted_from_part", lambda *_: None)
    plain = calibrate(observations)
    assert torch.equal(found.translations, plain.translations)
    assert torch.equal(found.points, plain.points)
    assert [stage.name for stage in found.stages] == [stage.name for stage in plain.stages]


@pytest.mark.usefixtures("long")
def test_a_part_is_runs_of_seen_frames():
    observations = session("pauses")
    observations = replace(observations, confidence=torch.rand(observations.visible.shape, dtype=torch.float64))
    part, seen = part_of(observations), observations.visible.any(0).any(-1)
    of_part = part.visible.any(0).any(-1)
    assert 40 <= int(of_part.sum()) <= 100
    own = part.keypoints[:, of_part]
    given = observations.keypoints[:, seen]
    places = [int((given[0, :, 0] == frame).all(-1).nonzero()[0, 0]) for frame in own[0, :, 0]]
    assert torch.equal(own, given[:, places])
    assert part.confidence is not None
    assert observations.confidence is not None
    assert torch.equal(part.confidence[:, of_part], observations.confidence[:, seen][:, places])
    steps = torch.tensor(places).diff()
    assert bool((steps > 0).all())
    gaps = (~of_part).double().diff().clamp_min(0).sum()
    assert int(gaps) == int((steps > 1).sum()) + 1


def test_points_that_follow_end_at_the_same_minimum(disturbed: tuple[Measurements, State], monkeypatch: pytest.MonkeyPatch):
    m, state = disturbed
    objective = Objective(m, {**IMAGES, "length": StickLengthLoss(0.001, kernel=Cauchy(3.0))})
    near = gauss_newton(objective, state, cameras_free=True, termination=NEAR, stage="test", listener=lambda _: None).state
    plain, _ = minimum_near(lambda _: objective, near, cameras_free=True)
    for last, distance in ((1e-2, 1e-2), (1e-8, 1e-7)):
        monkeypatch.setattr("torchstickcal.solvers.following._LAST", last)
        found, converged = minimum_with_points_following(lambda _: objective, near)
        assert bool(converged.all())
        assert sigmas_between(objective, found.state, plain.state) < distance


def test_points_that_follow_do_not_claim_a_minimum_that_is_none(disturbed: tuple[Measurements, State]):
    m, state = disturbed
    far = state.retracted(torch.full((1, 3, 6), 0.2, dtype=torch.float64), torch.zeros_like(state.points))
    _, converged = minimum_with_points_following(lambda _: Objective(m, IMAGES), far)
    assert not bool(converged.any())


def sigmas_between(objective: Objective, found: State, plain: State) -> float:
    """Distance of the cameras of two states, in standard deviations."""
    step = torch.cat([found.translations - plain.translations, torch.zeros_like(plain.translations)], dim=-1)[:, 1:]
    turned = plain.rotations.mT @ (found.rotations - plain.rotations)
    step[..., 3:] = torch.stack([turned[..., 2, 1], turned[..., 0, 2], turned[..., 1, 0]], dim=-1)[:, 1:]
    step[..., :3] = (plain.rotations.mT[:, 1:] @ (found.translations - plain.translations)[:, 1:, :, None])[..., 0]
    information = Linearised(objective, plain, cameras_free=True)._system(exact=False).reduced[0]
    return float((step.flatten() @ information @ step.flatten()).clamp_min(0).sqrt())


@pytest.mark.usefixtures("long")
@pytest.mark.parametrize("kind", ["plain", "pauses"])
def test_windows_give_the_points_of_all_frames(kind: str):
    m = Measurements.of(session(kind))
    _, truth = golf_session(cameras=4, frames=160, noise=Noise(1.0), seed=4)
    assert truth.points is not None
    generator = torch.Generator().manual_seed(5)
    points = truth.points.flatten(0, 1).mT[None]
    points = points + 0.002 * torch.randn(points.shape, generator=generator, dtype=torch.float64)
    state = State.of(truth.rotations[None], truth.translations[None], points)
    acceleration = 0.005 + 0.01 * torch.rand(1, m.frames - 2, m.points_per_frame, generator=generator, dtype=torch.float64)
    losses = {**IMAGES, "length": StickLengthLoss(0.01), "smoothness": SmoothnessLoss(acceleration)}
    objective, tight, heard = Objective(m, losses), Termination(cost_tolerance=1e-12), list[IterationRecord]()
    assert can_be_divided(objective)
    plain = gauss_newton(objective, state, cameras_free=False, termination=tight, stage="test", listener=lambda _: None)
    found = gauss_newton_by_windows(objective, state, termination=tight, stage="test", listener=heard.append)
    active = m.active[:, None].expand_as(points)
    assert torch.allclose(found.state.points[active], plain.state.points[active], atol=1e-9)
    assert found.stops[0].converged
    assert tuple(heard) == found.iterations[0]
    for own, whole in ((heard[0], plain.iterations[0][0]), (heard[-1], plain.iterations[0][-1])):
        assert own.terms == pytest.approx(whole.terms, rel=1e-9)
        assert own.reprojection_px == pytest.approx(whole.reprojection_px, rel=1e-7)
        assert own.stick_length_m == pytest.approx(whole.stick_length_m, rel=1e-9)


@pytest.mark.usefixtures("long")
def test_a_given_smoothness_is_not_divided(disturbed: tuple[Measurements, State]):
    m, _ = disturbed
    assert can_be_divided(Objective(m, IMAGES))
    assert not can_be_divided(Objective(m, {**IMAGES, "smoothness": SmoothnessLoss(0.001)}))


def test_the_noise_is_found_in_the_frames_that_are_looked_at(
    disturbed: tuple[Measurements, State], monkeypatch: pytest.MonkeyPatch
):
    m, state = disturbed
    monkeypatch.setattr("torchstickcal.model.noise._MAX_FRAMES", 7)
    squared = m.squared_residuals(state)
    chosen = Chosen(near_keypoints(m, squared), NEAR_SIGMAS)
    assert torch.allclose(chosen.sigma_px_at(m, state), chosen.sigma_px(m, squared), rtol=1e-12)


@pytest.mark.usefixtures("long")
def test_counts_without_copies():
    seen = torch.rand(2, 3, 500) > 0.4
    assert torch.equal(views_of(seen).long(), seen.sum(1))
    assert torch.equal(count_of(seen), seen.sum(2))


def test_work_that_nobody_could_help_with_is_forgotten():
    class Work:
        def __call__(self, number: int) -> int:
            return number

    def busy(_: int) -> tuple[list[int], bool]:
        work = Work()
        done, kept = map_with_idle_workers(work, range(20)), weakref.ref(work)
        del work
        return done, kept() is None

    assert all(map_on_workers(torch.device("cpu"), busy, range(4))[number] == (list(range(20)), True) for number in range(4))
