"""The losses: closed forms, gradients, and the linearised forms against autograd."""

from __future__ import annotations

import math
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from torch import Tensor

from torchstickcal import ConfigError, Extrinsics, Intrinsics, ObservationError
from torchstickcal.losses import (
    Cauchy,
    GemanMcClure,
    Huber,
    Quadratic,
    ReprojectionLoss,
    SmoothnessLoss,
    StickLengthLoss,
    reprojection_residuals,
    robust_kernel,
    second_differences,
    stick_lengths,
)

KERNELS = [Quadratic(), Cauchy(1.3), Huber(1.3), GemanMcClure(2.0)]
F, P, C = 5, 4, 3


def random(*shape: int, seed: int = 0) -> Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def scene() -> dict[str, Tensor | Intrinsics]:
    points = random(F, P, 3)
    rotations = torch.linalg.qr(random(C, 3, 3, seed=1))[0]
    rotations = rotations * rotations.det().sign()[:, None, None]
    translations = random(C, 3, seed=2) * 0.1 + torch.tensor([0.0, 0.0, 6.0])
    matrix = torch.tensor([[100.0, 0.5, 50.0], [0, 110.0, 40.0], [0, 0, 1]], dtype=torch.float64)
    lens = torch.tensor([[-0.2, 0.05, 0.001, 0.002, 0.0]], dtype=torch.float64)
    intrinsics = Intrinsics(matrix.expand(C, 3, 3), lens.expand(C, 5))
    exact = torch.zeros(C, F, P, 2, dtype=torch.float64)
    keypoints = reprojection_residuals(points, rotations, translations, exact, intrinsics) + random(C, F, P, 2, seed=3)
    keypoints[0, 1, 2] = torch.nan
    confidence = torch.rand(C, F, P, generator=torch.Generator().manual_seed(4), dtype=torch.float64)
    return {
        "points": points,
        "rotations": rotations,
        "translations": translations,
        "keypoints": keypoints,
        "intrinsics": intrinsics,
        "confidence": confidence,
    }


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_kernel_weight_is_the_derivative_of_rho(kernel):
    squared = torch.tensor([0.0, 0.1, 1.0, 1.69, 3.0, 100.0, 1e6], dtype=torch.float64, requires_grad=True)
    (slope,) = torch.autograd.grad(kernel.rho(squared).sum(), squared)
    torch.testing.assert_close(slope, kernel.weight(squared).detach())
    assert kernel.rho(torch.zeros(1)) == 0
    assert kernel.weight(torch.zeros(1)).item() == pytest.approx(1)


def test_kernels_have_their_closed_forms():
    s = torch.tensor([9.0])
    assert Cauchy(2.0).rho(s).item() == pytest.approx(4 * math.log(1 + 9 / 4))
    assert Huber(2.0).rho(s).item() == pytest.approx(2 * 2 * 3 - 4)
    assert GemanMcClure(2.0).rho(s).item() == pytest.approx(9 / (1 + 9 / 4))


def test_kernels_are_found_by_name():
    assert robust_kernel("cauchy", 1.5) == Cauchy(1.5)
    assert robust_kernel("none") == Quadratic()
    with pytest.raises(ConfigError, match="one of none, cauchy"):
        robust_kernel("tukey")
    with pytest.raises(ConfigError, match="above 0"):
        robust_kernel("huber", -1.0)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_reprojection_gradients(kernel):
    s = scene()
    loss = ReprojectionLoss(sigma=torch.tensor([0.5, 1.0, 2.0, 1.5]), weight=0.7, kernel=kernel)
    inputs = [s[name].clone().requires_grad_() for name in ("points", "rotations", "translations", "keypoints", "confidence")]

    def value(points: Tensor, rotations: Tensor, translations: Tensor, keypoints: Tensor, confidence: Tensor) -> Tensor:
        return loss(points, rotations, translations, keypoints, s["intrinsics"], confidence)

    inputs[3].data[0, 1, 2] = 1e3
    assert torch.autograd.gradcheck(value, inputs)


