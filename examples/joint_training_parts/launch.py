"""The command line of both experiments: sizes, seeds, processes, and the table at the end."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

import torch
import torch.distributed as dist
from torch import Tensor


def options_of(parser: argparse.ArgumentParser, **sizes: tuple[int, int]) -> argparse.Namespace:
    """Options from the command line.

    Args:
        parser: with the option ``--full``.
        sizes: further options, numbers: of a short run, and of a full one.
    """
    for name, (short, full) in sizes.items():
        parser.add_argument(f"--{name}", type=int, help=f"default: {short}, and {full} with --full")
    options = parser.parse_args()
    for name, (short, full) in sizes.items():
        if getattr(options, name) is None:
            setattr(options, name, full if options.full else short)
    return options


@contextmanager
def processes() -> Iterator[None]:
    """Run as the only process, or as one of several of torchrun, with its share of the cores."""
    count = int(os.environ.get("WORLD_SIZE", "1"))
    cores = int(os.environ.get("OMP_NUM_THREADS", os.cpu_count() or 1)) if count == 1 else (os.cpu_count() or 1) // count
    torch.set_num_threads(max(1, cores))
    if count > 1:
        dist.init_process_group("gloo")
    try:
        yield
    finally:
        if count > 1:
            dist.destroy_process_group()


def is_first() -> bool:
    """Whether this is the only process, or the first of several."""
    return not dist.is_initialized() or dist.get_rank() == 0


def repeat(experiment: Callable[[int], dict[str, Tensor]], seeds: int) -> None:
    """Repeat an experiment, and print the mean of its results after each time.

    Args:
        experiment: gives errors (n,) by method for a seed.
        seeds: how often.
    """
    found: list[dict[str, Tensor]] = []
    for seed in range(seeds):
        began, used = time.perf_counter(), time.process_time()
        torch.manual_seed(seed)
        found.append(experiment(seed))
        if is_first():
            print(f"\nseed {seed}: {time.perf_counter() - began:.0f} s, {time.process_time() - used:.0f} s of CPU", flush=True)
            print(table(found), flush=True)


def table(found: list[dict[str, Tensor]]) -> str:
    """Mean and median over the sessions of each seed: their means over the seeds, with standard errors."""
    rows = [f"{'error of the camera positions, mm':32}{'mean':>14}{'median':>16}"]
    for method in found[0]:
        numbers = [torch.stack([of(errors[method]) for errors in found]) for of in (torch.mean, torch.median)]
        rows.append(f"{method:32}" + "  ".join(f"{_with_error(values):>14}" for values in numbers))
    return "\n".join(rows)


def _with_error(values: Tensor) -> str:
    error = f" +- {values.std() / len(values) ** 0.5:4.1f}" if len(values) > 1 else ""
    return f"{values.mean():.1f}{error}"
