"""What the commands show of a calibration and of its errors, and their exit statuses."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal import files as written
from torchstickcal.cli.console import is_quiet, print_coloured
from torchstickcal.errors import CalibrationError
from torchstickcal.files import PAGE_FILE, REPORT_FILE

if TYPE_CHECKING:
    from torchstickcal.io import Writer
    from torchstickcal.metrics import PoseErrors
    from torchstickcal.outputs import ResultFiles
    from torchstickcal.quality.verdict import Quality
    from torchstickcal.result import Calibration

EXIT_DONE, EXIT_NOT_CONVERGED, EXIT_UNUSABLE, EXIT_POOR, EXIT_INTERRUPTED = 0, 1, 2, 3, 130


def chosen_files(formats: str | None = None, page: bool = True, rerun: bool = False) -> ResultFiles:
    """The files of a result that options ask for.

    Args:
        formats: further formats, or files whose names say their formats, with commas.
        page: whether ``report.html`` is written.
        rerun: whether ``scene.rrd`` is written.

    Raises:
        ConfigError: for an unknown format.
        CalibrationError: if two files have the same name, or if Rerun is not installed.
    """
    from torchstickcal.outputs import ResultFiles, result_writers

    named = tuple(formats.split(",")) if formats else ()
    result_writers(named, "--write")
    return ResultFiles(named, page, rerun)


def point_writers(names: str | None) -> dict[str, Writer]:
    """The writers of points, by the names of their files; that of arrays where none are named.

    Raises:
        CalibrationError: also for a format that does not hold points.
    """
    from torchstickcal.outputs import named_writers

    writers = named_writers(names.split(",") if names else ["npz"], {REPORT_FILE}, "--write")
    for name, writer in writers.items():
        if writer.writes != "points":
            raise CalibrationError(
                "a format that does not hold points", where="--write", got=name, expected="such as trc, c3d, csv or npz"
            )
    return writers


def show_results(
    calibration: Calibration, folder: Path, files: ResultFiles, strict: bool = False, verbose: bool = False
) -> int:
    """Show a calibration: the verdict first, then the tables, and where the files are.

    Args:
        calibration: what was found.
        folder: where its files are.
        files: which there are.
        strict: whether ``usable`` counts as poor.
        verbose: whether every table is shown.

    Returns:
        The exit status.
    """
    from torchstickcal.show.report import table

    show_quality(calibration.quality)
    print(f"\n{table(calibration, verbose)}")
    print(f"\n{', '.join(files.names)} in {folder}")
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
    """Write what ``--json`` asks for, if it does."""
    if path is not None:
        written.write_json(path, content)


def try_json(path: Path | None) -> None:
    """Raise a CalibrationError if :func:`write_json` could not write a file; leave no trace of it."""
    from torchstickcal.files import try_writing

    if path is None:
        return
    if not path.parent.is_dir() or (path.exists() and not path.is_file()):
        got = f"{path}, in a folder that does not exist" if not path.parent.is_dir() else f"{path}, which is not a file"
        raise CalibrationError("a file cannot be written", where="--json", got=got, expected="a file in a folder that exists")
    try_writing(path.parent, [path.name], "--json")
