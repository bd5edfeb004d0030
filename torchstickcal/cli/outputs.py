"""What the commands write and show of a calibration and of its errors, and their exit statuses."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.cli.console import is_quiet, print_coloured
from torchstickcal.errors import CalibrationError

if TYPE_CHECKING:
    from torchstickcal.io import Writer
    from torchstickcal.metrics import PoseErrors
    from torchstickcal.observations import Observations
    from torchstickcal.quality.verdict import Quality
    from torchstickcal.result import Calibration

EXIT_DONE, EXIT_NOT_CONVERGED, EXIT_UNUSABLE, EXIT_POOR, EXIT_INTERRUPTED = 0, 1, 2, 3, 130
CAMERAS_FORMAT = "pose2sim"
CAMERAS_FILE, POINTS_FILE, REPORT_FILE, PAGE_FILE = "calibration.toml", "points.npz", "report.json", "report.html"


def chosen_writers(names: str | None = None) -> dict[str, Writer]:
    """The writers of the camera file and of further outputs, by the names of the files (or folders) that they write.

    Args:
        names: of formats, or of files whose names say their formats, with commas.

    Raises:
        CalibrationError: for an unknown format, or if two files have the same name.
    """
    return _distinct([CAMERAS_FORMAT, *(names.split(",") if names else ())], {POINTS_FILE, REPORT_FILE, PAGE_FILE})


def point_writers(names: str | None) -> dict[str, Writer]:
    """The writers of points, as :func:`chosen_writers`; that of arrays where none are named.

    Raises:
        CalibrationError: also for a format that does not hold points.
    """
    writers = _distinct(names.split(",") if names else ["npz"], {REPORT_FILE})
    for name, writer in writers.items():
        if writer.writes != "points":
            raise CalibrationError(
                "a format that does not hold points", where="--write", got=name, expected="such as trc, c3d, csv or npz"
            )
    return writers


def _distinct(names: Iterable[str], taken: set[str]) -> dict[str, Writer]:
    """Writers of formats or files, by the names of their files. One that is named twice counts once.

    Raises:
        CalibrationError: for an unknown format, for a file elsewhere, or if two files have the same name.
    """
    from torchstickcal.cli.convert import writer_of
    from torchstickcal.io import CALIBRATION_WRITERS

    writers: dict[str, Writer] = {}
    for name in dict.fromkeys(names):
        if name not in CALIBRATION_WRITERS and "." in name:
            if Path(name).name != name:
                expected = "the name of a file alone, which is written to the folder of the results"
                raise CalibrationError("a file in another folder", where="--write", got=name, expected=expected)
            file_name, writer = writer_of(name)
        else:
            writer = CALIBRATION_WRITERS[name]
            file_name = writer.file_name
        if file_name.lower() in {other.lower() for other in (*writers, *taken)}:
            expected = "another file name"
            raise CalibrationError("two files of one name", where=f"--write {name}", got=file_name, expected=expected)
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
    return [*(name for name, writer in writers.items() if not writer.files), POINTS_FILE, REPORT_FILE, PAGE_FILE]


def write_results(calibration: Calibration, folder: Path, writers: dict[str, Writer], provenance: dict[str, Any]) -> None:
    """Write the results of a calibration into a folder of :func:`torchstickcal.files.atomic_set`.

    Args:
        calibration: what was found.
        folder: where.
        writers: of the camera file and of further formats, by the names of their files.
        provenance: the session, the configuration and notes, as JSON can hold them.
    """
    from torchstickcal.show.page.page import report_page

    made_of = provenance | {"versions": versions()}
    for file_name, writer in writers.items():
        writer.write(folder / file_name, calibration)
    calibration.save(folder / POINTS_FILE)
    write_json(folder / REPORT_FILE, made_of | calibration.summary())
    (folder / PAGE_FILE).write_text(report_page(calibration, made_of), "utf-8")


def versions() -> dict[str, str]:
    """The versions of what calculates."""
    import platform
    from importlib.metadata import version

    packages = ("torchstickcal", "torch", "kornia", "numpy")
    return {name: version(name) for name in packages} | {"python": platform.python_version()}


def show_results(
    calibration: Calibration, folder: Path, writers: dict[str, Writer], strict: bool = False, verbose: bool = False
) -> int:
    """Show a calibration: the verdict first, then the tables, and where the files are.

    Args:
        calibration: what was found.
        folder: where its files are.
        writers: that wrote them.
        strict: whether ``usable`` counts as poor.
        verbose: whether every table is shown.

    Returns:
        The exit status.
    """
    from torchstickcal.show.report import table

    show_quality(calibration.quality)
    print(f"\n{table(calibration, verbose)}")
    print(f"\n{', '.join([*writers, POINTS_FILE, REPORT_FILE, PAGE_FILE])} in {folder}")
    print(f"Open {folder / PAGE_FILE} in a browser to see the result." + ("" if verbose else " More tables: --verbose."))
    if not calibration.converged:
        print(f"not converged: {calibration.status}", file=sys.stderr)
        return EXIT_NOT_CONVERGED
    return exit_status(calibration.quality, strict)


def show_quality(quality: Quality, notes: bool = False) -> None:
    """The verdict first, in words and colour, then why."""
    from torchstickcal.show.quality import colour_of, meaning_of, reasons_text

    print_coloured("verdict: ", quality.verdict.value, colour_of(quality.verdict), f" ({meaning_of(quality.verdict)})")
    if reasons := reasons_text(quality, notes):
        print(reasons)


def exit_status(quality: Quality, strict: bool) -> int:
    """0 for good and usable, 3 for poor and failed; where it is strict, also for usable. With ``--quiet`` 3 has its reason."""
    from torchstickcal.quality.verdict import Verdict
    from torchstickcal.show.quality import meaning_of

    if quality.verdict in ((Verdict.GOOD,) if strict else (Verdict.GOOD, Verdict.USABLE)):
        return EXIT_DONE
    if is_quiet():
        print(f"verdict: {quality.verdict.value} ({meaning_of(quality.verdict)})", file=sys.stderr)
    return EXIT_POOR


def errors_by_camera(names: Sequence[str], errors: PoseErrors) -> dict[str, Any]:
    """The errors as a dictionary that can be written as JSON."""
    rows = zip(names, errors.rotation_deg.tolist(), errors.translation_m.tolist(), strict=True)
    return {
        "aligned_by": errors.aligned_by,
        "mean_rotation_deg": errors.mean_rotation_deg,
        "mean_translation_m": errors.mean_translation_m,
        "cameras": [{"name": n, "rotation_deg": rotation, "translation_m": translation} for n, rotation, translation in rows],
    }


def print_errors(errors: dict[str, Any]) -> None:
    from torchstickcal.show.tables import printable

    width = max(6, *(len(printable(camera["name"])) for camera in errors["cameras"]))
    print(f"aligned before the comparison: {errors['aligned_by']}")
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
