"""The points of a long session whose cameras are held, window after window of its frames.

With known cameras nothing couples frames but smoothness, and that only over a short time: where its strength is estimated, what
a track does is felt by a factor of about 0.6 less from frame to frame. So the points of a window are found with some frames
before and after it, and no array is longer than a window.
"""

from __future__ import annotations

from dataclasses import replace

import torch

from torchstickcal.losses.camera_point import CameraPointSlopes
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.base import Listener, Outcome, Stop, Termination, ignore_record
from torchstickcal.solvers.elimination.evaluated import Evaluated
from torchstickcal.solvers.gauss_newton import gauss_newton
from torchstickcal.workers import map_with_idle_workers

_FRAMES, _MARGIN_FRAMES = 1000, 64
"""Frames of a window, and frames before and after it that are solved with it and not kept."""


def can_be_divided(objective: Objective) -> bool:
    """Whether a session is long, and all that couples its frames has an estimated strength, one for each of them.

    On a graphics card windows would be too small to be worth its launches.
    """
    m = objective.measurements
    on_cpu = m.pixels.device.type == "cpu"
    return m.is_long and on_cpu and all(loss.sigma.ndim >= 3 for loss in objective.track_losses.values())


def gauss_newton_by_windows(
    objective: Objective, state: State, *, termination: Termination, stage: str, listener: Listener
) -> Outcome:
    """Minimise an objective over the points of one session; arguments as of :func:`gauss_newton`.

    Its records are of the beginning and of the end.
    """
    frames = objective.measurements.frames
    points = torch.empty_like(state.points)

    def solve(start: int) -> tuple[Stop, int]:
        stop = min(start + _FRAMES, frames)
        around = slice(max(0, start - _MARGIN_FRAMES), min(stop + _MARGIN_FRAMES, frames))
        own = objective.within(around)
        columns, kept = objective.measurements.columns_of(around), objective.measurements.columns_of(slice(start, stop))
        found = gauss_newton(
            own,
            replace(state, points=state.points[..., columns]),
            cameras_free=False,
            termination=termination,
            stage=stage,
            listener=ignore_record,
        )
        first = kept.start - columns.start
        points[..., kept] = found.state.points[..., first : first + kept.stop - kept.start]
        return found.stops[0], found.iterations[0][-1].iteration

    ended = map_with_idle_workers(solve, range(0, frames, _FRAMES))
    found = replace(state, points=points)
    most = max(iterations for _, iterations in ended)
    records = [
        *_Value(objective, state).records(stage, [0], [0.0], [0.0]),
        *_Value(objective, found).records(stage, [most], [0.0], [float((points - state.points).abs().max())]),
    ]
    for record in records:
        listener(record)
    stops = [stop for stop, _ in ended]
    return Outcome(found, (next((stop for stop in stops if not stop.converged), stops[0]),), (tuple(records),))


class _Value(Evaluated):
    """The value of an objective, without derivatives."""

    def __init__(self, objective: Objective, state: State) -> None:
        super().__init__(objective, state, cameras_free=False)
        m = objective.measurements
        for name, terms in objective.linearise_frames(state).items():
            self.terms[name] = self.terms[name] + terms.cost
        for slopes in map_with_idle_workers(self._of_images, m.chunks()):
            for name, found in slopes.items():
                self._add_images(name, found)
        reach = max((len(loss.stencil) - 1 for loss in objective.track_losses.values()), default=0)
        for window in m.frame_slices() if reach else ():
            with_next = slice(window.start, min(window.stop + reach, m.frames))
            own = replace(state, points=state.points[..., m.columns_of(with_next)])
            for name, terms in objective.within(with_next).linearise_tracks(own).items():
                self.terms[name] = self.terms[name] + terms.cost
        self.reprojection_px = (self._squares / self._weights.clamp_min(1e-300)).sqrt()

    def _of_images(self, columns: slice) -> dict[str, CameraPointSlopes]:
        found = self.objective.slopes_of_chunk(self.state, columns)
        return {name: slopes._replace(gradient=self.state.points[..., :0]) for name, slopes in found.items()}
