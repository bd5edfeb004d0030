"""The calibration from keypoints to a result; ``calibrate.py`` tells the story."""
