"""Clouds in every dialect give the points that were written; what is ambiguous is refused."""

from __future__ import annotations

import numpy as np
import pytest

from partialbench.dataset.cloud_files import FORMATS, read_cloud, read_oriented
from partialbench.dataset.cloud_formats.lzf import decompress
from partialbench.dataset.cloud_formats.text import looks_like_points
from partialbench.errors import InputError
from tests.dataset import cloud_writers as written


@pytest.mark.parametrize("name", [*written.TEXTS, *written.COUNTED])
def test_every_dialect_gives_the_points_that_were_written(name: str, rng) -> None:
    points = rng.normal(size=(40, 3))
    write = {**written.TEXTS, **written.COUNTED}[name]
    np.testing.assert_array_equal(read_cloud(write(points), name), points)


def test_every_format_has_a_dialect_here() -> None:
    names = [*written.TEXTS, *written.COUNTED]
    assert {suffix for suffix in FORMATS if any(n.endswith(suffix) for n in names)} == set(FORMATS)


ROWS = "0.5 0.6 0.7\n0.25 0.125 1\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("0,5 0,6 0,7\n0,1 0,2 0,3\n", "line 1 is '0,5 0,6 0,7': a comma may be a decimal"),
        ("0,5\t0,6\t0,7\n", "a comma may be a decimal point"),
        ("0,5;0,6;0,7\n", "a comma may be a decimal point"),
        ("0,05,0,97,1,20\n", "a comma may be a decimal point"),
        ("1 2 3\n4,5,6\n", "expected one separator throughout"),
        ("1;2;3\n4 5 6\n", "expected one separator throughout"),
        ("1 2 3\n4 5\n", "line 2 has 2 numbers, line 1 has 3"),
        ("1 2 3\n4 5 six\n", "line 2 is '4 5 six': 'six' is no number"),
        ("1,2,3\n4,,6\n", "line 2: a cell is empty"),
        ("C 0 0 1\nH 1 0 0\n", "'C' is no number .symbols of atoms: a molecule is no surface"),
        ("2\nwater\nO 0 0 1\nH 1 0 0\n", "symbols of atoms"),
        ("3\n" + ROWS, "says 3 points in its first line, 2 follow it"),
        ("1\n" + ROWS, "says 1 points in its first line, 2 follow it"),
        ("r g b\n" + ROWS, "line 1 names the columns r, g, b; expected x, y and z among them"),
        ("x y x\n" + ROWS, "names the columns x, y, x"),
        ("id x y z\n" + ROWS, "line 1 names 4 columns .id x y z., the table has 3"),
        ("x y z x\n1 2 3 4\n", "names two columns the same"),
        ("1 2 3 4\n2 3 4 5\n3 1 2 3\n4 0 0 0\n", "the first column counts the rows from 1 on"),
        ("7 .2 3 4\n9 .3 4 5\n10 .1 2 3\n40 0 0 0\n", "another whole number in each row .7, 9, 10"),
        ("7 .2 3 4\n3 .3 4 5\n40 .1 2 3\n5 0 0 0\n", "another whole number in each row .7, 3, 40"),
        ("x y z\n7 .2 3 4\n3 .3 4 5\n40 .1 2 3\n5 0 0 0\n", "is it x or a number of the point"),
        ("", "no line of numbers"),
        ("# nothing\n", "no line of numbers"),
        ("nan nan nan\n" + ROWS, "1 of 3 points are not finite"),
        ("1_0 2 3\n", "'1_0' is no number"),
        ("1 2 3#4.5\n", "'3#4.5' is no number"),
    ],
)
def test_text_that_may_be_read_two_ways_is_refused(content: str, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_cloud(content.encode(), "a.txt")


SIX = "1 2 3 4 5 6\n6 5 4 3 2 1\n"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("# z y x\n" + SIX, "line 1 names 3 columns .z y x., the table has 6"),
        ("// r g b X Y Z i\n" + SIX, "line 1 names 7 columns"),
        ("# id x y z\n" + SIX, "line 1 names 4 columns"),
        ("# lon,lat,alt\n1,2,3\n4,5,6\n", "line 1 names the columns lon, lat, alt; expected x, y"),
        ("x,y\n1,2,3\n4,5,6\n", "names the columns x, y; .* a name for each of the 3 columns"),
        ("id;r;g;b\n1;2;3;4;5\n", "names the columns id, r, g, b; .* each of the 5 columns"),
    ],
)
def test_names_that_are_not_those_of_the_first_three_columns_are_refused(content, message) -> None:
    with pytest.raises(InputError, match=message):
        read_cloud(content.encode(), "a.txt")


