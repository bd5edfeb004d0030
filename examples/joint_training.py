"""Train a keypoint detector and calibrate its cameras jointly, from images alone: the calibration is a layer of the network.

    python examples/joint_training.py                  # a few steps, to see it run
    python examples/joint_training.py --full           # some minutes, with the result below
    torchrun --nproc-per-node 2 examples/joint_training.py --full --distributed

Six fixed cameras see athletes with clubs, bats, sticks and shinais. A detector is first trained on labels that are wrong in two
views of every point, and learns this error. Then the training continues without labels. The detector's keypoints and
confidences go through :class:`torchstickcal.CalibrationLayer`. The loss has two parts: the distances of the layer's points from
the rays of the keypoints, computed with the layer's cameras, and the difference of the stick from its length. There is no other
supervision, and the gradient goes through the cameras that the keypoints themselves have determined.

The distances are in metres, because in pixels they would become smaller if the detector made the athlete smaller. The loss is
linear for large distances, so that the majority of the views decides. The optimiser is plain gradient descent: a method like
Adam, which gives each parameter a step of the same size, would move right and wrong views equally. Only the parameters that
each camera has for itself are trained. If all layers are trained, the detector drifts to another scene and another rig with the
same agreement.

Errors on test sessions (two cores, two minutes):

                              before    after
    keypoints (px)             1.266    0.902
    camera positions (mm)      242      146
    camera rotations (deg)     3.67     1.04

Two processes compute the same loss and gradient as one. The rounding errors of float32 grow over the steps of the first
training: to 0.3 % of the loss after 50 steps and to a few percent after 200. The joint losses then differ by up to 3 %.

The remaining errors are those on which the views agree: the part of the wrong labels that another camera pose or another
position of the point can explain, and errors of the stick's ends that are the same in all views and change the scale.
"""

from __future__ import annotations

import argparse
import os
import time
from dataclasses import dataclass, replace

import torch
import torch.distributed as dist
from joint_training_parts.detector import Detector
from joint_training_parts.scenes import CAMERAS, POINTS, Sessions, Venue, stick
from torch import Tensor, nn
from torch.nn.parallel import DistributedDataParallel
from torch.utils.tensorboard import SummaryWriter

from torchstickcal import CalibrationLayer, Config, LayerResult, load_config
from torchstickcal.losses import ReprojectionSettings, StickLengthSettings, reprojection_residuals
from torchstickcal.metrics import pose_errors

SESSIONS_A_STEP, FRAMES_A_STEP = 2, 8
SOFT_M, STICK_SOFT_M, STICK_WEIGHT = 0.02, 0.05, 0.03


@dataclass(frozen=True)
class Plan:
    """Numbers of sessions and of training steps."""

    labelled: int
    unlabelled: int
    test: int
    first_steps: int
    joint_steps: int


SMOKE = Plan(labelled=1, unlabelled=2, test=1, first_steps=3, joint_steps=1)
FULL = Plan(labelled=16, unlabelled=16, test=5, first_steps=700, joint_steps=60)


