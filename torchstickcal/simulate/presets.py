"""Presets: named sets of session specifications. The sessions of a preset never change, so results can be compared."""

from __future__ import annotations

from dataclasses import replace

from torchstickcal.errors import CalibrationError
from torchstickcal.io import Truth
from torchstickcal.observations import Observations
from torchstickcal.registry import suggestion
from torchstickcal.simulate.clocks import Clocks
from torchstickcal.simulate.cube import Cube
from torchstickcal.simulate.motions import SPORTS
from torchstickcal.simulate.regimes import (
    DetectorNoise,
    Flips,
    Gaps,
    GaussianNoise,
    Noise,
    Outliers,
    SelfOcclusion,
    SwappedEnds,
)
from torchstickcal.simulate.rigs import Lens
from torchstickcal.simulate.session import Assumptions, SessionSpec

_PAPER_PATHS = {"golf": "circle", "baseball": "figure8", "hockey": "square", "kendo": "triangle"}
_PAPER_NOISE_PX = (0.1, 0.2, 0.3, 0.4, 0.5)
_PAPER_CAMERAS = range(3, 11)
_PAPER_FPS = 10.0
_PAPER_SEEDS = {"hemisphere": 0, "random": 10_000}
_HARD_SPORTS = ("golf", "baseball", "hockey", "kendo", "wand")
_HARD_LAYOUTS = ("hemisphere", "random", "ring", "line", "arena")
_MOST_SESSIONS = 1_000_000
_VIDEO = Lens(distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0))


def preset(name: str) -> tuple[SessionSpec, ...]:
    """The session specifications of a preset.

    Args:
        name: a key of :data:`PRESETS`.

    Raises:
        CalibrationError: if there is no preset of that name; the message lists the presets.

    Example:
        >>> from torchstickcal.simulate import preset
        >>> specs = preset("hard")
        >>> len(specs), specs[0].name, specs[0].cameras
        (60, 'hard00_golf_hemisphere_cam2', 2)
    """
    if name not in PRESETS:
        raise CalibrationError("unknown preset", where="preset", got=repr(name), expected=f"one of {', '.join(PRESETS)}")
    return PRESETS[name]()


def session_specs(name: str, count: int | None = None, seed: int = 0) -> tuple[SessionSpec, ...]:
    """Session specifications of a preset or of a sport.

    Args:
        name: a preset (a key of :data:`PRESETS`) or a sport (of :data:`~torchstickcal.simulate.SPORTS`).
        count: number of sessions: the first ones of a preset (by default all), or sessions of a sport with consecutive seeds
            (by default one).
        seed: added to the seed of every session, 0 or more.

    Raises:
        CalibrationError: for an unknown name, a count below 1 or above a million, or a negative seed.

    Example:
        >>> from torchstickcal.simulate import session_specs
        >>> [(spec.name, spec.seed) for spec in session_specs("kendo", count=2, seed=5)]
        [('kendo_5', 5), ('kendo_6', 6)]
    """
    if name not in PRESETS and name not in SPORTS:
        near = suggestion(name, [*PRESETS, *SPORTS])
        known = f"a preset ({', '.join(PRESETS)}) or a sport ({', '.join(SPORTS)})"
        raise CalibrationError("no preset or sport of that name", where="name", got=repr(name), expected=known, remedy=near)
    if count is not None and not 1 <= count <= _MOST_SESSIONS:
        what = "no sessions to simulate" if count < 1 else "too many sessions to simulate"
        raise CalibrationError(what, where="count", got=count, expected=f"1 to {_MOST_SESSIONS}")
    if seed < 0:
        raise CalibrationError("negative seed", where="seed", got=seed, expected="0 or more")
    if name in PRESETS:
        return tuple(replace(spec, seed=spec.seed + seed) for spec in preset(name)[:count])
    return tuple(everyday(name, seed + number) for number in range(count or 1))


def everyday(sport: str, seed: int = 0) -> SessionSpec:
    """An ordinary recording of a sport: six cameras, four seconds, the errors of a good detector."""
    return SessionSpec(
        name=f"{sport}_{seed}",
        sport=sport,
        seed=seed,
        layout="ring",
        lens=_VIDEO,
        radius_m=4.5,
        path="circle",
        regimes=(DetectorNoise(), SelfOcclusion(), Outliers(0.02), Gaps(0.05)),
    )


def sports_stick_syn(layout: str = "hemisphere") -> tuple[SessionSpec, ...]:
    """160 sessions like those of the paper's data: 4 sports, 5 noise levels, 3 to 10 cameras; each with an ArUco cube.

    Args:
        layout: ``hemisphere``, as in the paper, or ``random``.
    """
    lens = Lens(image_size=(1200, 1200), focal_px=1600.0)
    return tuple(
        SessionSpec(
            name=f"{path}_{sport}_noise{noise:g}_cam{cameras}" + ("" if layout == "hemisphere" else f"_{layout}"),
            sport=sport,
            seed=_PAPER_SEEDS[layout] + 1000 * number + 100 * level + cameras,
            cameras=cameras,
            frames=50,
            fps=_PAPER_FPS,
            layout=layout,
            lens=lens,
            path=path,
            laps=0.5,
            regimes=(GaussianNoise(noise),),
            cube=Cube(),
        )
        for number, (sport, path) in enumerate(_PAPER_PATHS.items())
        for level, noise in enumerate(_PAPER_NOISE_PX)
        for cameras in _PAPER_CAMERAS
    )


