"""Calibrations of other programs: one rig, written by the test as each program writes it, is read as the same rig."""

from __future__ import annotations

import json
import pickle
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch

from torchstickcal import CalibrationError, FileFormatError, Stick
from torchstickcal.cli import main
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.io import (
    CALIBRATION_READERS,
    KEYPOINT_READERS,
    SESSION_READERS,
    Given,
    Rig,
    RigCamera,
    read_calibration,
    read_session,
    write_npz,
)
from torchstickcal.io.formats import head_of
from torchstickcal.io.given import amended
from torchstickcal.io.lenses import arranged, lenses_of
from torchstickcal.simulate import golf_session

NAMES = ("cam2", "cam9", "cam10")
SIZE = (1280, 720)
MATRICES = [np.array([[900.0 + n, 0, 640.5 + n], [0, 905 + n, 350 - n], [0, 0, 1]]) for n in range(3)]
LENSES = [np.array([-0.1, 0.05, 0.001, -0.002, 0.01 * n]) for n in range(3)]
VECTORS = [np.array([0.0, 0, 0]), np.array([0.3, -0.5, 0.1]), np.array([-0.2, 1.4, 0.4])]
ROTATIONS = [cv2.Rodrigues(vector)[0] for vector in VECTORS]
TRANSLATIONS = [np.array([0.0, 0, 0]), np.array([0.5, -0.1, 3.0]), np.array([-1.5, 0.2, 4.0])]
Writer = Callable[[Path], None]


def rig(fisheye: bool = False, names: tuple[str, ...] = NAMES) -> Rig:
    lenses = [np.array([0.02, -0.01, 0.003, 0.001 * n]) for n in range(3)] if fisheye else LENSES
    cameras = zip(names, MATRICES, lenses, ROTATIONS, TRANSLATIONS, strict=True)
    return Rig.of([RigCamera(name, matrix, lens, fisheye, SIZE, r, t) for name, matrix, lens, r, t in cameras])


def put(path: Path, text: object) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text if isinstance(text, str) else json.dumps(text))


def opencv_matrix(matrix: np.ndarray) -> str:
    matrix = np.atleast_2d(matrix)
    return (
        f"!!opencv-matrix\n   rows: {len(matrix)}\n   cols: {matrix.shape[1]}\n   dt: d\n   data: {matrix.ravel().tolist()}\n"
    )


def toml(keys: tuple[str, ...], unit: float, coefficients: int, more: str = "") -> Writer:
    def write(folder: Path) -> None:
        text = ""
        for key, name, matrix, lens, vector, t in zip(keys, NAMES, MATRICES, LENSES, VECTORS, TRANSLATIONS, strict=True):
            text += f'[{key}]\nname = "{name}"\nsize = [ 1280.0, 720.0]\nmatrix = {matrix.tolist()}\n'
            text += f"distortions = {lens[:coefficients].tolist()}\nrotation = {vector.tolist()}\n"
            text += f"translation = {(t / unit).tolist()}\n{more}\n"
        put(folder / "calibration.toml", text + "[metadata]\nadjusted = false\nerror = 0.0\n")

    return write


def caliscope(matrices: bool) -> Writer:
    def write(folder: Path) -> None:
        text = ""
        for name, matrix, lens, vector, t in zip(NAMES, MATRICES, LENSES, VECTORS, TRANSLATIONS, strict=True):
            rotation = cv2.Rodrigues(vector)[0] if matrices else vector
            text += f"[cameras.{name[3:]}]\ncam_id = {name[3:]}\nsize = [1280, 720]\nrotation_count = 0\n"
            text += f"matrix = {matrix.tolist()}\ndistortions = {lens.tolist()}\nrotation = {rotation.tolist()}\n"
            text += f"translation = {t.tolist()}\nfisheye = false\n\n"
        put(folder / "camera_array.toml", text)

    return write


def opencv(suffix: str) -> Writer:
    def write(folder: Path) -> None:
        for name, matrix, lens, rotation, t in zip(NAMES, MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True):
            storage = cv2.FileStorage(str(folder / f"{name}{suffix}"), cv2.FILE_STORAGE_WRITE)
            storage.write("image_width", SIZE[0])
            storage.write("image_height", SIZE[1])
            for key, value in (("camera_matrix", matrix), ("distortion_coefficients", lens), ("R", rotation), ("T", t)):
                storage.write(key, value)
            storage.release()

    return write


