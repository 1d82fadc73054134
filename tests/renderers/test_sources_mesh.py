"""Mesh files of every format, and normalisation."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from partialbench.errors import InputError
from renderers.sources.mesh import SUFFIXES, normalise, read_mesh


def export(mesh: trimesh.Trimesh | trimesh.Scene, suffix: str) -> bytes:
    if suffix == ".gltf":
        return trimesh.exchange.gltf.export_gltf(mesh, embed_buffers=True)["model.gltf"]
    content = mesh.export(file_type=suffix.lstrip("."))
    return content.encode() if isinstance(content, str) else content


def corners(mesh: trimesh.Trimesh) -> np.ndarray:
    """The triangles' corners, (F,3,3), as the same array whatever the order of faces."""
    triangles = mesh.vertices[mesh.faces]
    return triangles[np.lexsort(triangles.reshape(-1, 9).round(5).T)]


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_every_format_gives_the_same_triangles(suffix: str) -> None:
    box = trimesh.creation.box((1, 2, 3)).apply_translation((5, 6, 7))
    box.unmerge_vertices()
    # A back-to-back double face, and one of no area: both stay.
    faces = np.vstack([box.faces, box.faces[:1, ::-1], [[0, 0, 1]]])
    mesh = trimesh.Trimesh(box.vertices, faces, process=False, validate=False)
    found = read_mesh(export(mesh, suffix), suffix)
    assert len(found.faces) == 14
    np.testing.assert_allclose(corners(found), corners(mesh), atol=1e-6)
    upper = read_mesh(export(mesh, suffix), suffix.upper())
    np.testing.assert_array_equal(upper.vertices, found.vertices)


@pytest.mark.parametrize("suffix", SUFFIXES)
def test_y_up_becomes_z_up(suffix: str) -> None:
    mesh = trimesh.Trimesh([[0, 0, 0], [1, 0, 0], [0, 5, 2]], [[0, 1, 2]], process=False)
    found = read_mesh(export(mesh, suffix), suffix, up="y")
    # A quarter turn about x: y goes to z, z to −y; a proper rotation.
    np.testing.assert_allclose(
        np.sort(found.vertices, axis=0), np.sort([[0, 0, 0], [1, 0, 0], [0, -2, 5]], axis=0)
    )


def test_bodies_of_a_glb_scene_are_placed_and_joined() -> None:
    box = trimesh.creation.box((1, 1, 1))
    scene = trimesh.Scene()
    scene.add_geometry(box, node_name="seat", transform=np.diag([2.0, 1, 4, 1]))
    # A quarter turn about the vertical through (3, 0): (x, y) → (3 − y, x − 3).
    quarter = trimesh.transformations.rotation_matrix(np.pi / 2, (0, 0, 1), (3, 0, 0))
    scene.add_geometry(box, node_name="back", parent_node_name="seat", transform=quarter)
    found = read_mesh(export(scene, ".glb"), ".glb")
    assert len(found.faces) == 24
    # The second is in the first's frame: 2·[2.5, 3.5] by [−3.5, −2.5].
    np.testing.assert_allclose(found.bounds, [[-1, -3.5, -2], [7, 0.5, 2]], atol=1e-6)
    assert found.volume == pytest.approx(16)


DAE = """<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.01"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="pa" count="12">0 0 0 1 0 0 1 1 0 0 1 0</float_array>
<technique_common><accessor source="#pa" count="4" stride="3">
<param name="X" type="float"/><param name="Y" type="float"/><param name="Z" type="float"/>
</accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<polylist count="1"><input semantic="VERTEX" source="#v" offset="0"/>
<vcount>4</vcount><p>0 1 2 3</p></polylist>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s">
<node><scale>2 2 2</scale><instance_geometry url="#g"/>
<node><translate>0 0 3</translate><instance_geometry url="#g"/></node></node>
</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene>
</COLLADA>"""


