"""COLMAP: geometric verification and incremental mapping; the scale from the stick afterwards.

The cameras do not move. So a camera is one image, whose features are its keypoints of all frames, and a point that two cameras
see in a frame is a match. Intrinsics are held fixed. With ``COLMAP_REFINE=focal`` in the environment, both focal lengths of
each camera are estimated, with ``COLMAP_REFINE=focal,extra`` also the distortion, as COLMAP does by default. Points that only
two cameras see are used. By default COLMAP ignores them; it then rejects rigs of two cameras, and loses the stick in rigs of
three. All other options are COLMAP's defaults; ``COLMAP_MAX_ERROR_PX`` replaces its 4 pixels, the largest error of an inlier.
The time includes verification, mapping and scaling, but not filling the database.
"""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from pathlib import Path

import numpy as np
import pycolmap
from numpy.typing import NDArray
from sessions import Found, NotCalibratedError, Session, main, stick_scale

REFINE = os.environ.get("COLMAP_REFINE", "").split(",")
MAX_ERROR_PX = float(os.environ.get("COLMAP_MAX_ERROR_PX", "4"))


def calibrate(session: Session) -> Found:
    """Poses of all cameras.

    Raises:
        NotCalibratedError: if COLMAP does not place every camera in one model.
    """
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        columns = _fill_database(session, folder)
        began = time.perf_counter()
        pycolmap.verify_matches(folder / "database.db", folder / "pairs.txt", _verification_options())
        models = pycolmap.incremental_mapping(folder / "database.db", folder, folder, _mapping_options())
        if not models:
            raise NotCalibratedError("no initial pair")
        model = max(models.values(), key=lambda model: model.num_reg_images())
        cameras = len(session.keypoints)
        if model.num_reg_images() < cameras:
            raise NotCalibratedError(f"{model.num_reg_images()} of {cameras} cameras placed")
        poses = np.stack([model.images[index + 1].cam_from_world().matrix() for index in range(cameras)])
        translations = poses[:, :, 3] * stick_scale(session, _points(session, model, columns))
        return Found(poses[:, :, :3], translations, time.perf_counter() - began)


def _fill_database(session: Session, folder: Path) -> list[NDArray[np.int64]]:
    """Write cameras, images, features, matches and the list of pairs; returns the column (frame, point) of every feature."""
    visible = session.visible.reshape(len(session.keypoints), -1)
    columns = [np.flatnonzero(seen) for seen in visible]
    database = pycolmap.Database.open(folder / "database.db")
    model, coefficients = ("FULL_OPENCV", 8) if session.distortion[:, 4:].any() else ("OPENCV", 4)
    for index, keypoints in enumerate(session.keypoints.reshape(len(visible), -1, 2)):
        matrix, (width, height) = session.matrices[index], session.sizes[index]
        lens = np.zeros(8)
        lens[: session.distortion.shape[1]] = session.distortion[index]
        camera = pycolmap.Camera(
            camera_id=index + 1,
            model=model,
            width=int(width),
            height=int(height),
            params=[matrix[0, 0], matrix[1, 1], matrix[0, 2], matrix[1, 2], *lens[:coefficients]],
            has_prior_focal_length=True,
        )
        database.write_camera(camera, use_camera_id=True)
        image = pycolmap.Image(name=f"{index}", camera_id=index + 1, image_id=index + 1)
        database.write_image(image, use_image_id=True)
        database.write_keypoints(index + 1, keypoints[columns[index]].astype(np.float32))
    pairs = list(itertools.combinations(range(len(visible)), 2))
    for first, second in pairs:
        both = np.flatnonzero(visible[first] & visible[second])
        matches = np.stack([np.searchsorted(columns[first], both), np.searchsorted(columns[second], both)], axis=1)
        database.write_matches(first + 1, second + 1, matches.astype(np.uint32))
    database.close()
    (folder / "pairs.txt").write_text("".join(f"{first} {second}\n" for first, second in pairs), "ascii")
    return columns


def _verification_options() -> pycolmap.TwoViewGeometryOptions:
    options = pycolmap.TwoViewGeometryOptions()
    options.ransac.max_error = MAX_ERROR_PX
    return options


def _mapping_options() -> pycolmap.IncrementalPipelineOptions:
    focal, extra = "focal" in REFINE, "extra" in REFINE
    options = pycolmap.IncrementalPipelineOptions(
        ba_refine_focal_length=focal, ba_refine_principal_point=False, ba_refine_extra_params=extra, extract_colors=False
    )
    options.mapper.abs_pose_refine_focal_length, options.mapper.abs_pose_refine_extra_params = focal, extra
    options.mapper.init_max_error = options.mapper.filter_max_reproj_error = MAX_ERROR_PX
    options.triangulation.ignore_two_view_tracks = False
    options.triangulation.merge_max_reproj_error = options.triangulation.complete_max_reproj_error = MAX_ERROR_PX
    return options


def _points(session: Session, model: pycolmap.Reconstruction, columns: list[NDArray[np.int64]]) -> NDArray[np.float64]:
    """(F, P, 3), NaN where the model has no point. If it has several for one point, the longest track is used."""
    frames, points = session.keypoints.shape[1:3]
    found, length = np.full((frames * points, 3), np.nan), np.zeros(frames * points, dtype=int)
    for point in model.points3D.values():
        element = point.track.elements[0]
        column = columns[element.image_id - 1][element.point2D_idx]
        if point.track.length() > length[column]:
            found[column], length[column] = point.xyz, point.track.length()
    return found.reshape(frames, points, 3)


if __name__ == "__main__":
    pycolmap.logging.minloglevel = pycolmap.logging.Level.FATAL.value
    main(calibrate, __doc__)
