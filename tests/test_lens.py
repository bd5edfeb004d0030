"""Lenses that were given wrong, or not at all."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from torchstickcal import Calibration, CalibrationLayer, Observations, calibrate
from torchstickcal.benchmark.bound import camera_bound
from torchstickcal.benchmark.cases import Case
from torchstickcal.errors import ConfigError, ObservationError
from torchstickcal.metrics import pose_errors
from torchstickcal.model.unknowns import with_refinements
from torchstickcal.simulate import Lens, SessionSpec, SimulatedSession
from torchstickcal.simulate.regimes import GaussianNoise
from torchstickcal.simulate.session import Assumptions

BARREL = Lens(distortion=(-0.2, 0.0, 0.0, 0.0, 0.0))


def session(
    seed: int = 0, cameras: int = 4, sigma_px: float = 0.5, lens: Lens | None = None, **assumed: float
) -> SimulatedSession:
    spec = SessionSpec("lens", "hockey", seed, cameras, frames=120, lens=lens or Lens(), regimes=(GaussianNoise(sigma_px),))
    return dataclasses.replace(spec, assumptions=Assumptions(**assumed)).generate()  # pyright: ignore[reportArgumentType]


def error_mm(found: Calibration, seen: SimulatedSession) -> float:
    truth = seen.truth
    return 1000 * pose_errors(found.rotations, found.translations, truth.rotations, truth.translations).mean_translation_m


@pytest.mark.parametrize("scale", [0.9, 1.03])
def test_wrong_focal_length_is_found_exactly_without_noise(scale: float):
    seen = session(sigma_px=0.0, focal_scale=scale)
    found = calibrate(seen.observations, refine=["focal"])
    assert found.converged
    assert seen.truth.intrinsics is not None
    torch.testing.assert_close(found.intrinsics[:, 0, 0], seen.truth.intrinsics[:, 0, 0], rtol=1e-6, atol=0)
    assert error_mm(found, seen) < 0.01


def test_distortion_is_found_exactly_without_noise():
    seen = session(sigma_px=0.0, lens=BARREL, lens_known=False)
    found = calibrate(seen.observations, refine=["radial"])
    assert found.distortion is not None
    torch.testing.assert_close(found.distortion[:, 0], torch.full((4,), -0.2, dtype=torch.float64), rtol=1e-4, atol=0)
    assert error_mm(found, seen) < 0.01


@pytest.mark.parametrize(
    ("assumed", "lens", "refined"),
    [
        ({}, None, ()),
        ({"focal_scale": 1.03}, None, ("focal_shared",)),
        ({"focal_spread": 0.03}, None, ("focal",)),
        ({"lens_known": False}, BARREL, ("radial",)),
        ({"centre_px": 25.0}, None, ("principal_point",)),
    ],
    ids=["nothing", "shared focal", "own focal", "k1", "principal point"],
)
def test_auto_refines_what_is_wrong(assumed: dict[str, float], lens: Lens | None, refined: tuple[str, ...]):
    seen = session(lens=lens, **assumed)
    found = calibrate(seen.observations, refine="auto")
    assert found.refined == refined
    case = Case(seen.name, seen.observations, seen.truth, seen.inliers, seen.sigma_px)
    bound = camera_bound(case, unknown=refined)
    assert bound is not None
    assert error_mm(found, seen) < 2000 * bound.translation_m


def test_nothing_refined_costs_nothing():
    seen = session()
    plain, auto = calibrate(seen.observations), calibrate(seen.observations, refine="auto")
    torch.testing.assert_close(plain.translations, auto.translations, rtol=0, atol=0)
    assert not [warning for warning in plain.warnings if "focal" in warning]


def test_wrong_focal_length_is_told_where_it_is_not_refined():
    found = calibrate(session(focal_scale=1.03).observations)
    assert found.refined == ()
    focal = found.unknowns["focal"]
    assert not focal.refined
    assert focal.std.isnan().all()
    assert torch.equal(focal.value, focal.given)
    assert ((focal.suggested / focal.given - 1 / 1.03).abs() < 5e-3).all()
    assert sum("focal length" in warning and "was given and used" in warning for warning in found.warnings) == 4


def test_stated_deviation_is_the_scatter():
    squared: list[float] = []
    for seed in range(12):
        seen = session(seed, focal_scale=0.97)
        found = calibrate(seen.observations, refine=["focal"])
        assert seen.truth.intrinsics is not None
        off = found.intrinsics[:, 0, 0] - seen.truth.intrinsics[:, 0, 0]
        squared += (off / found.unknowns["focal"].std).square().tolist()
    assert 0.5 < np.mean(squared) < 1.6


def test_no_intrinsics_at_all():
    seen = session(lens=Lens(focal_px=1300.0))
    given = seen.observations
    found = calibrate(Observations(given.keypoints, None, given.sticks, image_size=given.image_size))
    assert found.refined == ("focal_shared",)
    assert float(found.intrinsics[0, 0, 0]) == pytest.approx(1300, rel=0.01)
    assert error_mm(found, seen) < 15
    with pytest.raises(ObservationError, match="neither intrinsics nor image size"):
        Observations(given.keypoints, None, given.sticks)


def test_camera_groups_share():
    seen = session(focal_scale=1.02)
    config = {"extends": "default", "camera_groups": ["a", "b", "a", "b"]}
    focal = calibrate(seen.observations, config, refine=["focal_shared"]).intrinsics[:, 0, 0]
    assert float(focal[0]) == float(focal[2]) != float(focal[1]) == float(focal[3])
    with pytest.raises(ConfigError, match="camera groups do not fit"):
        calibrate(seen.observations, config | {"camera_groups": ["a"]}, refine=["focal_shared"])


def test_what_the_data_do_not_tell_stays_and_is_named():
    seen = session(cameras=2, sigma_px=2.0)
    few = dataclasses.replace(seen.observations, keypoints=seen.observations.keypoints[:, :12])
    found = calibrate(few, refine=["radial"])
    assert any("k2 stays near the given value" in warning for warning in found.warnings)


def test_unknown_refinement_is_refused():
    with pytest.raises(ConfigError, match="unusable value"):
        calibrate(session().observations, refine=["focus"])  # pyright: ignore[reportArgumentType]
    assert with_refinements(("focal_shared",), ("focal", "radial")) == ("focal", "radial")


def test_layer_finds_what_calibrate_finds():
    seen = session(focal_scale=1.03).observations
    config = {"extends": "default", "refine": ["focal"]}
    layer, found = CalibrationLayer(seen.sticks, config), calibrate(seen, config)
    torch.testing.assert_close(layer(seen.keypoints, seen.cameras).intrinsics, found.intrinsics, rtol=1e-4, atol=0)


def test_saved_and_loaded(tmp_path):
    found = calibrate(session(focal_scale=1.03).observations, refine="auto")
    found.save(tmp_path / "c.npz")
    again = Calibration.load(tmp_path / "c.npz")
    assert again.refined == found.refined
    for name, parameter in found.unknowns.items():
        other = again.unknowns[name]
        assert (other.label, other.unit, other.refined) == (parameter.label, parameter.unit, parameter.refined)
        for field in ("value", "std", "given", "suggested"):
            torch.testing.assert_close(getattr(other, field), getattr(parameter, field), rtol=0, atol=0, equal_nan=True)
