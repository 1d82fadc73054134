"""NPY and NPZ: one array of points, by its shape, its fields or its key."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray

from partialbench.dataset.cloud_formats.points import NORMALS, XYZ, Points, of_table
from partialbench.errors import InputError

KEYS = (
    "points", "point", "xyz", "pos", "position", "positions", "pc", "pcd", "cloud", "pointcloud",
    "point_cloud", "coords", "coord", "vertices", "verts", "data", "arr_0",
)  # fmt: skip
"""Names under which archives and structured arrays hold the points."""
NORMAL_KEYS = ("normals", "normal")
FACE_KEYS = ("faces", "face", "triangles", "tris")
_OTHER_KEYS = {*NORMAL_KEYS, "colors", "colours", "color", "colour", "rgb"}
"""Names of what may have the shape of points and is none."""


def read_npy(content: bytes) -> Points:
    """One array saved by ``numpy.save``.

    Raises:
        InputError: what follows it, fields without x, y, z, or as ``points.of_table``.
    """
    file = io.BytesIO(content)
    if not content.startswith(b"\x93NUMPY"):
        raise InputError("does not begin as NPY does")
    array = np.lib.format.read_array(file, allow_pickle=False)
    if behind := len(content) - file.tell():
        raise InputError(f"{behind} bytes follow its array; expected one array a file")
    return _of_array(array)


def read_npz(content: bytes) -> Points:
    """An archive of one array, or of one under a name of ``KEYS``; its normals beside it.

    Raises:
        InputError: none or several that may be the points, or as ``read_npy``.
    """
    if not zipfile.is_zipfile(io.BytesIO(content)):
        raise InputError("is no NPZ archive: it is damaged or was cut short")
    with np.load(io.BytesIO(content), allow_pickle=False) as archive:
        names = {name.lower(): name for name in archive.files}
        if len(names) < len(archive.files):
            raise InputError(f"holds {', '.join(archive.files)}: one name twice but for capitals")
        if "occupancies" in names or {"pos", "neg"} <= names.keys():
            what = "occupancies" if "occupancies" in names else "signed distances (pos, neg)"
            raise InputError(f"holds {what}: its points fill space, they are on no surface")
        if faces := [names[name] for name in FACE_KEYS if name in names]:
            raise InputError(
                f"holds {faces[0]}: a mesh, whose vertices are no even sample of its surface; save "
                f"it as one of OBJ, PLY, OFF"
            )
        known = [name for name in KEYS if name in names]
        # Of several arrays that were saved without a name, none is known to be the points.
        unnamed = known == ["arr_0"] and len(names) > 1
        if len(known) > 1 or unnamed or (not known and (len(names) != 1 or {*names} & _OTHER_KEYS)):
            raise InputError(
                f"holds {', '.join(archive.files) or 'nothing'}; expected one array, or one "
                f"called {', '.join(KEYS)}"
            )
        key = names[known[0]] if known else archive.files[0]
        found = _of_array(archive[key])
        beside = [names[name] for name in NORMAL_KEYS if name in names]
        if not beside:
            return found
        normals = of_table(archive[beside[0]], f"{beside[0]} ").points
    if len(normals) != len(found.points):
        raise InputError(f"has {len(found.points)} points and {len(normals)} normals")
    return found._replace(normals=normals, named=True)


def _of_array(array: NDArray) -> Points:
    if array.dtype.names is None:
        return of_table(array)
    flat = array.reshape(-1)
    return of_fields({name: flat[name] for name in array.dtype.names})


def of_fields(fields: Mapping[str, NDArray]) -> Points:
    """Named columns: x, y, z (n,), or one (n,3); and their normals.

    Raises:
        InputError: neither is there, or one is no column of numbers.
    """
    names: dict[str, str] = {}
    for name in fields:
        if name.lower() in names:
            raise InputError(f"has the field {name!r} twice")
        names[name.lower()] = name
    normals = None
    if all(axis in names for axis in XYZ):
        points = _columns(fields, [names[axis] for axis in XYZ])
        for triple in NORMALS:
            if all(axis in names for axis in triple):
                normals = _columns(fields, [names[axis] for axis in triple])
                break
    else:
        known = [names[key] for key in KEYS if key in names]
        if len(known) != 1:
            raise InputError(f"has the fields {', '.join(fields)}; expected x, y, z")
        points = np.asarray(fields[known[0]])
        if points.ndim != 2 or points.shape[1] != 3 or points.dtype.kind not in "fiu":
            raise InputError(
                f"its field {known[0]!r} is {points.dtype} {points.shape}, expected (n,3) numbers"
            )
        beside = [names[key] for key in NORMAL_KEYS if key in names]
        if beside and np.shape(fields[beside[0]]) == points.shape:
            normals = np.asarray(fields[beside[0]])
    if len(points) == 0:
        raise InputError("expected an (n,3) cloud with n ≥ 1, got 0 points")
    return Points(
        np.asarray(points, np.float64),
        None if normals is None else np.asarray(normals, np.float64),
        named=True,
    )


def _columns(fields: Mapping[str, NDArray], names: list[str]) -> NDArray[np.float64]:
    for name in names:
        if fields[name].ndim != 1 or fields[name].dtype.kind not in "fiu":
            raise InputError(
                f"its field {name!r} is {fields[name].dtype} {fields[name].shape}, expected one "
                f"number a point"
            )
    return np.stack([np.asarray(fields[name], np.float64) for name in names], axis=1)