def test_bodies_of_a_dae_scene_are_placed_and_joined() -> None:
    # One quad twice: scaled by 2, and inside that raised by 3.
    found = read_mesh(DAE.encode(), ".dae")
    assert len(found.faces) == 4
    np.testing.assert_allclose(found.bounds, [[0, 0, 0], [2, 2, 6]])
    assert found.area == pytest.approx(8)


def test_obj_with_quads_an_n_gon_two_bodies_and_no_material_file() -> None:
    text = """mtllib absent.mtl
o seat
v 0 0 0
v 2 0 0
v 2 2 0
v 0 2 0
usemtl wood
f 1 2 3 4
o back
v 0 0 1
v 1 0 1
v 2 1 1
v 1 2 1
v 0 1 1
vt 0 0
vn 0 0 1
f 5/1/1 6/1/1 7/1/1 8/1/1 9/1/1
f -5 -4 -3
"""
    mesh = read_mesh(text.encode(), ".obj")
    assert len(mesh.faces) == 2 + 3 + 1
    flat = mesh.vertices[mesh.faces]
    low = flat[(flat[..., 2] == 0).all(axis=1)]
    high = flat[(flat[..., 2] == 1).all(axis=1)]
    assert (len(low), len(high)) == (2, 4)
    # Polygons are cut, not lost: a square of 4, a pentagon of 2.5, and its corner of 0.5.
    assert mesh.area == pytest.approx(4 + 2.5 + 0.5)


def test_ply_with_quads_and_an_n_gon() -> None:
    header = (
        "ply\nformat ascii 1.0\nelement vertex 5\nproperty float x\nproperty float y\n"
        "property float z\nelement face 3\nproperty list uchar int vertex_indices\nend_header\n"
    )
    body = "0 0 0\n1 0 0\n2 1 0\n1 2 0\n0 1 0\n5 0 1 2 3 4\n4 0 1 2 3\n3 0 1 2\n"
    mesh = read_mesh((header + body).encode(), ".ply")
    assert len(mesh.faces) == 3 + 2 + 1
    # The pentagon (2.5), its first four corners (2) and its first three (0.5).
    assert mesh.area == pytest.approx(2.5 + 2 + 0.5)


@pytest.mark.parametrize("suffix", SUFFIXES)
@pytest.mark.parametrize("content", [b"", b" \n", b"\x00\xff rubbish \x93" * 30])
def test_what_is_no_mesh_is_an_input_error(suffix: str, content: bytes) -> None:
    with pytest.raises(InputError, match=r"^table/part"):
        read_mesh(content, suffix, name="table/part" + suffix)


