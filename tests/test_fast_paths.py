"""What is worked out in a quick way, against the plain way."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from types import SimpleNamespace
from typing import cast

import pytest
import torch
from torch import Tensor

from torchstickcal import Calibration, calibrate
from torchstickcal.geometry.singular import covariance_of, solve_information
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.trajectories import _HALF_WIDTHS, LocalPolynomials, Trajectories
from torchstickcal.model.unknowns import all_unknowns
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.folds import folds_of_frames, folds_of_points
from torchstickcal.quality.acceptance import Triangulated
from torchstickcal.quality.evidence import Evidence
from torchstickcal.quality.linear import FramePulls, variance_of_sums
from torchstickcal.quality.moved import _best_changes, _motions, _System
from torchstickcal.simulate import Noise, SessionSpec
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.uncertainty import likelihood


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    regimes = (Noise(1.5, missing=0.1, outliers=0.03),)
    observations = SessionSpec("golf", "golf", 4, 4, 23, regimes=regimes).generate().observations
    return calibrate(observations, refine=("focal", "time_offset"))


@pytest.fixture(scope="module")
def evidence(calibration: Calibration) -> Evidence:
    assert isinstance(calibration.judgement, partial)
    return calibration.judgement.args[0]


def likelihood_of(evidence: Evidence) -> Objective:
    return likelihood(evidence.kept, evidence.ended.last_camera_stage.losses, evidence.ended.last.sigma_px)


def without_prior(objective: Objective, state: State) -> tuple[Tensor, Tensor]:
    """Information and gradient of the cameras, by normal equations of their own."""
    system = NormalEquations(objective, state, cameras_free=True)
    _, own, prior = objective.linearise_prior(state)
    zeros = system.reduced_gradient.shape[1] - own.shape[1], 0
    padded = [torch.nn.functional.pad(values, zeros) for values in (prior, own)]
    return system.reduced[0] - padded[0][0].diag(), (system.reduced_gradient - padded[1])[0]


def test_folds_are_systems_of_their_keypoints(evidence: Evidence):
    objective, state, m = likelihood_of(evidence), evidence.state, evidence.kept
    windows = [slice(0, 6), slice(6, 10), slice(10, 19), slice(19, 23)]
    folds = folds_of_frames(objective, state, windows)
    for fold, window in zip(folds, windows, strict=True):
        own = replace(state, points=state.points[..., m.columns_of(window)])
        plain = without_prior(Objective(m.within(window), objective.losses), own)
        torch.testing.assert_close((fold.information, fold.gradient), plain, rtol=1e-9, atol=1e-6)
    whole = without_prior(objective, state)
    sums = sum(fold.information for fold in folds), sum(fold.gradient for fold in folds)
    torch.testing.assert_close(sums, whole, rtol=1e-9, atol=1e-6)
    single = [point for point in range(m.points_per_frame) if point not in m.sticks]
    group = torch.isin(torch.arange(m.num_columns) % m.points_per_frame, torch.tensor(single[::3]))
    (fold,) = folds_of_points(objective, state, [group])
    plain = without_prior(Objective(m.keeping(group), objective.losses), state)
    torch.testing.assert_close((fold.information, fold.gradient), plain, rtol=1e-9, atol=1e-6)


def test_points_by_themselves_follow_from_normal_equations(evidence: Evidence):
    loss = ReprojectionLoss(evidence.ended.last.sigma_px[:, None, None])
    objective, state, active = Objective(evidence.kept, {"reprojection": loss}), evidence.state, evidence.kept.active[0]
    assert not bool(active.all())
    seen = Triangulated.of(objective, state)
    held = NormalEquations(objective, state, cameras_free=False).step()
    torch.testing.assert_close(seen.points[:, active], (state.points + held.points)[0][:, active], rtol=0, atol=1e-9)
    torch.testing.assert_close(seen.points[:, ~active], state.points[0][:, ~active])
    system = NormalEquations(objective, state, cameras_free=True)
    rows = torch.stack([seen.moved(tangent) for tangent in torch.eye(len(seen.rows)).double()])
    torch.testing.assert_close(rows, system.point_response()[0], rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("lasting", [False, True])
def test_suggestions_follow_from_poses_and_one_unknown(evidence: Evidence, lasting: bool):
    check = CameraCheck(evidence.ended, [])
    system = check._system
    if lasting:
        other = torch.rand(len(system.gradient), 3, generator=torch.Generator().manual_seed(0)).double()
        system = system._replace(gradient_covariance=system.information + 1e4 * other @ other.mT)
        check.__dict__["_system"] = system
    for name, unknown in all_unknowns().items():
        names = (next(iter(unknown.variants)),)
        chosen, poses = check._chosen(names), system.poses
        information = chosen.mT @ system.information @ chosen
        values, covariance = -solve_information(information, chosen.mT @ system.gradient), covariance_of(information)
        if lasting:
            covariance = covariance @ chosen.mT @ system.gradient_covariance @ chosen @ covariance
        of_unknown, solution = check._picked(names)[1], check._solved(names)
        torch.testing.assert_close(solution.values, values[poses:], rtol=1e-6, atol=1e-12)
        torch.testing.assert_close(solution.covariance, covariance[poses:, poses:], rtol=1e-6, atol=1e-12)
        suggestion = check.suggestion(name)
        torch.testing.assert_close(
            suggestion.deviation, of_unknown.by_name(values[None, poses:])[name][0], rtol=1e-6, atol=1e-12
        )
        variances = of_unknown.variances(covariance[poses:, poses:])[name]
        torch.testing.assert_close(suggestion.std, variances.sqrt(), rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("fps", [30.0, 240.0])
def test_each_polynomial_is_of_the_widest_window_that_follows(fps: float):
    motion = SessionSpec("swing", "golf", 3).motion
    points = torch.from_numpy(motion.points((torch.arange(50) / fps + 1.0).numpy())).movedim(2, 0)
    generator = torch.Generator().manual_seed(0)
    points = points + 2e-3 * torch.randn(points.shape, generator=generator)
    variance = torch.full(points.shape[1:], 4e-6).double()
    variance[torch.rand(variance.shape, generator=generator) < 0.2] = torch.inf
    trajectories, frames = Trajectories(points, variance, torch.tensor(3)), slice(5, 45)
    every = torch.arange(40 * points.shape[2])
    narrow, *wider = (trajectories._fit(frames, half_width, every) for half_width in _HALF_WIDTHS)
    plain, follows, widths = narrow.shrunk, torch.ones(len(every), dtype=torch.bool), torch.zeros(len(every))
    for fit in wider:
        follows = follows & fit.follows
        plain = LocalPolynomials(*(torch.where(follows, new, old) for new, old in zip(fit.shrunk, plain, strict=True)))
        widths += follows
    assert len(widths.unique()) == 3, "each width is the best somewhere"
    found = trajectories.polynomials(frames)
    torch.testing.assert_close(tuple(found), tuple(plain), rtol=1e-6, atol=1e-12)


def test_keypoints_on_one_clock_stay_where_they_are(evidence: Evidence):
    ended, support, exposures = evidence.ended, evidence.ended.support, evidence.ended.exposures
    state = replace(ended.state, unknowns=torch.zeros_like(ended.state.unknowns))
    still = exposures.at_common_times(ended.seen, state, support)
    nearly = replace(exposures, delays=exposures.delays + 1e-9).at_common_times(ended.seen, state, support)
    torch.testing.assert_close(still.pixels, ended.seen.pixels, rtol=0, atol=0)
    torch.testing.assert_close(still.confidence, nearly.confidence)
    torch.testing.assert_close(still.pixels, nearly.pixels, rtol=0, atol=1e-6)
    assert still.motion is not None
    assert nearly.motion is not None
    assert float(still.motion.velocity.abs().max()) > 1.0
    torch.testing.assert_close(still.motion.velocity, nearly.motion.velocity, rtol=1e-6, atol=1e-6)


@pytest.mark.parametrize("name", ["motion", "lens", "clock"])
def test_clocks_count_twice_where_images_speak_against_them_too(name: str):
    family = {"lens": "focal", "clock": "time_offset"}
    for strengths in ([9.0, 4.0, 5.0], [9.0, 4.0, 3.0], [4.0, 9.0, 5.0], [4.0, 5.0, 9.0], [8.0, 8.0, 4.0], [0.0, 0.0, 0.0]):
        given: dict[str, float] = dict(zip(("motion", "lens", "clock"), strengths, strict=True))
        for apart in (True, False):
            stub = SimpleNamespace(
                motion=SimpleNamespace(evidence=given["motion"]),
                contradictions={unknown: torch.tensor([given[own]]) for own, unknown in family.items()},
                unknowns=dict.fromkeys(family.values(), SimpleNamespace(refined=False)),
                unsynchronised=lambda apart=apart: apart,
            )
            weighed = given | {"clock": (1 + apart) * given["clock"]}
            assert Evidence.explains_most(cast(Evidence, stub), name) == (weighed[name] == max(weighed.values()))


def test_the_images_are_not_asked_about_clocks_that_the_points_find_in_step():
    observations = SessionSpec("golf", "golf", 3, 5, 40, regimes=(Noise(1.0),)).generate().observations
    judgement = calibrate(observations).judgement
    assert isinstance(judgement, partial)
    asked: list[bool] = []
    quality = judgement.func(replace(judgement.args[0], unsynchronised=lambda: bool(asked.append(True))))
    assert quality.verdict == "good"
    assert not asked


def test_places_of_keypoints_are_compared_for_all_cameras(evidence: Evidence):
    observations = evidence.observations
    keypoints, centre = observations.keypoints.clone(), observations.cameras.matrix[:, :2, 2]
    keypoints[1] = keypoints[1] / 4
    keypoints[2] = centre[2] * (1.5 + 0.4 * keypoints[2] / keypoints[2].nan_to_num().amax())
    for size in (observations.image_size, None):
        changed = replace(observations, keypoints=keypoints, image_size=size)
        stub = cast(Evidence, SimpleNamespace(observations=changed, cameras=4))
        found = Evidence.off_centre._function(stub).tolist()  # type: ignore[attr-defined]
        for camera in range(4):
            places = changed.keypoints[camera][changed.visible[camera]] / centre[camera] - 1
            low, high = places.quantile(torch.tensor([0.05, 0.95]).double(), dim=0)
            outside = size is None and bool((low.abs().maximum(high.abs()) > 1.2).any())
            assert found[camera] == (bool((high < 0).all()) or outside)
        assert found[:2] == [False, True]


@pytest.mark.parametrize("gradual", [False, True], ids=["knock", "drift"])
def test_changes_of_all_cameras_are_those_of_each_by_itself(evidence: Evidence, gradual: bool):
    frames, camera = evidence.measurements.frames, 2
    share = torch.linspace(-0.5, 0.5, frames) if gradual else (torch.arange(frames) >= 9).double()
    pulls = FramePulls.of(evidence.measurements, evidence.state, evidence.ended.last.sigma_px)
    place = slice(6 * camera, 6 * camera + 6)
    tangent = torch.tensor([0.0, 0, 0, 0.02, -0.01, 0.01]).double()
    moved = pulls.gradient + share.double()[:, None, None] * (pulls.information[:, :, place] @ tangent).unflatten(1, (-1, 6))
    system = _System.of(replace(pulls, gradient=moved))
    motions = _motions(evidence.state.rotations[0], evidence.state.translations[0])
    changes = _best_changes(system, motions)
    steps = range(2, frames - 1)
    shares = torch.stack(
        [*((torch.arange(frames) >= step).double() for step in steps), torch.linspace(-0.5, 0.5, frames).double()]
    )
    for number, change in enumerate(changes):
        own_place, motion = slice(6 * number, 6 * number + 6), motions[number]
        for index, weights in enumerate(shares):
            rows = torch.einsum("k,kij->ij", weights, system.information[:, own_place])
            own = torch.einsum("k,kij->ij", weights.square(), system.information[:, own_place, own_place])
            prior = torch.tensor([1 / 0.02**2] * 3 + [1 / 0.03**2] * 3).double().diag()
            information = motion.mT @ (own - rows @ system.covariance @ rows.mT) @ motion + prior
            asked = motion.mT @ (weights @ system.pull[:, number])
            for size, found in ((3, change.asked.of_turn), (6, change.asked.of_any)):
                expected = asked[:size] @ torch.linalg.solve(information[:size, :size], asked[:size])
                torch.testing.assert_close(found[index], expected, rtol=1e-6, atol=1e-9)
        chosen, size = shares[change.chosen], 3 if change.turned else 6
        best = change.asked.tangent(change.chosen, size)
        rows, own = system.information[:, own_place], system.information[:, own_place, own_place]
        others = system.covariance @ torch.einsum("k,kij,i->j", chosen, rows, best)
        left = system.pull[:, number] - rows @ others + chosen[:, None] * (own @ best)
        assert change.variance == pytest.approx(max(0.4, float(variance_of_sums(left, own, (12, 24, 48)))), rel=1e-6)
    most = max(range(len(changes)), key=lambda number: changes[number].strength)
    assert (most, changes[most].gradual) == (camera, gradual)
    assert gradual or changes[most].part == 9
