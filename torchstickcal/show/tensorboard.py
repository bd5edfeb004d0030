"""Watching a calibration in TensorBoard."""

from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from torchstickcal.result import Calibration
from torchstickcal.show.report import table
from torchstickcal.show.rig import rig_figure
from torchstickcal.solvers import IterationRecord


class TensorBoardMonitor:
    """A callback of :func:`torchstickcal.calibrate` that writes what happens to a TensorBoard log.

    Per stage and iteration: the value of each loss, damping, step, reprojection of each camera and the sticks' mean length, on
    from where the stage ended if it runs again; at the end a figure of the rig and the summary table.

    Args:
        log_dir: folder of the log, made if need be.
    """

    def __init__(self, log_dir: str | Path) -> None:
        self._writer = SummaryWriter(str(log_dir))
        self._steps: dict[str, int] = {}

    def on_iteration(self, record: IterationRecord) -> None:
        """Write one iteration."""
        step = self._steps.setdefault(record.stage, 0)
        self._steps[record.stage] += 1
        stage = f"{list(self._steps).index(record.stage) + 1} {record.stage}"
        scalars = {"cost": record.cost, "damping": record.damping, "step_m": record.step_m}
        scalars |= {f"loss/{name}": value for name, value in record.terms.items()}
        scalars |= {f"reprojection_px/camera_{index}": value for index, value in enumerate(record.reprojection_px)}
        scalars |= {"stick_length_m": record.stick_length_m}
        for name, value in scalars.items():
            self._writer.add_scalar(f"{stage}/{name}", value, step)

    def on_end(self, calibration: Calibration) -> None:
        """Write the result and close the log."""
        self._writer.add_figure("rig", rig_figure(calibration))
        self._writer.add_text("summary", "\n".join(f"    {line}" for line in table(calibration).splitlines()))
        self._writer.close()
