"""GTSAM: robust Levenberg-Marquardt on projections and the stick's length, initialised with OpenCV.

GTSAM has no initialisation for such a scene, so this script has one: essential matrices by RANSAC and ``recoverPose`` for all
pairs of cameras, a tree of the pairs with most inliers, relative scales from points that two pairs have in common, then linear
triangulation of the points from all views. The keypoints are assumed to have a standard deviation of 2.5 pixels, the stick of 1
mm; both have a Cauchy kernel with GTSAM's constant. The time includes initialisation and optimisation, but not building the
graph.
"""

from __future__ import annotations

import itertools
import time

import cv2
import gtsam
import numpy as np
from gtsam.symbol_shorthand import L, X
from numpy.typing import NDArray
from sessions import Array, Found, NotCalibratedError, Session, main, stick_scale

SIGMA_PX, STICK_SIGMA_M = 2.5, 0.001
RANSAC_PX = 4.0
CAUCHY = 2.3849
MIN_COMMON = 15

Mask = NDArray[np.bool_]


def calibrate(session: Session) -> Found:
    """Poses of all cameras.

    Raises:
        NotCalibratedError: if the pairs do not connect all cameras.
    """
    began = time.perf_counter()
    rotations, translations, points = _start(session)
    seconds = time.perf_counter() - began
    graph, values = _graph(session, rotations, translations, points)
    began = time.perf_counter()
    optimised = gtsam.LevenbergMarquardtOptimizer(graph, values, gtsam.LevenbergMarquardtParams()).optimize()
    poses = [optimised.atPose3(X(index)).inverse() for index in range(len(rotations))]
    rotations = np.stack([pose.rotation().matrix() for pose in poses])
    translations = np.stack([np.asarray(pose.translation()) for pose in poses])
    return Found(rotations, translations, seconds + time.perf_counter() - began)


def _graph(
    session: Session, rotations: Array, translations: Array, points: Array
) -> tuple[gtsam.NonlinearFactorGraph, gtsam.Values]:
    """Factors of all keypoints and stick lengths; points (N, 3), NaN where none."""
    if session.distortion[:, 4:].any():
        raise NotCalibratedError("Cal3DS2 has no third radial coefficient")
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    kernel = gtsam.noiseModel.mEstimator.Cauchy.Create(CAUCHY)
    keypoints, confidence = session.keypoints.reshape(len(rotations), -1, 2), session.confidence.reshape(len(rotations), -1)
    used = session.visible.reshape(len(rotations), -1) & np.isfinite(points).all(-1)
    for index, (rotation, translation) in enumerate(zip(rotations, translations, strict=True)):
        matrix, lens = session.matrices[index], session.distortion[index]
        pose = gtsam.Pose3(gtsam.Rot3(rotation.T), -rotation.T @ translation)
        values.insert(X(index), pose)
        if index == 0:
            graph.add(gtsam.PriorFactorPose3(X(0), pose, gtsam.noiseModel.Constrained.All(6)))
        calibration = gtsam.Cal3DS2(matrix[0, 0], matrix[1, 1], 0.0, matrix[0, 2], matrix[1, 2], *lens[:4])
        for column in np.flatnonzero(used[index]):
            plain = gtsam.noiseModel.Isotropic.Sigma(2, SIGMA_PX / np.sqrt(confidence[index, column]))
            noise = gtsam.noiseModel.Robust.Create(kernel, plain)
            pixel = keypoints[index, column]
            graph.add(gtsam.GenericProjectionFactorCal3DS2(pixel, noise, X(index), L(int(column)), calibration, False, False))
    for column in np.flatnonzero(used.any(0)):
        values.insert(L(int(column)), points[column])
    ends = np.arange(len(points)).reshape(session.keypoints.shape[1:3])[:, list(session.stick)]
    noise = gtsam.noiseModel.Robust.Create(kernel, gtsam.noiseModel.Isotropic.Sigma(1, STICK_SIGMA_M))
    for start, end in ends[used.any(0)[ends].all(1)]:
        graph.add(gtsam.RangeFactor3(L(int(start)), L(int(end)), session.stick_length_m, noise))
    return graph, values


