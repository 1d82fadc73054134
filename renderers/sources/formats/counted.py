"""What a mesh file says of its own size, counted without its reader.

A reader that drops a part in silence gives a sound mesh of another object. So its result is held
against a count that knows nothing of how it reads: keywords found by patterns, the numbers of a
header, the length of the file, the accessors of a scene.
"""

from __future__ import annotations

import json
import re
import struct
from collections import Counter
from collections.abc import Callable
from typing import Any

from lxml import etree

from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons

_LINES_AND_BLANKS = bytes.maketrans(b"\r\t\v\f", b"\n   ")
_OFF = re.compile(rb"[^A-Za-z0-9]*[A-Za-z4]*OFF(\s+BINARY\s*?\n|\s*)", re.IGNORECASE)
_PLY_COUNT = rb"[\r\n]\s*element[ \t]+%s[ \t]+([0-9]+)"


def require_counts(content: bytes, suffix: str, found: Polygons) -> None:
    """Raise ``InputError`` where the reader's polygons are not as many as the file itself says.

    Args:
        content: the file's bytes.
        suffix: its format, as ".obj".
        found: what the reader made of it.
    """
    got = {"vertices": len(found.vertices), "faces": len(found.sizes) + found.edges}
    for what, expected in counted(content, suffix).items():
        if got[what] != expected:
            raise InputError(
                f"{got[what]} {what} were read, but the file has {expected} by its own count: it "
                f"is damaged, or written in a way that is not read rightly"
            )


def counted(content: bytes, suffix: str) -> dict[str, int]:
    """How many "vertices" and "faces" a file has, as far as it lets them be counted so.

    Faces are polygons; in STL, glTF and strips they are triangles.
    """
    return _COUNTERS[suffix](content)


def _obj(content: bytes) -> dict[str, int]:
    # By what a line begins with; none is taken apart.
    text = b"\n" + content.removeprefix(b"\xef\xbb\xbf").translate(_LINES_AND_BLANKS)
    if b"\n " in text:
        text = re.sub(rb"\n +", b"\n", text)
    return {"vertices": text.count(b"\nv "), "faces": text.count(b"\nf ") + text.count(b"\nfo ")}


def _off(content: bytes) -> dict[str, int]:
    head = content[:1000]
    if b"#" in head:
        head = re.sub(rb"#[^\r\n]*", b" ", content)[:1000]
    keyword = _OFF.match(head)
    word = keyword[0] if keyword else b""
    dimension = re.search(rb"n[STCN4]*OFF", word) is not None
    if keyword is None or not keyword[1].strip():
        numbers = re.findall(rb"[0-9]+", head)
        # The keyword's own figure, and the dimension that follows nOFF.
        start = (b"4" in word) + dimension
        return {"vertices": int(numbers[start]), "faces": int(numbers[start + 1])}
    at = content.index(b"\n") + 1 + 4 * dimension
    vertices, faces = struct.unpack_from(">ii", content, at)
    return {"vertices": vertices, "faces": faces}


def _ply(content: bytes) -> dict[str, int]:
    header = content.partition(b"end_header")[0]
    vertices = re.search(_PLY_COUNT % b"vertex", header)
    faces = re.search(_PLY_COUNT % b"face", header)
    counts = {"vertices": int(vertices[1])} if vertices else {}
    if faces and not re.search(_PLY_COUNT % b"tristrips", header):
        counts["faces"] = int(faces[1])
    return counts


def _stl(content: bytes) -> dict[str, int]:
    facets, rest = divmod(len(content) - 84, 50)
    if rest or content[80:84] != struct.pack("<I", max(facets, 0)):
        facets = content.lower().count(b"endfacet")
    return {"vertices": 3 * facets, "faces": facets}


def _gltf(content: bytes) -> dict[str, int]:
    text = content
    if content[:4] == b"glTF":
        text = content[20 : 20 + struct.unpack_from("<I", content, 12)[0]]
    document = json.loads(text.decode("utf-8-sig"))
    nodes, accessors = document["nodes"], document["accessors"]
    below = Counter(child for node in nodes for child in node.get("children", []))
    roots = [k for k in range(len(nodes)) if not below[k]]
    if document.get("scenes"):
        roots = document["scenes"][document.get("scene", 0)].get("nodes", [])
    counts: Counter[str] = Counter(vertices=0, faces=0)
    while roots:
        node = nodes[roots.pop()]
        roots = roots + node.get("children", [])
        mesh = document["meshes"][node["mesh"]] if "mesh" in node else {"primitives": []}
        for part in mesh["primitives"]:
            mode, vertices = part.get("mode", 4), accessors[part["attributes"]["POSITION"]]["count"]
            corners = accessors[part["indices"]]["count"] if "indices" in part else vertices
            if mode >= 4:
                counts["vertices"] += vertices
                counts["faces"] += corners // 3 if mode == 4 else corners - 2
    return dict(counts)


def _dae(content: bytes) -> dict[str, int]:
    root: Any = etree.fromstring(content, etree.XMLParser(resolve_entities=False, huge_tree=True))
    faces = 0
    here = root.xpath("//*[local-name()='instance_visual_scene']/@url")
    while here:
        (element,) = root.xpath("//*[@id=$id]", id=here.pop()[1:])
        for kind in ("triangles", "polylist", "polygons"):
            path = f"./*[local-name()='mesh']/*[local-name()='{kind}']/@count"
            faces += sum(map(int, element.xpath(path)))
        for kind in ("tristrips", "trifans"):
            path = f"./*[local-name()='mesh']/*[local-name()='{kind}']"
            for run in element.xpath(path):
                stride = 1 + max(map(int, run.xpath("./*[local-name()='input']/@offset")))
                rows = run.xpath("./*[local-name()='p']/text()")
                faces += sum(max(0, len(row.split()) // stride - 2) for row in rows)
        here += element.xpath(".//*[local-name()='instance_geometry']/@url")
        here += element.xpath(".//*[local-name()='instance_node']/@url")
    return {"faces": faces}


_COUNTERS: dict[str, Callable[[bytes], dict[str, int]]] = {
    ".obj": _obj, ".off": _off, ".ply": _ply, ".stl": _stl, ".glb": _gltf, ".gltf": _gltf,
    ".dae": _dae,
}  # fmt: skip
