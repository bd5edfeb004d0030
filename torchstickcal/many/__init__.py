"""Many sessions, calibrated on any executor: what was done is written at once, so that an interrupted run continues.

:func:`calibrate_many` is the way in; ``torchstickcal calibrate-many`` is the same as a command.
"""

from torchstickcal.many.manifest import SessionRow, read_manifests
from torchstickcal.many.many import ManyCalibrations, calibrate_many
from torchstickcal.many.sources import SessionFile, session_files

__all__ = ["ManyCalibrations", "SessionFile", "SessionRow", "calibrate_many", "read_manifests", "session_files"]
