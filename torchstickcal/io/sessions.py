"""Sessions from files of any format, with what the user adds to them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from torchstickcal.errors import CalibrationError, ConfigError
from torchstickcal.io.formats import KEYPOINT_READERS, SESSION_READERS, Session, find_reader, reader_of, session_of
from torchstickcal.io.given import Given, amended, complete
from torchstickcal.io.recording import Recording
from torchstickcal.io.truth import Truth
from torchstickcal.observations import Observations
from torchstickcal.registry import suggestion
from torchstickcal.untrusted import reading


@dataclass(frozen=True, eq=False)
class LoadedSession:
    """A session that was read."""

    observations: Observations
    truth: Truth | None
    """None if the files hold none"""
    notes: tuple[str, ...] = ()
    """sentences about how the files were understood: matched cameras, the skeleton, who the athlete is"""


def load_session(
    path: str | Path | Sequence[str | Path], format: str | None = None, given: Given | None = None
) -> LoadedSession:
    """Read a session from files of any format, with sentences about how they were understood.

    Args:
        path: of the file or the folder; or several, one for each camera.
        format: name of its format, a key of :data:`SESSION_READERS` or :data:`KEYPOINT_READERS`; None to recognise it by its
            content.
        given: what the files do not say; needed for keypoints of detectors, which have no stick.

    Raises:
        CalibrationError: as :func:`read_session`.
        FileNotFoundError: if there is no such file.

    Example: see :func:`read_session`.
    """
    given = given or Given()
    paths = [path] if isinstance(path, str | Path) else list(path)
    contents = [_content(one, format) for one in paths]
    if len(contents) == 1 and not isinstance(contents[0], Recording):
        observations, truth = contents[0]
        observations, notes = amended(observations, given)
        return LoadedSession(*session_of(observations, truth), notes)
    recordings = [content for content in contents if isinstance(content, Recording)]
    if len(recordings) != len(contents) or not recordings:
        raise CalibrationError(
            "several files that are not one camera each",
            where=", ".join(map(str, paths)) or "session",
            got=f"{len(contents) - len(recordings)} whole sessions among {len(contents)} files",
            expected="one session, or keypoints of one camera in each file",
        )
    where = ", ".join(map(str, paths))
    with reading(where, "keypoints of the cameras of one rig"):
        recording = recordings[0] if len(recordings) == 1 else _joined(recordings)
        observations, notes = complete(recording, given)
    return LoadedSession(*session_of(observations, None), notes)


def read_session(path: str | Path | Sequence[str | Path], format: str | None = None, given: Given | None = None) -> Session:
    """Read a session: keypoints, intrinsics, sticks, and the truth if the file holds it.

    Args:
        path: of the file or the folder; or several, one for each camera.
        format: name of its format, a key of :data:`SESSION_READERS` or :data:`KEYPOINT_READERS`; None to recognise it by its
            content.
        given: what the files do not say; needed for keypoints of detectors, which have no stick.

    Returns:
        The observations, and the truth or None.

    Raises:
        FileFormatError: if no format is recognised, or if the file is damaged or cannot be opened.
        CalibrationError: if something is not known, or what is given does not fit to the files.
        ConfigError: for an unknown format.
        ObservationError: if the session cannot be used for a calibration.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import tempfile
        >>> from torchstickcal.io import read_session, write_npz
        >>> from torchstickcal.simulate import golf_session
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     write_npz(f"{folder}/swing.npz", *golf_session(cameras=3, frames=10))
        ...     observations, truth = read_session(f"{folder}/swing.npz")
        >>> observations.keypoints.shape, truth.rotations.shape
        (torch.Size([3, 10, 21, 2]), torch.Size([3, 3, 3]))
    """
    loaded = load_session(path, format, given)
    return loaded.observations, loaded.truth


def read_recording(path: str | Path, format: str | None = None) -> Recording:
    """Read the keypoints that a detector wrote.

    Args:
        path: of the file or the folder.
        format: name of its format, a key of :data:`KEYPOINT_READERS`; None to recognise it by its content.

    Raises:
        FileFormatError: if no format is recognised, or if the file is damaged or cannot be opened.
        ConfigError: for an unknown format.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import json, pathlib, tempfile
        >>> from torchstickcal.io import read_recording
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for camera in ("left", "right"):
        ...         person = {"pose_keypoints_2d": [10, 20, 0.9, 0, 0, 0]}
        ...         pathlib.Path(folder, camera).mkdir()
        ...         _ = pathlib.Path(folder, camera, "0.json").write_text(json.dumps({"people": [person]}))
        ...     recording = read_recording(folder)
        >>> [view.name for view in recording.views], recording.num_points
        (['left', 'right'], 2)
    """
    return reader_of(path, KEYPOINT_READERS, format).read(path)


def _content(path: str | Path, format: str | None) -> Session | Recording:
    if format is None:
        return find_reader(path, SESSION_READERS, KEYPOINT_READERS).read(path)
    if format in KEYPOINT_READERS:
        return KEYPOINT_READERS[format].read(path)
    if format in SESSION_READERS:
        return SESSION_READERS[format].read(path)
    known = [*SESSION_READERS, *KEYPOINT_READERS]
    raise ConfigError(
        "unknown session format",
        where="format",
        got=repr(format),
        expected=f"one of {', '.join(known)}",
        remedy=suggestion(format, known),
    )


def _joined(recordings: Sequence[Recording]) -> Recording:
    """The recording of the cameras of several."""
    joined = Recording.of([view for recording in recordings for view in recording.views])
    first = recordings[0]
    notes = tuple(dict.fromkeys(note for recording in recordings for note in recording.notes))
    return replace(joined, fps=first.fps, intrinsics=first.intrinsics, skeleton=first.skeleton, notes=notes)
