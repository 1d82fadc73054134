"""Rendered depth against a brute-force caster, and what views promise."""

from __future__ import annotations

import multiprocessing
import os
import pickle
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import psutil
import pytest
import trimesh

from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import RejectedView, View
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera, fit_ball, sample_pose
from renderers import tracing
from renderers.mitsuba_depth import NOTHING_SEEN, MitsubaOccluder, back_project
from renderers.sources.folder import MeshFolder
from renderers.sources.mesh import normalise
from renderers.variants import SUPPORTED, pick_variant
from tests.renderers.raycaster import Cast, cast

TOLERANCE = 1e-4
# Float32 puts a ray up to two millionths of the image plane beside its pixel centre: there an edge
# may be met or missed. One pixel in ten thousand is far more than was ever seen (2 in 2.9 million).
MARGIN = 2e-6
EDGE_SHARE = 1e-4


def _soup(rng: np.random.Generator) -> trimesh.Trimesh:
    """Random triangles that cross each other, none part of a closed surface."""
    return trimesh.Trimesh(
        rng.normal(size=(120, 3)), np.arange(120).reshape(40, 3), process=False, validate=False
    )


def _doubled(mesh: trimesh.Trimesh) -> trimesh.Trimesh:
    """Every face also back to front."""
    return trimesh.Trimesh(
        mesh.vertices, np.vstack([mesh.faces, mesh.faces[:, ::-1]]), process=False, validate=False
    )


def _sheet() -> trimesh.Trimesh:
    square = [[-1.0, -1, 0], [1, -1, 0], [1, 1, 0], [-1, 1, 0]]
    return trimesh.Trimesh(square, [[0, 1, 2], [0, 2, 3]], process=False, validate=False)


SHAPES = {
    "box": lambda: trimesh.creation.box((1, 2, 3)),
    "sphere": lambda: trimesh.creation.icosphere(subdivisions=3),
    "torus": lambda: trimesh.creation.torus(1, 0.3),
    "capsule": lambda: trimesh.creation.capsule(2, 0.4),
    "soup": lambda: _soup(np.random.default_rng(5)),
    "sheet": _sheet,
    "doubled": lambda: _doubled(trimesh.creation.annulus(0.5, 1, 0.3)),
}


def shape(name: str) -> trimesh.Trimesh:
    return normalise(SHAPES[name]())


def poses(count: int, *key: str | int) -> list[tuple[np.ndarray, np.ndarray]]:
    return [sample_pose(generator(0, "test poses", *key, k)) for k in range(count)]


def seen(views: list[View | RejectedView]) -> list[View]:
    assert all(isinstance(view, View) for view in views)
    return views  # type: ignore[return-value]


def oracle(mesh: trimesh.Trimesh, view: View, width: int, height: int) -> Cast:
    camera = Camera(view.K, width, height)
    # The renderer's mesh is float32: the oracle casts against the same one.
    vertices = np.asarray(mesh.vertices, np.float32)
    return cast(vertices, mesh.faces, view.R_camera_object, view.t_camera_object, camera, MARGIN)


def check_depth(depth: np.ndarray, expected: Cast) -> None:
    """Equal at every pixel, but for a few whose centre is within rounding of an edge."""
    off = np.abs(depth - expected.depth) > TOLERANCE
    explained = (np.abs(depth - expected.grown) <= TOLERANCE) | (
        np.abs(depth - expected.shrunk) <= TOLERANCE
    )
    assert not (off & ~explained).any(), f"{(off & ~explained).sum()} pixels are wrong"
    hits = max(1, int((expected.depth > 0).sum()))
    assert off.sum() <= max(1, EDGE_SHARE * hits), f"{off.sum()} of {hits} pixels lie on an edge"


