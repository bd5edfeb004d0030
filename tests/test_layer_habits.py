"""What users of torch expect of a layer: results as tensors, torch.func, arguments, hooks, graphs, files."""

from __future__ import annotations

import copy
import io
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import Tensor, nn
from torch.autograd import forward_ad
from torch.func import functional_call, grad, hessian, jacfwd, jacrev, jvp, vjp, vmap
from torch.utils import _pytree as pytree
from torch.utils.checkpoint import checkpoint

from torchstickcal import (
    CalibrationError,
    CalibrationLayer,
    ConfigError,
    Intrinsics,
    LayerResult,
    ObservationError,
    Stick,
    calibrate,
)
from torchstickcal.simulate import Noise, SessionSpec, golf_session

OBSERVATIONS, _ = golf_session(cameras=3, frames=8, noise=Noise(sigma_px=1.0, missing=0.03))
KEYPOINTS, LENS, STICK = OBSERVATIONS.keypoints, OBSERVATIONS.cameras, OBSERVATIONS.sticks[0]
SESSIONS = torch.stack([KEYPOINTS, KEYPOINTS + 1.0, KEYPOINTS - 1.0])
BLIND = torch.full_like(KEYPOINTS, torch.nan)
LAYER = CalibrationLayer(STICK)


def spread(keypoints: Tensor, matrix: Tensor = LENS.matrix, confidence: Tensor | None = None) -> Tensor:
    """A number that depends on everything."""
    result = LAYER(keypoints, Intrinsics(matrix, LENS.distortion), confidence=confidence)
    return result.translations.square().sum() + result.points.square().mean()


def gradient_of(function: Callable[..., Tensor], *arguments: Tensor) -> tuple[Tensor, ...]:
    leaves = [argument.clone().requires_grad_() for argument in arguments]
    return torch.autograd.grad(function(*leaves), leaves)


def assert_near(found: Any, expected: Any, rtol: float = 1e-7) -> None:
    scale = float(expected.nan_to_num().abs().max())
    torch.testing.assert_close(found, expected, rtol=rtol, atol=rtol * scale, equal_nan=True)


def test_a_result_is_handled_as_a_tensor():
    result = LAYER(SESSIONS.clone().requires_grad_(), LENS)
    assert len(result) == 3
    assert not any(tensor.requires_grad for tensor in result.detach().tensors().values())
    one, some, back = result[1], result[1:], result[::-1]
    assert one.points.shape == result.points.shape[1:]
    assert torch.equal(one.points, result.points[1])
    assert len(some) == 2
    assert torch.equal(back.points, result.points.flip(0))
    assert [len(session.status) for session in result] == [1, 1, 1]
    assert torch.equal(result[-1].inliers, result.inliers[2])
    with pytest.raises(IndexError):
        result[3]
    for refused in (lambda: len(one), lambda: one[0], lambda: list(one)):
        with pytest.raises(TypeError, match="one session"):
            refused()
    assert bool(one)
    half = result.to(torch.float32)
    assert (half.points.dtype, half.known.dtype, half.keypoint_index.dtype) == (torch.float32, torch.bool, torch.int64)
    assert result.to("cpu", dtype=torch.float32).rotations.dtype == torch.float32
    half.points.sum().backward()
    assert torch.equal(copy.deepcopy(result.detach()).points, result.points)


@pytest.mark.parametrize("lens", [LENS, Intrinsics(LENS.matrix)], ids=["lens", "perfect lens"])
def test_a_result_is_a_pytree_and_a_file(lens: Intrinsics):
    result = LAYER(SESSIONS, lens)
    leaves, structure = pytree.tree_flatten(result)
    assert all(isinstance(leaf, Tensor) for leaf in leaves)
    assert pytree.tree_unflatten(leaves, structure).status == result.status
    first = pytree.tree_map(lambda tensor: tensor[0], result)
    assert isinstance(first, LayerResult)
    assert torch.equal(first.points, result[0].points)
    assert str(pytree.tree_flatten_with_path(result)[0][0][0][0]) == ".rotations"
    file = io.BytesIO()
    torch.save(result, file)
    file.seek(0)
    read = torch.load(file, weights_only=True)
    assert read.status == result.status
    assert all(torch.equal(tensor, getattr(read, name)) for name, tensor in result.tensors().items())


