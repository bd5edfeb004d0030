"""Calibrate a rig in ten lines: a golf swing seen by six cameras.

The swing is generated here; with keypoints of your own, start at ``Observations``.
"""

from torchstickcal import Observations, Stick, calibrate
from torchstickcal.simulate import Noise, golf_session

swing, _ = golf_session(cameras=6, noise=Noise(sigma_px=1.5, missing=0.15, outliers=0.05))

observations = Observations(
    keypoints=swing.keypoints,  # (cameras, frames, points, 2) pixels, NaN where not seen
    intrinsics=swing.intrinsics,  # (3, 3) or (cameras, 3, 3)
    sticks=Stick(start=19, end=20, length_m=1.0),  # two of the points, and metres between them
    distortion=swing.distortion,
)
calibration = calibrate(observations)

print(calibration.status)
print(calibration.rotations.shape, calibration.translations.shape, calibration.points.shape)
print("camera centres in metres:", calibration.camera_centres, sep="\n")
