"""What each mesh format's reader refuses, and by which words; how polygons are cut."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import trimesh

from partialbench.errors import InputError
from renderers.sources import mesh as door
from renderers.sources.formats.counted import counted
from renderers.sources.formats.polygons import Polygons
from renderers.sources.mesh import normalise, read_mesh
from tests.renderers.mesh_dialects import DIALECTS, TRUTH, dae, glb, obj, ply, scene, stl_binary

SQUARE = "v 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\n"


@pytest.mark.parametrize("name", [n for n in DIALECTS if n != "strips.ply"])
def test_the_count_without_the_reader_is_the_files(name: str) -> None:
    suffix = name[name.index(".") :]
    polygons = door.READERS[suffix](DIALECTS[name])
    faces = len(polygons.sizes) + polygons.edges
    expected = {"vertices": len(polygons.vertices), "faces": faces}
    found = counted(DIALECTS[name], suffix)
    assert found["faces"] == faces
    assert found.items() <= expected.items()


@pytest.mark.parametrize("name", ["plain.obj", "plain.off", "little.ply", "binary.stl",
                                  "plain.glb", "polylist.dae"])  # fmt: skip
def test_a_reader_that_loses_a_face_is_caught(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    suffix = name[name.index(".") :]
    whole = door.READERS[suffix]

    def blind(content: bytes) -> Polygons:
        found = whole(content)
        return replace(found, corners=found.corners[found.sizes[0] :], sizes=found.sizes[1:])

    monkeypatch.setitem(door.READERS, suffix, blind)
    with pytest.raises(InputError, match=r"^lamp: \d+ faces were read, but the file has \d+"):
        read_mesh(DIALECTS[name], suffix, name="lamp")


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (SQUARE + "f 0 1 2\n", "names vertex 0; OBJ counts vertices from 1"),
        (SQUARE + "f 1 2 5\n", "names vertex 4; the file's vertices are 0 to 3"),
        ("v 0 0 0\nf -1 -2 -3\n" + SQUARE, "names vertex -2, but only 1 vertices stand before it"),
        (SQUARE + "f 1 2 3.5\n", "'3.5' is a corner of a face; expected a whole number"),
        (SQUARE + "f 1/1 2/x 3/1\n", "the corner '2/x'; expected vertex/texture/normal"),
        (SQUARE + "f 1 2\n", "line 5 is 'f 1 2'; expected three corners"),
        (SQUARE.replace("1 1 0", "1 x 0") + "f 1 2 3\n", "'x' is a coordinate; expected a number"),
        (SQUARE.replace("1 1 0", "1_0 1 0") + "f 1 2 3\n", "'1_0' is a coordinate"),
        (SQUARE.replace("1 1 0", "1 0") + "f 1 2 3\n", "line 3 is 'v 1 0'; expected three"),
        (SQUARE + "g a\nw 1 2\nf 1 2 3\n", "line 6 is 'w 1 2'; OBJ has no keyword 'w'"),
        (SQUARE + "surf 0 1 0 1 1 2\nf 1 2 3\n", "free-form curves and surfaces of an OBJ"),
        (SQUARE + "l 1 2\n", "has no faces; expected a mesh, not points or lines"),
    ],
)
def test_obj(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_mesh(text.encode(), ".obj")


def test_a_backslash_goes_on_but_not_out_of_a_comment() -> None:
    text = "# in C:\\models\\\n" + SQUARE + "f 1 2 \\\n 3 \\\n 4\n"
    mesh = read_mesh(text.encode(), ".obj")
    assert (len(mesh.vertices), mesh.area) == (4, 1)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (stl_binary()[:-10], r"counts 20 triangles, which is 1084 bytes, but has 1074 bytes: 19"),
        (stl_binary(b"solid") + bytes(30), r"has 1114 bytes: 20 triangles and 30 bytes"),
        (stl_binary()[:80] + b"\x0b\0\0\0" + stl_binary()[84:], "counts 11 triangles"),
        (DIALECTS["plain.stl"][:-9], "begins 1 solids and ends 0"),
        (DIALECTS["plain.stl"].replace(b"endfacet", b"", 1), "facet 0 of the ASCII STL"),
        (DIALECTS["plain.stl"].replace(b" endloop", b"vertex 1 2 3\nendloop", 1), "facet 0 of"),
    ],
)
def test_stl(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_mesh(content, ".stl")


def test_normals_that_are_no_numbers_cost_no_triangle() -> None:
    written = DIALECTS["plain.stl"].replace(b"nan nan nan", b"-1.#IND 1.#QNAN0 1.#INF00e+000")
    assert b"#" in written
    found, expected = (read_mesh(c, ".stl") for c in (written, DIALECTS["plain.stl"]))
    assert np.array_equal(found.triangles, expected.triangles)
    with pytest.raises(InputError, match="a normal's component; expected a number"):
        read_mesh(DIALECTS["plain.stl"].replace(b"nan nan nan", b"1.#X 0 0"), ".stl")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (ply()[:-6], "face 7 of the ASCII PLY is"),
        (ply() + b"3 0 1 2\n", "1 lines follow the 20 that the PLY header counts"),
        (ply().replace(b"face 8", b"face 7"), "1 lines follow the 19"),
        (ply("binary_little_endian")[:-3], "face 7 of 8 runs past the file's end"),
        (ply("binary_big_endian") + b"abc", "3 bytes follow the last row"),
        (ply().replace(b"face 8", b"face 0"), "has no faces; expected a mesh, not points"),
        (ply().replace(b"vertex_indices", b"corners"), "must have one list vertex_indices once"),
        (ply().replace(b"float y", b"float w"), "vertex must have x, y and z once"),
        (ply().replace(b"uchar int", b"uchar float"), "must be a list of whole numbers"),
    ],
)
def test_ply(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_mesh(content, ".ply")


def changed(**changes: object) -> bytes:
    document, data = scene()
    for path, value in changes.items():
        *parents, key = path.split("__")
        item = document
        for parent in parents:
            item = item[int(parent) if parent.isdigit() else parent]
        item[key] = value
    return glb(document, data)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (changed(extensionsRequired=["KHR_new_thing"]), "uses the extension KHR_new_thing, which"),
        (changed(bufferViews__0__extensions={"EXT_meshopt_compression": {}}), "EXT_meshopt_comp"),
        (changed(nodes__0__skin=0), r"uses a skin \(node 0\)"),
        (changed(meshes__0__primitives__0__targets=[{}]), "uses morph targets"),
        (changed(nodes__0__weights=[1]), "uses morph targets"),
        (changed(nodes__0__extensions={"EXT_mesh_gpu_instancing": {}}), "EXT_mesh_gpu_instancing"),
        (changed(buffers__0__uri="body.bin"), r"lies in another file \(body.bin\); pack"),
        (changed(asset={"version": "1.0"}), "is glTF version 1.0; expected 2.0"),
        (changed(nodes__0__translatiom=[1, 2, 3]), "the key 'translatiom', which glTF does not"),
        (changed(nodes__0__children=[0]), "node 0 has two parents, or is below itself"),
        (changed(nodes__0__mesh=-1), "mesh is -1 in its JSON"),
        (changed(accessors__0__count=9999), "needs 119988 bytes of bufferView 0"),
        (changed(accessors__0__max=[1, 2, 3]), "says that its values lie within"),
        (changed(accessors__1__count=59), "59 indices, which make no triangles"),
        (changed(accessors__0__count=11), "names vertex 11 of a part with 11 vertices"),
        (DIALECTS["plain.glb"][:4] + b"\1" + DIALECTS["plain.glb"][5:], "is GLB version 1"),
        (DIALECTS["plain.glb"][:-8], "it was cut short or something was added"),
        (DIALECTS["draco.glb"].replace(b"DRACO", b"draco"), "KHR_draco_mesh_compression cannot"),
        (json.dumps({"asset": {"version": "2.0"}}).encode(), "has no faces"),
    ],
)
def test_gltf(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_mesh(content, ".glb")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (dae().replace(b"instance_geometry", b"instance_controller"), "uses a skin or morph"),
        (dae().replace(b"</p>", b" 0 0</p>"), "says 8 polygons of 36 corners, but lists 37"),
        (dae("polygons").replace(b'count="8"', b'count="9"'), "says 9, but lists 8"),
        (dae(node="<skew>1 2 3 4 5 6 7</skew>"), "has a <skew>, which is not read"),
        (dae(node="<tranlate>1 2 3</tranlate>"), "has a <tranlate>, which COLLADA does not have"),
        (dae().replace(b'url="#g"', b'url="other.dae#g"'), "lies in another file"),
        (dae().replace(b'count="36"', b'count="39"'), "says 39 numbers, but has 36"),
        (dae()[:-20], "its XML is broken"),
    ],
)
def test_dae(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_mesh(content, ".dae")


def cut(points: object, sizes: list[int] | None = None) -> trimesh.Trimesh:
    vertices = np.array(points, float)
    polygon = Polygons(vertices, np.arange(len(vertices)), np.array(sizes or [len(vertices)]))
    faces, notices = polygon.triangles()
    return trimesh.Trimesh(vertices, faces, process=False, metadata={"notices": notices})


def test_a_concave_polygon_is_covered_once_from_any_corner_in_any_unit() -> None:
    outline = np.array([[0, 0], [4, 0], [4, 3], [2, 1], [0, 3]], float)  # an M: area 8
    for start in range(5):
        for scale, offset in ((1, 0), (1e-9, 0), (1e9, 0), (1, 1e6)):
            flat = np.roll(outline, start, axis=0) * scale + offset
            points = np.c_[flat, flat @ [0.5, 0.25]]
            mesh = cut(points)
            # The plane z = x/2 + y/4 stretches areas.
            area = 8 * scale**2 * np.sqrt(1 + 0.25 + 0.0625)
            assert mesh.area == pytest.approx(area, rel=1e-6)
            a, b, c = mesh.triangles.transpose(1, 0, 2)
            assert (np.cross(b - a, c - a) @ [-0.5, -0.25, 1] > 0).all()


def test_a_convex_polygon_is_the_fan_from_its_first_corner() -> None:
    mesh = cut([[0, 0, 0], [2, 0, 0], [3, 1, 0], [2, 2, 0], [0, 2, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4]])
    assert mesh.metadata["notices"] == ()


def test_a_polygon_with_a_bridge_to_its_hole_is_covered_once() -> None:
    outer, hole = [[0, 0], [4, 0], [4, 4], [0, 4]], [[1, 1], [1, 3], [3, 3], [3, 1]]
    ring = [*outer, outer[0], *hole, hole[0]]
    assert cut(np.c_[ring, np.zeros(len(ring))]).area == pytest.approx(12)


def test_polygons_that_are_not_flat_are_told() -> None:
    mesh = cut([[0, 0, 0], [1, 0, 0], [1, 1, 0.2], [0, 1, 0]])
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3]])
    assert "1 polygons are not flat" in mesh.metadata["notices"][0]


@pytest.mark.parametrize(
    "points",
    [
        [[0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 1, 0]],  # a bow tie of unequal halves
        [[0, 0, 0], [2, 2, 0], [2, 0, 0], [0, 2, 0]],  # of equal ones: no area at all
        [[np.cos(a), np.sin(a), 0] for a in 4 * np.pi / 5 * np.arange(5)],  # a pentagram
    ],
)
def test_a_polygon_that_crosses_itself_is_an_input_error(points: list[list[float]]) -> None:
    with pytest.raises(InputError, match=r"face 0, a polygon of \d corners .* crosses itself"):
        cut(points)


def test_faces_without_area_bear_on_nothing() -> None:
    truth = normalise(TRUTH)
    far = np.array([[90, 90, 90], [91, 92, 93], [92, 94, 96], [5, 5, 5]], float)
    n = len(TRUTH.vertices)
    faces = [*TRUTH.faces, [n, n + 1, n + 2], [n + 3, n + 3, n], [n, n, n]]
    mesh = trimesh.Trimesh(np.vstack([TRUTH.vertices, far]), faces, process=False, validate=False)
    found = normalise(mesh)
    np.testing.assert_array_equal(found.vertices, truth.vertices)
    np.testing.assert_array_equal(found.faces, truth.faces)
    # A body far from the origin, a needle and a speck beside a large body keep their faces.
    for body in (
        TRUTH.copy().apply_translation((6e5, 5e6, 100)),
        TRUTH.copy().apply_transform(np.diag([1e6, 1, 1, 1])),
        trimesh.util.concatenate([TRUTH, TRUTH.copy().apply_scale(1e-6)]),
    ):
        assert len(normalise(body).faces) == len(body.faces)
    with pytest.raises(InputError, match="none of its 2 faces has an area"):
        normalise(trimesh.Trimesh(far, [[0, 1, 2], [3, 3, 3]], process=False, validate=False))


def test_the_same_obj_with_unknown_extras_is_the_same() -> None:
    text = obj().replace("o ell", "o ell\nmg 1 0.5\nshadow_obj x\ns off\ng a b\nusemtl m#1")
    np.testing.assert_array_equal(
        read_mesh(text.encode(), ".obj").vertices, read_mesh(DIALECTS["plain.obj"], ".obj").vertices
    )