def test_transforms_of_torch_func_are_those_of_backward():
    (expected,) = gradient_of(spread, KEYPOINTS)
    assert float(expected.abs().max()) > 0
    assert_near(grad(spread)(KEYPOINTS), expected)
    assert_near(vjp(spread, KEYPOINTS)[1](torch.ones((), dtype=torch.float64))[0], expected)
    rows = jacrev(lambda keypoints: LAYER(keypoints, LENS).translations[1])(KEYPOINTS)
    for row, found in enumerate(rows):
        (alone,) = gradient_of(lambda keypoints, row=row: LAYER(keypoints, LENS).translations[1, row], KEYPOINTS)
        assert_near(found, alone)
    shift = nn.Linear(2, 2).double()
    moved = grad(lambda weights: spread(KEYPOINTS.nan_to_num(500.0) + functional_call(shift, weights, torch.ones(2).double())))
    weights = dict(shift.named_parameters())
    spread(KEYPOINTS.nan_to_num(500.0) + shift(torch.ones(2).double())).backward()
    for name, found in moved(weights).items():
        assert_near(found, getattr(shift, name).grad, 1e-6)


def test_vmap_over_sessions_is_the_batch():
    together = LAYER(SESSIONS, LENS)
    mapped = vmap(lambda keypoints: LAYER(keypoints, LENS))(SESSIONS)
    assert torch.equal(mapped.points, together.points)
    assert mapped.status == together.status
    confidence = torch.linspace(0.5, 1.0, 3, dtype=torch.float64)

    def one(keypoints: Tensor, matrix: Tensor, trust: Tensor) -> Tensor:
        of_cameras = trust ** torch.arange(keypoints.shape[0])
        return spread(keypoints, matrix, of_cameras[:, None, None].expand(keypoints.shape[:-1]))

    arguments = SESSIONS, LENS.matrix, confidence
    alone = [gradient_of(one, SESSIONS[k], LENS.matrix, confidence[k]) for k in range(3)]
    per_session = vmap(grad(one, argnums=(0, 1, 2)), in_dims=(0, None, 0))(*arguments)
    summed = grad(lambda *given: vmap(one, in_dims=(0, None, 0))(*given).sum(), argnums=(0, 1, 2))(*arguments)
    for number, (mine, ours) in enumerate(zip(per_session, summed, strict=True)):
        expected = torch.stack([gradients[number] for gradients in alone])
        assert_near(mine, expected, 1e-6)
        assert_near(ours, expected.sum(0) if number == 1 else expected, 1e-6)


def test_vmap_over_batches_of_which_some_sessions_fail():
    batches = torch.stack([torch.stack([KEYPOINTS, BLIND]), torch.stack([BLIND, KEYPOINTS + 1.0])])
    mapped = vmap(lambda keypoints: LAYER(keypoints, LENS).translations)(batches)
    assert torch.equal(mapped.flatten(0, 1), LAYER(batches.flatten(0, 1), LENS).translations)
    found = vmap(grad(lambda keypoints: LAYER(keypoints, LENS).translations.sum()))(batches)
    assert (found[0, 1] == 0).all()
    assert (found[1, 0] == 0).all()
    assert float(found[1, 1].nan_to_num().abs().max()) > 0


def backward_twice(loss: Callable[[Tensor], Tensor], penalty_only: bool) -> None:
    keypoints = KEYPOINTS.clone().requires_grad_()
    value = loss(keypoints)
    (gradient,) = torch.autograd.grad(value, keypoints, create_graph=True)
    (gradient.nan_to_num().square().sum() + (0.0 if penalty_only else value)).backward()


