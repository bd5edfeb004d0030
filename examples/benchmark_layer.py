"""Measure the time of the layer: one batch against single calls, and the backward pass against a Gauss-Newton iteration.

python examples/benchmark_layer.py --sessions 64
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable

import torch

from torchstickcal import CalibrationLayer, Config, load_config
from torchstickcal.losses import ReprojectionLoss, StickLengthLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.simulate import Noise, golf_session
from torchstickcal.solvers.elimination.normal_equations import NormalEquations, Step
from torchstickcal.workers import on_worker

CAMERAS, FRAMES, POINTS = 6, 50, 21


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, default=4)
    parser.add_argument("--runs", type=int, default=3)
    parser.add_argument("--device", default="cpu")
    options = parser.parse_args()
    sessions = [golf_session(CAMERAS, FRAMES, Noise(sigma_px=1.0), seed) for seed in range(options.sessions)]
    observations, truth = sessions[0]
    keypoints = torch.stack([session.keypoints for session, _ in sessions]).to(options.device)
    layer, lens = CalibrationLayer(observations.sticks), observations.cameras
    print(f"{options.sessions} sessions of {CAMERAS} cameras, {FRAMES} frames, {POINTS} points; torch {torch.__version__}, ")
    print(f"{options.device}, {torch.get_num_threads()} threads, medians of {options.runs} runs\n")

    def batch(warm: bool) -> float:
        start = layer(keypoints, lens) if warm else None
        return _median(lambda: layer(keypoints + 0.5, lens, initial=start), options.runs, keypoints)

    def singles(warm: bool) -> float:
        starts = [layer(k, lens) if warm else None for k in keypoints]
        every = list(zip(keypoints, starts, strict=True))
        return _median(lambda: [layer(k + 0.5, lens, initial=start) for k, start in every], options.runs, keypoints)

    print(f"{'forward pass':24} {'single calls (s)':>16} {'one batch (s)':>14} {'ratio':>7}")
    for name, warm in (("cold start", False), ("warm start", True)):
        with torch.no_grad():
            alone, together = singles(warm), batch(warm)
        print(f"{name:24} {alone:16.3f} {together:14.3f} {together / alone:6.2f}x")

    leaf = keypoints[0].clone().requires_grad_()
    stages = {name: stage for name, stage in load_config("default").stages.items() if stage.cameras == "free"}
    result = CalibrationLayer(observations.sticks, Config(stages))(leaf, lens)
    back = _median(
        lambda: torch.autograd.grad(result.translations.sum() + result.points.sum(), leaf, retain_graph=True),
        10 * options.runs,
        keypoints,
    )
    measurements = Measurements.of(observations.to(options.device))
    points = truth.points.flatten(0, 1).mT[None] if truth.points is not None else torch.zeros(1, 3, FRAMES * POINTS)
    state = State.of(*(v.to(options.device) for v in (truth.rotations[None], truth.translations[None], points.contiguous())))
    objective = Objective(measurements, {"reprojection": ReprojectionLoss(), "stick_length": StickLengthLoss(0.001)})

    def iteration() -> Step:
        return NormalEquations(objective, state, True, 1e-6).step()

    one = _median(lambda: on_worker(keypoints.device, iteration), 10 * options.runs, keypoints)
    print(
        f"\nbackward pass, without smoothness: {1e3 * back:.1f} ms, "
        f"as long as {back / one:.1f} Gauss-Newton iterations of {1e3 * one:.1f} ms"
    )


def _median(run: Callable[[], object], runs: int, like: torch.Tensor) -> float:
    times: list[float] = []
    for _ in range(runs + 1):
        began = time.perf_counter()
        run()
        if like.is_cuda:
            torch.cuda.synchronize()
        times.append(time.perf_counter() - began)
    return statistics.median(times[1:])


if __name__ == "__main__":
    main()
