"""Writers of one cloud in every format and dialect that is read, each in a few lines of its own."""

from __future__ import annotations

import io
import struct
from collections.abc import Callable

import h5py
import numpy as np
from numpy.typing import NDArray


def text(points: NDArray, separator: str = " ", end: str = "\n", more: str = "") -> bytes:
    rows = [separator.join(repr(float(v)) for v in row) + more for row in points]
    return (end.join(rows) + end).encode()


def npy(array: NDArray) -> bytes:
    out = io.BytesIO()
    np.save(out, array)
    return out.getvalue()


def npz(**arrays: NDArray) -> bytes:
    out = io.BytesIO()
    np.savez_compressed(out, **arrays)
    return out.getvalue()


def structured(points: NDArray, names: str = "xyz") -> NDArray:
    table = np.zeros(len(points), [("i", "<i4"), *((n, "<f8") for n in names)])
    for name, column in zip(names, points.T, strict=True):
        table[name] = column
    return table


def ply(points: NDArray, encoding: str, more: str = "", end: str = "\n") -> bytes:
    kinds = {"float": "f4", "uchar": "u1", "double": "f8"}
    fields = [("red", "uchar"), ("x", "double"), ("y", "double"), ("z", "double")]
    header = [
        "ply",
        f"format {encoding} 1.0",
        "comment element face 12",
        f"element vertex {len(points)}",
    ]
    header += [f"property {kind} {name}" for name, kind in fields]
    header += [*filter(None, [more]), "end_header"]
    head = (end.join(header) + end).encode()
    if encoding == "ascii":
        return head + text(np.hstack([np.full((len(points), 1), 7), points]), end=end).replace(
            b"7.0 ", b"7 "
        )
    order = "<" if "little" in encoding else ">"
    table = np.zeros(len(points), [(name, order + kinds[kind]) for name, kind in fields])
    table["x"], table["y"], table["z"] = points.T
    return head + table.tobytes()


def pcd(points: NDArray, encoding: str, kind: str = "f8") -> bytes:
    size = int(kind[1])
    header = (
        f"# .PCD v0.7\nVERSION 0.7\nFIELDS rgb x _ y z\nSIZE 4 {size} 1 {size} {size}\n"
        f"TYPE U F U F F\nCOUNT 1 1 4 1 1\nWIDTH {len(points)}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {len(points)}\nDATA {encoding}\n"
    ).encode()
    table = np.zeros(
        len(points),
        [("rgb", "<u4"), ("x", f"<{kind}"), ("_", "u1", 4), ("y", f"<{kind}"), ("z", f"<{kind}")],
    )
    table["x"], table["y"], table["z"] = points.T
    if encoding == "binary":
        return header + table.tobytes()
    if encoding == "ascii":
        rows = [f"0 {x!r} 0 0 0 0 {y!r} {z!r}" for x, y, z in points.tolist()]
        return header + ("\n".join(rows) + "\n").encode()
    columns = b"".join(table[name].tobytes() for name in table.dtype.names or ())
    packed = lzf(columns)
    return header + struct.pack("<II", len(packed), len(columns)) + packed


def lzf(data: bytes) -> bytes:
    """Packed by LibLZF itself, as h5py has it; or as literals where it would not get smaller."""
    with h5py.File("x", "w", driver="core", backing_store=False) as file:
        stored = file.create_dataset(
            "d", data=np.frombuffer(data, np.uint8), chunks=(len(data),), compression="lzf"
        )
        mask, packed = stored.id.read_direct_chunk((0,))
    if mask == 0:
        return packed
    parts = [data[i : i + 32] for i in range(0, len(data), 32)]
    return b"".join(bytes([len(part) - 1]) + part for part in parts)


Writer = Callable[[NDArray], bytes]

TEXTS: dict[str, Writer] = {
    "a.xyz": text,
    "tab.txt": lambda p: text(p, "\t"),
    "comma.csv": lambda p: text(p, ", "),
    "semicolon.txt": lambda p: text(p, ";"),
    "closed.csv": lambda p: text(p, ",", more=","),
    "colours.xyz": lambda p: text(p, more=" 200 100 0"),
    "crlf.xyz": lambda p: text(p, end="\r\n"),
    "cr.xyz": lambda p: text(p, end="\r"),
    "bom.txt": lambda p: b"\xef\xbb\xbf" + text(p),
    "utf16.txt": lambda p: text(p).decode().encode("utf-16"),
    "utf16be.txt": lambda p: text(p).decode().encode("utf-16-be"),
    "header.csv": lambda p: b"x,y,z\n" + text(p, ","),
    "order.csv": lambda p: b'"id","Z [m]","Y [m]","X [m]"\n' + text(
        np.column_stack([np.arange(len(p)), p[:, ::-1]]), ","
    ),
    "cloudcompare.txt": lambda p: b"//X Y Z R G B\n" + text(p, more=" 1 2 3"),
    "comment.xyz": lambda p: b"# Ger\xe4t, 3 points\n% more\n" + text(p),
    "count.pts": lambda p: f"{len(p)}\n".encode() + text(p, more=" 17 1 2 3"),
    "count.xyz": lambda p: f"{len(p)}\nmade by hand in 2020\n".encode() + text(p),
    "count_blank.xyz": lambda p: f"{len(p)}\n\n".encode() + text(p),
    "prose.txt": lambda p: b"A scan of something\nx y z\n" + text(p),
}  # fmt: skip
COUNTED: dict[str, Writer] = {
    "rows.npy": npy,
    "columns.npy": lambda p: npy(p.T),
    "six.npy": lambda p: npy(np.hstack([p, p]).T),
    "fortran.npy": lambda p: npy(np.asfortranarray(p)),
    "big_endian.npy": lambda p: npy(p.astype(">f8")),
    "batch.npy": lambda p: npy(p[None]),
    "fields.npy": lambda p: npy(structured(p)),
    "order.npy": lambda p: npy(structured(p[:, ::-1], "zyx")),
    "one.npz": lambda p: npz(anything=p),
    "known.npz": lambda p: npz(points=p, labels=np.arange(len(p))),
    "ascii.ply": lambda p: ply(p, "ascii"),
    "mac.ply": lambda p: ply(p, "ascii", end="\r"),
    "little.ply": lambda p: ply(p, "binary_little_endian"),
    "big.ply": lambda p: ply(p, "binary_big_endian"),
    "meshlab.ply": lambda p: ply(
        p, "binary_little_endian", "element face 0\nproperty list uchar int vertex_indices"
    ),
    "ascii.pcd": lambda p: pcd(p, "ascii"),
    "binary.pcd": lambda p: pcd(p, "binary"),
    "packed.pcd": lambda p: pcd(p, "binary_compressed"),
}
"""Formats that say how many points there are: a part of the file is never a cloud."""