def in_a_dual_level() -> None:
    with forward_ad.dual_level():
        spread(forward_ad.make_dual(KEYPOINTS, torch.ones_like(KEYPOINTS)))


def linear(keypoints: Tensor) -> Tensor:
    return LAYER(keypoints, LENS).translations.sum()


@pytest.mark.parametrize(
    "attempt",
    [
        lambda: jvp(spread, (KEYPOINTS,), (torch.ones_like(KEYPOINTS),)),
        lambda: jacfwd(spread)(KEYPOINTS),
        lambda: hessian(spread)(KEYPOINTS),
        lambda: grad(lambda keypoints: grad(linear)(keypoints).nan_to_num().sum())(KEYPOINTS),
        in_a_dual_level,
        lambda: backward_twice(spread, penalty_only=True),
        lambda: backward_twice(linear, penalty_only=True),
        lambda: backward_twice(linear, penalty_only=False),
    ],
    ids=["jvp", "jacfwd", "hessian", "grad of grad", "dual", "twice", "twice, linear", "twice, linear and the loss"],
)
def test_derivatives_that_it_does_not_have_are_errors_and_not_zero(attempt: Callable[[], Any]):
    with pytest.raises(CalibrationError, match=r"no (forward-mode|second) derivatives"):
        attempt()


def test_a_gradient_with_a_graph_is_the_gradient():
    keypoints = KEYPOINTS.clone().requires_grad_()
    (found,) = torch.autograd.grad(spread(keypoints), keypoints, create_graph=True)
    assert_near(found.detach(), gradient_of(spread, KEYPOINTS)[0])


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("confidence", 1.0000001),
        ("confidence", -0.1),
        ("confidence", torch.nan),
        ("intrinsics", 0.0),
        ("intrinsics", torch.inf),
        ("distortion", torch.nan),
        ("stick_lengths", -1.0),
        ("stick_lengths", torch.nan),
        ("stick_lengths", 1000.0),
        ("image_size", -3.0),
    ],
)
def test_values_that_nothing_can_have_are_errors_and_no_status(name: str, value: float):
    seen = tuple(KEYPOINTS.isfinite().all(-1).nonzero()[0].tolist())
    given = {
        "confidence": torch.ones(SESSIONS.shape[:-1], dtype=torch.float64),
        "intrinsics": LENS.matrix.expand(3, 3, 3, 3).clone(),
        "distortion": LENS.distortion.expand(3, 3, -1).clone(),
        "stick_lengths": torch.ones(3, 1, dtype=torch.float64),
        "image_size": torch.full((3, 3, 2), 1000.0),
    }
    given[name][(1, *seen)[: given[name].ndim] if name == "confidence" else (1, *[0] * (given[name].ndim - 1))] = value
    lens = Intrinsics(given["intrinsics"], given["distortion"])
    other = {key: given[key] for key in ("confidence", "stick_lengths", "image_size")}
    where = {"stick_lengths": "length_m"}.get(name, name)
    with pytest.raises(ObservationError, match=rf"{where}.*session 1"):
        LAYER(SESSIONS, lens, **other)


def test_failures_are_a_status_or_an_error():
    keypoints = torch.stack([KEYPOINTS, BLIND, KEYPOINTS])
    assert LAYER(keypoints, LENS).converged.tolist() == [True, False, True]
    strict = CalibrationLayer(STICK, on_failure="raise")
    assert strict(SESSIONS, LENS).converged.all()
    with pytest.raises(CalibrationError, match=r"1 of 3 sessions.*\(session 1\).*never seen"):
        strict(keypoints, LENS)
    with pytest.raises(CalibrationError, match="1 of 1 sessions"):
        strict(BLIND, LENS)
    with pytest.raises(ConfigError, match="on_failure"):
        CalibrationLayer(STICK, on_failure="ignore")


