"""What may happen to sessions: to keypoints, and to everything else that observations are made of."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

Arguments = dict[str, Any]
"""Arguments of :class:`~torchstickcal.Observations`."""

Spoil = Callable[[Arguments, np.random.Generator], object]
"""Changes some arguments in place."""
