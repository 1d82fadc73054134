"""The same with Blender's own module: Cycles, one sample, its depth pass, in this process.

    python benchmarks/render_bpy.py MESHES POSES.npz OUT.h5 OBJECTS

Prints one line of JSON: views per second after the first eight objects.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
import time
from pathlib import Path

import bpy
import h5py
import mitsuba as mi  # only to read the EXR files that Blender writes
import numpy as np
import trimesh
from mathutils import Matrix

SIZE = 256


def set_up(folder: Path) -> bpy.types.Scene:
    bpy.ops.wm.read_factory_settings(use_empty=True)
    scene = bpy.context.scene
    scene.render.engine = "CYCLES"
    scene.cycles.device = "CPU"
    scene.cycles.samples = 1
    scene.cycles.use_denoising = False
    scene.cycles.use_adaptive_sampling = False
    scene.cycles.max_bounces = 0
    scene.cycles.filter_width = 0.01
    scene.render.use_persistent_data = True
    scene.render.resolution_x = scene.render.resolution_y = SIZE
    scene.render.resolution_percentage = 100
    scene.render.use_compositing = scene.render.use_sequencer = False
    scene.view_layers[0].use_pass_z = True
    scene.view_layers[0].use_pass_combined = False
    settings = scene.render.image_settings
    if hasattr(settings, "media_type"):
        settings.media_type = "MULTI_LAYER_IMAGE"
    settings.file_format = "OPEN_EXR_MULTILAYER"
    settings.color_depth = "32"
    settings.exr_codec = "NONE"
    if hasattr(settings, "use_exr_interleave"):
        settings.use_exr_interleave = True  # all passes in the file's one part
    scene.render.filepath = str(folder / "view.exr")
    camera = bpy.data.objects.new("camera", bpy.data.cameras.new("camera"))
    scene.collection.objects.link(camera)
    scene.camera = camera
    return scene


def place(camera: bpy.types.Object, R: np.ndarray, t: np.ndarray, K: np.ndarray) -> None:
    """Blender's camera looks along −z with y up; its lens is in sensor widths."""
    pose = np.eye(4)
    pose[:3, :3] = R.T @ np.diag([1.0, -1, -1])
    pose[:3, 3] = -R.T @ t
    camera.matrix_world = Matrix(pose.tolist())
    camera.data.sensor_width = 1.0
    camera.data.lens = K[0, 0] / SIZE
    camera.data.shift_x = -(K[0, 2] - SIZE / 2) / SIZE
    camera.data.shift_y = (K[1, 2] - SIZE / 2) / SIZE
    camera.data.clip_start, camera.data.clip_end = 0.01, 100


def main(root: Path, poses_path: Path, out: Path, limit: int) -> None:
    mi.set_variant("scalar_rgb")
    poses = np.load(poses_path)
    locations = sorted({key.rpartition("/")[0] for key in poses.files})[:limit]
    rng = np.random.default_rng(0)
    columns: dict[str, list] = {
        name: [] for name in ("points", "object_id", "view", "R", "t", "K", "n_visible")
    }
    folder = Path(tempfile.mkdtemp())
    scene = set_up(folder)
    v, u = np.mgrid[:SIZE, :SIZE] + 0.5
    warm, views_before = time.perf_counter(), 0
    for k, location in enumerate(locations):
        if k == 8:
            warm, views_before = time.perf_counter(), len(columns["view"])
        loaded = trimesh.load(root / location, process=False)
        vertices = loaded.vertices - loaded.bounds.mean(axis=0)
        vertices /= np.linalg.norm(vertices, axis=1).max()
        mesh = bpy.data.meshes.new("object")
        mesh.from_pydata(vertices.tolist(), [], loaded.faces.tolist())
        item = bpy.data.objects.new("object", mesh)
        scene.collection.objects.link(item)
        for view, (R, t, K) in enumerate(
            zip(poses[location + "/R"], poses[location + "/t"], poses[location + "/K"], strict=True)
        ):
            place(scene.camera, R, t, K)
            bpy.ops.render.render(write_still=True)
            image = mi.Bitmap(scene.render.filepath)
            channels = [field.name for field in image.struct_()]
            depth = np.array(image)[..., [".Depth." in c or c.endswith(".Z") for c in channels]]
            depth = depth.reshape(SIZE, SIZE)
            hit = depth < 50
            z = depth[hit]
            x, y = (u[hit] - K[0, 2]) / K[0, 0] * z, (v[hit] - K[1, 2]) / K[1, 1] * z
            points = np.stack([x, y, z], axis=1)
            chosen = rng.choice(len(points), 2048, replace=len(points) < 2048)
            columns["points"].append(points[chosen].astype(np.float32))
            columns["object_id"].append(Path(location).stem.encode())
            for name, value in zip(("view", "R", "t", "K", "n_visible"),
                                   (view, R, t, K, len(points)), strict=True):  # fmt: skip
                columns[name].append(value)
        bpy.data.objects.remove(item)
        bpy.data.meshes.remove(mesh)
    with h5py.File(out, "w") as file:
        for name, values in columns.items():
            file[name] = np.array(values)
    seconds = time.perf_counter() - warm
    views = len(columns["view"]) - views_before
    line = json.dumps({"views_per_s": views / seconds, "rows": len(columns["view"])})
    os.write(stdout, line.encode() + b"\n")


if __name__ == "__main__":
    # Blender reports every render on stdout.
    stdout = os.dup(1)
    os.dup2(2, 1)
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
