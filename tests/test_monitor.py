"""The content of the TensorBoard logs, of calibrations and of trainings."""

from __future__ import annotations

import doctest
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from tensorboard.plugins.hparams.plugin_data_pb2 import HParamsPluginData
from torch import Tensor

from torchstickcal import Calibration, CalibrationError, CalibrationLayer, Observations, TensorBoardMonitor, calibrate
from torchstickcal.cli import main
from torchstickcal.geometry import se3
from torchstickcal.metrics import pose_errors
from torchstickcal.show import tensorboard
from torchstickcal.show.pictures import keypoints_figure, residuals_figure
from torchstickcal.show.rig import rig_figure
from torchstickcal.show.scene import scene_mesh
from torchstickcal.simulate import Noise, golf_session, write_simulated
from torchstickcal.simulate.session import SessionSpec

OBSERVATIONS, TRUTH = golf_session(cameras=3, frames=8, noise=Noise(sigma_px=1.0))
OBSERVATIONS = replace(OBSERVATIONS, camera_names=("left", "right/far", "top"))


def read(folder: Path) -> EventAccumulator:
    log = EventAccumulator(str(folder), size_guidance={"tensors": 0, "images": 0, "scalars": 0, "histograms": 0})
    log.Reload()
    return log


@pytest.fixture(scope="module")
def logged(tmp_path_factory: pytest.TempPathFactory) -> tuple[Calibration, EventAccumulator]:
    folder = tmp_path_factory.mktemp("logs")
    calibration = calibrate(OBSERVATIONS, callback=TensorBoardMonitor(folder))
    return calibration, read(folder / "calibration_001")


def test_log_has_every_iteration_of_every_stage(logged: tuple[Calibration, EventAccumulator]):
    calibration, log = logged
    records = calibration.iterations
    stages = [number for number, stage in enumerate(calibration.stages, start=1) for _ in stage.iterations]
    centres = [se3.camera_centres(record.rotations, record.translations)[1].tolist() for record in records]
    for tag, values in {
        "solver/cost": [record.cost for record in records],
        "solver/damping": [record.damping for record in records],
        "solver/step [m]": [record.step_m for record in records],
        "solver/stage": stages,
        "reprojection [px]/top": [record.reprojection_px[2] for record in records],
        "stick/mean length [m]": [record.stick_length_m for record in records],
        "loss/reprojection": [record.terms["reprojection"] for record in records],
        "camera positions [m]/right_far x": [centre[0] for centre in centres],
        "camera positions [m]/right_far z": [centre[2] for centre in centres],
    }.items():
        events = log.Scalars(tag)
        assert [event.value for event in events] == pytest.approx(values, rel=1e-5, abs=1e-7), tag
        assert [event.step for event in events] == list(range(len(records)))
    for name in ("loss/stick_length", "loss/smoothness"):
        assert len(log.Scalars(name)) == sum(name.removeprefix("loss/") in record.terms for record in records)


def test_log_has_the_result(logged: tuple[Calibration, EventAccumulator]):
    calibration, log = logged
    tags = log.Tags()
    assert tags["images"] == ["rig", "residuals"]
    assert set(tags["histograms"]) == {
        *(f"residuals [px]/{name}" for name in ("left", "right_far", "top")),
        "stick/length in each frame [m]",
    }
    assert {"results/text_summary", "warnings/text_summary", "scene_VERTEX", "scene_FACE", "scene_COLOR"} <= set(
        tags["tensors"]
    )
    assert b"verdict: good" in log.Tensors("results/text_summary")[0].tensor_proto.string_val[0]
    assert b"right/far" in log.Tensors("results/text_summary")[0].tensor_proto.string_val[0]
    warnings = log.Tensors("warnings/text_summary")[0].tensor_proto.string_val[0].decode()
    assert warnings == f"converged\n\n- {calibration.warnings[0]}"
    (std,) = log.Scalars("standard deviation [m]/top")
    assert std.value == pytest.approx(float(calibration.camera_std_m[2]), rel=1e-5)
    plugin = log.summary_metadata["_hparams_/session_start_info"].plugin_data.content
    made_of = HParamsPluginData.FromString(plugin).session_start_info.hparams
    assert made_of["cameras"].number_value == 3
    assert "metric" in made_of["stages"].string_value
    (median,) = log.Scalars("final/reprojection, median [px]")
    assert median.value == pytest.approx(float(calibration.reprojection_median_px.median()), rel=1e-5)


def test_warnings_are_written(tmp_path: Path):
    calibrate(OBSERVATIONS, {"extends": "default", "stages": {"metric": {"max_iterations": 1}}}, TensorBoardMonitor(tmp_path))
    text = read(tmp_path / "calibration_001").Tensors("warnings/text_summary")[0].tensor_proto.string_val[0].decode()
    assert "metric: stopped at the limit of iterations" in text


