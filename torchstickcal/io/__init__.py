"""Files: sessions and calibrations are read, and calibrations are written, in formats that are found by name.

Example:
    >>> from torchstickcal.io import CALIBRATION_READERS, CALIBRATION_WRITERS, SESSION_READERS
    >>> "npz" in SESSION_READERS, "pose2sim" in CALIBRATION_READERS, CALIBRATION_WRITERS["pose2sim"].file_name
    (True, True, 'calibration.toml')
"""

from torchstickcal.io.camera_toml import read_camera_toml, write_camera_toml
from torchstickcal.io.formats import (
    CALIBRATION_READERS,
    CALIBRATION_WRITERS,
    SESSION_READERS,
    Reader,
    Session,
    Writer,
    calibration_reader,
    calibration_writer,
    find_reader,
    read_calibration,
    read_session,
    reading,
    session_reader,
    write_calibration,
)
from torchstickcal.io.npz import read_npz, write_npz
from torchstickcal.io.rig import Rig
from torchstickcal.io.sports_stick_syn import SPORTS_STICK_SYN_JOINTS, read_sports_stick_syn
from torchstickcal.io.truth import Truth

__all__ = [
    "CALIBRATION_READERS",
    "CALIBRATION_WRITERS",
    "SESSION_READERS",
    "SPORTS_STICK_SYN_JOINTS",
    "Reader",
    "Rig",
    "Session",
    "Truth",
    "Writer",
    "calibration_reader",
    "calibration_writer",
    "find_reader",
    "read_calibration",
    "read_camera_toml",
    "read_npz",
    "read_session",
    "read_sports_stick_syn",
    "reading",
    "session_reader",
    "write_calibration",
    "write_camera_toml",
    "write_npz",
]
