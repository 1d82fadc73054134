"""One body written in every format and dialect that the mesh readers take, as bytes.

The body is an L-shaped prism whose caps are single concave hexagons: turned, off centre, its six
sides quads. Written from the formats' definitions, without the readers or a mesh library.
"""

from __future__ import annotations

import base64
import json
import struct
from collections.abc import Callable

import numpy as np
import trimesh

OUTLINE = np.array([[0, 1], [0, 0], [3, 0], [3, 3], [2, 3], [2, 1]], float)
TURN = trimesh.transformations.rotation_matrix(0.7, (1, 2, 3))[:3, :3]
CORNERS = np.vstack([np.c_[OUTLINE, np.zeros(6)], np.c_[OUTLINE, np.full(6, 0.6)]])
# Rounded to float32, so that binary formats hold the same numbers as text.
VERTICES = (CORNERS @ TURN.T + (7, -4, 11)).astype(np.float32).astype(float)
POLYGONS = [
    [3, 2, 1, 0, 5, 4], [9, 10, 11, 6, 7, 8], [0, 1, 7, 6], [1, 2, 8, 7], [2, 3, 9, 8],
    [3, 4, 10, 9], [4, 5, 11, 10], [5, 0, 6, 11],
]  # fmt: skip
CAP = [[0, 1, 5], [1, 2, 5], [2, 3, 5], [3, 4, 5]]
"""The concave outline cut into triangles by hand."""
TRIANGLES = (
    [[c, b, a] for a, b, c in CAP]
    + [[a + 6, b + 6, c + 6] for a, b, c in CAP]
    + [[p[0], p[1 + k], p[2 + k]] for p in POLYGONS[2:] for k in range(2)]
)
TRUTH = trimesh.Trimesh(VERTICES, TRIANGLES, process=False, validate=False)


def rows(values: np.ndarray, behind: str = "") -> str:
    return "".join(" ".join(repr(float(x)) for x in row) + behind + "\n" for row in values)


def off(keyword: str = "OFF", behind: str = "", faces: list[list[int]] = POLYGONS) -> str:
    lines = "".join(" ".join(map(str, [len(f), *f])) + "\n" for f in faces)
    return f"{keyword}\n{len(VERTICES)} {len(faces)} 0\n" + rows(VERTICES, behind) + lines


def off_binary() -> bytes:
    data = b"OFF BINARY\n" + struct.pack(">3i", len(VERTICES), len(POLYGONS), 0)
    data += VERTICES.astype(">f4").tobytes()
    return data + b"".join(struct.pack(f">{len(p) + 2}i", len(p), *p, 0) for p in POLYGONS)


def obj(corner: Callable[[int], str] = str, tab: str = " ") -> str:
    faces = "".join("f" + tab + " ".join(corner(k + 1) for k in p) + "\n" for p in POLYGONS)
    vertices = "".join(f"v{tab}{line}\n" for line in rows(VERTICES).splitlines())
    return (
        "# made by hand \\\nmtllib none here.mtl\no ell\n" + vertices + "vt 0 0\nvn 0 0 1\n" + faces
    )


def obj_bodies() -> str:
    """Each face a body of its own, its vertices before it and counted back from it."""
    return "".join(
        "".join(f"v {line}\n" for line in rows(VERTICES[p]).splitlines())
        + "f " + " ".join(str(k - len(p)) for k in range(len(p))) + "\n"
        for p in POLYGONS
    )  # fmt: skip


def ply(encoding: str = "ascii", index: str = "int", name: str = "vertex_indices",
        newline: str = "\n", long: bool = False, extras: bool = False,
        faces: list[list[int]] = POLYGONS) -> bytes:  # fmt: skip
    more = ["property uchar red"] if extras else []
    header = [
        "ply", f"format {encoding} 1.0", *(["comment " + "x" * 60] * (100 if long else 1)),
        f"element vertex {len(VERTICES)}", "property float x", "property float y",
        "property float z", *more,
        *(["element edge 1", "property int vertex1", "property int vertex2"] if extras else []),
        f"element face {len(faces)}", *(["property uchar flags"] if extras else []),
        f"property list uchar {index} {name}",
        *(["property list uchar float texcoord"] if extras else []), "end_header",
    ]  # fmt: skip
    data = (newline.join(header) + newline).encode()
    if encoding == "ascii":
        body = rows(VERTICES, " 9" if extras else "") + ("0 1\n" if extras else "")
        for f in faces:
            body += "1 " * extras + " ".join(map(str, [len(f), *f])) + " 2 0.5 0.5" * extras + "\n"
        return data + body.replace("\n", newline).encode()
    order = ">" if encoding == "binary_big_endian" else "<"
    code = {"int": "i", "uint": "I", "ushort": "H", "uchar": "B"}[index]
    for v in VERTICES:
        data += struct.pack(order + "3f", *v) + b"\x09" * extras
    data += struct.pack(order + "2i", 0, 1) * extras
    for f in faces:
        data += b"\x01" * extras + struct.pack(f"{order}B{len(f)}{code}", len(f), *f)
        data += struct.pack(order + "B2f", 2, 0.5, 0.5) * extras
    return data


