"""Speed of rendering: from mesh files to closed shards, against Open3D's and Blender's own ways.

    python benchmarks/render.py [--objects 100] [--views 10] [--source PATH] [--json FILE]
    python benchmarks/render.py --memory          resident memory over ten thousand views
    python benchmarks/render.py --stages          where the time of one object goes
    python benchmarks/render.py --depth 1024      memory of a shard that keeps depth images

Every contender gets the same OFF files, the same poses and intrinsics, 256×256 pixels and 2,048
points a view, and ends with HDF5 on disk. Ours is the whole build with two worker processes, and
with one; a peer is the straightforward script of ``render_open3d.py`` and ``render_bpy.py``, in a
process of its own that may use both cores. Start-up is left out for all: the clock starts when the
first objects are done. A peer that is not installed is skipped by name, and what a peer rendered is
compared with ours before its time counts.
"""

from __future__ import annotations

import argparse
import hashlib
import importlib.util
import json
import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import psutil
import trimesh

from partialbench.dataset.build import BuildPlan, Progress, build
from partialbench.dataset.rows import Job
from partialbench.dataset.seeding import generator
from partialbench.geometry.camera import fit_ball, sample_pose
from renderers.mitsuba_depth import MitsubaOccluder, back_project
from renderers.sources.mesh import normalise, read_mesh
from renderers.sources.open import open_source
from renderers.tracing import make_scene
from renderers.visibility import surface_samples

RESOLUTION, POINTS, DATASET = 256, 2048, "bench"
WARM_UP = 8  # objects, of every contender
PEERS = {"open3d": "render_open3d.py", "bpy": "render_bpy.py"}


def write_meshes(root: Path, count: int) -> None:
    """Meshes of 5,000 to 20,480 faces, of four kinds in turn, as OFF files of one class."""
    folder = root / "chair" / "train"
    folder.mkdir(parents=True)
    rng = np.random.default_rng(0)
    mesh: Any
    for k in range(count):
        if k % 4 == 0:
            mesh = trimesh.creation.torus(1, 0.3, 70 + k % 50, 50)
        elif k % 4 == 1:  # a smooth blob that hides parts of itself
            mesh = trimesh.creation.icosphere(subdivisions=5)
            waves = rng.normal(size=(3, 3)) * 3
            bumps = np.sin(mesh.vertices @ waves.T).sum(axis=1)
            mesh.vertices = mesh.vertices * (1 + 0.2 * bumps)[:, None]
        elif k % 4 == 2:  # legs and boards, finely cut
            boxes = [
                trimesh.creation.box(rng.uniform(0.1, 1, 3)).apply_translation(rng.normal(size=3))
                for _ in range(12)
            ]
            mesh = trimesh.util.concatenate(boxes)
            for _ in range(3):
                mesh = mesh.subdivide()
        else:
            mesh = trimesh.creation.icosphere(subdivisions=4)
            mesh.apply_scale(rng.uniform(0.3, 1, 3))
        (folder / f"chair_{k:04}.off").write_text(mesh.export(file_type="off"))


def job(source: Any, views: int, occluder: MitsubaOccluder | None = None) -> Job:
    return Job(source, occluder or MitsubaOccluder(RESOLUTION), DATASET, "partial",
               {"train": views, "test": views}, POINTS, 0)  # fmt: skip


def ours(source: Any, views: int, out: Path, workers: int) -> dict[str, Any]:
    """Views per second of a whole build between its first objects and its last closed shard."""
    marks: list[tuple[int, float]] = []

    def mark(progress: Progress) -> None:
        marks.append((progress.rows, time.perf_counter()))

    begin = time.perf_counter()
    manifest = build(
        BuildPlan(job(source, views), out, source.splits()), workers=workers, on_progress=mark
    )
    end = time.perf_counter()
    rows = sum(shard.rows for shard in manifest.shards)
    warm_rows, warm = marks[min(WARM_UP, len(marks) - 1) - 1]
    return {"views_per_s": (rows - warm_rows) / (end - warm), "rows": rows,
            "seconds_with_start": end - begin}  # fmt: skip


def write_poses(source: Any, views: int, path: Path) -> None:
    """The build's own poses for the peers: arrays keyed by file."""
    arrays: dict[str, Any] = {}
    for split in source.splits():
        for ref in source.objects(split):
            poses = [
                sample_pose(generator(0, DATASET, split, ref.object_id, v, "pose"))
                for v in range(views)
            ]
            arrays[ref.location + "/R"] = np.stack([R for R, _ in poses])
            arrays[ref.location + "/t"] = np.stack([t for _, t in poses])
            arrays[ref.location + "/K"] = np.stack([fit_ball(t, RESOLUTION).K for _, t in poses])
    np.savez(path, **arrays)


