"""CalibPerson (Lee et al., "Extrinsic camera calibration from a moving person", RA-L 2022).

The directions of the limbs give the relative rotations, the keypoints then give the translations, both by linear equations. A
bundle adjustment with bones of constant length follows. In the published method a neural network estimates the 3D directions
of the limbs from each view. Here they are an input: the true directions with noise as of such a network.
"""

from __future__ import annotations

import torch
from torch import Tensor

from torchstickcal.benchmark.baselines.base import Estimate, Inputs, Listing, PublishedErrors, baseline, required
from torchstickcal.benchmark.baselines.frame_adjustment import FrameResiduals, adjust
from torchstickcal.benchmark.baselines.joints import bone_indices, joint_measurements, scaled_by_height
from torchstickcal.benchmark.baselines.reasons import CONVERGED, HEIGHT
from torchstickcal.losses import ReprojectionLoss
from torchstickcal.model.measurements import Measurements
from torchstickcal.model.state import State

_SIGMA_LENGTH_SHARE = 0.01
_TINY = 1e-12


@baseline(
    "calib_person",
    Listing("CalibPerson", {"sota": PublishedErrors(0.268, 0.072)}, (HEIGHT, CONVERGED), position=21),
    needs=("orientations", "height_m"),
    title_in_motion="CalibPerson, true mean height in motion",
)
def calib_person(inputs: Inputs) -> Estimate:
    """Rotations by Procrustes alignment of the limbs, translations, bundle adjustment, scale from the height.

    Args:
        inputs: needs ``orientations`` and ``height_m``.

    Raises:
        ObservationError: if the joints of the limbs are not among the points.
    """
    observations = inputs.observations
    orientations = torch.as_tensor(required(inputs, "orientations"), dtype=torch.float64)
    bones = torch.tensor(bone_indices(observations))
    measurements = joint_measurements(observations)
    rotations = relative_rotations(orientations)
    state = scaled_by_height(inputs, measurements, linear_state(measurements, rotations, bones))
    adjusted = adjust(measurements, state, ReprojectionLoss(), _length_variance(measurements, bones))
    state = scaled_by_height(inputs, measurements, adjusted.state)
    status = "converged" if adjusted.converged else "the bundle adjustment stopped before it had converged"
    return Estimate.of_state(state, status)


def relative_rotations(orientations: Tensor) -> Tensor:
    """Rotations from the first camera to each camera, by Procrustes alignment of the limb directions.

    Args:
        orientations: unit vectors (C, F, B, 3); NaN where not known.

    Returns:
        (C, 3, 3).
    """
    directions = orientations.flatten(1, 2)
    both = (directions.isfinite().all(-1) & directions[:1].isfinite().all(-1))[..., None]
    products = directions.where(both, 0.0).mT @ directions[:1].where(both, 0.0)
    u, _, vh = torch.linalg.svd(products)
    signs = torch.ones_like(products[..., 0])
    signs[:, 2] = torch.det(u @ vh)
    return u @ (signs[..., None] * vh)


def linear_state(measurements: Measurements, rotations: Tensor, bones: Tensor) -> State:
    """Translations and points up to scale at known rotations: the solution of a homogeneous linear system.

    Collinearity: a point lies on the ray of each camera that sees it. Coplanarity: a limb lies in the plane through the camera
    centre and the image of the limb. The points of each frame are eliminated. The solution is the eigenvector of the smallest
    eigenvalue for the translations of all cameras but the first, with the sign that puts the points in front of the cameras.

    Args:
        measurements: of one session.
        rotations: (C, 3, 3).
        bones: indices of the two joints of each limb, (B, 2).
    """
    m = measurements
    cameras, joints = len(rotations), m.points_per_frame
    rays = m.cameras[0].undistort(m.pixels[0].movedim(1, -1))
    visible = m.by_frame(m.visible[0] & rays.isfinite().all(-1)).movedim(1, 0)
    rays = m.by_frame(torch.cat([rays, torch.ones_like(rays[..., :1])], dim=-1).nan_to_num().movedim(-1, 0)).permute(2, 1, 3, 0)

    # In camera axes: rows e1 - u e3 and e2 - v e3, (F, C, J, 2, 3), are orthogonal to the point with image (u, v); normals,
    # (F, C, B, 3), are orthogonal to the limb.
    across = (torch.eye(3).to(rays)[:2] - rays[..., :2, None] * torch.eye(3).to(rays)[2]) * visible[..., None, None]
    normals = torch.linalg.cross(rays[:, :, bones[:, 0]], rays[:, :, bones[:, 1]], dim=-1)
    normals = normals / normals.norm(dim=-1, keepdim=True).clamp_min(_TINY) * visible[:, :, bones].all(-1)[..., None]
    on_points = torch.einsum("fcjka,cab,ji->fcjkib", across, rotations, torch.eye(joints).to(rays)).flatten(4).flatten(1, 3)
    on_shifts = torch.einsum("fcjka,cd->fcjkda", across, torch.eye(cameras).to(rays)).flatten(4).flatten(1, 3)[..., 3:]
    limbs = torch.nn.functional.one_hot(bones[:, 1], joints) - torch.nn.functional.one_hot(bones[:, 0], joints)
    on_limbs = torch.einsum("fcka,cab,ki->fckib", normals, rotations, limbs.to(rays)).flatten(3).flatten(1, 2)

    hessian = on_points.mT @ on_points + on_limbs.mT @ on_limbs
    unseen = ~m.by_frame(m.active[0]).repeat_interleave(3, dim=1)
    hessian = hessian + unseen.to(rays).diag_embed()
    cross = on_points.mT @ on_shifts
    response = -torch.linalg.solve(hessian, cross)
    reduced = (on_shifts.mT @ on_shifts + cross.mT @ response).sum(0)
    shifts = torch.linalg.eigh(reduced).eigenvectors[:, 0]
    points = (response @ shifts).view(-1, 3).mT
    state = State.of(rotations[None], torch.cat([shifts.new_zeros(3), shifts]).view(1, cameras, 3), points[None])
    in_front = ((state.in_cameras()[..., 2, :] > 0) & m.visible).sum()
    return state.scaled(torch.where(2 * in_front > m.visible.sum(), 1.0, -1.0)[None])


def _length_variance(measurements: Measurements, bones: Tensor) -> FrameResiduals:
    """Residuals (F, B): logarithm of a bone's length minus the mean logarithm over the session; independent of the scale."""
    complete = measurements.by_frame(measurements.active[0])[:, bones].all(-1)

    def residuals(points: Tensor) -> Tensor:
        limbs = (points[:, bones[:, 1]] - points[:, bones[:, 0]]).where(complete[..., None], 1.0)
        logs = limbs.norm(dim=-1).log()
        mean = ((logs * complete).sum(0) / complete.sum(0).clamp_min(1)).detach()
        return (logs - mean).where(complete, 0.0) / _SIGMA_LENGTH_SHARE

    return residuals