def hard() -> tuple[SessionSpec, ...]:
    """60 sessions with the errors of a poor detector: 4 sports and a wand, 5 layouts of 2 to 8 cameras."""
    specs = []
    for number in range(60):
        sport = _HARD_SPORTS[number % len(_HARD_SPORTS)]
        cameras = (2, 3, 4, 5, 6, 8)[number // 5 % 6]
        layout = _HARD_LAYOUTS[(number + number // 5) % len(_HARD_LAYOUTS)]
        share = number / 59
        specs.append(
            SessionSpec(
                name=f"hard{number:02d}_{sport}_{layout}_cam{cameras}",
                sport=sport,
                seed=50_000 + number,
                cameras=cameras,
                frames=(60, 120, 180, 240, 300)[(number // 5 + 2 * number) % 5],
                fps=(30.0, 60.0)[number % 2],
                layout=layout,
                lens=_VIDEO,
                radius_m=4.5,
                path=("stay", "circle", "figure8", "square", "triangle")[(number // 5 + 3 * number) % 5],
                height_m=1.62 + 0.3 * ((7 * number) % 60) / 59,
                regimes=(
                    DetectorNoise(sigma_px=2.0 + share, stick_sigma_px=1.5),
                    SelfOcclusion(),
                    Flips(0.10),
                    SwappedEnds(0.03),
                    Outliers(0.10 + 0.05 * share),
                    Gaps(0.15, mean_frames=4),
                ),
            )
        )
    return tuple(specs)


def breakdown() -> tuple[SessionSpec, ...]:
    """35 sessions of 4 cameras and 60 frames, in which 0 to 60 % of the keypoints are outliers: where does a method fail?"""
    return tuple(
        SessionSpec(
            name=f"outliers{round(100 * share):02d}_{sport}_{number}",
            sport=sport,
            seed=90_000 + number,
            cameras=4,
            frames=60,
            fps=30.0,
            layout="ring",
            lens=_VIDEO,
            radius_m=4.5,
            path="circle",
            regimes=(DetectorNoise(2.5, 1.5), SelfOcclusion(), Outliers(share)),
        )
        for share in (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6)
        for number, sport in enumerate(_HARD_SPORTS)
    )


def regimes() -> tuple[SessionSpec, ...]:
    """27 sessions with errors of clocks, intrinsics or stick length, one at a time and together; 6 cameras, 300 frames."""
    errors: dict[str, tuple[Clocks, Assumptions]] = {
        "right": (Clocks(), Assumptions()),
        "offsets": (Clocks(offset_s=0.1), Assumptions()),
        "far_offsets": (Clocks(offset_s=2.0), Assumptions()),
        "rolling": (Clocks(readout_s=0.015), Assumptions()),
        "focal": (Clocks(), Assumptions(focal_scale=1.03)),
        "each_focal": (Clocks(), Assumptions(focal_spread=0.02, centre_px=5.0)),
        "no_k1": (Clocks(), Assumptions(lens_known=False)),
        "stick": (Clocks(), Assumptions(stick_scale=1.01)),
        "all": (Clocks(0.5, 0.015), Assumptions(focal_scale=1.03)),
    }
    return tuple(
        SessionSpec(
            name=f"{label}_{sport}_{rate}hz",
            sport=sport,
            seed=70_000 + rate,
            frames=300,
            fps=float(rate),
            layout="ring",
            lens=_VIDEO,
            radius_m=4.5,
            path="circle",
            regimes=(DetectorNoise(3.0, 1.5), Gaps(0.15)),
            clocks=clocks,
            assumptions=assumptions,
        )
        for label, (clocks, assumptions) in errors.items()
        for sport, rate in (("golf", 30), ("kendo", 60), ("wand", 120))
    )


PRESETS = {
    "sports-stick-syn": sports_stick_syn,
    "sports-stick-syn-random": lambda: sports_stick_syn("random"),
    "hard": hard,
    "breakdown": breakdown,
    "regimes": regimes,
}
"""The functions that make the specifications of each preset, by name."""


def golf_session(cameras: int = 6, frames: int = 240, noise: Noise | None = None, seed: int = 0) -> tuple[Observations, Truth]:
    """A golf swing of 2.4 s, seen by cameras on a ring of radius 4.5 m: a session for demonstrations and tests.

    Args:
        cameras: number of cameras C, 2 to 16.
        frames: number of frames F into which the swing is divided.
        noise: errors of the keypoints; None for exact keypoints.
        seed: of all random numbers.

    Returns:
        The observations, and their truth: extrinsics, intrinsics and points (F, 21, 3).

    Raises:
        CalibrationError: for an unsupported number of cameras.

    Example:
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=4, frames=30)
        >>> observations.keypoints.shape
        torch.Size([4, 30, 21, 2])
        >>> truth.rotations.shape, truth.translations.shape
        (torch.Size([4, 3, 3]), torch.Size([4, 3]))
    """
    lens = Lens(focal_px=1200.0, distortion=_VIDEO.distortion)
    spec = SessionSpec(
        name="golf", sport="golf", seed=seed, cameras=cameras, frames=frames, fps=max(frames - 1, 1) / 2.4,
        layout="ring", lens=lens, radius_m=4.5, regimes=() if noise is None else (noise,),
    )  # fmt: skip
    session = spec.generate()
    return session.observations, session.truth
