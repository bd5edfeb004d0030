"""Eliminations against dense linear algebra."""

from __future__ import annotations

import pytest
import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.geometry.symmetric import expand, inverse_diagonal
from torchstickcal.model.measurements import Measurements
from torchstickcal.solvers.elimination.cross_blocks import cross_rows, symmetric_times
from torchstickcal.solvers.elimination.parts import Couplings, Part, parts
from torchstickcal.solvers.elimination.tracks import BlockTridiagonal

P = 5
PAIRS = torch.tensor([[3, 4], [1, 0]])


def entries(blocks: Tensor) -> Tensor:
    return torch.stack([blocks[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])


def system(frames: int, smooth: bool) -> tuple[Tensor, Tensor, Tensor, Tensor, Tensor]:
    """Dense matrix (ordered frame, point, axis), diagonal blocks, stick coupling, and couplings between frames."""
    generator = torch.Generator().manual_seed(frames)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    a, b = random(3, 3, frames, P), random(3, 3, frames, 2)
    blocks = torch.einsum("ikfp,jkfp->ijfp", a, a) + torch.eye(3, dtype=torch.float64)[..., None, None]
    coupling = torch.einsum("ikfs,jkfs->ijfs", b, b)
    blocks[..., PAIRS] += coupling[..., None]
    dense = torch.zeros(frames, P, 3, frames, P, 3, dtype=torch.float64)
    for s, (start, end) in enumerate(PAIRS.tolist()):
        for f in range(frames):
            dense[f, start, :, f, end, :] = dense[f, end, :, f, start, :] = -coupling[:, :, f, s]
    next_frame = torch.zeros(frames - 1, P, dtype=torch.float64)
    second_frame = torch.zeros(max(frames - 2, 0), P, dtype=torch.float64)
    if smooth:
        stencil = torch.zeros(frames - 2, frames, dtype=torch.float64)
        for f in range(frames - 2):
            stencil[f, f : f + 3] = torch.tensor([1.0, -2, 1])
        for p in range(P):
            track = stencil.mT @ torch.diag(random(frames - 2).square()) @ stencil
            next_frame[:, p], second_frame[:, p] = track.diagonal(1), track.diagonal(2)
            for axis in range(3):
                dense[:, p, axis, :, p, axis] += track - torch.diag(track.diagonal())
                blocks[axis, axis, :, p] += track.diagonal()
    for f in range(frames):
        for p in range(P):
            dense[f, p, :, f, p, :] = blocks[:, :, f, p]
    return dense.reshape(frames * P * 3, -1), entries(blocks), entries(coupling), next_frame, second_frame


def flat(columns: Tensor) -> Tensor:
    return columns.mT.flatten()


def check(part: Part, hessian: Tensor, dense: Tensor) -> None:
    """A part that holds all columns, against dense algebra, for random blocks N_c of two cameras and a random gradient."""
    count = hessian.shape[1]
    generator = torch.Generator().manual_seed(count)
    shapes = ((1, 2, 6, count), (1, 3, count), (1, 3, count))
    cross, points, gradient = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in shapes)
    coupling = torch.stack([flat(row) for row in cross_rows(cross, points)[0].flatten(0, 1)])
    right = torch.cat([coupling, flat(gradient[0])[None]])
    expected = right @ torch.linalg.solve(dense, right.mT)
    columns = part.columns
    elimination = part.eliminate(hessian[None, :, columns])
    rows, half = elimination.reductions(cross[..., columns], points[..., columns], gradient[..., columns])
    both = torch.cat([rows, half[:, None]], dim=1)[0]
    torch.testing.assert_close(both @ both.mT, expected, rtol=1e-11, atol=1e-11 * float(expected.abs().max()))
    solution = torch.empty_like(gradient)
    solution[..., columns] = elimination.solve(gradient[..., columns])
    torch.testing.assert_close(flat(solution[0]), torch.linalg.solve(dense, flat(gradient[0])), rtol=1e-11, atol=1e-12)


def session(frames: int, pairs: Tensor) -> Measurements:
    """Nothing but the shape of a session of one camera."""
    cameras = Intrinsics(torch.eye(3, dtype=torch.float64)[None, None])
    pixels, confidence = torch.zeros(1, 1, 2, frames * P), torch.ones(1, 1, frames * P)
    return Measurements(pixels, confidence, cameras, frames, pairs, torch.ones(1, len(pairs)))


