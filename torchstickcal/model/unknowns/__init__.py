"""What may be unknown of a camera beside its pose: one file per unknown, found by its name."""

from torchstickcal.model.unknowns.base import (
    REFINEMENTS,
    CameraUnknown,
    ClockUnknown,
    Columns,
    ImageMotion,
    InUnits,
    LensUnknown,
    Refinement,
    RigEstimate,
    Sharing,
    View,
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
