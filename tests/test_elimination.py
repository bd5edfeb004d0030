"""The eliminations agree with dense linear algebra."""

from __future__ import annotations

import itertools

import pytest
import torch
from torch import Tensor

from torchstickcal.geometry import se3
from torchstickcal.geometry.cameras import Intrinsics
from torchstickcal.geometry.symmetric import expand, inverse_diagonal
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.unknowns import RigUnknowns
from torchstickcal.solvers.elimination.cross_blocks import cross_rows, symmetric_times
from torchstickcal.solvers.elimination.parts import BetweenFrames, Couplings, Part, WithinFrame, parts
from torchstickcal.solvers.elimination.tracks import BlockTridiagonal

P = 6
CLUSTERS = {
    "single points": [],
    "pairs": [(0, 1), (3, 4)],
    "a pair and three": [(0, 2, 5), (3, 4)],
    "all": [(0, 1, 2, 3, 4, 5)],
}


def entries(blocks: Tensor) -> Tensor:
    return torch.stack([blocks[i, j] for i, j in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))])


def system(frames: int, clusters: list[tuple[int, ...]], smooth: bool) -> tuple[Tensor, Tensor, Couplings]:
    """Dense Hessian in the order frame, point, axis; its diagonal blocks; and its blocks off the diagonal."""
    generator = torch.Generator().manual_seed(frames)

    def random(*shape: int) -> Tensor:
        return torch.randn(*shape, generator=generator, dtype=torch.float64)

    dense = torch.zeros(frames, P, 3, frames, P, 3, dtype=torch.float64)
    for f in range(frames):
        for cluster in [*((point,) for point in range(P)), *clusters]:
            root = random(3 * len(cluster), 3 * len(cluster))
            block = (root @ root.mT + torch.eye(len(root))).view(len(cluster), 3, len(cluster), 3)
            for i, first in enumerate(cluster):
                for j, second in enumerate(cluster):
                    dense[f, first, :, f, second, :] += block[i, :, j]
    within = WithinFrame()
    for cluster in clusters:
        for first, second in itertools.combinations(cluster, 2):
            own = torch.stack([dense[f, second, :, f, first, :] for f in range(frames)], dim=-1)
            within.add(torch.tensor([second]), torch.tensor([first]), own[None, ..., None])
    between = None
    if smooth:
        next_frame, second_frame = (torch.zeros(frames - step, P, dtype=torch.float64) for step in (1, 2))
        stencil = torch.zeros(frames - 2, frames, dtype=torch.float64)
        for f in range(frames - 2):
            stencil[f, f : f + 3] = torch.tensor([1.0, -2, 1])
        for p in range(P):
            track = stencil.mT @ torch.diag(random(frames - 2).square()) @ stencil
            next_frame[:, p], second_frame[:, p] = track.diagonal(1), track.diagonal(2)
            for axis in range(3):
                dense[:, p, axis, :, p, axis] += track
        between = BetweenFrames(next_frame[None], second_frame[None])
    own = torch.stack([dense[f, p, :, f, p, :] for f in range(frames) for p in range(P)], dim=-1)
    return dense.reshape(frames * P * 3, -1), entries(own), Couplings(within, between)


def flat(columns: Tensor) -> Tensor:
    return columns.mT.flatten()


def check(found: list[Part], hessian: Tensor, dense: Tensor) -> None:
    """Compare the parts with dense linear algebra, for random blocks N_c of two cameras and a random gradient."""
    count = hessian.shape[1]
    generator = torch.Generator().manual_seed(count)
    shapes = ((1, 2, 6, count), (1, 3, count), (1, 3, count))
    cross, points, gradient = (torch.randn(*shape, generator=generator, dtype=torch.float64) for shape in shapes)
    coupling = torch.stack([flat(row) for row in cross_rows(cross, points)[0].flatten(0, 1)])
    right = torch.cat([coupling, flat(gradient[0])[None]])
    expected = right @ torch.linalg.solve(dense, right.mT)
    reduced, solution = torch.zeros_like(expected), torch.empty_like(gradient)
    for part in found:
        columns = part.columns
        elimination = part.eliminate(hessian[None, :, columns])
        rows = elimination.forward_solve_cross(cross[..., columns], None, None, points[..., columns])
        both = torch.cat([rows, elimination.forward_solve(gradient[..., columns])[:, None]], dim=1)[0]
        reduced += both @ both.mT
        solution[..., columns] = elimination.solve(gradient[..., columns])
    torch.testing.assert_close(reduced, expected, rtol=1e-10, atol=1e-10 * float(expected.abs().max()))
    torch.testing.assert_close(flat(solution[0]), torch.linalg.solve(dense, flat(gradient[0])), rtol=1e-10, atol=1e-11)


def session(frames: int) -> Measurements:
    """A session of one camera of which only the shape matters."""
    cameras = Intrinsics(torch.eye(3, dtype=torch.float64)[None, None])
    pixels, confidence = torch.zeros(1, 1, 2, frames * P, dtype=torch.float64), torch.ones(1, 1, frames * P)
    empty = torch.zeros(0)
    unknowns = RigUnknowns.of((), cameras)
    return Measurements(pixels, confidence, cameras, frames, torch.zeros(0, 2).long(), empty[None], empty, unknowns)