def test_reprojection_of_unseen_and_unknown_points_is_zero_with_zero_gradient():
    s = scene()
    points = s["points"].clone()
    points[3, 1] = torch.nan
    points.requires_grad_()
    value = ReprojectionLoss()(points, s["rotations"], s["translations"], s["keypoints"], s["intrinsics"])
    value.backward()
    assert value.isfinite()
    assert points.grad.isfinite().all()
    assert (points.grad[3, 1] == 0).all()


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_reprojection_linearised(kernel):
    """Gradient and Gauss-Newton block of every keypoint against autograd on the weighted residuals."""
    s = scene()
    sigma = torch.tensor([0.5, 1.0, 2.0, 1.5], dtype=torch.float64)
    loss = ReprojectionLoss(sigma, weight=0.7, kernel=kernel)
    seen = s["keypoints"].isfinite().all(-1)
    information = (torch.where(seen, s["confidence"], 0.0) / sigma**2).flatten(1)
    columns = s["points"].reshape(-1, 3).mT
    pixels = s["keypoints"].nan_to_num().movedim(-1, 1).flatten(2)
    points_cam = s["rotations"] @ columns + s["translations"][..., None]
    terms = loss.linearise(points_cam, s["rotations"], pixels, information, s["intrinsics"])

    value = loss(s["points"], s["rotations"], s["translations"], s["keypoints"], s["intrinsics"], s["confidence"])
    torch.testing.assert_close(terms.cost, value)

    repeated = s["points"].expand(C, F, P, 3).clone().requires_grad_()
    lenses = s["intrinsics"]
    by_camera = zip(s["rotations"], s["translations"], s["keypoints"], lenses.matrix, lenses.distortion, strict=True)
    residuals = torch.cat(
        [
            reprojection_residuals(
                points, rotation[None], translation[None], pixels[None], Intrinsics(matrix[None], lens[None])
            )
            for points, (rotation, translation, pixels, matrix, lens) in zip(repeated, by_camera, strict=True)
        ]
    )
    rows = torch.stack([torch.autograd.grad(residuals[..., k].sum(), repeated, retain_graph=True)[0] for k in (0, 1)], dim=-2)
    whitened = residuals.detach().square().sum(-1) * s["confidence"] / sigma**2
    weights = 0.7 * kernel.weight(whitened) * torch.where(seen, s["confidence"], 0.0) / sigma**2
    hessian = torch.einsum("cfpki,cfpkj,cfp->cfpij", rows, rows, weights).flatten(1, 2)
    gradient = torch.einsum("cfpki,cfpk,cfp->cfpi", rows, residuals.detach(), weights).flatten(1, 2)
    torch.testing.assert_close(terms.gradient.movedim(1, -1), gradient)
    entries = torch.stack([hessian[..., i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))], dim=1)
    torch.testing.assert_close(terms.hessian, entries)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_stick_length(kernel):
    loss = StickLengthLoss(sigma=0.1, weight=0.4, kernel=kernel)
    starts, ends = random(F, 2, 3).requires_grad_(), random(F, 2, 3, seed=5).requires_grad_()
    lengths = torch.tensor([1.0, 1.2], dtype=torch.float64)
    assert torch.autograd.gradcheck(lambda a, b: loss(a, b, lengths), (starts, ends))

    points = torch.cat([starts, ends], dim=1).detach().movedim(-1, 0)
    sticks = torch.tensor([[0, 2], [1, 3]])
    terms = loss.linearise(points, sticks, lengths[None], torch.ones(F, 4, dtype=torch.bool))
    value = loss(starts, ends, lengths)
    torch.testing.assert_close(terms.cost, value.detach())
    by_starts, by_ends = torch.autograd.grad(value, (starts, ends))
    torch.testing.assert_close(2 * terms.gradient.movedim(1, -1), torch.stack([by_starts, by_ends]))


def test_stick_length_closed_form_and_degenerate_stick():
    start, end = torch.zeros(1, 3, dtype=torch.float64), torch.tensor([[3.0, 4.0, 0.0]], dtype=torch.float64)
    assert StickLengthLoss()(start, end, 4.0).item() == pytest.approx(1.0)
    start.requires_grad_()
    StickLengthLoss()(start, torch.zeros_like(start), 4.0).backward()
    assert start.grad.isfinite().all()
    gone = torch.full((1, 3), torch.nan)
    assert StickLengthLoss()(gone, end, 4.0) == 0


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_smoothness(kernel):
    loss = SmoothnessLoss(sigma=torch.tensor([0.5, 1.0, 2.0, 3.0]), weight=0.2, kernel=kernel)
    points = random(F, P, 3).requires_grad_()
    assert torch.autograd.gradcheck(loss, points)

    terms = loss.linearise(points.detach().movedim(-1, 0), torch.ones(F, P, dtype=torch.bool))
    value = loss(points)
    torch.testing.assert_close(terms.cost, value.detach())
    gradient = torch.zeros(3, F, P, dtype=torch.float64)
    for offset, factor in enumerate((1.0, -2.0, 1.0)):
        gradient[:, offset : offset + F - 2] += 2 * factor * terms.scale * terms.residual
    torch.testing.assert_close(gradient.movedim(0, -1), torch.autograd.grad(value, points)[0])