def ply_strips() -> bytes:
    strips = [row for a, b, c in TRIANGLES for row in (a, b, c, -1)]
    header = (
        f"ply\nformat ascii 1.0\nelement vertex {len(VERTICES)}\nproperty float x\nproperty float "
        "y\nproperty float z\nelement tristrips 1\nproperty list int int vertex_indices\n"
        "end_header\n"
    )
    return (header + rows(VERTICES) + " ".join(map(str, [len(strips), *strips])) + "\n").encode()


def stl(name: str = "", upper: bool = False, solids: int = 1) -> bytes:
    text = ""
    for part in np.array_split(np.array(TRIANGLES), solids):
        text += f"solid {name}\n"
        for corners in VERTICES[part]:
            text += "facet normal nan nan nan\n outer loop\n"
            text += "".join(f"  vertex {line}\n" for line in rows(corners).splitlines())
            text += " endloop\nendfacet\n"
        text += "endsolid\n"
    return (text.upper() if upper else text).encode()


def stl_binary(header: bytes = b"") -> bytes:
    data = header.ljust(80, b"\0") + struct.pack("<I", len(TRIANGLES))
    for corners in VERTICES[TRIANGLES]:
        data += bytes(12) + corners.astype("<f4").tobytes() + b"\x01\x80"
    return data


def glb(document: dict, binary: bytes) -> bytes:
    text = json.dumps(document).encode()
    text += b" " * (-len(text) % 4)
    binary += b"\0" * (-len(binary) % 4)
    length = 12 + 8 + len(text) + 8 + len(binary)
    return (
        b"glTF" + struct.pack("<II", 2, length) + struct.pack("<I4s", len(text), b"JSON") + text
        + struct.pack("<I4s", len(binary), b"BIN\0") + binary
    )  # fmt: skip


def scene(points: np.ndarray = VERTICES, dtype: str = "<f4", component: int = 5126,
          node: dict | None = None, mode: int = 4, indexed: bool = True,
          faces: list[list[int]] = TRIANGLES, **accessor: object) -> tuple:  # fmt: skip
    """A glTF document of one part and its buffer."""
    triangles = np.array(faces)
    if not indexed:
        points = points[triangles.reshape(-1)]
    data = points.astype(dtype)
    indices = triangles.reshape(-1)
    if mode == 5:  # one strip, its jumps made of triangles without area
        indices = np.concatenate([[a, a, b, c, c, c] for a, b, c in triangles])[1:]
    size = data.dtype.itemsize
    padded = np.zeros((len(data), 12 if size == 4 else 8), np.uint8)
    padded[:, : 3 * size] = data.view(np.uint8).reshape(len(data), -1)
    vertices, index = padded.tobytes(), indices.astype("<u2").tobytes()
    part: dict = {"attributes": {"POSITION": 0}, "mode": mode}
    if indexed:
        part["indices"] = 1
    document = {
        "asset": {"version": "2.0"},
        "buffers": [{"byteLength": len(vertices) + len(index)}],
        "bufferViews": [
            {"buffer": 0, "byteLength": len(vertices), "byteStride": padded.shape[1]},
            {"buffer": 0, "byteOffset": len(vertices), "byteLength": len(index)},
        ],
        "accessors": [
            {"bufferView": 0, "componentType": component, "count": len(data), "type": "VEC3",
             "min": data.min(axis=0).tolist(), "max": data.max(axis=0).tolist(), **accessor},
            {"bufferView": 1, "componentType": 5123, "count": len(indices), "type": "SCALAR"},
        ],
        "meshes": [{"primitives": [part]}],
        "nodes": [{"mesh": 0, **(node or {})}],
        "scenes": [{"nodes": [0]}],
        "scene": 0,
    }  # fmt: skip
    return document, vertices + index


