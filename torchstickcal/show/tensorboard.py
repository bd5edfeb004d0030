"""TensorBoard logs: of calibrations, and of trainings with the layer."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import torch
import torch.distributed as dist
from tensorboard.compat.proto.summary_pb2 import Summary  # pyright: ignore[reportAttributeAccessIssue]
from torch import Tensor
from torch.utils.tensorboard import SummaryWriter
from torch.utils.tensorboard.summary import hparams

from torchstickcal.errors import CalibrationError
from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.layer.result import LayerResult
from torchstickcal.metrics import pose_errors
from torchstickcal.observations import Observations
from torchstickcal.result import Calibration
from torchstickcal.show.pictures import keypoints_figure, residuals_figure
from torchstickcal.show.quality import meaning_of
from torchstickcal.show.report import table
from torchstickcal.show.rig import rig_figure
from torchstickcal.show.scene import mesh_view, scene_mesh
from torchstickcal.show.tables import length_spread_m, printable
from torchstickcal.solvers import IterationRecord

if TYPE_CHECKING:
    from numpy.typing import NDArray

_SCENE_FRAMES = 8
_FLUSH_SECONDS = 10


class TensorBoardMonitor:
    """Writes TensorBoard logs of calibrations, as a callback of :func:`torchstickcal.calibrate`, and of trainings.

    Every calibration, and every training, is a run of its own: a new folder ``calibration_001``, ``training_001`` and so on in
    ``log_dir``. View all of them with ``tensorboard --logdir LOG_DIR``. Of several processes only the first one writes.

    A calibration's log has, over all iterations of all stages: the losses, damping and step, the reprojection error of each
    camera, positions and rotations of the cameras, and the length of the stick. At the end come the standard deviations, the
    residuals as histograms and as a figure, a figure of the rig, the scene as a mesh, the table of results and the warnings as
    text, and the final metrics with what they were obtained from. The tab *Custom Scalars* has all cameras in one chart.

    Args:
        log_dir: folder of the logs. It is created if it does not exist.
        camera_names: names of the cameras in a training; None for their numbers. A calibration has names of its own.
        figures: whether to write figures and meshes. They take about half a second in all.

    Example:
        >>> import tempfile
        >>> from pathlib import Path
        >>> from torchstickcal import CalibrationLayer, TensorBoardMonitor, calibrate
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=5)
        >>> layer = CalibrationLayer(observations.sticks)
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     calibration = calibrate(observations, callback=TensorBoardMonitor(folder))
        ...     with TensorBoardMonitor(folder) as monitor:  # of a training
        ...         for step in range(2):
        ...             result = layer(observations.keypoints, observations.cameras)
        ...             monitor.layer(step, result, truth=truth)
        ...     sorted(path.name for path in Path(folder).iterdir())
        ['calibration_001', 'training_001']
    """

    def __init__(self, log_dir: str | Path, camera_names: Sequence[str] | None = None, figures: bool = True) -> None:
        self._log_dir, self._figures = Path(log_dir), figures
        self._camera_names = camera_names
        self._writes = not (dist.is_available() and dist.is_initialized() and dist.get_rank())
        self._calibration: _CalibrationLog | None = None
        self._training: SummaryWriter | None = None
        self._steps: dict[str, int] = {}

    def on_start(self, observations: Observations) -> None:
        """Begin the run of a calibration."""
        if self._writes:
            self._calibration = _CalibrationLog(_new_writer(self._log_dir, "calibration"), observations.camera_labels)

    def on_iteration(self, record: IterationRecord) -> None:
        """Write one iteration."""
        if self._writes:
            if self._calibration is None:
                names = [f"camera {number}" for number in range(len(record.reprojection_px))]
                self._calibration = _CalibrationLog(_new_writer(self._log_dir, "calibration"), names)
            self._calibration.iteration(record)

    def on_end(self, calibration: Calibration) -> None:
        """Write the result, and close the run of this calibration."""
        if self._calibration is not None:
            self._calibration.result(calibration, self._figures)
            self._calibration = None

    @property
    def writer(self) -> SummaryWriter | None:
        """What writes the run of a training, for values of your own; None on all processes but the first."""
        if self._training is None and self._writes:
            self._training = _new_writer(self._log_dir, "training")
        return self._training

    @torch.no_grad()
    def layer(
        self,
        step: int,
        result: LayerResult,
        *,
        truth: Any = None,
        keypoints: Tensor | None = None,
        confidence: Tensor | None = None,
        images: Tensor | None = None,
        every: int = 50,
        name: str = "train",
        fisheye: bool = False,
    ) -> None:
        """Write what the layer found in one step of a training.

        At every call: the share of sessions that could be calibrated, of keypoints that were used, the noise of the keypoints,
        and where the truth is known the errors of the cameras. At every 50th: the confidences and the residuals as histograms,
        and a picture of one session with keypoints and reprojections.

        Args:
            step: number of the step. It has to grow from call to call of one ``name``.
            result: of the layer, of one session or a batch.
            truth: true ``rotations`` (C, 3, 3) and ``translations`` (C, 3), or (B, C, ...), as attributes, such as those of a
                simulation, or as a pair.
            keypoints: as given to the layer.
            confidence: likewise.
            images: (..., C, F, 3, H, W) or (..., C, F, 1, H, W), 0 to 1 or bytes, the frames of the keypoints; for the picture.
            every: how often histograms and pictures are written, in calls.
            name: of what the step is part of, such as ``train`` or ``test``. Each has curves of its own.
            fisheye: whether the lenses are of the fisheye model.

        Raises:
            CalibrationError: if the step does not grow, or if keypoints, confidence or images do not fit the result.
        """
        writer = self.writer
        if writer is None:
            return
        calls = self._checked_step(step, name)
        result = result.detach().to("cpu")
        result = result if result.batched else result.each(lambda tensor: tensor[None])
        names = self._camera_names or [f"camera {number}" for number in range(result.rotations.shape[1])]
        seen = None if keypoints is None else _of_sessions("keypoints", keypoints, result, (*result.inliers.shape[1:], 2))
        scalars = _shares(result, seen) | (_camera_errors(result, truth, names) if truth is not None else {})
        _write_scalars(writer, {f"{name}{tag}": value for tag, value in scalars.items()}, step)
        if calls % every:
            return
        if confidence is not None:
            given = _of_sessions("confidence", confidence, result, tuple(result.inliers.shape[1:]))
            _write_histogram(writer, f"{name}/confidence", given[given > 0], step)
        if seen is None or not bool(result.converged.any()):
            return
        reprojections = _reprojections(result, fisheye)
        for camera, label in enumerate(names):
            sizes = (reprojections - seen)[:, camera].norm(dim=-1)[result.inliers[:, camera] & result.converged[:, None, None]]
            _write_histogram(writer, f"{name} residuals [px]/{_tag(label)}", sizes, step)
        if self._figures:
            session = int(result.converged.int().argmax())
            frame = int(result.inliers[session].sum((0, 2)).argmax())
            pictures = None if images is None else _pictures(images, result, session, frame)
            figure = keypoints_figure(
                seen[session, :, frame],
                reprojections[session, :, frame],
                result.inliers[session, :, frame],
                names,
                pictures,
                f"step {step}, session {session} of the batch, frame {frame}",
            )
            writer.add_figure(f"{name}/keypoints", figure, step)

    def close(self) -> None:
        """End the run of a training; the next call begins another."""
        if self._training is not None:
            self._training.close()
        self._training, self._steps = None, {}

    def __enter__(self) -> TensorBoardMonitor:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _checked_step(self, step: int, name: str) -> int:
        """How many calls of this name there were before.

        Raises:
            CalibrationError: if the step is not after all of them.
        """
        last = self._steps.get(name, -math.inf)
        if step <= last:
            raise CalibrationError(
                "two calls for one step, or steps that go back, would be drawn over each other",
                where=f"step of {name!r}",
                got=step,
                expected=f"more than {last}",
                remedy="Give each part of the training a name of its own (name='before', name='test'), or count on.",
            )
        self._steps[name] = step
        calls = self._steps.setdefault(f"calls of {name}", 0)
        self._steps[f"calls of {name}"] += 1
        return calls


class _CalibrationLog:
    """The run of one calibration."""

    def __init__(self, writer: SummaryWriter, camera_names: Sequence[str]) -> None:
        self._writer, self._names = writer, [_tag(name) for name in camera_names]
        self._step = 0
        self._stages: list[str] = []
        self._turns: list[NDArray[np.float64]] = []

    def iteration(self, record: IterationRecord) -> None:
        """Write one iteration."""
        if not self._stages or self._stages[-1] != record.stage:
            self._stages.append(record.stage)
        scalars = {
            "solver/cost": record.cost,
            "solver/damping": record.damping,
            "solver/step [m]": record.step_m,
            "solver/stage": len(self._stages),
            "stick/mean length [m]": record.stick_length_m,
        }
        scalars |= {f"loss/{name}": value for name, value in record.terms.items()}
        scalars |= {f"reprojection [px]/{name}": v for name, v in zip(self._names, record.reprojection_px, strict=True)}
        if record.rotations is not None and record.translations is not None:
            scalars |= self._poses(record.rotations, record.translations)
        _write_scalars(self._writer, scalars, self._step)
        self._step += 1

    def result(self, calibration: Calibration, figures: bool) -> None:
        """Write the result, and end the run."""
        writer, last = self._writer, max(0, self._step - 1)
        stds = zip(self._names, calibration.camera_std_m.tolist(), calibration.camera_std_deg.tolist(), strict=True)
        scalars = {}
        for name, std_m, std_deg in stds:
            scalars |= {f"standard deviation [m]/{name}": std_m, f"standard deviation [deg]/{name}": std_deg}
        _write_scalars(writer, scalars, last)
        sizes = calibration.residuals_px.norm(dim=-1)
        for name, used, found in zip(self._names, calibration.inliers, sizes, strict=True):
            _write_histogram(writer, f"residuals [px]/{name}", found[used], last)
        _write_histogram(writer, "stick/length in each frame [m]", calibration.stick_lengths_m, last)
        quality = calibration.quality
        sentence = f"\n{quality.acceptance.sentence}" if quality.acceptance is not None else ""
        verdict = f"verdict: {quality.verdict} ({meaning_of(quality.verdict)}){sentence}"
        writer.add_text("results", _code(f"{verdict}\n\n{table(calibration)}"))
        warnings = "\n".join(f"- {printable(warning)}" for warning in calibration.warnings)
        writer.add_text("warnings", f"{calibration.status}\n\n{warnings or 'No warnings.'}", last)
        self._write_metrics(calibration)
        writer.add_custom_scalars(self._charts())
        if figures:
            writer.add_figure("rig", rig_figure(calibration), last)
            writer.add_figure("residuals", residuals_figure(calibration), last)
            self._write_scene(calibration)
        writer.close()

    def _poses(self, rotations: Tensor, translations: Tensor) -> dict[str, float]:
        """Positions and rotation vectors of all cameras but the first, which is the world."""
        turns = [cv2.Rodrigues(rotation)[0][:, 0] for rotation in rotations.double().cpu().numpy()]
        before = self._turns or turns
        self._turns = [_nearest_turn(turn, previous) for turn, previous in zip(turns, before, strict=True)]
        centres = se3.camera_centres(rotations, translations).tolist()
        scalars: dict[str, float] = {}
        for name, centre, turn in list(zip(self._names, centres, self._turns, strict=True))[1:]:
            for axis, position, angle in zip("xyz", centre, np.degrees(turn).tolist(), strict=True):
                scalars[f"camera positions [m]/{name} {axis}"] = position
                scalars[f"camera rotations [deg]/{name} {axis}"] = angle
        return scalars

    def _charts(self) -> dict[str, dict[str, list[Any]]]:
        """Charts with several curves, for the tab Custom Scalars."""
        poses = {
            f"{name}: {what}": ["Multiline", [re.escape(f"{group}/{name}") + " [xyz]$"]]
            for name in self._names[1:]
            for what, group in (("position (m)", "camera positions [m]"), ("rotation (deg)", "camera rotations [deg]"))
        }
        everything = {
            "losses": ["Multiline", ["^loss/"]],
            "reprojection error of each camera (px)": ["Multiline", [r"^reprojection \[px\]/"]],
            "mean length of the stick (m)": ["Multiline", [r"^stick/mean length"]],
        }
        return {"Calibration": everything, "Cameras": poses}

    def _write_metrics(self, calibration: Calibration) -> None:
        """What the calibration was made of, and its final metrics, for the tab HParams."""
        cameras, frames, points = calibration.inliers.shape
        made_of = {
            "cameras": cameras,
            "frames": frames,
            "points": points,
            "sticks": len(calibration.sticks),
            "stages": ", ".join(dict.fromkeys(stage.name for stage in calibration.stages)),
            "refined": ", ".join(calibration.refined) or "nothing",
        }
        lengths = calibration.stick_lengths_m
        final = {
            "final/converged": float(calibration.converged),
            "final/warnings": float(len(calibration.warnings)),
            "final/reprojection, median [px]": float(calibration.reprojection_median_px.nanmedian()),
            "final/noise of the keypoints [px]": float(calibration.sigma_px.median()),
            "final/share of inliers": float(calibration.inliers.sum() / calibration.residuals_px.isfinite().all(-1).sum()),
            "final/largest standard deviation [m]": float(calibration.camera_std_m.max()),
            "final/largest standard deviation [deg]": float(calibration.camera_std_deg.max()),
            "final/standard deviation of the scale": float(calibration.scale_std),
            "final/spread of the stick's length [m]": length_spread_m(lengths) if lengths.numel() else 0.0,
            "final/time [s]": calibration.seconds["total"],
        }
        file = self._writer.file_writer
        assert file is not None
        for summary in hparams(made_of, final):
            file.add_summary(summary)
        _write_scalars(self._writer, final, 0)

    def _write_scene(self, calibration: Calibration) -> None:
        """The scene in some frames, with the frame as the step."""
        known = calibration.points.isfinite().all(-1).any(-1).nonzero()[:, 0]
        places = torch.linspace(0, len(known) - 1, min(_SCENE_FRAMES, len(known))).round().long()
        for frame in dict.fromkeys(known.cpu()[places].tolist()):
            mesh = scene_mesh(calibration, frame)
            self._writer.add_mesh(
                "scene", mesh.vertices[None], mesh.colours[None], mesh.faces[None], mesh_view(calibration), global_step=frame
            )


def _new_writer(log_dir: Path, kind: str) -> SummaryWriter:
    """A writer into a new folder, also where another process makes one at the same time."""
    log_dir.mkdir(parents=True, exist_ok=True)
    number = 1
    while True:
        try:
            (log_dir / f"{kind}_{number:03d}").mkdir()
        except FileExistsError:
            number += 1
        else:
            return SummaryWriter(str(log_dir / f"{kind}_{number:03d}"), flush_secs=_FLUSH_SECONDS)


def _write_scalars(writer: SummaryWriter, scalars: Mapping[str, float], step: int) -> None:
    """Many numbers at once, which costs little more than one."""
    file = writer.file_writer
    assert file is not None
    file.add_summary(Summary(value=[Summary.Value(tag=tag, simple_value=value) for tag, value in scalars.items()]), step)


def _write_histogram(writer: SummaryWriter, tag: str, values: Tensor, step: int) -> None:
    """The finite ones of some values; nothing if there are none."""
    known = values[values.isfinite()]
    if known.numel():
        writer.add_histogram(tag, known.detach().cpu().numpy(), step)


def _shares(result: LayerResult, seen: Tensor | None) -> dict[str, float]:
    """What can be said of any result."""
    scalars = {"/share of sessions calibrated": float(result.converged.double().mean())}
    good = result.converged
    if bool(good.any()):
        noise = result.sigma_px[good]
        scalars["/noise of the keypoints [px]"] = float(noise[noise > 0].median()) if bool((noise > 0).any()) else 0.0
        if seen is not None:
            given = seen[good].isfinite().all(-1)
            scalars["/share of inliers"] = float(result.inliers[good].sum() / given.sum().clamp(min=1))
    return scalars


def _camera_errors(result: LayerResult, truth: Any, names: Sequence[str]) -> dict[str, float]:
    """Errors of the cameras of the sessions that could be calibrated."""
    true = truth if isinstance(truth, tuple) else (truth.rotations, truth.translations)
    rotations, translations = (torch.as_tensor(value).detach().cpu().double() for value in true)
    good = result.converged
    if not bool(good.any()):
        return {}
    if rotations.ndim == 4:
        rotations, translations = rotations[good], translations[good]
    errors = pose_errors(result.rotations[good], result.translations[good], rotations, translations)
    position, angle = errors.translation_m, errors.rotation_deg
    scalars = {"/position error [m]": float(position.mean()), "/rotation error [deg]": float(angle.mean())}
    for camera, name in enumerate(names):
        scalars[f" position error [m]/{_tag(name)}"] = float(position[:, camera].mean())
        scalars[f" rotation error [deg]/{_tag(name)}"] = float(angle[:, camera].mean())
    return scalars


def _reprojections(result: LayerResult, fisheye: bool) -> Tensor:
    """Where the points appear, (B, C, F, P, 2), pixels; NaN where they are not known."""
    lens = result.distortion
    cameras = Intrinsics(result.intrinsics.double(), None if lens is None else lens.double(), fisheye)
    points = result.points.double().where(result.known[..., None], torch.nan)
    turned = torch.einsum("bcij,bfpj->bcfpi", result.rotations.double(), points)
    return cameras.project(turned + result.translations.double()[:, :, None, None])


def _of_sessions(what: str, values: Tensor, result: LayerResult, shape: tuple[int, ...]) -> Tensor:
    """What was given to the layer, with the batch dimension, on the CPU.

    Raises:
        CalibrationError: if it does not fit the result.
    """
    values = torch.as_tensor(values).detach().cpu()
    expected = (len(result), *shape)
    if values.shape not in (expected, shape) or (values.shape == shape and len(result) > 1):
        raise CalibrationError("does not fit the result", where=what, got=tuple(values.shape), expected=f"{expected}")
    return values.reshape(expected)


def _pictures(images: Tensor, result: LayerResult, session: int, frame: int) -> Tensor:
    """The images (C, 3, H, W) of all cameras in one frame.

    Raises:
        CalibrationError: if they do not fit the result.
    """
    cameras, frames = result.inliers.shape[1:3]
    of_one = (cameras, frames, *images.shape[-3:])
    if images.ndim < 5 or images.shape[-3] not in (1, 3) or images.shape not in (of_one, (len(result), *of_one)):
        expected = f"({len(result)}, {cameras}, {frames}, 3, height, width)"
        raise CalibrationError("images do not fit the result", where="images", got=tuple(images.shape), expected=expected)
    return (images[session] if images.ndim == 6 else images)[:, frame].cpu()


def _nearest_turn(turn: NDArray[np.float64], previous: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of all rotation vectors of one rotation, the one nearest to another: a curve of them does not jump at 180 degrees."""
    angle = float(np.linalg.norm(turn))
    if angle < 1e-9:
        return turn
    turns = round((float(turn @ previous) / angle - angle) / (2 * math.pi))
    return turn * (1 + 2 * math.pi * turns / angle)


def _tag(name: str) -> str:
    """A camera's name in a tag, where a slash would begin another level.

    TensorBoard draws no curve in the tab Custom Scalars for a tag with round brackets; therefore units are in square ones.
    """
    return printable(name).translate(str.maketrans("/()", "_[]"))


def _code(text: str) -> str:
    """A text whose columns stay aligned in Markdown."""
    return "\n".join(f"    {line}" for line in text.splitlines())
