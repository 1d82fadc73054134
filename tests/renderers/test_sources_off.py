"""The OFF reader: every way such files are written, and every way they are broken."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from partialbench.errors import InputError
from renderers.sources.mesh import read_mesh


def read_off(source: bytes | Path, name: str = "") -> trimesh.Trimesh:
    return read_mesh(source, ".off", name=name)


VERTICES = "0 0 0\n1 0 0\n1 1 0\n0 1 0.5\n"
COLOURED = "OFF\n4 2 0\n" + VERTICES.replace("\n", " 200 100 0 255\n") + "3 0 1 2\n3 0 2 3\n"
PLAIN = "OFF\n4 2 0\n" + VERTICES + "3 0 1 2\n3 0 2 3\n"
POINTS = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0.5]]
TRIANGLES = [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    "text",
    [
        PLAIN,
        PLAIN.replace("OFF\n", "OFF"),
        PLAIN.replace("OFF\n", "OFF "),
        PLAIN.replace("4 2 0", "4 2"),
        PLAIN.replace("4 2 0", "4 2\n0"),
        PLAIN.replace("\n", "\r\n"),
        PLAIN.replace("OFF\n", "OFF").replace("\n", "\r\n"),
        PLAIN.replace("\n", "\r"),
        PLAIN.rstrip("\n"),
        PLAIN.replace("\n", "\n\n"),
        PLAIN.replace("\n", " \t\n  "),
        "\n\n" + PLAIN,
        "# a comment\n" + PLAIN,
        PLAIN.replace("1 1 0\n", "1 1 0 # the corner 9 9 9\n# and 7 7 7 more\n"),
        PLAIN.replace("1 1 0\n", "1.0e0 +1 -0.\n"),
        PLAIN.replace("3 0 1 2\n", "3 0 1 2 255 0 0\n"),
        PLAIN.replace("3 0 1 2\n", "3 0 1 2 0.5 0.25 1.0 0.5\n").replace("2 3\n", "2 3 7\n"),
        COLOURED,
        "OFF\n4 1 0\n" + VERTICES + "4 0 1 2 3\n",
        "OFF\n4 1 0\n" + VERTICES + "4 0 1 2 3 255 255 255\n",
    ],
)
def test_all_ways_to_write_one_mesh(text: str) -> None:
    mesh = read_off(text.encode())
    np.testing.assert_array_equal(mesh.vertices, POINTS)
    np.testing.assert_array_equal(mesh.faces, TRIANGLES)
    assert (mesh.vertices.dtype, mesh.faces.dtype) == (np.float64, np.int64)


def test_polygons_become_fans_in_order() -> None:
    mesh = read_off(b"OFF 5 2 0\n0 0 0\n1 0 0\n2 1 0\n1 2 0\n0 1 0\n5 0 1 2 3 4\n3 4 3 2\n")
    np.testing.assert_array_equal(mesh.faces, [[0, 1, 2], [0, 2, 3], [0, 3, 4], [4, 3, 2]])


def test_nothing_is_merged_or_dropped() -> None:
    # A repeated vertex, an unused one, a face of no area and a doubled face.
    text = "OFF\n5 3 0\n0 0 0\n0 0 0\n1 0 0\n0 1 0\n9 9 9\n3 0 2 3\n3 3 2 0\n3 0 1 2\n"
    mesh = read_off(text.encode())
    assert mesh.vertices.shape == (5, 3)
    np.testing.assert_array_equal(mesh.faces, [[0, 2, 3], [3, 2, 0], [0, 1, 2]])


def test_coordinates_are_the_nearest_float64() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(size=(50, 3)) * 10.0 ** rng.integers(-12, 12, (50, 1))
    rows = "\n".join(" ".join(repr(float(x)) for x in row) for row in values)
    mesh = read_off(f"OFF\n50 1 0\n{rows}\n3 0 1 2\n".encode())
    np.testing.assert_array_equal(mesh.vertices, values)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "part.off: the file is empty"),
        (" \n\r\n ", "the file is empty"),
        ("solid ascii", "begins with 'solid'; expected OFF"),
        ("ply\nformat", "begins with 'ply'; expected OFF"),
        (PLAIN.replace("OFF", "COFF"), "vertex 0 is '0 0 0'; expected 7 or 6 numbers"),
        (PLAIN.replace("OFF", "XOFF"), "begins with 'XOFF'; expected OFF"),
        (PLAIN.replace("4 2 0\n", "4 2 0 9\n"), "7 lines follow the counts of 4 vertices and 2"),
        (PLAIN + "0 1\n", "7 lines follow the counts of 4 vertices and 2 faces; expected 6"),
        (PLAIN.replace("OFF", "NCNOFF"), "begins with 'NCNOFF', which says a thing twice"),
        ("OFF\n", "has no counts behind its keyword"),
        ("OFF\nfour two 0\n", "'four' is one of the counts of .*; expected a whole number"),
        ("OFF\n4 0 0\n" + VERTICES, "4 vertices and 0 faces; expected at least one face"),
        ("OFF\n0 2 0\n", "0 vertices and 2 faces"),
        ("OFF\n-4 2 0\n" + VERTICES, "-4 vertices and 2 faces"),
        ("OFF\n4 2 0\n0 0 0\n1 0 0\n", "ends after vertex 2 of 4; it was cut short"),
        (PLAIN[:-9], "ends after face 1 of 2; it was cut short"),
        (PLAIN[:-3], "face 1 is '3 0 2'; expected a count, as many vertex indices"),
        (PLAIN.replace("1 1 0\n", "nan 1 0\n"), r"vertex 2 is \[nan, 1.0, 0.0\]; expected finite"),
        (PLAIN.replace("1 1 0\n", "1 -inf 0\n"), r"vertex 2 is \[1.0, -inf, 0.0\]"),
        (PLAIN.replace("1 1 0\n", "1 x 0\n"), "vertex 2 is '1 x 0'; expected numbers"),
        (PLAIN.replace("1 1 0\n", "1 1\n"), "vertex 2 is '1 1'; expected 3 or 6 or 7 numbers"),
        (PLAIN.replace("3 0 1 2", "3 0 1 4"), "a face names vertex 4; .* are 0 to 3"),
        (PLAIN.replace("3 0 1 2", "3 0 1 -1"), "a face names vertex -1; .* are 0 to 3"),
        (PLAIN.replace("3 0", "2 0"), "none of its 2 faces has three corners"),
        (PLAIN.replace("3 0 1 2", "5 0 1 2"), "face 0 is '5 0 1 2'"),
        (PLAIN.replace("3 0 1 2", "3 0 1.5 2"), "face 0 is '0 1.5 2'; expected vertex indices"),
        (PLAIN.replace("3 0 1 2", "3 0 1 99999999999999999999"), "vertex index|names vertex"),
    ],
)
def test_every_broken_file_is_told_apart(text: str, message: str) -> None:
    with pytest.raises(InputError, match=message) as caught:
        read_off(text.encode(), "part.off")
    assert str(caught.value).startswith("part.off: ")


def test_binary_rubbish_is_an_input_error() -> None:
    rng = np.random.default_rng(0)
    for size in (1, 10, 1000):
        with pytest.raises(InputError):
            read_off(rng.integers(0, 256, size, np.uint8).tobytes())
        with pytest.raises(InputError):
            read_off(b"OFF\n3 1 0\n" + rng.integers(0, 256, size, np.uint8).tobytes())


def test_any_cut_of_a_file_is_an_input_error() -> None:
    for end in range(len(PLAIN.rstrip())):
        with pytest.raises(InputError):
            read_off(PLAIN[:end].encode())


def test_a_path_that_cannot_be_read_is_named(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"absent\.off: cannot be read \(No such file"):
        read_off(tmp_path / "absent.off")
    path = tmp_path / "plain.off"
    path.write_text(PLAIN)
    np.testing.assert_array_equal(read_off(path).faces, TRIANGLES)


@pytest.mark.data
def test_real_files_read_as_trimesh_reads_them(shared: Path) -> None:
    paths = sorted((shared / "data" / "ModelNet40").glob("*/*/*.off"))
    assert len(paths) == 8
    for path in paths:
        ours, theirs = read_off(path), trimesh.load(path, process=False)
        np.testing.assert_array_equal(ours.vertices, theirs.vertices)
        np.testing.assert_array_equal(ours.faces, theirs.faces)