def easymocap(vectors: bool) -> Writer:
    def write(folder: Path) -> None:
        intri, extri = ("%YAML:1.0\n---\nnames:\n" + "".join(f'  - "{name}"\n' for name in NAMES) for _ in range(2))
        for name, matrix, lens, rotation, t in zip(NAMES, MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True):
            intri += f"K_{name}: {opencv_matrix(matrix)}dist_{name}: {opencv_matrix(lens)}H_{name}: 720\nW_{name}: 1280\n"
            vector = cv2.Rodrigues(rotation)[0]
            extri += f"R_{name}: {opencv_matrix(vector)}" + ("" if vectors else f"Rot_{name}: {opencv_matrix(rotation)}")
            extri += f"T_{name}: {opencv_matrix(t.reshape(3, 1))}"
        put(folder / "intri.yml", intri.replace("\n", "\r\n"))
        put(folder / "extri.yml", extri)

    return write


def opencap(folder: Path) -> None:
    for name, matrix, lens, rotation, t in zip(NAMES, MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True):
        content = {
            "distortion": lens[None],
            "intrinsicMat": matrix,
            "imageSize": np.array([[720.0], [1280.0]]),
            "rotation": rotation,
            "translation": 1000 * t.reshape(3, 1),
            "rotation_EulerAngles": cv2.Rodrigues(rotation)[0],
        }
        path = folder / "Videos" / name / "cameraIntrinsicsExtrinsics.pickle"
        path.parent.mkdir(parents=True)
        path.write_bytes(pickle.dumps(content))


