"""Camera error by share of outliers, for every program: a figure and a table.

    torchstickcal simulate breakdown --out breakdown
    (each program on `breakdown`, and compare.py breakdown --peer ... --out scores.jsonl, as in README.md)
    python examples/peers/breakdown.py scores.jsonl --out breakdown.png

The sessions' names begin with their share of outliers. A session that a program refused counts as a failure; in the figure it
lies at the upper edge.
"""

from __future__ import annotations

import argparse
import json
import re
import statistics
from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple

from matplotlib.figure import Figure

SUCCESS = 3.0
TOP_MM = 5000.0
COLOURS = ("#1f5fa8", "#d1495b", "#e8a33d", "#4a9d77", "#7a5195")


class Row(NamedTuple):
    """One session, calibrated by one program; no error if it failed."""

    program: str
    percent: int
    error_mm: float | None
    bound_mm: float

    @property
    def good(self) -> bool:
        """Whether the camera error is at most three times the bound."""
        return self.error_mm is not None and self.error_mm <= SUCCESS * self.bound_mm


def main() -> None:
    """Draw the figure and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("scores", type=Path, help="JSON lines of compare.py")
    parser.add_argument("--out", type=Path, required=True, help="the figure, .png")
    options = parser.parse_args()
    found = rows(options.scores.read_text("utf-8").splitlines())
    figure(found).savefig(options.out, dpi=110)
    print("\n".join(table(found)))


def rows(lines: Sequence[str]) -> list[Row]:
    """The scores of the sessions whose names begin with a share of outliers."""
    found: list[Row] = []
    for line in map(json.loads, lines):
        if share := re.match(r"outliers(\d+)_", line["name"]):
            error = None if line["translation_m"] is None else 1000 * line["translation_m"]
            found.append(Row(line["peer"], int(share[1]), error, 1000 * line["bound_m"]))
    return found


def figure(found: Sequence[Row]) -> Figure:
    """Median error, and every session as a dot, by share of outliers."""
    drawn = Figure(figsize=(8, 4.5), layout="constrained")
    axes = drawn.subplots()
    programs = list(dict.fromkeys(row.program for row in found))
    shares = sorted({row.percent for row in found})
    for number, (program, colour) in enumerate(zip(programs, COLOURS, strict=False)):
        own = [row for row in found if row.program == program]
        shift = 1.2 * (number - (len(programs) - 1) / 2)
        axes.plot([row.percent + shift for row in own], [_drawn(row) for row in own], ".", color=colour, alpha=0.5)
        medians = [statistics.median(_drawn(row) for row in own if row.percent == share) for share in shares]
        axes.plot([share + shift for share in shares], medians, color=colour, label=program)
    bounds = [statistics.median(row.bound_mm for row in found if row.percent == share) for share in shares]
    axes.plot(shares, bounds, "k--", label="bound: outliers known")
    axes.set(xlabel="outliers (% of the keypoints)", ylabel="error of the camera centres (mm)", yscale="log")
    axes.set_ylim(top=1.2 * TOP_MM)
    axes.grid(alpha=0.3)
    axes.legend()
    return drawn


def table(found: Sequence[Row]) -> list[str]:
    """Lines of Markdown: sessions within three times the bound, and the median error, by program and share of outliers."""
    shares = sorted({row.percent for row in found})
    lines = [f"| outliers | {' | '.join(f'{share} %' for share in shares)} |", f"|---{'|---' * len(shares)}|"]
    for program in dict.fromkeys(row.program for row in found):
        groups = [[row for row in found if row.program == program and row.percent == share] for share in shares]
        cells = [f"{sum(r.good for r in group)} of {len(group)}, {_text(group)}" for group in groups]
        lines.append(f"| {program} | {' | '.join(cells)} |")
    bounds = (statistics.median(row.bound_mm for row in found if row.percent == share) for share in shares)
    return [*lines, f"| bound | {' | '.join(f'{bound:.1f} mm' for bound in bounds)} |"]


def _text(group: Sequence[Row]) -> str:
    median = statistics.median(_drawn(row) for row in group)
    return "-" if median >= TOP_MM else f"{median:.0f} mm" if median >= 10 else f"{median:.1f} mm"


def _drawn(row: Row) -> float:
    return TOP_MM if row.error_mm is None else min(row.error_mm, TOP_MM)


if __name__ == "__main__":
    main()
