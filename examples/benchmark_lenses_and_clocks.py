"""Accuracy with unknown lenses and clocks: simulated sessions in which the given intrinsics or times are wrong.

    python examples/benchmark_lenses_and_clocks.py lenses --seeds 30 --cameras 3 6
    python examples/benchmark_lenses_and_clocks.py clocks --seeds 30 --rates 30 60 120

The sport changes from seed to seed. The camera error is the distance between estimated and true camera centres, mean over the
cameras. For lenses it is divided by the Cramér-Rao bound of a method that has to estimate what is wrong. For clocks it is
divided by the error in the same session with synchronised cameras: the same frames overlap, and the noise is the same. "Largest
ratio" is that of a single session. "Normalised squared error" is the mean of (error / standard deviation)^2 of the estimated
focal lengths, k1 or time offsets; it is 1 if the standard deviations that the calibration reports are right. "Within 3 std" is
the share of these errors below three standard deviations.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from torchstickcal import Calibration, Observations, calibrate
from torchstickcal.benchmark.bound import camera_bound
from torchstickcal.benchmark.cases import Case
from torchstickcal.metrics import pose_errors
from torchstickcal.pipeline.synchronise import on_common_frames
from torchstickcal.simulate import Clocks, Lens, SessionSpec, SimulatedSession
from torchstickcal.simulate.regimes import DetectorNoise, Gaps, GaussianNoise
from torchstickcal.simulate.session import Assumptions

SPORTS = ("golf", "baseball", "hockey", "kendo", "wand")
BARREL = Lens(distortion=(-0.2, 0.0, 0.0, 0.0, 0.0))
VIDEO = Lens(distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0))


class Outcome(NamedTuple):
    """One session."""

    error_m: float
    reference_m: float
    """the bound, or the error with synchronised cameras"""
    normalised: NDArray[np.float64]
    """errors of the estimated unknowns, divided by their standard deviations"""
    seconds: float


@dataclass(frozen=True)
class WholeFrames(Clocks):
    """The offsets of :class:`Clocks`, rounded to whole frames."""

    fps: float = 1.0

    def offsets(self, cameras: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return np.round(super().offsets(cameras, rng) * self.fps) / self.fps


def main() -> None:
    """Print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", nargs="?", choices=("lenses", "clocks"), default="clocks")
    parser.add_argument("--seeds", type=int, default=1)
    parser.add_argument("--cameras", type=int, nargs="+", default=[6])
    parser.add_argument("--rates", type=int, nargs="+", default=[60], help="frame rates for clocks, Hz")
    options = parser.parse_args()
    reference = "bound" if options.what == "lenses" else "error if synchronised"
    print(
        f"| cameras | what is wrong | refine | camera error (mm) | error / {reference} | largest ratio "
        "| normalised squared error | within 3 std | time (s) |"
    )
    print("|---|---|---|---|---|---|---|---|---|")
    for cameras in options.cameras:
        rows = lenses(cameras) if options.what == "lenses" else clocks(cameras, options.rates)
        for name, refine, measure in rows:
            outcomes = [measure(seed) for seed in range(options.seeds)]
            print(f"| {cameras} | {name} | {', '.join(refine) or '-'} | {row(outcomes)} |", flush=True)


Row = tuple[str, tuple[str, ...], Callable[[int], Outcome]]


def row(outcomes: list[Outcome]) -> str:
    """The cells of one row."""
    ratios = [outcome.error_m / outcome.reference_m for outcome in outcomes]
    mean, reference = (statistics.fmean(getattr(o, part) for o in outcomes) for part in ("error_m", "reference_m"))
    normalised = np.concatenate([outcome.normalised for outcome in outcomes])
    spread = f"{np.mean(normalised**2):.2f} | {100 * np.mean(np.abs(normalised) < 3):.1f} %" if len(normalised) else "- | -"
    seconds = statistics.median(outcome.seconds for outcome in outcomes)
    return f"{1000 * mean:.2f} | {mean / reference:.2f} | {max(ratios):.2f} | {spread} | {seconds:.2f}"


def lenses(cameras: int) -> Iterator[Row]:
    """Wrong focal lengths and distortion."""
    spec = SessionSpec("lens", "golf", 0, cameras, frames=300, regimes=(GaussianNoise(1.0),))
    yield "nothing", (), lens_row(spec, ())
    for scale in (1.03, 0.97, 1.1, 0.9):
        wrong = replace(spec, assumptions=Assumptions(focal_scale=scale))
        yield f"all focal lengths {100 * (scale - 1):+.0f} %", ("focal_shared",), lens_row(wrong, ("focal_shared",))
    for spread in (0.03, 0.1):
        wrong = replace(spec, assumptions=Assumptions(focal_spread=spread))
        yield f"each focal length differently, std {100 * spread:.0f} %", ("focal",), lens_row(wrong, ("focal",))
    wrong = replace(spec, lens=BARREL, assumptions=Assumptions(lens_known=False))
    yield "k1 = -0.2, given as 0", ("radial",), lens_row(wrong, ("radial",))
    wrong = replace(spec, assumptions=Assumptions(focal_scale=1.03))
    yield "all focal lengths +3 %", ("auto",), lens_row(wrong, ("focal_shared",), "auto")
    yield "only the image size is given", ("focal_shared",), lens_row(spec, ("focal_shared",), (), without_intrinsics)


