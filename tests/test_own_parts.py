"""Losses and camera unknowns that a user adds: they work wherever those that are shipped do."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any, ClassVar

import pytest
import torch
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import Tensor

from torchstickcal import Calibration, CalibrationLayer, ConfigError, Intrinsics, TensorBoardMonitor, calibrate, load_config
from torchstickcal.losses import (
    CameraPointLoss,
    Cauchy,
    FrameLoss,
    Loss,
    LossContext,
    LossSettings,
    ReprojectionLoss,
    SmoothnessLoss,
    StickLengthLoss,
    TrackLoss,
    register_loss,
)
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.model.unknowns import REFINEMENTS, LensUnknown, Sharing, View, all_unknowns, register_unknown
from torchstickcal.show.report import summary, table
from torchstickcal.simulate import Noise, SessionSpec, golf_session
from torchstickcal.simulate.regimes import GaussianNoise
from torchstickcal.solvers.elimination.normal_equations import NormalEquations
from torchstickcal.solvers.uncertainty import camera_covariance, likelihood

ARMS = (("left_elbow", "left_wrist"), ("right_elbow", "right_wrist"))


class EqualLengths(FrameLoss):
    """Two segments of one frame are equally long."""

    def __init__(self, points: list[int], sigma_m: float) -> None:
        super().__init__(sigma_m)
        self._points = points

    def groups(self, sticks: Tensor) -> Tensor:
        return torch.tensor([self._points], device=sticks.device)

    def residuals(self, points: Tensor, lengths_m: Tensor) -> Tensor:
        first, second = (points[..., end, :] - points[..., start, :] for start, end in ((0, 1), (2, 3)))
        return (first.norm(dim=-1) - second.norm(dim=-1)).unsqueeze(-1)


@dataclass(frozen=True)
class EqualForearms(LossSettings):
    """Left and right forearm are equally long."""

    sigma_m: float = 0.005

    loss = EqualLengths

    def build(self, context: LossContext) -> EqualLengths:
        return EqualLengths([context.point(name) for arm in ARMS for name in arm], self.sigma_m)


class RayLoss(CameraPointLoss):
    """Distance of keypoint and projection on the plane at depth 1."""

    def residuals(self, points_cam: Tensor, keypoints: Tensor, intrinsics: Intrinsics) -> Tensor:
        return (
            points_cam[..., :2] / points_cam[..., 2:]
            - (keypoints - intrinsics.matrix[..., None, :2, 2]) / (intrinsics.focal_px[..., None, None])
        )


@dataclass(frozen=True)
class RaySettings(LossSettings):
    sigma: float = 0.001

    loss = RayLoss

    def build(self, context: LossContext) -> RayLoss:
        return RayLoss(self.sigma, kernel=Cauchy(3.0))


class SlowLoss(TrackLoss):
    """Points move little from frame to frame."""

    stencil = (-1.0, 1.0)


@dataclass(frozen=True)
class SlowSettings(LossSettings):
    sigma_m: float = 0.1

    loss = SlowLoss

    def build(self, context: LossContext) -> SlowLoss:
        return SlowLoss(self.sigma_m)


class Aspect(LensUnknown):
    """Ratio of the focal lengths along y and x; the deviation is its logarithm over that of the given ratio."""

    name = "own_aspect"
    label = "aspect ratio"
    unit = ""
    components = ("own_aspect",)
    variants: ClassVar = {"own_aspect": Sharing.OWN, "own_aspect_shared": Sharing.GROUP}
    noticeable_prior_share = 0.1

    def prior(self, cameras: Intrinsics) -> Tensor:
        return torch.full_like(cameras.focal_px, 0.05).unsqueeze(-1)

    def applied(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
        only_fy = cameras.matrix.new_tensor([[0.0, 0, 0], [0, 1, 0], [0, 0, 0]])
        return replace(cameras, matrix=cameras.matrix * (1 + only_fy * (deviations.exp()[..., None] - 1)))

    def values(self, cameras: Intrinsics) -> Tensor:
        return (cameras.matrix[..., 1, 1] / cameras.matrix[..., 0, 0]).unsqueeze(-1)


@pytest.fixture
def registered(own_parts) -> None:
    """The parts above, registered as a user's module would."""
    register_loss("own_forearms")(EqualForearms)
    register_loss("rays")(RaySettings)
    register_loss("slow")(SlowSettings)
    register_unknown(Aspect)


