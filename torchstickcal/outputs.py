"""The files of a result: which there are, and the one place that writes them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from torchstickcal.errors import CalibrationError
from torchstickcal.files import PAGE_FILE, POINTS_FILE, REPORT_FILE, RERUN_FILE, atomic_path, write_json
from torchstickcal.io.about import version_of
from torchstickcal.io.writers import CALIBRATION_WRITERS, Writer, writer_of
from torchstickcal.show.rerun import rerun_package, write_rerun

if TYPE_CHECKING:
    from torchstickcal.observations import Observations
    from torchstickcal.result import Calibration

CAMERAS_FORMAT = "pose2sim"


@dataclass(frozen=True)
class ResultFiles:
    """Writes the files of a result: ``calibration.toml``, ``points.npz``, ``report.json``, ``report.html``, and others.

    Args:
        formats: further formats, by their names as of :func:`torchstickcal.io.write_calibration`, or names of files that say
            their formats.
        page: whether ``report.html`` is written.
        rerun: whether ``scene.rrd`` is written, for the Rerun viewer.

    Raises:
        ConfigError: for an unknown format.
        CalibrationError: if a name of a file does not say its format or is one of another folder, if two files have the same
            name, or if the package that ``rerun`` needs is not installed.

    Example:
        >>> from torchstickcal import ResultFiles
        >>> ResultFiles(("trc", "camera_array.toml"), page=False).names
        ('calibration.toml', 'points.trc', 'camera_array.toml', 'points.npz', 'report.json')
    """

    formats: tuple[str, ...] = ()
    page: bool = True
    rerun: bool = False

    def __post_init__(self) -> None:
        object.__setattr__(self, "formats", tuple(self.formats))
        _ = self.writers
        if self.rerun:
            rerun_package()

    @property
    def writers(self) -> dict[str, Writer]:
        """The writers of the camera file and of the further formats, by the names of the files (or folders) that they write."""
        return result_writers(self.formats, "formats")

    @property
    def names(self) -> tuple[str, ...]:
        """The names of all files, and of the folders of formats of several files."""
        shown = [name for name, is_written in ((PAGE_FILE, self.page), (RERUN_FILE, self.rerun)) if is_written]
        return (*self.writers, POINTS_FILE, REPORT_FILE, *shown)

    @property
    def single_files(self) -> list[str]:
        """Those of :attr:`names` that are not folders."""
        writers = self.writers
        return [name for name in self.names if name not in writers or not writers[name].files]

    def __call__(self, calibration: Calibration, folder: Path, provenance: dict[str, Any]) -> None:
        """Write the files into a folder that exists, best into one of :func:`torchstickcal.files.atomic_set`.

        Args:
            calibration: what was found.
            folder: where.
            provenance: the session, the configuration and notes, as JSON can hold them.

        Raises:
            CalibrationError: if a format cannot hold the calibration.
            OSError: if a file cannot be written.
        """
        made_of = provenance | {"versions": versions()}
        for file_name, writer in self.writers.items():
            writer.write(folder / file_name, calibration)
        calibration.save(folder / POINTS_FILE)
        write_json(folder / REPORT_FILE, made_of | calibration.summary())
        if self.page:
            write_page(folder / PAGE_FILE, calibration, made_of)
        if self.rerun:
            write_rerun(folder / RERUN_FILE, calibration)


def result_writers(formats: Iterable[str], where: str) -> dict[str, Writer]:
    """The writers of the camera file and of further formats, by the names of their files; as :func:`named_writers`."""
    return named_writers([CAMERAS_FORMAT, *formats], {POINTS_FILE, REPORT_FILE, PAGE_FILE, RERUN_FILE}, where)


def named_writers(names: Iterable[str], taken: set[str], where: str) -> dict[str, Writer]:
    """Writers of formats or files, by the names of their files. One that is named twice counts once.

    Args:
        names: of formats, or of files whose names say their formats.
        taken: names of files that are written by others.
        where: what an error calls the place where the names were given.

    Raises:
        ConfigError: for an unknown format.
        CalibrationError: for a file elsewhere, or if two files have the same name.
    """
    writers: dict[str, Writer] = {}
    for name in dict.fromkeys(names):
        if name not in CALIBRATION_WRITERS and "." in name:
            if Path(name).name != name:
                expected = "the name of a file alone, which is written to the folder of the results"
                raise CalibrationError("a file in another folder", where=where, got=name, expected=expected)
            file_name, writer = writer_of(name, where=where)
        else:
            writer = CALIBRATION_WRITERS[name]
            file_name = writer.file_name
        if file_name.lower() in {other.lower() for other in (*writers, *taken)}:
            expected = "another file name"
            raise CalibrationError("two files of one name", where=f"{where} {name}", got=file_name, expected=expected)
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


def write_page(path: Path, calibration: Calibration, made_of: dict[str, Any]) -> None:
    """Write ``report.html``; ``made_of`` is as of :func:`torchstickcal.show.page.page.report_page`."""
    import torch

    from torchstickcal.show.page.page import report_page

    with atomic_path(path) as temporary, torch.inference_mode():
        temporary.write_text(report_page(calibration, made_of), "utf-8")


def versions() -> dict[str, str]:
    """The versions of what calculates."""
    import platform

    packages = ("torchstickcal", "torch", "kornia", "numpy")
    return {name: version_of(name) for name in packages} | {"python": platform.python_version()}