def distance_to_mesh(mesh: trimesh.Trimesh, view: View, count: int) -> float:
    """The largest distance of some of a view's points from the mesh, in the object frame."""
    chosen = np.linspace(0, len(view.points) - 1, count).astype(int)
    points = (view.points[chosen] - view.t_camera_object) @ view.R_camera_object
    return float(trimesh.proximity.closest_point(mesh, points)[1].max())


@pytest.fixture(params=SUPPORTED)
def variant(request: pytest.FixtureRequest) -> str:
    try:
        return pick_variant(request.param)
    except InputError as error:
        pytest.skip(str(error))


@pytest.mark.parametrize("name", SHAPES)
def test_depth_equals_the_brute_force_caster(name: str, variant: str) -> None:
    mesh = shape(name)
    occluder = MitsubaOccluder(resolution=64, variant=variant, keep_depth=True)
    for view in seen(occluder.views(mesh, poses(4, name), [])):
        check_depth(view.depth, oracle(mesh, view, 64, 64))


@pytest.mark.data
def test_depth_equals_the_brute_force_caster_on_real_files(shared: Path) -> None:
    source = MeshFolder(shared / "data" / "ModelNet40")
    refs = [ref for split in source.splits() for ref in source.objects(split)]
    assert len(refs) == 8
    for ref in refs:
        mesh = source.load(ref)
        for view in seen(MitsubaOccluder(keep_depth=True).views(mesh, poses(2, ref.object_id), [])):
            check_depth(view.depth, oracle(mesh, view, 256, 256))
            assert distance_to_mesh(mesh, view, 100) <= TOLERANCE


def test_the_comparison_fails_a_wrong_depth() -> None:
    mesh = shape("torus")
    (view,) = seen(MitsubaOccluder(resolution=64, keep_depth=True).views(mesh, poses(1), []))
    expected = oracle(mesh, view, 64, 64)
    check_depth(view.depth, expected)
    # Cast through pixel corners instead of centres: half a pixel off.
    shifted = Camera(view.K + np.array([[0, 0, 0.5], [0, 0, 0.5], [0, 0, 0]]), 64, 64)
    corner = cast(mesh.vertices, mesh.faces, view.R_camera_object, view.t_camera_object, shifted)
    with pytest.raises(AssertionError, match="wrong"):
        check_depth(corner.depth.astype(np.float32), expected)
    # Ray length instead of z.
    slopes = Camera(view.K, 64, 64).unproject(
        Camera(view.K, 64, 64).pixel_centres(), np.ones((64, 64))
    )
    with pytest.raises(AssertionError, match="wrong"):
        check_depth(view.depth * np.linalg.norm(slopes, axis=-1), expected)
    # Back faces culled: a sheet seen from behind is lost.
    sheet, behind = shape("sheet"), (np.diag([1.0, -1, -1]), np.array([0.2, 0.1, 4]))
    (view,) = seen(MitsubaOccluder(resolution=64, keep_depth=True).views(sheet, [behind], []))
    expected = oracle(sheet, view, 64, 64)
    check_depth(view.depth, expected)
    with pytest.raises(AssertionError, match="wrong"):
        check_depth(np.zeros_like(view.depth), expected)


def test_the_oracle_finds_the_same_with_and_without_pruning() -> None:
    for name in ("soup", "torus"):
        mesh = shape(name)
        for R, t in poses(2, name):
            pruned, whole = (
                cast(mesh.vertices, mesh.faces, R, t, fit_ball(t, 24), prune=prune)
                for prune in (True, False)
            )
            for field in ("depth", "grown", "shrunk"):
                np.testing.assert_array_equal(getattr(pruned, field), getattr(whole, field))
            assert (pruned.depth > 0).any()


