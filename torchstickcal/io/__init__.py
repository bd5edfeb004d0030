"""Files: sessions, detectors' keypoints and calibrations are read, and calibrations are written, in formats found by name.

Example:
    >>> from torchstickcal.io import CALIBRATION_READERS, CALIBRATION_WRITERS, SESSION_READERS
    >>> "npz" in SESSION_READERS, "pose2sim" in CALIBRATION_READERS, CALIBRATION_WRITERS["pose2sim"].file_name
    (True, True, 'calibration.toml')
"""

from torchstickcal.io.camera_toml import read_camera_toml, write_camera_toml
from torchstickcal.io.formats import (
    CALIBRATION_READERS,
    KEYPOINT_READERS,
    SESSION_READERS,
    Reader,
    Session,
    calibration_reader,
    camera_reader,
    find_reader,
    keypoint_reader,
    read_calibration,
    reading,
    session_reader,
)
from torchstickcal.io.given import Given, complete
from torchstickcal.io.motion import Motion
from torchstickcal.io.movement import recording_of_movement
from torchstickcal.io.npz import read_npz, write_npz
from torchstickcal.io.recording import Detection, Recording, View
from torchstickcal.io.rig import Rig, RigCamera
from torchstickcal.io.sessions import LoadedSession, load_session, read_recording, read_session
from torchstickcal.io.sports_stick_syn import read_sports_stick_syn
from torchstickcal.io.truth import Truth
from torchstickcal.io.writers import (
    CALIBRATION_WRITERS,
    Writer,
    calibration_writer,
    camera_writer,
    point_writer,
    write_calibration,
)
from torchstickcal.skeletons import SKELETONS, SPORTS_STICK_SYN_JOINTS

__all__ = [
    "CALIBRATION_READERS",
    "CALIBRATION_WRITERS",
    "KEYPOINT_READERS",
    "SESSION_READERS",
    "SKELETONS",
    "SPORTS_STICK_SYN_JOINTS",
    "Detection",
    "Given",
    "LoadedSession",
    "Motion",
    "Reader",
    "Recording",
    "Rig",
    "RigCamera",
    "Session",
    "Truth",
    "View",
    "Writer",
    "calibration_reader",
    "calibration_writer",
    "camera_reader",
    "camera_writer",
    "complete",
    "find_reader",
    "keypoint_reader",
    "load_session",
    "point_writer",
    "read_calibration",
    "read_camera_toml",
    "read_npz",
    "read_recording",
    "read_session",
    "read_sports_stick_syn",
    "reading",
    "recording_of_movement",
    "session_reader",
    "write_calibration",
    "write_camera_toml",
    "write_npz",
]
