"""Camera intrinsics: pinhole with OpenCV's lens models, exact in both directions, with derivatives in closed form.

Pixels have their centres at integer coordinates, cameras look along +z (OpenCV). Both lens models of OpenCV are covered: the
standard one with 4, 5, 8, 12 or 14 coefficients ``k1 k2 p1 p2 [k3 [k4 k5 k6 [s1 s2 s3 s4 [tx ty]]]]`` (radial, tangential,
thin prism, tilted sensor), and the fisheye model of Kannala and Brandt with 4. The same projection from kornia's functions, for
autograd, is :mod:`torchstickcal.geometry.projection`.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

import torch
from torch import Tensor

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import ObservationError
from torchstickcal.inference import differentiates
from torchstickcal.lazy import cached_property
from torchstickcal.precision import at_least_float32
from torchstickcal.shapes import extended

if TYPE_CHECKING:
    from kornia.geometry.camera import PinholeCamera

_MIN_DEPTH = 1e-6
_FOLD_SEARCH_RADIUS = 8.0
_FOLD_SEARCH_STEPS = 4096
_UNDISTORT_ITERATIONS = 50
_UNDISTORT_TOLERANCE = 1e-13
_UNDISTORT_ROUNDING = 32.0
"""Rounding of the distortion, in units of the last place."""


class Distorted(NamedTuple):
    """A lens applied to normalised coordinates (u, v), with the derivative of the result."""

    u: Tensor
    v: Tensor
    du_du: Tensor
    du_dv: Tensor
    dv_du: Tensor
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
        distortion: lens coefficients in OpenCV's order, (..., C, 4 | 5 | 8 | 12 | 14), or None for a perfect lens.
        fisheye: whether ``distortion`` (..., C, 4) is of OpenCV's fisheye model.

    Example:
        >>> import torch
        >>> matrix = torch.tensor([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]])
        >>> cameras = Intrinsics(matrix.expand(2, 3, 3), torch.tensor([[-0.1, 0, 0, 0]]).expand(2, 4))
        >>> pixels = cameras.project(torch.tensor([0.2, 0.1, 2.0]).expand(2, 1, 3))
        >>> pixels[0, 0]
        tensor([1059.8750,  589.9375])
        >>> cameras.undistort(pixels)[0, 0]
        tensor([0.1000, 0.0500])
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

    def to_kornia(self, image_size: Any, rotations: Tensor | None = None, translations: Tensor | None = None) -> PinholeCamera:
        """The C cameras of one session as kornia's.

        Args:
            image_size: width and height, (2,) or (C, 2), pixels.
            rotations: (C, 3, 3), world to camera; None for the identity.
            translations: (C, 3), world to camera, metres; None for zero.

        Raises:
            ObservationError: if the lenses are distorted, which kornia's camera cannot hold, or the image size is none.

        Example:
            >>> import torch
            >>> matrix = torch.tensor([[1000.0, 0, 960], [0, 1000, 540], [0, 0, 1]])
            >>> camera = Intrinsics(matrix[None]).to_kornia(torch.tensor([1920, 1080]))
            >>> camera.project(torch.tensor([[[0.2, 0.1, 2.0]]]))
            tensor([[[1060.,  590.]]])
        """
        from kornia.geometry.camera import PinholeCamera

        if self.distortion is not None and bool(self.distortion.any()):
            raise ObservationError(
                "a distorted lens does not fit into kornia's PinholeCamera",
                where="Intrinsics.to_kornia",
                got="distortion that is not zero",
                expected="perfect lenses",
                remedy="Undistort the keypoints (Intrinsics.undistort), then convert Intrinsics(matrix) without distortion.",
            )
        size = tensor_of(image_size, "image_size").to(self.matrix)
        if tuple(size.shape) not in {(2,), (len(self.matrix), 2)}:
            expected = f"(2,) or ({len(self.matrix)}, 2): width, height in pixels"
            raise ObservationError("image size is not usable", where="image_size", got=size.tolist(), expected=expected)
        matrix = torch.eye(4).to(self.matrix).repeat(len(self.matrix), 1, 1)
        pose = matrix.clone()
        matrix[:, :3, :3] = self.matrix
        if rotations is not None:
            pose[:, :3, :3] = rotations
        if translations is not None:
            pose[:, :3, 3] = translations
        width, height = size.expand(len(matrix), 2).unbind(-1)
        return PinholeCamera(matrix, pose, height, width)

    @staticmethod
    def from_kornia(camera: PinholeCamera) -> Intrinsics:
        """The intrinsics of kornia's cameras."""
        return Intrinsics(camera.camera_matrix)

    @property
    def focal_px(self) -> Tensor:
        """Mean focal length of each camera, (..., C), pixels."""
        return (self.matrix[..., 0, 0] + self.matrix[..., 1, 1]) / 2

    def project(self, points_cam: Tensor) -> Tensor:
        """Pixels (..., C, ..., 2) of points (..., C, ..., 3) in the cameras' own frames, metres."""
        return torch.stack(self.project_components(*at_least_float32(points_cam).unbind(-1)), dim=-1)

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
            dx_du=torch.addcmul(fx * lens.du_du, skew, lens.dv_du),
            dx_dv=torch.addcmul(fx * lens.du_dv, skew, lens.dv_dv),
            dy_du=fy * lens.dv_du,
            dy_dv=fy * lens.dv_dv,
        )

    def pixel_curvature(self, u: Tensor, v: Tensor, along_x: Tensor, along_y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Second derivatives uu, uv, vv of ``along_x x + along_y y``, pixels (x, y) of normalised coordinates (..., C, N)."""
        if self.distortion is None:
            zero = torch.zeros_like(u)
            return zero, zero, zero
        if self.fisheye or self._has_denominator:
            return self._curvature_by_autograd(u, v, along_x, along_y)
        fx, skew, _, fy, _ = self._pixel_map(u.ndim)
        _, k2, p1, p2, k3, *_ = self._coefficients(u.ndim)
        _, slope, _, _, r2 = self._rational(u, v)
        a, b = along_x * fx, torch.addcmul(along_y * fy, along_x, skew)
        # Along u the scale of the lens has the second derivative by_u, along v it has by_v; what is mixed is the same for both.
        bend, twice_slope = _polynomial(r2, 8 * k2, 24 * k3), 2 * slope
        by_u, by_v = (torch.addcmul(twice_slope, bend, x * x) for x in (u, v))
        mixed_u, mixed_v = torch.addcmul(2 * p1, v, by_u), torch.addcmul(2 * p2, u, by_v)
        own_u = torch.addcmul(6 * p2, u, torch.add(by_u, twice_slope, alpha=2))
        own_v = torch.addcmul(6 * p1, v, torch.add(by_v, twice_slope, alpha=2))
        return (
            torch.addcmul(a * own_u, b, mixed_u),
            torch.addcmul(a * mixed_u, b, mixed_v),
            torch.addcmul(a * mixed_v, b, own_v),
        )

    @differentiates
    def _curvature_by_autograd(self, u: Tensor, v: Tensor, along_x: Tensor, along_y: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """:meth:`pixel_curvature` of any lens."""
        u, v = u.detach().requires_grad_(), v.detach().requires_grad_()
        m = self.pixels_with_jacobian(u, v)
        by_u, by_v = along_x * m.dx_du + along_y * m.dy_du, along_x * m.dx_dv + along_y * m.dy_dv
        uu, uv = torch.autograd.grad(by_u.sum(), (u, v), retain_graph=True)
        (vv,) = torch.autograd.grad(by_v.sum(), v)
        return uu, uv, vv

    def pixels_by_radial(self, u: Tensor, v: Tensor, order: int) -> tuple[Tensor, Tensor]:
        """Derivatives of the pixels of normalised coordinates (..., C, N) by the radial coefficient k1 (order 1) or k2.

        Not for tilted sensors.
        """
        fx, skew, _, fy, _ = self._pixel_map(u.ndim)
        r2 = u * u + v * v
        if self.fisheye:
            r = r2.clamp_min(1e-16).sqrt()
            growth = r.atan() ** (2 * order + 1) / r
        else:
            growth = r2**order
            if self._has_denominator:
                k4, k5, k6 = self._coefficients(u.ndim)[5:8]
                growth = growth / (1 + r2 * (k4 + r2 * (k5 + r2 * k6)))
        return (fx * u + skew * v) * growth, fy * v * growth

    def distort(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the lenses to normalised coordinates, two tensors (..., C, ...)."""
        if self.distortion is None:
            return u, v
        if self.fisheye:
            scale, _ = self._fisheye(u, v)
            return scale * u, scale * v
        radial, _, p1, p2, r2 = self._rational(u, v, slope=False)
        scale = torch.addcmul(torch.addcmul(radial, 2 * p1, v), 2 * p2, u)
        distorted = torch.addcmul(p2 * r2, u, scale), torch.addcmul(p1 * r2, v, scale)
        if self._has_prism:
            s1, s2, s3, s4 = self._coefficients(u.ndim)[8:12]
            distorted = distorted[0] + r2 * (s1 + r2 * s2), distorted[1] + r2 * (s3 + r2 * s4)
        return self._tilted(*distorted)[:2] if self.is_tilted else distorted

    def distort_with_jacobian(self, u: Tensor, v: Tensor) -> Distorted:
        """:meth:`distort` with its Jacobian."""
        if self.distortion is None:
            one, zero = torch.ones_like(u), torch.zeros_like(u)
            return Distorted(u, v, one, zero, zero, one)
        if self.fisheye:
            scale, slope = self._fisheye(u, v)
            mixed = slope * u * v
            return Distorted(scale * u, scale * v, scale + slope * u * u, mixed, mixed, scale + slope * v * v)
        radial, slope, p1, p2, r2 = self._rational(u, v)
        twice_p1, twice_p2 = 2 * p1, 2 * p2
        scale = torch.addcmul(torch.addcmul(radial, twice_p1, v), twice_p2, u)
        twice_slope = 2 * slope
        along_u, along_v = twice_slope * u, twice_slope * v
        mixed = torch.addcmul(torch.addcmul(along_u * v, twice_p1, u), twice_p2, v)
        found = Distorted(
            torch.addcmul(p2 * r2, u, scale),
            torch.addcmul(p1 * r2, v, scale),
            torch.addcmul(scale, u, along_u + 2 * twice_p2),
            mixed,
            mixed,
            torch.addcmul(scale, v, along_v + 2 * twice_p1),
        )
        if self._has_prism:
            found = self._with_prism(u, v, r2, found)
        return self._tilted_with_jacobian(found) if self.is_tilted else found

    def _with_prism(self, u: Tensor, v: Tensor, r2: Tensor, found: Distorted) -> Distorted:
        """Add the thin-prism terms at normalised coordinates."""
        s1, s2, s3, s4 = self._coefficients(u.ndim)[8:12]
        by_u, by_v = 2 * (s1 + 2 * r2 * s2), 2 * (s3 + 2 * r2 * s4)
        return Distorted(
            found.u + r2 * (s1 + r2 * s2),
            found.v + r2 * (s3 + r2 * s4),
            found.du_du + by_u * u,
            found.du_dv + by_u * v,
            found.dv_du + by_v * u,
            found.dv_dv + by_v * v,
        )

    def _tilted(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Distorted coordinates on a tilted sensor, and the depth by which they were divided."""
        xx, xy, xz, yx, yy, yz, zx, zy, zz = extended(self._tilt.flatten(-2).movedim(-1, 0), u.ndim + 1)
        depth = zx * u + zy * v + zz
        return (xx * u + xy * v + xz) / depth, (yx * u + yy * v + yz) / depth, depth

    def _tilted_with_jacobian(self, lens: Distorted) -> Distorted:
        xx, xy, _, yx, yy, _, zx, zy, _ = extended(self._tilt.flatten(-2).movedim(-1, 0), lens.u.ndim + 1)
        u, v, depth = self._tilted(lens.u, lens.v)
        a, b = (xx - u * zx) / depth, (xy - u * zy) / depth
        c, d = (yx - v * zx) / depth, (yy - v * zy) / depth
        return Distorted(
            u,
            v,
            a * lens.du_du + b * lens.dv_du,
            a * lens.du_dv + b * lens.dv_dv,
            c * lens.du_du + d * lens.dv_du,
            c * lens.du_dv + d * lens.dv_dv,
        )

    def undistort(self, pixels: Tensor) -> Tensor:
        """Normalised coordinates (..., C, ..., 2) of pixels (..., C, ..., 2), by Newton's method run to convergence.

        NaN where the pixel is NaN and where no point in front of the lens maps to it: beyond the radius at which the
        lens model folds back.
        """
        pixels = at_least_float32(pixels)
        fx, skew, cx, fy, cy = self._pixel_map(pixels.ndim - 1)
        v_target = (pixels[..., 1] - cy) / fy
        u_target = (pixels[..., 0] - cx - skew * v_target) / fx
        if self.distortion is None:
            return torch.stack([u_target, v_target], dim=-1)
        u, v = u_target.clone(), v_target.clone()
        rounding = _UNDISTORT_ROUNDING * torch.finfo(u.dtype).eps
        tolerance = max(_UNDISTORT_TOLERANCE, rounding / 8)
        for _ in range(_UNDISTORT_ITERATIONS):
            lens = self.distort_with_jacobian(u, v)
            error_u, error_v = lens.u - u_target, lens.v - v_target
            determinant = lens.du_du * lens.dv_dv - lens.du_dv * lens.dv_du
            determinant = torch.where(determinant.abs() < 1e-3, torch.full_like(determinant, 1e-3), determinant)
            u = u - (lens.dv_dv * error_u - lens.du_dv * error_v) / determinant
            v = v - (lens.du_du * error_v - lens.dv_du * error_u) / determinant
            if not bool((torch.maximum(error_u.abs(), error_v.abs()) > tolerance).any()):
                break
        back_u, back_v = self.distort(u, v)
        fold_radius = extended(self._fold_radius, u.ndim)
        exact = (back_u - u_target).abs() + (back_v - v_target).abs() < max(1e-9, rounding)
        solved = exact & (u * u + v * v < fold_radius**2)
        return torch.where(solved[..., None], torch.stack([u, v], dim=-1), torch.nan)

    def _pixel_map(self, ndim: int) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """fx, skew, cx, fy, cy, each (..., C, 1, ...) for coordinates of ``ndim`` dimensions."""
        fx, skew, cx, _, fy, cy, *_ = extended(self.matrix.flatten(-2).movedim(-1, 0), ndim + 1)
        return fx, skew, cx, fy, cy

    def _to_pixels(self, u: Tensor, v: Tensor) -> tuple[Tensor, Tensor]:
        fx, skew, cx, fy, cy = self._pixel_map(u.ndim)
        return torch.addcmul(torch.addcmul(cx, fx, u), skew, v), torch.addcmul(cy, fy, v)

    @property
    def is_tilted(self) -> bool:
        """Whether the lens model has a tilted sensor."""
        return self.distortion is not None and self.distortion.shape[-1] > 12

    @property
    def _has_prism(self) -> bool:
        return self.distortion is not None and self.distortion.shape[-1] > 8

    @property
    def _has_denominator(self) -> bool:
        return self.distortion is not None and self.distortion.shape[-1] > 5

    @property
    def _tilt(self) -> Tensor:
        """Homography (..., C, 3, 3) from the plane that faces the lens to the tilted sensor."""
        assert self.distortion is not None
        cos_x, cos_y = self.distortion[..., 12:].cos().unbind(-1)
        sin_x, sin_y = self.distortion[..., 12:].sin().unbind(-1)
        zero, one = torch.zeros_like(cos_x), torch.ones_like(cos_x)
        rotation = [cos_y, sin_y * sin_x, -sin_y * cos_x, zero, cos_x, sin_x, sin_y, -cos_y * sin_x, cos_y * cos_x]
        depth, shift_x, shift_y = rotation[8], -rotation[2], -rotation[5]
        onto_sensor = torch.stack([depth, zero, shift_x, zero, depth, shift_y, zero, zero, one], dim=-1)
        return onto_sensor.unflatten(-1, (3, 3)) @ torch.stack(rotation, dim=-1).unflatten(-1, (3, 3))

    def _coefficients(self, ndim: int) -> list[Tensor]:
        assert self.distortion is not None
        padding = 0 if self.fisheye else max(0, 8 - self.distortion.shape[-1])
        padded = torch.nn.functional.pad(self.distortion, (0, padding))
        return list(extended(padded.movedim(-1, 0), ndim + 1))

    def _rational(self, u: Tensor, v: Tensor, slope: bool = True) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
        """Radial factor, its derivative by r^2 (if wanted), p1, p2 and r^2."""
        k1, k2, p1, p2, k3, k4, k5, k6 = self._coefficients(u.ndim)[:8]
        one, r2 = torch.ones_like(k1), torch.addcmul(u * u, v, v)
        radial, by_r2 = _polynomial(r2, one, k1, k2, k3), r2
        if slope:
            by_r2 = _polynomial(r2, k1, 2 * k2, 3 * k3)
        if self._has_denominator:
            denominator = _polynomial(r2, one, k4, k5, k6)
            radial = radial / denominator
            if slope:
                by_r2 = (by_r2 - radial * _polynomial(r2, k4, 2 * k5, 3 * k6)) / denominator
        return radial, by_r2, p1, p2, r2

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


def _polynomial(x: Tensor, *coefficients: Tensor) -> Tensor:
    """``c0 + c1 x + c2 x^2 + ...``"""
    *others, value = coefficients
    for coefficient in reversed(others):
        value = torch.addcmul(coefficient, x, value)
    return value


def inverse_depths(depth: Tensor) -> Tensor:
    """1 / z, bounded where z is nearly 0."""
    return away_from_zero(depth).reciprocal()


def away_from_zero(depth: Tensor) -> Tensor:
    """Depths, those nearly 0 moved to the least by which one can divide, with gradient 0."""
    return depth.abs().clamp_min(_MIN_DEPTH).copysign(depth)
