"""FreeMoCap: an array of what all cameras saw (.npy), alone or in the folder of a recording."""

from __future__ import annotations

from pathlib import Path

from torchstickcal.io.formats import keypoint_reader
from torchstickcal.io.recording import Recording, View, in_folder
from torchstickcal.io.skeletons import SKELETONS
from torchstickcal.untrusted import read_array

_RAW = Path("output_data", "raw_data")
_VIDEOS = ("synchronized_videos", "annotated_videos")
_NPY = b"\x93NUMPY"


def _arrays(path: Path) -> list[Path]:
    return in_folder(path / _RAW, "*2d*.npy")


@keypoint_reader(
    "freemocap",
    "FreeMoCap: 2D data (.npy), or the folder of a recording",
    recognises=lambda path, head: head.startswith(_NPY) or bool(_arrays(path)),
)
def read_freemocap(path: Path) -> Recording:
    """Read an array (cameras, frames, points, 2 or 3). A third number, of a depth or a score, is not used.

    In the folder of a recording, cameras have the names of its videos, and the intrinsics are those of its calibration.
    """
    file, folder = path, None
    if path.is_dir():
        files = _arrays(path)
        if len(files) != 1:
            raise ValueError(f"{len(files)} arrays of 2D data in {_RAW}: {[one.name for one in files][:5]}; give one of them")
        file, folder = files[0], path
    keypoints = read_array(file)
    if keypoints.ndim != 4 or keypoints.shape[-1] not in (2, 3):
        raise ValueError(f"an array of the shape {keypoints.shape}; (cameras, frames, points, 2 or 3) is expected")
    names = _video_names(folder, len(keypoints))
    blazepose = SKELETONS["blazepose-33"]
    further = keypoints.shape[2] - len(blazepose)
    points = [*blazepose, *(f"point {number}" for number in range(len(blazepose), keypoints.shape[2]))] if further > 0 else None
    views = [View.of_tracks(name, own[None, ..., :2], points) for name, own in zip(names, keypoints, strict=True)]
    calibrations = [] if folder is None else in_folder(folder, "*camera_calibration.toml")
    return Recording.of(views, intrinsics=calibrations[0] if len(calibrations) == 1 else None)


def _video_names(folder: Path | None, cameras: int) -> list[str]:
    """The names of the cameras: of their videos, sorted as FreeMoCap sorts them, else their numbers."""
    for videos in () if folder is None else [folder / name for name in _VIDEOS]:
        names = sorted(file.stem for file in in_folder(videos) if file.suffix.lower() in (".mp4", ".avi", ".mov"))
        if len(names) == cameras:
            return names
    return [f"cam_{number}" for number in range(cameras)]
