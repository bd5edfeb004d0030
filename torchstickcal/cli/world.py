"""The frame of the world in which results are given."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.result import Calibration
    from torchstickcal.world import Frame

World = tuple[str, "Callable[[Calibration], Frame] | None"]
"""The name of a frame, and what finds it in a calibration where a file fixes it."""


def world_of(option: str, unit: str | None = None) -> World:
    """The frame that ``--world`` asks for; its file is read now, so that nothing is calibrated in vain.

    Raises:
        CalibrationError: for something else than a frame, and for a file that fixes none.
    """
    from torchstickcal.io.worlds import world_of_calibration, world_of_points
    from torchstickcal.world import WORLDS

    kind, _, file = option.partition(" ")
    if kind in WORLDS and not file:
        return kind, None
    if kind == "points" and file:
        return kind, world_of_points(file)
    if kind == "calibration" and file:
        return kind, world_of_calibration(file, unit)
    raise CalibrationError(
        "no frame of the world",
        where="--world",
        got=repr(option),
        expected=f"{', '.join(WORLDS)}, points FILE or calibration FILE",
    )


def placed(calibration: Calibration, world: World) -> tuple[Calibration, list[str]]:
    """A calibration in a frame, and a sentence where no body fixes it and it stays in that of the first camera.

    Raises:
        CalibrationError: if the points or cameras of a file do not fit to the calibration.
    """
    kind, find = world
    if find is not None:
        return calibration.in_world(find(calibration)), []
    try:
        return calibration.in_world(kind), []
    except CalibrationError as error:
        sentence = f"The frame is that of the first camera, because no standing body is known: {error.got}."
        return calibration, [sentence]