def mc_calib(folder: Path) -> None:
    text = "%YAML:1.0\n---\nnb_camera: 3\n"
    for n, (matrix, lens, rotation, t) in enumerate(zip(MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, t
        values = (("camera_matrix", matrix), ("distortion_vector", lens), ("camera_pose_matrix", np.linalg.inv(pose)))
        block = "".join(f"{key}: {opencv_matrix(value)}" for key, value in values)
        block += "distortion_type: 0\ncamera_group: 0\nimg_width: 1280\nimg_height: 720\n"
        text += f"camera_{n}:\n" + "".join(f"   {line}\n" for line in block.splitlines())
    put(folder / "calibrated_cameras_data.yml", text)


def multical(folder: Path) -> None:
    cameras, poses = {}, {}
    for name, matrix, lens, rotation, t in zip(NAMES, MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True):
        cameras[name] = {"model": "standard", "image_size": SIZE, "K": matrix.tolist(), "dist": [lens.tolist()]}
        poses[name if name == NAMES[0] else f"{name}_to_{NAMES[0]}"] = {"R": rotation.tolist(), "T": t.tolist()}
    put(folder / "calibration.json", {"cameras": cameras, "camera_poses": poses, "image_sets": {}})


def kalibr(folder: Path) -> None:
    text, before = "", np.eye(4)
    for n, (matrix, lens, rotation, t) in enumerate(zip(MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True)):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, t
        step = pose @ np.linalg.inv(before)
        chain = "  T_cn_cnm1:\n" + "".join(f"  - {row.tolist()}\n" for row in step) if n else ""
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        text += f"cam{n}:\n{chain}  cam_overlaps: [1]\n  camera_model: pinhole\n  distortion_coeffs: {lens[:4].tolist()}\n"
        text += f"  distortion_model: radtan\n  intrinsics: {[fx, fy, cx, cy]}\n  resolution: [1280, 720]\n  rostopic: /c\n"
        before = pose
    put(folder / "camchain.yaml", text)


def colmap(folder: Path) -> None:
    cameras, images = "# Camera list\n", "# Image list\n"
    for n, (name, matrix, lens, vector, t) in enumerate(zip(NAMES, MATRICES, LENSES, VECTORS, TRANSLATIONS, strict=True), 1):
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        cameras += f"{n} FULL_OPENCV 1280 720 {fx} {fy} {cx + 0.5} {cy + 0.5} {' '.join(map(str, lens.tolist()))} 0 0 0\n"
        angle = np.linalg.norm(vector)
        axis = vector / angle if angle else vector
        quaternion = [np.cos(angle / 2), *(np.sin(angle / 2) * axis)]
        points = "1.0 2.0 -1" if n == 1 else ""
        images += f"{n} {' '.join(map(str, quaternion))} {' '.join(map(str, t.tolist()))} {n} {name}/0001.png\n{points}\n"
    put(folder / "sparse" / "0" / "cameras.txt", cameras)
    put(folder / "sparse" / "0" / "images.txt", images)


def nerfstudio(folder: Path) -> None:
    frames = []
    for name, matrix, lens, rotation, t in zip(NAMES, MATRICES, LENSES, ROTATIONS, TRANSLATIONS, strict=True):
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = rotation, t
        pose = np.linalg.inv(pose) @ np.diag([1, -1, -1, 1])
        (fx, _, cx), (_, fy, cy), _ = matrix.tolist()
        frame = {"file_path": f"images/{name}.png", "fl_x": fx, "fl_y": fy, "cx": cx + 0.5, "cy": cy + 0.5, "w": 1280, "h": 720}
        frames.append(
            frame | dict(zip(("k1", "k2", "p1", "p2", "k3"), lens.tolist(), strict=True)) | {"transform_matrix": pose.tolist()}
        )
    put(folder / "transforms.json", {"camera_model": "OPENCV", "frames": frames})


KEYS = ("cam_2", "cam_9", "cam_10")
WRITERS: dict[str, tuple[str, Writer, str | None, tuple[str, ...]]] = {
    "Pose2Sim": ("pose2sim", toml(NAMES, 1, 4, "fisheye = false"), "m", NAMES),
    "aniposelib": ("pose2sim", toml(KEYS, 0.001, 5), None, NAMES),
    "FreeMoCap": ("pose2sim", toml(NAMES, 0.001, 5, "world_position = [0, 0, 0]"), "mm", NAMES),
    "Caliscope": ("caliscope", caliscope(False), "m", KEYS),
    "Caliscope with matrices": ("caliscope", caliscope(True), "m", KEYS),
    "OpenCV yaml": ("opencv", opencv(".yml"), None, NAMES),
    "OpenCV xml": ("opencv", opencv(".xml"), None, NAMES),
    "OpenCV json": ("opencv", opencv(".json"), None, NAMES),
    "EasyMocap": ("easymocap", easymocap(False), "m", NAMES),
    "EasyMocap vectors": ("easymocap", easymocap(True), "m", NAMES),
    "OpenCap": ("opencap", opencap, "mm", NAMES),
    "MC-Calib": ("mc-calib", mc_calib, None, ("camera_0", "camera_1", "camera_2")),
    "multical": ("multical", multical, None, NAMES),
    "Kalibr": ("kalibr", kalibr, "m", ("cam0", "cam1", "cam2")),
    "COLMAP": ("colmap", colmap, None, NAMES),
    "nerfstudio": ("nerfstudio", nerfstudio, None, NAMES),
}  # fmt: skip
"""For each program: the format, the function that writes it, the unit that is known of it, and the names of the cameras."""
FOUR_COEFFICIENTS = {"Pose2Sim", "Kalibr"}


def only_file(folder: Path) -> Path:
    entries = list(folder.iterdir())
    return entries[0] if len(entries) == 1 and entries[0].is_file() else folder


@pytest.mark.parametrize("what", WRITERS)
def test_every_format_gives_the_same_rig(what: str, tmp_path: Path):
    name, write, unit, names = WRITERS[what]
    write(tmp_path)
    path = only_file(tmp_path)
    registries = (SESSION_READERS, KEYPOINT_READERS, CALIBRATION_READERS)
    claims = [other for registry in registries for other, reader in registry.items() if reader.takes(path, head_of(path))]
    assert claims == [name]
    found, expected = read_calibration(path), rig()
    assert found.names == names or set(found.names) == set(names)
    order = [found.names.index(one) for one in names]
    assert found.unit == unit
    torch.testing.assert_close(found.intrinsics[order], expected.intrinsics)
    assert found.image_size is not None
    assert found.image_size[order].tolist() == [list(SIZE)] * 3
    for index, lens in zip(order, LENSES, strict=True):
        count = 4 if what in FOUR_COEFFICIENTS else 5
        np.testing.assert_allclose(found.distortion[index][:5].numpy(), lens[:count], atol=1e-12)
        assert not found.distortion[index][5:].any()
    rotations, translations = found.poses("mm" if what == "aniposelib" else "m" if unit is None else None)
    np.testing.assert_allclose(rotations[order].numpy(), ROTATIONS, atol=1e-9)
    np.testing.assert_allclose(translations[order].numpy(), TRANSLATIONS, atol=1e-9)


@pytest.mark.parametrize("what", WRITERS)
def test_damaged_files_are_one_error_of_our_own(what: str, tmp_path: Path):
    name, write, *_ = WRITERS[what]
    rng = np.random.default_rng(len(what))
    (tmp_path / "whole").mkdir()
    write(tmp_path / "whole")
    files = sorted(path for path in (tmp_path / "whole").rglob("*") if path.is_file())
    for trial in range(20):
        folder = tmp_path / "damaged"
        shutil.copytree(tmp_path / "whole", folder)
        path = folder / files[int(rng.integers(len(files)))].relative_to(tmp_path / "whole")
        content = path.read_bytes()
        at = int(rng.integers(len(content)))
        damages = [
            content[:at],
            content[:at] + b"\x00\xff{[\n" + content[at:],
            b"null",
            content.replace(b"900", b"nan").replace(b"905", b'"a"'),
            content.replace(b"1280", b"-1").replace(b"rotation", b"rotatoin"),
        ]
        path.write_bytes(damages[trial % len(damages)])
        with suppress(CalibrationError, FileNotFoundError):
            CALIBRATION_READERS[name].read(only_file(folder))
        shutil.rmtree(folder)


def test_units_are_never_guessed(tmp_path: Path, capsys: pytest.CaptureFixture[str]):
    toml(KEYS, 0.001, 5)(tmp_path)
    toml(NAMES, 1, 4, "fisheye = false")(tmp_path / "metres")
    files = [str(tmp_path / "calibration.toml"), str(tmp_path / "metres" / "calibration.toml")]
    assert main(["evaluate", *files]) == 2
    assert "the unit of length is not known" in capsys.readouterr().err
    assert main(["evaluate", *files, "--units", "mm"]) == 0
    assert "0.000" in capsys.readouterr().out.splitlines()[-1]
    unknown, metres = map(read_calibration, files)
    assert unknown.unit is None
    with pytest.raises(CalibrationError, match=r"another unit of length .*got mm; expected m, as in the file"):
        metres.poses("mm")


def test_intrinsics_alone(tmp_path: Path):
    easymocap(False)(tmp_path)
    (tmp_path / "extri.yml").unlink()
    found = read_calibration(tmp_path / "intri.yml")
    assert found.rotations is None
    with pytest.raises(CalibrationError, match="a calibration without poses"):
        found.poses()


def test_names_with_leading_zeros_and_numbers_without_points(tmp_path: Path):
    """As programs write them, and as YAML misunderstands them."""
    matrix = "{rows: 3, cols: 3, dt: d, data: [1e3, 0, 640, 0, 1.e+3, 360, 0, 0, 1]}"
    text = f"%YAML:1.0\nnames:\n  - 01\n  - 02\nK_01: {matrix}\ndist_01: [1e-3, 0, 0, 0]\nK_02: {matrix}\n"
    put(tmp_path / "intri.yml", text)
    found = read_calibration(tmp_path / "intri.yml", "easymocap")
    assert found.names == ("01", "02")
    assert found.intrinsics[1, 0, 0] == found.intrinsics[1, 1, 1] == 1000
    assert [len(lens) for lens in found.distortion] == [4, 0]
    assert found.image_size is None or bool(found.image_size.isnan().all())


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("K_1: &a [1, 2]\ndist_1: *a\n", "an alias"),
        ("K_1: !!python/object/apply:os.system ['true']\n", "could not determine a constructor"),
        ("K_1: [1, 2]\n" + "#" * 2**20, "more than 1048576 bytes"),
        ("K_1: {rows: 100000, cols: 100000, data: [1]}\n", "cannot reshape"),
        ("K_1: [a, b]\n", "could not convert"),
    ],
)
def test_yaml_that_would_do_more_than_it_says(content: str, message: str, tmp_path: Path):
    put(tmp_path / "intri.yml", content)
    with pytest.raises(FileFormatError, match=message):
        read_calibration(tmp_path / "intri.yml")


