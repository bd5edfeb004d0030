"""Worker threads: one torch thread each, without a change of the caller's settings."""

from __future__ import annotations

import multiprocessing
import threading

import pytest
import torch

from torchstickcal.workers import map_on_workers, on_worker

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
