"""Sports: each module registers the action of one; a new module in this folder is found without being listed anywhere."""

from torchstickcal.simulate.motions.base import SPORTS, Action, Posture, action, tilted_plane

__all__ = ["SPORTS", "Action", "Posture", "action", "tilted_plane"]