def test_xml_with_entities(tmp_path: Path):
    put(tmp_path / "a.qca.txt", '<!DOCTYPE c [<!ENTITY a "aa">]><calibration><camera serial="&a;"/></calibration>')
    with pytest.raises(FileFormatError, match="a document type"):
        read_calibration(tmp_path / "a.qca.txt")


def test_the_real_files(data: Path):
    ewand = read_calibration(data / "formats" / "opencv_filestorage_ewand.yaml")
    assert ewand.names == ("cam0",)
    assert ewand.intrinsics[0, 0, 0] == 1255.38250702563
    assert ewand.distortion[0].tolist() == [-0.2228823, 0.2432134, -0.0002509402, 0.00124672, -0.2092471]
    array = read_calibration(data / "formats" / "caliscope_camera_array.toml")
    assert array.names[:2] == ("cam_0", "cam_1")
    assert array.rotations is not None
    qualisys = read_calibration(data / "formats" / "qualisys_calib.qca.txt")
    _, truth = read_session(data / "real" / "pose2sim_video_mediapipe.npz")
    observations, _ = read_session(data / "real" / "pose2sim_video_mediapipe.npz")
    assert truth is not None
    rotations, translations = qualisys.poses()
    torch.testing.assert_close(rotations, truth.rotations, atol=1e-6, rtol=0)
    torch.testing.assert_close(translations, truth.translations, atol=1e-6, rtol=0)
    torch.testing.assert_close(qualisys.intrinsics, observations.intrinsics.double(), atol=1e-3, rtol=0)
    assert observations.distortion is not None
    torch.testing.assert_close(torch.stack(qualisys.distortion), observations.distortion.double(), atol=1e-9, rtol=0)


