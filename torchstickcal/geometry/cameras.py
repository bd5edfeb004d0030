"""Camera intrinsics: pinhole with OpenCV's lens models, exact in both directions.

Pixels have their centres at integer coordinates, cameras look along +z (OpenCV). The two lens models of OpenCV are
covered: rational with tangential terms (4, 5 or 8 coefficients ``k1 k2 p1 p2 [k3 [k4 k5 k6]]``) and the fisheye model of
Kannala and Brandt (4 coefficients). Both have a symmetric 2 x 2 Jacobian, kept as its three distinct entries.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import torch
from torch import Tensor

_MAX_INVERSE_DEPTH = 1e6
_FOLD_SEARCH_RADIUS = 8.0
_FOLD_SEARCH_STEPS = 4096
_UNDISTORT_ITERATIONS = 50
_UNDISTORT_TOLERANCE = 1e-13


class Distorted(NamedTuple):
    """A lens applied to normalised coordinates (u, v), with the derivative of the result."""

    u: Tensor
    v: Tensor
    du_du: Tensor
    du_dv: Tensor
    dv_dv: Tensor


class PixelMap(NamedTuple):
    """Pixels of normalised coordinates, with derivatives; (..., C, N), or (..., C, 1) where one is the same for all."""

    x: Tensor
    y: Tensor
    dx_du: Tensor
    dx_dv: Tensor
    dy_du: Tensor
    dy_dv: Tensor

    def moved(self, u: Tensor, v: Tensor, inverse_depth: Tensor, step: Tensor) -> tuple[Tensor, Tensor]:
        """How the pixels (x, y) move where the points there, in the cameras' frames, move by a step (..., C, 3, N)."""
        dx, dy, dz = step.unbind(-2)
        du, dv = (dx - u * dz) * inverse_depth, (dy - v * dz) * inverse_depth
        return self.dx_du * du + self.dx_dv * dv, self.dy_du * du + self.dy_dv * dv


