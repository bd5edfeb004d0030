"""The reprojection loss: distance in the image between a keypoint and the projection of its 3D point."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Literal, Self

import torch
from torch import Tensor

from torchstickcal.geometry import projection
from torchstickcal.geometry.cameras import Intrinsics, PixelMap, inverse_depths
from torchstickcal.geometry.symmetric import outer, symmetric_product
from torchstickcal.losses.camera_point import CameraPointLoss, CameraPointTerms, CameraUnknownsAt, UnknownTerms
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
        return self._repeated(lambda times: times[..., 0, _points_of(columns, points).to(times.device)])

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
        # The derivative of (u, v) by the world point has the rows p / z and q / z, p = r1 - u r3 and q = r2 - v r3 with the
        # rows r of the rotation; M, the derivative of the pixel by (u, v), gives J^T W J = [p q] (M^T W M / z^2) [p q]^T.
        x, y, z = points_cam.unbind(-2)
        inverse_depth = inverse_depths(z)
        u, v = x * inverse_depth, y * inverse_depth
        m = cameras.pixels_with_jacobian(u, v)
        rx, ry = m.x - pixels[..., 0, :], m.y - pixels[..., 1, :]
        squared_px = rx.square().addcmul_(ry, ry)
        squared = squared_px * information
        weights = information * self.kernel.weight(squared)
        if self.weight != 1.0:
            weights = weights * self.weight

        first, second, third = rotations[..., None].unbind(-3)
        p = torch.addcmul(first, u.unsqueeze(-2), third, value=-1)
        q = torch.addcmul(second, v.unsqueeze(-2), third, value=-1)
        gradient = p * _scaled(weights, m.dx_du, rx, m.dy_du, ry, inverse_depth)
        gradient.addcmul_(q, _scaled(weights, m.dx_dv, rx, m.dy_dv, ry, inverse_depth))

        weights_at_depth = weights * inverse_depth.square()
        pp = _scaled(weights_at_depth, m.dx_du, m.dx_du, m.dy_du, m.dy_du)
        pq = _scaled(weights_at_depth, m.dx_du, m.dx_dv, m.dy_du, m.dy_dv)
        qq = _scaled(weights_at_depth, m.dx_dv, m.dx_dv, m.dy_dv, m.dy_dv)
        if exact:
            bend = 2 * self.weight * (information * inverse_depth).square() * self.kernel.curvature(squared)
            along_u, along_v = m.dx_du * rx + m.dy_du * ry, m.dx_dv * rx + m.dy_dv * ry
            uu, uv, vv = cameras.pixel_curvature(u, v, weights_at_depth * rx, weights_at_depth * ry)
            pp = pp + (bend * along_u * along_u + uu).unsqueeze(-2)
            pq = pq + (bend * along_u * along_v + uv).unsqueeze(-2)
            qq = qq + (bend * along_v * along_v + vv).unsqueeze(-2)
        s, t = p * pp, p * pq
        s.addcmul_(q, pq)
        t.addcmul_(q, qq)
        hessian = p.new_empty(*p.shape[:-2], 6, p.shape[-1])
        for entries, axis in ((slice(0, 3), 0), (slice(3, 5), 1), (slice(5, 6), 2)):
            block = hessian[..., entries, :]
            torch.mul(p[..., axis : axis + 1, :], s[..., axis:, :], out=block)
            block.addcmul_(q[..., axis : axis + 1, :], t[..., axis:, :])
        if exact:
            hessian -= symmetric_product(third.expand_as(p), gradient * inverse_depth.unsqueeze(-2))
        return CameraPointTerms(
            cost=self.total(squared, over=2),
            squares=(weights * squared_px).sum(-1),
            weights=weights.sum(-1),
            gradient=gradient,
            hessian=hessian,
            unknown=None
            if unknowns is None
            else _by_unknowns(unknowns.projection_derivatives(u, v, m), weights, rx, ry, m, p, q, inverse_depth),
        )

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


def _points_of(columns: slice | Tensor, points: int) -> Tensor:
    """The points that some columns are of, with ``points`` points in each frame."""
    return (torch.arange(columns.start, columns.stop) if isinstance(columns, slice) else columns) % points


def _by_unknowns(
    columns: tuple[Tensor, Tensor],
    weights: Tensor,
    rx: Tensor,
    ry: Tensor,
    m: PixelMap,
    p: Tensor,
    q: Tensor,
    inverse_depth: Tensor,
) -> UnknownTerms:
    """The terms by columns (..., C, k, N): the gradient's with a column in place of the residual."""
    ex, ey = columns
    wx, wy = weights.unsqueeze(-2) * ex, weights.unsqueeze(-2) * ey
    along_p, along_q = (
        (by_x.unsqueeze(-2) * wx).addcmul_(by_y.unsqueeze(-2), wy) * inverse_depth.unsqueeze(-2)
        for by_x, by_y in ((m.dx_du, m.dy_du), (m.dx_dv, m.dy_dv))
    )
    coupling = p.unsqueeze(-3) * along_p.unsqueeze(-2)
    return UnknownTerms(
        gradient=(wx @ rx.unsqueeze(-1) + wy @ ry.unsqueeze(-1))[..., 0],
        hessian=wx @ ex.mT + wy @ ey.mT,
        coupling=coupling.addcmul_(q.unsqueeze(-3), along_q.unsqueeze(-2)),
    )


def _scaled(weights: Tensor, a: Tensor, b: Tensor, c: Tensor, d: Tensor, factor: Tensor | None = None) -> Tensor:
    """``weights (a b + c d) factor`` as (..., C, 1, N)."""
    scaled = weights * torch.addcmul(a * b, c, d)
    return (scaled if factor is None else scaled * factor).unsqueeze(-2)