@pytest.mark.parametrize(
    ("names", "labels", "order", "by"),
    [
        (("b", "a", "c"), ("a", "b", "c"), [1, 0, 2], None),
        (("cam_10", "cam_2", "cam_9"), ("view2", "view9", "view10"), [1, 2, 0], "the numbers in their names"),
        (("cam10", "cam2", "cam1"), ("x3", "x4", "x5"), [2, 1, 0], "their order"),
        (("left", "top", "right"), ("a", "b", "c"), [0, 1, 2], "their order"),
        (("cam1", "cam2", "cam3"), ("cam3", "cam1"), [2, 0], None),
        (("c1", "c2", "c3"), ("cam3", "cam1"), [2, 0], "the numbers in their names"),
    ],
)
def test_cameras_are_matched_by_name_or_number_or_order(
    names: tuple[str, ...], labels: tuple[str, ...], order: list[int], by: str | None
):
    lenses, notes = lenses_of(rig(names=names), labels, None)
    assert lenses.intrinsics is not None
    assert lenses.intrinsics.equal(rig().intrinsics[order])
    assert (by is None) == (not notes)
    assert by is None or f"matched by {by}: {labels[0]} = {names[order[0]]}" in notes[0]
    with pytest.raises(FileFormatError, match="others than those of the recording"):
        lenses_of(rig(names=names), ("p", "q"), None)


def test_other_image_sizes_are_put_right_or_refused():
    def sizes(*size: float) -> torch.Tensor:
        return torch.tensor(size, dtype=torch.float64).expand(3, 2)

    halved, notes = lenses_of(rig(), NAMES, sizes(640, 360))
    assert halved.intrinsics is not None
    assert "0.5 times" in notes[0]
    point = np.array([[0.1, -0.2, 1.0]])
    whole, _ = lenses_of(rig(), NAMES, None)
    assert whole.intrinsics is not None
    pixel, half = ((point @ lenses.intrinsics[1].numpy().T)[0, :2] for lenses in (whole, halved))
    np.testing.assert_allclose(half + 0.5, (pixel + 0.5) / 2)
    assert lenses_of(rig(), NAMES, sizes(1288, 720))[0].intrinsics.equal(whole.intrinsics)
    with pytest.raises(FileFormatError, match=r"images were turned.*720 x 1280.*Turn the images back"):
        lenses_of(rig(), NAMES, sizes(720, 1280))
    with pytest.raises(FileFormatError, match=r"another shape.*Were they cut"):
        lenses_of(rig(), NAMES, sizes(720, 720))