def lens_row(
    spec: SessionSpec,
    unknown: tuple[str, ...],
    refine: tuple[str, ...] | str | None = None,
    given: Callable[[Observations], Observations] = lambda observations: observations,
) -> Callable[[int], Outcome]:
    """A function that measures one seed, with the bound of a method that has to estimate what is ``unknown``."""

    def measure(seed: int) -> Outcome:
        session = replace(spec, seed=seed, sport=SPORTS[seed % 4]).generate()
        found, seconds = timed(given(session.observations), unknown if refine is None else refine)
        case = Case(session.name, session.observations, session.truth, session.inliers, session.sigma_px)
        bound = camera_bound(case, unknown=unknown)
        assert bound is not None
        return Outcome(error_m(found, session), bound.translation_m, lens_errors(found, session, unknown), seconds)

    return measure


def without_intrinsics(observations: Observations) -> Observations:
    """A session in which only the image size of the cameras is given."""
    return Observations(
        observations.keypoints, None, observations.sticks, image_size=observations.image_size, fps=observations.fps
    )


def lens_errors(found: Calibration, session: SimulatedSession, unknown: tuple[str, ...]) -> NDArray[np.float64]:
    """Errors of focal lengths or k1, divided by their standard deviations; a shared one counts once."""
    truth = session.truth
    assert truth.intrinsics is not None
    if "radial" in unknown:
        assert found.distortion is not None
        assert truth.distortion is not None
        return ((found.distortion[:, 0] - truth.distortion[:, 0]) / found.unknowns["radial"].std[:, 0]).numpy()
    off = (found.intrinsics[:, 0, 0] - truth.intrinsics[:, 0, 0]) / found.unknowns["focal"].std
    return off.numpy()[: 1 if "focal_shared" in unknown else None] if unknown else np.zeros(0)


def clocks(cameras: int, rates: list[int]) -> Iterator[Row]:
    """Time offsets and rolling shutters, with motion at the speed of competition."""
    for fps in rates:
        spec = SessionSpec(
            "clock", "golf", 0, cameras, 300, float(fps), "ring", VIDEO, 4.5, "circle",
            regimes=(DetectorNoise(3.0, 1.5), Gaps(0.15)),
        )  # fmt: skip
        for name, wrong, refine in (
            ("nothing", Clocks(), ("time_offset",)),
            ("offsets up to 1 s", Clocks(1.0), ("time_offset",)),
            ("offsets up to 1 s, 15 ms read-out", Clocks(1.0, 0.015), ("time_offset", "readout")),
            ("offsets up to 1 s", Clocks(1.0), ("auto",)),
        ):
            yield f"{name}, {fps} Hz", refine, clock_row(replace(spec, clocks=wrong), refine)


def clock_row(spec: SessionSpec, refine: tuple[str, ...]) -> Callable[[int], Outcome]:
    """A function that measures one seed, with the error in the same session with synchronised cameras."""

    def measure(seed: int) -> Outcome:
        wrong = replace(spec, seed=seed, sport=SPORTS[seed % 5])
        session = wrong.generate()
        right = replace(wrong, clocks=WholeFrames(wrong.clocks.offset_s, fps=wrong.fps)).generate()
        assert right.truth.time_offsets_s is not None
        assert session.truth.time_offsets_s is not None
        synchronised = on_common_frames(right.observations, (right.truth.time_offsets_s * wrong.fps).round()).observations
        reference = error_m(calibrate(synchronised), right)
        found, seconds = timed(session.observations, refine if refine != ("auto",) else "auto")
        off = (found.time_offsets - session.truth.time_offsets_s) / found.unknowns["time_offset"].std
        return Outcome(error_m(found, session), reference, off[1:].numpy(), seconds)

    return measure


def timed(observations: Observations, refine: tuple[str, ...] | str) -> tuple[Calibration, float]:
    """A calibration and the seconds it took."""
    began = time.perf_counter()
    found = calibrate(observations, refine=refine)  # pyright: ignore[reportArgumentType]
    return found, time.perf_counter() - began


def error_m(found: Calibration, session: SimulatedSession) -> float:
    """Distance between estimated and true camera centres, mean over the cameras, metres."""
    truth = session.truth
    return pose_errors(found.rotations, found.translations, truth.rotations, truth.translations).mean_translation_m


if __name__ == "__main__":
    torch.set_num_threads(1)
    main()
