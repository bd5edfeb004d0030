"""The tables of a calibration, once for the terminal, notebooks and the report."""

from __future__ import annotations

import textwrap
from collections.abc import Sequence
from dataclasses import dataclass
from html import escape
from itertools import zip_longest
from typing import NamedTuple

from torch import Tensor

from torchstickcal.model.unknowns import all_unknowns
from torchstickcal.reconstruction import Reconstruction
from torchstickcal.result import Calibration, CameraParameter
from torchstickcal.show.look import digits, share, with_std


@dataclass(frozen=True)
class Column:
    """One column of a table."""

    head: str
    unit: str = ""
    meaning: str = ""
    """a sentence for those who do not know the head"""
    is_text: bool = False
    """whether it is aligned on the left"""

    @property
    def heads(self) -> tuple[str, str]:
        """Two lines above the column: what and in which unit."""
        return self.head, f"({self.unit})" if self.unit else ""


@dataclass(frozen=True)
class Table:
    """Rows of texts with a head for each column."""

    title: str
    columns: tuple[Column, ...]
    rows: tuple[tuple[str, ...], ...]

    def text(self) -> str:
        """The table as lines for a terminal, columns aligned. Heads are broken where they are wider than their column."""
        rows = [[printable(cell) for cell in row] for row in self.rows]
        heads = [_head_lines(column, [row[number] for row in rows]) for number, column in enumerate(self.columns)]
        lines = list(map(list, zip_longest(*heads, fillvalue="")))
        units = [column.heads[1] for column in self.columns]
        lines += [units] if any(units) else []
        widths = [max(len(line[number]) for line in [*lines, *rows]) for number in range(len(self.columns))]

        def aligned(cells: Sequence[str]) -> str:
            placed = [
                cell.ljust(width) if column.is_text else cell.rjust(width)
                for cell, width, column in zip(cells, widths, self.columns, strict=True)
            ]
            return "  ".join(placed).rstrip()

        above = [aligned(line) for line in lines]
        return "\n".join([*above, "-" * (sum(widths) + 2 * (len(widths) - 1)), *map(aligned, rows)])

    def html(self) -> str:
        """The table as HTML, every text escaped."""
        heads = "".join(_head(column) for column in self.columns)
        rows = "".join(
            f"<tr>{''.join(_cell(cell, column) for cell, column in zip(row, self.columns, strict=True))}</tr>"
            for row in self.rows
        )
        return (
            f'<h3>{escape(self.title)}</h3><div class="wide"><table>'
            f"<thead><tr>{heads}</tr></thead><tbody>{rows}</tbody></table></div>"
        )


def _head_lines(column: Column, cells: Sequence[str]) -> list[str]:
    """The head of a column, as wide as its cells or its longest word."""
    head, unit = column.heads
    width = max(map(len, (*cells, *head.split(), unit, " ")))
    return textwrap.wrap(head, width, break_long_words=False, break_on_hyphens=False)


def text_table(rows: Sequence[Sequence[str]]) -> str:
    """Rows of texts, the first of which has the heads, as lines for a terminal. Columns of numbers are aligned on the right."""
    heads, *others = rows
    are_text = [not any(row[number][:1].isdigit() or row[number][:1] == "-" for row in others) for number in range(len(heads))]
    columns = tuple(
        Column(head, is_text=not number or is_text) for number, (head, is_text) in enumerate(zip(heads, are_text, strict=True))
    )
    return Table("", columns, tuple(map(tuple, others))).text()


def _head(column: Column) -> str:
    head, unit = map(escape, column.heads)
    meaning = f' title="{escape(column.meaning)}"' if column.meaning else ""
    return f"<th{_kind(column)}{meaning}>{head}{f'<br><small>{unit}</small>' if unit else ''}</th>"


def _cell(text: str, column: Column) -> str:
    return f"<td{_kind(column)}>{escape(printable(text))}</td>"


def _kind(column: Column) -> str:
    return ' class="text"' if column.is_text else ""


def printable(text: str) -> str:
    r"""A text for one place in a table: line ends and other characters that have no shape of their own are escaped.

    Example:
        >>> print(printable("left\ncamera"))
        left\ncamera
    """
    if text.isprintable():
        return text
    return "".join(letter if letter.isprintable() else letter.encode("unicode_escape").decode() for letter in text)


