"""A calibration as a recording for the Rerun viewer: cameras, athlete and stick in space, keypoints in images, over time."""

from __future__ import annotations

from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor

from torchstickcal.errors import CalibrationError
from torchstickcal.files import atomic_path
from torchstickcal.result import Calibration
from torchstickcal.show.look import COLOURS, Colour, camera_colour
from torchstickcal.show.page.drawn import ASIDE, RELABELLED, SEEN, Drawing
from torchstickcal.show.skeleton import bones_of
from torchstickcal.show.space import frusta
from torchstickcal.show.tables import point_name, stick_name

_POINT_M, _STICK_M = 0.02, 0.012
"""Radii of what is drawn in space."""
_KEYPOINT_DOT, _PROJECTION_DOT = -3.5, -2.0
"""Radii of dots in images: negative ones are those of the window, so that dots are seen in images of any size."""
_BODY, _DOTS = 0, 1
"""Classes of points: those that are joined by bones, and those that are not."""
_KEYPOINTS = {SEEN: "used", ASIDE: "aside", RELABELLED: "relabelled"}
"""The names, also of the colours, of what became of a keypoint."""


def rerun_package() -> ModuleType:
    """The package of Rerun.

    Raises:
        CalibrationError: if it is not installed.
    """
    try:
        import rerun  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise CalibrationError(
            "a recording for Rerun needs the package rerun-sdk",
            where="--rrd",
            got="no such package",
            expected="rerun-sdk",
            remedy='Install it: pip install "torchstickcal[rerun]"',
        ) from error
    return rerun


def write_rerun(path: str | Path, calibration: Calibration) -> None:
    """Write a recording that ``rerun scene.rrd`` opens. It has two time lines: the frame, and the time where it is known.

    Args:
        path: of the file, which ends with ``.rrd``.
        calibration: what was found.

    Raises:
        CalibrationError: if the package ``rerun-sdk`` is not installed.
        OSError: if the file cannot be written.

    Example::

        from torchstickcal import Calibration
        from torchstickcal.show.rerun import write_rerun

        write_rerun("scene.rrd", Calibration.load("results/points.npz"))
    """
    rr = rerun_package()
    with atomic_path(path) as temporary:
        recording = rr.RecordingStream("torchstickcal", recording_id="torchstickcal", send_properties=False)
        recording.save(temporary)
        _Scene(rr, recording, calibration).write()
        recording.disconnect()


