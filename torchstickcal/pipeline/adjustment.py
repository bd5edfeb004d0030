"""Sessions on their way through a calibration: what was measured, and what has been estimated so far."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from dataclasses import dataclass, field, replace

import torch
from torch import Tensor

from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State
from torchstickcal.observations import Observations
from torchstickcal.pipeline.relabel import Labels
from torchstickcal.pipeline.stage import StageResult, agreeing_cameras
from torchstickcal.pipeline.synchronise import CommonFrames, Exposures, Support
from torchstickcal.solvers import StageRecord


@dataclass(frozen=True)
class Adjustment:
    """B sessions on their way: what was measured, and what has been estimated so far."""

    observations: tuple[Observations, ...]
    frames: tuple[CommonFrames, ...]
    """with the keypoints as given"""
    refined: tuple[str, ...]
    """what is estimated of the cameras beside their poses, of :data:`torchstickcal.model.unknowns.REFINEMENTS`"""
    seen: Measurements
    """the keypoints as detected, on the common frames, where they belong by the labels"""
    measurements: Measurements
    """the same keypoints, moved in the image to where they would be at the times of the common frames"""
    state: State
    labels: Labels
    """which given keypoint each point uses, on the common frames"""
    results: tuple[StageResult, ...] = ()
    """of the last stage that estimated cameras, and of those after it"""
    records: tuple[tuple[StageRecord, ...], ...] = ((),)
    """of every stage, for each session"""
    window: slice = field(default_factory=lambda: slice(None))
    """which of the common frames this is about"""

    @staticmethod
    def stack(sessions: Sequence[Adjustment]) -> Adjustment:
        """Sessions of one kind that have just begun or ended a stage, as one batch, without results."""
        return Adjustment(
            tuple(session.observations[0] for session in sessions),
            tuple(session.frames[0] for session in sessions),
            sessions[0].refined,
            Measurements.stack([session.seen for session in sessions]),
            Measurements.stack([session.measurements for session in sessions]),
            State.stack([session.state for session in sessions]),
            Labels.stack([session.labels for session in sessions]),
            records=((),) * len(sessions),
        )

    @property
    def kind(self) -> Hashable:
        """What sessions have in common that can be adjusted as one batch by one configuration."""
        m = self.measurements
        lens = m.cameras.distortion
        return (
            *(m.pixels.shape, m.pixels.dtype, m.pixels.device, m.frames, m.point_names),
            *(m.cameras.matrix.dtype, m.cameras.fisheye, None if lens is None else lens.shape),
            *(tuple(m.sticks.flatten().tolist()), tuple(m.stick_sigma_m.tolist())),
            *(self.refined, m.motion is None, self.asynchronous),
        )

    @property
    def exposures(self) -> Exposures:
        """When the keypoints were exposed."""
        sessions = enumerate(self.frames)
        labelled = [replace(f, observations=self.labels[n : n + 1].applied(f.observations)) for n, f in sessions]
        return Exposures.stack([Exposures.of(frames, self.window) for frames in labelled])

    @property
    def last_camera_stage(self) -> StageResult:
        """Where the last stage that estimated cameras ended."""
        return self.results[0]

    @property
    def last(self) -> StageResult:
        """Where the last stage ended."""
        return self.results[-1]

    @property
    def support(self) -> Support:
        """How well the points are known where the last stage ended."""
        return Support.of(self.kept, self.state, self.last.sigma_px)

    @property
    def kept(self) -> Measurements:
        """The measurements that took part to the end."""
        return self.measurements.keeping(self.last.inliers)

    @property
    def agreeing_cameras(self) -> Tensor:
        """(B, C), the cameras whose keypoints agree with those of the other cameras."""
        return agreeing_cameras(self.measurements, self.kept)

    @property
    def asynchronous(self) -> bool:
        """Whether keypoints of one common frame were, or may have been, exposed at different times."""
        return any(frames.apart for frames in self.frames) or self.seen.unknowns.clocked

    @property
    def converged(self) -> bool:
        """Whether every stage converged, in all sessions."""
        return all(record.stop.converged for records in self.records for record in records)

    def status(self, session: int) -> str:
        """``converged``, or which stages of a session did not and why."""
        failed = [f"{record.name}: {record.stop}" for record in self.records[session] if not record.stop.converged]
        return "; ".join(failed) or "converged"

    @property
    def remaining_offsets_frames(self) -> Tensor:
        """(C,), time offsets of one session's cameras beyond those by which their frames were chosen, as found, in frames."""
        found = self.seen.unknowns.by_name(self.state.unknowns).get("time_offset")
        return torch.zeros_like(self.frames[0].offsets_frames) if found is None else found[0, :, 0]

    @property
    def deviations(self) -> dict[str, Tensor]:
        """(C, n), what was found beyond the given values in one session, by the name of the unknown, in units of deviations."""
        found = {name: own[0] for name, own in self.seen.unknowns.by_name(self.state.unknowns).items()}
        if "time_offset" in found:
            found["time_offset"] = found["time_offset"] + self.frames[0].offsets_frames[:, None]
        return found

    def __getitem__(self, session: int) -> Adjustment:
        """One of the sessions that has just begun or ended a stage, without results."""
        one = slice(session, session + 1)
        return replace(
            self,
            observations=self.observations[one],
            frames=self.frames[one],
            seen=self.seen[one],
            measurements=self.measurements[one],
            state=self.state[one],
            labels=self.labels[one],
            results=(),
            records=((),),
        )

    def alone(self, session: int) -> Adjustment:
        """One of the sessions with its results and records."""
        sessions = len(self.records)
        return replace(
            self[session],
            results=tuple(result.of(session) for result in self.results),
            records=(tuple(record.of_one(sessions) for record in self.records[session]),),
        )

    def after(self, earlier: Adjustment) -> Adjustment:
        """With the results and records that the same session had before."""
        records = tuple((*before, *own) for before, own in zip(earlier.records, self.records, strict=True))
        return replace(self, results=(*earlier.results, *self.results), records=records)

    def replaced(self, where: Tensor, other: Adjustment) -> Adjustment:
        """The adjustment with the results of some sessions (B,), True where, taken from another of the same sessions."""
        taken = where.tolist()
        return replace(
            self,
            state=self.state.replaced(where, other.state),
            results=tuple(mine.replaced(where, theirs) for mine, theirs in zip(self.results, other.results, strict=True)),
            records=tuple(b if t else a for a, b, t in zip(self.records, other.records, taken, strict=True)),
        )

    def ended(self, result: StageResult) -> Adjustment:
        """After one more stage."""
        records = tuple((*before, record) for before, record in zip(self.records, result.records, strict=True))
        earlier = self.results if result.stage.cameras == "held" and self.results else ()
        return replace(self, state=result.state, results=(*earlier, result), records=records)

    def within(self, most_frames: int) -> Adjustment:
        """The middle of sessions that are longer."""
        total = self.measurements.frames
        if total <= most_frames:
            return self
        start = (total - most_frames) // 2
        window = slice(start, start + most_frames)
        columns = self.measurements.columns_of(window)

        def cut(state: State) -> State:
            return replace(state, points=state.points[..., columns])

        return replace(
            self,
            seen=self.seen.within(window),
            measurements=self.measurements.within(window),
            state=cut(self.state),
            results=tuple(
                r._replace(state=cut(r.state), minimum=cut(r.minimum), inliers=r.inliers[..., columns]) for r in self.results
            ),
            window=window,
        )


@dataclass(frozen=True)
class WarmStart:
    """An earlier estimate of one session to start from."""

    rotations: Tensor
    """(C, 3, 3), world to camera"""
    translations: Tensor
    """(C, 3), metres"""
    points: Tensor | None
    """(F, P, 3), metres, NaN where not known; None if none is known"""
    unknowns: Tensor
    """(K,), of the cameras"""
    inliers: Tensor | None
    """(C, F, P), None for all keypoints"""
    sigma_px: Tensor
    """(P,)"""
