"""Two solvers with the same interface: Gauss-Newton with exact elimination of the points, and torch.optim.LBFGS."""

from __future__ import annotations

from torchstickcal.solvers.base import IterationRecord, Listener, Outcome, Solver, StageRecord, Stop, Termination, ignore_record
from torchstickcal.solvers.gauss_newton import gauss_newton

__all__ = [
    "SOLVERS",
    "IterationRecord",
    "Listener",
    "Outcome",
    "Solver",
    "StageRecord",
    "Stop",
    "Termination",
    "gauss_newton",
    "ignore_record",
    "solver",
]

SOLVERS = ("gauss_newton", "lbfgs")


def solver(name: str) -> Solver:
    """The solver with one of the names in ``SOLVERS``. Only ``lbfgs`` imports kornia."""
    if name == "lbfgs":
        from torchstickcal.solvers.lbfgs import lbfgs

        return lbfgs
    return gauss_newton
