"""Simulated sessions that are then spoiled. A short description of each, which a failing test prints, makes it again."""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace

import numpy as np
from hypothesis import strategies as st

from fuzz.spoils import Arguments
from fuzz.spoils.arguments import SPOILS as OTHER_SPOILS
from fuzz.spoils.keypoints import SPOILS as KEYPOINT_SPOILS
from torchstickcal import Observations
from torchstickcal.simulate import Assumptions, Clocks, Lens, Noise, SessionSpec


@dataclass(frozen=True)
class Spoiled:
    """A session, and what was done to it."""

    sport: str = "golf"
    cameras: int = 3
    frames: int = 8
    layout: str = "ring"
    noise_px: float = 0.5
    focal_scale: float = 1.0
    offset_s: float = 0.0
    readout_s: float = 0.0
    spoils: tuple[str, ...] = ()
    seed: int = 0

    def arguments(self) -> Arguments:
        """The arguments of the session's observations."""
        arguments, rng, known = self.simulated(), np.random.default_rng(self.seed), KEYPOINT_SPOILS | OTHER_SPOILS
        for name in sorted(set(self.spoils), key=list(known).index):
            known[name](arguments, rng)
        return arguments

    def observations(self) -> Observations:
        return observations_of(self.arguments())

    def simulated(self) -> Arguments:
        """The arguments before anything was done to them, as NumPy arrays."""
        arguments = _simulated(replace(self, spoils=()))
        return {name: value.copy() if isinstance(value, np.ndarray) else value for name, value in arguments.items()}


def observations_of(arguments: Arguments) -> Observations:
    """Observations of arguments in which a function may stand for the sticks that it makes."""
    sticks = arguments["sticks"]
    return Observations(**arguments | {"sticks": sticks() if callable(sticks) else sticks})


@functools.lru_cache(maxsize=200)
def _simulated(told: Spoiled) -> Arguments:
    spec = SessionSpec(
        name="fuzz",
        sport=told.sport,
        seed=told.seed % 5,
        cameras=told.cameras,
        frames=told.frames,
        fps=max(told.frames, 6) / 1.5,
        layout=told.layout,
        lens=Lens(focal_px=1200.0, distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0)),
        radius_m=4.5,
        regimes=(Noise(told.noise_px),) if told.noise_px else (),
        clocks=Clocks(told.offset_s, told.readout_s),
        assumptions=Assumptions(focal_scale=told.focal_scale),
    )
    seen = spec.generate().observations
    arrays = ("keypoints", "intrinsics", "distortion", "image_size")
    plain = ("sticks", "fps", "point_names", "camera_names")
    return {name: getattr(seen, name).numpy() for name in arrays} | {name: getattr(seen, name) for name in plain}


def spoiled_sessions(spoils: list[str] | None = None, most: int = 3) -> st.SearchStrategy[Spoiled]:
    """Small sessions to which up to ``most`` things were done."""
    names = [*KEYPOINT_SPOILS, *OTHER_SPOILS] if spoils is None else spoils
    return st.builds(
        Spoiled,
        sport=st.sampled_from(["golf", "wand", "kendo"]),
        cameras=st.integers(2, 4),
        frames=st.sampled_from([4, 8, 12, 20]),
        layout=st.sampled_from(["ring", "line", "random"]),
        noise_px=st.sampled_from([0.5, 0.0, 3.0]),
        focal_scale=st.sampled_from([1.0, 0.95]),
        offset_s=st.sampled_from([0.0, 0.02, 0.3]),
        readout_s=st.sampled_from([0.0, 0.01]),
        spoils=st.lists(st.sampled_from(names), max_size=most).map(tuple),
        seed=st.integers(0, 10_000),
    )