def quantised(normalised: bool) -> bytes:
    centre, half = VERTICES.mean(axis=0), np.abs(VERTICES - VERTICES.mean(axis=0)).max()
    levels = np.round((VERTICES - centre) / half * 32767)
    scale = float(half if normalised else half / 32767)
    document, data = scene(
        levels, "<i2", 5122, {"translation": centre.tolist(), "scale": [scale] * 3},
        normalized=normalised,
    )  # fmt: skip
    document["extensionsRequired"] = document["extensionsUsed"] = ["KHR_mesh_quantization"]
    return glb(document, data)


def sparse() -> bytes:
    document, data = scene()
    accessor = document["accessors"][0]
    start = len(data)
    data += np.arange(len(VERTICES), dtype="<u2").tobytes() + VERTICES.astype("<f4").tobytes()
    document["bufferViews"] += [
        {"buffer": 0, "byteOffset": start, "byteLength": 2 * len(VERTICES)},
        {"buffer": 0, "byteOffset": start + 2 * len(VERTICES), "byteLength": 12 * len(VERTICES)},
    ]
    del accessor["bufferView"]
    accessor["sparse"] = {
        "count": len(VERTICES),
        "indices": {"bufferView": 2, "componentType": 5123},
        "values": {"bufferView": 3},
    }
    document["buffers"][0]["byteLength"] = len(data)
    return glb(document, data)


def draco() -> bytes:
    import DracoPy

    packed = DracoPy.encode(VERTICES, np.array(TRIANGLES), quantization_bits=24)
    decoded = DracoPy.decode(packed)
    document, _ = scene()
    document["buffers"], document["bufferViews"] = (
        [{"byteLength": len(packed)}],
        [{"buffer": 0, "byteLength": len(packed)}],
    )
    for accessor, count in zip(
        document["accessors"], (len(decoded.points), decoded.faces.size), strict=True
    ):
        del accessor["bufferView"]
        accessor["count"] = count
    name = "KHR_draco_mesh_compression"
    document["meshes"][0]["primitives"][0]["extensions"] = {
        name: {"bufferView": 0, "attributes": {"POSITION": 0}}
    }
    document["extensionsRequired"] = document["extensionsUsed"] = [name]
    return glb(document, packed)