def test_every_output_of_a_batch_that_fails_has_a_graph():
    keypoints = torch.stack([BLIND, BLIND]).requires_grad_()
    result = LAYER(keypoints, LENS)
    for name, tensor in result.tensors().items():
        if tensor.is_floating_point() and name != "sigma_px":
            (found,) = torch.autograd.grad(tensor.sum(), keypoints, retain_graph=True)
            assert (found == 0).all(), name


def test_unseen_keypoints_that_a_network_has_touched():
    weight = torch.tensor(1.0, dtype=torch.float64, requires_grad=True)
    spread(KEYPOINTS * weight).backward()
    assert weight.grad.isnan(), "NaN times a gradient of zero is NaN, whatever the layer does"
    seen = KEYPOINTS.isfinite().all(-1).double()
    weight.grad = None
    scaled = KEYPOINTS.nan_to_num() * weight
    spread(scaled, confidence=seen).backward()
    with torch.no_grad():
        ahead, behind = (spread(KEYPOINTS * (1 + step)) for step in (1e-4, -1e-4))
        assert torch.equal(LAYER(scaled, LENS, confidence=seen).points, LAYER(KEYPOINTS, LENS).points)
    assert float(weight.grad) == pytest.approx(float(ahead - behind) / 2e-4, rel=0.1)
    blind = torch.zeros_like(seen)
    weight.grad = None
    spread(KEYPOINTS.nan_to_num() * weight, confidence=blind).backward()
    assert weight.grad == 0


def test_hooks_checkpoints_and_inference():
    layer, called = copy.deepcopy(LAYER), []
    layer.register_forward_pre_hook(lambda *_: called.append("before"))
    layer.register_forward_hook(lambda *_: called.append("after"))
    keypoints = KEYPOINTS.clone().requires_grad_()
    result = layer(keypoints, LENS)
    result.translations.register_hook(lambda gradient: called.append("backward"))
    result.translations.square().sum().backward()
    assert called == ["before", "after", "backward"]
    again = KEYPOINTS.clone().requires_grad_()
    checkpoint(LAYER, again, LENS, use_reentrant=False).translations.square().sum().backward()
    assert_near(again.grad, keypoints.grad)
    layer.register_full_backward_hook(lambda *_: None)
    with pytest.warns(UserWarning, match="module output should be a Tensor or a tuple of Tensors"):
        layer(keypoints, LENS)
    with torch.inference_mode():
        assert torch.equal(LAYER(KEYPOINTS, LENS).points, result.points)


COMPILED = """
import sys, warnings
import torch
from torchstickcal import CalibrationError, CalibrationLayer
from torchstickcal.simulate import golf_session
observations, _ = golf_session(3, 6)
layer, lens, keypoints = CalibrationLayer(observations.sticks), observations.cameras, observations.keypoints
function = lambda k: (layer(k + 0.0, lens).translations * 2.0).sum()
expected = float(function(keypoints))
class Network(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.layer = layer
    def forward(self, k):
        return self.layer(k, lens).translations
for attempt, error in (
    (lambda: torch.export.export(Network(), (keypoints,)), CalibrationError),
    (lambda: torch.jit.trace(function, (keypoints,)), CalibrationError),
    (lambda: torch.compile(function, backend="eager", fullgraph=True)(keypoints), Exception),
    (lambda: torch.export.export(Network(), (keypoints,), strict=True), Exception),
):
    try:
        attempt()
    except error as raised:
        assert "its steps depend on the keypoints" in str(raised), raised
    else:
        raise AssertionError("no error")
torch._dynamo.reset()
compiled = torch.compile(function, backend="eager")
leaf = keypoints.clone().requires_grad_()
value = compiled(leaf)
value.backward()
assert abs(float(value) - expected) < 1e-9
assert float(leaf.grad.nan_to_num().abs().max()) > 0
for moved in (1.0, 2.0, 3.0):
    compiled(keypoints + moved)
frames = torch._dynamo.utils.counters["stats"]["unique_graphs"]
assert frames <= 4, frames
"""


