"""Metric extrinsic calibration of multi-camera rigs from an athlete's keypoints and a stick of known length.

The way in is :func:`calibrate` on :class:`Observations` with a :class:`Stick`; docs/calibrate.md shows it in ten lines.
"""

from __future__ import annotations

from importlib import import_module
from importlib.metadata import version
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from torchstickcal.config import Config, config_names, load_config
    from torchstickcal.errors import CalibrationError, ConfigError, FileFormatError, ObservationError, RigError
    from torchstickcal.extrinsics import Extrinsics
    from torchstickcal.geometry.cameras import Intrinsics
    from torchstickcal.layer.layer import CalibrationLayer
    from torchstickcal.layer.result import LayerResult
    from torchstickcal.many import calibrate_many
    from torchstickcal.observations import Observations
    from torchstickcal.outputs import ResultFiles
    from torchstickcal.pipeline.calibrate import Callback, calibrate
    from torchstickcal.pipeline.triangulate import triangulate
    from torchstickcal.quality.check import check
    from torchstickcal.quality.finding import Finding, Severity
    from torchstickcal.quality.verdict import Quality, Verdict
    from torchstickcal.reconstruction import Reconstruction
    from torchstickcal.result import Calibration
    from torchstickcal.show.tensorboard import TensorBoardMonitor
    from torchstickcal.solvers.gradients import GaussNewton, GradientMode, Implicit, Unrolled
    from torchstickcal.stick import Stick

__version__ = version("torchstickcal")

_HOMES = {
    "Calibration": "result",
    "CalibrationError": "errors",
    "CalibrationLayer": "layer.layer",
    "Callback": "pipeline.calibrate",
    "Config": "config",
    "ConfigError": "errors",
    "Extrinsics": "extrinsics",
    "FileFormatError": "errors",
    "Finding": "quality.finding",
    "GaussNewton": "solvers.gradients",
    "GradientMode": "solvers.gradients",
    "Implicit": "solvers.gradients",
    "Intrinsics": "geometry.cameras",
    "LayerResult": "layer.result",
    "ObservationError": "errors",
    "Observations": "observations",
    "Reconstruction": "reconstruction",
    "ResultFiles": "outputs",
    "Quality": "quality.verdict",
    "RigError": "errors",
    "Severity": "quality.finding",
    "Stick": "stick",
    "TensorBoardMonitor": "show.tensorboard",
    "Unrolled": "solvers.gradients",
    "Verdict": "quality.verdict",
    "calibrate": "pipeline.calibrate",
    "check": "quality.check",
    "calibrate_many": "many",
    "config_names": "config",
    "load_config": "config",
    "triangulate": "pipeline.triangulate",
}
_SUBPACKAGES = {"analysis", "bridges", "io", "losses", "metrics", "simulate", "video"}

__all__ = [
    "Calibration",
    "CalibrationError",
    "CalibrationLayer",
    "Callback",
    "Config",
    "ConfigError",
    "Extrinsics",
    "FileFormatError",
    "Finding",
    "GaussNewton",
    "GradientMode",
    "Implicit",
    "Intrinsics",
    "LayerResult",
    "ObservationError",
    "Observations",
    "Quality",
    "Reconstruction",
    "ResultFiles",
    "RigError",
    "Severity",
    "Stick",
    "TensorBoardMonitor",
    "Unrolled",
    "Verdict",
    "calibrate",
    "calibrate_many",
    "check",
    "config_names",
    "load_config",
    "triangulate",
]


def __getattr__(name: str) -> Any:
    """Import a public name when it is first used, so that importing the package costs nothing."""
    if name in _SUBPACKAGES:
        return import_module(f"torchstickcal.{name}")
    if name not in _HOMES:
        raise AttributeError(f"module 'torchstickcal' has no attribute {name!r}")
    value = getattr(import_module(f"torchstickcal.{_HOMES[name]}"), name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, *_SUBPACKAGES])
