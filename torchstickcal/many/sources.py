"""Where sessions come from: files, observations, or functions that make them. Nothing is read before its turn."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence, Sized
from dataclasses import dataclass, replace
from pathlib import Path
from typing import cast

from torchstickcal.errors import CalibrationError, FileFormatError, quoted
from torchstickcal.files import check_text
from torchstickcal.io import KEYPOINT_READERS, SESSION_READERS, Given, LoadedSession, find_reader, load_session
from torchstickcal.io.formats import is_folder
from torchstickcal.io.recording import in_folder
from torchstickcal.observations import Observations
from torchstickcal.untrusted import read_bytes, reading

LIST_SUFFIX = ".txt"
"""The end of the name of a list of sessions."""
_LONGEST_NAME = 1000


@dataclass(frozen=True)
class SessionFile:
    """A session in files; called without arguments, it reads them.

    Args:
        path: file or folder of a session; or several, one for each camera.
        format: name of its format; None to recognise it by its content.
        given: what the files do not say.
        change: called with what was read, returns what is calibrated; an object whose ``repr`` says what it does, such as a
            dataclass.
    """

    path: str | Path | Sequence[str | Path]
    format: str | None = None
    given: Given | None = None
    change: Callable[[Observations], Observations] | None = None

    def __call__(self) -> LoadedSession:
        loaded = load_session(self.path, self.format, self.given)
        return loaded if self.change is None else replace(loaded, observations=self.change(loaded.observations))


SessionLike = str | Path | Observations | Callable[[], Observations | LoadedSession]
"""A session: its path, its observations, or a function without arguments that makes them when their turn comes.

