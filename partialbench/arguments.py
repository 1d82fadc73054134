"""Values of command-line options that are more than one number: their little grammars.

What does not parse raises ``typer.BadParameter``: wrong usage, exit status 2.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Any

import typer

from partialbench.options import plain

if TYPE_CHECKING:
    from partialbench.geometry.camera import Camera


def pairs(given: list[str] | None) -> dict[str, Any]:
    """``["lr=0.01", "vector=false"]`` → {"lr": 0.01, "vector": False}; see ``options.plain``."""
    return {name: plain(value) for name, value in texts(given).items()}


def texts(given: list[str] | None) -> dict[str, str]:
    """``["vector=false"]`` → {"vector": "false"}: for who knows what each should be."""
    parsed: dict[str, str] = {}
    for item in given or []:
        name, equals, value = item.partition("=")
        if not equals or not name:
            raise typer.BadParameter(f"{item!r} is not of the form name=value")
        if name in parsed:
            raise typer.BadParameter(f"{name} is given twice: {parsed[name]!r} and {value!r}")
        parsed[name] = value
    return parsed


def parts(text: str) -> list[str]:
    """``"lr=0.01,schedule_options={"a":1,"b":2}"`` at the commas outside brackets and quotes."""
    found, depth, quoted = [""], 0, False
    for sign in text:
        quoted ^= sign == '"'
        depth += 0 if quoted else (sign in "[{") - (sign in "]}")
        if sign == "," and not quoted and depth == 0:
            found.append("")
        else:
            found[-1] += sign
    return found


def numbers(text: str, count: int, option: str) -> list[float]:
    """``count`` numbers separated by commas; ``option`` is named in the error."""
    try:
        values = [float(part) for part in text.split(",")]
    except ValueError:
        values = []
    if len(values) != count or not all(map(math.isfinite, values)):
        raise typer.BadParameter(f"{option} takes {count} numbers with commas, got {text!r}")
    return values


def _whole(value: float, what: str, option: str) -> int:
    if value != int(value):
        raise typer.BadParameter(f"{option}: {what} is {value:g}, expected a whole number")
    return int(value)


def camera(text: str) -> Camera:
    """A fixed camera from FX,FY,CX,CY,WIDTH,HEIGHT in pixels."""
    import numpy as np  # not by every --help

    from partialbench.geometry.camera import Camera

    fx, fy, cx, cy, width, height = numbers(text, 6, "--camera")
    size = _whole(width, "WIDTH", "--camera"), _whole(height, "HEIGHT", "--camera")
    try:
        return Camera(np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]]), *size)
    except ValueError as error:
        raise typer.BadParameter(f"--camera {text!r}: {error}") from error


def counts(text: str) -> tuple[int, int] | str:
    """Objects per class as TRAIN,TEST, or "modelnet40" for the official numbers."""
    if text == "modelnet40":
        return text
    train, test = numbers(text, 2, "--counts")
    return _whole(train, "TRAIN", "--counts"), _whole(test, "TEST", "--counts")
