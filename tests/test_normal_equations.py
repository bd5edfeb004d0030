"""The reduced system against a dense solve of the full normal equations, built by autograd."""

from __future__ import annotations

import pytest
import torch
from kornia.geometry.liegroup import Se3

from torchstickcal.losses import Cauchy, Loss, ReprojectionLoss, SmoothnessLoss, StickLengthLoss, second_differences
from torchstickcal.losses.reprojection import reprojection_residuals
from torchstickcal.objective import Objective
from torchstickcal.problem import Measurements, State
from torchstickcal.solvers.normal_equations import linearise

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
    """Hessian and gradient of the weighted residuals by all unknowns (cameras but the first, then points), and the cost."""
    m = objective.measurements
    shape = (m.frames, m.points_per_frame, 3)
    tangents = torch.zeros(len(state.rotations) - 1, 6, dtype=torch.float64)
    confidence = m.by_frame(m.confidence)
    keypoints = m.by_frame(m.pixels).movedim(1, -1).where(confidence[..., None] > 0, torch.nan)
    active = m.by_frame(m.active)

    def residuals(tangents: torch.Tensor, points: torch.Tensor) -> list[torch.Tensor]:
        step = Se3.exp(tangents).matrix()
        rotations = torch.cat([state.rotations[:1], state.rotations[1:] @ step[:, :3, :3]])
        moved = (state.rotations[1:] @ step[:, :3, 3:])[..., 0] + state.translations[1:]
        translations = torch.cat([state.translations[:1], moved])
        points = points.view(shape)
        found: list[torch.Tensor] = []
        for loss in objective.losses.values():
            scale = (loss.weight**0.5) / loss.sigma
            if isinstance(loss, ReprojectionLoss):
                r = reprojection_residuals(points, rotations, translations, keypoints, m.cameras)
                whitened = r.detach().square().sum(-1) * confidence / loss.sigma**2
                r = r * (loss.kernel.weight(whitened) * confidence).sqrt()[..., None]
            elif isinstance(loss, StickLengthLoss):
                ends = points[:, m.pairs]
                r = ((ends[:, :, 1] - ends[:, :, 0]).norm(dim=-1) - m.lengths_m) * m.pair_active
            else:
                complete = active[2:] & active[1:-1] & active[:-2]
                r = second_differences(points) * complete[..., None]
            found.append((r * scale).flatten())
        return found

    arguments = (tangents, state.points.mT.flatten())
    terms = objective.terms(state.rotations, state.translations, state.points.mT.reshape(shape))
    cost = float(sum(terms.values()))
    jacobians = torch.autograd.functional.jacobian(lambda *x: torch.cat(residuals(*x)), arguments)
    jacobian = torch.cat([j.flatten(1) for j in jacobians], dim=1)
    residual = torch.cat(residuals(*arguments))
    return (jacobian.mT @ jacobian).detach(), (jacobian.mT @ residual).detach(), cost


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
@pytest.mark.parametrize("damping", [0.0, 1e-3])
def test_step_is_that_of_the_full_system(disturbed: tuple[Measurements, State], losses: dict[str, Loss], damping: float):
    measurements, state = disturbed
    frames, points = 6, measurements.points_per_frame
    columns = slice(0, frames * points)
    measurements = Measurements(
        measurements.pixels[:, :, columns].contiguous(),
        measurements.confidence[:, columns].contiguous(),
        measurements.cameras,
        frames,
        measurements.pairs,
        measurements.lengths_m,
    )
    state = State(state.rotations, state.translations, state.points[:, columns].contiguous())
    objective = Objective(measurements, losses)
    hessian, gradient, cost = dense_system(objective, state)
    inactive = (~measurements.active).repeat_interleave(3).nonzero().flatten() + 6 * (len(state.rotations) - 1)
    hessian[inactive, inactive] += 1.0
    if "length" not in losses:
        damping = max(damping, 1e-6)  # the scale is open without a length
    damped = hessian + damping * torch.diag(hessian.diagonal())

    system = linearise(objective, state, cameras_free=True)
    step = system.step(damping)
    assert step is not None
    found = torch.cat([step.cameras.flatten(), step.points.mT.flatten()])
    expected = -torch.linalg.solve(damped, gradient)
    torch.testing.assert_close(damped @ found, -gradient, rtol=0, atol=1e-10 * float(gradient.abs().max()))
    torch.testing.assert_close(found, expected, rtol=1e-6, atol=1e-10 * float(expected.abs().max()) / max(damping, 1e-4))
    predicted = -2 * float(gradient @ expected) - float(expected @ hessian @ expected)
    assert step.predicted_decrease == pytest.approx(predicted, rel=1e-8)
    assert system.cost == pytest.approx(cost, rel=1e-13)

    cameras = 6 * (len(state.rotations) - 1)
    h_cc, h_cx, h_xx = damped[:cameras, :cameras], damped[:cameras, cameras:], damped[cameras:, cameras:]
    reduced = h_cc - h_cx @ torch.linalg.solve(h_xx, h_cx.mT)
    torch.testing.assert_close(system.reduced_system(damping)[0], reduced, rtol=1e-8, atol=1e-10 * float(reduced.abs().max()))


@pytest.mark.parametrize("losses", LOSSES.values(), ids=LOSSES.keys())
def test_linearised_cost_and_gradient_are_autograds(disturbed: tuple[Measurements, State], losses: dict[str, Loss]):
    measurements, state = disturbed
    objective = Objective(measurements, losses)
    points = measurements.by_frame(state.points).movedim(0, -1).clone().requires_grad_()
    terms = objective.terms(state.rotations, state.translations, points)
    system = linearise(objective, state, cameras_free=True)
    for name, value in terms.items():
        assert system.terms[name] == pytest.approx(float(value.detach()), rel=1e-12)
    (gradient,) = torch.autograd.grad(torch.stack(list(terms.values())).sum(), points)
    found = 2 * measurements.by_frame(system.point_gradient).movedim(0, -1)
    torch.testing.assert_close(found, gradient, rtol=1e-9, atol=1e-9 * float(gradient.abs().max()))


def test_chunks_of_frames_add_up(disturbed: tuple[Measurements, State], monkeypatch: pytest.MonkeyPatch):
    measurements, state = disturbed
    objective = Objective(measurements, LOSSES["with sticks"])
    whole = linearise(objective, state, cameras_free=True).step(1e-6)
    monkeypatch.setattr("torchstickcal.problem._CHUNK_KEYPOINTS", 200)
    monkeypatch.setattr("torchstickcal.solvers.point_elimination._PART_KEYPOINTS", 200)
    monkeypatch.setattr("torchstickcal.solvers.normal_equations._ELIMINATED_COLUMNS", 130)
    assert len(measurements.chunks()) > 10
    parts = linearise(objective, state, cameras_free=True).step(1e-6)
    assert whole is not None
    assert parts is not None
    torch.testing.assert_close(parts.cameras, whole.cameras, rtol=1e-9, atol=1e-12)
    torch.testing.assert_close(parts.points, whole.points, rtol=1e-9, atol=1e-12)
