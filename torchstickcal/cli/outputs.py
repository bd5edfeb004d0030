"""What the commands write and show of a calibration and of its errors, and their exit statuses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.io import Writer
    from torchstickcal.metrics import PoseErrors
    from torchstickcal.observations import Observations
    from torchstickcal.result import Calibration

EXIT_DONE, EXIT_NOT_CONVERGED, EXIT_UNUSABLE, EXIT_INTERRUPTED = 0, 1, 2, 130
CAMERAS_FORMAT = "pose2sim"
CAMERAS_FILE, POINTS_FILE, REPORT_FILE = "calibration.toml", "points.npz", "report.json"


def chosen_writers(export: str | None = None, write: str | None = None) -> dict[str, Writer]:
    """The writers of the camera file and of further outputs, by the names of the files (or folders) that they write.

    Args:
        export: names of formats, or of files whose names say their formats, with commas.
        write: the same.

    Raises:
        CalibrationError: for an unknown format, or if two files have the same name.
    """
    chosen = {CAMERAS_FORMAT: "--write"}
    for option, names in (("--export", export), ("--write", write)):
        chosen |= dict.fromkeys(names.split(",") if names else (), option)
    return _distinct(chosen, {POINTS_FILE, REPORT_FILE})


def point_writers(names: str | None) -> dict[str, Writer]:
    """The writers of points, as :func:`chosen_writers`; that of arrays where none are named.

    Raises:
        CalibrationError: also for a format that does not hold points.
    """
    writers = _distinct(dict.fromkeys(names.split(",") if names else ["npz"], "--write"), {REPORT_FILE})
    for name, writer in writers.items():
        if writer.writes != "points":
            raise CalibrationError(
                "a format that does not hold points", where="--write", got=name, expected="such as trc, c3d, csv or npz"
            )
    return writers


def _distinct(names: dict[str, str], taken: set[str]) -> dict[str, Writer]:
    """Writers by the names of their files, of formats or files and the options that ask for them.

    Raises:
        CalibrationError: for an unknown format, for a file elsewhere, or if two files have the same name.
    """
    from torchstickcal.cli.convert import writer_of
    from torchstickcal.io import CALIBRATION_WRITERS

    writers: dict[str, Writer] = {}
    for name, option in names.items():
        if name not in CALIBRATION_WRITERS and "." in name:
            if Path(name).name != name:
                expected = "the name of a file alone, which is written to the folder of the results"
                raise CalibrationError("a file in another folder", where=option, got=name, expected=expected)
            file_name, writer = writer_of(name)
        else:
            writer = CALIBRATION_WRITERS[name]
            file_name = writer.file_name
        if file_name.lower() in {other.lower() for other in (*writers, *taken)}:
            expected = "another file name"
            raise CalibrationError("two files of one name", where=f"{option} {name}", got=file_name, expected=expected)
        writers[file_name] = writer
    return writers


def check_frame_rate(writers: dict[str, Writer], observations: Observations) -> None:
    """Refuse, before anything is calculated, a recording without a frame rate for formats that need one.

    Raises:
        CalibrationError: if it is one.
    """
    if observations.fps is not None or observations.timestamps is not None:
        return
    for name, writer in writers.items():
        if writer.needs_rate:
            raise CalibrationError(
                "a format that needs a frame rate",
                where=name,
                got="a recording without one",
                expected="frames per second",
                remedy="Give it with --fps.",
            )


def result_names(writers: dict[str, Writer]) -> list[str]:
    """The names of the single files that :func:`write_results` writes; folders of several files are not among them."""
    return [*(name for name, writer in writers.items() if not writer.files), POINTS_FILE, REPORT_FILE]


def write_results(calibration: Calibration, folder: Path, writers: dict[str, Writer], provenance: dict[str, Any]) -> None:
    """Write the results of a calibration into a folder of :func:`torchstickcal.files.atomic_set`."""
    from torchstickcal.show.report import summary

    for file_name, writer in writers.items():
        writer.write(folder / file_name, calibration)
    calibration.save(folder / POINTS_FILE)
    write_json(folder / REPORT_FILE, provenance | summary(calibration))


def show_results(calibration: Calibration, folder: Path, writers: dict[str, Writer]) -> int:
    from torchstickcal.show.report import table

    print(table(calibration))
    print(f"\n{', '.join([*writers, POINTS_FILE, REPORT_FILE])} in {folder}")
    if calibration.converged:
        return EXIT_DONE
    print(f"not converged: {calibration.status}", file=sys.stderr)
    return EXIT_NOT_CONVERGED


def errors_by_camera(names: Sequence[str], errors: PoseErrors) -> dict[str, Any]:
    """The errors as a dictionary that can be written as JSON."""
    rows = zip(names, errors.rotation_deg.tolist(), errors.translation_m.tolist(), strict=True)
    return {
        "mean_rotation_deg": errors.mean_rotation_deg,
        "mean_translation_m": errors.mean_translation_m,
        "cameras": [{"name": n, "rotation_deg": rotation, "translation_m": translation} for n, rotation, translation in rows],
    }


def print_errors(errors: dict[str, Any]) -> None:
    from torchstickcal.show.report import printable

    width = max(6, *(len(printable(camera["name"])) for camera in errors["cameras"]))
    print(f"{'camera':{width}}  rotation (deg)  translation (mm)")
    mean = {"name": "mean", "rotation_deg": errors["mean_rotation_deg"], "translation_m": errors["mean_translation_m"]}
    for camera in [*errors["cameras"], mean]:
        print(f"{printable(camera['name']):{width}}  {camera['rotation_deg']:14.5f}  {1000 * camera['translation_m']:16.3f}")


def write_json(path: Path | None, content: dict[str, Any]) -> None:
    from torchstickcal.files import atomic_path, json_text

    if path is not None:
        with atomic_path(path) as temporary:
            temporary.write_text(json_text(content) + "\n", "utf-8")


def try_json(path: Path | None) -> None:
    """Raise a CalibrationError if :func:`write_json` could not write a file; leave no trace of it."""
    from torchstickcal.files import try_writing

    if path is None:
        return
    if not path.parent.is_dir() or (path.exists() and not path.is_file()):
        got = f"{path}, in a folder that does not exist" if not path.parent.is_dir() else f"{path}, which is not a file"
        raise CalibrationError("a file cannot be written", where="--json", got=got, expected="a file in a folder that exists")
    try_writing(path.parent, [path.name], "--json")
