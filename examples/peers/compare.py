"""Calibrate sessions with torchstickcal and compare the result with other programs: one table.

Each of the other programs has written a file of JSON lines from the same sessions with its own script; see README.md in this
folder.

    python examples/peers/compare.py sessions --peer COLMAP=colmap.jsonl --peer GTSAM=gtsam.jsonl

A calibration is successful if its mean camera error is at most three times the bound. The camera error is that of the camera
centres after a rigid alignment without scale. The bound is the error that can be expected if outliers, noise of the keypoints
and lenses are known, and the stick to a millimetre. A session that a program gave up, refused or did not finish in time counts
as a failure. Medians are over the sessions that were calibrated; those of wall times are over all that ended. Remarks are
calibrated sessions for which the program printed a warning.
"""

from __future__ import annotations

import json
import statistics
import time
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from sessions import Found, Session, arguments, measured, session_files

from torchstickcal import Observations, Stick
from torchstickcal import calibrate as calibrate_here
from torchstickcal.errors import FileFormatError
from torchstickcal.losses import ReprojectionLoss, StickLengthLoss
from torchstickcal.metrics import PoseErrors, pose_errors
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.simulate import SimulatedSession, read_simulated
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

HERE = "torchstickcal"
SUCCESS = 3.0
STICK_SIGMA_M = 0.001
DRAWS = 200


class Score(NamedTuple):
    """One calibration of one session; the errors are None if it failed."""

    name: str
    rotation_deg: float | None
    translation_m: float | None
    seconds: float
    status: str

    def succeeded(self, bound_m: float) -> bool:
        """Whether the camera error is at most three times the bound."""
        return self.translation_m is not None and self.translation_m <= SUCCESS * bound_m


def main() -> None:
    """Print the table, and write the scores."""
    parser = arguments(__doc__)
    parser.add_argument("--peer", action="append", default=[], metavar="NAME=FILE", help="a program and its JSON lines")
    parser.add_argument("--refine", metavar="A,B|auto|none", help="as of `torchstickcal calibrate` (default: none)")
    parser.add_argument("--out", type=Path, help="JSON lines of all scores")
    options = parser.parse_args()
    files = session_files(options.sessions)
    ours = partial(calibrate, refine=refinements(options.refine))
    lines = {HERE: list(measured(ours, files, options.timeout, options.repeats))}
    for peer in options.peer:
        name, _, file = peer.partition("=")
        lines[name] = [json.loads(line) for line in Path(file).read_text("utf-8").splitlines()]
    truths = {file.stem: read_simulated(file) for file in files}
    bounds = {name: bound(session) for name, session in truths.items()}
    scores = {
        name: [score(line, truths[line["name"]]) for line in found if line["name"] in truths] for name, found in lines.items()
    }
    if options.out:
        rows = [{"peer": name, "bound_m": bounds[s.name]} | s._asdict() for name, found in scores.items() for s in found]
        options.out.write_text("".join(json.dumps(row) + "\n" for row in rows), "utf-8")
    print("\n".join(table(scores, bounds)))


def refinements(option: str | None) -> Any:
    """The option as :func:`torchstickcal.calibrate` takes it."""
    if option in {None, "auto"}:
        return option
    return [] if option == "none" else str(option).split(",")


def calibrate(session: Session, refine: Any = None) -> Found:
    """Calibrate with torchstickcal in its default configuration, except for what it refines."""
    observations = Observations(
        session.keypoints,
        session.matrices,
        Stick(*session.stick, session.stick_length_m),
        distortion=session.distortion,
        confidence=session.confidence,
        image_size=session.sizes,
        fps=session.fps,
    )
    began = time.perf_counter()
    found = calibrate_here(observations, refine=refine)
    seconds = time.perf_counter() - began
    said = [*([] if found.converged else [found.status]), *found.warnings]
    return Found(found.rotations.numpy(), found.translations.numpy(), seconds, "; ".join(said) or "done")


