"""Tasks on an executor: a bounded number at a time, small ones in groups, and none is lost with the process that had it."""

from __future__ import annotations

import itertools
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, BrokenExecutor, CancelledError, Executor, Future, wait
from functools import partial
from typing import Any

from torchstickcal.errors import CalibrationError
from torchstickcal.many.memory import Budget, memory_for_sessions
from torchstickcal.many.task import Done, Performed, Task, error_text, failed_row, perform, use_budget
from torchstickcal.processes import WorkerProcesses

Group = tuple[Task, ...]
Submit = Callable[..., Future[Any]]

_ON_EXECUTORS = 256
"""Groups of tasks that are given at a time to an executor whose size is not known."""
_MOST_TOGETHER = 8
"""Tasks of a group: what is lost if its process is killed, and what is worth calibrating side by side."""
_CARRIED_BYTES = 500_000_000
"""Size of the observations that are on their way at a time, where sessions are given as observations."""
_MOST_DEATHS = 3
"""Processes that a session may take with it before it has failed, and attempts to start processes."""


class _Queue:
    """Tasks in groups: one by one, until it is known how many such sessions are worth calibrating together."""

    def __init__(self, tasks: Iterable[Task], together: int = 1) -> None:
        self._tasks, self._returned, self._together = iter(tasks), deque[Task](), together

    def next_group(self) -> Group:
        """The next tasks; none at the end."""
        group = [self._returned.popleft() for _ in range(min(self._together, len(self._returned)))]
        return (*group, *itertools.islice(self._tasks, self._together - len(group)))

    def learn(self, group: Group, performed: Performed) -> None:
        """Take back what was not done of a group, and note how many of its sessions are worth calibrating together."""
        self._returned.extend(group[len(performed.done) :])
        if performed.together is not None:
            self._together = min(performed.together, _MOST_TOGETHER)


def on_executor(tasks: Iterator[Task], executor: Executor) -> Generator[list[Done]]:
    """Perform tasks on any executor; what is done comes as it is ready.

    Raises:
        CalibrationError: if the executor is broken, after everything that it has done.
    """
    lost = 0
    for group, done in _flight(_Queue(tasks), executor.submit, _ON_EXECUTORS):
        if done is None:
            lost += len(group)
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
) -> Generator[list[Done]]:
    """Perform tasks in processes of this machine; what is done comes as it is ready.

    Where a process is killed, the groups in hand are calibrated again one by one, in new processes, and if that kills one too,
    its sessions one by one. A session whose process is killed every time has failed.

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
    queue = _Queue(itertools.chain([first], tasks))
    lost: list[Group] = []
    deaths: Counter[str] = Counter()
    while True:
        with _started(count, share, prepare) as processes:
            again, lost = lost, []
            while again and not lost:
                alone = again.pop(0)
                for group, done in _flight(_Queue(alone, len(alone)), processes.submit, 1):
                    if done is None:
                        lost += [(task,) for task in group]
                    else:
                        yield done
            if not lost:
                for group, done in _flight(queue, processes.submit, 2 * count):
                    if done is None:
                        lost.append(group)
                    else:
                        yield done
            if not lost and not again:
                return
        deaths.update(task.source.name for group in lost for task in group)
        for group in [group for group in lost if deaths[group[0].source.name] >= _MOST_DEATHS]:
            lost.remove(group)
            yield [(failed_row(task, _KILLED), None) for task in group]
        lost += again


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


def _flight(queue: _Queue, submit: Submit, most: int) -> Iterator[tuple[Group, list[Done] | None]]:
    """Groups as they end, with None for those that were lost with a process; after a loss no further group is begun."""
    flying: dict[Future[Performed], Group] = {}
    broken = False
    while True:
        while not broken and len(flying) < most and _carried_bytes(flying) <= _CARRIED_BYTES:
            group = queue.next_group()
            if not group:
                break
            try:
                flying[submit(perform, group)] = group
            except RuntimeError:  # the executor is broken, or has been shut down
                broken = True
                yield group, None
        if not flying:
            return
        for future in wait(flying, return_when=FIRST_COMPLETED).done:
            group = flying.pop(future)
            performed = _performed(group, future)
            if performed is None:
                broken = True
                yield group, None
            else:
                queue.learn(group, performed)
                yield group, performed.done


def _carried_bytes(flying: dict[Future[Performed], Group]) -> int:
    return sum(task.source.carried_bytes for group in flying.values() for task in group)


def _performed(group: Sequence[Task], future: Future[Performed]) -> Performed | None:
    """What a future has given; None where its process ended first."""
    try:
        return future.result()
    except (BrokenExecutor, CancelledError):
        return None
    except (KeyboardInterrupt, GeneratorExit):
        raise
    except BaseException as error:  # something could not be sent to a process, or back
        if len(group) > 1:
            return Performed([], together=1)
        return Performed([(failed_row(group[0], error_text(error)), None)])
