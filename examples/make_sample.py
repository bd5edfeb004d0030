"""Make the recording that `torchstickcal sample` writes: a simulated golf swing, as OpenPose and Pose2Sim write it.

python examples/make_sample.py torchstickcal/samples/golf.zip
"""

from __future__ import annotations

import json
import sys
import tempfile
import zipfile
from pathlib import Path

import numpy as np

from torchstickcal.io import Rig, RigCamera, write_calibration
from torchstickcal.io.skeletons import SKELETONS
from torchstickcal.simulate import SessionSpec
from torchstickcal.simulate.regimes import DetectorNoise, Gaps, Outliers
from torchstickcal.simulate.rigs import Lens

STICK = ("club_grip", "club_head")
NAMES = (*SKELETONS["halpe-26"], *STICK)
SAME = {"head": "head_top", "nose": "head", "hip": "pelvis"}
"""Points of the simulated body that have another name in HALPE_26. It has no eyes, ears, hips, toes and heels."""


def main() -> None:
    lens = Lens(image_size=(1280, 720), distortion=(-0.1, 0.02, 0.0005, -0.0005, 0.0))
    errors = (DetectorNoise(), Outliers(0.02), Gaps(0.05))
    session = SessionSpec(
        "sample", "golf", seed=1, cameras=4, frames=90, layout="ring", lens=lens, radius_m=4.5, regimes=errors
    ).generate()
    observations, truth = session.observations, session.truth
    assert truth.intrinsics is not None
    assert truth.distortion is not None
    given = list(observations.point_names or ())
    keypoints, seen = observations.keypoints.numpy(), observations.visible.numpy()
    scores = np.ones(seen.shape) if observations.confidence is None else observations.confidence.numpy()
    path = sys.argv[1] if len(sys.argv) > 1 else "sample.zip"
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:

        def put(name: str, text: str) -> None:
            archive.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED, 9)

        for camera, label in enumerate(observations.camera_labels):
            for frame in range(observations.num_frames):
                flat: list[float] = []
                for name in NAMES:
                    point = given.index(SAME.get(name, name)) if SAME.get(name, name) in given else None
                    if point is None or not seen[camera, frame, point]:
                        flat += [0.0, 0.0, 0.0]
                    else:
                        x, y = keypoints[camera, frame, point].tolist()
                        flat += [round(x, 2), round(y, 2), round(float(scores[camera, frame, point]), 3)]
                person = {"person_id": [-1], "pose_keypoints_2d": flat}
                text = json.dumps({"version": 1.3, "people": [person]}, separators=(",", ":"))
                put(f"pose/{label}_json/{label}_{frame:06d}.json", text)
        cameras = [
            RigCamera(
                label, truth.intrinsics[n], truth.distortion[n], False, (1280, 720), truth.rotations[n], truth.translations[n]
            )
            for n, label in enumerate(observations.camera_labels)
        ]
        with tempfile.TemporaryDirectory() as folder:
            write_calibration(f"{folder}/Calib.toml", Rig.of(cameras), "pose2sim")
            put("calibration/Calib.toml", Path(folder, "Calib.toml").read_text("utf-8"))
        put("Config.toml", f"[project]\nframe_rate = {session.fps:g}\n")
        put("skeleton.toml", f"points = {json.dumps(NAMES, indent=2)}\n")
    print(path)


if __name__ == "__main__":
    main()
