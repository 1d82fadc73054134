"""The straightforward way with Open3D: read, cast a pinhole's rays, back-project, draw, store.

    python benchmarks/render_open3d.py MESHES POSES.npz OUT.h5 OBJECTS

Prints one line of JSON: views per second after the first eight objects.
"""

from __future__ import annotations

import json
import sys
import time
from pathlib import Path

import h5py
import numpy as np
import open3d as o3d


def main(root: Path, poses_path: Path, out: Path, limit: int) -> None:
    poses = np.load(poses_path)
    locations = sorted({key.rpartition("/")[0] for key in poses.files})[:limit]
    rng = np.random.default_rng(0)
    columns: dict[str, list] = {
        name: [] for name in ("points", "object_id", "view", "R", "t", "K", "n_visible")
    }
    warm = views_before = 0
    for k, location in enumerate(locations):
        if k == 8:
            warm, views_before = time.perf_counter(), len(columns["view"])
        mesh = o3d.io.read_triangle_mesh(str(root / location))
        vertices = np.asarray(mesh.vertices)
        vertices = vertices - (vertices.min(axis=0) + vertices.max(axis=0)) / 2
        vertices /= np.linalg.norm(vertices, axis=1).max()
        scene = o3d.t.geometry.RaycastingScene()
        scene.add_triangles(
            o3d.core.Tensor(vertices.astype(np.float32)),
            o3d.core.Tensor(np.asarray(mesh.triangles).astype(np.uint32)),
        )
        for view, (R, t, K) in enumerate(
            zip(poses[location + "/R"], poses[location + "/t"], poses[location + "/K"], strict=True)
        ):
            extrinsic = np.eye(4)
            extrinsic[:3, :3], extrinsic[:3, 3] = R, t
            rays = scene.create_rays_pinhole(
                o3d.core.Tensor(K), o3d.core.Tensor(extrinsic), 256, 256
            )
            distance = scene.cast_rays(rays)["t_hit"].numpy()
            hit = np.isfinite(distance)
            rays = rays.numpy()[hit]
            points = rays[:, :3] + distance[hit][:, None] * rays[:, 3:]
            points = points @ R.T + t
            chosen = rng.choice(len(points), 2048, replace=len(points) < 2048)
            columns["points"].append(points[chosen].astype(np.float32))
            columns["object_id"].append(Path(location).stem.encode())
            for name, value in zip(("view", "R", "t", "K", "n_visible"),
                                   (view, R, t, K, len(points)), strict=True):  # fmt: skip
                columns[name].append(value)
    with h5py.File(out, "w") as file:
        for name, values in columns.items():
            file[name] = np.array(values)
    seconds = time.perf_counter() - warm
    views = len(columns["view"]) - views_before
    line = json.dumps({"views_per_s": views / seconds, "rows": len(columns["view"])})
    sys.stdout.write(line + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4]))
