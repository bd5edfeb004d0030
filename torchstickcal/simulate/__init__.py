"""Simulated sessions with known truth: an athlete with a stick, cameras, and the errors of real recordings.

Example:
    >>> from torchstickcal.simulate import SPORTS, SessionSpec
    >>> {"baseball", "golf", "hockey", "kendo", "wand"} <= set(SPORTS)
    True
    >>> session = SessionSpec("swing", sport="golf", cameras=4, frames=60).generate()
    >>> session.observations.num_cameras
    4
"""

from torchstickcal.simulate.athlete import Motion
from torchstickcal.simulate.clocks import Clocks
from torchstickcal.simulate.cube import Cube, CubeViews
from torchstickcal.simulate.motions import SPORTS, Action, Posture, action, tilted_plane
from torchstickcal.simulate.presets import PRESETS, golf_session, preset, session_specs
from torchstickcal.simulate.regimes import Noise
from torchstickcal.simulate.rigs import Lens
from torchstickcal.simulate.session import Assumptions, SessionSpec, SimulatedSession, read_simulated, write_simulated

__all__ = [
    "PRESETS",
    "SPORTS",
    "Action",
    "Assumptions",
    "Clocks",
    "Cube",
    "CubeViews",
    "Lens",
    "Motion",
    "Noise",
    "Posture",
    "SessionSpec",
    "SimulatedSession",
    "action",
    "golf_session",
    "preset",
    "read_simulated",
    "session_specs",
    "tilted_plane",
    "write_simulated",
]
