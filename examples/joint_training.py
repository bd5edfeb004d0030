"""Train a keypoint detector and calibrate its cameras jointly, from pictures alone: the calibration is a layer of the network.

    python examples/joint_training.py                  # a few steps, to see it run
    python examples/joint_training.py --full           # some minutes, with the result below
    torchrun --nproc-per-node 2 examples/joint_training.py --full --distributed

A venue with six cameras, in whose pictures athletes swing clubs, bats, sticks and shinais. A detector is first trained on
labels that are wrong in two views of every point, and learns the error too. Then it goes on without labels. Its keypoints and
its confidence go through :class:`torchstickcal.CalibrationLayer`. The loss is how far the layer's points are from the rays of
the keypoints through the layer's cameras, and how far the stick is from its length. Nothing else supervises, and the gradient
goes through the cameras that the keypoints themselves have determined.

The distances are metres, not pixels: in pixels the views agree the better the smaller the detector makes the athlete. The loss
is linear in large distances, so that the views in the majority decide, and the steps are those of plain gradient descent: a
method that scales every parameter's step alike, as Adam does, would move right and wrong views equally. Only what the cameras
have of their own is trained: with all layers free the detector drifts to another scene and another rig that agree as well.

On sessions held out (two cores, two minutes):

                        before    after
    keypoints (px)       1.266    0.902
    camera places (mm)   242      146
    rotations (deg)      3.67     1.04

Two processes compute the same loss and gradient as one. The rounding of float32 grows over the steps of the first training, to
0.3 % of the loss after 50 and some percent after 200, and the joint losses then differ by up to 3 %.

What is left is what the views agree on: the part of the wrong labels that another pose of the camera or another place of the
point explains, and errors of the stick's ends, which set the scale, common to all views.
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
    """How much is done."""

    labelled: int
    unlabelled: int
    held_out: int
    first_steps: int
    joint_steps: int


SMOKE = Plan(labelled=1, unlabelled=2, held_out=1, first_steps=3, joint_steps=1)
FULL = Plan(labelled=16, unlabelled=16, held_out=5, first_steps=700, joint_steps=60)


def main() -> None:
    """Train, and print keypoint and camera errors on sessions held out."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--full", action="store_true", help="the whole training")
    parser.add_argument("--distributed", action="store_true", help="one of several processes of torchrun")
    parser.add_argument("--logdir", help="folder for TensorBoard")
    options = parser.parse_args()
    if options.distributed:
        dist.init_process_group("gloo")
    plan = FULL if options.full else SMOKE
    torch.manual_seed(0)
    training = Training(plan, options.logdir)
    training.measure("untrained", 0)
    training.learn_labels()
    before = training.measure("labels learnt", 0)
    training.learn_jointly()
    after = training.measure("jointly trained", plan.joint_steps)
    if training.first:
        print(f"\n{'held-out sessions':20} {'before':>8} {'after':>8}")
        for name, value in before.items():
            print(f"{name:20} {value:8.3f} {after[name]:8.3f}")
    if options.distributed:
        dist.destroy_process_group()


