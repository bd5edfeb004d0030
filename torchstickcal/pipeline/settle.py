"""Stages taken to their minima up to rounding errors, and cameras and noise that agree."""

from __future__ import annotations

import time

import torch
from torch import Tensor

from torchstickcal.allocator import give_back_freed_memory
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import NEAR_SIGMAS, near_keypoints
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.noise import Chosen, HeldNoise, NoiseGates, NoiseLevels, StageNoise
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import rulers, scale_factors
from torchstickcal.pipeline.stage import StageResult
from torchstickcal.solvers.linearised import Linearised
from torchstickcal.solvers.newton import minimum_near


@torch.no_grad()
def settled(name: str, measurements: Measurements, result: StageResult, run: Run) -> tuple[StageResult, Tensor]:
    """A stage that estimated cameras, with the noise as it is found where the stage ends.

    A stage uses the noise that was found where it began. That is a little different from the noise where it ends. Here
    both are brought to agree, with the keypoints that take part and all other decisions held.

    Args:
        name: of the stage.
        measurements: the sessions.
        result: where the stage has ended, or nearly.
        run: what all steps share.

    Returns:
        The result, and in which sessions it was found, (B,). Others may be anywhere on the way.
    """
    began, noise, at = time.perf_counter(), run.noise_of(result.stage), result.minimum
    levels, gates = _decided(noise, measurements, result.inliers, at)
    if measurements.is_long:
        give_back_freed_memory()
    held = HeldNoise(noise, gates, result.inliers)
    found, levels, converged = held.minimum_near(measurements, at, run.to_rounding, levels)
    run.took(name, time.perf_counter() - began)
    return _with_minimum(result, found, run)._replace(noise=levels, gates=gates, agrees=converged), converged


def _decided(noise: StageNoise, measurements: Measurements, inliers: Tensor, at: State) -> tuple[NoiseLevels, NoiseGates]:
    """The noise at a state, and what is decided about it, by the keypoints that take part."""

    def near() -> Chosen:
        return Chosen(near_keypoints(measurements, measurements.squared_residuals(at)), NEAR_SIGMAS)

    kept = measurements.keeping(inliers)
    chosen = noise.chosen(kept, near)
    _, levels, gates = noise.decided(kept, at, chosen.sigma_px_at(measurements, at), chosen)
    return levels, gates


@torch.no_grad()
def polished(name: str, measurements: Measurements, result: StageResult, run: Run) -> tuple[StageResult, Tensor]:
    """A stage at its minimum, with the noise that it began with; otherwise as :func:`settled`."""
    began, free = time.perf_counter(), result.stage.cameras == "free"
    objective = Objective(measurements.keeping(result.inliers), result.losses)
    found, converged = minimum_near(lambda _: objective, result.minimum, free)
    run.took(name, time.perf_counter() - began)
    return _with_minimum(result, found, run), converged


def _with_minimum(result: StageResult, found: Linearised, run: Run) -> StageResult:
    """The result with another minimum, brought to scale where the stage does so."""
    state, m = found.state, found.objective.measurements
    if result.stage.rescale:
        factors, _ = scale_factors(m, state.points, rulers(m, run.config))
        state = state.scaled(factors)
    return result._replace(state=state, minimum=found.state, losses=found.objective.losses)
