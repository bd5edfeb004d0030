"""Errors that last for several frames: how they are found, what they do to the covariance, and how keypoints then count."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
import torch

from torchstickcal import Observations, Stick, calibrate
from torchstickcal.config import load_config
from torchstickcal.io import Truth
from torchstickcal.losses import ReprojectionLoss, StickLengthLoss
from torchstickcal.losses.robust import GemanMcClure, Repeated
from torchstickcal.metrics import pose_errors
from torchstickcal.model.correlation import ErrorCorrelation, error_correlation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline import stages
from torchstickcal.pipeline.adjust import adjust_cameras, begin
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.stage import StageResult, run_stage
from torchstickcal.simulate import Lens, Noise, SessionSpec, golf_session
from torchstickcal.simulate.regimes import DetectorNoise
from torchstickcal.solvers import correlated
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.uncertainty import camera_covariance, relative_scale_std, ruler_covariance

FRAMES = 7
SIGMA_PX, TOLERANCE_M = 2.0, 0.01


def scene() -> tuple[Measurements, State]:
    """A session and its true state, in the frame of the first camera."""
    observations, truth = golf_session(cameras=3, frames=FRAMES, noise=Noise(1.0, missing=0.1))
    assert truth.points is not None
    rotations = truth.rotations @ truth.rotations[0].mT
    translations = truth.translations - (rotations @ truth.translations[0])
    points = truth.points @ truth.rotations[0].mT + truth.translations[0]
    state = State.of(rotations[None], translations[None], points.flatten(0, 1).mT[None].contiguous())
    return Measurements.of(observations), state


def decaying(points: int) -> ErrorCorrelation:
    """Every point's errors last for another time."""
    decay = torch.linspace(0.2, 0.8, points, dtype=torch.float64)
    return ErrorCorrelation(decay[None, :, None] ** torch.arange(FRAMES))


def test_what_never_changes_does_not_count_among_the_errors_that_vary():
    lags = torch.arange(100, dtype=torch.float64)
    fading, constant = 0.9**lags, torch.where(lags == 0, 1.0, 0.4)
    both = torch.where(lags == 0, 1.0, 0.4 + 0.3 * fading)
    times = ErrorCorrelation(torch.stack([fading, constant, both])[None]).varying_times[0]
    last = ErrorCorrelation(torch.stack([fading, constant, both])[None]).times[0]
    torch.testing.assert_close(times[:2], torch.stack([last[0], torch.ones(()).double()]), rtol=0.05, atol=0.0)
    torch.testing.assert_close(times[2], 1 + 0.3 * (last[0] - 1), rtol=0.05, atol=0.0)
    assert float(last[1:].min()) > 30


def objective_of(m: Measurements) -> Objective:
    sigma = torch.full((1, m.points_per_frame), SIGMA_PX, dtype=torch.float64)
    return Objective(m, {"reprojection": ReprojectionLoss(sigma[:, None, None]), "stick_length": StickLengthLoss(TOLERANCE_M)})


def dense_covariance(m: Measurements, state: State, correlation: ErrorCorrelation) -> torch.Tensor:
    """``S^-1 (sum A T A^T + rest) S^-1`` with derivatives by finite differences and dense matrices T."""
    system = NormalEquations(objective_of(m), state, cameras_free=True)

    def whitened(tangents: torch.Tensor, points: torch.Tensor) -> torch.Tensor:
        residuals = torch.cat([found for _, found, _ in m.residuals(state.retracted(tangents.view(1, -1, 6), points))], dim=-1)
        return residuals[0] * m.confidence[0].sqrt()[:, None] / SIGMA_PX

    step, response = 1e-6, system.point_response()[0]
    columns = [
        (whitened(step * unit, step * moved[None]) - whitened(-step * unit, -step * moved[None])) / (2 * step)
        for unit, moved in zip(torch.eye(len(response), dtype=torch.float64), response, strict=True)
    ]
    derivatives = torch.stack(columns).unflatten(-1, (FRAMES, -1))
    lags = (torch.arange(FRAMES)[:, None] - torch.arange(FRAMES)).abs()
    excess = correlation.values[0][:, lags] - torch.eye(FRAMES)
    inverse = torch.linalg.inv(system.reduced[0])
    added = torch.einsum("dckfp,pfg,eckgp->de", derivatives, excess, derivatives)
    return inverse + inverse @ added @ inverse


