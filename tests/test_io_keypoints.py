"""Keypoints of detectors: one session, written by the test as each program writes it, is read as the same session."""

from __future__ import annotations

import json
import pickle
import shutil
import sys
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError, ConfigError, FileFormatError, Observations, Stick
from torchstickcal.cli import main
from torchstickcal.io import (
    CALIBRATION_READERS,
    KEYPOINT_READERS,
    SESSION_READERS,
    SKELETONS,
    Given,
    Recording,
    View,
    complete,
    find_reader,
    load_session,
    read_recording,
    read_session,
    recording_of_movement,
    write_npz,
)
from torchstickcal.io.formats import head_of
from torchstickcal.io.skeletons import conventional, skeleton
from torchstickcal.simulate import golf_session

WIDTH, HEIGHT = 1920, 1080
CAMERAS = ("cam2", "cam9", "cam10")
FIRST = 7
"""Number of the first frame, where files number frames."""
Session = tuple[np.ndarray, np.ndarray, list[str]]


@pytest.fixture(scope="module")
def session() -> Session:
    """Keypoints (3, 6, 21, 2) with gaps, scores (3, 6, 21), and names."""
    observations, _ = golf_session(cameras=3, frames=6)
    rng = np.random.default_rng(1)
    keypoints = observations.keypoints.numpy().round(3)
    scores = rng.uniform(0.2, 1, keypoints.shape[:3]).round(3)
    keypoints[rng.uniform(size=scores.shape) < 0.1] = np.nan
    assert observations.point_names
    return keypoints, scores, list(observations.point_names)


def zeros(keypoints: np.ndarray, scores: np.ndarray) -> np.ndarray:
    """Keypoints (..., 3) as most programs write them: zeros where a point was not seen."""
    seen = np.isfinite(keypoints[..., :1])
    return np.where(seen, np.concatenate([keypoints, scores[..., None]], axis=-1), 0.0)