def test_compiled_around_the_layer_and_never_exported():
    ran = subprocess.run([sys.executable, "-c", COMPILED], capture_output=True, text=True, check=False)
    assert ran.returncode == 0, ran.stderr
    assert "recompile" not in ran.stderr
    assert "graph break" not in ran.stderr.lower()


class Network(nn.Module):
    """As a framework for training would have it: its arguments are stored, and make it anew."""

    def __init__(self, **hyper_parameters: Any) -> None:
        super().__init__()
        self.hyper_parameters = hyper_parameters
        self.shift = nn.Linear(2, 2).double()
        stick = Stick(*hyper_parameters["stick"])
        self.layer = CalibrationLayer(stick, hyper_parameters["config"], hyper_parameters["gradient"], on_failure="status")

    def forward(self, keypoints: Tensor) -> Tensor:
        return self.layer(keypoints + self.shift(torch.ones(2).double()), LENS).translations


def test_checkpoints_of_a_network_hold_plain_values():
    network = Network(
        stick=[STICK.start, STICK.end, STICK.length_m], config={"extends": "default", "refine": []}, gradient="implicit"
    )
    assert list(network.state_dict()) == ["shift.weight", "shift.bias"]
    file = io.BytesIO()
    torch.save({"state_dict": network.state_dict(), "hyper_parameters": network.hyper_parameters}, file)
    file.seek(0)
    read = torch.load(file, weights_only=True)
    again = Network(**read["hyper_parameters"])
    again.load_state_dict(read["state_dict"])
    assert torch.equal(again(KEYPOINTS), network(KEYPOINTS))
    for same in (copy.deepcopy(network), pickle.loads(pickle.dumps(network))):
        assert torch.equal(same(KEYPOINTS), network(KEYPOINTS))
    assert "length_m=1.0" in repr(network)


def test_nothing_of_all_this_warns():
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        keypoints = SESSIONS.clone().requires_grad_()
        LAYER(keypoints, LENS).translations.sum().backward()
        vmap(grad(linear))(SESSIONS)


def test_a_layer_judges_its_sessions_as_calibrate_does():
    given = SessionSpec("s", "golf", 1, cameras=4, frames=30, layout="ring", regimes=(Noise(1.0),)).generate().observations
    mirrored = given.keypoints.clone()
    mirrored[2, ..., 0] = 1919 - mirrored[2, ..., 0]
    keypoints = torch.stack([given.keypoints, mirrored, torch.full_like(mirrored, torch.nan)]).requires_grad_()
    result = CalibrationLayer(given.sticks, point_names=given.point_names, judge=True)(keypoints, given.cameras)
    assert result.verdict is not None
    assert result.agreement is not None
    assert result.metre_m is not None
    assert result.qualities is not None
    assert result.verdict.tolist() == [0, 2, 3]
    assert result.agreement.shape == (3, 4)
    assert bool((result.agreement[0] > 0.95).all())
    assert int(result.agreement[1].argmin()) == 2
    assert [quality.findings[0].code for quality in result.qualities[1:]] == ["camera_mirrored", "not_calibrated"]
    alone = calibrate(replace(given, image_size=None, fps=None)).quality
    assert alone.acceptance is not None
    assert float(result.metre_m[0]) == pytest.approx(alone.acceptance.metre_m, rel=1e-3)
    assert result[1].qualities == result.qualities[1:2]
    assert [int(one.verdict) for one in result if one.verdict is not None] == [0, 2, 3]
    again = pytree.tree_map(lambda tensor: tensor.detach(), result)
    file = io.BytesIO()
    torch.save(again, file)
    file.seek(0)
    assert torch.load(file, weights_only=True).qualities == result.qualities
    result.translations.sum().backward()
    assert keypoints.grad is not None
    assert LAYER(KEYPOINTS, LENS).verdict is None