def test_rotations_are_drawn_without_jumps():
    angles = np.linspace(2.9, 3.5, 20)  # beyond 180 degrees a rotation vector turns to the other side
    axis = torch.nn.functional.normalize(torch.tensor([1.0, 2.0, -1.0], dtype=torch.float64), dim=0)
    log = tensorboard._CalibrationLog(None, ["first", "turning"])  # pyright: ignore[reportArgumentType]
    found = []
    for angle in angles:
        tangents = torch.stack([torch.zeros(6).double(), torch.cat([torch.zeros(3).double(), angle * axis])])
        scalars = log._poses(*se3.exp(tangents))
        found.append([scalars[f"camera rotations [deg]/turning {name}"] for name in "xyz"])
    expected = np.degrees(angles[:, None] * axis.numpy())
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_no_tag_has_round_brackets_which_custom_scalars_do_not_draw(tmp_path: Path):
    named = replace(OBSERVATIONS, camera_names=tuple(f"camera (no. {number})" for number in range(len(OBSERVATIONS.keypoints))))
    calibrate(named, callback=TensorBoardMonitor(tmp_path, figures=False))
    tags = read(tmp_path / "calibration_001").Tags()
    for tag in (*tags["scalars"], *tags["histograms"]):
        assert not {"(", ")"} & set(tag), tag
    assert "reprojection [px]/camera [no. 1]" in tags["scalars"]


def test_runs_do_not_mix(tmp_path: Path):
    monitor = TensorBoardMonitor(tmp_path, figures=False)
    for callback in (monitor, monitor, TensorBoardMonitor(tmp_path, figures=False)):
        calibrate(OBSERVATIONS, callback=callback)
    runs = sorted(path.name for path in tmp_path.iterdir())
    assert runs == ["calibration_001", "calibration_002", "calibration_003"]
    logs = [read(tmp_path / run) for run in runs]
    costs = [[(event.step, event.value) for event in log.Scalars("solver/cost")] for log in logs]
    assert costs[0] == costs[1] == costs[2]
    assert not logs[0].Tags()["images"]
    assert all(len(list((tmp_path / run).iterdir())) == 1 for run in runs)


def test_the_command_line_writes_a_run_of_its_own(tmp_path: Path):
    session = tmp_path / "swing.npz"
    write_simulated(session, SessionSpec("swing", sport="golf", cameras=3, frames=8).generate())
    for _ in range(2):
        assert main(["calibrate", str(session), "--out", str(tmp_path / "out"), "--tensorboard", str(tmp_path / "logs")]) == 0
    assert sorted(path.name for path in (tmp_path / "logs").iterdir()) == ["calibration_001", "calibration_002"]
    assert "reprojection [px]/cam02" in read(tmp_path / "logs" / "calibration_001").Tags()["scalars"]


def test_an_iteration_is_one_entry_of_the_log():
    """Entries cost much more than numbers: one for each number would slow the solver down."""
    written: list[int] = []

    class Writer:
        file_writer = type("File", (), {"add_summary": staticmethod(lambda summary, step: written.append(step))})

    log = tensorboard._CalibrationLog(Writer(), OBSERVATIONS.camera_labels)  # pyright: ignore[reportArgumentType]
    records = calibrate(OBSERVATIONS).iterations
    for record in records:
        log.iteration(record)
    assert written == list(range(len(records)))


def layer_calls(monitor: TensorBoardMonitor, steps: range, **keywords: Any) -> tuple[Any, Tensor]:
    layer = CalibrationLayer(OBSERVATIONS.sticks)
    blind = torch.full_like(OBSERVATIONS.keypoints, torch.nan)
    keypoints = torch.stack([blind, OBSERVATIONS.keypoints, OBSERVATIONS.keypoints + 1.0]).requires_grad_()
    result = layer(keypoints, OBSERVATIONS.cameras)
    for step in steps:
        monitor.layer(step, result, truth=TRUTH, keypoints=keypoints, **keywords)
    return result, keypoints


def test_a_training_has_errors_shares_histograms_and_pictures(tmp_path: Path):
    confidence = torch.rand(3, 3, 8, 21)
    images = torch.randint(0, 255, (3, 3, 8, 3, 54, 96), dtype=torch.uint8)
    with TensorBoardMonitor(tmp_path, camera_names=OBSERVATIONS.camera_names) as monitor:
        result, _ = layer_calls(monitor, range(5), confidence=confidence, images=images, every=2)
        monitor.layer(0, result[1], truth=(TRUTH.rotations, TRUTH.translations), name="test")
        assert monitor.writer is not None
        monitor.writer.add_scalar("loss", 1.0, 0)
    log = read(tmp_path / "training_001")
    good = result.detach()[1:]
    errors = pose_errors(good.rotations, good.translations, TRUTH.rotations, TRUTH.translations)
    for tag, value in {
        "train/share of sessions calibrated": 2 / 3,
        "train/position error [m]": float(errors.translation_m.mean()),
        "train/rotation error [deg]": float(errors.rotation_deg.mean()),
        "train position error [m]/right_far": float(errors.translation_m[:, 1].mean()),
        "train/share of inliers": float(result.inliers[1:].sum() / OBSERVATIONS.keypoints.isfinite().all(-1).sum() / 2),
        "test/position error [m]": float(errors.translation_m[0].mean()),
        "test/share of sessions calibrated": 1.0,
    }.items():
        events = log.Scalars(tag)
        assert [event.step for event in events] == list(range(1 if tag.startswith("test") else 5))
        assert events[0].value == pytest.approx(value, rel=1e-5), tag
    assert [event.step for event in log.Histograms("train/confidence")] == [0, 2, 4]
    assert [event.step for event in log.Images("train/keypoints")] == [0, 2, 4]
    assert "train residuals [px]/top" in log.Tags()["histograms"]
    assert log.Scalars("loss")