class _Scene:
    """What is written of one calibration.

    Args:
        rr: the package of Rerun.
        recording: where to.
        calibration: what was found.
    """

    def __init__(self, rr: Any, recording: Any, calibration: Calibration) -> None:
        self._rr, self._recording, self._calibration = rr, recording, calibration
        self._drawing = Drawing(calibration)
        self._frames = torch.arange(len(calibration.points))
        times = calibration.times
        self._index = [rr.TimeColumn("frame", sequence=self._frames.numpy())]
        if times is not None:
            self._index.append(rr.TimeColumn("time", duration=times.double().cpu().numpy()))

    def write(self) -> None:
        """Write everything."""
        rr, world = self._rr, self._calibration.world
        axes = rr.ViewCoordinates.RIGHT_HAND_Z_UP if world.up == "z" else rr.ViewCoordinates.RIGHT_HAND_Y_DOWN
        self._recording.log("world", axes, static=True)
        self._recording.log("world", self._skeleton(), static=True)
        self._athlete()
        self._sticks()
        self._cameras()
        self._keypoints()

    def _skeleton(self) -> Any:
        """The names of the points: with bones between them, as class 0, and alone, as class 1."""
        rr, c = self._rr, self._calibration
        names = [rr.AnnotationInfo(index, point_name(c, index)) for index in range(c.points.shape[1])]

        def described(number: int, name: str, bones: list[tuple[int, int]]) -> Any:
            info = rr.AnnotationInfo(number, name, COLOURS["body"].rgb)
            return rr.ClassDescription(info=info, keypoint_annotations=names, keypoint_connections=bones)

        return rr.AnnotationContext([described(_BODY, "athlete", bones_of(c.point_names)), described(_DOTS, "keypoints", [])])

    def _athlete(self) -> None:
        points = self._calibration.points.detach().double().cpu()
        known = points.isfinite().all(-1)
        columns = self._rr.Points3D.columns(positions=points[known].float().numpy(), **_labelled(known, _BODY))
        self._send("world/athlete", columns, known.sum(1))
        self._recording.log("world/athlete", self._rr.Points3D.from_fields(radii=_POINT_M, show_labels=False), static=True)

    def _sticks(self) -> None:
        points = self._calibration.points.detach().double().cpu()
        for number, stick in enumerate(self._calibration.sticks):
            ends = points[:, list(stick.ends)]
            known = ends.isfinite().all(-1).all(-1)
            path = self._path("world", "sticks", stick_name(self._calibration, number))
            self._send(path, self._rr.LineStrips3D.columns(strips=list(ends[known].float().numpy())), known.long())
            look = self._rr.LineStrips3D.from_fields(radii=_STICK_M, colors=[COLOURS["stick"].rgb])
            self._recording.log(path, look, static=True)

    def _cameras(self) -> None:
        rr, c = self._rr, self._calibration
        turns, centres = c.rotations.mT.double().cpu(), c.camera_centres.double().cpu()
        corners = frusta(c).cpu()
        for camera, name in enumerate(c.camera_names):
            pose = rr.Transform3D(translation=centres[camera].numpy(), mat3x3=turns[camera].numpy())
            depth = float(((corners[camera, 1:] - corners[camera, 0]) @ turns[camera][:, 2]).mean())
            lens = rr.Pinhole(
                image_from_camera=c.intrinsics[camera].double().cpu().numpy(),
                resolution=self._drawing.image_sizes[camera],
                camera_xyz=rr.ViewCoordinates.RDF,
                image_plane_distance=depth,
                color=camera_colour(camera).rgb,
            )
            self._recording.log(self._path("world", "cameras", name), pose, static=True)
            self._recording.log(self._image(name), lens, static=True)

    def _keypoints(self) -> None:
        """The keypoints of each image by what became of them, and the projections of the points."""
        drawing, c = self._drawing, self._calibration
        residuals = drawing.common(c.residuals_px.detach().double().cpu(), self._frames, torch.nan)
        codes = drawing.common(drawing.codes, self._frames, 0)
        projections = drawing.projections(self._frames)
        keypoints = projections - residuals
        for camera, name in enumerate(c.camera_names):
            seen = codes[camera] > 0
            self._dots(name, "projections", projections[camera], seen, _PROJECTION_DOT, COLOURS["reprojection"])
            for code, word in _KEYPOINTS.items():
                self._dots(name, word, keypoints[camera], codes[camera] == code, _KEYPOINT_DOT, COLOURS[word])

    def _dots(self, camera: str, word: str, places: Tensor, chosen: Tensor, radius: float, colour: Colour) -> None:
        """Dots of one kind (G, P, 2), where they are chosen (G, P), in the image of a camera; nothing where there are none."""
        chosen = chosen & places.isfinite().all(-1)
        if not bool(chosen.any()):
            return
        path = self._rr.new_entity_path([*self._parts(camera), word])
        columns = self._rr.Points2D.columns(positions=places[chosen].float().numpy(), **_labelled(chosen, _DOTS))
        self._send(path, columns, chosen.sum(1))
        look = self._rr.Points2D.from_fields(radii=radius, colors=[colour.rgb], show_labels=False)
        self._recording.log(path, look, static=True)

    def _image(self, camera: str) -> str:
        return self._path(*self._parts(camera))

    def _parts(self, camera: str) -> tuple[str, ...]:
        return "world", "cameras", camera, "image"

    def _path(self, *parts: str) -> str:
        return self._rr.new_entity_path(list(parts))

    def _send(self, path: str, columns: Any, counts: Tensor) -> None:
        """Columns that have some entries, by ``counts``, in each frame."""
        self._recording.send_columns(path, indexes=self._index, columns=columns.partition(counts.numpy()))


def _labelled(chosen: Tensor, kind: int) -> dict[str, Any]:
    """The numbers and the class of points (G, P) that are chosen."""
    numbers = chosen.nonzero()[:, 1].numpy()
    return {"keypoint_ids": numbers, "class_ids": np.full_like(numbers, kind)}
