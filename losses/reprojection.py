"""The reprojection loss: distance in the image between a keypoint and the projection of its 3D point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, Self

import torch
from torch import Tensor

from torchstickcal.geometry import projection
from torchstickcal.geometry.cameras import Intrinsics, PixelMap, inverse_depths
from torchstickcal.geometry.symmetric import outer, symmetric_product
from torchstickcal.losses.camera_point import (
    CameraPointLoss,
    CameraPointSlopes,
    CameraPointTerms,
    CameraUnknownsAt,
    UnknownTerms,
)
from torchstickcal.losses.registry import LossContext, LossSettings, register_loss
from torchstickcal.losses.robust import Quadratic, Repeated, RobustKernel, robust_kernel
from torchstickcal.settings import Positive


def reprojection_residuals(
    points: Tensor, rotations: Tensor, translations: Tensor, keypoints: Tensor, intrinsics: Intrinsics | Tensor
) -> Tensor:
    """Projection minus keypoint, in (distorted) pixels; the negative of the paper's residuals of stage 1.

    Args:
        points: (..., F, P, 3), metres, in the world; leading dimensions, of several sessions, are those of all arguments.
        rotations: (..., C, 3, 3) and translations: (..., C, 3), world to camera.
        keypoints: (..., C, F, P, 2), NaN where not seen.
        intrinsics: cameras with their lenses, or matrices (..., C, 3, 3) or (3, 3).

    Returns:
        (..., C, F, P, 2), zero where a keypoint was not seen or its point is not known.

    Example:
        >>> import torch
        >>> points, keypoints = torch.tensor([[[0.0, 0.0, 2.0]]]), torch.tensor([[[[49.0, 52.0]]]])
        >>> matrix = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        >>> reprojection_residuals(points, torch.eye(3)[None], torch.zeros(1, 3), keypoints, matrix)
        tensor([[[[ 1., -2.]]]])
    """
    return ReprojectionLoss().of_scene(points, rotations, translations, keypoints, intrinsics)


class ReprojectionLoss(CameraPointLoss):
    """``weight * sum rho(confidence |r|^2 / sigma^2)`` over all keypoints seen, r of :func:`reprojection_residuals`.

    Args:
        sigma: noise of a keypoint in pixels, one number or one per point (P,).
        weight: factor on the loss.
        kernel: robust kernel; None for least squares.
        times: (B, 1, 1, P), as many keypoints of a point count as one, because their errors are alike; None for 1.

    Example:
        >>> import torch
        >>> points, keypoints = torch.tensor([[[0.0, 0.0, 2.0]]]), torch.tensor([[[[49.0, 52.0]]]])
        >>> matrix = torch.tensor([[100.0, 0, 50], [0, 100, 50], [0, 0, 1]])
        >>> ReprojectionLoss(sigma=2.0)(points, torch.eye(3)[None], torch.zeros(1, 3), keypoints, matrix)
        tensor(1.2500)
    """

    def __init__(
        self,
        sigma: float | Tensor = 1.0,
        weight: float = 1.0,
        kernel: RobustKernel | None = None,
        times: Tensor | None = None,
    ) -> None:
        if times is None:
            super().__init__(sigma, weight, kernel)
        else:
            super().__init__(sigma * times.sqrt(), weight, Repeated(kernel or Quadratic(), times))

    def of(self, sessions: slice) -> Self:
        return super().of(sessions)._repeated(lambda times: times[sessions])

    def replaced(self, where: Tensor, other: Any) -> Self:
        return (
            super()
            .replaced(where, other)
            ._repeated(
                lambda times: (
                    torch.where(where[:, None, None, None], other.kernel.times, times)
                    if isinstance(other.kernel, Repeated)
                    else times
                )
            )
        )

    def of_columns(self, columns: slice | Tensor, points: int) -> Self:
        return self._repeated(lambda times: _of_columns(times[..., 0, :], columns, points))

    def _repeated(self, change: Callable[[Tensor], Tensor]) -> Self:
        """The loss with its ``times`` changed, where it has them."""
        if not isinstance(self.kernel, Repeated):
            return self
        return self._with(kernel=Repeated(self.kernel.kernel, change(self.kernel.times)))

    def residuals(self, points_cam: Tensor, keypoints: Tensor, intrinsics: Intrinsics) -> Tensor:
        return projection.project(points_cam, intrinsics) - keypoints

    def likelihood(self, sigma_px: Tensor) -> Self:
        """With the noise that the keypoints were found to have, whatever the loss was given."""
        return type(self)(sigma_px[:, None, None])

    def linearise(
        self,
        points_cam: Tensor,
        rotations: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        exact: bool = False,
        unknowns: CameraUnknownsAt | None = None,
    ) -> CameraPointTerms:
        at = self._seen(points_cam, rotations, pixels, information, cameras)
        # With the derivatives a and b of a keypoint's x and y by the world point: J^T W J = a (w a)^T + b (w b)^T.
        along_a, along_b = at.weights.unsqueeze(-2) * at.a, at.weights.unsqueeze(-2) * at.b
        gradient = along_a * at.rx.unsqueeze(-2)
        gradient.addcmul_(along_b, at.ry.unsqueeze(-2))
        if exact:
            bend = 2 * self.weight * information.square() * self.kernel.curvature(at.squared)
            by_squared = (at.a * at.rx.unsqueeze(-2)).addcmul_(at.b, at.ry.unsqueeze(-2))
            along_a.addcmul_((bend * at.rx).unsqueeze(-2), by_squared)
            along_b.addcmul_((bend * at.ry).unsqueeze(-2), by_squared)
        hessian = at.a.new_empty(*at.a.shape[:-2], 6, at.a.shape[-1])
        for entries, axis in ((slice(0, 3), 0), (slice(3, 5), 1), (slice(5, 6), 2)):
            block = hessian[..., entries, :]
            torch.mul(at.a[..., axis : axis + 1, :], along_a[..., axis:, :], out=block)
            block.addcmul_(at.b[..., axis : axis + 1, :], along_b[..., axis:, :])
        if exact:
            hessian += at.curvature(rotations, gradient, cameras)
        return CameraPointTerms(
            *self._sums(at.squared_px, at.squared, at.weights),
            gradient=gradient,
            hessian=hessian,
            unknown=None if unknowns is None else _by_unknowns(unknowns.projection_derivatives(at.u, at.v, at.pixel), at),
        )

    def slopes(
        self,
        points_cam: Tensor,
        rotations: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        unknowns: CameraUnknownsAt | None = None,
    ) -> CameraPointSlopes:
        at = self._seen(points_cam, rotations, pixels, information, cameras)
        wx, wy = (at.weights * r for r in (at.rx, at.ry))
        gradient = at.a * wx.unsqueeze(-2)
        by_unknowns = None
        if unknowns is not None:
            ex, ey = (derivative.to(wx) for derivative in unknowns.projection_derivatives(at.u, at.v, at.pixel))
            by_unknowns = (ex @ wx.unsqueeze(-1) + ey @ wy.unsqueeze(-1))[..., 0]
        return CameraPointSlopes(
            *self._sums(at.squared_px, at.squared, at.weights),
            gradient=gradient.addcmul_(at.b, wy.unsqueeze(-2)),
            unknown_gradient=by_unknowns,
        )

    def _seen(self, points_cam: Tensor, rotations: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics) -> _Seen:
        """The points as the cameras see them, beside the keypoints; the arguments are those of :meth:`linearise`."""
        x, y, z = points_cam.unbind(-2)
        inverse_depth = inverse_depths(z)
        u, v = x * inverse_depth, y * inverse_depth
        pixel = cameras.pixels_with_jacobian(u, v)
        rx, ry = pixel.x - pixels[..., 0, :], pixel.y - pixels[..., 1, :]
        squared_px = rx.square().addcmul_(ry, ry)
        squared = squared_px * information
        weights = information * self.kernel.weight(squared)
        if self.weight != 1.0:
            weights = weights * self.weight
        a = _by_world(rotations, pixel.dx_du, pixel.dx_dv, u, v, inverse_depth)
        b = _by_world(rotations, pixel.dy_du, pixel.dy_dv, u, v, inverse_depth)
        return _Seen(u, v, inverse_depth, pixel, rx, ry, squared_px, squared, weights, a, b)

    def slope(
        self,
        points_cam: Tensor,
        moved_cam: Tensor,
        pixels: Tensor,
        information: Tensor,
        cameras: Intrinsics,
        unknowns: CameraUnknownsAt | None = None,
        step: Tensor | None = None,
    ) -> Tensor:
        x, y, z = points_cam.unbind(-2)
        inverse_depth = inverse_depths(z.where(information > 0, 1.0))
        u, v = x * inverse_depth, y * inverse_depth
        m = cameras.pixels_with_jacobian(u, v)
        moved_x, moved_y = m.moved(u, v, inverse_depth, moved_cam)
        if unknowns is not None and step is not None:
            by_x, by_y = unknowns.projection_derivatives(u, v, m)
            moved_x, moved_y = (moved + (step[..., None] * by).sum(-2) for moved, by in ((moved_x, by_x), (moved_y, by_y)))
        rx, ry = m.x - pixels[..., 0, :], m.y - pixels[..., 1, :]
        weights = self.weight * information * self.kernel.weight((rx.square() + ry.square()) * information)
        return (weights * (rx * moved_x + ry * moved_y)).sum()

    def point_information(
        self, points_cam: Tensor, rotations: Tensor, pixels: Tensor, information: Tensor, cameras: Intrinsics
    ) -> Tensor:
        x, y, z = points_cam.unbind(-2)
        inverse_depth = inverse_depths(z.where(information > 0, 1.0))
        u, v = x * inverse_depth, y * inverse_depth
        m = cameras.pixels_with_jacobian(u, v)
        squared = (m.x - pixels[..., 0, :]).square() + (m.y - pixels[..., 1, :]).square()
        weights = self.weight * information * self.kernel.weight(squared * information) * inverse_depth.square()
        first, second, third = rotations[..., None].unbind(-3)
        p, q = first - u.unsqueeze(-2) * third, second - v.unsqueeze(-2) * third
        by_x = p * m.dx_du.unsqueeze(-2) + q * m.dx_dv.unsqueeze(-2)
        by_y = p * m.dy_du.unsqueeze(-2) + q * m.dy_dv.unsqueeze(-2)
        return ((outer(by_x) + outer(by_y)) * weights.unsqueeze(-2)).sum(-3)


@register_loss("reprojection")
@dataclass(frozen=True)
class ReprojectionSettings(LossSettings):
    """Keypoints against the projections of their points, in pixels.

    Args:
        sigma_px: noise of a keypoint along each axis, pixels; ``estimated`` takes it from the session, for each point.
        kernel: robust kernel.
        kernel_scale: residual in standard deviations from which on a keypoint counts for less; None for the kernel's default.
        weight: factor on the loss.
        correlation_frames: for how many frames errors last: as many keypoints of a point count as one. ``estimated`` takes it
            from the session, for each point.
    """

    sigma_px: Positive | Literal["estimated"] = "estimated"
    kernel: Literal["none", "cauchy", "huber", "geman_mcclure"] = "none"
    kernel_scale: Positive | None = None
    weight: Positive = 1.0
    correlation_frames: Positive | Literal["estimated"] = 1.0

    loss = ReprojectionLoss

    def build(self, context: LossContext) -> ReprojectionLoss:
        sigma = context.sigma_px[:, None, None] if self.sigma_px == "estimated" else self.sigma_px
        kernel = robust_kernel(self.kernel, self.kernel_scale)
        if self.correlation_frames == 1.0:
            return ReprojectionLoss(sigma, self.weight, kernel)
        times = context.correlation_frames(self.correlation_frames)[:, None, None]
        return ReprojectionLoss(sigma, self.weight, kernel, times)


def _of_columns(values: Tensor, columns: slice | Tensor, points: int) -> Tensor:
    """Values (..., P) of the points, for some columns of P points side by side in each frame."""
    if isinstance(columns, Tensor):
        return values[..., columns.to(values.device) % points]
    first, count = columns.start % points, columns.stop - columns.start
    frames = -(-(first + count) // points)
    return values.repeat(*[1] * (values.ndim - 1), frames)[..., first : first + count]


class _Seen(NamedTuple):
    """N points as C cameras see them; (..., C, N), and (..., C, 3, N) with the axes of the world."""

    u: Tensor
    v: Tensor
    """normalised coordinates"""
    inverse_depth: Tensor
    pixel: PixelMap
    rx: Tensor
    ry: Tensor
    """projections minus keypoints, pixels"""
    squared_px: Tensor
    squared: Tensor
    """squared residuals, times the information"""
    weights: Tensor
    """of least squares re-weighted"""
    a: Tensor
    b: Tensor
    """(..., C, 3, N): derivatives of the pixel's x and y by the point"""

    def curvature(self, rotations: Tensor, gradient: Tensor, cameras: Intrinsics) -> Tensor:
        """What the curvature of the projection adds to the Hessian by the point, (..., C, 6, N), for a gradient (..., C, 3, N).

        With p and q, the derivatives of u and v times the depth, it is that of the lens, ``[p q] C [p q]^T``, and that of the
        division by the depth, along the third row of the rotation.
        """
        first, second, third = rotations[..., None].unbind(-3)
        found = -symmetric_product(third.expand_as(gradient), gradient * self.inverse_depth.unsqueeze(-2))
        if cameras.distortion is None:
            return found
        at_depth = self.weights * self.inverse_depth.square()
        uu, uv, vv = cameras.pixel_curvature(self.u, self.v, at_depth * self.rx, at_depth * self.ry)
        p, q = first - self.u.unsqueeze(-2) * third, second - self.v.unsqueeze(-2) * third
        p_half = p * (uu / 2).unsqueeze(-2)
        return found.add_(symmetric_product(p, p_half.addcmul_(q, uv.unsqueeze(-2)))).add_(
            symmetric_product(q, q * (vv / 2).unsqueeze(-2))
        )