def test_steps_do_not_collide(tmp_path: Path):
    monitor = TensorBoardMonitor(tmp_path, figures=False)
    layer_calls(monitor, range(2))
    with pytest.raises(CalibrationError, match=r"step of 'train'.*got 1; expected more than 1"):
        layer_calls(monitor, range(1, 2))
    layer_calls(monitor, range(1, 2), name="labels learnt")
    monitor.close()
    layer_calls(monitor, range(2))
    monitor.close()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["training_001", "training_002"]


def test_only_the_first_of_several_processes_writes(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    for rank, runs in ((1, []), (0, ["calibration_001", "training_001"])):
        monkeypatch.setattr("torch.distributed.is_initialized", lambda: True)
        monkeypatch.setattr("torch.distributed.get_rank", lambda rank=rank: rank)
        with TensorBoardMonitor(tmp_path, figures=False) as monitor:
            calibrate(OBSERVATIONS, callback=monitor)
            layer_calls(monitor, range(1))
            assert (monitor.writer is None) == bool(rank)
        assert sorted(path.name for path in tmp_path.iterdir()) == runs


@pytest.mark.parametrize(
    "wrong",
    [
        {"keypoints": OBSERVATIONS.keypoints},
        {"confidence": torch.ones(3, 8, 20)},
        {"images": torch.zeros(3, 8, 54, 96, 3)},
        {"images": torch.zeros(2, 3, 8, 3, 54, 96)},
    ],
    ids=["keypoints of one", "confidence", "channels last", "of other sessions"],
)
def test_what_does_not_fit_the_result_is_refused(tmp_path: Path, wrong: dict[str, Tensor]):
    with TensorBoardMonitor(tmp_path) as monitor:
        result, keypoints = layer_calls(monitor, range(0))
        with pytest.raises(CalibrationError, match=next(iter(wrong))):
            monitor.layer(0, result, **{"keypoints": keypoints, **wrong})


def test_a_batch_that_fails_is_logged(tmp_path: Path):
    blind = torch.full_like(OBSERVATIONS.keypoints, torch.nan)
    with TensorBoardMonitor(tmp_path) as monitor:
        monitor.layer(0, CalibrationLayer(OBSERVATIONS.sticks)(blind, OBSERVATIONS.cameras), truth=TRUTH, keypoints=blind)
    log = read(tmp_path / "training_001")
    assert log.Scalars("train/share of sessions calibrated")[0].value == 0.0
    assert log.Tags()["scalars"] == ["train/share of sessions calibrated"]


def with_gaps(observations: Observations) -> Observations:
    keypoints = observations.keypoints.clone()
    keypoints[:, 2:5] = torch.nan
    keypoints[:, :, 4] = torch.nan
    return replace(observations, keypoints=keypoints)


@pytest.mark.parametrize(
    "change", [lambda o: o, with_gaps, lambda o: replace(o, point_names=None)], ids=["whole", "with gaps", "without names"]
)
def test_figures_and_meshes_of_any_calibration(change: Callable[[Observations], Observations]):
    calibration = calibrate(change(OBSERVATIONS))
    for figure in (rig_figure(calibration), residuals_figure(calibration)):
        assert figure.axes[0].get_xlabel()
    labels = {text.get_text() for text in rig_figure(calibration).axes[0].texts}
    assert {" left", " top"} <= labels
    for frame in (0, 3):
        mesh = scene_mesh(calibration, frame)
        assert mesh.vertices.isfinite().all()
        assert len(mesh.colours) == len(mesh.vertices)
        assert int(mesh.faces.max()) < len(mesh.vertices)
        assert int(mesh.faces.min()) == 0


def test_a_picture_without_anything_seen():
    nothing = torch.full((2, 5, 2), torch.nan)
    for images in (None, torch.zeros(2, 1, 20, 30)):
        figure = keypoints_figure(nothing, nothing, torch.zeros(2, 5, dtype=torch.bool), ["a", "b"], images)
        assert [axes.get_title() for axes in figure.axes] == ["a", "b"]
        assert all(math.isfinite(limit) for axes in figure.axes for limit in (*axes.get_xlim(), *axes.get_ylim()))


def test_example_of_the_monitor_runs():
    assert doctest.testmod(tensorboard).failed == 0
