"""From where the adjustment ended to a state with gradients by what was measured."""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.pipeline.adjustment import Adjustment
from torchstickcal.pipeline.noise import HeldNoise, NoiseLevels
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import rulers, scale_factors
from torchstickcal.pipeline.stage import StageResult
from torchstickcal.solvers.gradients import GradientMode, attach
from torchstickcal.solvers.linearised import Linearised
from torchstickcal.solvers.newton import minimum_near


def attach_gradients(ended: Adjustment, data: Measurements, run: Run, mode: GradientMode) -> State:
    """The state where the last stage ended, with gradients.

    It depends on the measurements through the last stage that estimated cameras and through those after it. Where no minimum is
    found that agrees with its own noise, the noise is held as it is. Sessions that have not converged have no gradients: these
    are defined at a minimum only, and elsewhere may be of any size.

    Args:
        ended: the sessions where their last stage ended.
        data: the same measurements, whose tensors may require gradients.
        run: what all steps share.
        mode: how the gradients are computed.
    """
    state = ended.state
    at_minima = run.settles and ended.measurements.pixels.dtype == torch.float64
    for number, result in enumerate(ended.results):
        held = HeldNoise(run.noise_of(result.stage), result.gates, result.inliers)
        fixed = None if result.stage.cameras == "free" else state if number else result.minimum
        levels = _levels(held, result, data, fixed if number else None)
        minimum, agrees = _minimum(held, data.detached(), result, fixed, levels, at_minima)
        state = attach(held, data, minimum, mode, fixed, levels)
        if levels is None and not bool(agrees.all()):
            minimum, _ = _minimum(held, data.detached(), result, fixed, result.noise, at_minimum=False)
            state = attach(held, data, minimum, mode, fixed, result.noise).replaced(agrees, state)
        if result.stage.rescale:
            kept = replace(data, confidence=data.confidence.where(result.inliers, 0.0))
            factors, _ = scale_factors(kept, state.points, rulers(kept, run.config))
            state = state.scaled(factors)
    elsewhere = torch.tensor([not all(record.stop.converged for record in records) for records in ended.records])
    return state.replaced(elsewhere.to(state.points.device), ended.state)


def _levels(held: HeldNoise, result: StageResult, data: Measurements, before: State | None) -> NoiseLevels | None:
    """The levels of the noise that a stage uses; None where they are those at its own minimum.

    Args:
        held: the noise of the stage.
        result: where the stage ended.
        data: the measurements.
        before: the state before the stage, with gradients; None where that is not known.
    """
    if not held.noise.estimated:
        return result.noise
    if result.stage.cameras == "free":
        return None
    return result.noise if before is None else held.levels(data, before)


@torch.no_grad()
def _minimum(
    held: HeldNoise,
    data: Measurements,
    result: StageResult,
    fixed: State | None,
    levels: NoiseLevels | None,
    at_minimum: bool,
) -> tuple[Linearised, Tensor]:
    """A stage's minimum, to rounding, and in which sessions it agrees with its levels: a gradient is as exact as that.

    Args:
        held: the noise of the stage.
        data: the measurements.
        result: where the stage ended.
        fixed: the state with its cameras, where they were held fixed.
        levels: of the noise; None where they are those at the minimum, and both have been found together.
        at_minimum: whether the stage has ended there.
    """
    start = result.minimum if fixed is None else replace(fixed, points=result.minimum.points)
    if levels is None and not at_minimum:
        found, _, converged = held.minimum_near(data, start)
        return found, converged
    objective = held.objective(data, result.noise if levels is None else levels)
    if at_minimum:
        return Linearised(objective, start, cameras_free=fixed is None), result.agrees
    return minimum_near(lambda _: objective, start, cameras_free=fixed is None)