def _by_world(rotations: Tensor, by_u: Tensor, by_v: Tensor, u: Tensor, v: Tensor, inverse_depth: Tensor) -> Tensor:
    """Derivative (..., C, 3, N) by the world point of what has the derivatives ``by_u`` and ``by_v`` by (u, v).

    With the rows r of the rotation, u has the derivative ``(r1 - u r3) / z`` and v has ``(r2 - v r3) / z``.
    """
    first, second, third = rotations[..., None].unbind(-3)
    shares = [(row, at, by * inverse_depth) for row, at, by in ((first, u, by_u), (second, v, by_v)) if _matters(by)]
    if not shares:
        return u.unsqueeze(-2) * torch.zeros_like(third)
    row, at, along = shares[0]
    found, along_depth = row * along.unsqueeze(-2), along * at
    for row, at, along in shares[1:]:
        found.addcmul_(row, along.unsqueeze(-2))
        along_depth.addcmul_(along, at)
    return found.addcmul_(third, along_depth.unsqueeze(-2), value=-1)


def _matters(derivative: Tensor) -> bool:
    """False for the same zero at all points."""
    return derivative.shape[-1] != 1 or bool(derivative.any())


def _by_unknowns(columns: tuple[Tensor, Tensor], at: _Seen) -> UnknownTerms:
    """The terms by columns (..., C, k, N): the gradient's with a column in place of the residual."""
    ex, ey = columns
    wx, wy = at.weights.unsqueeze(-2) * ex, at.weights.unsqueeze(-2) * ey
    coupling = at.a.unsqueeze(-3) * wx.unsqueeze(-2)
    return UnknownTerms(
        gradient=(wx @ at.rx.unsqueeze(-1) + wy @ at.ry.unsqueeze(-1))[..., 0],
        hessian=wx @ ex.mT + wy @ ey.mT,
        coupling=coupling.addcmul_(at.b.unsqueeze(-3), wy.unsqueeze(-2)),
    )
