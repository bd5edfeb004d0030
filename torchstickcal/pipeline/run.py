"""What all steps of one calibration share: its configuration, who listens, and how long each step took."""

from __future__ import annotations

from dataclasses import dataclass, field

from torchstickcal.config import Config, Stage
from torchstickcal.pipeline.noise import StageNoise
from torchstickcal.solvers import Listener, ignore_record


@dataclass(frozen=True)
class Run:
    """One calibration of one session, or of several side by side.

    Args:
        config: the configuration.
        listener: hears every iteration.
        seconds: time by step, which the steps add to.
        to_rounding: whether the last camera stage and those after it are taken to their minima up to rounding errors, for
            gradients. Their solver then only has to come near.
        must_converge: whether a stage that does not converge ends everything with an error, because nothing else is of use.
    """

    config: Config
    listener: Listener = ignore_record
    seconds: dict[str, float] = field(default_factory=dict)
    to_rounding: bool = False
    must_converge: bool = False

    @property
    def camera_stages(self) -> dict[str, Stage]:
        """The stages up to the last that estimates cameras."""
        return dict(self._stages[: self._number_of_camera_stages])

    @property
    def point_stages(self) -> dict[str, Stage]:
        """The stages after it, in which the cameras are fixed."""
        return dict(self._stages[self._number_of_camera_stages :])

    def noise_of(self, stage: Stage) -> StageNoise:
        """The noise that a stage uses."""
        return StageNoise(stage, self.config.given_sigma_px)

    @property
    def settles(self) -> bool:
        """Whether the last camera stage takes its noise from the data, so that both have to be brought to agree."""
        *_, stage = self.camera_stages.values()
        return stage.cameras == "free" and self.noise_of(stage).estimated

    def took(self, step: str, seconds: float) -> None:
        """Add to the time of a step."""
        self.seconds[step] = self.seconds.get(step, 0.0) + seconds

    @property
    def _stages(self) -> list[tuple[str, Stage]]:
        return list(self.config.stages.items())

    @property
    def _number_of_camera_stages(self) -> int:
        """All stages where none estimates cameras."""
        free = [number for number, (_, stage) in enumerate(self._stages) if stage.cameras == "free"]
        return max(free, default=len(self._stages) - 1) + 1
