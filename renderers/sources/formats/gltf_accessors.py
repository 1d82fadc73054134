"""What the accessors of a glTF file hold, each checked against what it says of itself."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError

_TYPES = {5120: "<i1", 5121: "<u1", 5122: "<i2", 5123: "<u2", 5125: "<u4", 5126: "<f4"}
_MESHOPT = ("EXT_meshopt_compression", "KHR_meshopt_compression")
BOX_TOLERANCE = 0.01
"""How far values may pass, or stay within, the box that the file states, as a share of its size."""


def integer(item: Any, key: str, default: int | None = None, below: int | None = None) -> int:
    """A whole number that is at least 0; ``InputError`` for anything else."""
    value = item.get(key, default) if isinstance(item, dict) else None
    if type(value) is not int or value < 0 or (below is not None and value >= below):
        expected = "expected a whole number" + ("" if below is None else f" below {below}")
        raise InputError(f"{key} is {value!r} in its JSON; {expected}")
    return value


def sequence(item: Any, key: str) -> list[Any]:
    """A list of the JSON, empty where it is absent."""
    value = item.get(key, []) if isinstance(item, dict) else None
    if not isinstance(value, list):
        raise InputError(f"{key} is no list in its JSON")
    return value


def known(item: Any, kind: str, keys: tuple[str, ...]) -> None:
    """Raise ``InputError`` for a key that glTF does not have: it may be a misspelt one."""
    if not isinstance(item, dict):
        raise InputError(f"a {kind} of its JSON is no object")
    if unknown := sorted(set(item) - set(keys) - {"name", "extensions", "extras"}):
        raise InputError(f"a {kind} has the key {unknown[0]!r}, which glTF does not have")
    if not isinstance(item.get("extensions", {}), dict):
        raise InputError(f"the extensions of a {kind} are no object")


class Accessors:
    """The accessors of a document over its buffers.

    Args:
        document: the JSON.
        buffers: each one's bytes, or the error to raise where it is needed.
    """

    def __init__(self, document: dict[str, Any], buffers: list[bytes | InputError]) -> None:
        self._accessors = sequence(document, "accessors")
        self._views = sequence(document, "bufferViews")
        self._buffers = buffers

    def positions(self, primitive: dict[str, Any]) -> NDArray[np.float64]:
        """A primitive's vertices (n,3) float64, in its node's frame."""
        accessor = self._position(primitive)
        stored = self._values(accessor, 3, tuple(_TYPES))
        values = np.asarray(stored, np.float64)
        if accessor.get("normalized", False):
            if stored.dtype.kind not in "iu" or stored.dtype.itemsize > 2:
                raise InputError("a POSITION accessor is normalised but holds no short integers")
            values = np.maximum(values / np.iinfo(stored.dtype).max, -1)
        if not np.isfinite(values).all():
            raise InputError("has a coordinate that is no finite number")
        self._require_box(accessor, np.asarray(stored, np.float64), values)
        return values

    def indices(self, primitive: dict[str, Any], vertices: int) -> NDArray[np.int64]:
        """A primitive's indices (n,), those of its vertices in order where it has none."""
        if "indices" not in primitive:
            return np.arange(vertices)
        accessor = self._accessor(integer(primitive, "indices", below=len(self._accessors)))
        return self._values(accessor, 1, (5121, 5123, 5125))[:, 0].astype(np.int64)

    def draco(
        self, primitive: dict[str, Any], extension: Any
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Vertices (n,3) and indices (3·faces,) of a Draco compressed primitive."""
        import DracoPy

        accessor = self._position(primitive)
        data, _ = self._view(integer(extension, "bufferView", below=len(self._views)))
        try:
            decoded = DracoPy.decode(data)
            points = np.asarray(decoded.points, np.float64).reshape(-1, 3)
            faces = np.asarray(getattr(decoded, "faces", []), np.int64).reshape(-1)
        except Exception as error:  # of types of its own
            raise InputError(
                f"a part under KHR_draco_mesh_compression cannot be decoded ({error})"
            ) from error
        stated = integer(accessor, "count")
        index = self._accessor(integer(primitive, "indices", below=len(self._accessors)))
        if len(points) != stated or len(faces) != integer(index, "count"):
            raise InputError(
                f"a part under KHR_draco_mesh_compression gives {len(points)} vertices and "
                f"{len(faces)} indices; its accessors say {stated} and {index['count']}"
            )
        if not np.isfinite(points).all():
            raise InputError("has a coordinate that is no finite number")
        self._require_box(accessor, points, points)
        return points, faces

    def _position(self, primitive: dict[str, Any]) -> dict[str, Any]:
        attributes = primitive.get("attributes")
        if not isinstance(attributes, dict) or "POSITION" not in attributes:
            raise InputError("a part has no POSITION")
        return self._accessor(integer(attributes, "POSITION", below=len(self._accessors)))

    def _accessor(self, index: int) -> dict[str, Any]:
        accessor = self._accessors[index]
        known(accessor, "accessor", ("bufferView", "byteOffset", "componentType", "normalized",
                                     "count", "type", "max", "min", "sparse"))  # fmt: skip
        return accessor

    def _view(self, index: int) -> tuple[bytes, int]:
        """A buffer view's bytes and its stride, 0 for none."""
        view = self._views[index]
        known(view, "bufferView", ("buffer", "byteOffset", "byteLength", "byteStride", "target"))
        for name in _MESHOPT:
            if name in view.get("extensions", {}):
                raise InputError(f"uses {name}, which is not read; export it uncompressed")
        data = self._buffers[integer(view, "buffer", below=len(self._buffers))]
        if isinstance(data, InputError):
            raise data
        start, length = integer(view, "byteOffset", 0), integer(view, "byteLength")
        if start + length > len(data):
            raise InputError(
                f"bufferView {index} ends at byte {start + length} of a buffer of {len(data)}"
            )
        stride = integer(view, "byteStride", 0)
        if stride and not 4 <= stride <= 252:
            raise InputError(f"bufferView {index} has byteStride {stride}; expected 4 to 252")
        return data[start : start + length], stride

    def _table(self, item: Any, dtype: np.dtype, count: int, width: int) -> NDArray[Any]:
        """The (count, width) values where an item's bufferView and byteOffset point."""
        view = integer(item, "bufferView", below=len(self._views))
        offset = integer(item, "byteOffset", 0)
        data, stride = self._view(view)
        size = dtype.itemsize * width
        stride = stride or size
        needed = offset + stride * (count - 1) + size
        if stride < size or needed > len(data):
            raise InputError(
                f"an accessor needs {needed} bytes of bufferView {view}, which has {len(data)}"
            )
        return np.ndarray((count, width), dtype, data, offset, (stride, dtype.itemsize)).copy()

    def _values(self, accessor: dict[str, Any], width: int, types: tuple[int, ...]) -> NDArray[Any]:
        """(count, width) as stored."""
        component, shape = accessor.get("componentType"), accessor.get("type")
        expected = {1: "SCALAR", 3: "VEC3"}[width]
        if component not in types or shape != expected:
            raise InputError(
                f"an accessor has componentType {component!r} and type {shape!r}; expected "
                f"{expected} of {', '.join(map(str, types))}"
            )
        dtype, count = np.dtype(_TYPES[component]), integer(accessor, "count")
        sparse = accessor.get("sparse")
        if count < 1:
            raise InputError("an accessor has no values")
        if "bufferView" in accessor:
            values = self._table(accessor, dtype, count, width)
        elif sparse is None or count > 2**27:
            raise InputError("an accessor has no bufferView, so that a part has no data")
        else:
            values = np.zeros((count, width), dtype)
        if sparse is None:
            return values
        known(sparse, "sparse accessor", ("count", "indices", "values"))
        changed = integer(sparse, "count")
        where, what = sparse.get("indices"), sparse.get("values")
        known(where, "sparse accessor", ("bufferView", "byteOffset", "componentType"))
        known(what, "sparse accessor", ("bufferView", "byteOffset"))
        if where.get("componentType") not in (5121, 5123, 5125) or not 1 <= changed <= count:
            raise InputError("a sparse accessor has wrong indices or a wrong count")
        rows = self._table(where, np.dtype(_TYPES[where["componentType"]]), changed, 1)[:, 0]
        if (np.diff(rows.astype(np.int64)) <= 0).any() or rows[-1] >= count:
            raise InputError("the indices of a sparse accessor do not rise, or pass its count")
        values[rows] = self._table(what, dtype, changed, width)
        return values

    @staticmethod
    def _require_box(accessor: dict[str, Any], stored: NDArray, values: NDArray) -> None:
        """Hold positions against the accessor's min and max, which glTF demands.

        Those of a normalised accessor are as stored; some write the decoded ones.
        """
        if "min" not in accessor and "max" not in accessor:
            return
        stated = np.array([accessor.get("min"), accessor.get("max")], np.float64)
        if stated.shape != (2, 3) or not np.isfinite(stated).all():
            raise InputError("min and max of a POSITION accessor are not three numbers each")
        for found in (stored, values):
            box = np.array([found.min(axis=0), found.max(axis=0)])
            size = max(float(np.ptp(stated, axis=0).max()), float(np.ptp(box, axis=0).max()))
            # Beside it, what float32 does to coordinates far from the origin.
            rounding = 1e-6 * float(np.abs(box).max())
            if np.abs(box - stated).max() <= BOX_TOLERANCE * size + rounding:
                return
        raise InputError(
            f"a POSITION accessor says that its values lie within {stated.tolist()}; they lie "
            f"within {box.tolist()}: the file is damaged, or was written wrongly"
        )
