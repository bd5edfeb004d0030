"""From where the adjustment ended to a state with gradients by what was measured."""

from __future__ import annotations

from dataclasses import replace

import torch

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.pipeline.adjust import Adjustment
from torchstickcal.pipeline.run import Run
from torchstickcal.pipeline.scale import rulers, scale_factors
from torchstickcal.pipeline.stage import StageResult
from torchstickcal.solvers.gradients import GradientMode, attach
from torchstickcal.solvers.newton import polish


def attach_gradients(ended: Adjustment, data: Measurements, run: Run, mode: GradientMode) -> State:
    """The state where the last stage ended, with gradients.

    It depends on the measurements through the last stage that estimated cameras and through those after it. Sessions in which
    a stage has failed have no gradients.

    Args:
        ended: the sessions where their last stage ended.
        data: the same measurements, whose tensors may require gradients.
        run: what all steps share.
        mode: how the gradients are computed.
    """
    state = ended.state
    for number, result in enumerate(ended.results):
        kept = replace(data, confidence=data.confidence.where(result.inliers, 0.0))
        fixed = None if result.stage.cameras == "free" else state if number else result.minimum
        state = attach(Objective(kept, result.losses), _polished(kept, result, fixed), mode, fixed)
        if result.stage.rescale:
            factors, _ = scale_factors(kept, state.points, rulers(kept, run.config))
            state = state.scaled(factors)
    failed = torch.tensor([any(record.stop.failed for record in records) for records in ended.records])
    return state.replaced(failed.to(state.points.device), ended.state)


@torch.no_grad()
def _polished(measurements: Measurements, result: StageResult, fixed: State | None) -> State:
    """A stage's minimum, to rounding: a gradient is as exact as the minimum at which it is taken."""
    start = result.minimum if fixed is None else replace(fixed, points=result.minimum.points)
    return polish(Objective(measurements, result.losses), start, cameras_free=fixed is None)
