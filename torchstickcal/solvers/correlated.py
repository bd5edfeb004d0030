"""What errors that last do to an estimate that counts keypoints as independent.

With the camera system S, its root Q (S^-1 = Q Q^T), and the derivatives A of a track's whitened residuals by the cameras, the
points following, the covariance of the estimate is

    S^-1 (sum A T A^T + rest) S^-1 = Q E Q^T        E = I + sum Q^T A (T - I) A^T Q

with the correlation T of the errors of a track. The sum is over tracks: cameras, image axes and points. Independent errors have
T = I and E = I. In statistics this is the covariance that is consistent with heteroscedasticity and autocorrelation.

The products with T are taken at the frequencies of a Fourier transform over time, where T is diagonal. A long session is
divided into segments. Between segments, the errors count with their mean correlation.

Reference: Newey and West, "A simple, positive semi-definite, heteroskedasticity and autocorrelation consistent covariance
matrix", 1987.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import torch
from torch import Tensor

from torchstickcal.geometry.cameras import inverse_depths
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.correlation import ErrorCorrelation
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.objective import Objective
from torchstickcal.model.state import State
from torchstickcal.solvers.elimination.normal_equations import NormalEquations

_RESPONSE_VALUES = 2**23
"""Numbers of a segment's response to the cameras that are held at a time."""
_LEAST_SEGMENT = 512
_SPECTRUM_VALUES = 2**23
_MOST_TAKEN_UP = 0.8
"""Share of a point's lasting errors that the cameras can have taken up at most, in the correction for it."""

_LEAST_OF_WHITE = 0.1
"""Least variance of an estimate, as a part of that by independent errors of the same keypoints, each with its weight."""


def inflation(objective: Objective, state: State, root: Tensor, correlation: ErrorCorrelation, times: Tensor) -> Tensor:
    """The matrix E of the module's text, (B, D, D), D = 6 (C - 1) + K.

    Args:
        objective: the likelihood, in which the information of each point's keypoints is divided by ``times``.
        state: its minimum.
        root: Q, (B, D, D).
        correlation: of the keypoint errors.
        times: (B, P), as many keypoints count as one.
    """
    m = objective.measurements
    segments = _segments(m, root.shape[-1])
    white, lasting = (root.new_zeros(m.sessions, m.points_per_frame, *root.shape[1:]) for _ in range(2))
    sums: list[Tensor] = []
    for frames in segments:
        parts = _within_segment(*_cut(objective, state, frames), root, correlation, bool((times != 1).any()))
        white, lasting = white + parts[0], lasting + parts[1]
        sums.append(parts[2])
    for step in range(1, len(segments)):
        for first, second in zip(range(len(segments)), range(step, len(segments)), strict=False):
            weight = correlation.between(segments[first], segments[second])[..., None, None]
            product = sums[first] @ sums[second].mT * weight
            lasting = lasting + product + product.mT
    worth, hidden, noise = 1 / times, *_hidden(lasting, m, correlation, 1 / times)
    by_point = (worth - 1)[..., None, None] * white + (worth * hidden)[..., None, None] * lasting
    found = noise[:, None, None] * (torch.eye(root.shape[-1]).to(root) + by_point.sum(1))
    return _not_below(found, _LEAST_OF_WHITE * worth.amin(1))


def _not_below(symmetric: Tensor, least: Tensor) -> Tensor:
    """Symmetric matrices (B, D, D) with eigenvalues of at least ``least`` (B,); the identity where one is not finite.

    Rounding leaves negative ones where the residuals fit no model of errors, as in a session that did not converge.
    """
    finite = symmetric.isfinite().flatten(1).all(1)[:, None, None]
    values, vectors = torch.linalg.eigh(symmetric.where(finite, torch.eye(symmetric.shape[-1]).to(symmetric)))
    return (vectors * values.maximum(least[:, None])[:, None]) @ vectors.mT


def _hidden(lasting: Tensor, m: Measurements, correlation: ErrorCorrelation, worth: Tensor) -> tuple[Tensor, Tensor]:
    """Factors on what lasts of each point's errors, (B, P), and on the noise, (B,), for what the residuals do not show.

    They show less of the errors that last than there is, because the cameras have taken up a part of them. So the correlation
    is underestimated, and the noise too.

    Args:
        lasting: each point's ``sum Q^T A (T - I) A^T Q``, (B, P, D, D), by the residuals.
        m: the inliers.
        correlation: by the residuals.
        worth: (B, P), weight of each point's keypoints.
    """
    free = m.by_frame((2 * m.visible.sum(1) - 3).clamp_min(0)).sum(1).to(lasting)
    taken_up = lasting.diagonal(dim1=2, dim2=3).sum(2)
    shown = free * (correlation.times - 1) / m.frames
    share = (taken_up / shown.clamp_min(1e-300)).clamp(0.0, _MOST_TAKEN_UP)
    noise = 1 + (worth * taken_up).sum(1).clamp_min(0.0) / (worth * free).sum(1).clamp_min(1e-300)
    return 1 / (1 - share), noise