def test_the_oracle_finds_a_plane_where_it_is() -> None:
    # The plane z = 3 + x/2 of the camera frame, met at z = 3/(1 − x_slope/2).
    corners = np.array([[-9.0, -9, -1.5], [9, -9, 7.5], [9, 9, 7.5], [-9, 9, -1.5]])
    corners[:, 2] = 3 + corners[:, 0] / 2
    corners = corners[[1, 2, 3]] * [0.1, 0.1, 1]  # in front of the camera
    corners[:, 2] = 3 + corners[:, 0] / 2
    camera = Camera(np.array([[40.0, 0, 8], [0, 40, 8], [0, 0, 1]]), 16, 16)
    found = cast(corners, np.array([[0, 1, 2]]), np.eye(3), np.zeros(3), camera, prune=False).depth
    slope = (np.arange(16) + 0.5 - 8) / 40
    expected = np.broadcast_to(3 / (1 - slope / 2), (16, 16))
    hit = found > 0
    assert 30 < hit.sum() < 256
    np.testing.assert_allclose(found[hit], expected[hit], rtol=1e-12)


@pytest.mark.parametrize("resolution", [5, 37, 130])
def test_any_resolution(resolution: int) -> None:
    mesh = shape("soup")
    occluder = MitsubaOccluder(resolution=resolution, keep_depth=True)
    for view in seen(occluder.views(mesh, poses(2, resolution), [])):
        assert view.depth.shape == (resolution, resolution)
        check_depth(view.depth, oracle(mesh, view, resolution, resolution))


def test_nothing_of_the_object_is_cut_off() -> None:
    # A vertex at norm 1 in every direction: the sphere's outline stays inside the image.
    mesh = shape("sphere")
    for view in seen(MitsubaOccluder(resolution=64, keep_depth=True).views(mesh, poses(6), [])):
        pixels, _ = Camera(view.K, 64, 64).project(
            mesh.vertices @ view.R_camera_object.T + view.t_camera_object
        )
        assert pixels.min() >= 0
        assert pixels.max() <= 64
        assert max(np.ptp(pixels, axis=0)) > 62


def test_views_hold_what_the_contract_says(variant: str) -> None:
    mesh = shape("torus")
    given = poses(3)
    occluder = MitsubaOccluder(resolution=48, variant=variant, keep_depth=True)
    for (R, t), view in zip(given, seen(occluder.views(mesh, given, [])), strict=True):
        camera = fit_ball(t, 48)
        np.testing.assert_array_equal(view.R_camera_object, R)
        np.testing.assert_array_equal(view.t_camera_object, t)
        np.testing.assert_array_equal(view.K, camera.K)
        assert (view.points.dtype, view.depth.dtype) == (np.float32, np.float32)
        assert view.points.shape == (view.n_visible, 3)
        assert view.n_visible == (view.depth > 0).sum()
        assert 0 < view.visible_fraction < 0.6
        np.testing.assert_allclose(
            view.points, camera.unproject_depth(view.depth), rtol=0, atol=1e-6
        )
        assert distance_to_mesh(mesh, view, 200) <= TOLERANCE
    assert occluder.views(mesh, [], []) == []
    unkept = seen(MitsubaOccluder(resolution=48, variant=variant).views(mesh, given, []))
    assert all(view.depth is None for view in unkept)


def test_back_projection_is_the_inverse_of_projection() -> None:
    camera = Camera(np.array([[50.0, 0, 3], [0, 60, 40], [0, 0, 1]]), 40, 30)
    depth = np.zeros((30, 40), np.float32)
    depth[3, 5], depth[29, 39], depth[0, 0] = 2, 3, 4
    points = back_project(depth, camera)
    pixels, z = camera.project(points)
    np.testing.assert_allclose(pixels, [[0.5, 0.5], [5.5, 3.5], [39.5, 29.5]], atol=1e-5)
    np.testing.assert_array_equal(z, [4, 2, 3])


