"""How the library's own configurations appear in the tables. A configuration without a listing gets its name as the title."""

from __future__ import annotations

from torchstickcal.benchmark.baselines import Listing, PublishedErrors
from torchstickcal.benchmark.baselines.base import OWN_CONFIGURATIONS
from torchstickcal.benchmark.baselines.reasons import CONVERGED

_RESCALED = (
    "The closed-form scale is applied again after the last stage. Without it the error of the converged published objective "
    "is 405 mm, because the smoothness term shrinks the scene against the weak length term. With it neither term changes the "
    "cameras much."
)

PROFILED = frozenset({"default", "paper"})
"""The configurations whose memory is measured."""

LISTINGS: dict[str, Listing] = {
    "default": Listing(
        "torchstickcal, `default`", {"sota": None, "inputs": None, "ablation": None}, position=OWN_CONFIGURATIONS + 30
    ),
    "lbfgs": Listing("torchstickcal, `lbfgs`", {"sota": None}, position=OWN_CONFIGURATIONS + 20),
    "paper": Listing(
        "torchstickcal, `paper` (the published method)",
        {
            "sota": PublishedErrors(0.020, 0.001),
            "inputs": PublishedErrors(0.020, 0.001, 0.014, 0.001),
            "ablation": PublishedErrors(0.020, 0.001),
        },
        (_RESCALED, CONVERGED),
        position=OWN_CONFIGURATIONS + 10,
    ),
    "without_length": Listing(
        "`paper` without length constraint",
        {"ablation": PublishedErrors(0.091, 0.011)},
        (_RESCALED, CONVERGED),
        position=OWN_CONFIGURATIONS + 11,
    ),
    "without_smoothness": Listing(
        "`paper` without temporal smoothness",
        {"ablation": PublishedErrors(0.022, 0.002)},
        (_RESCALED, CONVERGED),
        position=OWN_CONFIGURATIONS + 12,
    ),
    "stick_only": Listing(
        "Stick, given length",
        {"inputs": PublishedErrors(0.023, 0.001, 0.018, 0.001)},
        (CONVERGED,),
        position=OWN_CONFIGURATIONS,
    ),
    "human_only": Listing("Human, 1.72 m for everybody", {"inputs": None}, position=13),
}
"""By the name of the configuration."""


def listing_of(config: str) -> Listing:
    """The listing of a configuration."""
    return LISTINGS.get(config) or Listing(f"torchstickcal, `{config}`", position=OWN_CONFIGURATIONS + 15)