def with_stage_losses(**losses: Any) -> dict[str, Any]:
    """The default with more losses, with known noise and all keypoints, so that both solvers minimise the same."""
    known = {"reprojection": {"sigma_px": 2.0}}
    later = dict.fromkeys(("metric", "selected", "refined", "trajectories"), known | {"reject_sigmas": False} | losses)
    return {"extends": "default", "stages": {"unscaled": known} | later}


def forearm_difference_m(calibration: Calibration) -> float:
    names = calibration.point_names
    assert names is not None
    ends = [[calibration.points[:, names.index(name)] for name in arm] for arm in ARMS]
    left, right = ((end - start).norm(dim=-1) for start, end in ends)
    return float((left - right).abs().nanmedian())


@pytest.mark.usefixtures("registered")
class TestLoss:
    """Left and right forearm of equal length: a loss of four points of a frame, two of which a stick may share."""

    def test_any_stage_can_name_it_and_both_solvers_minimise_it(self):
        observations, _ = golf_session(cameras=3, frames=20, noise=Noise(2.0))
        plain = calibrate(observations)
        firm = with_stage_losses(own_forearms={"sigma_m": 1e-4})
        newton, lbfgs = calibrate(observations, firm), calibrate(observations, firm | {"solver": "lbfgs"})
        assert newton.converged
        assert forearm_difference_m(plain) > 0.005
        assert forearm_difference_m(newton) < 1e-6
        costs = [calibration.stages[3].iterations[-1].cost for calibration in (newton, lbfgs)]
        assert costs[0] == pytest.approx(costs[1], rel=1e-6)
        torch.testing.assert_close(newton.translations, lbfgs.translations, rtol=0, atol=1e-4)

    def test_covariance_counts_it(self, disturbed: tuple[Measurements, State]):
        """Knowing more never makes cameras less certain: the difference of the covariances is positive semidefinite."""
        measurements, state = disturbed
        sigma_px = torch.ones(1, 21, dtype=torch.float64)
        losses: dict[str, Loss] = {"reprojection": ReprojectionLoss(1.0), "stick_length": StickLengthLoss(0.001)}
        more = losses | {"equal": EqualLengths([7, 8, 10, 11], 1e-4)}
        without, with_it = (camera_covariance(likelihood(measurements, some, sigma_px), state)[0] for some in (losses, more))
        assert torch.linalg.eigvalsh(without - with_it).min() > -1e-6 * without.diagonal().max()
        assert (with_it.diagonal() < without.diagonal()).all()

    def test_tensorboard_shows_it(self, tmp_path):
        observations, _ = golf_session(cameras=3, frames=10, noise=Noise(2.0))
        calibrate(observations, with_stage_losses(own_forearms={}), TensorBoardMonitor(tmp_path))
        log = EventAccumulator(str(tmp_path / "calibration_001"))
        log.Reload()
        assert "loss/own_forearms" in log.Tags()["scalars"]

    def test_unknown_settings_and_taken_names_are_refused(self):
        with pytest.raises(ConfigError, match=r"own_forearms.sigma.*Did you mean 'sigma_m'"):
            load_config(with_stage_losses(own_forearms={"sigma": 1.0}))
        with pytest.raises(ConfigError, match=r"the name is taken .*loss"):
            register_loss("reprojection")(EqualForearms)

    @pytest.mark.parametrize("settings", [EqualLengths, type("Bare", (LossSettings,), {"loss": EqualLengths}), 3])
    def test_what_is_no_settings_cannot_be_registered(self, settings):
        with pytest.raises(ConfigError, match=r"not the settings of a loss.*'mine'.*@dataclass"):
            register_loss("mine")(settings)

    def test_a_decorator_without_a_name_is_refused(self):
        with pytest.raises(ConfigError, match="a loss needs a name"):
            register_loss(EqualForearms)  # type: ignore[arg-type]

    def test_it_has_a_scalar_for_training_loops(self):
        points = torch.zeros(2, 5, 4, 3, dtype=torch.float64)
        points[..., 1, 0], points[..., 3, 1] = 1.0, 1.5
        points[0, 0, 0] = torch.nan
        points.requires_grad_()
        loss = EqualLengths([0, 1, 2, 3], 0.1)(points)
        assert float(loss.detach()) == pytest.approx(9 * 0.5**2 / 0.1**2)
        loss.backward()
        assert points.grad is not None
        assert points.grad[1, 0, 1].tolist() == pytest.approx([-100.0, 0, 0])

    @pytest.mark.parametrize(
        ("method", "value", "message"),
        [
            ("groups", torch.tensor([0, 1]), r"\(2,\), torch.int64.*a tensor \(G, k\)"),
            ("groups", [[0, 1]], "list; expected a tensor"),
            ("groups", torch.tensor([[0, 99]]), "points 0 to 99; expected 0 to 20"),
            ("residuals", torch.zeros(1, 8, 1, dtype=torch.float64), r"\(1, 8, 1\); expected \(1, 8, 1, 'm'\)"),
        ],
    )
    def test_wrong_shapes_are_named(self, monkeypatch: pytest.MonkeyPatch, method: str, value, message: str):
        monkeypatch.setattr(EqualLengths, method, lambda *arguments: value)
        observations, _ = golf_session(cameras=3, frames=8)
        with pytest.raises(ConfigError, match=rf"EqualLengths.{method}.*{message}"):
            calibrate(observations, with_stage_losses(own_forearms={}))

    @pytest.mark.parametrize("smooth", [False, True])
    def test_gradients_of_the_layer_are_exact(self, smooth: bool):
        observations, _ = golf_session(cameras=3, frames=8, noise=Noise(2.0))
        reprojection = {"sigma_px": 2.0, "kernel": "cauchy", "kernel_scale": 3.0}
        metric: dict[str, Any] = {"reprojection": reprojection, "stick_length": {"sigma_m": 0.02}, "own_forearms": {}}
        if smooth:
            metric |= {"smoothness": {"sigma_m": 0.3}, "slow": {"sigma_m": 0.5}}
        stages = {"unscaled": {"reprojection": reprojection, "rescale": True}, "metric": metric}
        layer = CalibrationLayer(observations.sticks, {"stages": stages}, point_names=observations.point_names)
        keypoints = observations.keypoints.clone().requires_grad_()
        generator = torch.Generator().manual_seed(0)
        weights = torch.randn(8, 21, 3, generator=generator, dtype=torch.float64)
        direction = torch.randn(keypoints.shape, generator=generator, dtype=torch.float64)
        result = layer(keypoints, observations.cameras)
        (gradient,) = torch.autograd.grad((weights * result.points).sum() + result.translations.sum(), keypoints)
        with torch.no_grad():
            moved = [layer(keypoints + sign * 1e-3 * direction, observations.cameras, initial=result) for sign in (1, -1)]
        ahead, behind = (float((weights * r.points).sum() + r.translations.sum()) for r in moved)
        assert float((gradient * direction).sum()) == pytest.approx((ahead - behind) / 2e-3, rel=1e-5)


