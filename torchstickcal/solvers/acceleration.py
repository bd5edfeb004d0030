"""Fixed-point iterations, accelerated by what their earlier steps have shown (Anderson's method).

Near the end of an iteration its steps are linear in the distance to the end. So the combination of the last few steps that is
shortest says how far to go. On a linear iteration the method is equivalent to GMRES.

Reference: Walker and Ni, "Anderson acceleration for fixed-point iterations", 2011.
"""

from __future__ import annotations

import torch
from torch import Tensor

_MEMORY = 6
_ROUNDING = 1e-12
"""Relative size of what tells nothing about the others."""


class Acceleration:
    """Better steps from the plain steps of an iteration, for B sessions independently.

    A step is given in two forms, as it is and times a metric, both (B, D). The inner product of two steps is that of one as it
    is and the other times the metric.
    """

    def __init__(self) -> None:
        self._changes: list[tuple[Tensor, Tensor]] = []
        self._detours: list[tuple[Tensor, Tensor]] = []
        """what the step was, beyond the change that it made of the next plain step"""
        self._before: tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]] | None = None

    def step(self, plain: Tensor, times_metric: Tensor) -> tuple[Tensor, Tensor]:
        """The step to take instead of a plain one; in both forms, too."""
        now = plain, times_metric
        if self._before is not None:
            before, taken = self._before
            change = now[0] - before[0], now[1] - before[1]
            self._changes = [*self._changes, change][-_MEMORY:]
            self._detours = [*self._detours, (taken[0] + change[0], taken[1] + change[1])][-_MEMORY:]
        taken = now
        if self._changes:
            changes, dual_changes = (torch.stack(forms, dim=1) for forms in zip(*self._changes, strict=True))
            products = changes @ dual_changes.mT
            inverse = torch.linalg.pinv((products + products.mT) / 2, rtol=_ROUNDING, hermitian=True)
            shares = (inverse @ (changes @ times_metric[..., None])).mT
            detours = (torch.stack(forms, dim=1) for forms in zip(*self._detours, strict=True))
            by_form = [form - (shares @ detour)[:, 0] for form, detour in zip(now, detours, strict=True)]
            taken = by_form[0], by_form[1]
        self._before = now, taken
        return taken
