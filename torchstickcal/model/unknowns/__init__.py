"""What may be unknown of a camera beside its pose: one file per unknown, found by its name."""

from torchstickcal.model.unknowns.base import (
    CameraUnknown,
    ClockUnknown,
    Columns,
    ImageMotion,
    InUnits,
    LensUnknown,
    RigEstimate,
    Sharing,
    View,
)
from torchstickcal.model.unknowns.registered import (
    REFINEMENTS,
    Refinement,
    all_unknowns,
    clock_refinements,
    register_unknown,
    with_refinements,
)
from torchstickcal.model.unknowns.rig import RigUnknowns

__all__ = [
    "REFINEMENTS",
    "CameraUnknown",
    "ClockUnknown",
    "Columns",
    "ImageMotion",
    "InUnits",
    "LensUnknown",
    "Refinement",
    "RigEstimate",
    "RigUnknowns",
    "Sharing",
    "View",
    "all_unknowns",
    "clock_refinements",
    "register_unknown",
    "with_refinements",
]
