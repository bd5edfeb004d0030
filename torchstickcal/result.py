"""The result of a calibration: everything found, how it was found, and how far to trust it."""

from __future__ import annotations

import dataclasses
import json
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchstickcal import se3
from torchstickcal.errors import FileFormatError
from torchstickcal.files import atomic_path
from torchstickcal.observations import Stick
from torchstickcal.solvers import IterationRecord, Stop
from torchstickcal.stages import StageRecord

_FORMAT = "torchstickcal calibration 1"
_TENSORS = (
    "rotations",
    "translations",
    "points",
    "residuals_px",
    "inliers",
    "stick_lengths_m",
    "sigma_px",
    "intrinsics",
)
_OPTIONAL_TENSORS = ("distortion", "image_size")


@dataclass(frozen=True, eq=False)
class Calibration:
    """A calibrated rig and the scene it saw, in metres, in the frame of the first camera.

    Floating-point tensors have the dtype and device of the keypoints they were found from.
    """

    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), world to camera, metres"""
    points: Tensor
    """(F, P, 3), metres; NaN where fewer than two cameras saw the point"""
    residuals_px: Tensor
    """(C, F, P, 2), projection minus keypoint, pixels, of inliers and outliers; NaN where not seen or the point not known"""
    inliers: Tensor
    """(C, F, P), True where a keypoint took part to the end: seen by a second camera too, and agreeing with the others"""
    stick_lengths_m: Tensor
    """(F, S), reconstructed lengths; NaN where an end is not known"""
    sigma_px: Tensor
    """(P,), estimated noise of each point's keypoints along an axis, pixels"""
    intrinsics: Tensor
    """(C, 3, 3)"""
    distortion: Tensor | None
    """(C, D), OpenCV's order"""
    image_size: Tensor | None
    """(C, 2), width and height, pixels"""
    fisheye: bool
    sticks: tuple[Stick, ...]
    fps: float | None
    point_names: tuple[str, ...] | None
    camera_names: tuple[str, ...]
    stages: tuple[StageRecord, ...]
    seconds: dict[str, float]
    """time of the initialisation, of each stage and in total"""
    warnings: tuple[str, ...]
    """what a careful user should know"""

    @property
    def converged(self) -> bool:
        """Whether every stage converged."""
        return all(stage.stop.converged for stage in self.stages)

    @property
    def status(self) -> str:
        """``converged``, or which stage did not and why."""
        failed = [f"{stage.name}: {stage.stop}" for stage in self.stages if not stage.stop.converged]
        return "; ".join(failed) or "converged"

    @property
    def iterations(self) -> tuple[IterationRecord, ...]:
        """The records of all iterations of all stages."""
        return tuple(record for stage in self.stages for record in stage.iterations)

    @property
    def camera_centres(self) -> Tensor:
        """(C, 3), metres."""
        return se3.camera_centres(self.rotations, self.translations) + 0.0

    @property
    def reprojection_rms_px(self) -> Tensor:
        """(C,), root mean square over the inliers of each camera of the residuals' lengths, pixels."""
        return self._inlier_distances().square().nanmean(1).sqrt()

    @property
    def reprojection_median_px(self) -> Tensor:
        """(C,), median over the inliers of each camera of the residuals' lengths, pixels."""
        return self._inlier_distances().nanmedian(1).values

    def _inlier_distances(self) -> Tensor:
        return self.residuals_px.norm(dim=-1).where(self.inliers, torch.nan).flatten(1)

    def save(self, path: str | Path) -> None:
        """Write everything to one ``.npz`` file."""
        tensors = {name: getattr(self, name) for name in (*_TENSORS, *_OPTIONAL_TENSORS)}
        arrays = {name: tensor.detach().cpu().numpy() for name, tensor in tensors.items() if tensor is not None}
        meta = {
            "format": _FORMAT,
            "fisheye": self.fisheye,
            "sticks": [dataclasses.astuple(stick) for stick in self.sticks],
            "fps": self.fps,
            "point_names": self.point_names,
            "camera_names": self.camera_names,
            "stages": [dataclasses.asdict(stage) | {"stop": stage.stop.name} for stage in self.stages],
            "seconds": self.seconds,
            "warnings": self.warnings,
        }
        with atomic_path(path) as temporary, temporary.open("wb") as file:
            np.savez_compressed(file, meta=np.array(json.dumps(meta)), **arrays)

    @staticmethod
    def load(path: str | Path) -> Calibration:
        """Read what :meth:`save` wrote.

        Raises:
            FileFormatError: if the file is not such a file, or damaged.
        """
        try:
            with np.load(path, allow_pickle=False) as file:
                arrays = {name: torch.from_numpy(file[name]) for name in file.files if name != "meta"}
                meta: dict[str, Any] = json.loads(str(file["meta"]))
            if meta.pop("format") != _FORMAT:
                raise KeyError("format")
            return Calibration(
                **{name: arrays[name] for name in _TENSORS},
                distortion=arrays.get("distortion"),
                image_size=arrays.get("image_size"),
                fisheye=meta["fisheye"],
                sticks=tuple(Stick(*stick) for stick in meta["sticks"]),
                fps=meta["fps"],
                point_names=None if meta["point_names"] is None else tuple(meta["point_names"]),
                camera_names=tuple(meta["camera_names"]),
                stages=tuple(_stage_record(stage) for stage in meta["stages"]),
                seconds=meta["seconds"],
                warnings=tuple(meta["warnings"]),
            )
        except (KeyError, TypeError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise FileFormatError(
                "not a saved calibration", where=str(path), got=repr(error), expected="a file written by Calibration.save"
            ) from error


def _stage_record(stage: dict[str, Any]) -> StageRecord:
    iterations = tuple(
        IterationRecord(**record | {"reprojection_px": tuple(record["reprojection_px"])}) for record in stage["iterations"]
    )
    return StageRecord(stage["name"], Stop[stage["stop"]], stage["seconds"], iterations)
