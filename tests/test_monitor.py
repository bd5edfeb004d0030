"""The content of the TensorBoard log."""

from __future__ import annotations

import doctest
from pathlib import Path

import pytest
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from torchstickcal import TensorBoardMonitor, calibrate
from torchstickcal.show import tensorboard


def test_log_has_every_iteration_of_every_stage(tmp_path: Path, noisy):
    calibration = calibrate(noisy[0], callback=TensorBoardMonitor(tmp_path))
    log = EventAccumulator(str(tmp_path))
    log.Reload()
    tags = log.Tags()
    for number, stage in enumerate(calibration.stages, start=1):
        prefix = f"{number} {stage.name}"
        for name, values in {
            "cost": [record.cost for record in stage.iterations],
            "damping": [record.damping for record in stage.iterations],
            "step_m": [record.step_m for record in stage.iterations],
            "reprojection_px/camera_2": [record.reprojection_px[2] for record in stage.iterations],
            "stick_length_m": [record.stick_length_m for record in stage.iterations],
            "loss/reprojection": [record.terms["reprojection"] for record in stage.iterations],
        }.items():
            assert [event.value for event in log.Scalars(f"{prefix}/{name}")] == pytest.approx(values, rel=1e-6)
    assert "2 metric/loss/stick_length" in tags["scalars"]
    assert "5 trajectories/loss/smoothness" in tags["scalars"]
    assert tags["images"] == ["rig"]
    assert tags["tensors"] == ["summary/text_summary"]


def test_example_of_the_monitor_runs():
    assert doctest.testmod(tensorboard).failed == 0
