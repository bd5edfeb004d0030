"""How large the errors are that a stage uses, and its losses with them.

Both depend on the state at which the errors are looked at. What is decided on the way, which keypoints take part and which
correlations are real, is held as a :class:`NoiseGates`, so that the rest is a smooth function of state and measurements.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import torch
from torch import Tensor

from torchstickcal.config import Config, Stage
from torchstickcal.errors import ConfigError
from torchstickcal.lazy import cached_property
from torchstickcal.losses import Loss, LossContext, LossSettings, TrackLoss
from torchstickcal.model.correlation import CorrelationGates, ErrorCorrelation, error_correlation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.noise import estimate_acceleration_m, frames_looked_at, sigma_px_of
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.shapes import extended
from torchstickcal.solvers.following import minimum_with_points_following
from torchstickcal.solvers.linearised import Linearised
from torchstickcal.solvers.newton import minimum_near

_ESTIMATED, _SIGMA_PX = "estimated", "sigma_px"
_CONTRAST = 1.0
"""Variance between points, of the logarithm of the errors that last, in their weights. A stick's ends are often tracked better
than joints, which are many: seen as one group, they would look like them."""


class NoiseLevels(NamedTuple):
    """How large the errors are, for each point."""

    sigma_px: Tensor
    """(B, P), estimated standard deviation of the keypoints along an image axis, pixels"""
    correlation_frames: Tensor
    """(B, P), as many keypoints count as one, because their errors are alike"""
    acceleration_m: Tensor
    """(B, F - 2, P), standard deviation of the second difference over frames that counts as usual, metres; (B, P) and infinite
    where no loss needs it"""

    def of(self, sessions: slice) -> NoiseLevels:
        """The levels of some of the sessions."""
        return NoiseLevels(*(level[sessions] for level in self))

    def replaced(self, where: Tensor, other: NoiseLevels) -> NoiseLevels:
        """The levels with some sessions (B,), True where, taken from another."""
        pairs = zip(self, other, strict=True)
        return NoiseLevels(*(torch.where(extended(where, new.ndim), new, old) for old, new in pairs))


@dataclass(frozen=True)
class Chosen:
    """Keypoints from which their noise is estimated.

    Args:
        mask: (B, C, N).
        cut: residual, in standard deviations, up to which they were chosen.
    """

    mask: Tensor
    cut: float

    def sigma_px(self, given: Measurements, squared_residuals: Tensor) -> Tensor:
        """The standard deviation of the keypoints, (B, P), pixels; arguments as of :func:`sigma_px_of`."""
        return sigma_px_of(given, squared_residuals, self.mask, self.cut)

    def sigma_px_at(self, given: Measurements, state: State) -> Tensor:
        """The same at a state: only the frames that are looked at are computed."""
        frames = frames_looked_at(given)
        if len(frames) == given.frames:
            return self.sigma_px(given, given.squared_residuals(state))
        columns, some = given.columns_of(frames), given.within(frames)
        squared_residuals = some.squared_residuals(replace(state, points=state.points[..., columns]))
        return sigma_px_of(some, squared_residuals, self.mask[..., columns], self.cut)


@dataclass(frozen=True)
class NoiseGates:
    """What was decided when the noise was estimated."""

    chosen: Chosen
    """the keypoints from which the noise is estimated"""
    correlation: CorrelationGates | None
    """None where no loss asks for how long errors last"""

    def of(self, sessions: slice) -> NoiseGates:
        """The decisions about some of the sessions."""
        chosen = replace(self.chosen, mask=self.chosen.mask[sessions])
        return NoiseGates(chosen, None if self.correlation is None else self.correlation.of(sessions))

    def replaced(self, where: Tensor, other: NoiseGates) -> NoiseGates:
        """The decisions with some sessions (B,), True where, taken from another."""
        mine, theirs = self.correlation, other.correlation
        correlation = None if mine is None or theirs is None else mine.replaced(where, theirs)
        mask = torch.where(where[:, None, None], other.chosen.mask, self.chosen.mask)
        return NoiseGates(Chosen(mask, other.chosen.cut), correlation)


@dataclass(frozen=True)
class StageNoise:
    """The noise that a stage of a configuration uses.

    Args:
        stage: the stage.
        given_sigma_px: standard deviation of the keypoints along an image axis, (P,) or (), pixels; None to estimate it.
    """

    stage: Stage
    given_sigma_px: Tensor | None

    @property
    def estimated(self) -> bool:
        """Whether a loss of the stage takes something from the data."""
        wanted = [name for loss in self.stage.losses.values() for name, value in vars(loss).items() if value == _ESTIMATED]
        return any(name != _SIGMA_PX or self.given_sigma_px is None for name in wanted)

    @property
    def has_track_losses(self) -> bool:
        """Whether a loss of the stage couples consecutive frames."""
        return any(map(_is_track, self.stage.losses.items()))

    def chosen(self, kept: Measurements, near: Callable[[], Chosen]) -> Chosen:
        """From which keypoints the noise is estimated once no more are rejected: those that take part in the stage.

        While it is not yet known which keypoints are wrong, a narrow cut keeps them from raising the estimate. Afterwards a
        wide one is better: a keypoint that crosses the cut is a jump, and few keypoints are near a wide one.

        Args:
            kept: the keypoints that take part in the stage.
            near: gives those that a narrow cut leaves.
        """
        rejects = self.stage.reject_sigmas
        return near() if rejects is None else Chosen(kept.visible, rejects)

    def decided(
        self, kept: Measurements, state: State, sigma_px: Tensor, chosen: Chosen, times: Tensor | None = None
    ) -> tuple[dict[str, Loss], NoiseLevels, NoiseGates]:
        """The stage's losses at a state, their noise, and what was decided about it.

        Args:
            kept: the keypoints that take part in the stage.
            state: where the errors are looked at.
            sigma_px: the standard deviation of the keypoints there, (B, P), pixels.
            chosen: the keypoints from which it was estimated.
            times: (B, P), as many keypoints of each point as count as one where the stage estimates that; NaN where it is to be
                estimated, None for all.
        """
        found = _Levels(kept, state, sigma_px, times=times)
        losses = self._losses(kept, found.sigma_px, found.correlation_frames, found.acceleration_m)
        return losses, found.levels, NoiseGates(chosen, found.gates)

    def levels(self, given: Measurements, kept: Measurements, state: State, gates: NoiseGates) -> NoiseLevels:
        """The noise at a state with all decisions held; differentiable by state and measurements.

        Args:
            given: all keypoints.
            kept: those that take part in the stage.
            state: where the errors are looked at.
            gates: what was decided.
        """
        found = _Levels(kept, state, gates.chosen.sigma_px_at(given, state), gates)
        self._losses(kept, found.sigma_px, found.correlation_frames, found.acceleration_m)
        return found.levels

    def losses(self, kept: Measurements, levels: NoiseLevels) -> dict[str, Loss]:
        """The stage's losses with some noise; differentiable by it."""

        def correlation_frames(given: float | str) -> Tensor:
            return (
                levels.correlation_frames if given == _ESTIMATED else torch.full_like(levels.correlation_frames, float(given))
            )

        return self._losses(kept, levels.sigma_px, correlation_frames, lambda _: levels.acceleration_m)

    def _losses(
        self,
        kept: Measurements,
        sigma_px: Tensor,
        correlation_frames: Callable[[float | str], Tensor],
        acceleration_m: Callable[[dict[str, Loss]], Tensor],
    ) -> dict[str, Loss]:
        """The losses. Track losses come last: their sigma may be estimated with the others at hand."""
        losses: dict[str, Loss] = {}
        used_px = sigma_px if self.given_sigma_px is None else self.given_sigma_px.to(sigma_px).expand_as(sigma_px)
        context = LossContext(kept.point_index, kept.stick_sigma_m, used_px, correlation_frames, lambda: acceleration_m(losses))
        for name, settings in sorted(self.stage.losses.items(), key=_is_track):
            losses[name] = settings.build(context)
        return losses


