"""The header of a PLY file: mesh or cloud, and what else it promises."""

from __future__ import annotations

import pytest

from partialbench.dataset.ply import header_is_whole, is_mesh, parse_header
from partialbench.errors import InputError

LINES = (
    "ply", "format binary_big_endian 1.0", "comment end_header", "obj_info element face 9",
    "element vertex 4", "property float x", "property double y", "property list uchar int z",
    "element face 2", "property list uint8 uint32 vertex_indices", "end_header",
)  # fmt: skip


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
def test_elements_properties_and_size(newline: str) -> None:
    text = (newline.join(LINES) + newline).encode()
    # A byte 10 is data where lines end with CR.
    header = parse_header(text + b"\x0a\x00\x00")
    assert header.size == len(text)
    assert header.encoding == "binary_big_endian"
    assert [(e.name, e.count) for e in header.elements] == [("vertex", 4), ("face", 2)]
    vertex, face = header.elements
    assert [(p.name, p.dtype, p.length_dtype) for p in vertex.properties] == [
        ("x", "f4", ""),
        ("y", "f8", ""),
        ("z", "i4", "u1"),
    ]
    assert face.properties[0].dtype == "u4"
    assert header.is_mesh


@pytest.mark.parametrize(
    ("faces", "mesh"),
    [
        ("element face 1\n", True),
        ("element face 0\nproperty list uchar int vertex_indices\n", False),
        ("", False),
        ("element tristrips 1\nproperty list int int vertex_indices\n", True),
        ("comment element face 7\n", False),
    ],
)
def test_mesh_or_cloud(faces: str, mesh: bool) -> None:
    head = "ply\nformat ascii 1.0\nelement vertex 2\nproperty float x\n"
    assert is_mesh(f"{head}{faces}end_header\n0\n1\n".encode()) is mesh


def test_a_long_header_is_read_to_its_end() -> None:
    head = b"ply\nformat ascii 1.0\n" + b"comment range 0.1\n" * 9000
    tail = b"element vertex 1\nproperty float x\nelement face 1\nend_header\n"
    assert not header_is_whole(head)
    assert header_is_whole(head + tail)
    assert is_mesh(head + tail)
    # More bytes would not make PLY of these.
    assert header_is_whole(b"solid")
    assert not header_is_whole(b"pl")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (("ply", "plx"), "begins with 'plx"),
        (("end_header", "end"), "has no line end_header"),
        (("format binary_big_endian 1.0", "comment"), "has no line format ascii or"),
        (("format binary_big_endian 1.0", "format utf8 1.0"), "line 'format utf8 1.0'"),
        (("element vertex 4", "element vertex -4"), "line 'element vertex -4'"),
        (("element vertex 4", "element face 4"), "the element 'face' twice"),
        (("property float x", "property real x"), "line 'property real x'"),
        (("uint8 uint32", "float uint32"), "line 'property list float uint32"),
        (("property float x", "x"), "line 'x'"),
    ],
)
def test_a_broken_header_is_an_input_error(change: tuple[str, str], message: str) -> None:
    text = ("\n".join(LINES[:2] + LINES[4:]) + "\n").replace(*change)
    with pytest.raises(InputError, match=message):
        parse_header(text.encode())
