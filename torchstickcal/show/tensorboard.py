"""TensorBoard logs of a calibration."""

from __future__ import annotations

from pathlib import Path

from torch.utils.tensorboard import SummaryWriter

from torchstickcal.result import Calibration
from torchstickcal.show.report import table
from torchstickcal.show.rig import rig_figure
from torchstickcal.solvers import IterationRecord


class TensorBoardMonitor:
    """A callback of :func:`torchstickcal.calibrate` that writes a TensorBoard log.

    It logs for each stage and iteration: the cost and the value of each loss, the damping, the step, the reprojection error of
    each camera and the mean stick length. If a stage runs again, its curves continue. At the end it logs a figure of the rig
    and the summary table. View the log with ``tensorboard --logdir LOG_DIR``.

    Args:
        log_dir: folder of the log. It is created if it does not exist.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchstickcal import TensorBoardMonitor, calibrate
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=5)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     calibration = calibrate(observations, callback=TensorBoardMonitor(folder))
        ...     len(list(Path(folder).glob("events.out.tfevents.*")))
        1
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
        """Write the figure and the summary, and close the log."""
        self._writer.add_figure("rig", rig_figure(calibration))
        self._writer.add_text("summary", "\n".join(f"    {line}" for line in table(calibration).splitlines()))
        self._writer.close()