def _start(session: Session) -> tuple[Array, Array, Array]:
    """Poses (C, 3, 3), (C, 3), world to camera, and points (F P, 3), NaN where none, in metres by the stick."""
    rays = _rays(session)
    cameras = len(rays)
    pairs = _pairs(session, rays)
    rotations, translations = np.full((cameras, 3, 3), np.nan), np.full((cameras, 3), np.nan)
    rotations[0], translations[0] = np.eye(3), 0.0
    points = np.full((rays.shape[1], 3), np.nan)
    placed = {0}
    while len(placed) < cameras:
        edges = [edge for edge in pairs if (edge[0] in placed) != (edge[1] in placed)]
        if not edges:
            raise NotCalibratedError(f"{len(placed)} of {cameras} cameras connected")
        first, second = max(edges, key=lambda edge: pairs[edge][2].sum())
        rotation, translation, inliers = pairs[first, second]
        if first not in placed:
            first, second, rotation, translation = second, first, rotation.T, -rotation.T @ translation
        here = np.stack([np.eye(3), rotation]), np.stack([np.zeros(3), translation])
        relative = np.full_like(points, np.nan)
        relative[inliers] = _triangulated(*here, rays[[first, second]][:, inliers])
        known = points @ rotations[first].T + translations[first]
        ratios = np.linalg.norm(known, axis=1) / np.linalg.norm(relative, axis=1)
        scale = float(np.nanmedian(ratios)) if np.isfinite(ratios).any() else 1.0
        rotations[second] = rotation @ rotations[first]
        translations[second] = rotation @ translations[first] + scale * translation
        new = (scale * relative - translations[first]) @ rotations[first]
        points = np.where(np.isfinite(points), points, new)
        placed.add(second)
    points = _triangulated(rotations, translations, rays)
    scale = stick_scale(session, points.reshape(*session.keypoints.shape[1:3], 3))
    return rotations, scale * translations, scale * points


def _rays(session: Session) -> Array:
    """Undistorted keypoints (C, F P, 2) at depth 1; NaN where not seen."""
    rays = np.full((len(session.keypoints), session.visible[0].size, 2), np.nan)
    for index, seen in enumerate(session.visible.reshape(len(rays), -1)):
        pixels = session.keypoints[index].reshape(-1, 1, 2)[seen]
        rays[index, seen] = cv2.undistortPoints(pixels, session.matrices[index], session.distortion[index])[:, 0]
    return rays


def _pairs(session: Session, rays: Array) -> dict[tuple[int, int], tuple[Array, Array, Mask]]:
    """Relative pose and inliers (F P,) of every pair of cameras that has one."""
    found = {}
    threshold = RANSAC_PX / float(session.matrices[:, [0, 1], [0, 1]].mean())
    for first, second in itertools.combinations(range(len(rays)), 2):
        common = np.flatnonzero(np.isfinite(rays[[first, second]]).all((0, 2)))
        if len(common) < MIN_COMMON:
            continue
        a, b = rays[first, common], rays[second, common]
        essential, chosen = cv2.findEssentialMat(a, b, np.eye(3), cv2.RANSAC, 0.999, threshold)
        if essential is None or essential.shape != (3, 3):
            continue
        count, rotation, translation, chosen = cv2.recoverPose(essential, a, b, np.eye(3), mask=chosen)
        if count >= MIN_COMMON:
            inliers = np.zeros(rays.shape[1], dtype=bool)
            inliers[common[chosen[:, 0] > 0]] = True
            found[first, second] = rotation, translation[:, 0], inliers
    return found


def _triangulated(rotations: Array, translations: Array, rays: Array) -> Array:
    """Points (N, 3) by the linear method, of rays (C, N, 2); NaN where fewer than two cameras see one."""
    projections = np.concatenate([rotations, translations[:, :, None]], axis=2)
    seen = np.isfinite(rays).all(-1).sum(0) >= 2
    rows = rays[:, seen, :, None] * projections[:, None, 2:] - projections[:, None, :2]
    rows = np.nan_to_num(rows).transpose(1, 0, 2, 3).reshape(int(seen.sum()), -1, 4)
    homogeneous = np.linalg.eigh(rows.transpose(0, 2, 1) @ rows)[1][:, :, 0]
    points = np.full((rays.shape[1], 3), np.nan)
    points[seen] = homogeneous[:, :3] / homogeneous[:, 3:]
    return points


if __name__ == "__main__":
    main(calibrate, __doc__)
