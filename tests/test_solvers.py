"""Both solvers: they find the same minimum, report why they stopped, and never return a worse state."""

from __future__ import annotations

import doctest

import pytest
import torch

from torchstickcal.losses import Cauchy, GemanMcClure, Loss, ReprojectionLoss, SmoothnessLoss, StickLengthLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers import IterationRecord, Stop, Termination, gradients, solver
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.linearised import Linearised
from torchstickcal.solvers.newton import polish

LOSSES: dict[str, dict[str, Loss]] = {
    "whitened": {"reprojection": ReprojectionLoss(1.0, kernel=GemanMcClure(8.0)), "length": StickLengthLoss(0.001)},
    "paper": {
        "reprojection": ReprojectionLoss(1.0, kernel=Cauchy(3.0)),
        "length": StickLengthLoss(1.0, weight=0.4),
        "smoothness": SmoothnessLoss(1.0, weight=0.2),
    },
}
TIGHT = Termination(max_iterations=200, cost_tolerance=1e-11, camera_tolerance=1e-7)


def run(name: str, objective: Objective, state: State, termination: Termination = TIGHT, cameras_free: bool = True):
    records: list[IterationRecord] = []
    outcome = solver(name)(
        objective, state, cameras_free=cameras_free, termination=termination, stage="test", listener=records.append
    )
    assert (tuple(records),) == outcome.iterations
    return outcome


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
def test_both_solvers_find_the_same_minimum(disturbed: tuple[Measurements, State], losses: dict[str, Loss]):
    measurements, state = disturbed
    objective = Objective(measurements, losses)
    ours, theirs = run("gauss_newton", objective, state), run("lbfgs", objective, state)
    assert ours.stops[0].converged
    assert theirs.stops[0].converged
    assert ours.iterations[0][-1].cost == pytest.approx(theirs.iterations[0][-1].cost, rel=1e-8)
    assert ours.iterations[0][-1].cost < ours.iterations[0][0].cost


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
@pytest.mark.parametrize("tolerance", [1e-2, 1e-5, 1e-9])
def test_the_last_step_is_confirmed_by_its_cost_alone(
    disturbed: tuple[Measurements, State], losses: dict[str, Loss], tolerance: float, monkeypatch: pytest.MonkeyPatch
):
    """One system less than states, and the same end as with the system of every state, but for a negligible step."""
    objective = Objective(disturbed[0], losses)
    built: list[NormalEquations] = []
    build = NormalEquations.__init__
    monkeypatch.setattr(NormalEquations, "__init__", lambda self, *given: built.append(self) or build(self, *given))
    outcome = run("gauss_newton", objective, disturbed[1], Termination(cost_tolerance=tolerance, camera_tolerance=0.0))
    states = outcome.iterations[0]
    assert outcome.stops[0].converged
    assert len(built) == len(states) - 1
    exact = run("gauss_newton", objective, disturbed[1]).iterations[0][-1].cost
    assert exact <= states[-1].cost <= exact * (1 + 10 * tolerance)


def test_a_run_that_newton_follows_stops_earlier_and_ends_at_the_same_minimum(disturbed: tuple[Measurements, State]):
    objective = Objective(disturbed[0], LOSSES["whitened"])

    def ended(newton_follows: bool, max_iterations: int = 100, leaves_last_step: bool = False) -> tuple[Stop, int, State]:
        termination = Termination(
            max_iterations, cost_tolerance=1e-3, newton_follows=newton_follows, leaves_last_step=leaves_last_step
        )
        outcome = run("gauss_newton", objective, disturbed[1], termination)
        return outcome.stops[0], len(outcome.iterations[0]), polish(objective, outcome.state, cameras_free=True)

    (_, steps, there), (stop, fewer, same) = ended(False), ended(True)
    assert stop.converged
    assert fewer < steps
    torch.testing.assert_close(same.translations, there.translations, rtol=0, atol=1e-9)
    torch.testing.assert_close(same.points, there.points, rtol=0, atol=1e-9)
    assert ended(True, max_iterations=1)[0] == Stop.ITERATIONS  # nothing is known of the next step
    stop, tried, again = ended(True, leaves_last_step=True)
    assert stop.converged
    assert tried < fewer
    torch.testing.assert_close(again.translations, there.translations, rtol=0, atol=1e-9)
    assert ended(False, leaves_last_step=True)[1] == steps