def point_name(found: Calibration | Reconstruction, index: int) -> str:
    """The name of a point, or its number."""
    return found.point_names[index] if found.point_names else f"point {index}"


def stick_name(found: Calibration | Reconstruction, stick: int) -> str:
    """The names of a stick's ends."""
    return " - ".join(point_name(found, end) for end in found.sticks[stick].ends)


def length_spread_m(lengths: Tensor) -> float:
    """Standard deviation of the lengths of sticks around their mean, metres; NaN where none is known."""
    return float((lengths - lengths.nanmean()).square().nanmean().sqrt())


def keypoints_seen(calibration: Calibration) -> Tensor:
    """(C, F, P), True where a keypoint was given whose point is known."""
    return calibration.residuals_px.isfinite().all(-1) | calibration.inliers


class CameraFacts(NamedTuple):
    """What tables and pages say of one camera."""

    name: str
    centre_m: list[float]
    std_m: float
    std_deg: float
    median_px: float
    rms_px: float
    used: int
    """number of its keypoints that were used"""
    seen: int
    """number of its keypoints whose point is known"""


def camera_facts(calibration: Calibration) -> list[CameraFacts]:
    """The facts of each camera."""
    columns = (
        calibration.camera_centres,
        calibration.camera_std_m,
        calibration.camera_std_deg,
        calibration.reprojection_median_px,
        calibration.reprojection_rms_px,
        calibration.inliers.flatten(1).sum(1),
        keypoints_seen(calibration).flatten(1).sum(1),
    )
    return [CameraFacts(*row) for row in zip(calibration.camera_names, *(column.tolist() for column in columns), strict=True)]


def camera_table(cameras: Sequence[CameraFacts]) -> Table:
    """Where the cameras are, how surely, and how well their keypoints fit."""
    columns = (
        Column("camera", is_text=True),
        Column("position x, y, z", "m", "centre of the camera in the frame of the calibration"),
        Column("its std", "mm", "standard deviation of that position, relative to the first camera"),
        Column("rotation std", "deg", "standard deviation of the camera's rotation, relative to the first camera"),
        Column("reprojection", "px, median", "distance between a keypoint and the projection of its point"),
        Column("keypoints used", "", "keypoints that agree with the other cameras"),
        Column("share used", "", "share of the keypoints seen; the rest contradicts the other cameras and was set aside"),
    )
    rows = tuple(
        (
            camera.name,
            position,
            f"{1000 * camera.std_m:.2f}",
            f"{camera.std_deg:.4f}",
            f"{camera.median_px:.3f}",
            str(camera.used),
            share(camera.used / camera.seen) if camera.seen else "-",
        )
        for camera, position in zip(cameras, _aligned([camera.centre_m for camera in cameras]), strict=True)
    )
    return Table("Cameras", columns, rows)


def _aligned(positions: Sequence[Sequence[float]]) -> list[str]:
    """Positions as texts of equal width, metres."""
    texts = [[f"{value:.3f}" for value in position] for position in positions]
    width = max(len(text) for position in texts for text in position)
    return [" ".join(text.rjust(width) for text in position) for position in texts]


def unknown_tables(calibration: Calibration, only_refined: bool = False) -> list[Table]:
    """For everything that may be unknown of the cameras beside their poses: what was given, used and suggested."""
    tables = []
    for name, parameter in calibration.unknowns.items():
        known = bool(parameter.by_component("suggested").isfinite().any())
        unknown = all_unknowns().get(name)
        noticeable = unknown is None or unknown.noticeable_prior_share is not None  # None: of a module that is not imported
        if known and (parameter.refined or (noticeable and not only_refined)):
            tables.append(_unknown_table(calibration, parameter))
    return tables