def test_cross_rows_are_blocks_times_camera_jacobians():
    blocks, points = torch.randn(2, 6, 7, dtype=torch.float64), torch.randn(3, 7, dtype=torch.float64)
    matrices = expand(blocks).movedim(-1, 1)
    jacobian = torch.cat([torch.eye(3, dtype=torch.float64).expand(7, 3, 3), -se3.hat(points.mT)], dim=-1)
    rows = cross_rows(blocks[None], points[None])[0]
    torch.testing.assert_close(rows.permute(0, 3, 2, 1), matrices @ jacobian)
    vectors = torch.randn(2, 3, 7, dtype=torch.float64)
    expected = (matrices @ vectors.movedim(-1, 1)[..., None])[..., 0].sum(0).mT
    torch.testing.assert_close(symmetric_times(blocks[None], vectors[None])[0], expected)


@pytest.mark.parametrize("clusters", CLUSTERS.values(), ids=CLUSTERS.keys())
@pytest.mark.parametrize("frames", [1, 2, 3, 7])
@pytest.mark.parametrize("chunk", [6, 32_000])
def test_elimination_of_points_of_one_frame(
    frames: int, clusters: list[tuple[int, ...]], chunk: int, monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("torchstickcal.model.measurements._CHUNK_KEYPOINTS", {"cpu": chunk})
    dense, blocks, couplings = system(frames, clusters, smooth=False)
    check(parts(session(frames), clusters, couplings), blocks, dense)


@pytest.mark.parametrize("clusters", CLUSTERS.values(), ids=CLUSTERS.keys())
@pytest.mark.parametrize("frames", [3, 4, 5, 8, 11])
@pytest.mark.parametrize("together", [1, 1000])
def test_elimination_of_tracks(frames: int, clusters: list[tuple[int, ...]], together: int, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr("torchstickcal.solvers.elimination.parts._MAX_TRACK_POINTS", together)
    dense, blocks, couplings = system(frames, clusters, smooth=True)
    found = parts(session(frames), clusters, couplings)
    columns = torch.cat([torch.arange(frames * P)[part.columns] for part in found])
    assert sorted(columns.tolist()) == list(range(frames * P))
    check(found, blocks, dense)


def test_inverse_diagonal():
    _, blocks, _ = system(4, [], smooth=False)
    matrices = expand(blocks).movedim(-1, 0)
    torch.testing.assert_close(inverse_diagonal(blocks).mT, torch.linalg.inv(matrices).diagonal(dim1=1, dim2=2))


def test_what_is_not_finite_in_one_session_leaves_the_others_alone():
    diagonal = torch.eye(3, dtype=torch.float64).repeat(12, 1, 1)
    below = torch.full_like(diagonal, 0.1)
    below[3::4] = 0.0
    right = torch.ones(12, 3, 1, dtype=torch.float64)

    def solved(diagonal: torch.Tensor, right: torch.Tensor) -> torch.Tensor:
        solver = BlockTridiagonal(diagonal, below, levels=2, sessions=3)
        return solver.backward_solve(solver.forward_solve(right))

    expected = solved(diagonal, right)
    for bad in (4, 5, 6, 7):
        not_definite, not_finite = diagonal.clone(), right.clone()
        not_definite[bad] *= -1
        not_finite[bad] = torch.nan
        for found in (solved(not_definite, right), solved(diagonal, not_finite)):
            assert found[4:8].isnan().any()
            for others in (slice(0, 4), slice(8, 12)):
                torch.testing.assert_close(found[others], expected[others], rtol=0, atol=0)


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
    levels = (count - 1).bit_length()
    missing = -2 * count % 2**levels  # two chains one after another, with zeros between them, filled up with identities
    diagonal = torch.cat(
        [dense.diagonal(dim1=1, dim2=3).movedim(-1, 1).flatten(0, 1), torch.eye(4).double().expand(missing, 4, 4)]
    )
    under = torch.zeros(2, count, 4, 4, dtype=torch.float64)
    under[:, :-1] = dense.diagonal(-1, dim1=1, dim2=3).movedim(-1, 1)
    under = torch.cat([under.flatten(0, 1), torch.zeros(missing, 4, 4, dtype=torch.float64)])
    solver = BlockTridiagonal(diagonal, under, levels)
    right = torch.randn(2 * count + missing, 4, 3, dtype=torch.float64)
    solved = solver.forward_solve(right)
    assert [len(level) for level in solved] == solver.counts(2 * count + missing)
    expected = torch.linalg.solve(factor @ factor.mT, right[: 2 * count].reshape(2, -1, 3)).reshape(-1, 4, 3)
    torch.testing.assert_close(solver.backward_solve(solved)[: 2 * count], expected, rtol=1e-9, atol=1e-10)