def score(line: dict[str, Any], session: SimulatedSession) -> Score:
    """The errors of a line of results."""
    if "rotations" not in line:
        return Score(line["name"], None, None, line["seconds"], line["status"])
    poses = (torch.tensor(line[part], dtype=torch.float64) for part in ("rotations", "translations"))
    errors = pose_errors(*poses, session.truth.rotations, session.truth.translations)
    return Score(line["name"], errors.mean_rotation_deg, errors.mean_translation_m, line["seconds"], line["status"])


def bound(session: SimulatedSession) -> float:
    """The mean camera error, metres, that can be expected according to the Cramér-Rao bound.

    Errors are drawn from the inverse of the reduced camera system at the truth, and aligned like those of an estimate.

    Raises:
        FileFormatError: if the file of the session does not contain the true points.
    """
    truth = session.truth
    if truth.points is None:
        raise FileFormatError("no bound", where=session.name, got="no points", expected="the truth of a simulated session")
    observations = session.observations
    if truth.intrinsics is not None:
        observations = replace(observations, intrinsics=truth.intrinsics, distortion=truth.distortion)
    measurements = Measurements.of(observations).keeping(torch.from_numpy(session.inliers).flatten(1)[None])
    sigma_px = torch.from_numpy(session.sigma_px).flatten(1)
    measurements = replace(measurements, confidence=measurements.visible / sigma_px.square())
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(), "stick_length": StickLengthLoss(STICK_SIGMA_M)})
    points = truth.points.flatten(0, 1).mT.contiguous()
    state = State.of(truth.rotations[None], truth.translations[None], points[None])
    covariance = torch.linalg.inv(NormalEquations(objective, state, cameras_free=True).reduced[0])
    draws = np.random.default_rng(0).multivariate_normal(np.zeros(len(covariance)), covariance.numpy(), DRAWS)
    return statistics.fmean(_errors_at(state, tangents).mean_translation_m for tangents in torch.from_numpy(draws))


def _errors_at(truth: State, tangents: torch.Tensor) -> PoseErrors:
    moved = truth.retracted(tangents.view(1, -1, 6), torch.zeros_like(truth.points))
    return pose_errors(moved.rotations[0], moved.translations[0], truth.rotations[0], truth.translations[0])


def table(scores: dict[str, list[Score]], bounds: dict[str, float]) -> list[str]:
    """Lines of Markdown, one row for each program."""
    own = statistics.median(s.seconds for s in scores[HERE])
    bound_mm = 1000 * statistics.median(bounds.values())
    rows = [
        f"| {len(bounds)} sessions, bound {bound_mm:.1f} mm | calibrated | success | rotation | centres | largest error "
        "| error / bound | wall time | ratio | time-outs | remarks |",
        "|---|---|---|---|---|---|---|---|---|---|---|",
    ]
    for name, found in scores.items():
        calibrated = [s for s in found if s.translation_m is not None]
        ended = [s.seconds for s in found if not s.status.startswith("time-out")]
        share = sum(s.succeeded(bounds[s.name]) for s in found) / max(1, len(found))
        seconds = _median(ended)
        cells = [
            name,
            f"{len(calibrated)} of {len(found)}",
            f"{100 * share:.0f} %",
            f"{_median([s.rotation_deg for s in calibrated]):.3f} deg",
            f"{1000 * _median([s.translation_m for s in calibrated]):.1f} mm",
            f"{1000 * max((s.translation_m for s in calibrated), default=float('nan')):.1f} mm",
            f"{_median([(s.translation_m or 0.0) / bounds[s.name] for s in calibrated]):.2f}",
            f"{seconds:.2f} s",
            f"{seconds / own:.1f} x",
            f"{len(found) - len(ended)}",
            f"{sum(s.status != 'done' for s in calibrated)}",
        ]
        rows.append(f"| {' | '.join(cells)} |")
    return rows


def _median(values: Sequence[float | None]) -> float:
    known = [value for value in values if value is not None]
    return statistics.median(known) if known else float("nan")


if __name__ == "__main__":
    main()
