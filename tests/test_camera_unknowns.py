"""Unknown lenses and clocks in the reduced system and in the objective's slope, against dense systems built by autograd."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from kornia.geometry.liegroup import Se3
from torch import Tensor

from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.losses import Cauchy, GemanMcClure, Loss, ReprojectionLoss, SmoothnessLoss, StickLengthLoss
from torchstickcal.losses.reprojection import reprojection_residuals
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import REFINEMENTS, ImageMotion, RigUnknowns
from torchstickcal.solvers.elimination.evaluated import Gradient
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

CHOICES = [(name,) for name in REFINEMENTS] + [
    ("focal", "radial", "time_offset"),
    ("focal_shared", "principal_point", "readout"),
]
LENSES = {
    "perfect": None,
    "rational": torch.tensor([-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.0], dtype=torch.float64),
    "fisheye": torch.tensor([0.02, -0.01, 0.003, 0.001], dtype=torch.float64),
}


def unknown_rig(
    measurements: Measurements, state: State, names: tuple[str, ...], lens: str, frames: int = 5
) -> tuple[Measurements, State]:
    """The first frames of a session with unknowns at values that are not zero, and invented motion in the image."""
    generator = torch.Generator().manual_seed(len(names))
    columns = slice(0, frames * measurements.points_per_frame)
    shape = measurements.confidence[..., columns].shape
    velocity = 10 * torch.randn(*shape[:2], 2, shape[2], generator=generator, dtype=torch.float64)
    row = torch.rand(shape, generator=generator, dtype=torch.float64)
    distortion = LENSES[lens]
    matrix = measurements.cameras.matrix
    cameras = Intrinsics(matrix, None if distortion is None else distortion.expand(*matrix.shape[:2], -1), lens == "fisheye")
    measurements = dataclasses.replace(
        measurements,
        pixels=measurements.pixels[..., columns].contiguous(),
        confidence=measurements.confidence[..., columns].contiguous(),
        frames=frames,
        cameras=cameras,
        unknowns=RigUnknowns.of(names, cameras, groups=[0, 0, 1, 1]),
    )
    reference = 0.2 * measurements.unknowns.prior_sigma
    measurements = dataclasses.replace(measurements, motion=ImageMotion(velocity, row, reference))
    values = 0.3 * measurements.unknowns.prior_sigma * torch.randn(1, measurements.unknowns.count, generator=generator)
    return measurements, dataclasses.replace(state, points=state.points[..., columns].contiguous(), unknowns=values)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("names", CHOICES, ids="-".join)
def test_step_is_that_of_the_full_system(disturbed: tuple[Measurements, State], names: tuple[str, ...], lens: str):
    m, state = unknown_rig(*disturbed, names, lens)
    unknowns = m.unknowns
    losses: dict[str, Loss] = {"reprojection": ReprojectionLoss(2.0, kernel=Cauchy(2.0)), "length": StickLengthLoss(0.01)}
    if lens == "perfect":
        losses["smoothness"] = SmoothnessLoss(0.05, weight=0.2)
    objective = Objective(m, losses)
    shape = (m.frames, m.points_per_frame, 3)
    confidence = m.by_frame(m.confidence)[0]
    active = m.by_frame(m.active)[0]

    def residuals(tangents: Tensor, values: Tensor, points: Tensor) -> Tensor:
        step = Se3.exp(tangents).matrix()
        rotations = torch.cat([state.rotations[0, :1], state.rotations[0, 1:] @ step[:, :3, :3]])
        moved = (state.rotations[0, 1:] @ step[:, :3, 3:])[..., 0] + state.translations[0, 1:]
        translations = torch.cat([state.translations[0, :1], moved])
        pixels = m.by_frame(unknowns.displaced(m.pixels, values, m.motion))[0].movedim(1, -1)
        keypoints = pixels.where(confidence[..., None] > 0, torch.nan)
        cameras = unknowns.applied(m.cameras, values)[0]
        points = points.view(shape)
        r = reprojection_residuals(points, rotations, translations, keypoints, cameras)
        whitened = r.detach().square().sum(-1) * confidence / 4
        r = r * (Cauchy(2.0).weight(whitened) * confidence).sqrt()[..., None] / 2
        ends = points[:, m.sticks]
        length = ((ends[:, :, 1] - ends[:, :, 0]).norm(dim=-1) - m.lengths_m[0]) * m.stick_active[0] / 0.01
        found = [r.flatten(), length.flatten(), (values / unknowns.prior_sigma).flatten()]
        if "smoothness" in losses:
            complete = (active[2:] & active[1:-1] & active[:-2])[..., None]
            found.append(((points[2:] - 2 * points[1:-1] + points[:-2]) * complete * 0.2**0.5 / 0.05).flatten())
        return torch.cat(found)

    at = torch.zeros(3, 6, dtype=torch.float64), state.unknowns, state.points[0].mT.reshape(shape)
    jacobians = torch.autograd.functional.jacobian(residuals, at)
    jacobian = torch.cat([j.flatten(1) for j in jacobians], dim=1)
    hessian, gradient = jacobian.mT @ jacobian, jacobian.mT @ residuals(*at)
    inactive = (~active).flatten().repeat_interleave(3).nonzero().flatten() + 18 + unknowns.count
    hessian[inactive, inactive] += 1.0
    damped = hessian + 1e-3 * torch.diag(hessian.diagonal())

    system = NormalEquations(objective, state, True, 1e-3)
    step = system.step()
    found = torch.cat([step.cameras.flatten(), step.unknowns.flatten(), step.points[0].mT.flatten()])
    torch.testing.assert_close(damped @ found, -gradient, rtol=0, atol=1e-9 * float(gradient.abs().max()))
    predicted = -2 * float(gradient @ found) - float(found @ hessian @ found)
    assert float(step.predicted_decrease) == pytest.approx(predicted, rel=1e-8)
    terms = objective.terms(state)
    assert float(system.cost) == pytest.approx(float(sum(terms.values())), rel=1e-12)

    alone, (count, tangents) = Gradient(objective, state, True), (unknowns.count, 18)
    assert float(alone.cost) == pytest.approx(float(system.cost), rel=1e-12)
    scale = 1e-9 * float(gradient[: tangents + count].abs().max())
    torch.testing.assert_close(alone.camera_gradient.flatten(), gradient[:tangents], rtol=1e-9, atol=scale)
    torch.testing.assert_close(alone.unknown_gradient[0], gradient[tangents : tangents + count], rtol=1e-9, atol=scale)


@pytest.mark.parametrize("lens", LENSES)
@pytest.mark.parametrize("names", CHOICES, ids="-".join)
def test_exact_hessian_and_slope_are_autograds(disturbed: tuple[Measurements, State], names: tuple[str, ...], lens: str):
    """At a state that is no minimum: all terms of the second derivative take part."""
    m, state = unknown_rig(*disturbed, names, lens, frames=2)
    losses: dict[str, Loss] = {"reprojection": ReprojectionLoss(9.0, 0.7, GemanMcClure(8.0)), "length": StickLengthLoss(0.1)}
    objective, count = Objective(m, losses), m.unknowns.count
    sizes = [18, count, state.points.numel()]

    def split(vector: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        cameras, unknowns, points = vector.split(sizes)
        return cameras.view(1, 3, 6), unknowns[None], points.view(1, -1, 3).mT

    def value(vector: Tensor, at: Tensor = state.unknowns) -> Tensor:
        cameras, unknowns, points = split(vector)
        step = Se3.exp(cameras[0]).matrix()
        turned = torch.cat([state.rotations[:, :1], state.rotations[:, 1:] @ step[None, :, :3, :3]], dim=1)
        moved = (state.rotations[:, 1:] @ step[None, :, :3, 3:])[..., 0] + state.translations[:, 1:]
        translations = torch.cat([state.translations[:, :1], moved], dim=1)
        terms = objective.terms(State(turned, translations, state.points + points, at + unknowns))
        return torch.stack(list(terms.values())).sum() / 2

    zero = torch.zeros(sum(sizes), dtype=torch.float64)
    hessian = torch.autograd.functional.hessian(value, zero, vectorize=True)
    inactive = (~m.active[0]).repeat_interleave(3).nonzero().flatten() + 18 + count
    hessian[inactive, inactive] += 1.0
    damping = 1.0  # makes it definite away from the minimum
    damped = hessian + damping * torch.diag(hessian.diagonal())
    rhs, direction = torch.randn(2, len(zero), generator=torch.Generator().manual_seed(0), dtype=torch.float64)

    *found, solved = NormalEquations(objective, state, True, damping, exact=True).solve(*split(rhs))
    assert bool(solved)
    together = torch.cat([found[0].flatten(), found[1].flatten(), found[2].mT.flatten()])
    torch.testing.assert_close(damped @ together, rhs, rtol=1e-8, atol=1e-8)

    cameras, unknowns, points = split(direction)
    slope = objective.slope(state, torch.nn.functional.pad(cameras, (0, 0, 1, 0)), points, unknowns)
    (gradient,) = torch.autograd.grad(value(zero.requires_grad_()), zero)
    assert float(slope) == pytest.approx(float(gradient @ direction), rel=1e-10)