def test_smoothness_is_zero_at_constant_speed_and_skips_gaps():
    time = torch.arange(6, dtype=torch.float64)[:, None, None]
    line = time * torch.tensor([1.0, -2.0, 0.5], dtype=torch.float64)
    assert SmoothnessLoss()(line).item() < 1e-24
    bent = line.clone()
    bent[3] += 1.0
    assert SmoothnessLoss()(bent).item() == pytest.approx(3 * (1 + 4 + 1))
    bent[3] = torch.nan
    bent.requires_grad_()
    SmoothnessLoss()(bent).backward()
    assert bent.grad.isfinite().all()


def test_float32_comes_back_as_float32():
    points = random(F, P, 3).float()
    assert SmoothnessLoss(sigma=torch.tensor(0.1, dtype=torch.float64))(points).dtype == torch.float32


def test_the_folder_is_refused_under_its_own_name():
    root = Path(__file__).parents[1]
    run = subprocess.run([sys.executable, "-c", "import losses"], cwd=root, capture_output=True, text=True, check=False)
    assert run.returncode != 0
    assert "import torchstickcal.losses" in run.stderr


LENSES = {
    "perfect": (0, False),
    "standard": (5, False),
    "rational": (8, False),
    "prism": (12, False),
    "tilted": (14, False),
    "fisheye": (4, True),
}


def arguments(dtype: torch.dtype) -> list[Any]:
    s = scene()
    tensors = [s[name].to(dtype) for name in ("points", "rotations", "translations", "keypoints")]
    return [*tensors, s["intrinsics"].to(dtype)]


COMPUTED: dict[str, Callable[[torch.dtype], Tensor]] = {
    "ReprojectionLoss": lambda dtype: ReprojectionLoss()(*arguments(dtype)),
    "ReprojectionLoss.forward": lambda dtype: ReprojectionLoss().forward(*arguments(dtype)),
    "reprojection_residuals": lambda dtype: reprojection_residuals(*arguments(dtype)),
    "StickLengthLoss": lambda dtype: StickLengthLoss(0.1)(random(F, 3).to(dtype), random(F, 3, seed=1).to(dtype), 1.15),
    "StickLengthLoss.of_session": lambda dtype: StickLengthLoss(0.1).of_session(
        random(F, P, 3).to(dtype), torch.tensor([[0, 1]]), torch.tensor([[1.15]])
    ),
    "stick_lengths": lambda dtype: stick_lengths(random(F, 3).to(dtype), random(F, 3, seed=1).to(dtype)),
    "SmoothnessLoss": lambda dtype: SmoothnessLoss(0.01)(random(F, P, 3).to(dtype)),
    "second_differences": lambda dtype: second_differences(random(F, P, 3).to(dtype)),
    "Extrinsics": lambda dtype: torch.cat([v.flatten() for v in Extrinsics(*arguments(dtype)[1:3])()]),
    "Extrinsics.to": lambda dtype: torch.cat([v.flatten() for v in Extrinsics(*arguments(torch.float32)[1:3]).to(dtype)()]),
    "Extrinsics.compose": lambda dtype: Extrinsics(*arguments(dtype)[1:3]).compose(random(C - 1, 6).to(dtype))[0],
}


@pytest.mark.parametrize("name", COMPUTED)
def test_nothing_is_computed_below_float32(name: str):
    """Neither in an autocast region nor with half-precision input, whose values are exact."""
    compute = COMPUTED[name]
    for dtype in (torch.float16, torch.bfloat16, torch.float32, torch.float64):
        expected = compute(dtype)
        assert expected.dtype == (torch.float64 if dtype == torch.float64 else torch.float32)
        for cast in (torch.bfloat16, torch.float16):
            with torch.autocast("cpu", dtype=cast):
                assert torch.equal(compute(dtype), expected)


