"""What callers of the Python interface give, as what it should be, or an ``InputError``.

A float where a number of points is meant, a mask of NumPy's or a number for a path would else end
in a traceback of whatever library first minds, or in an answer to another question.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError
from partialbench.geometry.rotations import is_rotation
from partialbench.paths import path as path

Several = str | int | float | Path | Iterable[Any] | None


def whole_number(value: Any, name: str, least: int | None = None) -> int:
    """An int, one of NumPy's or a tensor of one; neither a truth value nor 64.0."""
    try:
        if isinstance(value, bool | np.bool_):
            raise TypeError
        number = operator.index(value)
    except TypeError:
        raise InputError(
            f"{name} must be a whole number, got {value!r} ({type(value).__name__})"
        ) from None
    if least is not None and number < least:
        raise InputError(f"{name} must be at least {least}, got {number}")
    return number


def positive(value: Any, name: str) -> float:
    """A finite number above 0; a truth value is none."""
    try:
        number = float(value)
    except (TypeError, ValueError):
        number = math.nan
    if not 0 < number < math.inf or isinstance(value, str | bool | np.bool_):
        raise InputError(f"{name} must be a finite number above 0, got {value!r}")
    return number


def truth(value: Any, name: str) -> bool:
    """True or False and nothing that merely counts as one: "no" does."""
    if not isinstance(value, bool | np.bool_):
        raise InputError(f"{name} must be True or False, got {value!r}")
    return bool(value)


def function(value: Any, name: str, arguments: str = "") -> None:
    """Something to call, or None; ``arguments`` says in the error with what."""
    if value is not None and not callable(value):
        raise InputError(f"{name} must be something to call{arguments}, got {value!r}")


def several(value: Several, name: str) -> list[Any]:
    """What was given, one or several, as a list; None is none. A text is one, not its letters."""
    if value is None:
        return []
    if isinstance(value, str | bytes | int | float | Path | np.generic):
        return [value]
    if isinstance(value, Mapping) or not isinstance(value, Iterable):
        raise InputError(f"{name} must be one or a list of them, got {value!r}")
    return list(value)


def mapping(value: Any, name: str) -> dict[str, Any]:
    """A mapping by names; None is an empty one."""
    if value is None:
        return {}
    if not isinstance(value, Mapping) or not all(isinstance(key, str) for key in value):
        raise InputError(f'{name} must be a dictionary such as {{"name": value}}, got {value!r}')
    return dict(value)


def clouds(points: Any, expected: str) -> tuple[list[tuple[str, NDArray]], bool]:
    """One cloud (N,3), several (B,N,3), or a list of clouds of any sizes.

    Args:
        expected: what errors say may be given.

    Returns:
        Each with what errors call it, as ``cloud`` gives it; and whether it was one by itself.
    """
    dimensions = _dimensions(points)
    if dimensions == 2:
        return [("the cloud", cloud(points))], True
    if dimensions != 3:
        known = hasattr(points, "points") or (isinstance(points, Mapping) and "points" in points)
        raise InputError(
            f"expected {expected}, got a {type(points).__name__} of {dimensions} "
            f"dimension{'' if dimensions == 1 else 's'}{'; give its points' if known else ''}"
        )
    names = (f"cloud {i}" for i in range(len(points)))
    return [(name, cloud(one, name)) for name, one in zip(names, points, strict=True)], False


def _dimensions(points: Any) -> int:
    """2 of a cloud, 3 of several; a list has one more than its first has."""
    if not isinstance(points, list | tuple):
        return int(np.ndim(points))
    if not points:
        return 3
    try:
        return 1 + int(np.ndim(points[0]))
    except ValueError:  # rows of unequal length: which cloud it is is said further on
        return 3


def rotations(R: Any, name: str, count: int) -> NDArray[np.float64]:
    """(count,3,3); one (3,3) stands for itself where one is expected."""
    array = _array(R, name, "(3,3)")
    given = array[None] if array.ndim == 2 else array
    if given.shape != (count, 3, 3):
        raise InputError(f"{name} has shape {array.shape}, expected (3,3) for each of {count}")
    given = _real(given, name, "(3,3)").astype(np.float64)
    if not is_rotation(given, 1e-3).all():
        raise InputError(f"{name} is no rotation: R·Rᵀ must be the identity, det R = 1")
    return given


def cloud(points: Any, name: str = "the cloud") -> NDArray:
    """Points (N,3) of any real dtype and memory layout, N ≥ 0, finite or not.

    Args:
        points: an array, nested lists, or a tensor on whatever device.

    Raises:
        InputError: another shape (further columns are refused), no real numbers, an array of
            NumPy's with masked points, which would count like the others, or a table of pandas'
            that names its columns x, y, z in another order.
    """
    array = _array(points, name, "(N,3)")
    if array.ndim != 2 or array.shape[1] != 3:
        hint = "; transpose it" if array.ndim == 2 and array.shape[0] == 3 else ""
        raise InputError(
            f"{name} is a {type(points).__name__} of shape {array.shape}, expected (N,3){hint}"
        )
    names = [str(column).lower() for column in getattr(points, "columns", ())]
    if names != ["x", "y", "z"] and sorted(names) == ["x", "y", "z"]:
        raise InputError(
            f"{name} has the columns {', '.join(names)}; give them in the order x, y, z"
        )
    return _real(array, name, "(N,3)")


def real_numbers(value: Any, name: str, expected: str) -> NDArray[np.float64]:
    """An array of float64 of whatever holds real numbers; errors say the ``expected`` shape.

    Raises:
        InputError: texts, complex numbers (whose imaginary part NumPy would drop), truth values, or
            no array.
    """
    return _real(_array(value, name, expected), name, expected).astype(np.float64)


def _real(array: NDArray, name: str, expected: str) -> NDArray:
    if array.dtype.kind not in "fiu":
        raise InputError(f"{name} is of type {array.dtype}, expected {expected} real numbers")
    return array


def _array(value: Any, name: str, expected: str) -> NDArray:
    """NumPy's array of an array, nested lists, or a tensor of any kind and device."""
    try:
        if hasattr(value, "detach"):
            value = value.detach().cpu()
            if value.is_floating_point():  # NumPy has no bfloat16
                value = value.double()
            value = value.numpy()
        if not isinstance(value, np.ma.MaskedArray):
            return np.asarray(value)
    except (TypeError, ValueError, RuntimeError) as error:  # ragged lists, sparse tensors
        raise InputError(f"{name} is no array, expected {expected}: {error}") from error
    if np.ma.is_masked(value):
        raise InputError(f"{name} has masked points; leave them out: np.ma.compress_rows(points)")
    return value.data
