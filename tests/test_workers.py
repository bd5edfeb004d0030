"""Worker threads: one torch thread each, without a change of the caller's settings."""

from __future__ import annotations

import faulthandler
import multiprocessing
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor

import pytest
import torch

from torchstickcal import calibrate, workers
from torchstickcal.lazy import cached_property
from torchstickcal.losses import CameraPointLoss, Loss, ReprojectionLoss, SmoothnessLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.simulate import golf_session
from torchstickcal.solvers.elimination.evaluated import Gradient
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.workers import map_on_workers, map_with_idle_workers, on_worker

CPU = torch.device("cpu")


def test_workers_have_one_torch_thread_and_other_threads_keep_theirs():
    before = torch.get_num_threads()
    assert on_worker(CPU, torch.get_num_threads) == 1
    later: list[int] = []
    thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert (torch.get_num_threads(), later) == (before, [before])


def test_workers_use_the_gradient_mode_of_the_caller():
    x = torch.ones(2, requires_grad=True)
    assert on_worker(CPU, torch.square, x).requires_grad
    with torch.no_grad():
        assert not on_worker(CPU, torch.square, x).requires_grad


def test_order_nested_calls_and_errors():
    assert map_on_workers(CPU, lambda k: on_worker(CPU, lambda: 2 * k), range(20)) == list(range(0, 40, 2))
    with pytest.raises(ZeroDivisionError):
        on_worker(CPU, lambda: 1 / 0)


@pytest.fixture
def two_workers(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    with ThreadPoolExecutor(2, initializer=workers._initialise_worker) as pool:
        monkeypatch.setattr(workers, "_pool", pool)
        yield


@pytest.mark.usefixtures("two_workers")
def test_idle_workers_help():
    both = threading.Barrier(2, timeout=20)
    assert on_worker(CPU, map_with_idle_workers, lambda _: both.wait() >= 0, range(2)) == [True, True]
    assert on_worker(CPU, map_with_idle_workers, lambda k: 2 * k, range(50)) == list(range(0, 100, 2))
    with pytest.raises(ZeroDivisionError):
        on_worker(CPU, map_with_idle_workers, lambda k: 1 // (k - 3), range(9))


@pytest.mark.usefixtures("two_workers")
def test_busy_workers_do_not_wait_for_each_other():
    both = threading.Barrier(2, timeout=20)

    def busy(first: int) -> list[int]:
        both.wait()  # no worker is idle
        return map_with_idle_workers(lambda k: first + k, range(20))

    assert map_on_workers(CPU, busy, [0, 100]) == [list(range(20)), list(range(100, 120))]


@pytest.mark.usefixtures("two_workers")
@pytest.mark.parametrize("losses", [{"r": ReprojectionLoss()}, {"r": ReprojectionLoss(), "s": SmoothnessLoss(0.05)}])
def test_help_does_not_change_a_bit(
    disturbed: tuple[Measurements, State], losses: dict[str, Loss], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("torchstickcal.model.measurements._CHUNK_KEYPOINTS", {"cpu": 200})
    monkeypatch.setattr("torchstickcal.solvers.elimination.parts._MAX_TRACK_POINTS", 90)
    m, state = disturbed

    def step() -> tuple[torch.Tensor, ...]:
        system = NormalEquations(Objective(m, losses), state, True, 1e-5)
        value = Gradient(Objective(m, losses), state, True)
        return *system.step(), value.cost, value.point_gradient, value.camera_gradient, m.squared_residuals(state)

    for alone, helped in zip(step(), on_worker(CPU, step), strict=True):
        assert torch.equal(alone, helped)


@pytest.mark.usefixtures("two_workers")
def test_gradients_of_what_several_threads_have_computed(
    disturbed: tuple[Measurements, State], monkeypatch: pytest.MonkeyPatch
):
    m, state = disturbed
    leaves = state.leaves()

    def gradients() -> tuple[torch.Tensor, ...]:
        squared = m.squared_residuals(leaves)
        return torch.autograd.grad(squared[squared.isfinite()].sum(), [leaves.points, leaves.translations])

    expected = gradients()
    monkeypatch.setattr("torchstickcal.model.measurements._CHUNK_KEYPOINTS", {"cpu": 50})
    for _ in range(20):
        for found, right in zip(on_worker(CPU, gradients), expected, strict=True):
            torch.testing.assert_close(found, right, rtol=1e-9, atol=1e-9)


@pytest.mark.usefixtures("two_workers")
def test_derivatives_of_own_losses_in_several_threads(disturbed: tuple[Measurements, State]):
    """Dual numbers exist in one thread at a time."""
    m, state = disturbed
    given = state.in_cameras(), torch.ones_like(state.in_cameras()), m.pixels, m.confidence, m.cameras
    expected = CameraPointLoss.slope(ReprojectionLoss(), *given)

    def slopes(_: int) -> bool:
        return all(torch.equal(CameraPointLoss.slope(ReprojectionLoss(), *given), expected) for _ in range(30))

    assert map_on_workers(CPU, slopes, range(4)) == [True] * 4


def _threads_in_child(queue: multiprocessing.SimpleQueue[int]) -> None:
    queue.put(on_worker(CPU, torch.get_num_threads))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="the system cannot fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_has_its_own_workers():
    on_worker(CPU, torch.get_num_threads)
    context = multiprocessing.get_context("fork")
    queue: multiprocessing.SimpleQueue[int] = context.SimpleQueue()
    child = context.Process(target=_threads_in_child, args=(queue,))
    child.start()
    child.join(20)
    assert child.exitcode == 0
    assert queue.get() == 1


def _calibrate_in_child(seconds: float) -> None:
    faulthandler.dump_traceback_later(seconds, exit=True)
    os._exit(0 if calibrate(golf_session(cameras=3, frames=10)[0]).converged else 2)


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="the system cannot fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_processes_forked_during_calibrations_can_calibrate():
    """Whatever lock another thread holds at that moment."""
    observations, stop = golf_session(cameras=3, frames=10)[0], threading.Event()

    def calibrate_again_and_again() -> None:
        while not stop.is_set():
            calibrate(observations, refine="auto")

    calibrate(observations)
    thread = threading.Thread(target=calibrate_again_and_again)
    thread.start()
    try:
        context = multiprocessing.get_context("fork")
        children = []
        for moment in range(8):
            stop.wait(0.02 * moment)
            children.append(context.Process(target=_calibrate_in_child, args=(30.0,)))
            children[-1].start()
        for child in children:
            child.join(40)
        assert [child.exitcode for child in children] == [0] * 8
    finally:
        stop.set()
        thread.join()


def test_no_value_is_computed_under_a_lock():
    """A process that is forked while a value is computed computes it itself; another thread does not wait either."""
    begun, go_on = threading.Event(), threading.Event()

    class Slow:
        calls = 0

        @cached_property
        def value(self) -> int:
            self.calls += 1
            if self.calls == 1:
                begun.set()
                assert go_on.wait(20)
            return 3

    slow = Slow()
    thread = threading.Thread(target=lambda: slow.value)
    thread.start()
    assert begun.wait(20)
    assert slow.value == 3
    go_on.set()
    thread.join()
    assert (slow.value, slow.calls) == (3, 2)


def test_no_more_workers_than_processors():
    code = (
        "import os, threading, torch\ntorch.set_num_threads(500)\n"
        "from torchstickcal.workers import on_worker\non_worker(torch.device('cpu'), torch.get_num_threads)\n"
        "assert torch.get_num_threads() == 500 and threading.active_count() <= 1 + os.cpu_count()"
    )
    subprocess.run([sys.executable, "-c", code], check=True)
