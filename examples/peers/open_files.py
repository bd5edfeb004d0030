"""What other programs read in the files that torchstickcal writes for them.

    torchstickcal calibrate PROJECT --stick RKnee RAnkle 0.43 --fps 60 --out results \
        --write anipose,caliscope,freemocap,colmap,easymocap,opencv,opencap,nerfstudio,trc,c3d
    python examples/peers/open_files.py results --pose2sim PROJECT --model BODY_25B

Each program that is installed reads its file, and prints how far its cameras are from those of `report.json`. Pose2Sim also
triangulates the project with our calibration. Programs that are not installed are skipped.
"""

from __future__ import annotations

import argparse
import json
import logging
import pickle
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

Pose = tuple[str, np.ndarray, np.ndarray]
"""Name, rotation (3, 3) and translation (3,) of a camera, world to camera, metres."""


def anipose(folder: Path) -> Iterator[Pose]:
    from aniposelib.cameras import CameraGroup

    for camera in CameraGroup.load(str(folder / "anipose.toml")).cameras:
        yield camera.get_name(), rotation(camera.get_rotation()), np.ravel(camera.get_translation())


def pose2sim(folder: Path) -> Iterator[Pose]:
    from Pose2Sim.common import retrieve_calib_params

    found = retrieve_calib_params(folder / "calibration.toml")
    yield from zip(names(folder), found["R_mat"], found["T"], strict=True)


def caliscope(folder: Path) -> Iterator[Pose]:
    from caliscope.cameras.camera_array import CameraArray

    array = CameraArray.from_toml(folder / "camera_array.toml")
    for name, camera in zip(names(folder), array.cameras.values(), strict=True):
        yield name, camera.rotation, np.ravel(camera.translation)


def colmap(folder: Path) -> Iterator[Pose]:
    import pycolmap

    for image in pycolmap.Reconstruction(str(folder / "colmap")).images.values():
        pose = image.cam_from_world() if callable(image.cam_from_world) else image.cam_from_world
        yield Path(image.name).stem, pose.rotation.matrix(), pose.translation


def opencv(folder: Path) -> Iterator[Pose]:
    import cv2

    for file in sorted((folder / "opencv").glob("*.yml")):
        storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_READ)
        yield storage.getNode("camera_name").string(), storage.getNode("R").mat(), storage.getNode("T").mat().ravel()


def easymocap(folder: Path) -> Iterator[Pose]:
    """With OpenCV's FileStorage, by which EasyMocap reads its files."""
    import cv2

    storage = cv2.FileStorage(str(folder / "easymocap" / "extri.yml"), cv2.FILE_STORAGE_READ)
    listed = storage.getNode("names")
    for name in (listed.at(index).string() for index in range(listed.size())):
        yield name, rotation(storage.getNode(f"R_{name}").mat()), storage.getNode(f"T_{name}").mat().ravel()


def opencap(folder: Path) -> Iterator[Pose]:
    """With pickle, by which OpenCap reads its files."""
    for file in sorted((folder / "opencap" / "Videos").glob("*/*.pickle")):
        content = pickle.loads(file.read_bytes())
        yield file.parent.name, content["rotation"], content["translation"].ravel() / 1000


READERS: dict[str, Callable[[Path], Iterator[Pose]]] = {
    reader.__name__: reader for reader in (pose2sim, anipose, caliscope, colmap, opencv, easymocap, opencap)
}


def rotation(vector: np.ndarray) -> np.ndarray:
    import cv2

    return cv2.Rodrigues(np.asarray(vector, dtype=float))[0]


def names(folder: Path) -> list[str]:
    return [camera["name"] for camera in json.loads((folder / "report.json").read_text("utf-8"))["cameras"]]


def compared(folder: Path, found: list[Pose]) -> str:
    """The largest difference of a program's cameras from ours."""
    report = json.loads((folder / "report.json").read_text("utf-8"))["cameras"]
    ours = {camera["name"]: (np.array(camera["rotation"]), np.array(camera["translation_m"])) for camera in report}
    if {name for name, _, _ in found} != set(ours):
        return f"other cameras: {[name for name, _, _ in found]}"
    turns = [np.abs(matrix - ours[name][0]).max() for name, matrix, _ in found]
    shifts = [np.abs(translation - ours[name][1]).max() for name, _, translation in found]
    return f"{len(found)} cameras; largest difference of rotations {max(turns):.1e}, of translations {max(shifts):.1e} m"


def points(folder: Path) -> None:
    """The C3D file, read by ezc3d."""
    import ezc3d

    file = ezc3d.c3d(str(next(folder.glob("*.c3d"))))
    point = file["parameters"]["POINT"]
    known = file["data"]["meta_points"]["residuals"][0] >= 0
    print(
        f"ezc3d: {len(point['LABELS']['value'])} points, {known.shape[1]} frames at {point['RATE']['value'][0]:g} Hz in "
        f"{point['UNITS']['value'][0]}, {100 * known.mean():.0f} % known, z up to {file['data']['points'][2][known].max():.0f}"
    )


def triangulated(folder: Path, project: Path, model: str) -> None:
    """Pose2Sim's own triangulation of a project, with our calibration in the place of its own."""
    from Pose2Sim.triangulation import triangulate_all

    logging.basicConfig(level=logging.INFO, format="  %(message)s", stream=sys.stdout, force=True)
    with tempfile.TemporaryDirectory() as session:
        trial = Path(session)
        shutil.copytree(project / "pose", trial / "pose", copy_function=shutil.copyfile)
        (trial / "calibration").mkdir()
        shutil.copyfile(folder / "calibration.toml", trial / "calibration" / "Calib.toml")
        (trial / "Config.toml").write_text("")
        triangulate_all({
            "project": {"project_dir": str(trial), "frame_range": "all", "multi_person": False, "frame_rate": 60},
            "pose": {"pose_model": model, "vid_img_extension": ".mp4"},
            "triangulation": {
                "reproj_error_threshold_triangulation": 30, "likelihood_threshold_triangulation": 0.3,
                "min_cameras_for_triangulation": 2, "make_c3d": False, "handle_LR_swap": False,
            },
        })  # fmt: skip
        lines = [line.split("\t") for line in next((trial / "pose-3d").glob("*.trc")).read_text().splitlines()]
    markers = [name for name in lines[3][2:] if name]
    rows = np.array([[float(cell) if cell else np.nan for cell in line[2:]] for line in lines[5:]])
    heights = dict(zip(markers, np.nanmedian(rows[:, 1::3], axis=0).round(3).tolist(), strict=False))
    print(f"Pose2Sim's TRC, median heights in {lines[2][4]}: {heights}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("results", type=Path)
    parser.add_argument("--pose2sim", type=Path, help="a project that Pose2Sim triangulates with our calibration")
    parser.add_argument("--model", default="HALPE_26", help="Pose2Sim's name of the skeleton")
    options = parser.parse_args()
    for name, reader in READERS.items():
        try:
            print(f"{name}: {compared(options.results, list(reader(options.results)))}")
        except ModuleNotFoundError as error:
            print(f"{name}: not installed ({error.name})")
        except (FileNotFoundError, StopIteration):
            print(f"{name}: no file")
    try:
        points(options.results)
    except ModuleNotFoundError:
        print("ezc3d: not installed")
    except StopIteration:
        print("ezc3d: no file")
    if options.pose2sim:
        triangulated(options.results, options.pose2sim, options.model)


if __name__ == "__main__":
    main()