@pytest.mark.parametrize(
    "comment",
    ["# x y z", "# x, y, z in metres", "# Format: x y z", "# a scan of mine", "#",
     "# frame: x right, y down, z forward", "# mug, scanned by me, 2020"],
)  # fmt: skip
def test_a_comment_in_prose_changes_nothing(comment: str, rng) -> None:
    for columns in (3, 6):
        table = rng.normal(size=(20, columns))
        content = f"{comment}\n".encode() + written.text(table)
        np.testing.assert_array_equal(read_cloud(content, "a.txt"), table[:, :3])
    content = b"# columns are x, y, z\n" + written.text(table[:, :3], ",")
    np.testing.assert_array_equal(read_cloud(content, "a.csv"), table[:, :3])


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (written.npy(np.ones((3, 3))), r"shape \(3, 3\): rows and columns cannot be told apart"),
        (written.npy(np.ones((3, 6))), r"shape \(3, 6\), which may be read either way"),
        (written.npy(np.ones((4, 60))), r"shape \(4, 60\), which may be read either way"),
        (written.npy(np.ones((48, 64))), r"shape \(48, 64\): an image, or 64 numbers a point"),
        (written.npy(np.ones((2, 60, 3))), r"shape \(2, 60, 3\); expected one"),
        (written.npy(np.ones(60)), r"shape \(60,\); expected one"),
        (written.npy(np.ones((60, 3), complex)), "holds complex128, expected an array of real"),
        (written.npy(np.ones((60, 3), bool)), "holds bool, expected an array of real"),
        (
            written.npy(written.structured(np.ones((9, 3)), "abc")),
            "the fields i, a, b, c; expected",
        ),
        (written.npy(np.ones((60, 3))) + b"more", "4 bytes follow its array"),
    ],
)
def test_arrays_of_another_shape_are_refused(content: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        read_cloud(content, "a.npy")


def test_a_column_without_a_name_keeps_its_place(rng) -> None:
    """pandas writes the numbers of rows, of which some may be gone, under no name."""
    points = rng.normal(size=(20, 3))
    table = np.column_stack([rng.permutation(99)[:20], points, rng.integers(0, 9, 20)])
    for header in (",x,y,z,class", '"";"x";"y";"z";"class"', " , x , y , z , class ,"):
        sign = ";" if ";" in header else ","
        closed = sign if header.endswith(",") else ""
        rows = [sign.join(map(repr, map(float, row))) + closed for row in table]
        content = "\n".join([header, *rows]).encode()
        assert np.array_equal(read_cloud(content, "a.csv"), points)


def test_an_archive_of_several_arrays_is_refused_by_its_keys(rng) -> None:
    points = rng.normal(size=(20, 3))
    with pytest.raises(InputError, match="holds a, b; expected one array, or one called points"):
        read_cloud(written.npz(a=points, b=points), "a.npz")
    with pytest.raises(InputError, match="holds points, xyz; expected one array"):
        read_cloud(written.npz(points=points, xyz=points), "a.npz")
    for name in ("normals", "Colors", "rgb"):
        with pytest.raises(InputError, match=f"holds {name}; expected one array, or one called"):
            read_cloud(written.npz(**{name: points}), "a.npz")
    with pytest.raises(InputError, match="holds arr_0, arr_1; expected one array"):
        read_cloud(written.npz(arr_0=points, arr_1=points), "a.npz")
    with pytest.raises(InputError, match="holds Points, points: one name twice"):
        read_cloud(written.npz(Points=points, points=points), "a.npz")
    np.testing.assert_array_equal(read_cloud(written.npz(arr_0=points), "a.npz"), points)
    with pytest.raises(InputError, match="its points fill space, they are on no surface"):
        read_cloud(written.npz(points=points, occupancies=points[:, 0]), "a.npz")
    with pytest.raises(InputError, match=r"signed distances \(pos, neg\): its points fill space"):
        read_cloud(written.npz(pos=np.ones((9, 4)), neg=np.ones((9, 4))), "a.npz")
    with pytest.raises(InputError, match="holds faces: a mesh, whose vertices are no even sample"):
        read_cloud(written.npz(vertices=points, faces=np.zeros((4, 3), int)), "a.npz")


def test_normals_are_kept_where_the_file_has_them(rng) -> None:
    points = rng.normal(size=(30, 3))
    normals = rng.normal(size=(30, 3))
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    both = np.hstack([points, normals])
    ply = (
        written.ply(points, "ascii")
        .replace(b"uchar red", b"float nx")
        .replace(b"end_header", b"property float ny\nproperty float nz\nend_header")
    )
    head = ply.partition(b"end_header\n")[0]
    rows = np.column_stack([normals[:, 0], points, normals[:, 1:]])
    contents = {
        "a.txt": written.text(both, ","),
        "a.npy": written.npy(both),
        "b.npy": written.npy(both.T),
        "a.npz": written.npz(points=points, normals=7 * normals),
        "a.ply": head + b"end_header\n" + written.text(rows),
        "named.csv": b"nx,ny,nz,x,y,z\n" + written.text(np.hstack([normals, points]), ","),
        "a.pcd": written.pcd(points, "ascii").partition(b"# ")[0]
        + b"FIELDS x y z normal_x normal_y normal_z\nSIZE 8 8 8 8 8 8\nTYPE F F F F F F\nWIDTH 30\n"
          b"HEIGHT 1\nPOINTS 30\nDATA ascii\n"
        + written.text(both),
    }  # fmt: skip
    for name, content in contents.items():
        got, directions = read_oriented(content, name)
        np.testing.assert_allclose(got, points, atol=1e-12, err_msg=name)
        assert directions is not None, name
        np.testing.assert_allclose(directions, normals, atol=1e-6, err_msg=name)


def test_colours_are_no_normals(rng) -> None:
    points = rng.normal(size=(30, 3))
    colours = np.hstack([points, rng.uniform(size=(30, 3))])
    assert read_oriented(written.npy(colours), "a.npy")[1] is None
    assert read_oriented(written.text(colours), "a.xyz")[1] is None
    zero = np.hstack([points, np.zeros((30, 3))])
    assert read_oriented(written.text(zero), "a.txt")[1] is None


def test_a_pcd_of_another_version_or_organised_is_read(rng) -> None:
    points = rng.normal(size=(12, 3))
    old = written.pcd(points, "binary").replace(b"VERSION 0.7", b"VERSION .6")
    np.testing.assert_array_equal(read_cloud(old, "a.pcd"), points)
    image = points.copy()
    image[[2, 7]] = np.nan
    grid = written.pcd(image, "binary_compressed").replace(
        b"WIDTH 12\nHEIGHT 1", b"WIDTH 4\nHEIGHT 3"
    )
    np.testing.assert_array_equal(read_cloud(grid, "a.pcd"), np.delete(points, [2, 7], axis=0))
    wrong = grid.replace(b"HEIGHT 3", b"HEIGHT 4")
    with pytest.raises(InputError, match="POINTS': 12, 'WIDTH × HEIGHT': 16"):
        read_cloud(wrong, "a.pcd")


@pytest.mark.parametrize("size", [1, 31, 32, 33, 300, 5000])
def test_lzf_is_unpacked_as_liblzf_packs_it(size: int, rng) -> None:
    for data in (rng.integers(0, 3, size), rng.integers(0, 256, size), np.zeros(size)):
        raw = data.astype(np.uint8).tobytes()
        assert decompress(written.lzf(raw), size) == raw


@pytest.mark.parametrize(
    ("packed", "message"),
    [(b"\x05ab", "end early"), (b"\x00a\xe0", "end early"), (b"\x20\x05", "before their start"),
     (b"\x01ab", "give 2 bytes, 9 were said")],
)  # fmt: skip
def test_damaged_lzf_is_told(packed: bytes, message: str) -> None:
    with pytest.raises(InputError, match=message):
        decompress(packed, 9)


def test_a_ply_may_name_its_axes_in_capitals(rng) -> None:
    points = rng.random((5, 3))
    lines = [f"property double {axis}" for axis in "XYZ"]
    header = ["ply", "format ascii 1.0", "element vertex 5", *lines, "end_header"]
    rows = [" ".join(map(repr, row)) for row in points.tolist()]
    content = "\n".join([*header, *rows]).encode()
    np.testing.assert_array_equal(read_cloud(content, "a.ply"), points)


def test_a_ply_of_other_properties_says_which(rng) -> None:
    for encoding in ("ascii", "binary_big_endian"):
        content = written.ply(rng.random((5, 3)), encoding).replace(b"double z", b"double w")
        with pytest.raises(InputError, match="the properties red, x, y, w; expected x, y, z"):
            read_cloud(content, "a.ply")


def test_a_list_of_names_does_not_look_like_points() -> None:
    assert looks_like_points(b"x y z\n1 2 3\n")
    assert looks_like_points(b"600\n1 2 3\n")
    assert not looks_like_points(b"chair_0001\nchair_0002\n")
    assert not looks_like_points(b"This data set has 3 parts\n")
    assert not looks_like_points(b"")
