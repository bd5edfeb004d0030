"""Sessions with known truth: athletes of four sports and a wand, seen by simulated cameras, with everything that goes wrong."""

from torchstickcal.simulate.clocks import Clocks
from torchstickcal.simulate.cube import Cube, CubeViews
from torchstickcal.simulate.motions import ACTIONS, Motion, action
from torchstickcal.simulate.presets import PRESETS, golf_session, preset, session_specs
from torchstickcal.simulate.regimes import Noise
from torchstickcal.simulate.rigs import Lens
from torchstickcal.simulate.session import Assumptions, SessionSpec, SimulatedSession, read_simulated, write_simulated

__all__ = [
    "ACTIONS",
    "PRESETS",
    "Assumptions",
    "Clocks",
    "Cube",
    "CubeViews",
    "Lens",
    "Motion",
    "Noise",
    "SessionSpec",
    "SimulatedSession",
    "action",
    "golf_session",
    "preset",
    "read_simulated",
    "session_specs",
    "write_simulated",
]
