"""Learn from known rigs how far keypoints can be trusted, and use it on other rigs and sports.

    python examples/learnt_confidence.py          # a few steps, to see it run
    python examples/learnt_confidence.py --full   # the table in docs/training.md
    torchrun --nproc-per-node 2 examples/learnt_confidence.py --full

Cheap cameras are noisy and not synchronised: each of their frames is up to 20 ms too early or too late. Keypoints of fast
points are then wrong by centimetres. No label of an image shows this, because within one image nothing is wrong. But what
moves fast is blurred, and that can be seen. The detections are simulated: three numbers for each keypoint, the length of its
blur, the graininess of its image, and the detector's score.

A head of few numbers makes confidences of these. It learns from sessions of golf and baseball in rigs with known cameras, and
is tested on hockey and kendo, with other athletes and rigs. `joint_training.py` is the same experiment on images.
"""

from __future__ import annotations

import argparse
from functools import partial

import numpy as np
import torch
from joint_training_parts.comparison import compare
from joint_training_parts.detections import Detections
from joint_training_parts.launch import options_of, processes, repeat
from joint_training_parts.log import watched_by
from torch import Tensor

from torchstickcal import Stick, TensorBoardMonitor
from torchstickcal.simulate import Lens, Motion, action
from torchstickcal.simulate.paths import Path
from torchstickcal.simulate.rigs import camera_rig
from torchstickcal.simulate.skeleton import JOINTS, Skeleton

CAMERAS, FRAMES, POINTS = 5, 20, len(JOINTS) + 2
STICK = Stick(POINTS - 2, POINTS - 1, 1.0)
SIGMA_PX = 1.0

_CHEAP, _EARLY_OR_LATE_S, _EXPOSURE_S = 0.4, 0.02, 0.01
_NOISE_PX, _CHEAP_NOISE_PX, _BLUR_SHARE = 1.0, 3.0, 0.1
_OUTLIERS, _OUTLIER_PX = 0.03, (25.0, 60.0)


def main() -> None:
    """Compare the teachers of a head."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the whole experiment, not just a few steps to see it run")
    parser.add_argument("--logdir", help="folder for TensorBoard")
    options = options_of(parser, training=(4, 16), test=(2, 12), steps=(1, 30), seeds=(1, 5))
    with processes():
        monitor = TensorBoardMonitor(options.logdir) if options.logdir else None
        repeat(partial(experiment, options, monitor), options.seeds)


def sessions(seeds: range, sports: tuple[str, ...]) -> Detections:
    """Sessions with an athlete, a rig and errors of their own."""
    drawn = [_session(np.random.default_rng(seed), sports[seed % len(sports)], seed) for seed in seeds]
    return Detections(*(torch.from_numpy(np.stack(values)) for values in zip(*drawn, strict=True)))


def _session(rng: np.random.Generator, sport: str, seed: int) -> tuple[np.ndarray, ...]:
    """The fields of :class:`Detections`, of one session."""
    path = Path("circle", float(rng.uniform(0.5, 1.2)))
    motion = Motion(action(sport), Skeleton(float(rng.uniform(1.6, 1.9))), path, seed=seed)
    layout, lens = ("ring", "random")[seed // 2 % 2], Lens(image_size=(1280, 960), focal_px=1000.0)
    rig = camera_rig(layout, CAMERAS, rng, lens, radius_m=float(rng.uniform(3.5, 6)))
    cheap = rng.uniform(size=CAMERAS) < _CHEAP
    times = np.broadcast_to(np.sort(rng.uniform(0, 3.6, FRAMES)), (CAMERAS, FRAMES))
    taken = times + cheap[:, None] * rng.uniform(-_EARLY_OR_LATE_S, _EARLY_OR_LATE_S, (CAMERAS, FRAMES))
    true, labels = rig.project(motion.points(times)), rig.project(motion.points(taken))
    blur = np.linalg.norm(rig.project(motion.points(taken + _EXPOSURE_S)) - labels, axis=-1)
    noise = np.where(cheap, _CHEAP_NOISE_PX, _NOISE_PX)[:, None, None] + _BLUR_SHARE * blur
    angle, gross = rng.uniform(0, 2 * np.pi, noise.shape), rng.uniform(*_OUTLIER_PX, noise.shape)
    jump = gross[..., None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    outlier = rng.uniform(size=noise.shape) < _OUTLIERS
    error = np.where(outlier[..., None], jump, noise[..., None] * rng.normal(size=labels.shape))
    score = 2 - np.log(np.linalg.norm(error, axis=-1) + 1) + 0.7 * rng.normal(size=noise.shape)
    grain = cheap[:, None, None] + 0.2 * rng.normal(size=noise.shape)
    measured = np.log1p(blur * np.exp(0.2 * rng.normal(size=noise.shape)))
    seen = np.nan_to_num(np.stack([measured, grain, measured * grain, score], axis=-1))
    points = np.broadcast_to(np.eye(POINTS), (CAMERAS, FRAMES, POINTS, POINTS))
    return (
        labels + error,
        np.nan_to_num(1 / (1 + np.exp(-score))),
        np.concatenate([seen, points], axis=-1),
        labels,
        true,
        rig.intrinsics,
        rig.rotations,
        rig.translations,
        np.array([motion.action.stick_m]),
    )


def experiment(options: argparse.Namespace, monitor: TensorBoardMonitor | None, seed: int) -> dict[str, Tensor]:
    """Errors of the camera positions in the test sessions, millimetres, by teacher."""
    first = 1000 * seed
    training = sessions(range(first, first + options.training), ("golf", "baseball"))
    test = sessions(range(first + 500, first + 500 + options.test), ("hockey", "kendo"))
    errors, _ = compare(training, test, STICK, SIGMA_PX, options.steps, seed, watched_by(monitor, seed))
    return errors


if __name__ == "__main__":
    main()
