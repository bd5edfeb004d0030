"""The files of a benchmark: all measurements as CSV and JSON, figures, and a report in Markdown and in HTML."""

from __future__ import annotations

import base64
import csv
import html
import io
import re
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from pathlib import Path

from matplotlib.figure import Figure

from torchstickcal.benchmark.figures import figures
from torchstickcal.benchmark.run import Row
from torchstickcal.benchmark.tables import Cell, Table, tables
from torchstickcal.files import atomic_set, json_text

CSV_FILE, JSON_FILE, MARKDOWN_FILE, HTML_FILE = "results.csv", "results.json", "benchmark.md", "benchmark.html"
FILES = (CSV_FILE, JSON_FILE, MARKDOWN_FILE, HTML_FILE)
"""Names of the files beside the figures."""

_FIGURES_AFTER = {"inputs": ("errors_by_cameras", "errors_by_noise"), "run_time": ("run_time",), "frames": ("frames",)}
_STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; max-width: 72rem; margin: 2rem auto; padding: 0 1rem; color: #22272c; }
table { border-collapse: collapse; margin: 0.8rem 0; font-size: 13px; }
th, td { padding: 0.25rem 0.7rem; border-bottom: 1px solid #dfe3e7; text-align: right; }
th { vertical-align: bottom; } th:first-child, td:first-child { text-align: left; }
td.text { text-align: left; }
.wide { overflow-x: auto; } .note, figcaption { color: #59636e; font-size: 13px; }
figure { margin: 1rem 0; } img { max-width: 100%; } code { background: #f0f2f4; padding: 0 0.2em; }
"""


def write_results(rows: Sequence[Row], out: Path) -> None:
    """Write ``results.csv``, ``results.json``, the figures, ``benchmark.md`` and ``benchmark.html``, all or none."""
    with atomic_set(out) as folder:
        _write_all(rows, folder)


def _write_all(rows: Sequence[Row], out: Path) -> None:
    made = tables(rows)
    pictures = {name: (caption, _png(figure)) for name, (caption, figure) in figures(rows).items()}
    record = {"rows": [asdict(row) for row in rows], "tables": {table.name: asdict(table) for table in made}}
    _write(out / CSV_FILE, as_csv(rows))
    _write(out / JSON_FILE, json_text(record) + "\n")
    for name, (_, picture) in pictures.items():
        (out / f"{name}.png").write_bytes(picture)
    _write(out / MARKDOWN_FILE, markdown(rows, made, {name: caption for name, (caption, _) in pictures.items()}))
    _write(out / HTML_FILE, page(rows, made, pictures))


def as_csv(rows: Sequence[Row]) -> str:
    """CSV with one line for each method on each case."""
    text = io.StringIO()
    writer = csv.DictWriter(text, [field.name for field in fields(Row)], lineterminator="\n")
    writer.writeheader()
    writer.writerows(asdict(row) for row in rows)
    return text.getvalue()


def markdown(rows: Sequence[Row], made: Sequence[Table], captions: Mapping[str, str]) -> str:
    """The report in Markdown, which refers to the files of the figures.

    Args:
        rows: all measured rows. made: the tables.
        captions: of the figures, by name.
    """
    parts = [f"# {_heading(rows)}", _introduction(rows)]
    for table in made:
        lines = [table.header, ["---"] + ["---:"] * (len(table.header) - 1), *table.rows]
        body = ["| " + " | ".join(_text(cell).replace("|", "\\|") for cell in line) + " |" for line in lines]
        parts += [f"## {table.title}", "\n".join(body), *([table.note] if table.note else [])]
        for name in _FIGURES_AFTER.get(table.name, ()):
            if name in captions:
                parts += [f"![{captions[name]}]({name}.png)", captions[name]]
    return "\n\n".join(parts) + "\n"


def page(rows: Sequence[Row], made: Sequence[Table], pictures: Mapping[str, tuple[str, bytes]]) -> str:
    """The report in HTML; it contains the figures.

    Args:
        rows: all measured rows. made: the tables.
        pictures: caption and PNG file of each figure, by name.
    """
    parts = [f"<h1>{_marked(_heading(rows))}</h1>", f"<p>{_marked(_introduction(rows))}</p>"]
    for table in made:
        head = "".join(f"<th>{_marked(_text(cell))}</th>" for cell in table.header)
        body = "".join(f"<tr>{''.join(map(_cell, line))}</tr>\n" for line in table.rows)
        parts += [f"<h2>{_marked(table.title)}</h2>"]
        parts += [
            f'<div class="wide"><table id="{table.name}"><thead><tr>{head}</tr></thead>\n<tbody>{body}</tbody></table></div>'
        ]
        parts += [f'<p class="note">{_marked(table.note)}</p>'] if table.note else []
        for name in _FIGURES_AFTER.get(table.name, ()):
            if name in pictures:
                caption, picture = pictures[name]
                image = f'<img src="data:image/png;base64,{base64.b64encode(picture).decode()}" alt="{html.escape(caption)}">'
                parts.append(f"<figure>{image}<figcaption>{_marked(caption)}</figcaption></figure>")
    title = html.escape(_heading(rows))
    head = f'<meta charset="utf-8"><title>{title}</title><style>{_STYLE}</style>'
    return f'<!doctype html>\n<html lang="en"><head>{head}</head>\n<body>\n' + "\n".join(parts) + "\n</body></html>\n"


def _heading(rows: Sequence[Row]) -> str:
    return f"Benchmark: {rows[0].place}" if rows else "Benchmark"


def _introduction(rows: Sequence[Row]) -> str:
    return (
        f"{len({row.method for row in rows})} methods on {len({row.case for row in rows})} sessions. Errors are "
        "measured as in the paper (Yang et al., Multi-Camera Self-Calibration in Sports Motion Capture, FG 2026): a rigid "
        "transformation without scale aligns the estimated camera centres with the true ones; the remaining rotation angle and "
        "distance of the centres are averaged over the cameras of a session, then over the sessions. The figures of the paper "
        "are for its 160 sequences."
    )


def _text(cell: Cell) -> str:
    if cell is None:
        return "-"
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)


def _cell(cell: Cell) -> str:
    text = isinstance(cell, str) and not cell[:1].isdigit()
    return f"<td{' class=text' if text else ''}>{_marked(_text(cell))}</td>"


def _marked(text: str) -> str:
    """HTML of a text with code in backquotes."""
    return re.sub(r"`([^`]*)`", r"<code>\1</code>", html.escape(text))


def _png(figure: Figure) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", dpi=110, metadata={"Software": None})
    return stream.getvalue()


def _write(path: Path, text: str) -> None:
    path.write_text(text, "utf-8", "backslashreplace")
