"""What athletes do with their sticks, as functions of continuous time."""

from torchstickcal.errors import CalibrationError
from torchstickcal.simulate.motions.base import Action, Motion, Posture
from torchstickcal.simulate.motions.baseball import BASEBALL
from torchstickcal.simulate.motions.golf import GOLF
from torchstickcal.simulate.motions.hockey import HOCKEY
from torchstickcal.simulate.motions.kendo import KENDO
from torchstickcal.simulate.motions.wand import WAND

__all__ = ["ACTIONS", "Action", "Motion", "Posture", "action"]

ACTIONS = {"golf": GOLF, "baseball": BASEBALL, "hockey": HOCKEY, "kendo": KENDO, "wand": WAND}


def action(sport: str) -> Action:
    """The action of a sport.

    Raises:
        CalibrationError: if there is none of that name.
    """
    if sport not in ACTIONS:
        raise CalibrationError("unknown sport", where="sport", got=repr(sport), expected=f"one of {', '.join(ACTIONS)}")
    return ACTIONS[sport]