@pytest.mark.parametrize("in_segments", [False, True])
def test_covariance_agrees_with_dense_matrices(in_segments: bool, monkeypatch: pytest.MonkeyPatch):
    m, state = scene()
    correlation = decaying(m.points_per_frame)
    as_shown = torch.ones(1, m.points_per_frame, dtype=torch.float64), torch.ones(1, dtype=torch.float64)
    monkeypatch.setattr(correlated, "_hidden", lambda *_: as_shown)
    if in_segments:
        monkeypatch.setattr(correlated, "_LEAST_SEGMENT", 4)
        monkeypatch.setattr(correlated, "_RESPONSE_VALUES", 1)
    found = camera_covariance(objective_of(m), state, correlation)[0]
    expected = dense_covariance(m, state, correlation)
    white = camera_covariance(objective_of(m), state)[0]
    assert (expected.diagonal() / white.diagonal()).max() > 1.5
    torch.testing.assert_close(found.diagonal(), expected.diagonal(), rtol=0.15 if in_segments else 0.002, atol=0)


def test_independent_errors_leave_the_covariance_as_it_is():
    for seed in range(3):
        observations, truth = golf_session(cameras=4, frames=60, noise=Noise(1.5), seed=seed)
        m = Measurements.of(observations)
        assert truth.points is not None
        points = truth.points.flatten(0, 1).mT[None].double().contiguous()
        state = State.of(truth.rotations[None].double(), truth.translations[None].double(), points)
        sigma_px = torch.full((1, m.points_per_frame), 1.5, dtype=torch.float64)
        found = error_correlation(m, state, sigma_px)
        assert not found.lasts
        assert (found.times == 1).all()
        white = camera_covariance(objective_of(m), state)
        assert torch.equal(camera_covariance(objective_of(m), state, found), white)


def biased(seed: int, bias_px: float) -> tuple[Observations, Truth]:
    """Each camera sees each joint with an error of its own that stays; the ends of the stick have none."""
    observations, truth = golf_session(cameras=4, frames=80, noise=Noise(1.5), seed=seed)
    generator = torch.Generator().manual_seed(100 + seed)
    bias = bias_px * torch.randn(4, 1, observations.num_points, 2, generator=generator, dtype=torch.float64)
    bias[:, :, list(observations.sticks[0].ends)] = 0.0
    return replace(observations, keypoints=observations.keypoints + bias), truth


def test_errors_that_last_are_covered_and_count_less():
    """The deviations grow with the errors, and the stick, whose ends are tracked well, determines the cameras."""
    normalised, errors, plain = [], [], []
    single = {"extends": "default", "stages": {"refined": {"reprojection": {"correlation_frames": 1.0}}}}
    for seed in range(4):
        observations, truth = biased(seed, 4.0)
        for config, into in (("default", errors), (single, plain)):
            found = calibrate(observations, config)
            into.append(
                float(pose_errors(found.rotations, found.translations, truth.rotations, truth.translations).mean_translation_m)
            )
            if config == "default":
                error = (found.camera_centres - truth_centres(truth))[1:].norm(dim=1)
                normalised += (error / found.camera_std_m[1:]).square().tolist()
    assert 0.2 < sum(normalised) / len(normalised) < 2.0
    assert sum(errors) < 0.6 * sum(plain)


def seen_elsewhere(sport: str, cameras: int, seed: int, bias_px: float = 4.0) -> tuple[Observations, Truth]:
    """A detector's noise, and joints as in ``biased``, by an athlete who stays where he is."""
    noise = DetectorNoise(3.0, 1.5)
    spec = SessionSpec("s", sport, seed, cameras, 80, layout="ring", lens=Lens(), radius_m=4.5, path="stay", regimes=(noise,))
    given = spec.generate()
    observations, generator = given.observations, torch.Generator().manual_seed(seed)
    bias = bias_px * torch.randn(cameras, 1, observations.num_points, 2, generator=generator, dtype=torch.float64)
    bias[:, :, list(observations.sticks[0].ends)] = 0.0
    return replace(observations, keypoints=observations.keypoints + bias), given.truth


@pytest.mark.parametrize(("sport", "seed"), [("golf", 0), ("hockey", 2), ("kendo", 0)])
def test_two_cameras_are_not_deceived_by_joints(sport: str, seed: int):
    """Two views fit together in a rig that is 0.5 to 4.5 m off: the stick changes its length there, or its ends seem to err."""
    observations, truth = seen_elsewhere(sport, 2, seed)
    found = calibrate(observations)
    error = float((found.camera_centres - truth_centres(truth))[1].norm())
    assert error < 0.1
    assert error < 3 * float(found.camera_std_m[1])


def test_ends_are_trusted_in_the_session_of_a_batch_that_needs_it():
    run = Run(load_config("default"))
    both = [begin(seen_elsewhere("kendo", 2, 0)[0], run), begin(seen_elsewhere("kendo", 2, 0, 0.0)[0], run)]
    together = adjust_cameras(Adjustment.stack(both), run)
    for number, begun in enumerate(both):
        alone = adjust_cameras(begun, run)
        torch.testing.assert_close(together.state.rotations[number], alone.state.rotations[0], rtol=0.0, atol=1e-4)