def graph() -> bytes:
    """The body mirrored and turned, put right by its nodes; another scene is beside it."""
    quarter = [0.0, 0.0, 2**-0.5, 2**-0.5]  # a quarter turn about z: (x, y) → (−y, x)
    x, y, z = VERTICES.T
    document, data = scene(np.c_[y / 2, x / 2, z / 2], faces=[t[::-1] for t in TRIANGLES])
    document["nodes"] = [
        {"mesh": 0, "scale": [2, -2, 2]},
        {"children": [0], "rotation": quarter},
        {"children": [1], "matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 5, 6, 7, 1]},
        {"mesh": 0, "translation": [100, 0, 0]},
    ]
    document["scenes"], document["scene"] = [{"nodes": [3]}, {"nodes": [2]}], 1
    return glb(document, data)


def gltf() -> bytes:
    document, data = scene()
    uri = "data:application/octet-stream;base64," + base64.b64encode(data).decode()
    document["buffers"][0]["uri"] = uri
    return json.dumps(document).encode()


def dae(
    kind: str = "polylist", node: str = "", points: np.ndarray = VERTICES, step: int = 1
) -> bytes:
    wanted = POLYGONS if kind in ("polylist", "polygons") else TRIANGLES
    wanted = [polygon[::step] for polygon in wanted]
    runs = [" ".join(f"{k} 0" for k in p) for p in wanted]
    if kind in ("polylist", "triangles"):
        lists = f"<p>{' '.join(runs)}</p>"
    else:
        lists = "".join(f"<p>{run}</p>" for run in runs)
    if kind == "polylist":
        lists = f"<vcount>{' '.join(str(len(p)) for p in wanted)}</vcount>" + lists
    numbers = rows(points).replace("\n", " ")
    return f"""<?xml version="1.0"?>
<COLLADA xmlns="http://www.collada.org/2005/11/COLLADASchema" version="1.4.1">
<asset><unit meter="0.0254"/><up_axis>Z_UP</up_axis></asset>
<library_geometries><geometry id="g"><mesh>
<source id="p"><float_array id="a" count="{3 * len(points)}">{numbers}</float_array>
<technique_common><accessor source="#a" count="{len(points)}" stride="3"><param name="X"/>
<param name="Y"/><param name="Z"/></accessor></technique_common></source>
<vertices id="v"><input semantic="POSITION" source="#p"/></vertices>
<{kind} count="{len(wanted)}"><input semantic="VERTEX" source="#v" offset="0"/>
<input semantic="NORMAL" source="#p" offset="1"/>{lists}</{kind}>
</mesh></geometry></library_geometries>
<library_visual_scenes><visual_scene id="s"><node>{node}<instance_geometry url="#g"/></node>
</visual_scene></library_visual_scenes>
<scene><instance_visual_scene url="#s"/></scene></COLLADA>""".encode()


def dae_mirrored() -> bytes:
    x, y, z = VERTICES.T
    node = "<translate>1 2 3</translate><rotate>0 0 1 90</rotate><scale>1 -1 1</scale>"
    # The scale mirrors y, the turn swaps: (a, b) → (a, −b) → (b, a).
    return dae("polylist", node, np.c_[y - 2, x - 1, z - 3], -1)


def packed_words(text: str) -> str:
    """The same words, eleven a line."""
    keyword, *words = text.split()
    return keyword + "\n" + "\n".join(" ".join(words[k : k + 11]) for k in range(0, len(words), 11))


_STEADY = [[*t] for t in TRIANGLES]
DIALECTS: dict[str, bytes] = {
    name: content if isinstance(content, bytes) else content.encode()
    for name, content in {
        "plain.off": off(),
        "triangles.off": off(faces=_STEADY),
        "fused.off": off().replace("OFF\n", "OFF"),
        "lower.off": off("off"),
        "mac.off": off().replace("\n", "\r"),
        "bom.off": "\ufeff" + off(),
        "commented.off": "# one\n" + off().replace("\n", " # more 1 2 3\n"),
        "no_edges.off": off().replace(" 0\n", "\n", 1),
        "colours.off": off("COFF", " 9 9 9 255"),
        "rgb.off": off("COFF", " 0.1 0.2 0.3"),
        "plain_colours.off": off("OFF", " 9 9 9"),
        "normals.off": off("NOFF", " 0 0 1"),
        "both.off": off("CNOFF", " 0 0 1 9 9 9 255"),
        "meshlab.off": off("NCSTOFF", " 9 9 9 255 0 0 1 0.5 0.5"),
        "texture.off": off("STOFF", " 0.5 0.5"),
        "divided.off": off("4OFF", " 1"),
        "dimension.off": off("nOFF\n3"),
        "edges.off": off(faces=[*POLYGONS, [0, 1]]),
        "stream.off": packed_words(off()),
        "one_line.off": " ".join(off().split()),
        "binary.off": off_binary(),
        "plain.obj": obj(),
        "tabs.obj": obj(tab="\t").replace("\n", "\t\r\n"),
        "slashes.obj": obj(lambda k: f"{k}/1/1"),
        "normals.obj": obj(lambda k: f"{k}//1"),
        "relative.obj": obj(lambda k: str(k - 1 - len(VERTICES))),
        "bodies.obj": obj_bodies(),
        "continued.obj": obj().replace(" 5 ", " 5 \\\n"),
        "lines.obj": obj() + "v 90 90 90\nl 1 13\np 13\n",
        "plain.ply": ply(),
        "mac.ply": ply(newline="\r"),
        "windows.ply": ply(newline="\r\n", extras=True),
        "little.ply": ply("binary_little_endian"),
        "big.ply": ply("binary_big_endian", "ushort", "vertex_index"),
        "extras.ply": ply("binary_big_endian", "uchar", extras=True),
        "triangles.ply": ply("binary_little_endian", "uint", faces=_STEADY, long=True),
        "mac_binary.ply": ply("binary_little_endian", newline="\r"),
        "strips.ply": ply_strips(),
        "plain.stl": stl(),
        "upper.stl": stl("Käse", upper=True),
        "solids.stl": stl("one", solids=3),
        "binary.stl": stl_binary(),
        "solid_binary.stl": stl_binary(b"solid ell facet normal"),
        "plain.glb": glb(*scene()),
        "no_indices.glb": glb(*scene(indexed=False)),
        "strip.glb": glb(*scene(mode=5)),
        "normalised.glb": quantised(True),
        "quantised.glb": quantised(False),
        "sparse.glb": sparse(),
        "draco.glb": draco(),
        "graph.glb": graph(),
        "plain.gltf": gltf(),
        "polylist.dae": dae(),
        "triangles.dae": dae("triangles"),
        "polygons.dae": dae("polygons"),
        "tristrips.dae": dae("tristrips"),
        "trifans.dae": dae("trifans"),
        "mirrored.dae": dae_mirrored(),
    }.items()
}
