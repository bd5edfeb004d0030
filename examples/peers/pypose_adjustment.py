"""Bundle adjustment with PyPose's Levenberg-Marquardt compared with this project's solver: time and memory.

In the environment of torchstickcal, with ``pip install pypose`` in addition:

    python examples/peers/pypose_adjustment.py --cameras 6 --frames 5 10 20

Both get the problem of ``examples/benchmark_adjustment.py``, start from the same values, and stop when an iteration decreases
the cost by less than 1e-6 of it. PyPose is used as in its documentation: poses as SE(3) parameters, the Jacobian by autograd,
dense Cholesky, trust region. (Its sparse solver needs CUDA.) Times are medians over the runs, of the adjustment alone. Memory
is the peak of the process, minus what it uses before the adjustment.
"""

from __future__ import annotations

import argparse
import platform
import statistics
import sys
import time
from pathlib import Path

import pypose
import torch
from torch import Tensor, nn

from torchstickcal.benchmark.memory import memory_needed

sys.path.append(str(Path(__file__).parents[1]))

from benchmark_adjustment import COST_TOLERANCE, FOCAL_PX, HEIGHT, REPROJECTION, WIDTH, Problem, Timing, ours, simulated

MAX_ITERATIONS = 50


class Reprojection(nn.Module):
    """Pixels (C, N, 2) of points seen by cameras. The first camera is held fixed."""

    def __init__(self, problem: Problem) -> None:
        super().__init__()
        poses = pypose.mat2SE3(torch.cat([problem.rotations, problem.translations[..., None]], dim=-1))
        self.first = poses[:1]
        self.others = pypose.Parameter(poses[1:])
        self.points = nn.Parameter(problem.points.mT.clone())
        self.centre = torch.tensor([WIDTH / 2, HEIGHT / 2], dtype=torch.float64)

    def forward(self, _: Tensor) -> Tensor:
        """The pixels."""
        poses = torch.cat([self.first, self.others])
        in_cameras = poses[:, None].Act(self.points[None])
        return FOCAL_PX * in_cameras[..., :2] / in_cameras[..., 2:] + self.centre


def pypose_lm(problem: Problem) -> Timing:
    """PyPose's dense Levenberg-Marquardt."""
    model = Reprojection(problem)
    optimiser = pypose.optim.LM(model)
    nothing, pixels = torch.empty(0), problem.pixels.movedim(1, -1).contiguous()
    began = time.perf_counter()
    cost = float("inf")
    for _ in range(MAX_ITERATIONS):
        before, cost = cost, float(optimiser.step(nothing, pixels))
        if before - cost < COST_TOLERANCE * cost:
            break
    return Timing(time.perf_counter() - began, cost)


ADJUSTERS = {"torchstickcal": lambda problem: ours(problem, REPROJECTION), "PyPose": pypose_lm}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--cameras", type=int, default=6)
    parser.add_argument("--frames", type=int, nargs="+", default=[5, 10, 20])
    parser.add_argument("--points", type=int, default=21)
    parser.add_argument("--runs", type=int, default=5)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    print(f"{platform.machine()}, torch {torch.__version__}, PyPose {pypose.__version__}, {options.threads} threads\n")
    print("| cameras | frames | keypoints | adjuster | median | memory | cost per keypoint |\n" + "|---" * 7 + "|")
    for frames in options.frames:
        problem = simulated(options.cameras, frames, options.points)
        keypoints = options.cameras * frames * options.points
        for name, adjust in ADJUSTERS.items():
            adjust(problem)
            timings = [adjust(problem) for _ in range(options.runs)]
            seconds = statistics.median(timing.seconds for timing in timings)
            memory = memory_needed(lambda adjust=adjust, problem=problem: adjust(problem)).resident_bytes
            peak = "?" if memory is None else f"{memory / 1e6:.1f} MB"
            row = f"| {options.cameras} | {frames} | {keypoints} | {name} | {seconds:.4f} s | {peak}"
            print(f"{row} | {timings[0].cost / keypoints:.7f} |", flush=True)


if __name__ == "__main__":
    main()
