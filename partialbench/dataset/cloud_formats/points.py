"""What every cloud format hands on, and the checks they share."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError

XYZ = ("x", "y", "z")
NORMALS = (("nx", "ny", "nz"), ("normal_x", "normal_y", "normal_z"))
"""How files name the columns of a normal."""

WIDEST = 16
"""Columns of a table from which it is taken to hold a point a column, not a row."""


class Points(NamedTuple):
    """One file's cloud.

    Attributes:
        points: (n,3) float64, as the file has them, finite or not.
        normals: (n,3) float64, or None.
        named: whether the file itself calls them normals; else they are columns 4 to 6, which may
            be colours.
        columns: of a table that does not name them: the first three are the points. 3 where it
            does.
    """

    points: NDArray[np.float64]
    normals: NDArray[np.float64] | None = None
    named: bool = False
    columns: int = 3


def of_table(table: NDArray, where: str = "") -> Points:
    """A table of points, one a row or one a column: x, y, z first, whatever follows behind.

    A table of 3 or 6 rows and more than ``WIDEST`` columns is turned, one that might be read either
    way is refused.

    Args:
        table: (n,c), (c,n) or with leading axes of length 1.
        where: what the error calls it.

    Raises:
        InputError: another number of axes, no numbers, or it is not clear which axis is which.
    """
    table = np.asarray(table)
    shape = table.shape
    if table.dtype.kind not in "fiu":
        raise InputError(f"{where}holds {table.dtype}, expected an array of real numbers")
    while table.ndim > 2 and len(table) == 1:
        table = table[0]
    if table.ndim != 2 or 0 in table.shape:
        raise InputError(f"{where}has the shape {shape}; expected one (n,3) cloud with n ≥ 1")
    rows, columns = table.shape
    if rows in (3, 6) and columns > WIDEST:
        table = table.T
    elif min(rows, columns) > WIDEST:
        raise InputError(
            f"{where}has the shape {shape}: an image, or {columns} numbers a point; save it as "
            f"(n,3), a point a row"
        )
    elif columns > WIDEST or (columns != 3 and rows in (3, 6) and columns >= 3):
        raise InputError(
            f"{where}has the shape {shape}, which may be read either way; save it as (n,3), "
            f"a point a row"
        )
    elif rows == columns == 3:
        raise InputError(f"{where}has the shape (3, 3): rows and columns cannot be told apart")
    return of_rows(table, where)


def of_rows(table: NDArray, where: str = "") -> Points:
    """A table (n,c) of one point a row: x, y, z first."""
    table = np.asarray(table, np.float64)
    if table.ndim != 2 or table.shape[1] < 3 or len(table) == 0:
        raise InputError(f"{where}expected an (n,3) cloud with n ≥ 1, got {table.shape}")
    require_no_index(table, where)
    normals = table[:, 3:6] if table.shape[1] >= 6 else None
    return Points(table[:, :3], normals, columns=table.shape[1])


def require_no_index(table: NDArray, where: str = "") -> None:
    """Raise ``InputError`` where the first of four or more columns numbers the points.

    It counts the rows; or, as where points were picked from more, it holds a whole number of each,
    in rising order or beside coordinates that are no whole numbers.
    """
    first = table[:, 0]
    if table.shape[1] <= 3 or len(first) <= 3 or not np.isfinite(first).all():
        return
    if not (first == np.floor(first)).all():
        return
    steps = np.diff(first)
    if first[0] in (0, 1) and (steps == 1).all():
        found = f"counts the rows from {first[0]:g} on"
    elif (steps > 0).all() or (
        len(np.unique(first)) == len(first) and (table[:, 1:4] != np.floor(table[:, 1:4])).any()
    ):
        shown = ", ".join(f"{value:.10g}" for value in first[:3])
        found = f"has another whole number in each row ({shown}, …)"
    else:
        return
    raise InputError(
        f"{where}the first column {found}: is it x or a number of the point? Name the columns in a "
        f"header (id x y z), or remove it"
    )


def padding(points: NDArray) -> NDArray[np.bool_]:
    """Which of the points (n,3) are (0, 0, 0) and are none: files are padded with them to a fixed
    size, sensors write them where they measured nothing.

    Those are two or more, and more than there are of any other point, as zero may be a point too.
    """
    zero = (points == 0).all(axis=1)
    count = int(zero.sum())
    if 2 <= count < len(points):
        _, times = np.unique(points[~zero], axis=0, return_counts=True)
        if count > times.max():
            return zero
    return np.zeros(len(points), np.bool_)


def unit_normals(points: Points) -> NDArray[np.float64] | None:
    """The cloud's normals, made unit; None where it has none or a point lacks a direction.

    Columns that no name calls normals are taken for them only if all are unit to rounding: else
    they are colours.
    """
    if points.normals is None:
        return None
    with np.errstate(over="ignore", invalid="ignore"):  # any numbers may stand in columns 4 to 6
        length = np.linalg.norm(points.normals, axis=1)
    good = np.isfinite(length) & (length > 0)
    if not points.named:
        good &= np.abs(length - 1) < 0.01
    if not good.all():
        return None
    return points.normals / length[:, None]
