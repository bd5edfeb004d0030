"""Cameras for other libraries: kornia, PyTorch3D, nerfstudio and OpenGL, in both directions.

torchstickcal has OpenCV's conventions: ``x_camera = R x_world + t``, x to the right, y down, z forward, and the centre of the
first pixel at (0, 0). Pinhole cameras have no lens distortion. All conversions keep gradients, dtype, device and leading
dimensions.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import torch
from kornia.geometry.camera import PinholeCamera
from torch import Tensor

from torchstickcal.arrays import tensor_of
from torchstickcal.errors import CalibrationError
from torchstickcal.geometry import se3

_NERFSTUDIO_CORNER = 0.5
"""Where nerfstudio counts pixels from the corner of the first one, OpenCV counts from its centre."""


class HasCameras(Protocol):
    """A :class:`torchstickcal.Calibration` or :class:`torchstickcal.LayerResult`."""

    @property
    def rotations(self) -> Tensor: ...
    @property
    def translations(self) -> Tensor: ...
    @property
    def intrinsics(self) -> Tensor: ...
    @property
    def distortion(self) -> Tensor | None: ...


@dataclass(frozen=True, eq=False)
class PinholeCameras:
    """Cameras without lens distortion, in OpenCV's conventions.

    Example:
        >>> from torchstickcal import calibrate
        >>> from torchstickcal.simulate import golf_session
        >>> observations, truth = golf_session(cameras=3, frames=10)
        >>> found = calibrate(observations)
        >>> cameras = PinholeCameras(found.rotations, found.translations, found.intrinsics, found.image_size)
        >>> cameras.to_kornia().extrinsics.shape, cameras.to_opengl().shape
        (torch.Size([3, 4, 4]), torch.Size([3, 4, 4]))
        >>> sorted(cameras.to_pytorch3d())
        ['R', 'T', 'focal_length', 'image_size', 'in_ndc', 'principal_point']
    """

    rotations: Tensor
    """(..., 3, 3), world to camera"""
    translations: Tensor
    """(..., 3), world to camera, metres"""
    intrinsics: Tensor
    """(..., 3, 3), camera matrices, pixels"""
    image_size: Tensor | None = None
    """(..., 2), width and height, pixels"""

    @staticmethod
    def of(cameras: HasCameras, image_size: Any = None) -> PinholeCameras:
        """The cameras of a calibration or of a result of the layer.

        Args:
            cameras: the calibration.
            image_size: (2,) or (..., C, 2), width and height, pixels; None for those of the calibration, if it knows them.

        Raises:
            CalibrationError: if the lenses have distortion, which these cameras cannot have.
        """
        if cameras.distortion is not None and bool((cameras.distortion != 0).any()):
            raise CalibrationError(
                "pinhole cameras have no lens distortion",
                where="distortion",
                got="coefficients that are not zero",
                expected="None or zeros",
                remedy="Undistort images or keypoints first (Intrinsics.undistort); then make PinholeCameras of the tensors.",
            )
        size = getattr(cameras, "image_size", None) if image_size is None else tensor_of(image_size, "image_size")
        if size is not None:
            size = size.to(cameras.translations).expand(*cameras.translations.shape[:-1], 2)
        return PinholeCameras(cameras.rotations, cameras.translations, cameras.intrinsics, size)

    def to_kornia(self) -> PinholeCamera:
        """kornia's camera, with all leading dimensions as its one batch dimension.

        Raises:
            CalibrationError: without an image size.
        """
        width, height = self._size("kornia.PinholeCamera").reshape(-1, 2).unbind(-1)
        pose = torch.cat([self.rotations, self.translations[..., None]], dim=-1)
        matrix = torch.nn.functional.pad(self.intrinsics, (0, 1))
        return PinholeCamera(_homogeneous(matrix).reshape(-1, 4, 4), _homogeneous(pose).reshape(-1, 4, 4), height, width)

    @staticmethod
    def from_kornia(camera: PinholeCamera) -> PinholeCameras:
        """Cameras (N, ...) of kornia's."""
        extrinsics = camera.extrinsics
        size = torch.stack([camera.width, camera.height], dim=-1).to(extrinsics)
        return PinholeCameras(extrinsics[..., :3, :3], extrinsics[..., :3, 3], camera.intrinsics[..., :3, :3], size)

    def to_pytorch3d(self) -> dict[str, Any]:
        """Arguments of PyTorch3D's ``PerspectiveCameras``: ``PerspectiveCameras(**cameras.to_pytorch3d())``.

        PyTorch3D multiplies rows, ``x_camera = x_world R + T``, with x to the left and y up. ``image_size`` is (height, width).
        As in PyTorch3D's own ``cameras_from_opencv_projection``, the principal point is the same number of pixels.

        Raises:
            CalibrationError: without an image size, or with a skew, which PyTorch3D's cameras do not have.
        """
        self._check_skew("pytorch3d")
        turn = self._turn(-1.0, -1.0, 1.0)
        return {
            "R": self.rotations.mT * turn,
            "T": self.translations * turn,
            "focal_length": self.intrinsics.diagonal(dim1=-2, dim2=-1)[..., :2],
            "principal_point": self.intrinsics[..., :2, 2],
            "image_size": self._size("pytorch3d").flip(-1),
            "in_ndc": False,
        }

    @staticmethod
    def from_pytorch3d(
        R: Tensor, T: Tensor, focal_length: Tensor, principal_point: Tensor, image_size: Tensor
    ) -> PinholeCameras:
        """Cameras of PyTorch3D's, given in pixels (``in_ndc=False``).

        Args:
            R: (..., 3, 3), for rows.
            T: (..., 3).
            focal_length: (..., 2), pixels.
            principal_point: (..., 2), pixels.
            image_size: (..., 2), height and width, pixels.
        """
        turn = R.new_tensor([-1.0, -1.0, 1.0])
        matrix = _matrix(focal_length, principal_point)
        return PinholeCameras((R * turn).mT, T * turn, matrix, image_size.flip(-1))

    def to_opengl(self) -> Tensor:
        """Poses (..., 4, 4) from camera to world, with y up and z backwards: those of OpenGL, Blender and nerfstudio."""
        centres = se3.camera_centres(self.rotations, self.translations)
        turned = self.rotations.mT * self._turn(1.0, -1.0, -1.0)
        return _homogeneous(torch.cat([turned, centres[..., None]], dim=-1))

    @staticmethod
    def from_opengl(camera_to_world: Tensor, intrinsics: Tensor, image_size: Tensor | None = None) -> PinholeCameras:
        """Cameras of poses (..., 4, 4) or (..., 3, 4) as :meth:`to_opengl` gives them.

        Args:
            camera_to_world: the poses.
            intrinsics: (..., 3, 3), pixels, as OpenCV counts them.
            image_size: (..., 2), width and height, pixels.
        """
        rotations = (camera_to_world[..., :3, :3] * camera_to_world.new_tensor([1.0, -1.0, -1.0])).mT
        translations = -(rotations @ camera_to_world[..., :3, 3:])[..., 0]
        return PinholeCameras(rotations, translations, intrinsics, image_size)

    def to_nerfstudio(self) -> dict[str, Tensor]:
        """Arguments of nerfstudio's ``Cameras``: ``Cameras(**cameras.to_nerfstudio())``.

        Its poses are those of :meth:`to_opengl` without their last row. It counts pixels from the corner of the first one, so
        that its principal point is half a pixel larger.

        Raises:
            CalibrationError: without an image size, or with a skew, which nerfstudio's cameras do not have.
        """
        self._check_skew("nerfstudio")
        width, height = self._size("nerfstudio").long().split(1, dim=-1)
        cx, cy = (self.intrinsics[..., :2, 2] + _NERFSTUDIO_CORNER).split(1, dim=-1)
        fx, fy = self.intrinsics[..., 0, 0, None], self.intrinsics[..., 1, 1, None]
        camera_to_worlds = self.to_opengl()[..., :3, :]
        return {"camera_to_worlds": camera_to_worlds, "fx": fx, "fy": fy, "cx": cx, "cy": cy, "width": width, "height": height}

    @staticmethod
    def from_nerfstudio(
        camera_to_worlds: Tensor, fx: Tensor, fy: Tensor, cx: Tensor, cy: Tensor, width: Tensor, height: Tensor
    ) -> PinholeCameras:
        """Cameras of nerfstudio's fields: poses (..., 3, 4) or (..., 4, 4), the others (..., 1)."""
        matrix = _matrix(torch.cat([fx, fy], dim=-1), torch.cat([cx, cy], dim=-1) - _NERFSTUDIO_CORNER)
        size = torch.cat([width, height], dim=-1).to(camera_to_worlds)
        return PinholeCameras.from_opengl(camera_to_worlds, matrix, size)

    def _turn(self, *signs: float) -> Tensor:
        return self.translations.new_tensor(signs)

    def _size(self, wanted_by: str) -> Tensor:
        if self.image_size is None:
            expected = "width and height, (..., 2), pixels"
            raise CalibrationError(
                f"a camera of {wanted_by} needs the size of its image", where="image_size", got=None, expected=expected
            )
        return self.image_size

    def _check_skew(self, wanted_by: str) -> None:
        if bool((self.intrinsics[..., 0, 1] != 0).any()):
            raise CalibrationError(
                f"cameras of {wanted_by} have no skew", where="intrinsics", got="a skew that is not zero", expected="zero"
            )


def _homogeneous(rows: Tensor) -> Tensor:
    """Matrices (..., 4, 4) of their first three rows."""
    return torch.cat([rows, rows.new_tensor([0.0, 0.0, 0.0, 1.0]).expand(*rows.shape[:-2], 1, 4)], dim=-2)


def _matrix(focal_px: Tensor, principal_point: Tensor) -> Tensor:
    """Camera matrices (..., 3, 3) of focal lengths and principal points (..., 2)."""
    rows = torch.cat([torch.diag_embed(focal_px), principal_point[..., None]], dim=-1)
    return torch.cat([rows, rows.new_tensor([0.0, 0.0, 1.0]).expand(*rows.shape[:-2], 1, 3)], dim=-2)