def test_what_keypoints_count_is_not_estimated_where_it_is_given(monkeypatch: pytest.MonkeyPatch):
    """A stage runs once then, however long the errors of the sticks' ends are said to last."""
    names: list[str] = []

    def noted(name: str, *arguments: Any, **keywords: Any) -> StageResult:
        names.append(name)
        return run_stage(name, *arguments, **keywords)

    monkeypatch.setattr(stages, "run_stage", noted)
    given = {"extends": "default", "stages": {"refined": {"reprojection": {"correlation_frames": 10.0}}}}
    calibrate(seen_elsewhere("golf", 3, 0)[0], given)
    assert names.count("refined") == 1


def truth_centres(truth: Truth) -> torch.Tensor:
    """Camera centres in the frame of the first camera."""
    centres = -(truth.rotations.mT @ truth.translations[..., None])[..., 0]
    return (centres - centres[0]) @ truth.rotations[0].mT


def test_auto_leaves_right_lenses_alone_where_errors_last():
    for seed in range(2):
        assert calibrate(biased(seed, 4.0)[0], refine="auto").refined == ()


def test_a_ruler_has_one_error():
    """The error of its length is the scale's, however many frames there are."""
    m, state = scene()
    sigma_px = torch.ones(1, m.points_per_frame, dtype=torch.float64)
    centres = -(state.rotations[0].mT @ state.translations[0][..., None])[..., 0]
    m = replace(m, stick_sigma_m=torch.tensor([0.02], dtype=torch.float64))
    scale_std = relative_scale_std(centres, ruler_covariance(m, state, sigma_px))
    assert float(scale_std) == pytest.approx(0.02 / float(m.lengths_m))
    observations = golf_session(cameras=3, frames=40, noise=Noise(1.0))[0]
    stick: Stick = observations.sticks[0]
    uncertain = replace(observations, sticks=(replace(stick, sigma_m=0.02),))
    assert float(calibrate(uncertain).scale_std) > 0.02 / stick.length_m


def test_repeated_residuals_are_judged_by_themselves():
    """n residuals as one: the loss is divided by n, and the robust kernel bends where it did."""
    observations, truth = golf_session(cameras=3, frames=2, noise=Noise(3.0))
    arguments = truth.points, truth.rotations, truth.translations, observations.keypoints, observations.intrinsics
    plain = ReprojectionLoss(2.0, kernel=GemanMcClure(3.0))
    times = torch.full((1, 1, 1, observations.num_points), 4.0, dtype=torch.float64)
    torch.testing.assert_close(ReprojectionLoss(2.0, kernel=GemanMcClure(3.0), times=times)(*arguments), plain(*arguments) / 4)
    squared = torch.linspace(0.0, 5.0, 7, dtype=torch.float64).requires_grad_()
    kernel = Repeated(GemanMcClure(2.0), torch.tensor(3.0))
    (slope,) = torch.autograd.grad(kernel.rho(squared).sum(), squared, create_graph=True)
    (curvature,) = torch.autograd.grad(slope.sum(), squared)
    torch.testing.assert_close(kernel.weight(squared), slope)
    torch.testing.assert_close(kernel.curvature(squared), curvature)


@pytest.mark.parametrize("columns", [slice(0, 20), slice(5, 15), slice(3, 4), slice(7, 19), slice(2, 2)])
def test_times_of_some_columns(columns: slice):
    loss = ReprojectionLoss(times=torch.arange(1.0, 11.0).view(2, 1, 1, 5))
    kernels = [loss.of_columns(chosen, 5).kernel for chosen in (columns, torch.arange(columns.start, columns.stop))]
    times = [kernel.times for kernel in kernels if isinstance(kernel, Repeated)]
    assert torch.equal(*times)
    assert times[0].shape == (2, 1, columns.stop - columns.start)


def test_no_variance_is_negative_or_not_a_number_whatever_the_residuals_are():
    spoiled = torch.tensor([[[1.0, 3.0], [3.0, 1.0]], [[torch.nan, 0.0], [0.0, 1.0]], [[2.0, 0.5], [0.5, 2.0]]])
    found = correlated._not_below(spoiled, torch.tensor([0.5, 0.5, 0.5]))
    torch.testing.assert_close(torch.linalg.eigvalsh(found), torch.tensor([[0.5, 4.0], [1.0, 1.0], [1.5, 2.5]]))
    torch.testing.assert_close(found[2], spoiled[2])
