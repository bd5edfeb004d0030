"""The reduced camera system agrees with a dense solve of the full normal equations, which autograd builds."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from kornia.geometry.liegroup import Se3

from torchstickcal.losses import (
    Cauchy,
    GemanMcClure,
    Huber,
    Loss,
    ReprojectionLoss,
    SmoothnessLoss,
    StickLengthLoss,
    second_differences,
)
from torchstickcal.losses.reprojection import reprojection_residuals
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.evaluated import Gradient
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

LOSSES: dict[str, dict[str, Loss]] = {
    "reprojection": {"reprojection": ReprojectionLoss(2.0, kernel=Cauchy(2.0))},
    "with sticks": {"reprojection": ReprojectionLoss(2.0, kernel=Cauchy(2.0)), "length": StickLengthLoss(0.01)},
    "with smoothness": {
        "reprojection": ReprojectionLoss(2.0, kernel=Cauchy(2.0)),
        "length": StickLengthLoss(0.01, weight=0.4),
        "smoothness": SmoothnessLoss(0.05, weight=0.2),
    },
}


def dense_system(objective: Objective, state: State) -> tuple[torch.Tensor, torch.Tensor, float]:
    """Hessian and gradient with respect to all unknowns (all cameras but the first, then points), and the cost."""
    m = objective.measurements
    shape = (m.frames, m.points_per_frame, 3)
    start_rotations, start_translations, start_points = state.rotations[0], state.translations[0], state.points[0].mT
    tangents = torch.zeros(len(start_rotations) - 1, 6, dtype=torch.float64)
    confidence = m.by_frame(m.confidence)[0]
    keypoints = m.by_frame(m.pixels)[0].movedim(1, -1).where(confidence[..., None] > 0, torch.nan)
    active = m.by_frame(m.active)[0]

    def residuals(tangents: torch.Tensor, points: torch.Tensor) -> list[torch.Tensor]:
        step = Se3.exp(tangents).matrix()
        rotations = torch.cat([start_rotations[:1], start_rotations[1:] @ step[:, :3, :3]])
        moved = (start_rotations[1:] @ step[:, :3, 3:])[..., 0] + start_translations[1:]
        translations = torch.cat([start_translations[:1], moved])
        points = points.view(shape)
        found: list[torch.Tensor] = []
        for loss in objective.losses.values():
            scale = (loss.weight**0.5) / loss.sigma
            if isinstance(loss, ReprojectionLoss):
                r = reprojection_residuals(points, rotations, translations, keypoints, m.cameras[0])
                whitened = r.detach().square().sum(-1) * confidence / loss.sigma**2
                r = r * (loss.kernel.weight(whitened) * confidence).sqrt()[..., None]
            elif isinstance(loss, StickLengthLoss):
                ends = points[:, m.sticks]
                r = ((ends[:, :, 1] - ends[:, :, 0]).norm(dim=-1) - m.lengths_m[0]) * m.stick_active[0]
            else:
                complete = active[2:] & active[1:-1] & active[:-2]
                r = second_differences(points) * complete[..., None]
            found.append((r * scale).flatten())
        return found

    arguments = (tangents, start_points.flatten())
    terms = objective.terms(state)
    cost = float(sum(terms.values()))
    jacobians = torch.autograd.functional.jacobian(lambda *x: torch.cat(residuals(*x)), arguments)
    jacobian = torch.cat([j.flatten(1) for j in jacobians], dim=1)
    residual = torch.cat(residuals(*arguments))
    return (jacobian.mT @ jacobian).detach(), (jacobian.mT @ residual).detach(), cost


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_step_agrees_with_the_full_system(disturbed: tuple[Measurements, State], losses: dict[str, Loss], damping: float):
    measurements, state = first_frames(*disturbed, frames=6)
    objective = Objective(measurements, losses)
    hessian, gradient, cost = dense_system(objective, state)
    inactive = (~measurements.active[0]).repeat_interleave(3).nonzero().flatten() + 18
    hessian[inactive, inactive] += 1.0
    if "length" not in losses:
        damping = max(damping, 1e-6)  # nothing determines the scale without a length
    damped = hessian + damping * torch.diag(hessian.diagonal())

    system = NormalEquations(objective, state, True, damping)
    step = system.step()
    assert bool(step.solved)
    found = torch.cat([step.cameras.flatten(), step.points[0].mT.flatten()])
    expected = -torch.linalg.solve(damped, gradient)
    torch.testing.assert_close(damped @ found, -gradient, rtol=0, atol=1e-10 * float(gradient.abs().max()))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-10 * float(expected.abs().max()) / max(damping, 1e-4))
    predicted = -2 * float(gradient @ expected) - float(expected @ hessian @ expected)
    assert float(step.predicted_decrease) == pytest.approx(predicted, rel=1e-8)
    assert float(system.cost) == pytest.approx(cost, rel=1e-13)

    cameras = 18
    h_cc, h_cx, h_xx = damped[:cameras, :cameras], damped[:cameras, cameras:], damped[cameras:, cameras:]
    reduced = h_cc - h_cx @ torch.linalg.solve(h_xx, h_cx.mT)
    torch.testing.assert_close(system.reduced[0], reduced, rtol=1e-8, atol=1e-10 * float(reduced.abs().max()))


def first_frames(measurements: Measurements, state: State, frames: int) -> tuple[Measurements, State]:
    columns = slice(0, frames * measurements.points_per_frame)
    pixels, confidence = measurements.pixels[..., columns].contiguous(), measurements.confidence[..., columns].contiguous()
    measurements = dataclasses.replace(measurements, pixels=pixels, confidence=confidence, frames=frames)
    return measurements, dataclasses.replace(state, points=state.points[..., columns].contiguous())


EXACT: dict[str, dict[str, Loss]] = {
    "cauchy": {"reprojection": ReprojectionLoss(9.0, 0.7, Cauchy(5.0)), "length": StickLengthLoss(0.1, 0.4, Cauchy(2.0))},
    "geman": {"reprojection": ReprojectionLoss(9.0, kernel=GemanMcClure(8.0)), "length": StickLengthLoss(0.1)},
    "huber": {"reprojection": ReprojectionLoss(2.0, kernel=Huber(1.5)), "length": StickLengthLoss(0.01)},
    "smooth": {
        "reprojection": ReprojectionLoss(2.0),
        "length": StickLengthLoss(0.01),
        "smoothness": SmoothnessLoss(0.05, weight=0.2),
    },
}


@pytest.mark.parametrize("losses", EXACT.values(), ids=EXACT.keys())
def test_exact_hessian_agrees_with_autograd(disturbed: tuple[Measurements, State], losses: dict[str, Loss]):
    """At a state that is not a minimum, where every term of the second derivative is nonzero."""
    measurements, state = first_frames(*disturbed, frames=5)
    objective = Objective(measurements, losses)

    def value(unknowns: torch.Tensor) -> torch.Tensor:
        step = Se3.exp(unknowns[:18].view(3, 6)).matrix()
        turned = torch.cat([state.rotations[:, :1], state.rotations[:, 1:] @ step[None, :, :3, :3]], dim=1)
        moved = (state.rotations[:, 1:] @ step[None, :, :3, 3:])[..., 0] + state.translations[:, 1:]
        points = state.points + unknowns[18:].view(-1, 3).mT
        translations = torch.cat([state.translations[:, :1], moved], dim=1)
        return torch.stack(list(objective.terms(State.of(turned, translations, points)).values())).sum() / 2

    zero = torch.zeros(18 + state.points.numel(), dtype=torch.float64)
    hessian = torch.autograd.functional.hessian(value, zero)
    inactive = (~measurements.active[0]).repeat_interleave(3).nonzero().flatten() + 18
    hessian[inactive, inactive] += 1.0
    rhs = torch.randn(len(zero), generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    def solved(damping: float) -> torch.Tensor:
        system = NormalEquations(objective, state, True, damping, exact=True)
        none = rhs.new_zeros(1, 0)
        cameras, _, points, _ = system.solve(rhs[:18].view(1, 3, 6), none, rhs[18:].view(1, -1, 3).mT)
        return torch.cat([cameras.flatten(), points[0].mT.flatten()])

    damping = 0.5  # makes the Hessian positive definite away from the minimum
    damped = hessian + damping * torch.diag(hessian.diagonal())
    torch.testing.assert_close(damped @ solved(damping), rhs, rtol=1e-8, atol=1e-8)

    direction = 0.01 * torch.randn(len(zero), generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    steps = torch.cat([torch.zeros(1, 6), direction[:18].view(3, 6)])[None], direction[18:].view(1, -1, 3).mT
    (gradient,) = torch.autograd.grad(value(zero.requires_grad_()), zero)
    along = float(objective.slope(state, *steps, state.unknowns))
    assert along == pytest.approx(float(gradient @ direction), rel=1e-10)


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
def test_linearised_cost_and_gradient_agree_with_autograd(disturbed: tuple[Measurements, State], losses: dict[str, Loss]):
    measurements, state = disturbed
    objective = Objective(measurements, losses)
    points = state.points.clone().requires_grad_()
    terms = objective.terms(dataclasses.replace(state, points=points))
    (gradient,) = torch.autograd.grad(torch.stack(list(terms.values())).sum(), points)
    system = NormalEquations(objective, state, cameras_free=True)
    alone = Gradient(objective, state, cameras_free=True)
    for found in (system, alone):
        for name, value in terms.items():
            assert float(found.terms[name]) == pytest.approx(float(value.detach()), rel=1e-12)
        torch.testing.assert_close(2 * found.point_gradient, gradient, rtol=1e-9, atol=1e-9 * float(gradient.abs().max()))
    scale = float(system.camera_gradient.abs().max())
    torch.testing.assert_close(alone.camera_gradient, system.camera_gradient, rtol=1e-10, atol=1e-12 * scale)
    torch.testing.assert_close(alone.reprojection_px, system.reprojection_px)


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
@pytest.mark.parametrize("kept", ["rows", "blocks", "nothing"])
def test_splitting_into_parts_does_not_change_the_step(
    disturbed: tuple[Measurements, State], losses: dict[str, Loss], kept: str, monkeypatch: pytest.MonkeyPatch
):
    measurements, state = disturbed
    objective = Objective(measurements, losses)
    whole = NormalEquations(objective, state, True, 1e-3).step()
    monkeypatch.setattr("torchstickcal.model.measurements._CHUNK_KEYPOINTS", {"cpu": 200})
    monkeypatch.setattr("torchstickcal.solvers.elimination.parts._MAX_TRACK_POINTS", 90)
    if kept != "rows":
        monkeypatch.setattr("torchstickcal.solvers.elimination.normal_equations._MAX_SOLVED_BYTES", 0)
    if kept == "nothing":
        monkeypatch.setattr("torchstickcal.solvers.elimination.normal_equations._MAX_CACHED_BYTES", 0)
    assert len(measurements.chunks()) > 10
    parts = NormalEquations(objective, state, True, 1e-3).step()
    torch.testing.assert_close(parts.cameras, whole.cameras, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(parts.points, whole.points, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
def test_sessions_of_a_batch_are_independent(disturbed: tuple[Measurements, State], losses: dict[str, Loss]):
    measurements, state = disturbed
    generator = torch.Generator().manual_seed(5)
    shift = 0.01 * torch.randn(state.points.shape, generator=generator, dtype=torch.float64)
    other = state.retracted(torch.zeros(1, 0, 6), shift)
    both = Objective(Measurements.stack([measurements, measurements]), losses)
    damping = torch.tensor([1e-4, 1e-2], dtype=torch.float64)
    together = NormalEquations(both, State.stack([state, other]), True, damping).step()
    for session, start in enumerate((state, other)):
        alone = NormalEquations(Objective(measurements, losses), start, True, damping[session : session + 1]).step()
        for found, expected in zip(together, alone, strict=True):
            torch.testing.assert_close(found[session], expected[0], rtol=1e-8, atol=1e-12)
