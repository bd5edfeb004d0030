"""Tasks on an executor: a bounded number at a time, and no task is lost with the process that had it."""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Generator, Iterator
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from functools import partial
from typing import Any

from torchstickcal.errors import CalibrationError
from torchstickcal.many.manifest import SessionRow
from torchstickcal.many.memory import Budget, memory_for_sessions
from torchstickcal.many.task import Task, error_text, failed_row, perform, use_budget
from torchstickcal.processes import WorkerProcesses
from torchstickcal.result import Calibration

Done = tuple[SessionRow, Calibration | None]
Submit = Callable[..., Future[Any]]

_ON_EXECUTORS = 256
"""Tasks that are given at a time to an executor whose size is not known."""
_CARRIED_BYTES = 500_000_000
"""Size of the observations that are on their way at a time, where sessions are given as observations."""
_MOST_DEATHS = 3
"""Processes that a session may take with it before it has failed, and attempts to start processes."""


def on_executor(tasks: Iterator[Task], executor: Executor) -> Generator[Done]:
    """Perform tasks on any executor; what is done comes as it is ready.

    Raises:
        CalibrationError: if the executor is broken, after everything that it has done.
    """
    lost = 0
    for _, done in _flight(tasks, executor.submit, _ON_EXECUTORS):
        if done is None:
            lost += 1
        else:
            yield done
    if lost:
        raise CalibrationError(
            "the executor is broken",
            where="executor",
            got=f"{lost} sessions that it took and did not finish",
            expected="an executor whose processes live",
            remedy="The same call with another executor and the same folder goes on with the sessions that are missing.",
        )


def on_processes(
    tasks: Iterator[Task], count: int, memory_bytes: int | None, prepare: Callable[[], object] | None
) -> Generator[Done]:
    """Perform tasks in processes of this machine; what is done comes as it is ready.

    Where a process is killed, the sessions in hand are calibrated again one by one, in new processes. A session whose process
    is killed every time has failed.

    Args:
        tasks: what is to be done.
        count: number of processes.
        memory_bytes: that this process and the others may need together; None for any.
        prepare: called first in each process.

    Raises:
        CalibrationError: if processes cannot be started, or if they would need more memory than there is.
    """
    share = None if memory_bytes is None else memory_for_sessions(memory_bytes, count)
    first = next(tasks, None)
    if first is None:
        return
    tasks = itertools.chain([first], tasks)
    lost: list[Task] = []
    deaths: Counter[str] = Counter()
    while True:
        with _started(count, share, prepare) as processes:
            again, lost = lost, []
            while again and not lost:
                for task, done in _flight(iter([again.pop(0)]), processes.submit, 1):
                    if done is None:
                        lost.append(task)
                    else:
                        yield done
            lost += again
            if not lost:
                for task, done in _flight(tasks, processes.submit, 2 * count):
                    if done is None:
                        lost.append(task)
                    else:
                        yield done
            if not lost:
                return
        deaths.update(task.source.name for task in lost if task not in again)
        for task in [task for task in lost if deaths[task.source.name] >= _MOST_DEATHS]:
            lost.remove(task)
            yield failed_row(task, _KILLED), None


_KILLED = (
    f"the process that calibrated it was killed {_MOST_DEATHS} times; where that was for want of memory, allow fewer processes "
    "or less memory"
)


def _started(count: int, memory_bytes: int | None, prepare: Callable[[], object] | None) -> WorkerProcesses:
    """Processes of which one has already answered.

    Raises:
        CalibrationError: if they end instead.
    """
    for _ in range(_MOST_DEATHS):
        budget = None if memory_bytes is None else Budget(memory_bytes)
        processes = WorkerProcesses(count, partial(use_budget, budget, prepare))
        try:
            processes.submit(abs, 0).result()
            return processes
        except BrokenExecutor:
            processes.end()
        except BaseException:
            processes.end()
            raise
    raise CalibrationError(
        "worker processes cannot be started",
        where="executor",
        got="processes that end at once",
        expected='a program whose main part stands below `if __name__ == "__main__":`',
        remedy="Each process imports the program anew. What it has printed to standard error says why it ended.",
    )


def _flight(tasks: Iterator[Task], submit: Submit, most: int) -> Iterator[tuple[Task, Done | None]]:
    """Tasks as they end, with None for those that were lost with a process; after a loss no further task is begun."""
    flying: dict[Future[Done], Task] = {}
    broken = False
    while True:
        while not broken and len(flying) < most and _carried_bytes(flying) <= _CARRIED_BYTES:
            task = next(tasks, None)
            if task is None:
                break
            try:
                flying[submit(perform, task)] = task
            except RuntimeError:  # the executor is broken, or has been shut down
                broken = True
                yield task, None
        if not flying:
            return
        for future in wait(flying, return_when=FIRST_COMPLETED).done:
            task = flying.pop(future)
            done = _done(task, future)
            broken = broken or done is None
            yield task, done


def _carried_bytes(flying: dict[Future[Done], Task]) -> int:
    return sum(task.source.carried_bytes for task in flying.values())


def _done(task: Task, future: Future[Done]) -> Done | None:
    """What a future has given; None where its process ended first."""
    try:
        return future.result()
    except (BrokenExecutor, CancelledError):
        return None
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:  # it could not be sent to a process, or back
        return failed_row(task, error_text(error)), None
