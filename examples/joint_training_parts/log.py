"""What TensorBoard shows of a training end to end."""

from __future__ import annotations

from torch import Tensor

from joint_training_parts.comparison import Watch
from joint_training_parts.detections import Detections
from torchstickcal import LayerResult, TensorBoardMonitor


def watched_by(monitor: TensorBoardMonitor | None, seed: int) -> Watch | None:
    """What writes each step of a training: the loss, and the errors of the cameras; None without a monitor."""
    if monitor is None:
        return None

    def watch(method: str, step: int, loss: Tensor, batch: Detections, confidence: Tensor, result: LayerResult) -> None:
        name = f"{method}, seed {seed}"
        if monitor.writer:
            monitor.writer.add_scalar(f"loss/{name}", loss.item(), step)
        truth = (batch.rotations, batch.translations)
        monitor.layer(step, result, truth=truth, keypoints=batch.keypoints, confidence=confidence, name=name)

    return watch
