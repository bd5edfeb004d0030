"""Makes the pictures of README and documents again: `python docs/style/pictures.py`, or with a folder to put them elsewhere.

Needs Chromium. The report is that of `torchstickcal demo`; the terminal is the sample recording at 80 columns, and TensorBoard
shows its calibration.
"""

from __future__ import annotations

import html
import os
import pty
import re
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from PIL import Image  # of matplotlib

ROOT = Path(__file__).parents[2]
sys.path.insert(0, str(ROOT))

from tests.browser import Page, browser_page  # noqa: E402
from torchstickcal import Calibration  # noqa: E402
from torchstickcal.show.look import COLOURS  # noqa: E402

_SGR = {"32": COLOURS["good"].dark, "33": COLOURS["usable"].dark, "31": COLOURS["poor"].dark, "1;31": COLOURS["failed"].dark}
_SAMPLE = "calibrate sample --skeleton sample/skeleton.toml --stick club_grip club_head 1.0 --out results"
_COLUMNS = 80
_TENSORBOARD_SIZE, _TENSORBOARD_S = (1280, 900), 20.0
"""Of its window, and how long it may take until all curves are drawn."""
_HEIGHT = 3000
"""Of the window: the bar with the slider is where it is when one has scrolled to its end."""
_MARGIN = 8
_FRAME = 96
"""Of the demo: shortly before the club hits the ball."""


def main(out: Path) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        _run(folder, "demo", "--out", "demo")
        _run(folder, "sample", "sample")
        shown = _run(folder, *_SAMPLE.split())
        (folder / "terminal.html").write_text(_terminal(f"$ torchstickcal {_SAMPLE}\n{shown}"), "utf-8")
        calibration = Calibration.load(folder / "demo" / "points.npz")
        calibration.plot(_FRAME).savefig(folder / "demo.png", dpi=120)
        _small(folder / "demo.png", out / "demo.png")
        with browser_page(folder / "profile") as page:
            _report(page, folder, out)
            page.open(folder / "terminal.html", width=760)
            _take(page, "pre", folder, out / "terminal.png")
            _run(folder, *_SAMPLE.split(), "--tensorboard", "runs")
            with _tensorboard(folder / "runs") as address:
                page.call("Emulation.setEmulatedMedia", features=[{"name": "prefers-color-scheme", "value": "light"}])
                page.open(f"{address}/#custom_scalars", *_TENSORBOARD_SIZE)
                time.sleep(_TENSORBOARD_S)
                page.screenshot(folder / "picture.png")
                _small(folder / "picture.png", out / "tensorboard.png")


def _report(page: Page, folder: Path, out: Path) -> None:
    """Pictures of the report of the demo."""
    file = folder / "demo" / "report.html"
    for dark, width, names in ((False, 1280, ("report", "report-scene", "report-cameras")), (True, 390, ("report-phone",))):
        scheme = [{"name": "prefers-color-scheme", "value": "dark" if dark else "light"}]
        page.call("Emulation.setEmulatedMedia", features=scheme)
        page.open(file, width=width, height=_HEIGHT)
        page.evaluate(f"frame.value = {_FRAME}; frame.dispatchEvent(new Event('input'))")
        for name in names:
            places = {
                "report": "body > header, #scene",
                "report-scene": "#scene",
                "report-cameras": "#cameras",
                "report-phone": "#scene",
            }
            _take(page, places[name], folder, out / f"{name}.png")


@contextmanager
def _tensorboard(runs: Path) -> Iterator[str]:
    """The address of a TensorBoard, which ends with the block."""
    with socket.socket() as probe:
        probe.bind(("localhost", 0))
        port = probe.getsockname()[1]
    command = [sys.executable, "-m", "tensorboard.main", "--logdir", runs.name, "--port", str(port)]
    server = subprocess.Popen(command, cwd=runs.parent, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    try:
        for _ in range(300):
            with socket.socket() as probe:
                if probe.connect_ex(("localhost", port)) == 0:
                    break
            time.sleep(0.1)
        yield f"http://localhost:{port}"
    finally:
        server.terminate()
        server.wait()


def _take(page: Page, places: str, folder: Path, out: Path) -> None:
    """A picture of all from the first to the last of some elements of a page."""
    page.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    box = page.evaluate(
        f"(() => {{ const all = [...document.querySelectorAll({places!r})].map((one) => one.getBoundingClientRect());"
        "const x = Math.min(...all.map((b) => b.left)), y = Math.min(...all.map((b) => b.top));"
        f"return {{x: Math.max(0, x - {_MARGIN}), y: Math.max(0, y + scrollY - {_MARGIN}),"
        f"width: Math.max(...all.map((b) => b.right)) - x + 2 * {_MARGIN},"
        f"height: Math.max(...all.map((b) => b.bottom)) - y + 2 * {_MARGIN}, scale: 1}}; }})()"
    )
    page.screenshot(folder / "picture.png", box)
    _small(folder / "picture.png", out)


def _small(picture: Path, out: Path) -> None:
    """A picture with 256 colours, whose file is small."""
    with Image.open(picture) as image:
        image.convert("RGB").quantize(256, Image.Quantize.MAXCOVERAGE, dither=Image.Dither.NONE).save(out, optimize=True)


def _run(folder: Path, *words: str) -> str:
    """What a command shows in a terminal."""
    main_end, other = pty.openpty()
    environment = os.environ | {"COLUMNS": str(_COLUMNS), "PYTHONPATH": str(ROOT)}
    command = [sys.executable, "-m", "torchstickcal", *words]
    process = subprocess.Popen(command, cwd=folder, env=environment, stdout=other, stderr=subprocess.DEVNULL)
    os.close(other)
    parts = []
    while True:
        try:
            part = os.read(main_end, 1 << 16)
        except OSError:  # the terminal has been closed
            break
        if not part:
            break
        parts.append(part)
    os.close(main_end)
    assert process.wait() == 0, words
    return b"".join(parts).decode().replace("\r\n", "\n")


def _terminal(text: str) -> str:
    """A page that looks like a terminal."""
    shown = re.sub(
        r"\x1b\[([\d;]+)m(.*?)\x1b\[0m", lambda found: f'<b style="color:{_SGR[found[1]]}">{found[2]}</b>', html.escape(text)
    )
    style = (
        f"pre{{display:inline-block;width:{_COLUMNS}ch;white-space:pre-wrap;word-break:break-all;margin:0;padding:16px 20px;"
        "font:14px/1.45 'DejaVu Sans Mono',monospace;background:#16191d;color:#d5dae0}"
    )
    return f"<!doctype html><meta charset='utf-8'><style>body{{margin:0}}{style}</style><pre>{shown.rstrip()}</pre>"


if __name__ == "__main__":
    main(Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "docs")