def peer(name: str, root: Path, poses: Path, folder: Path, objects: int) -> dict[str, Any]:
    """A peer's figures, or why there are none."""
    if importlib.util.find_spec(name) is None:
        return {"skipped": f"{name} is not installed"}
    script = Path(__file__).with_name(PEERS[name])
    out = folder / f"{name}.h5"
    command = [sys.executable, str(script), str(root), str(poses), str(out), str(objects)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return {"skipped": f"{name} failed: {done.stderr.strip().splitlines()[-1]}"}
    return json.loads(done.stdout.splitlines()[-1])


def same_work(shards: Path, other: Path) -> float:
    """The median relative difference of the numbers of visible pixels, ours against a peer's."""
    counts = {}
    for shard in sorted(shards.glob("*.h5")):
        with h5py.File(shard) as file:
            for name, view, n in zip(file["object_id"], file["view"], file["n_visible"],
                                     strict=True):  # fmt: skip
                counts[name.decode(), int(view)] = int(n)
    with h5py.File(other) as file:
        theirs = {(name.decode(), int(view)): int(n) for name, view, n in zip(
            file["object_id"], file["view"], file["n_visible"], strict=True)}  # fmt: skip
    assert theirs
    return float(np.median([abs(n - counts[key]) / counts[key] for key, n in theirs.items()]))


def contest(args: argparse.Namespace) -> dict[str, Any]:
    with tempfile.TemporaryDirectory() as temporary:
        folder = Path(temporary)
        root = Path(args.source) if args.source else folder / "meshes"
        if not args.source:
            write_meshes(root, args.objects)
        source = open_source(root)
        write_poses(source, args.views, folder / "poses.npz")
        figures: dict[str, Any] = {
            "one worker": ours(source, args.views, folder / "one", 1),
            "two workers": ours(source, args.views, folder / "two", 2),
        }
        for name, limit in (("open3d", args.objects), ("bpy", max(WARM_UP + 4, args.objects // 8))):
            result = peer(name, root, folder / "poses.npz", folder, limit)
            if "skipped" not in result:
                result["difference"] = same_work(folder / "two", folder / f"{name}.h5")
                if result["difference"] > 0.02:
                    result = {"skipped": f"{name} rendered something else: {result}"}
            figures[name] = result
    best = figures["two workers"]["views_per_s"]
    for figure in figures.values():
        if "views_per_s" in figure:
            figure["ours_is_times_faster"] = best / figure["views_per_s"]
    return figures


def stages(views: int) -> dict[str, float]:
    """Milliseconds of each stage for one object of 20,480 faces in one thread, best of ten."""
    with tempfile.TemporaryDirectory() as temporary:
        mesh = trimesh.creation.icosphere(subdivisions=5)
        path = Path(temporary) / "sphere.off"
        path.write_text(mesh.export(file_type="off"))
        poses = [sample_pose(generator(0, "stages", k)) for k in range(views)]
        occluder = MitsubaOccluder(RESOLUTION, keep_depth=True)
        shape = normalise(read_mesh(path))
        vertices, faces = shape.vertices.astype(np.float32), shape.faces.astype(np.uint32)
        seen: list[Any] = occluder.views(shape, poses, [])
        cameras = [fit_ball(t, RESOLUTION) for _, t in poses]

        calls = {
            "read and normalise": lambda: normalise(read_mesh(path)),
            "digest": lambda: hashlib.sha256(path.read_bytes()).hexdigest(),
            "acceleration structure": lambda: make_scene(vertices, faces),
            "surface samples": lambda: surface_samples(vertices, faces, 2048),
            "back-projection": lambda: [
                back_project(view.depth, camera) for view, camera in zip(seen, cameras, strict=True)
            ],
            "views, all of them": lambda: occluder.views(shape, poses, []),
        }
        return {name: 1e3 * min(_timed(call) for _ in range(10)) for name, call in calls.items()}


def _timed(call: Any) -> float:
    begin = time.perf_counter()
    call()
    return time.perf_counter() - begin


def memory(views: int) -> list[float]:
    """Resident MiB after each thousand of ten thousand views, mesh sizes changing."""
    occluder, process = MitsubaOccluder(RESOLUTION), psutil.Process()
    meshes = [trimesh.creation.icosphere(subdivisions=size) for size in (2, 3, 4, 5)]
    resident = []
    for k in range(10_000 // views):
        poses = [sample_pose(generator(0, "memory", k, v)) for v in range(views)]
        occluder.views(meshes[k % 4], poses, [])
        if (k + 1) * views % 1000 == 0:
            resident.append(process.memory_info().rss / 2**20)
    return resident


def depth_memory(resolution: int, views: int, objects: int, sensor: str) -> dict[str, float]:
    """Peak memory of one shard with depth images, in units of the shard's images as they are."""
    with tempfile.TemporaryDirectory() as temporary:
        root = Path(temporary) / "meshes"
        write_meshes(root, objects)
        source = open_source(root)
        occluder = MitsubaOccluder(resolution, keep_depth=True, sensor=sensor)
        plan = BuildPlan(
            job(source, views, occluder), Path(temporary) / "out", source.splits(),
            rows_per_shard=views * objects,
        )  # fmt: skip
        before = psutil.Process().memory_info().rss
        [shard] = build(plan, workers=2).shards
        images = shard.rows * resolution**2 * 4
        # Linux gives kibibytes.
        peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024
        worker = resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss * 1024
        return {
            "rows": shard.rows,
            "images, MiB": images / 2**20,
            "file, MiB": shard.bytes / 2**20,
            "builder's growth, MiB": (peak - before) / 2**20,
            "builder's growth in shards of images": (peak - before) / images,
            "a worker's peak, MiB": worker / 2**20,
        }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--objects", type=int, default=100)
    parser.add_argument("--views", type=int, default=10)
    parser.add_argument("--source", help="a folder of OFF files in ModelNet40's tree")
    parser.add_argument("--memory", action="store_true")
    parser.add_argument("--stages", action="store_true")
    parser.add_argument("--depth", type=int, help="image side in pixels")
    parser.add_argument("--sensor", default="ideal", help="with --depth")
    parser.add_argument("--json", type=Path)
    args = parser.parse_args()
    if args.memory:
        result: Any = {"MiB after each thousand views": memory(args.views)}
    elif args.depth:
        result = depth_memory(args.depth, args.views, args.objects, args.sensor)
    elif args.stages:
        result = stages(args.views)
    else:
        result = contest(args)
    text = json.dumps(result, indent=1)
    sys.stdout.write(text + "\n")
    if args.json:
        args.json.write_text(text + "\n")


if __name__ == "__main__":
    main()
