"""Use the losses and the extrinsics in a training loop of your own, with any optimiser of torch.optim.

The cameras of a calibrated rig have moved a little. Adam estimates their poses and the points of the athlete from new
keypoints. A network that predicts keypoints or points could replace these parameters.
"""

import torch
from torch import nn

from torchstickcal import Extrinsics
from torchstickcal.geometry import se3
from torchstickcal.losses import Cauchy, ReprojectionLoss, SmoothnessLoss, StickLengthLoss
from torchstickcal.metrics import pose_errors
from torchstickcal.simulate import Noise, golf_session

STEPS = 600

session, truth = golf_session(cameras=4, frames=60, noise=Noise(sigma_px=1.0))
assert truth.points is not None
torch.manual_seed(0)
perturbation = 0.02 * torch.randn(4, 6, dtype=torch.float64)
perturbation[0] = 0.0
extrinsics = Extrinsics(*se3.retract(truth.rotations, truth.translations, perturbation))
points = nn.Parameter(truth.points + 0.05 * torch.randn_like(truth.points))

reprojection = ReprojectionLoss(sigma=1.0, kernel=Cauchy(3.0))
length, smoothness = StickLengthLoss(sigma=0.001), SmoothnessLoss(sigma=0.1)
(stick,) = session.sticks
start, end = stick.ends

optimiser = torch.optim.Adam([*extrinsics.parameters(), points], lr=2e-3)
schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, STEPS)
for step in range(STEPS + 1):
    rotations, translations = extrinsics()
    loss = reprojection(points, rotations, translations, session.keypoints, session.cameras)
    loss = loss + length(points[:, start], points[:, end], stick.length_m) + smoothness(points)
    if step % 100 == 0:
        errors = pose_errors(rotations, translations, truth.rotations, truth.translations)
        error_mm = 1000 * errors.mean_translation_m
        print(
            f"step {step:4d}  loss {float(loss.detach()):12.1f}  cameras {errors.mean_rotation_deg:.3f} deg, {error_mm:.1f} mm"
        )
    optimiser.zero_grad()
    loss.backward()
    optimiser.step()
    schedule.step()