@dataclass(frozen=True)
class Intrinsics:
    """The intrinsics of C cameras, or of C cameras in each of several sessions: any leading dimensions before C.

    Args:
        matrix: camera matrices K, (..., C, 3, 3), pixels.
        distortion: lens coefficients in OpenCV's order, (..., C, 4 | 5 | 8), or None for a perfect lens.
        fisheye: whether ``distortion`` (..., C, 4) is of OpenCV's fisheye model.
    """

    matrix: Tensor
    distortion: Tensor | None = None
    fisheye: bool = False

    def to(self, *args: object, **kwargs: object) -> Intrinsics:
        """The same cameras on another device or in another dtype (arguments of ``Tensor.to``)."""
        distortion = None if self.distortion is None else self.distortion.to(*args, **kwargs)  # type: ignore[call-overload]
        return Intrinsics(self.matrix.to(*args, **kwargs), distortion, self.fisheye)  # type: ignore[call-overload]

    def __getitem__(self, index: int | slice | list[int] | Tensor) -> Intrinsics:
        """Those at an index of the first dimension."""
        return Intrinsics(self.matrix[index], None if self.distortion is None else self.distortion[index], self.fisheye)

    def batched(self) -> Intrinsics:
        """The cameras of one session as those of a batch of one."""
        return Intrinsics(self.matrix[None], None if self.distortion is None else self.distortion[None], self.fisheye)

    @property
    def focal_px(self) -> Tensor:
        """Mean focal length of each camera, (..., C), pixels."""
        return (self.matrix[..., 0, 0] + self.matrix[..., 1, 1]) / 2

    def project(self, points_cam: Tensor) -> Tensor:
        """Pixels (..., C, ..., 2) of points (..., C, ..., 3) in the cameras' own frames, metres."""
        return torch.stack(self.project_components(*points_cam.unbind(-1)), dim=-1)

    def project_components(self, x: Tensor, y: Tensor, z: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates of points given as three tensors (..., C, ...)."""
        inverse_depth = inverse_depths(z)
        return self.pixels(x * inverse_depth, y * inverse_depth)

    def pixels(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Pixel coordinates of normalised coordinates, two tensors (..., C, ...)."""
        return self._to_pixels(*self.distort(u, v))

    def pixels_with_jacobian(self, u: Tensor, v: Tensor) -> PixelMap:
        """Pixel coordinates of normalised coordinates (..., C, N), with their derivatives."""
        fx, skew, _, fy, _ = self._pixel_map(u.ndim)
        if self.distortion is None:
            return PixelMap(*self._to_pixels(u, v), fx, skew, torch.zeros_like(fx), fy)
        lens = self.distort_with_jacobian(u, v)
        return PixelMap(
            *self._to_pixels(lens.u, lens.v),
            dx_du=fx * lens.du_du + skew * lens.du_dv,
            dx_dv=fx * lens.du_dv + skew * lens.dv_dv,
            dy_du=fy * lens.du_dv,
            dy_dv=fy * lens.dv_dv,
        )

    def pixel_curvature(self, u: Tensor, v: Tensor, along_x: Tensor, along_y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Second derivatives uu, uv, vv of ``along_x x + along_y y``, pixels (x, y) of normalised coordinates (..., C, N)."""
        if self.distortion is None:
            zero = torch.zeros_like(u)
            return zero, zero, zero
        with torch.enable_grad():
            u, v = u.detach().requires_grad_(), v.detach().requires_grad_()
            m = self.pixels_with_jacobian(u, v)
            by_u, by_v = along_x * m.dx_du + along_y * m.dy_du, along_x * m.dx_dv + along_y * m.dy_dv
            uu, uv = torch.autograd.grad(by_u.sum(), (u, v), retain_graph=True)
            (vv,) = torch.autograd.grad(by_v.sum(), v)
        return uu, uv, vv

    def pixels_by_radial(self, u: Tensor, v: Tensor, order: int) -> tuple[Tensor, Tensor]:
        """Derivatives of the pixels of normalised coordinates (..., C, N) by the radial coefficient k1 (order 1) or k2."""
        fx, skew, _, fy, _ = self._pixel_map(u.ndim)
        r2 = u * u + v * v
        if self.fisheye:
            r = r2.clamp_min(1e-16).sqrt()
            growth = r.atan() ** (2 * order + 1) / r
        else:
            growth = r2**order
            if self._has_denominator:
                *_, k4, k5, k6 = self._coefficients(u.ndim)
                growth = growth / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (fx * u + skew * v) * growth, fy * v * growth

    def distort(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the lenses to normalised coordinates, two tensors (..., C, ...)."""
        if self.distortion is None:
            return u, v
        if self.fisheye:
            scale, _ = self._fisheye(u, v)
            return scale * u, scale * v
        radial, _, p1, p2, r2 = self._rational(u, v)
        uv = 2 * u * v
        return u * radial + p1 * uv + p2 * (r2 + 2 * u * u), v * radial + p1 * (r2 + 2 * v * v) + p2 * uv

    def distort_with_jacobian(self, u: Tensor, v: Tensor) -> Distorted:
        """:meth:`distort` with its symmetric Jacobian."""
        if self.distortion is None:
            one, zero = torch.ones_like(u), torch.zeros_like(u)
            return Distorted(u, v, one, zero, one)
        if self.fisheye:
            scale, slope = self._fisheye(u, v)
            return Distorted(scale * u, scale * v, scale + slope * u * u, slope * u * v, scale + slope * v * v)
        radial, slope, p1, p2, r2 = self._rational(u, v)
        uv = 2 * u * v
        return Distorted(
            u * radial + p1 * uv + p2 * (r2 + 2 * u * u),
            v * radial + p1 * (r2 + 2 * v * v) + p2 * uv,
            radial + 2 * slope * u * u + 2 * p1 * v + 6 * p2 * u,
            slope * uv + 2 * p1 * u + 2 * p2 * v,
            radial + 2 * slope * v * v + 6 * p1 * v + 2 * p2 * u,
        )

    def undistort(self, pixels: Tensor) -> Tensor:
        """Normalised coordinates (..., C, ..., 2) of pixels (..., C, ..., 2), by Newton's method run to convergence.

        NaN where the pixel is NaN and where no point in front of the lens maps to it: beyond the radius at which the
        lens model folds back.
        """
        fx, skew, cx, fy, cy = self._pixel_map(pixels.ndim - 1)
        v_target = (pixels[..., 1] - cy) / fy
        u_target = (pixels[..., 0] - cx - skew * v_target) / fx
        if self.distortion is None:
            return torch.stack([u_target, v_target], dim=-1)
        u, v = u_target.clone(), v_target.clone()
        for _ in range(_UNDISTORT_ITERATIONS):
            lens = self.distort_with_jacobian(u, v)
            error_u, error_v = lens.u - u_target, lens.v - v_target
            determinant = lens.du_du * lens.dv_dv - lens.du_dv**2
            determinant = torch.where(determinant.abs() < 1e-3, torch.full_like(determinant, 1e-3), determinant)
            u = u - (lens.dv_dv * error_u - lens.du_dv * error_v) / determinant
            v = v - (lens.du_du * error_v - lens.du_dv * error_u) / determinant
            if not bool((torch.maximum(error_u.abs(), error_v.abs()) > _UNDISTORT_TOLERANCE).any()):
                break
        back_u, back_v = self.distort(u, v)
        fold_radius = _broadcast(self._fold_radius, u.ndim)
        solved = ((back_u - u_target).abs() + (back_v - v_target).abs() < 1e-9) & (u * u + v * v < fold_radius**2)
        return torch.where(solved[..., None], torch.stack([u, v], dim=-1), torch.nan)

    def _pixel_map(self, ndim: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """fx, skew, cx, fy, cy, each (..., C, 1, ...) for coordinates of ``ndim`` dimensions."""
        fx, skew, cx, _, fy, cy, *_ = _broadcast(self.matrix.flatten(-2).movedim(-1, 0), ndim + 1)
        return fx, skew, cx, fy, cy

    def _to_pixels(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        fx, skew, cx, fy, cy = self._pixel_map(u.ndim)
        return fx * u + skew * v + cx, fy * v + cy

    @property
    def _has_denominator(self) -> bool:
        return self.distortion is not None and self.distortion.shape[-1] > 5

    def _coefficients(self, ndim: int) -> list[Tensor]:
        assert self.distortion is not None
        padding = 0 if self.fisheye else 8 - self.distortion.shape[-1]
        padded = torch.nn.functional.pad(self.distortion, (0, padding))
        return list(_broadcast(padded.movedim(-1, 0), ndim + 1))

    def _rational(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Radial factor, its derivative by r^2, p1, p2 and r^2."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients(u.ndim)
        r2 = u * u + v * v
        numerator = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        numerator_slope = k1 + r2 * (2 * k2 + 3 * r2 * k3)
        if not self._has_denominator:
            return numerator, numerator_slope, p1, p2, r2
        denominator = 1 + r2 * (k4 + r2 * (k5 + r2 * k6))
        radial = numerator / denominator
        denominator_slope = k4 + r2 * (2 * k5 + 3 * r2 * k6)
        return radial, (numerator_slope - radial * denominator_slope) / denominator, p1, p2, r2

    def _fisheye(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Scale ``theta_d / r`` and its derivative by r, divided by r."""
        k1, k2, k3, k4 = self._coefficients(u.ndim)
        r2 = (u * u + v * v).clamp_min(1e-16)
        r = r2.sqrt()
        theta = r.atan()
        t2 = theta * theta
        theta_d = theta * (1 + t2 * (k1 + t2 * (k2 + t2 * (k3 + t2 * k4))))
        slope = 1 + t2 * (3 * k1 + t2 * (5 * k2 + t2 * (7 * k3 + t2 * 9 * k4)))
        scale = theta_d / r
        return scale, (slope / (1 + r2) - scale) / r2

    @cached_property
    def _fold_radius(self) -> Tensor:
        """Normalised radius (..., C) up to which the radial model is one-to-one."""
        radii = torch.linspace(0, _FOLD_SEARCH_RADIUS, _FOLD_SEARCH_STEPS, dtype=self.matrix.dtype)
        radii = radii.to(self.matrix.device).expand(*self.matrix.shape[:-2], -1)
        if self.fisheye:
            scale, slope = self._fisheye(radii, torch.zeros_like(radii))
            growth = scale + slope * radii**2
        else:
            radial, slope, *_ = self._rational(radii, torch.zeros_like(radii))
            growth = radial + 2 * slope * radii**2
        folded = (growth <= 0) | ~growth.isfinite()
        limits = torch.where(folded, radii, torch.inf)
        return limits.amin(dim=-1)


def inverse_depths(depth: Tensor) -> Tensor:
    """1 / z, bounded where z is nearly 0."""
    return depth.reciprocal().clamp(-_MAX_INVERSE_DEPTH, _MAX_INVERSE_DEPTH)


def _broadcast(per_camera: Tensor, ndim: int) -> Tensor:
    """A tensor of values per camera with dimensions of 1 appended, ``ndim`` dimensions in all."""
    return per_camera.reshape(*per_camera.shape, *[1] * (ndim - per_camera.ndim))