@pytest.mark.parametrize("start", [1e-1, 1e-3, 1e-5])
def test_newton_ends_at_the_minimum(disturbed: tuple[Measurements, State], start: float):
    """From near and far, what is left of the way is a hundred-millionth of the standard deviations."""
    objective = Objective(disturbed[0], LOSSES["whitened"])
    near = run("gauss_newton", objective, disturbed[1], Termination(cost_tolerance=start, newton_follows=True)).state
    at = Linearised(objective, polish(objective, near, cameras_free=True), cameras_free=True)
    assert float(at.descent(at.gradient).dot(at.gradient).abs().sqrt()) < 1e-8


@pytest.mark.parametrize("name", ["gauss_newton", "lbfgs"])
def test_gradient_is_zero_at_the_result(disturbed: tuple[Measurements, State], name: str):
    measurements, state = disturbed
    objective = Objective(measurements, LOSSES["whitened"])

    def gradient(state: State) -> torch.Tensor:
        points, translations = state.points.clone().requires_grad_(), state.translations.clone().requires_grad_()
        torch.stack(list(objective.terms(State.of(state.rotations, translations, points)).values())).sum().backward()
        assert points.grad is not None
        assert translations.grad is not None
        return torch.cat([points.grad.flatten(), translations.grad[:, 1:].flatten()]).abs().max()

    assert gradient(run(name, objective, state).state) < 1e-5 * gradient(state)


@pytest.mark.parametrize("name", ["gauss_newton", "lbfgs"])
def test_cameras_held_fixed_do_not_change(disturbed: tuple[Measurements, State], name: str):
    measurements, state = disturbed
    outcome = run(name, Objective(measurements, LOSSES["whitened"]), state, cameras_free=False)
    assert outcome.stops[0].converged
    assert torch.equal(outcome.state.translations, state.translations)
    assert torch.equal(outcome.state.rotations, state.rotations)
    assert outcome.iterations[0][-1].cost < outcome.iterations[0][0].cost


def test_cost_never_increases_and_is_the_sum_of_its_terms(disturbed: tuple[Measurements, State]):
    measurements, state = disturbed
    records = run("gauss_newton", Objective(measurements, LOSSES["paper"]), state).iterations[0]
    costs = [record.cost for record in records]
    assert costs == sorted(costs, reverse=True)
    for record in records:
        assert sum(record.terms.values()) == pytest.approx(record.cost)
        assert len(record.reprojection_px) == 4


@pytest.mark.parametrize("name", ["gauss_newton", "lbfgs"])
def test_stop_at_the_limit_of_iterations_is_reported(disturbed: tuple[Measurements, State], name: str):
    measurements, state = disturbed
    outcome = run(name, Objective(measurements, LOSSES["whitened"]), state, Termination(max_iterations=1, cost_tolerance=1e-15))
    assert outcome.stops == (Stop.ITERATIONS,)
    assert not outcome.stops[0].converged
    assert [record.iteration for record in outcome.iterations[0]] == [0, 1]


def test_an_invalid_start_gives_a_status_and_returns_its_state(disturbed: tuple[Measurements, State]):
    measurements, state = disturbed
    broken = State.of(state.rotations, state.translations, torch.full_like(state.points, torch.nan))
    outcome = run("gauss_newton", Objective(measurements, LOSSES["whitened"]), broken)
    assert outcome.stops == (Stop.DIVERGED,)
    assert torch.equal(outcome.state.translations, state.translations)


def test_examples_of_the_gradient_modes_run():
    assert doctest.testmod(gradients).failed == 0