def test_a_fixed_camera_may_cut_the_object() -> None:
    mesh = shape("torus")
    # Half of a centred object lies left of the image, which is wider than high.
    camera = Camera(np.array([[60.0, 0, 0], [0, 60, 22], [0, 0, 1]]), 50, 44)
    pose = (np.eye(3), np.array([0.0, 0, 4]))
    occluder = MitsubaOccluder(camera=camera, keep_depth=True, visibility_samples=4096)
    (view,) = seen(occluder.views(mesh, [pose], []))
    np.testing.assert_array_equal(view.K, camera.K)
    check_depth(view.depth, oracle(mesh, view, 50, 44))
    (whole,) = seen(MitsubaOccluder(visibility_samples=4096).views(mesh, [pose], []))
    assert view.visible_fraction == pytest.approx(whole.visible_fraction / 2, abs=0.01)
    away = (np.eye(3), np.array([-3.0, 0, 4]))
    assert occluder.views(mesh, [away], []) == [
        RejectedView(NOTHING_SEEN, {"width": 50, "height": 44})
    ]


def test_a_sheet_seen_edge_on_is_turned_away_and_spares_the_other_views() -> None:
    # The eye lies in the sheet's plane y = 0 (camera frame), half a pixel from every centre.
    turned = np.array([[1.0, 0, 0], [0, 0, -1], [0, 1, 0]])
    edge_on = (turned, np.array([0.0, 0, 4]))
    views = MitsubaOccluder(resolution=64).views(shape("sheet"), [*poses(1), edge_on], [])
    assert isinstance(views[0], View)
    assert views[1] == RejectedView(NOTHING_SEEN, {"width": 64, "height": 64})


def _digest(views: list[View | RejectedView]) -> bytes:
    return b"".join(
        view.points.tobytes() + np.float64(view.visible_fraction).tobytes() for view in seen(views)
    )


def _render(occluder: MitsubaOccluder, name: str) -> bytes:
    return _digest(occluder.views(shape(name), poses(3, name), []))


def test_bits_do_not_depend_on_threads_processes_order_or_batches(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    names = ["torus", "soup", "doubled"]
    occluder = MitsubaOccluder(resolution=96)
    expected = [_render(occluder, name) for name in names]
    assert len(set(expected)) == 3
    assert [_render(occluder, name) for name in reversed(names)] == expected[::-1]
    assert [_render(MitsubaOccluder(96, threads=2), name) for name in names] == expected
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as pool:
        assert list(pool.map(_render, [occluder] * 3, names)) == expected
    monkeypatch.setattr(tracing, "MAX_RAYS", 96 * 96)
    assert [_render(occluder, name) for name in names] == expected
    # One view alone is the same as among others.
    given = poses(3, "torus")
    alone = [_digest(occluder.views(shape("torus"), [pose], [])) for pose in given]
    assert b"".join(alone) == expected[0]


def test_describe_is_data_and_names_the_variant_in_use() -> None:
    occluder = MitsubaOccluder(resolution=32)
    described = occluder.describe()
    assert described == {
        "name": "mitsuba",
        "variant": pick_variant("auto"),
        "resolution": 32,
        "camera": None,
        "sensor": {"name": "ideal"},
        "visibility_samples": 2048,
        "keep_depth": False,
    }
    assert pickle.loads(pickle.dumps(occluder)).describe() == described
    # What does not change the result does not enter the configuration.
    assert MitsubaOccluder(resolution=32, threads=2).describe() == described
    camera = Camera(np.array([[60.0, 0, 25], [0, 60, 22], [0, 0, 1]]), 50, 44)
    assert MitsubaOccluder(camera=camera).describe()["camera"] == {
        "K": [[60, 0, 25], [0, 60, 22], [0, 0, 1]],
        "width": 50,
        "height": 44,
    }


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"resolution": 0}, "resolution must be a whole number of at least 1, got 0"),
        ({"threads": 1.5}, "threads must be a whole number of at least 1, got 1.5"),
        ({"visibility_samples": True}, "visibility_samples must be .* got True"),
        ({"camera": np.eye(3)}, "camera must be a geometry.camera.Camera"),
        ({"camera": Camera(np.eye(3), 20_000, 20_000)}, "camera's has 20000×20000"),
        ({"sensor": "kinect"}, "no sensor named 'kinect'; did you mean kinect-v1"),
    ],
)
def test_wrong_options(options: dict, message: str) -> None:
    with pytest.raises(InputError, match=message):
        MitsubaOccluder(**options)