def test_cross_rows_are_blocks_times_the_cameras_jacobian():
    blocks, points = torch.randn(2, 6, 7, dtype=torch.float64), torch.randn(3, 7, dtype=torch.float64)
    matrices = expand(blocks).movedim(-1, 1)
    jacobian = torch.cat([torch.eye(3, dtype=torch.float64).expand(7, 3, 3), -se3.hat(points.mT)], dim=-1)
    rows = cross_rows(blocks[None], points[None])[0]
    torch.testing.assert_close(rows.permute(0, 3, 2, 1), matrices @ jacobian)
    vectors = torch.randn(2, 3, 7, dtype=torch.float64)
    expected = (matrices @ vectors.movedim(-1, 1)[..., None])[..., 0].sum(0).mT
    torch.testing.assert_close(symmetric_times(blocks[None], vectors[None])[0], expected)


@pytest.mark.parametrize("frames", [2, 3, 7])
def test_points_and_sticks(frames: int):
    dense, blocks, coupling, *_ = system(frames, smooth=False)
    (part,) = parts(session(frames, PAIRS), Couplings(coupling[None], None, None))
    check(part, blocks.flatten(1), dense)


def test_points_alone():
    _, blocks, *_ = system(4, smooth=False)
    matrices = expand(blocks.flatten(1)).movedim(-1, 0)
    (part,) = parts(session(4, PAIRS), Couplings(None, None, None))
    check(part, blocks.flatten(1), torch.block_diag(*matrices))
    found = inverse_diagonal(blocks.flatten(1))
    torch.testing.assert_close(found.mT, torch.linalg.inv(matrices).diagonal(dim1=1, dim2=2))


@pytest.mark.parametrize("frames", [3, 4, 5, 8, 11])
@pytest.mark.parametrize("together", [1, 1000])
def test_tracks(frames: int, together: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchstickcal.solvers.elimination.parts._TRACK_POINTS", together)
    dense, blocks, coupling, next_frame, second_frame = system(frames, smooth=True)
    by_point = dense.reshape(frames, P, 3, frames, P, 3)
    found = parts(session(frames, PAIRS), Couplings(coupling[None], next_frame[None], second_frame[None]))
    assert sorted(torch.cat([part.columns for part in found]).tolist()) == list(range(frames * P))
    for part in found:
        members = torch.unique(part.columns % P)
        inside = by_point[:, members][:, :, :, :, members].reshape(frames * len(members) * 3, -1)
        order = torch.empty(frames * P, dtype=torch.long)
        order[(torch.arange(frames)[:, None] * P + members).flatten()] = torch.arange(frames * len(members))
        check(_Renumbered(part, order[part.columns]), blocks[..., members].flatten(1), inside)


class _Renumbered:
    """A part of some points as a part that holds all columns of a session of these points."""

    def __init__(self, part: Part, columns: Tensor) -> None:
        self.columns, self.chunks, self.eliminate = columns, [columns], part.eliminate


@pytest.mark.parametrize("count", [1, 2, 3, 6, 9])
def test_block_tridiagonal(count: int):
    torch.manual_seed(count)
    lower = torch.randn(2, count, 4, 4, dtype=torch.float64).tril() + 3 * torch.eye(4, dtype=torch.float64)
    below = torch.randn(2, count - 1, 4, 4, dtype=torch.float64)
    factor = torch.zeros(2, count, 4, count, 4, dtype=torch.float64)
    for g in range(count):
        factor[:, g, :, g] = lower[:, g]
        if g:
            factor[:, g, :, g - 1] = below[:, g - 1]
    factor = factor.reshape(2, 4 * count, 4 * count)
    dense = (factor @ factor.mT).reshape(2, count, 4, count, 4)
    diagonal = torch.stack([dense[:, g, :, g] for g in range(count)], dim=1)
    under = [dense[:, g + 1, :, g] for g in range(count - 1)]
    solver = BlockTridiagonal(diagonal, torch.stack(under, dim=1) if under else diagonal.new_zeros(2, 0, 4, 4))
    right = torch.randn(2, count, 4, 3, dtype=torch.float64)
    expected = torch.linalg.solve(factor @ factor.mT, right.reshape(2, -1, 3)).reshape(right.shape)
    torch.testing.assert_close(solver.back_solve(solver.half_solve(right)), expected, rtol=1e-9, atol=1e-10)
