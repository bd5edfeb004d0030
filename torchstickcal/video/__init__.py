"""Keypoints from videos: frames with their times, body keypoints by ONNX networks, and the marked ends of a stick.

Example:
    >>> from torchstickcal.video.tape import HUES
    >>> list(HUES)
    ['red', 'orange', 'yellow', 'green', 'cyan', 'blue', 'magenta']
"""

from torchstickcal.video.detect import VideoKeypoints, detect, detect_video
from torchstickcal.video.frames import frames_of, video_info
from torchstickcal.video.pose import BodyDetector, RtmlibModel, SimccModel

__all__ = [
    "BodyDetector",
    "RtmlibModel",
    "SimccModel",
    "VideoKeypoints",
    "detect",
    "detect_video",
    "frames_of",
    "video_info",
]