def test_meshes_that_cannot_be_rendered() -> None:
    box = trimesh.creation.box((1, 1, 1))

    def render(vertices: object, faces: object) -> None:
        mesh = trimesh.Trimesh(vertices, faces, process=False, validate=False)
        MitsubaOccluder(resolution=16).views(mesh, poses(1), [])

    with pytest.raises(InputError, match=r"reaches 1\.73205 from the origin.*normalise"):
        render(box.vertices * 2, box.faces)
    # A camera of its own does not change what sizes mean: 1,000 millimetres are not 1,000 units.
    camera = Camera(np.array([[60.0, 0, 25], [0, 60, 22], [0, 0, 1]]), 50, 44)
    ball = trimesh.creation.icosphere(2, 1000)
    with pytest.raises(InputError, match=r"reaches 1000 from the origin.*normalise"):
        MitsubaOccluder(camera=camera).views(ball, [(np.eye(3), np.array([0, 0, 3000.0]))], [])
    with pytest.raises(InputError, match="NaN or infinite"):
        render(np.where(box.vertices > 0.4, np.nan, box.vertices), box.faces)
    with pytest.raises(InputError, match="names vertex 8; the mesh's vertices are 0 to 7"):
        render(box.vertices, [*box.faces.tolist(), [0, 1, 8]])
    with pytest.raises(InputError, match="no area: 2 faces"):
        render([[0, 0, 0], [0.5, 0, 0], [1, 0, 0]], [[0, 1, 2], [0, 0, 1]])
    with pytest.raises(InputError, match=r"expected a trimesh\.Trimesh, got ndarray"):
        MitsubaOccluder().views(np.zeros((5, 3)), poses(1), [])  # type: ignore[arg-type]


def test_an_unknown_variant_names_the_known_ones() -> None:
    with pytest.raises(InputError, match="'gpu'; expected auto, cuda_ad_rgb, llvm_ad_rgb"):
        pick_variant("gpu")
    assert pick_variant("auto") in SUPPORTED


def test_without_llvm_auto_still_renders_and_asking_for_llvm_says_what_to_install() -> None:
    script = (
        "from renderers.variants import pick_variant\n"
        "from partialbench.errors import InputError\n"
        "assert pick_variant('auto') != 'llvm_ad_rgb'\n"
        "assert pick_variant('scalar_rgb') == 'scalar_rgb'\n"
        "try: pick_variant('llvm_ad_rgb')\n"
        "except InputError as error: print(error)\n"
    )
    environment = {**os.environ, "DRJIT_LIBLLVM_PATH": "/nonexistent"}
    done = subprocess.run(
        [sys.executable, "-c", script],
        env=environment,
        cwd=Path(__file__).parents[2],
        capture_output=True,
        text=True,
        check=True,
    )
    for part in ("llvm_ad_rgb does not work here", "libLLVM.so", "apt-get install -y libllvm",
                 "DRJIT_LIBLLVM_PATH", "scalar_rgb"):  # fmt: skip
        assert part in done.stdout


@pytest.mark.slow
def test_memory_stays_flat_over_ten_thousand_views() -> None:
    occluder = MitsubaOccluder()
    process = psutil.Process()
    sizes = (2, 3, 4, 5)
    meshes = [normalise(trimesh.creation.icosphere(subdivisions=size)) for size in sizes]
    resident = []
    for k in range(1000):
        # Another mesh size each time, as in a real data set.
        occluder.views(meshes[k % len(meshes)], poses(10, k), [])
        if k % 100 == 99:
            resident.append(process.memory_info().rss / 2**20)
    assert resident[-1] - resident[1] < 20, f"MiB after each thousand views: {resident}"