def main() -> None:
    """Train, and print the errors of keypoints and cameras on test sessions."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the whole training, not just a few steps")
    parser.add_argument("--distributed", action="store_true", help="run as one of several processes of torchrun")
    parser.add_argument("--logdir", help="folder for TensorBoard")
    options = parser.parse_args()
    if options.distributed:
        dist.init_process_group("gloo")
    plan = FULL if options.full else SMOKE
    torch.manual_seed(0)
    training = Training(plan, options.logdir)
    training.measure("before training", 0)
    training.learn_labels()
    before = training.measure("trained on labels", plan.first_steps)
    training.learn_jointly()
    after = training.measure("trained jointly", plan.first_steps + plan.joint_steps)
    if training.first:
        print(f"\n{'test sessions':24} {'before':>8} {'after':>8}")
        for name, value in before.items():
            print(f"{name:24} {value:8.3f} {after[name]:8.3f}")
    if options.distributed:
        dist.destroy_process_group()


class Training:
    """The detector, its sessions and its log, in one of the processes."""

    def __init__(self, plan: Plan, logdir: str | None) -> None:
        self.rank, self.processes = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        self.first = self.rank == 0
        self._plan, self._began = plan, time.perf_counter()
        self._venue = Venue()
        self._labelled = self._venue.sessions(0, plan.labelled)
        self._unlabelled = self._venue.sessions(plan.labelled, plan.unlabelled)
        self._test = self._venue.sessions(plan.labelled + plan.unlabelled, plan.test)
        self._detector = Detector(CAMERAS, POINTS)
        self._model: nn.Module = self._detector
        if dist.is_initialized():
            self._model = DistributedDataParallel(self._detector, find_unused_parameters=True)
        self._layer = CalibrationLayer(stick(), calibration_config())
        self._log = SummaryWriter(logdir) if logdir and self.first else None

    def learn_labels(self) -> None:
        """The first training, on labels."""
        labels = self._venue.labels(self._labelled, seed=0).float()
        optimiser = torch.optim.Adam(self._model.parameters(), lr=3e-3)
        schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=self._plan.first_steps)
        order = torch.Generator().manual_seed(1)
        for step in range(self._plan.first_steps):
            session = int(torch.randint(len(labels), (), generator=order))
            frames = torch.randperm(labels.shape[2], generator=order)[:FRAMES_A_STEP][self.rank :: self.processes]
            keypoints, _ = self._model(self._labelled.images[session : session + 1, :, frames])
            target = labels[session : session + 1, :, frames]
            loss = (keypoints - target).abs().where(target.isfinite(), 0.0).mean()
            self._descend(optimiser, loss)
            schedule.step()
            self._log_loss("labels", step, loss, every=50)

    def learn_jointly(self) -> None:
        """The second training, by the agreement of the views: of the corrections for each camera, and of the confidence."""
        self._detector.keep_trunk()
        groups = [{"params": [self._detector.corrections], "lr": 2.0}, {"params": [self._detector.doubt], "lr": 0.05}]
        optimiser = torch.optim.SGD(groups, momentum=0.5)
        sessions = self._unlabelled.images
        for step in range(self._plan.joint_steps):
            batch = torch.arange(SESSIONS_A_STEP) + SESSIONS_A_STEP * step
            mine = batch[self.rank :: self.processes] % len(sessions)
            keypoints, confidence = self._model(sessions[mine])
            loss = self._disagreement(keypoints, confidence)
            self._descend(optimiser, loss)
            self._log_loss("joint", step, loss, every=5)
            if step and step % 30 == 0:
                self.measure(f"step {step}", self._plan.first_steps + step)

    def measure(self, name: str, step: int) -> dict[str, float]:
        """The errors on the test sessions, printed and logged."""
        with torch.no_grad():
            keypoints, confidence = self._detector(self._test.images)
            result = self._layer(keypoints, self._venue.intrinsics, confidence=confidence)
        true = self._test.keypoints
        wrong = (keypoints - true).norm(dim=-1)[true[..., 0].isfinite()]
        cameras = pose_errors(result.rotations, result.translations, self._venue.rotations, self._venue.translations)
        errors = {
            "keypoints (px)": float(wrong.mean()),
            "camera positions (mm)": 1000 * float(cameras.translation_m.mean(-1).median()),
            "camera rotations (deg)": float(cameras.rotation_deg.mean(-1).median()),
        }
        if self.first:
            text = ", ".join(f"{what} {value:.3f}" for what, value in errors.items())
            print(f"{time.perf_counter() - self._began:5.0f} s  {name}: {text}", flush=True)
        if self._log:
            for what, value in errors.items():
                self._log.add_scalar(f"test/{what}", value, step)
            self._log.add_images("test", _marked(self._test, keypoints), step)
        return errors

    def _disagreement(self, keypoints: Tensor, confidence: Tensor) -> Tensor:
        """The loss of the second training. Sessions that cannot be calibrated do not contribute."""
        result: LayerResult = self._layer(keypoints, self._venue.intrinsics, confidence=confidence)
        cameras = self._venue.intrinsics.to(keypoints).expand(len(keypoints), -1, -1, -1)
        points = result.points.where(result.known[..., None], torch.nan)
        distance = reprojection_residuals(points, result.rotations, result.translations, keypoints, cameras)
        depth = (
            torch.einsum("scj,sfpj->scfp", result.rotations[:, :, 2], result.points) + result.translations[:, :, 2, None, None]
        )
        metres = distance.square().sum(-1) * (depth / cameras[:, :, 0, 0, None, None]).square()
        views = _soft(metres / SOFT_M**2).mean((1, 2, 3))
        length = (result.points[..., -1, :] - result.points[..., -2, :]).norm(dim=-1) - stick().length_m
        sticks = _soft((length / STICK_SOFT_M).square()).mean(1)
        return (views + STICK_WEIGHT * sticks).where(result.converged, 0.0).mean()

    def _descend(self, optimiser: torch.optim.Optimizer, loss: Tensor) -> None:
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(self._model.parameters(), 1.0)
        optimiser.step()

    def _log_loss(self, phase: str, step: int, loss: Tensor, every: int) -> None:
        """Print and log the loss, mean over all processes."""
        value = loss.detach().clone()
        if dist.is_initialized():
            dist.all_reduce(value)
        value = float(value) / self.processes
        if self._log:
            self._log.add_scalar(f"loss/{phase}", value, step)
        if self.first and step % every == 0:
            print(f"{time.perf_counter() - self._began:5.0f} s  {phase} {step}: loss {value:.6f}", flush=True)


def calibration_config() -> Config:
    """The default, changed for images of 64 pixels and keypoints that all have errors: larger tolerances, and no rejection."""
    default = load_config("default")
    tolerant = {
        "reprojection": ReprojectionSettings(sigma_px=1.0, kernel="cauchy", kernel_scale=1.0),
        "stick_length": StickLengthSettings(sigma_m=0.02),
    }
    stages = {
        name: replace(
            stage,
            reject_sigmas=None,
            losses={loss: tolerant[loss] for loss in stage.losses},
            max_iterations=300,
            cost_tolerance=1e-6,
        )
        for name, stage in default.stages.items()
        if stage.cameras == "free" and name != "refined"
    }
    return Config(stages, initialise=replace(default.initialise, threshold_px=2.0, max_points=400))


def _soft(squared: Tensor) -> Tensor:
    """Quadratic for small values, linear for large ones."""
    return (1 + squared).sqrt() - 1


def _marked(sessions: Sessions, keypoints: Tensor) -> Tensor:
    """Some images with the keypoints drawn into them, (n, 3, H, W)."""
    images = sessions.images[0, :, ::8].flatten(0, 1).clone()
    for image, points in zip(images, keypoints[0, :, ::8].flatten(0, 1).round().long().tolist(), strict=True):
        for x, y in points:
            image[:, max(0, min(y, image.shape[1] - 1)), max(0, min(x, image.shape[2] - 1))] = 1.0
    return images


if __name__ == "__main__":
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))))
    main()
