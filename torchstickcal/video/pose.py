"""Body keypoints in images, by networks in the ONNX format."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from torchstickcal.errors import CalibrationError, FileFormatError
from torchstickcal.video.frames import Image

Array = NDArray[np.float64]

_MEAN, _SPREAD = np.array([123.675, 116.28, 103.53], np.float32), np.array([58.395, 57.12, 57.375], np.float32)
"""Of the colours of ImageNet, as the networks of MMPose and RTMLib expect them."""
_BINS_PER_PIXEL = 2.0
_MARGIN = 1.25
_LEAST_SCORE = 0.3


class BodyDetector(Protocol):
    """What finds the keypoints of the athlete in an image."""

    def __call__(self, image: Image) -> Array:
        """Keypoints (P, 3): x and y in pixels, and a score."""
        ...


class SimccModel:
    """A network of the kind of RTMPose: a crop of one person in, a distribution along x and one along y for each point out.

    The person is looked for in the whole image first, then around the keypoints of the frame before.

    Args:
        path: of the weights, an ``.onnx`` file.

    Raises:
        CalibrationError: if onnxruntime is not installed.
        FileFormatError: if the file is no such network.
        FileNotFoundError: if there is no such file.
    """

    def __init__(self, path: str | Path) -> None:
        if not Path(path).is_file():
            raise FileNotFoundError(f"no such file of weights: {path}")
        self._session = _session(path)
        inputs, outputs = self._session.get_inputs(), self._session.get_outputs()
        shape = inputs[0].shape
        if len(inputs) != 1 or len(outputs) != 2 or len(shape) != 4 or not all(isinstance(n, int) for n in shape[2:]):
            raise FileFormatError(
                "a network of another kind",
                where=str(path),
                got=f"{len(inputs)} inputs, {len(outputs)} outputs, the first input of shape {shape}",
                expected="one image (1, 3, H, W) in, two distributions (1, P, bins) out, as of RTMPose",
            )
        self._name, (self._height, self._width) = inputs[0].name, shape[2:]
        self._box: tuple[float, float, float, float] | None = None

    def __call__(self, image: Image) -> Array:
        """Keypoints (P, 3): x and y in pixels, and a score."""
        keypoints = self._within(image, self._box or (0.0, 0.0, float(image.shape[1]), float(image.shape[0])))
        seen = keypoints[keypoints[:, 2] >= _LEAST_SCORE]
        if len(seen) < max(2, len(keypoints) // 4):
            if self._box is not None:  # lost: look in the whole image again
                self._box = None
                return self(image)
            return keypoints
        low, high = seen[:, :2].min(0), seen[:, :2].max(0)
        self._box = (float(low[0]), float(low[1]), float(high[0]), float(high[1]))
        return keypoints

    def _within(self, image: Image, box: tuple[float, float, float, float]) -> Array:
        """Keypoints in a box: left, top, right, bottom."""
        centre = np.array([box[0] + box[2], box[1] + box[3]]) / 2
        size = np.maximum(_MARGIN * np.array([box[2] - box[0], box[3] - box[1]]), 16.0)
        scale = max(size[0] / self._width, size[1] / self._height)
        corner = centre - scale * np.array([self._width, self._height]) / 2
        to_image = np.array([[scale, 0, corner[0]], [0, scale, corner[1]]])
        crop = cv2.warpAffine(image, to_image, (self._width, self._height), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
        pixels = ((crop[..., ::-1].astype(np.float32) - _MEAN) / _SPREAD).transpose(2, 0, 1)[None]
        along_x, along_y = self._session.run(None, {self._name: np.ascontiguousarray(pixels)})
        return _decoded(np.asarray(along_x)[0], np.asarray(along_y)[0], scale, corner)


def _decoded(along_x: Array, along_y: Array, scale: float, corner: Array) -> Array:
    """Keypoints (P, 3) of distributions (P, bins), with the maximum between bins by a parabola."""
    places, peaks = [], []
    for bins in (along_x.astype(np.float64), along_y.astype(np.float64)):
        best = bins.argmax(-1)
        inner = np.clip(best, 1, bins.shape[1] - 2)
        before, here, after = (np.take_along_axis(bins, (inner + k)[:, None], 1)[:, 0] for k in (-1, 0, 1))
        bend = before - 2 * here + after
        step = np.where((inner == best) & (bend < 0), 0.5 * (before - after) / np.where(bend < 0, bend, -1.0), 0.0)
        places.append((best + step) / _BINS_PER_PIXEL)
        peaks.append(bins.max(-1))
    score = np.clip(np.minimum(*peaks), 0.0, 1.0)
    return np.column_stack([scale * np.stack(places, axis=-1) + corner, score])


class RtmlibModel:
    """RTMLib's detector of body and feet (halpe-26). It keeps its weights in a cache of its own, loaded when first used.

    The largest person of each image is taken.

    Raises:
        CalibrationError: if rtmlib is not installed.
    """

    def __init__(self, mode: str = "balanced") -> None:
        try:
            from rtmlib import BodyWithFeet  # pyright: ignore[reportMissingImports]
        except ImportError as error:
            raise _not_installed("rtmlib") from error
        self._model: Any = BodyWithFeet(mode=mode, backend="onnxruntime", device="cpu")

    def __call__(self, image: Image) -> Array:
        """Keypoints (26, 3): x and y in pixels, and a score."""
        keypoints, scores = self._model(image)
        found = np.concatenate([np.asarray(keypoints, float), np.asarray(scores, float)[..., None]], axis=-1)
        if not len(found):
            return np.full((26, 3), [np.nan, np.nan, 0.0])
        return max(found, key=lambda person: float(np.ptp(person[:, :2], axis=0).prod()))


def _session(path: str | Path) -> Any:
    try:
        import onnxruntime  # pyright: ignore[reportMissingImports]
    except ImportError as error:
        raise _not_installed("onnxruntime") from error
    options = onnxruntime.SessionOptions()
    options.log_severity_level = 4
    try:
        return onnxruntime.InferenceSession(str(path), options, providers=["CPUExecutionProvider"])
    except Exception as error:
        raise FileFormatError(
            "a file is no network that onnxruntime can run",
            where=str(path),
            got=" ".join(str(error).split())[:200],
            expected="weights in the ONNX format",
        ) from error


def _not_installed(package: str) -> CalibrationError:
    return CalibrationError(
        "body keypoints need a package that is not installed",
        where="--weights",
        got=f"no package {package}",
        expected=f"the package {package}",
        remedy='Install it with `pip install "torchstickcal[video]"`.',
    )