@dataclass(frozen=True)
class HeldNoise:
    """The noise of a stage and its objective as functions of state and measurements, with all decisions held.

    Args:
        noise: of the stage.
        gates: what was decided about it.
        inliers: (B, C, N), the keypoints that take part in the stage.
    """

    noise: StageNoise
    gates: NoiseGates
    inliers: Tensor

    def levels(self, measurements: Measurements, state: State) -> NoiseLevels:
        """The levels at a state."""
        return self.noise.levels(measurements, self._kept(measurements), state, self.gates)

    def objective(self, measurements: Measurements, levels: Sequence[Tensor]) -> Objective:
        """The stage's objective with some levels."""
        kept = self._kept(measurements)
        return Objective(kept, self.noise.losses(kept, NoiseLevels(*levels)))

    def minimum_near(
        self, measurements: Measurements, state: State, to_rounding: bool = True, levels: NoiseLevels | None = None
    ) -> tuple[Linearised, NoiseLevels, Tensor]:
        """The minimum whose own noise the objective uses, near a state.

        Args:
            measurements: the sessions.
            state: where to begin.
            to_rounding: whether to go on up to rounding errors.
            levels: those at the state, where they are known.

        Returns:
            The objective at the minimum, the levels there, and in which sessions they were found, (B,).
        """
        kept, found = self._kept(measurements), list[NoiseLevels]()

        def objective_at(at: State) -> Objective:
            known = levels if at is state else None
            found[:] = [self.noise.levels(measurements, kept, at, self.gates) if known is None else known]
            return Objective(kept, self.noise.losses(kept, found[0]))

        if measurements.is_long and not to_rounding and not self.noise.has_track_losses:
            minimum, converged = minimum_with_points_following(objective_at, state)
        else:
            minimum, converged = minimum_near(objective_at, state, cameras_free=True, to_rounding=to_rounding)
        return minimum, found[0], converged

    def _kept(self, measurements: Measurements) -> Measurements:
        return replace(measurements, confidence=measurements.confidence.where(self.inliers, 0.0))