class Training:
    """The detector, its sessions and its log, in one process of one or several."""

    def __init__(self, plan: Plan, logdir: str | None) -> None:
        self.rank, self.processes = (dist.get_rank(), dist.get_world_size()) if dist.is_initialized() else (0, 1)
        self.first = self.rank == 0
        self._plan, self._began = plan, time.perf_counter()
        self._venue = Venue()
        self._labelled = self._venue.sessions(0, plan.labelled)
        self._unlabelled = self._venue.sessions(plan.labelled, plan.unlabelled)
        self._held_out = self._venue.sessions(plan.labelled + plan.unlabelled, plan.held_out)
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
        slope = torch.optim.lr_scheduler.OneCycleLR(optimiser, 3e-3, total_steps=self._plan.first_steps)
        order = torch.Generator().manual_seed(1)
        for step in range(self._plan.first_steps):
            session = int(torch.randint(len(labels), (), generator=order))
            frames = torch.randperm(labels.shape[2], generator=order)[:FRAMES_A_STEP][self.rank :: self.processes]
            keypoints, _ = self._model(self._labelled.images[session : session + 1, :, frames])
            wanted = labels[session : session + 1, :, frames]
            loss = (keypoints - wanted).abs().where(wanted.isfinite(), 0.0).mean()
            self._descend(optimiser, loss)
            slope.step()
            self._tell("labels", step, loss, every=50)

    def learn_jointly(self) -> None:
        """The second training, of the cameras' own corrections and the confidence, on the agreement of the views."""
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
            self._tell("joint", step, loss, every=5)
            if step and step % 30 == 0:
                self.measure(f"step {step}", step)

    def measure(self, name: str, step: int) -> dict[str, float]:
        """Errors on the sessions held out, printed and logged."""
        with torch.no_grad():
            keypoints, confidence = self._detector(self._held_out.images)
            result = self._layer(keypoints, self._venue.intrinsics, confidence=confidence)
        true = self._held_out.keypoints
        wrong = (keypoints - true).norm(dim=-1)[true[..., 0].isfinite()]
        cameras = pose_errors(result.rotations, result.translations, self._venue.rotations, self._venue.translations)
        errors = {
            "keypoints (px)": float(wrong.mean()),
            "camera places (mm)": 1000 * float(cameras.translation_m.mean(-1).median()),
            "rotations (deg)": float(cameras.rotation_deg.mean(-1).median()),
        }
        if self.first:
            told = ", ".join(f"{what} {value:.3f}" for what, value in errors.items())
            print(f"{time.perf_counter() - self._began:5.0f} s  {name}: {told}", flush=True)
        if self._log:
            for what, value in errors.items():
                self._log.add_scalar(f"held out/{what}", value, step)
            self._log.add_images("held out", _marked(self._held_out, keypoints), step)
        return errors

    def _disagreement(self, keypoints: Tensor, confidence: Tensor) -> Tensor:
        """The supervision of sessions, of which those that cannot be calibrated have none."""
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

    def _tell(self, phase: str, step: int, loss: Tensor, every: int) -> None:
        """The loss of all processes' sessions."""
        value = loss.detach().clone()
        if dist.is_initialized():
            dist.all_reduce(value)
        value = float(value) / self.processes
        if self._log:
            self._log.add_scalar(f"loss/{phase}", value, step)
        if self.first and step % every == 0:
            print(f"{time.perf_counter() - self._began:5.0f} s  {phase} {step}: loss {value:.6f}", flush=True)


def calibration_config() -> Config:
    """The default, for pictures of 64 pixels and keypoints that are all a little wrong: softer, and nothing is set aside."""
    default = load_config("default")
    softer = {
        "reprojection": ReprojectionSettings(sigma_px=1.0, kernel="cauchy", kernel_scale=1.0),
        "stick_length": StickLengthSettings(sigma_m=0.02),
    }
    stages = {
        name: replace(
            stage,
            reject_sigmas=None,
            losses={loss: softer[loss] for loss in stage.losses},
            max_iterations=300,
            cost_tolerance=1e-6,
        )
        for name, stage in default.stages.items()
        if stage.cameras == "free" and name != "refined"
    }
    return Config(stages, initialise=replace(default.initialise, threshold_px=2.0, max_points=400))


def _soft(squared: Tensor) -> Tensor:
    """Quadratic where small, linear where large."""
    return (1 + squared).sqrt() - 1


def _marked(sessions: Sessions, keypoints: Tensor) -> Tensor:
    """Some pictures with the keypoints drawn into them, (n, 3, H, W)."""
    pictures = sessions.images[0, :, ::8].flatten(0, 1).clone()
    for picture, points in zip(pictures, keypoints[0, :, ::8].flatten(0, 1).round().long().tolist(), strict=True):
        for x, y in points:
            picture[:, max(0, min(y, picture.shape[1] - 1)), max(0, min(x, picture.shape[2] - 1))] = 1.0
    return pictures


if __name__ == "__main__":
    torch.set_num_threads(max(1, (os.cpu_count() or 1) // int(os.environ.get("LOCAL_WORLD_SIZE", "1"))))
    main()