DAMPING = 5.0
"""Makes the exact Hessian definite away from the minimum."""

LOSS_SETS = {
    "reprojection": {"reprojection": ReprojectionLoss(9.0, 0.7, Cauchy(5.0))},
    "rays": {"rays": RayLoss(0.01, 0.7, Cauchy(5.0)), "length": StickLengthLoss(0.1)},
    "forearms": {
        "reprojection": ReprojectionLoss(9.0),
        "length": StickLengthLoss(0.1),
        "equal": EqualLengths([7, 8, 10, 11], 0.1),
    },
    "shared with a stick": {
        "reprojection": ReprojectionLoss(9.0),
        "length": StickLengthLoss(0.1),
        "equal": EqualLengths([19, 8, 10, 20], 3.0),
    },
    "over time": {
        "reprojection": ReprojectionLoss(9.0),
        "equal": EqualLengths([7, 8, 10, 11], 0.1),
        "smooth": SmoothnessLoss(0.1),
        "slow": SlowLoss(0.1),
    },
}


def test_exact_gradients_refuse_a_track_loss_with_a_kernel(monkeypatch: pytest.MonkeyPatch, own_parts):
    register_loss("slow")(SlowSettings)
    monkeypatch.setattr(SlowSettings, "build", lambda self, context: SlowLoss(0.1, kernel=Cauchy()))
    observations, _ = golf_session(cameras=3, frames=8, noise=Noise(1.0))
    config = with_stage_losses(slow={})
    with pytest.raises(ConfigError, match=r"without a robust kernel.*slow.*Cauchy.*gauss_newton"):
        CalibrationLayer(observations.sticks, config)(observations.keypoints, observations.cameras)
    layer = CalibrationLayer(observations.sticks, config, gradient="gauss_newton")
    assert layer(observations.keypoints, observations.cameras).status == ("converged",)