def test_lenses_of_both_models_are_not_mixed():
    fisheye, plain = rig(True), rig()
    assert lenses_of(fisheye, NAMES, None)[0].fisheye
    mixed = Rig(NAMES, plain.intrinsics, (fisheye.distortion[0], *plain.distortion[1:]), (True, False, False), plain.image_size)
    with pytest.raises(CalibrationError, match="lenses of both models in one rig"):
        lenses_of(mixed, NAMES, None)


def test_coefficients_of_different_numbers_are_padded():
    lenses = Rig(NAMES, rig().intrinsics, ([0.1, 0, 0, 0], [0.1, 0, 0, 0, 0, 0, 0, 0], []), (False,) * 3)
    found, _ = lenses_of(lenses, NAMES, None)
    assert found.distortion is not None
    assert found.distortion[:, 0].tolist() == [0.1, 0.1, 0.0]
    assert found.distortion.shape == (3, 8)


@pytest.mark.parametrize("what", ["Pose2Sim", "OpenCV yaml", "OpenCap", "Kalibr"])
def test_a_session_takes_the_intrinsics_of_a_file(what: str, tmp_path: Path):
    observations, truth = golf_session(cameras=3, frames=6)
    (tmp_path / "cameras").mkdir()
    WRITERS[what][1](tmp_path / "cameras")
    write_npz(tmp_path / "a.npz", observations, truth)
    given = Given(Stick("club_grip", "club_head", 1.0), only_file(tmp_path / "cameras"), image_size=SIZE)
    told, _ = read_session(tmp_path / "a.npz", given=given)
    assert told.intrinsics_known
    torch.testing.assert_close(told.intrinsics, rig().intrinsics)
    assert told.distortion is not None


@pytest.mark.parametrize("turned", ["left", "right", "back"])
@pytest.mark.parametrize(("fisheye", "coefficients"), [(False, 5), (False, 12), (True, 4)])
def test_turned_images_are_put_right(turned: str, fisheye: bool, coefficients: int):
    """The turned camera projects to where the pixels of the turned image are, with every part of its lens."""
    width, height = SIZE
    lens = np.random.default_rng(coefficients).normal(0, 0.01, coefficients)
    given = Rig.of([RigCamera("cam2", MATRICES[0], lens, fisheye, SIZE, VECTORS[1], TRANSLATIONS[1])])
    points = torch.from_numpy(np.random.default_rng(1).normal(0, 0.4, (20, 3)))

    def seen(camera: Rig) -> torch.Tensor:
        cameras = Intrinsics(camera.intrinsics, torch.stack(list(camera.distortion)), fisheye)
        return cameras.project((points @ camera.rotations[0].mT + camera.translations[0])[None])[0]

    x, y = seen(given).unbind(-1)
    expected = {"right": (height - 1 - y, x), "left": (y, width - 1 - x), "back": (width - 1 - x, height - 1 - y)}[turned]
    found, notes = arranged(given, ["cam2"], None, turned)
    assert (seen(found) - torch.stack(expected, dim=-1)).abs().max() < 1e-9
    assert found.image_size.tolist() == [[width, height] if turned == "back" else [height, width]]
    assert "were turned" in notes[0]
    size = torch.tensor([[1920.0, 1080.0] if turned == "back" else [1080.0, 1920.0]])
    larger, _ = arranged(given, ["cam2"], size, turned)
    assert (larger.intrinsics[0, 0, 0] / found.intrinsics[0, 0, 0] - 1.5).abs() < 1e-9


def test_images_that_cannot_be_turned_are_refused():
    unknown = Rig.of([RigCamera("cam2", MATRICES[0], (), False, None)])
    with pytest.raises(CalibrationError, match="cannot be turned without their size"):
        arranged(unknown, ["cam2"], None, "left")
    tilted = Rig.of([RigCamera("cam2", MATRICES[0], [0.0] * 12 + [0.1, 0.2], False, SIZE)])
    with pytest.raises(CalibrationError, match="a tilted sensor"):
        arranged(tilted, ["cam2"], None, "left")
    with pytest.raises(CalibrationError, match=r"no such turn.*'up'.*left, right, back"):
        arranged(rig(), NAMES, None, "up")
    with pytest.raises(CalibrationError, match="nothing to turn"):
        amended(golf_session(cameras=3, frames=5)[0], Given(turned="left"))