class _Levels:
    """Estimates the levels that losses ask for while they are built, each at most once."""

    def __init__(
        self,
        kept: Measurements,
        state: State,
        sigma_px: Tensor,
        held: NoiseGates | None = None,
        times: Tensor | None = None,
    ) -> None:
        self._kept, self._state, self._held, self._times = kept, state, held, times
        self.sigma_px = sigma_px
        self.levels = NoiseLevels(sigma_px, torch.ones_like(sigma_px), torch.full_like(sigma_px, torch.inf))
        self.gates: CorrelationGates | None = None

    def correlation_frames(self, given: float | str) -> Tensor:
        times = self._estimated_times if given == _ESTIMATED else torch.full_like(self.sigma_px, float(given))
        self.levels = self.levels._replace(correlation_frames=times)
        return times

    def acceleration_m(self, losses: dict[str, Loss]) -> Tensor:
        """Of the smoothness, which the keypoints weigh against their noise as if it were independent in each frame.

        What lasts of the errors does not shake a track. It makes second differences smaller than the noise says, and would
        leave no acceleration to a point that swings. And only what shakes is to be smoothed.
        """
        variance, jitter = Objective(self._kept, losses).point_variance(self._state), self._correlation.jitter
        shaken = variance * jitter.repeat(1, self._kept.frames)
        acceleration_m = estimate_acceleration_m(self._kept, self._state.points, shaken) / jitter[:, None].sqrt()
        self.levels = self.levels._replace(acceleration_m=acceleration_m)
        return acceleration_m

    @property
    def _estimated_times(self) -> Tensor:
        times = self._times
        if times is None:
            return self._correlation.times
        unknown = times.isnan()
        return torch.where(unknown, self._correlation.times, times) if bool(unknown.any()) else times

    @cached_property
    def _correlation(self) -> ErrorCorrelation:
        gates = None if self._held is None else self._held.correlation
        found = correlation_for_weights(self._kept, self._state, self.sigma_px, gates)
        self.gates = found.gates
        return found


def correlation_for_weights(
    kept: Measurements, state: State, sigma_px: Tensor, gates: CorrelationGates | None = None
) -> ErrorCorrelation:
    """How long errors last, for the weights of the points; arguments as of :func:`error_correlation`."""
    return error_correlation(kept, state, sigma_px, _CONTRAST, gates)


def check_noise(config: Config, points: int) -> None:
    """Refuse given noise of another number of points than a session has.

    Raises:
        ConfigError: if it is.
    """
    given = config.given_sigma_px
    if given is not None and given.ndim and len(given) != points:
        raise ConfigError(
            "the given noise is of another number of points",
            where="config.sigma_px",
            got=f"{len(given)} numbers",
            expected=f"one number, or {points}: one for each point",
        )


def _is_track(named: tuple[str, LossSettings]) -> bool:
    return issubclass(named[1].loss, TrackLoss)
