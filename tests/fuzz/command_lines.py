"""Command lines: each command with its options, some of them with values that they cannot have."""

from __future__ import annotations

import functools
import tempfile
from pathlib import Path

from hypothesis import strategies as st

from fuzz.damaged import Damaged
from fuzz.sessions import Spoiled
from torchstickcal.io import write_npz
from torchstickcal.simulate import Noise, golf_session

FILES = {
    "session.npz": lambda path: write_npz(path, *golf_session(cameras=3, frames=8, noise=Noise(0.5))),
    "identical cameras.npz": lambda path: write_npz(path, Spoiled(spoils=("all_cameras_identical",)).observations()),
    "without truth é.npz": lambda path: write_npz(path, Spoiled().observations()),
    "damaged.npz": lambda path: path.write_bytes(Damaged("session .npz", ("cut_short",), 1).content()),
    "sequence.pkl": lambda path: path.write_bytes(Damaged("session .pkl").content()),
    "damaged.pkl": lambda path: path.write_bytes(Damaged("session .pkl", ("cut_short",), 1).content()),
    "calibration.toml": lambda path: path.write_bytes(Damaged("cameras .toml").content()),
    "points.npz": lambda path: path.write_bytes(Damaged("calibration .npz").content()),
    "config.toml": lambda path: path.write_text('extends = "default"\n'),
    "broken.toml": lambda path: path.write_text("stages = 1"),
    "empty": lambda path: path.touch(),
    "plugin.py": lambda path: path.write_text("x = 1\n"),
    "broken.py": lambda path: path.write_text("1 / 0\n"),
    "folder": lambda path: path.mkdir(),
}
"""What lies in the folder in which the commands are run."""


def lay_out(folder: Path) -> None:
    for name, content in _contents().items():
        if content is None:
            (folder / name).mkdir()
        else:
            (folder / name).write_bytes(content)


@functools.cache
def _contents() -> dict[str, bytes | None]:
    """The files' contents, made once; None for a folder."""
    with tempfile.TemporaryDirectory() as folder:
        for name, write in FILES.items():
            write(Path(folder, name))
        return {name: None if (path := Path(folder, name)).is_dir() else path.read_bytes() for name in FILES}


_NUMBERS = ["1", "0", "-1", "1.5", "1e-300", "1e308", "nan", "inf", "9" * 400, "", "x"]
_OUT = ["out", "new/deep", "folder", "empty", "session.npz", "session.npz/below", "/dev/null", "a" * 300, "", "é", "\udcff"]
_PATHS = ["session.npz", *FILES, "missing", ".", "/dev/null", "", "a" * 5000, "\udcff"]
VALUES: dict[str, list[str] | None] = {
    "--out": _OUT,
    "--json": ["errors.json", *_OUT],
    "--tensorboard": ["runs", "empty", "session.npz"],
    "--format": ["npz", "sports-stick-syn", "pose2sim", "x", ""],
    "--export": ["pose2sim", "pose2sim,pose2sim", "x", ",", ""],
    "--config": ["default", "paper", "config.toml", "broken.toml", "missing.toml", "folder", "x", "", "\udcff"],
    "--refine": ["auto", "none", "focal", "focal,time_offset", "x", ",", ""],
    "--no-sync": None,
    "--stick-length": ["1.2", *_NUMBERS],
    "--stick-sigma": ["0.01", *_NUMBERS],
    "--plugin": ["plugin.py", "broken.py", "missing.py", "folder", "x.y", "", "."],
    "--count": ["1", "2", "0", "-1", "1.5", "x", ""],
    "--seed": ["1", "-1", "1.5", "x", "9" * 400],
    "--methods": ["default", "x", ",", ""],
    "--jobs": ["1", "0", "-1", "1.5", "x"],
    "--gif": None,
    "--stick": ["0 1 0.5", "left_wrist right_wrist 0.4", "x y 1", "0 0 1", "0 1 nan", "0 1", "a b c d"],
    "--stick-points": _PATHS,
    "--intrinsics": ["calibration.toml", *_PATHS],
    "--image-size": ["1920 1080", "0 1080", "nan 1", "1920", "x y"],
    "--fps": ["60", *_NUMBERS],
    "--skeleton": ["coco_17", "config.toml", "broken.toml", "missing.toml", "x", "", "folder"],
    "--person": ["largest", "stick", "0", "-1", "99", "x", ""],
    "--units": ["m", "mm", "x", ""],
    "--write": ["pose2sim", "trc", "cameras.json", "x", ",", ""],
    "--world": ["camera", "athlete", "floor", "points x", "calibration calibration.toml", "x", ""],
    "--initial": ["calibration.toml", *_PATHS],
    "--calibration": ["calibration.toml", *_PATHS],
    "--turned": ["left", "x", ""],
    "--split-moved": None,
    "--strict": None,
    "--verbose": None,
    "--rrd": None,
    "--to": ["anipose", "trc", "x", ""],
    "--sport": ["golf", "x", ""],
    "--up": ["0 0 1", "0 0 0", "nan 0 1", "x y z"],
    "--from": ["pose2sim", "x", ""],
    "--tape": ["red,yellow", "x", ","],
    "--balls": ["red,yellow", "red", ",,"],
    "--shaft": None,
    "--stick-offset": ["0 0.1", "left_wrist unknown", "0 unknown", "x 1", "0 nan", "0"],
    "--weights": _PATHS,
    "--rtmlib": ["x", ""],
    "--cluster": ["x", ""],
    "--shard": ["1/2", "3/2", "x", ""],
    "--memory": ["8GB", "1", "x", ""],
    "--retry": None,
    "--no-page": None,
    "--set": [
        *(
            "relabel=false",
            "stages.metric.reject_sigmas=5",
            "relable=true",
            "points=sticks",
            "x",
            "",
            "=",
            "stages={}",
            "\udcff=1",
        ),
        *(
            "scale.length_m=1",
            "extends='paper'",
            "height_m=1.8",
            "height_m=nan",
            "refine=['x']",
            "[stages]",
            "relabel=" + "9" * 5000,
        ),
    ],
    "--print-config": None,
    "--analyse": ["golf", "x", ""],
    "--height": ["1.78", *_NUMBERS],
    "--external": ["x=folder", "x=missing", "default=folder", "x", "=", ""],
    "--quiet": None,
    "--debug": None,
}
"""The values that are tried of each option, words separated by blanks; None for an option without one. What would take long is
left out."""

