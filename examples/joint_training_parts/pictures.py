"""Pictures of crops with what is true, and what was found."""

from __future__ import annotations

import torch
from torch import Tensor
from torch.nn import functional

from joint_training_parts.detections import Detections
from joint_training_parts.scenes import SIZE, Sessions

_ZOOM = 4


def crops_with_keypoints(sessions: Sessions, found: Detections, confidence: Tensor, rows: int = 4) -> Tensor:
    """A sheet (3, H, W), 0 to 1, of all cameras, with a frame of each of some sessions in its rows.

    Labels are black, keypoints are white where they are trusted most in the picture and red where least, with lines between.
    """
    labels, keypoints = sessions.in_crops(sessions.labels), sessions.in_crops(found.keypoints.float())
    strips = []
    for session in range(min(rows, len(sessions.images))):
        frame = session % sessions.images.shape[2]
        zoomed = functional.interpolate(sessions.images[session, :, frame] / 255.0, scale_factor=_ZOOM)
        trust = confidence[session, :, frame].float()
        trust = trust / trust.amax()
        for picture, label, keypoint, trusted in zip(
            zoomed, labels[session, :, frame], keypoints[session, :, frame], trust, strict=True
        ):
            for share in torch.linspace(0, 1, 2 * SIZE).tolist():
                _dot(picture, label + share * (keypoint - label), torch.zeros(len(label), 3), 0)
            _dot(picture, label, torch.zeros(len(label), 3), 1)
            _dot(picture, keypoint, torch.stack([torch.ones_like(trusted), trusted, trusted], dim=-1), 1)
        strips.append(torch.cat(list(zoomed), dim=2))
    return torch.cat(strips, dim=1)


def _dot(picture: Tensor, places: Tensor, colours: Tensor, radius: int) -> None:
    """Draw squares at places (P, 2), pixels of the crop, into a zoomed crop (3, H, W), in place."""
    centres = ((places + 0.5) * _ZOOM).long()
    for dx in range(-radius, radius + 1):
        for dy in range(-radius, radius + 1):
            x, y = (centres + torch.tensor([dx, dy])).unbind(-1)
            inside = (x >= 0) & (y >= 0) & (x < picture.shape[2]) & (y < picture.shape[1])
            picture[:, y[inside], x[inside]] = colours[inside].mT