def _unknown_table(calibration: Calibration, parameter: CameraParameter) -> Table:
    factor, unit = (1000, "ms") if parameter.unit == "s" else (1, parameter.unit)
    used = "estimated" if parameter.refined else "used"
    columns = [Column("camera", is_text=True)]
    for component in parameter.components:
        name = component if len(parameter.components) > 1 else ""
        columns += [
            Column(f"{name} given".strip(), unit, "the value that was given for the camera"),
            Column(f"{name} {used}".strip(), unit, "the value in the result, ± its standard deviation"),
            Column(
                f"{name} suggested".strip(),
                unit,
                "what the keypoints suggest if this value alone is changed, ± its standard deviation",
            ),
        ]

    names = ("given", "value", "std", "suggested", "suggested_std")
    values = {name: (factor * parameter.by_component(name)).tolist() for name in names}
    pairs = (("given", None), ("value", "std"), ("suggested", "suggested_std"))
    rows = tuple(
        (
            label,
            *(
                with_std(values[name][camera][number], values[std][camera][number] if std else float("nan"))
                for number in range(len(parameter.components))
                for name, std in pairs
            ),
        )
        for camera, label in enumerate(calibration.camera_names)
    )
    return Table(parameter.label.capitalize(), tuple(columns), rows)


def stick_table(calibration: Calibration) -> Table | None:
    """The reconstructed lengths of the sticks; None without sticks."""
    if not calibration.sticks:
        return None
    columns = (
        Column("stick, fitted", is_text=True),
        Column("given", "m", "the length that was given"),
        Column("mean", "m", "mean of the reconstructed lengths; they took part in the calibration"),
        Column("spread", "mm", "standard deviation of the reconstructed lengths"),
        Column("frames", "", "frames in which both ends are known"),
    )
    return Table("Sticks", columns, tuple(stick_rows(calibration)))


def stick_rows(found: Calibration | Reconstruction) -> list[tuple[str, ...]]:
    """Of each stick: its name, the given and the mean length (m), their spread (mm), and the number of frames."""
    rows: list[tuple[str, ...]] = []
    for number, (stick, lengths) in enumerate(zip(found.sticks, found.stick_lengths_m.mT, strict=True)):
        known = lengths[lengths.isfinite()]
        spread = f"{1000 * float(known.std()):.2f}" if len(known) > 1 else "-"
        mean = f"{float(known.mean()):.5f}" if len(known) else "-"
        rows.append((stick_name(found, number), f"{stick.between_m:.5f}", mean, spread, str(len(known))))
    return rows


def point_table(calibration: Calibration) -> Table:
    """How noisy the keypoints of each point are, and how many were used."""
    columns = (
        Column("point", is_text=True),
        Column("noise", "px", "standard deviation of the point's keypoints along an axis"),
        Column("keypoints used", "", "keypoints that agree with the other cameras"),
        Column("share used", "", "share of the keypoints seen; the rest contradicts the other cameras and was set aside"),
        Column("relabelled", "", "keypoints that were given for another point: a label error that was undone"),
    )
    used, seen = calibration.inliers.sum((0, 1)).tolist(), keypoints_seen(calibration).sum((0, 1)).tolist()
    relabelled = (calibration.relabelled & calibration.inliers).sum((0, 1)).tolist()
    rows = tuple(
        (
            point_name(calibration, index),
            digits(sigma) if seen[index] else "-",
            str(used[index]),
            share(used[index] / seen[index]) if seen[index] else "-",
            str(relabelled[index]),
        )
        for index, sigma in enumerate(calibration.sigma_px.tolist())
    )
    return Table("Points", columns, rows)


def stage_table(calibration: Calibration) -> Table:
    """How each stage ended, and the time it took."""
    columns = (
        Column("stage", is_text=True),
        Column("iterations"),
        Column("cost", "", "sum of the losses at the end"),
        Column("time", "ms"),
        Column("why it stopped", is_text=True),
    )
    rows = [("initialise", "", "", f"{1000 * calibration.seconds['initialise']:.1f}", "")]
    for stage in calibration.stages:
        last = stage.iterations[-1]
        rows.append((stage.name, str(last.iteration), f"{last.cost:.6g}", f"{1000 * stage.seconds:.1f}", str(stage.stop)))
    rows.append(("total", "", "", f"{1000 * calibration.seconds['total']:.1f}", ""))
    return Table("Stages", columns, tuple(rows))