def put(path: Path, content: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(content if isinstance(content, str) else json.dumps(content))


def frames(session: Session, camera: int) -> list[tuple[int, np.ndarray]]:
    return [(FIRST + number, one) for number, one in enumerate(zeros(session[0][camera], session[1][camera]))]


def openpose(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        for frame, one in frames(session, camera):
            person = {"person_id": [-1], "pose_keypoints_2d": one.ravel().tolist(), "face_keypoints_2d": []}
            put(folder / f"{name}_json" / f"video1_{frame:012d}_keypoints.json", {"version": 1.3, "people": [person]})
        put(folder / f"{name}_json" / f"video1_{FIRST + 6:012d}_keypoints.json", {"version": 1.3, "people": []})


def pose2sim(folder: Path, session: Session) -> None:
    openpose(folder / "pose", (np.zeros_like(session[0]) + 5, *session[1:]))
    openpose(folder / "pose-sync", session)
    put(folder / "Config.toml", "[project]\nframe_rate = 60\n[pose]\npose_model = 'mine'\n")


def easymocap(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        for frame, one in frames(session, camera):
            person = {"personID": 0, "bbox": [0, 0, 1, 1, 1], "keypoints": one.tolist()}
            image = {"filename": f"images/{frame}.jpg", "height": HEIGHT, "width": WIDTH, "annots": [person]}
            put(folder / "annots" / name / f"{frame:06d}.json", image)


def coco_results(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        rows = [
            {"image_id": f, "category_id": 1, "keypoints": one.ravel().tolist(), "score": 0.9}
            for f, one in frames(session, camera)
        ]
        put(folder / f"{name}.json", rows)


def coco_annotations(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        content = {
            "info": {"description": "x" * 5000},
            "images": [
                {"id": 100 + f, "file_name": f"{name}_{f:06d}.jpg", "width": WIDTH, "height": HEIGHT}
                for f, _ in frames(session, camera)
            ],
            "annotations": [
                {
                    "id": f,
                    "image_id": 100 + f,
                    "keypoints": np.where(one[:, 2:] > 0, one * [1, 1, 0] + [0, 0, 2], 0).ravel().tolist(),
                }
                for f, one in frames(session, camera)
            ],
            "categories": [{"id": 1, "name": "person", "keypoints": session[2]}],
        }
        put(folder / f"{name}.json", content)


def alphapose(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        rows = [
            {
                "image_id": f"{f}.jpg",
                "category_id": 1,
                "keypoints": (one * [1, 1, 6]).ravel().tolist(),
                "score": 2.9,
                "idx": [1.0],
            }
            for f, one in frames(session, camera)
        ]
        put(folder / f"{name}.json", rows)


def instance(one: np.ndarray) -> dict[str, object]:
    return {
        "keypoints": one[:, :2].tolist(),
        "keypoint_scores": one[:, 2].tolist(),
        "bbox": [[0.0, 0, 1, 1]],
        "bbox_score": 0.9,
    }


def mmpose_video(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        put(folder / f"{name}.json", [{"frame_id": f, "instances": [instance(one)]} for f, one in frames(session, camera)])


def mmpose_demo(folder: Path, session: Session) -> None:
    meta = {"dataset_name": "mine", "padding": "x" * 5000, "keypoint_id2name": dict(enumerate(session[2]))}
    for camera, name in enumerate(CAMERAS):
        rows = [{"frame_id": f, "instances": [instance(one)]} for f, one in frames(session, camera)]
        put(folder / f"{name}.json", {"meta_info": meta, "instance_info": rows})


def mmpose_images(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        for frame, one in frames(session, camera):
            put(folder / name / f"{frame:04d}.json", [instance(one)])


def ultralytics(folder: Path, session: Session) -> None:
    for camera, name in enumerate(CAMERAS):
        put(folder / name / f"{FIRST - 1}.json", "[]")
        for frame, one in frames(session, camera):
            x, y, visible = one.T.tolist()
            box = {"x1": 0, "y1": 0, "x2": 1, "y2": 1}
            person = {
                "name": "person",
                "class": 0,
                "confidence": 0.9,
                "box": box,
                "keypoints": {"x": x, "y": y, "visible": visible},
            }
            put(folder / name / f"{frame}.json", [person])


def ultralytics_txt(after: str) -> Callable[[Path, Session], None]:
    def write(folder: Path, session: Session) -> None:
        for camera, name in enumerate(CAMERAS):
            for frame, one in frames(session, camera):
                words = [f"{value:.9f}" for value in (one / [WIDTH, HEIGHT, 1]).ravel()]
                put(folder / name / f"video_{frame}.txt", f"0 0.5 0.5 0.2 0.4 {' '.join(words)}{after}\n")

    return write


def deeplabcut(individuals: bool) -> Callable[[Path, Session], None]:
    def write(folder: Path, session: Session) -> None:
        for camera, name in enumerate(CAMERAS):
            points = session[2]
            rows = [["scorer"] + ["DLC_resnet50"] * 3 * len(points)]
            rows += [["individuals"] + ["anna"] * 3 * len(points)] if individuals else []
            rows += [
                ["bodyparts", *(point for point in points for _ in range(3))],
                ["coords", *(["x", "y", "likelihood"] * len(points))],
            ]
            for frame, one in enumerate(np.concatenate([session[0][camera], session[1][camera][..., None]], axis=-1)):
                rows.append([str(FIRST + frame), *("" if np.isnan(value) else str(value) for value in one.ravel())])
            put(folder / f"{name}DLC_resnet50_golfMay1shuffle1_1000_filtered.csv", "\n".join(",".join(row) for row in rows))

    return write


def anipose(folder: Path, session: Session) -> None:
    deeplabcut(False)(folder / "pose-2d", session)
    for file in (folder / "pose-2d").iterdir():
        file.rename(file.with_name(f"swing1-{file.name.partition('DLC')[0]}.csv"))
    put(folder / "config.toml", "[triangulation]\ncam_regex = '-(cam[0-9]+)'\n")


def caliscope(old: bool) -> Callable[[Path, Session], None]:
    def write(folder: Path, session: Session) -> None:
        camera_id, point_id = ("port", "point_id") if old else ("cam_id", "keypoint_id")
        lines = [f"sync_index,{camera_id},frame_index,frame_time,object_id,{point_id},img_loc_x,img_loc_y,obj_loc_x,obj_loc_y"]
        for camera, name in enumerate(CAMERAS):
            for frame, point in np.argwhere(np.isfinite(session[0][camera, ..., 0])):
                x, y = session[0][camera, frame, point]
                number = FIRST + frame
                lines.append(f"{number},{name[3:]},{number},{number / 60 + camera / 1000},0,{point},{x},{y},,")
        put(folder / "xy.csv", "\n".join(lines))

    return write


def freemocap(folder: Path, session: Session) -> None:
    raw = folder / "output_data" / "raw_data"
    raw.mkdir(parents=True)
    np.save(raw / "mediapipe_2dData_numCams_numFrames_numTrackedPoints_pixelXY.npy", session[0][[2, 0, 1]])  # sorted as text
    for name in CAMERAS:
        put(folder / "synchronized_videos" / f"{name}.mp4", "")


def table(separator: str) -> Callable[[Path, Session], None]:
    def write(folder: Path, session: Session) -> None:
        lines = ["Point;Camera;Frame;X;Y;Score".replace(";", separator)]
        for camera, name in enumerate(CAMERAS):
            for frame, one in frames(session, camera):
                lines += [
                    separator.join((point, name, str(frame), *map(str, values)))
                    for point, values in zip(session[2], one, strict=True)
                    if values[2]
                ]
        put(folder / "swing.csv", "\r\n".join(lines))

    return write


def dltdv(folder: Path, session: Session) -> None:
    tracks = session[0].transpose(1, 2, 0, 3)
    header = [f"pt{p + 1}_cam{name[3:]}_{axis}" for p in range(21) for name in CAMERAS for axis in "XY"]
    rows = [",".join("NaN" if np.isnan(value) else str(value) for value in row) for row in tracks.reshape(len(tracks), -1)]
    put(folder / "xypts.csv", "\n".join([",".join(header), *rows]))


WRITERS: dict[str, tuple[str, Callable[[Path, Session], None]]] = {
    "OpenPose": ("openpose", openpose),
    "Pose2Sim": ("pose2sim-project", pose2sim),
    "EasyMocap": ("easymocap", easymocap),
    "COCO results": ("coco", coco_results),
    "COCO annotations": ("coco", coco_annotations),
    "AlphaPose": ("alphapose", alphapose),
    "MMPose video": ("mmpose", mmpose_video),
    "MMPose demo": ("mmpose", mmpose_demo),
    "MMPose images": ("mmpose", mmpose_images),
    "Ultralytics": ("ultralytics", ultralytics),
    "Ultralytics txt": ("ultralytics-txt", ultralytics_txt("")),
    "Ultralytics txt with confidence": ("ultralytics-txt", ultralytics_txt(" 0.9")),
    "Ultralytics txt with track": ("ultralytics-txt", ultralytics_txt(" 0.9 3")),
    "DeepLabCut": ("deeplabcut", deeplabcut(False)),
    "DeepLabCut individuals": ("deeplabcut", deeplabcut(True)),
    "Anipose": ("anipose", anipose),
    "Caliscope": ("caliscope", caliscope(False)),
    "older Caliscope": ("caliscope", caliscope(True)),
    "FreeMoCap": ("freemocap", freemocap),
    "table": ("csv", table(",")),
    "table with semicolons": ("csv", table(";")),
    "DLTdv": ("dltdv", dltdv),
}
NO_SCORES = {"caliscope", "freemocap", "dltdv"}


def only_file(folder: Path) -> Path:
    """The file of all cameras, where there is one; else the folder."""
    entries = list(folder.iterdir())
    return entries[0] if len(entries) == 1 and entries[0].is_file() else folder


@pytest.mark.parametrize("what", WRITERS)
def test_every_format_gives_the_same_session(what: str, session: Session, tmp_path: Path):
    name, write = WRITERS[what]
    write(tmp_path, session)
    path = only_file(tmp_path)
    assert claims(path) == [name]
    given = Given(Stick(19, 20, 1.0), image_size=(WIDTH, HEIGHT), fps=60)
    loaded = load_session(path, given=given)
    observations = loaded.observations
    keypoints, scores, names = session
    assert [label.removeprefix("cam_") for label in observations.camera_labels] in (
        list(CAMERAS),
        [camera.removeprefix("cam") for camera in CAMERAS],
    )
    np.testing.assert_allclose(observations.keypoints.numpy(), keypoints, atol=1e-5)
    assert observations.confidence is not None
    given_scores = observations.confidence.numpy()
    seen = np.isfinite(keypoints[..., 0])
    expected = np.ones_like(scores) if name in NO_SCORES or what == "COCO annotations" else scores
    if name == "alphapose":
        expected = scores / scores[seen].max()
        assert any("scores go up to" in note for note in loaded.notes)
    np.testing.assert_allclose(given_scores[seen], expected[seen], atol=1e-5)
    assert not given_scores[~seen].any()
    if what in ("DeepLabCut", "table", "COCO annotations", "MMPose demo", "Anipose"):
        assert list(observations.point_names or ()) == names


def claims(path: Path) -> list[str]:
    registries = (SESSION_READERS, KEYPOINT_READERS, CALIBRATION_READERS)
    return [name for registry in registries for name, reader in registry.items() if reader.takes(path, head_of(path))]


@pytest.mark.parametrize("what", WRITERS)
def test_damaged_files_are_one_error_of_our_own(what: str, session: Session, tmp_path: Path):
    name, write = WRITERS[what]
    rng = np.random.default_rng(len(what))
    write(tmp_path / "whole", session)
    files = sorted(path for path in (tmp_path / "whole").rglob("*") if path.is_file() and path.stat().st_size)
    given = Given(Stick(19, 20, 1.0), image_size=(WIDTH, HEIGHT))
    for trial in range(16):
        folder = tmp_path / "damaged"
        shutil.copytree(tmp_path / "whole", folder)
        path = folder / files[int(rng.integers(len(files)))].relative_to(tmp_path / "whole")
        content = bytearray(path.read_bytes())
        at = int(rng.integers(len(content)))
        damage = [content[:at], content[:at] + b"\x00\xff{[\n" + content[at:], b"null", content.replace(b"0.", b'"a"', 40)][
            trial % 4
        ]
        path.write_bytes(damage)
        with suppress(CalibrationError, FileNotFoundError):
            read_session(only_file(folder), name, given)
        shutil.rmtree(folder)


@pytest.mark.parametrize("name", [*KEYPOINT_READERS, *CALIBRATION_READERS])
@pytest.mark.parametrize(
    "content", [b"", b"null", b"[]", b"{}", b"[[[[[[" * 20000, b"\x89HDF\r\n\x1a\n" + bytes(500), b"a,b\n1,2\n"]
)
def test_hostile_files_are_one_error_of_our_own(name: str, content: bytes, tmp_path: Path):
    path = tmp_path / "a.json"
    path.write_bytes(content)
    reader = KEYPOINT_READERS[name] if name in KEYPOINT_READERS else CALIBRATION_READERS[name]
    for place in (path, tmp_path):
        with pytest.raises((CalibrationError, FileNotFoundError)):
            reader.read(place)


def test_several_files_are_the_cameras_of_one_session(session: Session, tmp_path: Path):
    deeplabcut(False)(tmp_path, session)
    files = sorted(tmp_path.iterdir(), reverse=True)
    observations, truth = read_session(files, given=Given(Stick("club_grip", "club_head", 1.0), image_size=(WIDTH, HEIGHT)))
    assert observations.camera_names == CAMERAS
    assert truth is None
    np.testing.assert_array_equal(observations.keypoints.numpy(), session[0])
    write_npz(tmp_path / "a.npz", golf_session(cameras=3, frames=6)[0])
    with pytest.raises(CalibrationError, match="several files that are not one camera each"):
        read_session([tmp_path / "a.npz", files[0]])


def test_what_else_is_in_the_folder_is_said(session: Session, tmp_path: Path):
    coco_results(tmp_path, session)
    put(tmp_path / "notes.txt", "a fine day")
    put(tmp_path / ".hidden", "")
    assert read_recording(tmp_path).notes == (f"Not read in {tmp_path}: notes.txt.",)


def test_points_that_were_not_seen():
    view = View.of_tracks(
        "a", np.array([[[[0, 0, 0.9], [-1, -1, 0.5], [-3, 7, 0.5], [4, 5, 0], [4, 5, -1], [4, np.inf, 1], [1, 2, 0.5]]]])
    )
    assert view.keypoints[0, :, 0].tolist() == pytest.approx([np.nan, np.nan, -3, np.nan, np.nan, np.nan, 1], nan_ok=True)
    assert view.keypoints[0, :, 2].tolist() == [0, 0, 0.5, 0, 0, 0, 0.5]


def recording(firsts: tuple[int, ...], count: int = 4, points: int = 2, size: tuple[float, float] | None = None) -> Recording:
    """Cameras whose frames begin at different numbers; x is the number of the frame."""
    return Recording.of(
        [
            View.of_tracks(
                f"c{camera}",
                np.stack(np.broadcast_arrays(np.arange(first, first + count)[:, None] + 1.0, np.arange(points) + 5.0), -1)[
                    None
                ],
                frames=range(first, first + count),
                image_size=size,
            )
            for camera, first in enumerate(firsts)
        ]
    )


@pytest.mark.parametrize("name", ["{}", "video_{}_keypoints", "cam01_25fps_{}_pose2d", "{}-v2"])
def test_frames_are_numbered_in_any_usual_way(name: str, tmp_path: Path):
    for camera in ("a", "b"):
        for frame in (2, 10, 9):
            person = {"pose_keypoints_2d": [frame, 1, 1, 5, 5, 1]}
            put(tmp_path / camera / f"{name.format(frame)}.json", {"people": [person]})
    assert [view.frames.tolist() for view in read_recording(tmp_path).views] == [[2, 9, 10]] * 2
    put(tmp_path / "a" / "last.json", {"people": []})
    with pytest.raises(FileFormatError, match="files of frames are not numbered"):
        read_recording(tmp_path)


class Labelled(np.ndarray):
    """As much of an array of xarray as is used."""

    axes: tuple[str, ...]

    @classmethod
    def of(cls, values: np.ndarray, *axes: str) -> Labelled:
        array = values.view(cls)
        array.axes = axes
        return array

    @property
    def values(self) -> np.ndarray:
        return np.asarray(self)

    def transpose(self, *axes: str) -> Labelled:  # type: ignore[override]
        return Labelled.of(np.transpose(np.asarray(self), [self.axes.index(axis) for axis in axes]), *axes)


def test_datasets_of_movement(session: Session):
    class Dataset(dict):
        attrs = {"fps": 50}  # noqa: RUF012

    def dataset(camera: int) -> Dataset:
        keypoints, scores = session[0][camera], session[1][camera]
        return Dataset(
            position=Labelled.of(keypoints.transpose(0, 2, 1)[..., None].copy(), "time", "space", "keypoints", "individuals"),
            confidence=Labelled.of(scores[..., None].copy(), "time", "keypoints", "individuals"),
            keypoints=Labelled.of(np.array(session[2]), "keypoints"),
        )

    found = recording_of_movement({name: dataset(camera) for camera, name in enumerate(CAMERAS)})
    observations, _ = complete(found, Given(Stick("club_grip", "club_head", 1.0), image_size=(WIDTH, HEIGHT)))
    assert observations.fps == 50
    np.testing.assert_array_equal(observations.keypoints.numpy(), session[0])
    with pytest.raises(FileFormatError, match="datasets of movement"):
        recording_of_movement({"a": {"position": np.zeros(3)}})


def test_frames_are_matched_by_their_numbers():
    given = Given(Stick(0, 1, 1.0), image_size=(640, 480))
    observations, notes = complete(recording((3, 5)), given)
    assert observations.num_frames == 6
    np.testing.assert_array_equal(
        observations.keypoints[:, :, 0, 0].numpy(), [[4, 5, 6, 7, np.nan, np.nan], [np.nan, np.nan, 6, 7, 8, 9]]
    )
    assert not notes
    observations, notes = complete(recording((0, 100)), given)
    np.testing.assert_array_equal(observations.keypoints[:, :, 0, 0].numpy(), [[1, 2, 3, 4], [101, 102, 103, 104]])
    assert "no frame numbers in common (c0 0 to 3, c1 100 to 103)" in notes[0]
    apart = Recording.of([*recording((0,)).views, View.of_tracks("far", np.ones((1, 2, 2, 2)), frames=[0, 10**12])])
    with pytest.raises(FileFormatError, match="frame numbers are far apart"):
        complete(apart, given)


def test_skeletons_have_names():
    for names in SKELETONS.values():
        assert len(set(names)) == len(names)
        assert [conventional(name) for name in names] == list(names)
    sizes = {name: len(names) for name, names in SKELETONS.items()}
    assert sizes == {
        "coco-17": 17, "halpe-26": 26, "body-25": 25, "body-25b": 25, "coco-wholebody": 133, "blazepose-33": 33,
        "sports-stick-syn": 19,
    }  # fmt: skip
    assert skeleton("HALPE_26")[20] == "left_big_toe"
    assert skeleton("body25")[8] == "hip"
    assert [SKELETONS[name].index("right_ankle") for name in SKELETONS] == [16, 16, 11, 16, 16, 28, 15]
    with pytest.raises(CalibrationError, match=r"unknown skeleton.*Did you mean 'coco-17'"):
        skeleton("coco-18")
    with pytest.raises(CalibrationError, match=r"26 names; expected 17.*These have 17 points: coco-17"):
        skeleton("halpe-26", 17)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ('points = ["a", "b", "c"]', r"3 names; expected 2"),
        ('points = ["a", "a"]', r"two points called 'a'"),
        ("points = [1, 2]", r"not a list of names"),
        ("names = 1", r"no 'points'"),
    ],
)
def test_a_skeleton_of_one_s_own(content: str, message: str, tmp_path: Path):
    path = tmp_path / "mine.toml"
    given = Given(Stick("knob", "barrel", 1.0), image_size=(640, 480), skeleton=str(path))
    path.write_text('points = ["knob", "barrel"]')
    assert complete(recording((0, 0)), given)[0].point_names == ("knob", "barrel")
    path.write_text(content)
    with pytest.raises(CalibrationError, match=message):
        complete(recording((0, 0)), given)


@pytest.mark.parametrize("name", ["right_knee", "RKnee", "knee_right", "Right Knee", "r_knee", "rknee"])
def test_points_are_found_by_any_usual_name(name: str):
    observations, notes = complete(recording((0, 0), points=17), Given(Stick(name, "RAnkle", 0.4), image_size=(640, 480)))
    assert observations.sticks[0].ends == (14, 16)
    assert "taken to be coco-17, by its 17 points" in notes[0]


def test_what_is_not_known_is_asked_for():
    stick = Stick(0, 1, 1.0)
    with pytest.raises(CalibrationError, match=r"no stick.*the points are point 0, point 1.*--stick START END METRES"):
        complete(recording((0, 0)), Given(image_size=(640, 480)))
    with pytest.raises(CalibrationError, match=r"nothing is known of the lenses.*--intrinsics.*--image-size"):
        complete(recording((0, 0)), Given(stick))
    assert complete(recording((0, 0), size=(640, 480)), Given(stick))[0].image_size is not None
    with pytest.raises(CalibrationError, match=r"keypoints lie outside the image.*--image-size"):
        complete(recording((0, 0), count=40), Given(stick, image_size=(16, 9)))
    with pytest.raises(CalibrationError, match=r"the skeleton is not known.*body-25 or body-25b"):
        complete(recording((0, 0), points=25), Given(stick, image_size=(640, 480)))


def test_an_image_size_that_contradicts_the_files_is_refused():
    with pytest.raises(CalibrationError, match=r"another image size than the files say .*c0\): got \[320.0, 240.0\]"):
        complete(recording((0, 0), size=(640, 480)), Given(Stick(0, 1, 1.0), image_size=(320, 240)))
    for size in ((640,), 5, [[1, 2]] * 3):
        with pytest.raises(CalibrationError, match="image size is not usable"):
            complete(recording((0, 0)), Given(Stick(0, 1, 1.0), image_size=size))


def calib_toml(observations: Observations, names: tuple[str, ...]) -> str:
    """Intrinsics as Pose2Sim writes them."""
    text = ""
    assert observations.distortion is not None
    for name, matrix, lens in zip(names, observations.cameras.matrix, observations.distortion, strict=True):
        text += f'[{name}]\nname = "{name}"\nsize = [ {WIDTH}.0, {HEIGHT}.0]\nmatrix = {matrix.tolist()}\n'
        text += f"distortions = {lens[:4].tolist()}\nrotation = [ 0.0, 0.0, 0.0]\ntranslation = [ 0.0, 0.0, 1.0]\n"
        text += "fisheye = false\n\n"
    return text + "[metadata]\nadjusted = false\n"


def test_a_folder_of_keypoints_and_a_calibration_give_the_rig(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """By one command; the cameras of the calibration are in another order and have other names."""
    observations, truth = golf_session(cameras=3, frames=20)
    assert observations.point_names
    keypoints = observations.keypoints.numpy()
    openpose(tmp_path / "keypoints", (keypoints, np.ones(keypoints.shape[:3]), list(observations.point_names)))
    put(tmp_path / "points.toml", f"points = {json.dumps(observations.point_names)}")
    put(tmp_path / "Calib.toml", calib_toml(observations, ("int_2", "int_9", "int_10")))
    stick = observations.sticks[0]
    command = ["calibrate", str(tmp_path / "keypoints"), "--stick", "ClubGrip", "club_head", str(stick.length_m), "--fps", "60"]
    command += ["--intrinsics", str(tmp_path / "Calib.toml"), "--skeleton", str(tmp_path / "points.toml")]
    assert main([*command, "--out", str(tmp_path / "out")]) == 0
    assert "cam10 = int_10" in capsys.readouterr().err
    write_npz(tmp_path / "truth.npz", observations, truth)
    assert main(["evaluate", str(tmp_path / "out"), str(tmp_path / "truth.npz"), "--json", str(tmp_path / "e.json")]) == 0
    errors = json.loads((tmp_path / "e.json").read_text())
    assert errors["mean_rotation_deg"] < 1e-3
    assert errors["mean_translation_m"] < 1e-4


def test_the_calibration_of_a_project_is_used(session: Session, tmp_path: Path):
    pose2sim(tmp_path, session)
    observations, _ = golf_session(cameras=3, frames=6)
    put(tmp_path / "Config.toml", "[project]\nframe_rate = 'auto'\n[pose]\npose_model = 'Body'\n")
    put(tmp_path / "calibration" / "Calib.toml", calib_toml(observations, CAMERAS))
    put(tmp_path / "calibration" / "notes.txt", "a fine day")
    found = read_recording(tmp_path)
    assert found.intrinsics == (tmp_path / "calibration" / "Calib.toml").resolve()
    assert (found.skeleton, found.fps) == ("coco-17", None)
    with pytest.raises(CalibrationError, match=r"a skeleton with another number of points .*got 17 names; expected 21"):
        read_session(tmp_path, given=Given(Stick(19, 20, 1.0)))
    put(tmp_path / "Config.toml", "")
    read, _ = read_session(tmp_path, given=Given(Stick(19, 20, 1.0)))
    torch.testing.assert_close(read.intrinsics, observations.cameras.matrix)
    put(tmp_path / "calibration" / "old.toml", calib_toml(observations, CAMERAS))
    with pytest.raises(FileFormatError, match=r"several calibrations in one project .*Calib.toml, old.toml.*--intrinsics"):
        read_recording(tmp_path)


def test_the_stick_may_be_in_files_of_its_own():
    body, stick = recording((0, 0), points=17), recording((0, 0))
    named = Recording.of([View(v.name, v.frames, v.keypoints, v.persons, ("knob", "barrel")) for v in reversed(stick.views)])
    given = Given(Stick("knob", "barrel", 0.864), image_size=(640, 480), stick_points=named)
    observations, _ = complete(body, given)
    assert observations.num_points == 19
    assert observations.sticks[0].ends == (17, 18)
    np.testing.assert_array_equal(observations.keypoints[:, :, 17], observations.keypoints[:, :, 0])
    with pytest.raises(FileFormatError, match="recorded by other cameras"):
        complete(recording((0, 0, 0), points=17), given)


def test_a_session_that_is_whole_may_be_told_more(tmp_path: Path):
    observations, truth = golf_session(cameras=3, frames=6)
    write_npz(tmp_path / "a.npz", observations, truth)
    told = read_session(tmp_path / "a.npz", given=Given(Stick("left_knee", "LAnkle", 0.4), fps=50, image_size=(WIDTH, HEIGHT)))[
        0
    ]
    assert told.fps == 50
    assert told.sticks[0].length_m == 0.4
    assert told.keypoints.equal(observations.keypoints)
    with pytest.raises(CalibrationError, match="has its athlete and its stick already"):
        read_session(tmp_path / "a.npz", given=Given(person="largest"))


def test_formats_are_chosen_by_name(session: Session, tmp_path: Path):
    coco_results(tmp_path, session)
    with pytest.raises(FileFormatError, match=r"not a file .*got a folder"):
        read_recording(tmp_path, "deeplabcut")
    with pytest.raises(ConfigError, match=r"unknown session format.*npz.*openpose.*Did you mean 'openpose'"):
        read_session(tmp_path, "open-pose")


def test_real_files_are_each_claimed_by_one_reader(data: Path):
    expected = {
        "formats/caliscope_xy.csv": "caliscope",
        "formats/caliscope_camera_array.toml": "caliscope",
        "formats/opencv_filestorage_ewand.yaml": "opencv",
        "formats/qualisys_calib.qca.txt": "qualisys",
        "real/pose2sim_project": "pose2sim-project",
        "real/pose2sim_project/pose": "openpose",
        "real/ewand.npz": "npz",
    }
    for place, name in expected.items():
        assert claims(data / place) == [name]
    assert {place for place in expected if place.startswith("formats/")} == {
        str(path.relative_to(data)) for path in (data / "formats").iterdir()
    }


def test_the_real_table_of_caliscope(data: Path):
    found = read_recording(data / "formats" / "caliscope_xy.csv")
    assert {view.name for view in found.views} <= {f"cam_{number}" for number in range(4)}
    assert found.fps is not None
    assert 2 < found.fps < 60


def test_a_pose2sim_project_is_calibrated_by_one_command(data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    """The shank of the larger of two people is the stick; Qualisys is the reference."""
    project = data / "real" / "pose2sim_project"
    command = ["calibrate", str(project), "--stick", "RKnee", "RAnkle", "0.40", "--stick-sigma", "0.01", "--out", str(tmp_path)]
    assert main(command) == 0
    said = capsys.readouterr().err
    for sentence in ("body-25b", "Calib.qca.txt", "cam1 = cam_01", "largest in the images"):
        assert sentence in said
    report = json.loads((tmp_path / "report.json").read_text())
    assert any("Several people are in view" in note for note in report["notes"])
    reference = project / "calibration" / "Calib.qca.txt"
    assert main(["evaluate", str(tmp_path), str(reference), "--json", str(tmp_path / "errors.json")]) == 0
    errors = json.loads((tmp_path / "errors.json").read_text())
    assert errors["mean_rotation_deg"] < 1.0
    assert errors["mean_translation_m"] < 0.12


def test_the_same_project_with_its_parts_given(data: Path, tmp_path: Path):
    project = data / "real" / "pose2sim_project"
    reference = project / "calibration" / "Calib.qca.txt"
    stick = Stick("RKnee", "RAnkle", 0.40)
    whole = read_session(project, given=Given(stick, fps=60))[0]
    parts = read_session(project / "pose", "openpose", Given(stick, reference, fps=60, skeleton="BODY_25B"))[0]
    assert isinstance(parts, Observations)
    for name in ("keypoints", "confidence", "intrinsics", "distortion", "image_size"):
        assert torch.equal(torch.nan_to_num(getattr(parts, name)), torch.nan_to_num(getattr(whole, name)))


@pytest.mark.parametrize("flavour", ["table", "fixed", "sleap"])
def test_hdf5(flavour: str, session: Session, tmp_path: Path):
    h5py = pytest.importorskip("h5py", reason="needs h5py")
    for camera, name in enumerate(CAMERAS):
        values = np.concatenate([session[0][camera], session[1][camera][..., None]], axis=-1)
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            if flavour == "sleap":
                file["tracks"] = values[None, ..., :2].transpose(0, 3, 2, 1)
                file["point_scores"] = values[None, ..., 2].transpose(0, 2, 1)
                file["node_names"] = [point.encode() for point in session[2]]
                continue
            columns = [("DLC", point, axis) for point in session[2] for axis in ("x", "y", "likelihood")]
            rows = values.reshape(len(values), -1)
            if flavour == "table":
                kind = [("index", "<i8"), ("values_block_0", "<f8", rows.shape[1:])]
                records = np.zeros(len(rows), dtype=kind)
                records["index"], records["values_block_0"] = np.arange(len(rows)), rows
                file["df_with_missing/table"] = records
                file["df_with_missing/table"].attrs["values_block_0_kind"] = np.bytes_(pickle.dumps(columns, 0))
            else:
                group = file.create_group("df_with_missing")
                group.attrs["axis0_nlevels"] = 3
                group["axis1"], group["block0_values"] = np.arange(len(rows)), rows
                for level in range(3):
                    texts = sorted({column[level] for column in columns})
                    group[f"axis0_level{level}"] = [text.encode() for text in texts]
                    group[f"axis0_label{level}"] = [texts.index(column[level]) for column in columns]
    assert claims(tmp_path) == ["sleap" if flavour == "sleap" else "deeplabcut-h5"]
    observations = read_session(tmp_path, given=Given(Stick("club_grip", "club_head", 1.0), image_size=(WIDTH, HEIGHT)))[0]
    np.testing.assert_array_equal(observations.keypoints.numpy(), session[0])
    assert list(observations.point_names or ()) == session[2]


def test_hdf5_without_h5py_says_what_to_install(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setitem(sys.modules, "h5py", None)
    monkeypatch.setattr("torchstickcal.io.deeplabcut.h5_can_be_read", lambda: False)
    for name in ("a", "b"):
        (tmp_path / f"{name}.h5").write_bytes(b"\x89HDF\r\n\x1a\n" + bytes(100))
    assert find_reader(tmp_path, KEYPOINT_READERS)
    with pytest.raises(FileFormatError, match=r"no package h5py; expected the package h5py.*pip install h5py"):
        read_recording(tmp_path)
