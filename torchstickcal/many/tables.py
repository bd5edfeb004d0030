"""What was done of many sessions as tables for programs, and as a page that links the results."""

from __future__ import annotations

import csv
import html
import io
from collections.abc import Iterable, Sequence
from dataclasses import asdict, fields
from pathlib import Path
from urllib.parse import quote

from torchstickcal.files import PAGE_FILE, REPORT_FILE, atomic_set, json_text
from torchstickcal.io.recording import natural_order
from torchstickcal.many.manifest import CONVERGED, FAILED, MANIFESTS, NOT_CONVERGED, SessionRow, read_manifests

CSV_FILE, LINES_FILE, INDEX_FILE = "sessions.csv", "sessions.jsonl", "index.html"
FILES = (CSV_FILE, LINES_FILE, INDEX_FILE)
_LINKED = (PAGE_FILE, REPORT_FILE)
"""Files in the folder of a session to which the page links; the first that is there."""
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 90rem; margin: 2rem auto; padding: 0 1rem; color: #22272c; }
table { border-collapse: collapse; font-size: 13px; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #dfe3e7; text-align: right; vertical-align: top; }
td:nth-child(-n+3), td:last-child, th:nth-child(-n+3), th:last-child { text-align: left; }
td:first-child, td:last-child { overflow-wrap: anywhere; min-width: 12rem; }
.wide { overflow-x: auto; } .failed td { background: #fdecea; } .not td { background: #fff6e0; }
"""
_HEADER = (
    "session", "outcome", "verdict", "cameras", "frames", "reprojection (px)", "centre ± (mm)", "rotation ± (deg)",
    "scale ± (%)", "refined", "warnings", "time (s)", "status",
)  # fmt: skip


def write_tables(folder: Path) -> None:
    """Write the tables and the page of all manifests of a folder, in natural order of the names.

    Runs of other shards may write them at the same time: whoever has written looks afterwards whether there is more by now.
    """
    while True:
        before = _sizes(folder)
        rows = sorted(read_manifests(folder).values(), key=lambda row: natural_order(row.name))
        with atomic_set(folder) as new:
            (new / CSV_FILE).write_text(as_csv(rows), "utf-8", newline="")
            (new / LINES_FILE).write_text("".join(json_text(asdict(row), indent=False) + "\n" for row in rows), "utf-8")
            (new / INDEX_FILE).write_text(page(rows, folder), "utf-8")
        if _sizes(folder) == before:
            return


def as_csv(rows: Iterable[SessionRow]) -> str:
    """CSV with one line for each session."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(SessionRow)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def page(rows: Sequence[SessionRow], folder: Path) -> str:
    """A page in HTML with one line for each session, which links the results in a folder."""
    counts = [(sum(row.outcome == outcome for row in rows), outcome) for outcome in (CONVERGED, NOT_CONVERGED, FAILED)]
    counted = ", ".join(f"{count} {outcome}" for count, outcome in counts if count)
    head = "".join(f"<th>{cell}</th>" for cell in _HEADER)
    lines = "\n".join(_line(row, folder) for row in rows)
    files = f'<a href="{CSV_FILE}">CSV</a> and <a href="{LINES_FILE}">JSON lines</a>'
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Calibrated sessions</title><style>{_STYLE}</style></head>
<body>
<h1>{len(rows)} session{"" if len(rows) == 1 else "s"}</h1>
<p>{counted or "nothing calibrated yet"}. The same as {files}.</p>
<div class="wide"><table><thead><tr>{head}</tr></thead>
<tbody>
{lines}
</tbody></table></div>
</body></html>
"""


def _line(row: SessionRow, folder: Path) -> str:
    name = html.escape(row.name)
    for file in _LINKED if row.folder else ():
        if (folder / str(row.folder) / file).is_file():
            name = f'<a href="{html.escape(quote(f"{row.folder}/{file}"))}">{name}</a>'
            break
    figures = [
        row.cameras,
        row.frames,
        row.reprojection_px,
        _times(1000, row.centre_std_m),
        row.rotation_std_deg,
        _times(100, row.scale_std),
    ]
    texts = [row.outcome, row.verdict or "", *map(_text, figures), row.refined, _text(row.warnings), f"{row.seconds:.2f}"]
    status = row.error or ("" if row.outcome == CONVERGED else row.status)
    cells = [name, *(html.escape(text) for text in (*texts, status))]
    kind = {FAILED: ' class="failed"', NOT_CONVERGED: ' class="not"'}.get(row.outcome, "")
    return f"<tr{kind}>{''.join(f'<td>{cell}</td>' for cell in cells)}</tr>"


def _times(factor: float, value: float | None) -> float | None:
    return None if value is None else factor * value


def _text(value: float | None) -> str:
    if value is None:
        return ""
    return f"{value:.3g}" if isinstance(value, float) else str(value)


def _sizes(folder: Path) -> dict[str, int]:
    """The lengths of the manifests, which only grow."""
    return {file.name: file.stat().st_size for file in folder.glob(MANIFESTS)}