def test_integers_and_mixed_precisions_are_computed_in_the_highest():
    points, rotations, translations, keypoints, cameras = arguments(torch.float64)
    expected = ReprojectionLoss()(points, rotations, translations, keypoints, cameras)
    mixed = ReprojectionLoss()(points.float(), rotations, translations.float(), keypoints, cameras.to(torch.float32))
    assert mixed.dtype == torch.float64
    torch.testing.assert_close(mixed, expected, rtol=1e-4, atol=0)
    ends = torch.zeros(1, 3, dtype=torch.long), torch.tensor([[0, 3, 4]])
    assert StickLengthLoss()(*ends, 4.5).item() == pytest.approx(0.25)


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
@pytest.mark.parametrize("lens", LENSES)
def test_reprojection_of_points_in_every_place_has_finite_gradients(kernel, lens: str):
    places = [[0, 0, 0], [1, 0, 0], [0, 0, -0.0], [1e4, 3, 0], [0, 0, -3], [0.1, 0.2, -3], [0.3, 0.1, 1e-9], [0.3, 0.1, -1e-5]]
    places += [[1, 1, 1e-3], [100, 100, 1e-3], [1e10, 1e10, 1e10], [0, 0, 5], [0.1, 0.1, 4]]
    coefficients, fisheye = LENSES[lens]
    for dtype in (torch.float32, torch.float64):
        matrix = torch.tensor([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]], dtype=dtype)[None].requires_grad_()
        distortion = torch.full((1, coefficients), 0.01, dtype=dtype).requires_grad_() if coefficients else None
        points = torch.tensor([places], dtype=dtype).requires_grad_()
        rotation, translation = (
            torch.eye(3, dtype=dtype)[None].requires_grad_(),
            torch.zeros(1, 3, dtype=dtype).requires_grad_(),
        )
        keypoints = torch.full((1, 1, len(places), 2), 500.0, dtype=dtype).requires_grad_()
        given = [points, rotation, translation, keypoints, matrix, *([] if distortion is None else [distortion])]
        cameras = Intrinsics(matrix, distortion, fisheye)
        value = ReprojectionLoss(0.5, kernel=kernel)(points, rotation, translation, keypoints, cameras)
        assert value.isfinite()
        assert all(gradient.isfinite().all() for gradient in torch.autograd.grad(value, given))


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
@pytest.mark.parametrize("missing", [torch.nan, torch.inf])
def test_what_is_missing_has_no_gradient(kernel, missing: float):
    points, rotations, translations, keypoints, cameras = arguments(torch.float64)
    keypoints[0, 1, 2], keypoints[1, 0, 0, 1], points[3, 1] = missing, missing, missing
    confidence = torch.ones(C, F, P).where(keypoints.isfinite().all(-1), missing).requires_grad_()
    points.requires_grad_()
    keypoints.requires_grad_()
    value = ReprojectionLoss(kernel=kernel)(points, rotations, translations, keypoints, cameras, confidence)
    value = value + SmoothnessLoss(0.1, kernel=kernel)(points) + StickLengthLoss(kernel=kernel)(points[:, 1], points[:, 2], 1.0)
    value.backward()
    assert value.isfinite()
    for tensor in (points, keypoints, confidence):
        assert tensor.grad.isfinite().all()
    assert not keypoints.grad[0, 1, 2].any()
    assert not keypoints.grad[1, 0, 0].any()
    assert not points.grad[3, 1].any()


@pytest.mark.parametrize("kernel", KERNELS, ids=lambda k: type(k).__name__)
def test_points_at_rest_and_sticks_without_length_have_finite_gradients(kernel):
    for dtype in (torch.float16, torch.float32, torch.float64):
        points = torch.zeros(F, P, 3, dtype=dtype).requires_grad_()
        value = SmoothnessLoss(0.01, kernel=kernel)(points) + StickLengthLoss(0.1, kernel=kernel)(
            points[:, 0], points[:, 1], 1.0
        )
        value.backward()
        assert value.isfinite()
        assert points.grad.isfinite().all()


@pytest.mark.parametrize("value", [0, -1.0, "x", None, float("nan"), 10**400, [1.0]])
def test_unusable_kernel_scales_and_sigmas_are_refused(value: Any):
    for kernel in (Cauchy, Huber, GemanMcClure):
        with pytest.raises(ConfigError, match="kernel scale is not usable"):
            kernel(value)
    if value != [1.0]:
        with pytest.raises((ConfigError, ObservationError), match="sigma"):
            ReprojectionLoss(value)