def _segments(m: Measurements, size: int) -> list[slice]:
    """Frames that are worked on together: all of them, where that is not too many."""
    longest = max(_LEAST_SEGMENT, _RESPONSE_VALUES // (m.sessions * size * 3 * m.points_per_frame))
    count = -(-m.frames // longest)
    length = -(-m.frames // count)
    return [slice(start, min(start + length, m.frames)) for start in range(0, m.frames, length)]


def _cut(objective: Objective, state: State, frames: slice) -> tuple[Objective, State]:
    """An objective and a state for some of the frames."""
    m = objective.measurements
    if frames == slice(0, m.frames):
        return objective, state
    columns = m.columns_of(frames)
    return Objective(m.within(frames), objective.losses), replace(state, points=state.points[..., columns])


def _within_segment(
    objective: Objective, state: State, root: Tensor, correlation: ErrorCorrelation, with_white: bool
) -> tuple[Tensor, Tensor, Tensor]:
    """Each point's sums over one segment: ``Q^T A A^T Q`` and ``Q^T A (T - I) A^T Q``, (B, P, D, D), and of ``Q^T A``.

    The first are zero where they are not wanted. The last are sums over frames for each track of the point, (B, P, D, tracks).
    """
    m, size = objective.measurements, root.shape[-1]
    weights = correlation.spectrum(m.frames) - 1
    weights[..., 1:-1] *= 2
    weights = (weights / (2 * m.frames)).to(torch.float32)
    white, lasting = (root.new_zeros(m.sessions, m.points_per_frame, size, size) for _ in range(2))
    sums = root.new_empty(m.sessions, m.points_per_frame, size, m.num_cameras, 2)
    together = max(1, _SPECTRUM_VALUES // (4 * m.sessions * size * 2 * m.frames))
    for camera, derivatives in enumerate(_derivatives(objective, state, root)):
        by_track = derivatives.unflatten(-1, (m.frames, -1)).permute(0, 4, 1, 2, 3).to(torch.float32)
        sums[..., camera, :] = by_track.sum(-1)
        for first in range(0, m.points_per_frame, together):
            part = slice(first, first + together)
            flat = by_track[:, part].flatten(3)
            if with_white:
                white[:, part] += flat @ flat.mT
            spectrum = torch.view_as_real(torch.fft.rfft(by_track[:, part], n=2 * m.frames))
            weighted = spectrum * weights[:, part, None, None, :, None]
            lasting[:, part] += weighted.flatten(3) @ spectrum.flatten(3).mT
    return white, lasting, sums.flatten(3)


def _derivatives(objective: Objective, state: State, root: Tensor) -> Iterator[Tensor]:
    """``Q^T A`` of each camera in turn, (B, D, 2, N): of its whitened residuals along x and y, the points following."""
    m = objective.measurements
    response = NormalEquations(objective, state, cameras_free=True).point_response()
    moved = (root.mT @ response.flatten(2)).view_as(response)
    del response
    x, y, z = state.in_cameras().unbind(-2)
    inverse_depth = inverse_depths(z)
    u, v = x * inverse_depth, y * inverse_depth
    cameras = m.cameras_at(state).to(torch.float64)
    pixel = cameras.pixels_with_jacobian(u, v)
    by_unknowns = m.unknowns.projection_derivatives(u, v, pixel, cameras, m.motion) if m.unknowns.count else ()
    tangents = 6 * (m.num_cameras - 1)
    weights = (m.confidence * _information(objective)).sqrt()
    entries = (pixel.dx_du, pixel.dx_dv, pixel.dy_du, pixel.dy_dv)
    dx_du, dx_dv, dy_du, dy_dv = (entry.expand_as(u) for entry in entries)
    for camera in range(m.num_cameras):
        first, second, third = state.rotations[:, camera, :, :, None].unbind(1)
        p = (first - u[:, camera, None] * third) * (inverse_depth * weights)[:, camera, None]
        q = (second - v[:, camera, None] * third) * (inverse_depth * weights)[:, camera, None]
        own = root[:, 6 * camera - 6 : 6 * camera].mT if camera else root.new_zeros(m.sessions, root.shape[-1], 6)
        total = moved + own[:, :, :3, None] + torch.linalg.cross(own[:, :, 3:, None], state.points[:, None], dim=2)
        along_p, along_q = (torch.einsum("ban,bdan->bdn", axis, total) for axis in (p, q))
        found = [du[:, camera, None] * along_p + dv[:, camera, None] * along_q for du, dv in ((dx_du, dx_dv), (dy_du, dy_dv))]
        for axis, by_unknown in enumerate(by_unknowns):
            own = torch.einsum("kj,bjd->bdk", m.unknowns.share[camera], root[:, tangents:])
            found[axis] = found[axis] + own @ (by_unknown[:, camera] * weights[:, camera, None]).to(own)
        yield torch.stack(found, dim=2).where(m.visible[:, camera, None, None], 0.0)


def _information(objective: Objective) -> Tensor:
    """1 / sigma^2 of the keypoints, (1 | B, 1, N): zero where no loss compares them with projections."""
    m = objective.measurements
    found = [objective.information_of(name) for name, loss in objective.losses.items() if isinstance(loss, ReprojectionLoss)]
    return sum(found, m.confidence.new_zeros(1, 1, m.num_columns))