@pytest.mark.parametrize("exact", [False, True], ids=["gauss-newton", "exact"])
@pytest.mark.parametrize("losses", LOSS_SETS.values(), ids=LOSS_SETS.keys())
def test_linear_systems_are_those_of_autograd(disturbed: tuple[Measurements, State], losses: dict[str, Any], exact: bool):
    """The solution of the eliminated system satisfies the dense one, whose Hessian autograd takes of the objective."""
    whole, state = disturbed
    m = whole.within(slice(0, 4))
    state = replace(state, points=state.points[..., : m.num_columns].contiguous())
    objective = Objective(m, losses)

    def value(points: Tensor) -> Tensor:
        return torch.stack(list(objective.terms(replace(state, points=points.view_as(state.points))).values())).sum() / 2

    system = NormalEquations(objective, state, cameras_free=False, damping=DAMPING, exact=exact)
    assert float(system.cost) == pytest.approx(2 * float(value(state.points)), rel=1e-12)
    (gradient,) = torch.autograd.grad(value(at := state.points.clone().requires_grad_()), at)
    torch.testing.assert_close(system.point_gradient, gradient, rtol=1e-9, atol=1e-9 * float(gradient.abs().max()))
    if exact:
        hessian = torch.autograd.functional.hessian(value, state.points.flatten())
        inactive = (~m.active[0]).repeat(3).nonzero().flatten()
        hessian[inactive, inactive] += 1.0
        rhs = torch.randn(state.points.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        none = rhs.new_zeros(1, 0, 6), rhs.new_zeros(1, 0)
        *_, points, _ = system.solve(*none, rhs)
        damped = hessian + DAMPING * torch.diag(hessian.diagonal())
        torch.testing.assert_close(damped @ points.flatten(), rhs.flatten(), rtol=1e-8, atol=1e-8)


def test_closed_forms_are_the_automatic_ones(disturbed: tuple[Measurements, State]):
    """What the shipped losses write by hand against what the base classes derive from their residuals."""
    m, state = disturbed
    state = replace(state, points=state.points[..., :63])
    points_cam, pixels = state.in_cameras(), m.pixels[..., :63]
    information, rotations = m.confidence[..., :63] / 4.0, state.rotations
    loss = ReprojectionLoss(2.0, 0.7, Cauchy(2.0))
    for exact in (False, True):
        arguments = (points_cam, rotations, pixels, information, m.cameras, exact)
        by_hand, automatic = loss.linearise(*arguments), CameraPointLoss.linearise(loss, *arguments)
        for found, expected in zip(by_hand[:-1], automatic[:-1], strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    slopes = (points_cam, rotations, pixels, information, m.cameras)
    for found, expected in zip(loss.slopes(*slopes)[:-1], CameraPointLoss.slopes(loss, *slopes)[:-1], strict=True):
        torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    moved = torch.randn(points_cam.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
    along = (points_cam, moved, pixels, information, m.cameras)
    torch.testing.assert_close(loss.slope(*along), CameraPointLoss.slope(loss, *along), rtol=1e-11, atol=0)

    length, by_frame = StickLengthLoss(0.01, 0.4, Cauchy(2.0)), state.points.unflatten(-1, (3, 21))
    active, sticks, lengths_m = m.by_frame(m.active)[:, :3], m.sticks, m.lengths_m[:, None]
    for exact in (False, True):
        arguments = (by_frame, sticks, lengths_m, active, exact)
        by_hand, automatic = length.linearise(*arguments), FrameLoss.linearise(length, *arguments)
        for found, expected in zip(by_hand, automatic, strict=True):
            torch.testing.assert_close(found, expected, rtol=1e-9, atol=1e-9 * float(expected.abs().max()))
    moved = torch.randn(by_frame.shape, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    along = (by_frame, moved, sticks, lengths_m, active)
    torch.testing.assert_close(length.slope(*along), FrameLoss.slope(length, *along), rtol=1e-11, atol=0)


@pytest.mark.usefixtures("registered")
class TestCameraUnknown:
    """The aspect ratio of pixels, 1 % off in every camera."""

    SPEC = SessionSpec("own_aspect", "hockey", 3, 4, 80, 60.0, "ring", regimes=(GaussianNoise(0.5),))

    def observations(self):
        given = self.SPEC.generate().observations
        wrong = given.intrinsics.clone()
        wrong[..., 1, 1] *= 1.01
        return replace(given, intrinsics=wrong)

    def test_it_is_found_with_an_honest_deviation(self):
        found = calibrate(self.observations(), refine=["own_aspect"])
        assert found.converged
        assert found.refined == ("own_aspect",)
        aspect = found.unknowns["own_aspect"]
        assert aspect.refined
        assert (aspect.given - 1.01).abs().max() < 1e-12
        assert (aspect.std > 0).all()
        assert ((aspect.value - 1.0) / aspect.std).abs().max() < 4
        assert (aspect.value - 1.0).abs().max() < 0.003
        torch.testing.assert_close(found.intrinsics[:, 1, 1] / found.intrinsics[:, 0, 0], aspect.value)

    def test_shared_it_is_one_value(self):
        value = calibrate(self.observations(), refine=["own_aspect_shared"]).unknowns["own_aspect"].value
        assert (value == value[0]).all()

    def test_auto_tries_it_and_warnings_name_it(self):
        assert {"own_aspect", "own_aspect_shared"} & set(calibrate(self.observations(), refine="auto").refined)
        warnings = calibrate(self.observations()).warnings
        assert any("aspect ratio" in warning and "refine 'own_aspect'" in warning for warning in warnings)

    def test_report_and_summary_have_it(self):
        found = calibrate(self.observations(), refine=["own_aspect"])
        assert "aspect ratio" in table(found)
        assert summary(found)["unknowns"]["own_aspect"]["cameras"][1]["std"]["own_aspect"] > 0

    def test_the_layer_differentiates_by_it(self):
        given = self.observations()
        keypoints = given.keypoints[:, :12].clone().requires_grad_()
        known = {"reprojection": {"sigma_px": 0.5}, "reject_sigmas": False}
        stages = dict.fromkeys(("unscaled", "metric", "selected", "refined"), known)
        stages["trajectories"] = known | {"smoothness": {"sigma_m": 0.1}}
        layer = CalibrationLayer(given.sticks, {"extends": "default", "refine": ["own_aspect"], "stages": stages})
        result = layer(keypoints, given.cameras)
        (gradient,) = torch.autograd.grad(result.intrinsics[:, 1, 1].sum(), keypoints)
        direction = torch.randn(keypoints.shape, generator=torch.Generator().manual_seed(0), dtype=torch.float64)
        with torch.no_grad():
            ahead, behind = (
                float(layer(keypoints + sign * 1e-4 * direction, given.cameras, initial=result).intrinsics[:, 1, 1].sum())
                for sign in (1, -1)
            )
        assert float((gradient.nan_to_num() * direction).sum()) == pytest.approx((ahead - behind) / 2e-4, rel=1e-5)


def test_derivatives_by_shipped_unknowns_are_the_automatic_ones():
    generator = torch.Generator().manual_seed(0)
    u, v = 0.3 * torch.randn(2, 1, 3, 20, generator=generator, dtype=torch.float64)
    matrix = torch.tensor([[900.0, 0.5, 500], [0, 950, 400], [0, 0, 1]], dtype=torch.float64).expand(1, 3, 3, 3)
    lenses = {8: [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, 0.01, 0.001], 14: [-0.2, 0.05, *[0.001] * 10, 0.03, -0.02]}
    for coefficients in (None, *lenses.values()):
        lens = None if coefficients is None else torch.tensor(coefficients, dtype=torch.float64).expand(1, 3, -1)
        cameras = Intrinsics(matrix, lens)
        view = View(u, v, cameras.pixels_with_jacobian(u, v), cameras, None)
        for unknown in all_unknowns().values():
            if isinstance(unknown, LensUnknown):
                for found, expected in zip(
                    unknown.projection_derivatives(view), LensUnknown.projection_derivatives(unknown, view), strict=True
                ):
                    torch.testing.assert_close(found.expand_as(expected), expected, rtol=1e-10, atol=1e-10)
                by_values = LensUnknown.value_derivatives(unknown, cameras)
                torch.testing.assert_close(unknown.value_derivatives(cameras), by_values, rtol=1e-12, atol=1e-12)


def changed(**attributes: Any) -> type[LensUnknown]:
    """The aspect ratio with something else."""
    return type("Faulty", (Aspect,), {"name": "faulty", "variants": {"faulty": Sharing.OWN}} | attributes)


def moved_skew(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
    matrix = cameras.matrix.clone()
    matrix[..., 0, 1] = matrix[..., 0, 1] + deviations[..., 0]
    return replace(cameras, matrix=matrix)


def in_place(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
    cameras.matrix[..., 1, 1] *= deviations.exp()[..., 0]
    return cameras


def doubled(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
    return replace(cameras, matrix=2 * cameras.matrix)


def squared(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
    return Aspect.applied(self, cameras, deviations.square())


def first_coefficient(self, cameras: Intrinsics, deviations: Tensor) -> Intrinsics:
    return replace(cameras, distortion=cameras.distortion.clone())


@pytest.mark.parametrize(
    ("attributes", "message"),
    [
        ({"label": None}, "attribute `label`.*a text"),
        ({"components": "faulty"}, "attribute `components`.*a tuple"),
        ({"variants": {"faulty": "own"}}, "attribute `variants`.*members of Sharing"),
        ({"name": "focal"}, "another unknown has this name"),
        ({"prior": lambda self, cameras: torch.ones_like(cameras.focal_px)}, r"prior.*\(1, 2\)"),
        ({"applied": moved_skew}, "applied before or after 'focal'.*a fraction of it"),
        ({"applied": in_place}, "applied.*changes the cameras that it is given"),
        ({"applied": doubled}, "applied, no deviation.*the same cameras"),
        ({"applied": squared}, "a deviation twice.*add up"),
        ({"applied": lambda self, cameras, deviations: cameras}, "a deviation.*the same projections"),
        ({"applied": first_coefficient}, r"no distortion \(cameras.distortion is None\).*AttributeError"),
        ({"values": lambda self, cameras: cameras.focal_px}, r"values.*\(1, 2\)"),
    ],
)
@pytest.mark.usefixtures("own_parts")
def test_faulty_unknowns_are_refused_when_they_are_registered(attributes: dict[str, Any], message: str):
    with pytest.raises(ConfigError, match=rf"unusable camera unknown.*Faulty.*{message}"):
        register_unknown(changed(**attributes))
    assert "faulty" not in REFINEMENTS
