"""Files in and out: sessions of keypoints, and cameras for the programs that use them."""

from torchstickcal.io.camera_toml import Rig, read_camera_toml, write_camera_toml
from torchstickcal.io.session import Truth, read_npz, read_session, read_sports_stick_syn, write_npz

__all__ = [
    "Rig",
    "Truth",
    "read_camera_toml",
    "read_npz",
    "read_session",
    "read_sports_stick_syn",
    "write_camera_toml",
    "write_npz",
]
