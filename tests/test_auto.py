"""``auto`` estimates lenses and clocks that are wrong, and never harms where they are right."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from torchstickcal import Calibration, Observations, calibrate
from torchstickcal.io import read_session
from torchstickcal.pipeline import adjust
from torchstickcal.pipeline.check import CameraCheck
from torchstickcal.pipeline.selection import ModelSelection
from torchstickcal.simulate import Clocks, Noise, SessionSpec, golf_session
from torchstickcal.simulate.regimes import DetectorNoise, GaussianNoise
from torchstickcal.simulate.session import Assumptions

FPS = 30.0


@dataclass(frozen=True)
class Offsets(Clocks):
    """Given time offsets, in frames."""

    frames: tuple[float, ...] = ()

    def offsets(self, cameras: int, rng: np.random.Generator) -> NDArray[np.float64]:
        return np.array(self.frames) / FPS


def shaken(seed: int) -> Observations:
    """In each frame of each camera all keypoints are off by the same vector, as where an image is blurred or late."""
    observations, _ = golf_session(cameras=4, frames=48, noise=Noise(0.5), seed=seed)
    generator = torch.Generator().manual_seed(seed)
    shift = 3.0 * torch.randn(4, 48, 1, 2, generator=generator, dtype=torch.float64)
    return replace(observations, keypoints=observations.keypoints + shift, fps=FPS)


@pytest.mark.parametrize("seed", range(3))
def test_errors_that_points_have_in_common_refine_nothing(seed: int):
    assert calibrate(shaken(seed), refine="auto").refined == ()


@pytest.mark.parametrize(("wrong", "refined"), [(0.993, ()), (1.007, ()), (1.03, ("focal_shared",))])
def test_usual_errors_of_a_lens_are_left_alone(wrong: float, refined: tuple[str, ...]):
    spec = SessionSpec("lens", "hockey", 0, 4, frames=80, regimes=(GaussianNoise(0.5),))
    observations = replace(spec, assumptions=Assumptions(focal_scale=wrong)).generate().observations
    assert calibrate(observations, refine="auto").refined == refined


@pytest.mark.parametrize(
    ("sport", "frames"), [("golf", (0, 0.977, -0.2)), ("kendo", (0, 0.9, 0.85)), ("kendo", (0, 1.4, -1.2))]
)
def test_clocks_about_a_frame_off_are_found(sport: str, frames: tuple[float, ...]):
    spec = SessionSpec(
        "clocks", sport, 1, 3, 100, FPS, regimes=(DetectorNoise(2.0, 1.0),), clocks=Offsets(1 / FPS, frames=frames)
    )
    session = spec.generate()
    found = calibrate(session.observations, refine="auto")
    assert session.truth.time_offsets_s is not None
    assert "time_offset" in found.refined
    assert (found.time_offsets - session.truth.time_offsets_s).abs().max() * FPS < 0.1


@pytest.mark.parametrize("cameras", [[0, 1, 2], [0, 1, 3], [0, 1, 2, 3]])
def test_a_recorded_board_whose_parts_disagree_about_the_clocks_is_left_as_it_is(data: Path, cameras: list[int]):
    """With time offsets of 0.4 frames its keypoints fit better, but not with the same offsets in all parts of the recording."""
    observations, _ = read_session(data / "real" / "caliscope_post_optimization.npz")
    observations = observations.of_cameras(cameras)
    same(calibrate(observations), calibrate(observations, refine="auto"))


@pytest.mark.parametrize("cameras", [[0, 1, 3], [1, 2, 3]])
def test_a_camera_with_poor_keypoints_costs_no_second_start(data: Path, cameras: list[int], monkeypatch: pytest.MonkeyPatch):
    """It fits a little better at some of many time offsets. The cameras were in step."""
    starts = calls_of(adjust, "initialise", monkeypatch)
    observations, _ = read_session(data / "real" / "caliscope_board_and_person.npz")
    found = calibrate(observations.of_cameras(cameras), refine="auto")
    assert found.refined == ()
    assert len(starts) == 1


def test_trials_are_few_and_leave_nothing_behind(monkeypatch: pytest.MonkeyPatch):
    """A trial that is not confirmed changes nothing; where the given cameras do not converge there is none."""
    trials = calls_of(ModelSelection, "_with", monkeypatch)
    monkeypatch.setattr(CameraCheck, "confirms", lambda *arguments: False)
    spec = SessionSpec(
        "lens", "hockey", 0, 4, frames=40, regimes=(GaussianNoise(0.5),), assumptions=Assumptions(focal_scale=1.05)
    )
    observations = spec.generate().observations
    plain, auto = (calibrate(observations, refine=refine) for refine in (None, "auto"))
    assert 1 <= len(trials) <= 3
    same(plain, auto)
    trials.clear()
    unfinished = {"extends": "default", "stages": {"refined": {"max_iterations": 1}}}
    assert not calibrate(observations, unfinished, refine="auto").converged
    assert not trials


def calls_of(owner: object, name: str, monkeypatch: pytest.MonkeyPatch) -> list[tuple[object, ...]]:
    """The arguments of every call of a function from now on."""
    calls: list[tuple[object, ...]] = []
    function = getattr(owner, name)

    def noted(*arguments: object) -> object:
        calls.append(arguments)
        return function(*arguments)

    monkeypatch.setattr(owner, name, noted)
    return calls


def same(first: Calibration, second: Calibration) -> None:
    assert first.refined == second.refined
    assert torch.equal(first.translations, second.translations)
    assert torch.equal(first.covariance, second.covariance)