COMMANDS = {
    "calibrate": (["session.npz"] * len(_PATHS) + _PATHS,),
    "evaluate": (["calibration.toml"] * len(_PATHS) + _PATHS, _PATHS),
    "simulate": (["wand", "golf", "x", "", "hard"],),
    "benchmark": (["folder", "session.npz", "x", ".", "missing", ""],),
    "list": (["losses", "formats", "x", ""],),
    "check": (["calibration.toml"] * len(_PATHS) + _PATHS, ["session.npz"] * len(_PATHS) + _PATHS),
    "triangulate": (["session.npz"] * len(_PATHS) + _PATHS,),
    "info": (["session.npz"] * len(_PATHS) + _PATHS,),
    "convert": (["calibration.toml"] * len(_PATHS) + _PATHS, ["cameras.json", "points.trc", *_OUT]),
    "sample": (_OUT,),
    "report": (_PATHS,),
    "analyse": (_PATHS,),
    "detect": (_PATHS,),
}
"""The values that are tried of each argument of each command."""
FITTING = {
    "calibrate": [
        *("--format", "--export", "--config", "--refine", "--no-sync", "--stick-length", "--stick-sigma", "--plugin"),
        *("--stick", "--stick-points", "--intrinsics", "--image-size", "--fps", "--skeleton", "--person"),
        *("--write", "--world", "--initial", "--turned", "--split-moved", "--strict", "--verbose", "--rrd"),
        *("--set", "--print-config", "--height", "--quiet", "--stick-offset"),
    ],
    "evaluate": ["--format", "--json", "--plugin", "--units"],
    "simulate": ["--seed", "--plugin"],
    "benchmark": ["--json", "--config", "--plugin", "--count", "--set", "--external", "--print-config"],
    "list": ["--plugin"],
    "check": ["--json", "--units", "--strict", "--format"],
    "triangulate": ["--write", "--fps", "--units", "--set", "--print-config", "--config", "--analyse"],
    "info": ["--json", "--quiet"],
    "convert": ["--to", "--from", "--units"],
    "sample": [],
    "report": ["--rrd"],
    "analyse": ["--sport", "--up", "--fps"],
    "detect": ["--tape", "--balls", "--shaft", "--weights", "--rtmlib"],
}
"""The options that a command takes, apart from those that it needs."""


@st.composite
def command_lines(draw: st.DrawFn) -> list[str]:
    """A command, mostly with what it needs, and some options."""
    command = draw(st.sampled_from(["calibrate"] * 12 + ["evaluate"] * 4 + [*COMMANDS]))
    words = [command, *(draw(st.sampled_from(values)) for values in COMMANDS[command])]
    if command == "simulate":
        words += ["--count", draw(st.sampled_from(VALUES["--count"] or []))]
    if command == "triangulate":
        words += ["--calibration", draw(st.sampled_from(VALUES["--calibration"] or []))]
    if command in ("calibrate", "simulate", "triangulate", "detect"):
        words += ["--out", draw(st.sampled_from(["out"] * 6 + _OUT))]
    options = draw(st.lists(st.sampled_from(FITTING[command]), max_size=2, unique=True)) if FITTING[command] else []
    if draw(st.integers(0, 9)) == 9:
        options.append(draw(st.sampled_from(list(VALUES))))
    for option in options:
        values = VALUES[option]
        value = draw(st.one_of(st.just(values[0]), st.sampled_from(values))) if values else ""
        several = option in ("--stick", "--image-size", "--up", "--world")
        words += [option] if values is None else [option, *(value.split() if several else [value])]
    return words
