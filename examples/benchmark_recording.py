"""How the way of recording changes the accuracy: cameras, duration, movement, angles, and how often the stick is seen.

Each line is the median over simulated sessions (golf, baseball, hockey, kendo in turn) of the mean error of the camera centres.

    python examples/benchmark_recording.py cameras duration path stick angle --seeds 8
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator
from dataclasses import replace
from statistics import median
from typing import Any

import torch

from torchstickcal import Observations, calibrate
from torchstickcal.errors import CalibrationError
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import SessionSpec, SimulatedSession
from torchstickcal.simulate.presets import everyday

SPORTS = ("golf", "baseball", "hockey", "kendo")
GROUPS = ("cameras", "duration", "path", "stick", "angle")
Change = Callable[[Observations], Observations]


def session(seed: int, **settings: Any) -> SessionSpec:
    """An ordinary recording: four cameras around an athlete who walks about, 4 s at 60 Hz, the errors of a good detector."""
    spec = everyday(SPORTS[seed % len(SPORTS)], seed)
    return replace(spec, **{"cameras": 4, "frames": 240} | settings)


def of_cameras(cameras: list[int]) -> Change:
    """Only some of the cameras."""
    parts = ("keypoints", "intrinsics", "distortion", "confidence", "camera_names")

    def some(seen: Observations) -> Observations:
        chosen = {part: getattr(seen, part) for part in parts}
        kept = {part: _of(value, cameras) for part, value in chosen.items() if value is not None}
        return replace(seen, **kept)

    return some


def _of(values: Any, cameras: list[int]) -> Any:
    return values[cameras] if isinstance(values, torch.Tensor) else tuple(values[camera] for camera in cameras)


def stick_seen(share: float) -> Change:
    """The ends of the stick are seen only in some frames, spread over the session."""

    def seen_at_times(seen: Observations) -> Observations:
        keypoints, ends = seen.keypoints.clone(), [end for stick in seen.sticks for end in (stick.start, stick.end)]
        frames = torch.arange(seen.num_frames)
        hidden = (frames * share).floor() == ((frames - 1) * share).floor()
        for end in ends:
            keypoints[:, hidden, int(end)] = torch.nan
        return replace(seen, keypoints=keypoints)

    return seen_at_times


def error_mm(simulated: SimulatedSession, change: Change | None, keep: list[int]) -> float:
    """Mean distance of estimated from true camera centres, both seen from the first camera."""
    observations = simulated.observations if change is None else change(simulated.observations)
    try:
        found = calibrate(observations)
    except CalibrationError:
        return float("inf")
    truth = simulated.truth
    errors = pose_errors(
        found.rotations, found.translations, truth.rotations[keep], truth.translations[keep], alignment="first_camera"
    )
    return 1000 * float(errors.translation_m[1:].mean())


Row = tuple[str, dict[str, Any], Change | None, list[int] | None]
"""A title, settings of the session, a change of what was seen, and which cameras are kept."""


def rows(what: str) -> Iterator[Row]:
    """What is varied."""
    if what == "cameras":
        yield from ((f"{cameras} cameras", {"cameras": cameras}, None, None) for cameras in (2, 3, 4, 6, 8))
    elif what == "duration":
        yield from ((f"{frames / 60:g} s", {"frames": frames}, None, None) for frames in (30, 60, 120, 240, 600))
    elif what == "path":
        yield from ((f"path: {path}", {"path": path}, None, None) for path in ("stay", "circle"))
    elif what == "stick":
        yield from (
            (f"stick seen in {100 * share:.0f} % of the frames", {}, stick_seen(share), None) for share in (1, 0.3, 0.1, 0.03)
        )
    else:
        pairs = ([0, second] for second in range(1, 7))
        yield from ((f"two cameras, {30 * p[1]} deg apart", {"cameras": 12}, of_cameras(p), p) for p in pairs)


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", nargs="*", default=["path"], help=", ".join(GROUPS) + " (default: path)")
    parser.add_argument("--seeds", type=int, default=1, help="number of sessions for each line (default: 1)")
    arguments = parser.parse_args()
    for title, settings, change, keep in (row for what in arguments.what for row in rows(what)):
        simulated = [session(seed, **settings).generate() for seed in range(arguments.seeds)]
        errors = [error_mm(one, change, keep or list(range(one.observations.num_cameras))) for one in simulated]
        print(f"{title:40} {median(errors):8.1f} mm   largest {max(errors):8.1f} mm", flush=True)


if __name__ == "__main__":
    main()
