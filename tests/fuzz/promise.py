"""What must hold of every input: a result that is true, or one of the library's own errors, in bounded time and memory."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import os
import pickle
import resource
import select
import signal
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import torch
from hypothesis import HealthCheck, Phase, settings
from torch import Tensor

from torchstickcal import Calibration, CalibrationError
from torchstickcal.io import read_camera_toml, write_camera_toml
from torchstickcal.show.page.page import report_page
from torchstickcal.show.report import summary, table

LARGE = os.environ.get("TORCHSTICKCAL_FUZZ") == "large"
"""Whether `make fuzz` runs, not `make test`."""

SECONDS = 20.0
"""Most time of the processor that one case may take."""
MEMORY = 3 << 30
"""Most address space that one case may add to the process, bytes."""
FILE_MEMORY = 128 << 20
"""Most memory that reading one small file may add to the process, bytes."""
LONGEST_MESSAGE = 3000
"""Characters."""

TALLIES: dict[str, Counter[str]] = {}
"""For each subject, how many cases ended in which way."""


class FaultError(AssertionError):
    """The promise is broken."""


def budget(small: int, large: int) -> settings:
    """The number of cases in `make test` and in `make fuzz`. The same cases every time; `make fuzz SEED=1` tries others."""
    return settings(
        max_examples=large if LARGE else small,
        derandomize=not LARGE,
        database=None,
        deadline=None,
        phases=(Phase.explicit, Phase.generate, Phase.shrink),
        suppress_health_check=list(HealthCheck),
        print_blob=False,
    )


@contextlib.contextmanager
def case(subject: str) -> Iterator[Callable[[str], None]]:
    """A block that tries one case: the library's own errors end it well, all others break the promise.

    Gives a function to say how the case ended, if not in an error.
    """
    tally, said = TALLIES.setdefault(subject, Counter()), ["accepted"]
    tally["cases"] += 1
    refusal: CalibrationError | None = None
    before = time.process_time()
    try:
        with _little_memory():
            yield said.append
        seconds = time.process_time() - before
        assert seconds < SECONDS, f"{seconds:.0f} s for one small case"
    except CalibrationError as error:
        refusal = error
        said.append("refused")
    except BaseException:
        tally["faults"] += 1
        raise
    if refusal is not None:
        check_error(refusal)
    tally[said[-1]] += 1


def check_shares(subject: str, *ways: str, at_least: float) -> None:
    """The suite is worth its name: enough of the cases of a subject, if they were tried, ended in one of these ways.

    Few cases may miss the share by chance: they fail only where that is three standard deviations away.
    """
    tally = TALLIES.get(subject, Counter(cases=0))
    expected, chance = at_least * tally["cases"], (at_least * (1 - at_least) * tally["cases"]) ** 0.5
    assert sum(tally[way] for way in ways) >= expected - 3 * chance, tally


@contextlib.contextmanager
def _little_memory() -> Iterator[None]:
    """A block that may not take more than :data:`MEMORY`: what wants more gets an error instead of the whole machine."""
    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    pages = Path("/proc/self/statm")
    if pages.exists():
        used = int(pages.read_text().split()[0]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_AS, (used + MEMORY, hard))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def check_error(error: CalibrationError) -> None:
    """One message that says what and where, and that another process would show unchanged."""
    message = str(error)
    assert error.what
    assert error.where
    assert error.expected
    assert len(message) < LONGEST_MESSAGE, message[:LONGEST_MESSAGE]
    again = pickle.loads(pickle.dumps(error))
    assert type(again) is type(error)
    assert str(again) == message


def check_calibration(calibration: Calibration) -> None:
    """A status that is true, and a result that files and tables can hold."""
    assert calibration.status
    assert calibration.converged == (calibration.status == "converged")
    assert calibration.rotations.is_floating_point()
    if calibration.converged:
        _check_converged(calibration)
    with tempfile.TemporaryDirectory() as folder:
        calibration.save(Path(folder, "points.npz"))
        check_equal(Calibration.load(Path(folder, "points.npz")), calibration)
        if calibration.converged:
            write_camera_toml(Path(folder, "calibration.toml"), calibration)
            rig = read_camera_toml(Path(folder, "calibration.toml"))
            assert rig.names == calibration.camera_names
            assert torch.equal(rig.translations, calibration.translations.double())
    assert table(calibration)
    json.dumps(summary(calibration), allow_nan=False)
    assert calibration.quality.verdict in report_page(calibration)
    assert calibration._repr_html_()


def _check_converged(calibration: Calibration) -> None:
    """Finite and determined: every camera has inliers, and there are more measurements than unknowns."""
    inliers, cameras = calibration.inliers, len(calibration.rotations)
    for name in ("rotations", "translations", "intrinsics", "camera_centres", "reprojection_median_px"):
        assert bool(getattr(calibration, name).isfinite().all()), f"{name} is not finite"
    assert bool(inliers.flatten(1).any(1).all()), "a camera has no inlier"
    assert bool(calibration.residuals_px[inliers].isfinite().all()), "residuals of inliers are not finite"
    check_rotations(calibration.rotations)
    known = calibration.points.isfinite().all(-1)
    measured = 2 * int(inliers.sum()) + int(calibration.stick_lengths_m.isfinite().sum())
    unknown = 6 * (cameras - 1) + 3 * int(known.sum())
    assert measured > unknown, f"{measured} measurements of {unknown} unknowns"


def check_rotations(rotations: Tensor) -> None:
    """Orthonormal and right-handed, within the rounding of their dtype."""
    tolerance = 100 * torch.finfo(rotations.dtype).eps
    exact = rotations.detach().double()
    assert torch.allclose(exact @ exact.mT, torch.eye(3).to(exact), atol=tolerance, rtol=0), "rotations are not orthonormal"
    assert bool((exact.det() > 0).all()), "a rotation is a mirror"


def check_equal(one: Any, other: Any, where: str = "") -> None:
    """Two results hold the same: tensors to the bit and NaN where NaN. Fields that take no part in comparisons may differ."""
    assert type(one) is type(other) or isinstance(one, Mapping), where
    if isinstance(one, Tensor):
        assert one.dtype == other.dtype, where
        assert torch.equal(one.isnan(), other.isnan()), where
        assert torch.equal(one.nan_to_num(), other.nan_to_num()), where
    elif dataclasses.is_dataclass(one):
        for field in filter(lambda field: field.compare, dataclasses.fields(one)):
            check_equal(getattr(one, field.name), getattr(other, field.name), f"{where}.{field.name}")
    elif isinstance(one, Mapping):
        assert list(one) == list(other), where
        for key in one:
            check_equal(one[key], other[key], f"{where}[{key!r}]")
    elif isinstance(one, tuple):
        assert len(one) == len(other), where
        for number, (mine, others) in enumerate(zip(one, other, strict=True)):
            check_equal(mine, others, f"{where}[{number}]")
    else:
        assert one == other or (one != one and other != other), f"{where}: {one!r} is not {other!r}"


def read_in_a_child(read: Callable[[], object]) -> str:
    """Read a file in a process of its own, so that a crash, its time and its memory can be measured.

    Returns:
        "accepted", or "refused" for one of the library's own errors or of the operating system.

    Raises:
        FaultError: if it ended in any other way.
    """
    receiving, sending = os.pipe()
    child = os.fork()
    if child == 0:
        os.close(receiving)
        _report(read, sending)
    os.close(sending)
    try:
        in_time = bool(select.select([receiving], [], [], SECONDS)[0])
        if not in_time:
            os.kill(child, signal.SIGKILL)
        with os.fdopen(receiving, "rb") as file:
            answer = file.read()
    finally:
        status = os.waitpid(child, 0)[1]
    if not in_time:
        raise FaultError(f"not read within {SECONDS:g} s")
    if not answer:
        raise FaultError(f"the process died: wait status {status}")
    ended, text = json.loads(answer)
    if ended == "fault":
        raise FaultError(text)
    return ended


def _report(read: Callable[[], object], sending: int) -> None:
    """Read, write how it ended, and leave the child process without cleaning up what is its parent's."""
    try:
        before = _peak_bytes()
        with _little_memory():
            ended = _ending(read)
        if (taken := _peak_bytes() - before) > FILE_MEMORY:
            ended = "fault", f"{taken >> 20} MB of memory for a file of a few kilobytes"
        os.write(sending, json.dumps(ended).encode())
    finally:
        os._exit(0)


def _ending(read: Callable[[], object]) -> tuple[str, str]:
    try:
        read()
    except CalibrationError as error:
        check_error(error)
        return "refused", ""
    except OSError:
        return "refused", ""
    except BaseException:
        return "fault", traceback.format_exc()[-2000:]
    return "accepted", ""


def _peak_bytes() -> int:
    """Most memory that this process has had so far."""
    return 1024 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
