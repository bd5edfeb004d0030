"""The command line of both experiments: seeds, processes, and the table at the end."""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Callable
from typing import Any

import torch
import torch.distributed as dist
from torch import Tensor


def options_of(text: str | None, **sizes: int) -> argparse.Namespace:
    """Options from the command line.

    Args:
        text: what the program does.
        sizes: numbers that can be chosen, and their defaults.
    """
    parser = argparse.ArgumentParser(description=text, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=1, help="how often all is repeated with other sessions")
    for name, size in sizes.items():
        parser.add_argument(f"--{name}", type=int, default=size, help=f"default: {size}")
    parser.add_argument("--logdir", help="folder for TensorBoard")
    return parser.parse_args()


def run_seeds(experiment: Callable[[int, argparse.Namespace], dict[str, Tensor]], options: argparse.Namespace) -> None:
    """Repeat an experiment, and print the mean of its results; also as one of several processes of torchrun."""
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    torch.set_num_threads(int(os.environ.get("OMP_NUM_THREADS", max(1, (os.cpu_count() or 1) // processes))))
    if processes > 1:
        dist.init_process_group("gloo")
    first = processes == 1 or dist.get_rank() == 0
    found = []
    for seed in range(options.seeds):
        began, used = time.perf_counter(), time.process_time()
        torch.manual_seed(seed)
        found.append(experiment(seed, options))
        if first:
            print(f"seed {seed}: {time.perf_counter() - began:.0f} s, {time.process_time() - used:.0f} s of CPU", flush=True)
            print_table(found)
    if processes > 1:
        dist.destroy_process_group()


def print_table(found: list[dict[str, Tensor]]) -> None:
    """Mean over the seeds of each seed's mean and median over its sessions, with standard errors of the mean."""
    print(f"{'error of the camera positions, mm':36} {'mean':>12} {'median':>12}")
    for method in found[0]:
        print(f"{method:36} " + " ".join(_with_error([of(errors[method]) for errors in found]) for of in (torch.mean, torch.median)))


def _with_error(values: list[Any]) -> str:
    numbers = torch.stack(values)
    error = f"+- {numbers.std() / len(numbers) ** 0.5:.1f}" if len(numbers) > 1 else ""
    return f"{numbers.mean():6.1f} {error:6}"[:13]
