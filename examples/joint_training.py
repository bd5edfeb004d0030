"""Train how far a detector trusts its keypoints, end to end by the cameras that follow from them, on images.

    python examples/joint_training.py                  # a few steps, to see it run
    python examples/joint_training.py --full           # the table in docs/training.md
    torchrun --nproc-per-node 2 examples/joint_training.py --full

Five cameras see athletes with clubs, bats, sticks and shinais. Some cameras are cheap: their images are soft and grainy, and
they run freely, so that each frame is up to 20 ms early or late. Clothes hide joints, and the trunk hides arms.

A small detector learns keypoints from labelled images. A head then turns what the detector saw of a keypoint into a confidence.
The head learns in sessions of golf and baseball whose cameras are known, by different teachers: by labels (how likely are the
errors of the keypoints?), by the reprojections of triangulated points (likewise), and end to end: the confidences go through
:class:`torchstickcal.CalibrationLayer`, and the loss is the error of the cameras. All are tested on hockey and kendo, with
other athletes and rigs. `docs/training.md` says who wins.
"""

from __future__ import annotations

import argparse
from functools import partial

import torch
from joint_training_parts.comparison import compare
from joint_training_parts.detector import Detector, detections, learn_keypoints
from joint_training_parts.launch import is_first, options_of, processes, repeat
from joint_training_parts.log import watched_by
from joint_training_parts.pictures import crops_with_keypoints
from joint_training_parts.scenes import END, START, sessions
from torch import Tensor

from torchstickcal import Stick, TensorBoardMonitor

STICK = Stick(START, END, 1.0)
"""The sports' sticks have lengths of their own, which the layer gets for each session."""
SIGMA_PX = 4.0
_LEARNT, _OTHER = ("golf", "baseball"), ("hockey", "kendo")
_STUDIOS, _ELSEWHERE = ("ring", "hemisphere"), ("ring", "random")
_SEEDS_APART = 1000


def main() -> None:
    """Train the detector, then compare the teachers of its head."""
    sizes = {
        "labelled": (1, 50),
        "training": (1, 16),
        "test": (1, 10),
        "steps": (1, 20),
        "detector_steps": (3, 700),
        "seeds": (1, 5),
    }
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the whole experiment, not just a few steps to see it run")
    parser.add_argument("--logdir", help="folder for TensorBoard")
    options = options_of(parser, **sizes)
    with processes():
        monitor = TensorBoardMonitor(options.logdir) if options.logdir else None
        torch.manual_seed(0)
        detector = Detector()
        labelled = sessions(range(options.labelled), _LEARNT, _STUDIOS, invented=True)
        learn_keypoints(detector, labelled, options.detector_steps, partial(_report, monitor))
        repeat(partial(experiment, detector, options, monitor), options.seeds)
        if monitor:
            monitor.close()


def experiment(
    detector: Detector, options: argparse.Namespace, monitor: TensorBoardMonitor | None, seed: int
) -> dict[str, Tensor]:
    """Errors of the camera positions in the test sessions, millimetres, by teacher."""
    first = _SEEDS_APART * (seed + 1)
    studios = sessions(range(first, first + options.training), _LEARNT, _STUDIOS)
    others = sessions(range(first + _SEEDS_APART // 2, first + _SEEDS_APART // 2 + options.test), _OTHER, _ELSEWHERE)
    training, test = detections(detector, studios), detections(detector, others)
    errors, heads = compare(training, test, STICK, SIGMA_PX, options.steps, seed, watched_by(monitor, seed))
    if monitor and monitor.writer:
        for method, values in errors.items():
            monitor.writer.add_scalar(f"test, mm/{method}", float(values.mean()), seed)
        for method, head in heads.items():
            with torch.no_grad():
                confidence = head(test.seen)
            monitor.writer.add_histogram(f"test confidence/{method}", confidence, seed)
            monitor.writer.add_image(f"test/{method}", crops_with_keypoints(others, test, confidence), seed)
    return errors


def _report(monitor: TensorBoardMonitor | None, step: int, loss: Tensor) -> None:
    if monitor and monitor.writer:
        monitor.writer.add_scalar("detector/loss", loss.item(), step)
    if step % 50 == 0 and is_first():
        print(f"detector, step {step}: loss {loss.item():.2f}", flush=True)


if __name__ == "__main__":
    main()
