"""Threads of our own: one torch thread each, the caller's settings untouched."""

from __future__ import annotations

import multiprocessing
import threading

import pytest
import torch

from torchstickcal.workers import map_on_workers, on_worker

CPU = torch.device("cpu")


def test_workers_have_one_thread_and_nobody_else_notices():
    before = torch.get_num_threads()
    assert on_worker(CPU, torch.get_num_threads) == 1
    later: list[int] = []
    thread = threading.Thread(target=lambda: later.append(torch.get_num_threads()))
    thread.start()
    thread.join()
    assert (torch.get_num_threads(), later) == (before, [before])


def test_gradients_are_recorded_as_the_caller_wishes():
    x = torch.ones(2, requires_grad=True)
    assert on_worker(CPU, torch.square, x).requires_grad
    with torch.no_grad():
        assert not on_worker(CPU, torch.square, x).requires_grad


def test_order_errors_and_work_within_work():
    assert map_on_workers(CPU, lambda k: on_worker(CPU, lambda: 2 * k), range(20)) == list(range(0, 40, 2))
    with pytest.raises(ZeroDivisionError):
        on_worker(CPU, lambda: 1 / 0)


def _threads_in_child(queue: multiprocessing.SimpleQueue[int]) -> None:
    queue.put(on_worker(CPU, torch.get_num_threads))


@pytest.mark.skipif("fork" not in multiprocessing.get_all_start_methods(), reason="the system cannot fork")
@pytest.mark.filterwarnings("ignore::DeprecationWarning")
def test_a_forked_process_has_its_own():
    on_worker(CPU, torch.get_num_threads)
    context = multiprocessing.get_context("fork")
    queue: multiprocessing.SimpleQueue[int] = context.SimpleQueue()
    child = context.Process(target=_threads_in_child, args=(queue,))
    child.start()
    child.join(20)
    assert child.exitcode == 0
    assert queue.get() == 1
