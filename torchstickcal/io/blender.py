"""Blender: a Python script that makes the cameras of a calibration, for the text editor of Blender or ``blender --python``."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from torchstickcal.files import atomic_path, check_text
from torchstickcal.io.about import about, comments
from torchstickcal.io.formats import camera_writer
from torchstickcal.io.rig import Rig

_SENSOR_MM = 36.0
_TURN = np.diag([1.0, -1.0, -1.0])
_SCRIPT = """import bpy
from mathutils import Matrix

for name, (width, height), lens_mm, sensor_fit, shift, matrix in CAMERAS:
    data = bpy.data.cameras.new(name)
    data.sensor_width = data.sensor_height = {sensor_mm}
    data.sensor_fit, data.lens = sensor_fit, lens_mm
    data.shift_x, data.shift_y = shift
    camera = bpy.data.objects.new(name, data)
    camera.matrix_world = Matrix(matrix)
    bpy.context.collection.objects.link(camera)
    bpy.context.scene.render.resolution_x, bpy.context.scene.render.resolution_y = width, height
    bpy.context.scene.camera = camera
"""


@camera_writer("blender", "a Python script that makes the cameras in Blender, in metres", file_name="blender_cameras.py")
def write_blender(path: Path, rig: Rig) -> None:
    """Write a script with the cameras as a list. Distortion is not part of it: Blender's cameras are perfect lenses."""
    rig.check_plain("Blender", fisheye=False)
    rotations, translations = rig.in_metres().poses()
    cameras = []
    for camera, name in enumerate(rig.names):
        check_text(name, "camera_names")
        matrix = np.eye(4)
        matrix[:3, :3] = rotations[camera].mT.numpy() @ _TURN
        matrix[:3, 3] = -(rotations[camera].mT @ translations[camera]).numpy()
        width, height = map(round, rig.size(camera))
        (fx, _, cx), (_, fy, cy), _ = rig.intrinsics[camera].tolist()
        longer = max(width, height)
        shift = (width / 2 - cx - 0.5) / longer, (cy + 0.5 - height / 2) / longer
        focal, fit = (fx, "HORIZONTAL") if width >= height else (fy, "VERTICAL")
        cameras.append((name, (width, height), focal / longer * _SENSOR_MM, fit, shift, matrix.tolist()))
    head = comments(about("metres", rig.world, "Matrices are from cameras to the world; undistort the images first."))
    lines = "".join(f"    {camera!r},\n" for camera in cameras)
    with atomic_path(path) as temporary:
        script = _SCRIPT.format(sensor_mm=_SENSOR_MM)
        temporary.write_text(f"{head}\nCAMERAS = [\n{lines}]\n\n{script}", "utf-8")