# Not OBJ: it has no counts, half a file is a smaller mesh.
@pytest.mark.parametrize("suffix", [suffix for suffix in SUFFIXES if suffix != ".obj"])
def test_a_file_cut_in_half_is_an_input_error(suffix: str) -> None:
    content = export(trimesh.creation.icosphere(subdivisions=2), suffix)
    with pytest.raises(InputError):
        read_mesh(content[: len(content) // 2], suffix)


@pytest.mark.parametrize("lost", ["half", "a line", "an index"])
def test_a_text_ply_cut_short_is_an_input_error(lost: str) -> None:
    """Its parser takes what is there for all there is."""
    content = trimesh.creation.icosphere(subdivisions=2).export(file_type="ply", encoding="ascii")
    content = content if isinstance(content, bytes) else content.encode()
    whole = content.rstrip()
    assert len(read_mesh(whole, ".ply").faces) == 320
    kept = {"half": whole[: len(whole) // 2], "a line": whole.rpartition(b"\n")[0],
            "an index": whole.rpartition(b" ")[0]}  # fmt: skip
    with pytest.raises(InputError, match=r"^ball: .*ASCII PLY .*cut short"):
        read_mesh(kept[lost], ".ply", name="ball")


def test_errors_say_what_the_file_lacks(tmp_path: Path) -> None:
    cloud = trimesh.PointCloud([[0.0, 0, 0], [1, 1, 1]]).export(file_type="ply")
    with pytest.raises(InputError, match="has no faces; expected a mesh, not points"):
        read_mesh(cloud, ".ply")
    with pytest.raises(InputError, match=r"has the suffix \.fbx; expected one of \.off, \.obj"):
        read_mesh(b"x", ".fbx")
    (tmp_path / "mesh").write_bytes(b"x")
    with pytest.raises(InputError, match=r"mesh: has no suffix; expected one of \.off, \.obj"):
        read_mesh(tmp_path / "mesh")
    with pytest.raises(InputError, match="up must be one of z, y, got 'x'"):
        read_mesh(b"x", ".off", up="x")
    with pytest.raises(InputError, match=r"absent\.obj: cannot be read"):
        read_mesh(tmp_path / "absent.obj")
    with pytest.raises(InputError, match=r"vertex 1 is \[nan, 0.0, 0.0\]"):
        read_mesh(b"v 0 0 0\nv nan 0 0\nv 0 1 0\nf 1 2 3\n", ".obj")
    with pytest.raises(InputError):
        read_mesh(b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 7\n", ".obj")


def test_normalise_centres_the_box_and_fills_the_ball() -> None:
    # An unused vertex far away bears on nothing; the box of the others is [10,14]×[0,2]×[0,0].
    vertices = [[99, 99, 99], [10, 0, 0], [14, 0, 0], [11, 2, 0]]
    mesh = trimesh.Trimesh(vertices, [[1, 2, 3]], process=False, validate=False)
    found = normalise(mesh)
    np.testing.assert_allclose(
        found.vertices, np.array([[-2, -1, 0], [2, -1, 0], [-1, 1, 0]]) / np.sqrt(5), rtol=1e-15
    )
    np.testing.assert_array_equal(found.faces, [[0, 1, 2]])
    np.testing.assert_array_equal(mesh.vertices, vertices)


def test_normalise_again_changes_nothing_and_keeps_every_face() -> None:
    vertices = np.random.default_rng(0).normal(size=(60, 3)) * 40 + 1000
    faces = np.vstack([np.arange(60).reshape(20, 3)] * 2)
    once = normalise(trimesh.Trimesh(vertices, faces, process=False, validate=False))
    twice = normalise(once)
    assert once.faces.shape == (40, 3)
    assert np.linalg.norm(once.vertices, axis=1).max() == pytest.approx(1, abs=1e-15)
    np.testing.assert_allclose(once.bounds.sum(axis=0), 0, atol=1e-12)
    np.testing.assert_allclose(twice.vertices, once.vertices, atol=1e-14)


@pytest.mark.parametrize("scale", [1e-200, 1e-20, 1.0, 1e20, 1e307])
def test_normalise_any_unit(scale: float) -> None:
    box = trimesh.creation.box((1, 2, 3))
    expected = normalise(box).vertices
    scaled = trimesh.Trimesh(box.vertices * scale, box.faces, process=False, validate=False)
    np.testing.assert_allclose(normalise(scaled).vertices, expected, rtol=1e-12)


def test_what_cannot_be_normalised() -> None:
    def mesh(vertices: object, faces: object) -> trimesh.Trimesh:
        return trimesh.Trimesh(vertices, faces, process=False, validate=False)

    with pytest.raises(InputError, match="cup: none of its 1 faces has an area: their corners"):
        normalise(mesh([[1, 2, 3]] * 3, [[0, 1, 2]]), "cup")
    with pytest.raises(InputError, match="NaN or infinite"):
        normalise(mesh([[0, 0, 0], [1, np.nan, 0], [0, 1, 0]], [[0, 1, 2]]))
    with pytest.raises(InputError, match="has no faces"):
        normalise(mesh([[0, 0, 0]], np.zeros((0, 3), int)))
    # −1 would be the last vertex to NumPy.
    for k in (3, -1):
        with pytest.raises(InputError, match=f"names vertex .*{k}.*; its vertices are 0 to 2"):
            normalise(mesh(np.eye(3), [[0, 1, 2], [0, 1, k]]))
    # NaN in a vertex that no face uses is dropped with it.
    unused = mesh([[0, 0, 0], [1, 0, 0], [0, 1, 0], [np.nan] * 3], [[0, 1, 2]])
    assert np.isfinite(normalise(unused).vertices).all()