Other processes must be able to import the function: it stands at the top of a module, or is a :func:`functools.partial` of such
a one, or a :class:`SessionFile`.
"""


@dataclass(frozen=True, eq=False)
class Source:
    """A session that can be loaded, with its name."""

    name: str
    session: SessionLike

    @property
    def origin(self) -> str:
        """Where it comes from, for people."""
        if isinstance(self.session, SessionFile):
            path = self.session.path
            return str(path) if isinstance(path, str | Path) else ", ".join(map(str, path))
        if isinstance(self.session, str | Path):
            return str(self.session)
        return "observations" if isinstance(self.session, Observations) else "function"

    @property
    def options(self) -> str:
        """How the files are read, as a text that is the same for the same options."""
        return repr(replace(self.session, path="")) if isinstance(self.session, SessionFile) else ""

    @property
    def carried_bytes(self) -> int:
        """Memory that it needs before it is loaded."""
        return keypoint_bytes(self.session) if isinstance(self.session, Observations) else 0

    def load(self) -> LoadedSession:
        """The session.

        Raises:
            CalibrationError: if it cannot be read, or if a function returns something else than a session.
        """
        session = SessionFile(self.session) if isinstance(self.session, str | Path) else self.session
        loaded = session if isinstance(session, Observations) else session()
        if isinstance(loaded, Observations):
            return LoadedSession(loaded, None)
        if not isinstance(loaded, LoadedSession):
            raise CalibrationError(
                "a function that makes a session returns something else",
                where=self.name,
                got=type(loaded).__name__,
                expected="Observations, or a LoadedSession",
            )
        return loaded


def keypoint_bytes(observations: Observations) -> int:
    """Size of the keypoints of a session, bytes."""
    return observations.keypoints.numel() * observations.keypoints.element_size()


def sources_of(sessions: Mapping[str, SessionLike] | Iterable[SessionLike]) -> tuple[Iterator[Source], int | None]:
    """The sessions with their names, and how many there are if that is known.

    A mapping gives the names. Otherwise the name of a file is its path as given, and that of anything else is its number, from
    ``000000``. What has a length is checked at once, other iterables while they are used.

    Raises:
        CalibrationError: if two sessions have one name, for a name that cannot be written, and for what is no session; from the
            iterator where the length is not known.

    Example:
        >>> found, count = sources_of(["left/a.npz", "b.npz"])
        >>> [source.name for source in found], count
        (['left/a.npz', 'b.npz'], 2)
    """
    if isinstance(sessions, str | Path | Observations) or not isinstance(sessions, Iterable):
        raise CalibrationError(
            "not several sessions", where="sessions", got=quoted(sessions), expected="a list, a mapping, or another iterable"
        )
    found = _named(sessions)
    if not isinstance(sessions, Sized):
        return found, None
    every = list(found)
    return iter(every), len(every)


def session_files(
    paths: Sequence[str | Path],
    format: str | None = None,
    given: Given | None = None,
    change: Callable[[Observations], Observations] | None = None,
) -> dict[str, SessionFile]:
    """The sessions of folders and lists, by their names.

    Args:
        paths: each is a session, a folder of sessions, or a list: a ``.txt`` file with a path on each line, relative to the
            folder of the list; empty lines and lines that begin with ``#`` are left out. Every file and folder in a folder of
            sessions counts as one, but hidden ones.
        format: name of the format of all of them; None to recognise it by the content.
        given: what the files do not say.
        change: as of :class:`SessionFile`.

    Returns:
        The sessions in natural order of their names (or in that of the list). The name of a session in the only folder is its
        name there; that of another one is its path as given.

    Raises:
        CalibrationError: if there is no session, or if two have one name.
        FileNotFoundError: if there is no such file.

    Example:
        >>> import pathlib, tempfile
        >>> with tempfile.TemporaryDirectory() as folder:
        ...     for name in ("swing10.npz", "swing2.npz"):
        ...         _ = pathlib.Path(folder, name).write_bytes(b"...")
        ...     list(session_files([folder]))
        ['swing2.npz', 'swing10.npz']
    """
    found: dict[str, SessionFile] = {}
    for path in map(Path, paths):
        for name, session in _sessions_at(path, format, alone=len(paths) == 1):
            if name in found:
                raise _twice(name)
            found[name] = SessionFile(session.absolute(), format, given, change)
    if not found:
        where = ", ".join(map(str, paths)) or "sessions"
        raise CalibrationError("no sessions", where=where, got="none", expected="sessions, folders of sessions, or lists")
    return found


def _sessions_at(path: Path, format: str | None, alone: bool) -> Iterator[tuple[str, Path]]:
    """Names and paths of the sessions that a path of :func:`session_files` stands for."""
    if is_folder(path) and not _is_session(path, format):
        for entry in in_folder(path):
            yield entry.name if alone else entry.as_posix(), entry
    elif path.suffix.lower() == LIST_SUFFIX:
        with reading(path, "a list of sessions: a path on each line, in UTF-8"):
            lines = read_bytes(path).decode("utf-8-sig").splitlines()
        for line in lines:
            if (text := line.strip()) and not text.startswith("#"):
                yield text, path.parent / text
    elif not os.path.lexists(path):
        raise FileNotFoundError(f"no such file or folder: {path}")
    else:
        yield path.as_posix(), path


def _is_session(folder: Path, format: str | None) -> bool:
    """Whether a folder is one session, by its content."""
    if format is not None:
        registry = KEYPOINT_READERS if format in KEYPOINT_READERS else SESSION_READERS
        return registry[format].takes(folder, b"")
    try:
        find_reader(folder, SESSION_READERS, KEYPOINT_READERS)
    except FileFormatError:
        return False
    return True


def _named(sessions: Mapping[str, SessionLike] | Iterable[SessionLike]) -> Iterator[Source]:
    """Sessions with their names, checked."""
    names: set[str] = set()
    pairs = sessions.items() if isinstance(sessions, Mapping) else ((None, session) for session in sessions)
    for number, (given, session) in enumerate(pairs):
        if not isinstance(session, str | Path | Observations) and not callable(session):
            raise CalibrationError(
                "not a session",
                where=f"sessions[{number if given is None else given!r}]",
                got=type(session).__name__,
                expected="a path, Observations, or a function without arguments that returns them",
            )
        own = Path(session).as_posix() if isinstance(session, str | Path) else f"{number:06d}"
        name = own if given is None else given
        if not isinstance(name, str) or not 0 < len(name) <= _LONGEST_NAME:
            raise CalibrationError(
                "not a name", where="sessions", got=quoted(name), expected=f"a text of 1 to {_LONGEST_NAME} characters"
            )
        check_text(name, "sessions")
        if name in names:
            raise _twice(name)
        names.add(name)
        yield Source(name, Path(session).absolute() if isinstance(session, str | Path) else cast(SessionLike, session))


def _twice(name: str) -> CalibrationError:
    return CalibrationError("two sessions of one name", where="sessions", got=quoted(name), expected="a name for each session")
