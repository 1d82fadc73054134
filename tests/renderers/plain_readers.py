"""A second reader of each mesh format, for tests: as short and literal as the definitions allow.

They share no code with the project's readers and make no attempt at speed: pure Python, one value
at a time. Each gives the polygons of the surface, a list of corner coordinates per polygon, and
raises any exception for what it cannot read. What they take a damaged file for is what the file
says; where the project's reader gives another surface, one of the two is wrong.
"""

from __future__ import annotations

import base64
import json
import math
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable, Iterator

Point = tuple[float, float, float]
Polygon = list[Point]
NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?|[+-]?(nan|inf|infinity)", re.IGNORECASE)
PLY_CODES = {"char": "b", "uchar": "B", "uint8": "B", "short": "h", "ushort": "H", "int": "i",
             "uint": "I", "uint32": "I", "float": "f", "double": "d"}  # fmt: skip


def number(word: str) -> float:
    if not NUMBER.fullmatch(word):
        raise ValueError(f"{word!r} is no number")
    return float(word)


def index(word: str, count: int) -> int:
    if not re.fullmatch(r"[+-]?\d+", word) or not 0 <= int(word) < count:
        raise ValueError(f"{word!r} is no index below {count}")
    return int(word)


def lines_of(content: bytes) -> list[str]:
    text = content.removeprefix(b"\xef\xbb\xbf").decode("latin-1")
    return re.split(r"\r\n|\r|\n", text)


def words_of(line: str) -> list[str]:
    return [word for word in re.split(r"[ \t\n\r\v\f]+", line) if word]


def read_obj(content: bytes) -> list[Polygon]:
    lines = [line.split("#")[0] for line in lines_of(content)]
    joined: list[str] = []
    for line in lines:
        if joined and joined[-1].endswith("\\") and words_of(joined[-1])[0] in ("v", "f", "vt"):
            joined[-1] = joined[-1][:-1] + " " + line
        else:
            joined.append(line)
    points: list[Point] = []
    named: list[list[int]] = []
    for line in joined:
        match words_of(line):
            case ["v", x, y, z, *_]:
                points.append((number(x), number(y), number(z)))
            case ["f", *corners] if len(corners) >= 3:
                first = [int(corner.split("/")[0]) for corner in corners]
                if 0 in first:
                    raise ValueError("index 0")
                named.append([k - 1 if k > 0 else len(points) + k for k in first])
                if min(named[-1]) < 0:
                    raise ValueError("before the first vertex")
            case ["v" | "f", *_]:
                raise ValueError(line)
    return [[points[k] for k in polygon] for polygon in named]


def read_off(content: bytes) -> list[Polygon]:
    binary = re.match(rb"\s*OFF[ \t]*BINARY[ \t]*(\r\n|\r|\n)", content)
    if binary:
        return _off_binary(content[binary.end() :])
    lines = [words_of(line.split("#")[0]) for line in lines_of(content)]
    lines = [line for line in lines if line]
    keyword = re.match(r"((?:ST|[CN4n])*)(OFF|off)", lines[0][0])
    assert keyword is not None
    texture, colour, normal, divided, dimension = (
        keyword[1].count(each) for each in ("ST", "C", "N", "4", "n")
    )
    assert max(texture, colour, normal, divided, dimension) < 2
    rest = lines[0][0][keyword.end() :]
    lines[0] = [rest, *lines[0][1:]] if rest else lines[0][1:]
    lines = [line for line in lines if line]
    if dimension:
        assert lines.pop(0) == ["3"]
    counts = lines[0][:3]
    while len(counts) < 2:
        del lines[0]
        counts += lines[0][: 2 - len(counts)]
    lines[0] = lines[0][len(counts) :]
    lines = [line for line in lines if line]
    vertex_count, face_count = index(counts[0], 10**9), index(counts[1], 10**9)
    least = 3 + bool(divided) + 3 * bool(normal) + 2 * bool(texture) + 3 * bool(colour)
    if len(lines) == vertex_count + face_count + 1 and len(lines[0]) == 1:
        del lines[0]
    vertices, faces = lines[:vertex_count], lines[vertex_count:]
    widths = {len(v) for v in vertices}
    if len(faces) != face_count or len(widths) > 1 or min(widths) < least:
        words = [word for line in lines for word in line]
        vertices = [words[3 * k : 3 * k + 3] for k in range(vertex_count)]
        del words[: 3 * vertex_count]
        faces = []
        while words:
            size = 1 + index(words[0], 10**6)
            assert size > 3
            assert len(words) >= size
            faces.append(words[:size])
            del words[:size]
        assert len(faces) == face_count
    points = [tuple(number(word) / (number(v[3]) if divided else 1) for word in v[:3])
              for v in vertices]  # fmt: skip
    found = []
    for face in faces:
        size = index(face[0], len(face))
        found.append([points[index(word, vertex_count)] for word in face[1 : 1 + size]])
    return [polygon for polygon in found if len(polygon) >= 3]


def _off_binary(data: bytes) -> list[Polygon]:
    vertex_count, face_count = struct.unpack_from(">2i", data)
    points = [struct.unpack_from(">3f", data, 12 + 12 * k) for k in range(vertex_count)]
    at = 12 + 12 * vertex_count
    found = []
    for _ in range(face_count):
        (size,) = struct.unpack_from(">i", data, at)
        corners = struct.unpack_from(f">{size}i", data, at + 4)
        (colours,) = struct.unpack_from(">i", data, at + 4 + 4 * size)
        at += 8 + 4 * size + 4 * colours
        found.append([points[index(str(k), vertex_count)] for k in corners])
    assert at == len(data)
    return [polygon for polygon in found if len(polygon) >= 3]


def read_ply(content: bytes) -> list[Polygon]:
    newline = {b"\r\n": b"\r\n"}.get(content[3:5], content[3:4])
    end = re.search(rb"[\r\n][ \t]*end_header[ \t]*", content)
    assert end is not None
    head, body = content[: end.start()], content[end.end() :]
    body = body.removeprefix(newline) if body.startswith(newline) else body[1:]
    elements: list[tuple[str, int, list[list[str]]]] = []
    encoding = ""
    for line in lines_of(head)[1:]:
        match words_of(line):
            case ["format", name, "1.0"]:
                encoding = name
            case ["element", name, count]:
                elements.append((name, index(count, 10**9), []))
            case ["property", *rest]:
                elements[-1][2].append(rest)
    values = _ply_words(body) if encoding == "ascii" else _ply_bytes(body, encoding)
    next(values)
    tables = {}
    for name, count, properties in elements:
        rows = []
        for _ in range(count):
            row: dict[str, list[float]] = {}
            for kind, *rest in properties:
                codes = (rest[1], int(values.send(rest[0]))) if kind == "list" else (kind, 1)
                if codes[1] < 0:
                    raise ValueError("a list of negative length")
                row[rest[-1]] = [values.send(codes[0]) for _ in range(codes[1])]
            values.send("end of row")
            rows.append(row)
        tables[name] = rows
    values.send("end of file")
    points = [tuple(row[axis][0] for axis in "xyz") for row in tables["vertex"]]
    found = []
    for row in tables.get("face", []):
        corners = row.get("vertex_indices", row.get("vertex_index"))
        assert corners is not None
        found.append([points[index(str(int(k)), len(points))] for k in corners])
    for row in tables.get("tristrips", []):
        strip: list[Point] = []
        for k in row["vertex_indices"]:
            strip = [] if k == -1 else [*strip, points[index(str(int(k)), len(points))]]
            if len(strip) >= 3:
                found.append(strip[-3:] if len(strip) % 2 else strip[-3:][::-1])
    return [polygon for polygon in found if len(polygon) >= 3]


def _ply_words(body: bytes) -> Iterator[float]:
    lines = [words for line in lines_of(body) if (words := words_of(line))]
    value = 0.0
    while True:
        wanted = yield value
        if wanted == "end of row":
            assert not lines.pop(0)
        elif wanted == "end of file":
            assert not lines
        else:
            value = number(lines[0].pop(0))


def _ply_bytes(body: bytes, encoding: str) -> Iterator[float]:
    order = {"binary_little_endian": "<", "binary_big_endian": ">"}[encoding]
    at, value = 0, 0.0
    while True:
        wanted = yield value
        if wanted == "end of file":
            assert not body[at:].strip(b"\r\n")
        elif wanted != "end of row":
            code = order + PLY_CODES[wanted]
            (value,) = struct.unpack_from(code, body, at)
            at += struct.calcsize(code)


def read_stl(content: bytes) -> list[Polygon]:
    if len(content) >= 84 and len(content) == 84 + 50 * struct.unpack_from("<I", content, 80)[0]:
        numbers = [
            struct.unpack_from("<9f", content, at + 12) for at in range(84, len(content), 50)
        ]
        return [[n[0:3], n[3:6], n[6:9]] for n in numbers]
    words = []
    open_solid = False
    for line in lines_of(content):
        match words_of(line.lower()):
            case [word, *_] if word == "solid":
                assert not open_solid
                open_solid = True
            case [word, *_] if word in ("endsolid", "end"):
                assert open_solid
                open_solid = False
            case [word, *_] if word[0] in ";#":
                pass
            case found:
                words += found
    assert not open_solid
    facets = []
    for at in range(0, len(words), 21):
        match words[at : at + 21]:
            case ["facet", "normal", _, _, _, "outer", "loop", *vertices, "endloop", "endfacet"]:
                assert vertices[0::4] == ["vertex"] * 3
                facets.append([tuple(map(number, vertices[k : k + 3])) for k in (1, 5, 9)])
            case _:
                raise ValueError("no facet")
    return facets


def read_gltf(content: bytes) -> list[Polygon]:
    binary, text = b"", content
    if content[:4] == b"glTF":
        assert struct.unpack_from("<II", content, 4) == (2, len(content))
        (size,) = struct.unpack_from("<I", content, 12)
        text, binary = content[20 : 20 + size], content[28 + size :]
    document = json.loads(text.decode("utf-8-sig"))
    if (uri := document["buffers"][0].get("uri")) is not None:
        binary = base64.b64decode(uri.split(",")[1])

    def values(item: dict, code: str, count: int, width: int) -> list[tuple]:
        view = document["bufferViews"][item["bufferView"]]
        stride = view.get("byteStride") or width * struct.calcsize(code)
        start = view.get("byteOffset", 0) + item.get("byteOffset", 0)
        return [struct.unpack_from(f"<{width}{code}", binary, start + k * stride)
                for k in range(count)]  # fmt: skip

    def accessor(k: int, width: int) -> list[tuple]:
        item = document["accessors"][k]
        code = {5120: "b", 5121: "B", 5122: "h", 5123: "H", 5125: "I", 5126: "f"}[
            item["componentType"]
        ]
        count = item["count"]
        found = [(0.0,) * width] * count
        if "bufferView" in item:
            found = values(item, code, count, width)
        if "sparse" in item:
            sparse = item["sparse"]
            kind = {5121: "B", 5123: "H", 5125: "I"}[sparse["indices"]["componentType"]]
            where = values(sparse["indices"], kind, sparse["count"], 1)
            what = values(sparse["values"], code, sparse["count"], width)
            for (k,), value in zip(where, what, strict=True):
                found[k] = value
        if item.get("normalized"):
            top = {"b": 127, "B": 255, "h": 32767, "H": 65535}[code]
            found = [tuple(max(x / top, -1) for x in value) for value in found]
        return found

    def node(k: int, place: Callable[[Point], Point], mirrored: bool) -> Iterator[Polygon]:
        item = document["nodes"][k]
        m = item.get("matrix")
        x, y, z, w = item.get("rotation", (0, 0, 0, 1))
        n = x * x + y * y + z * z + w * w
        s, t = item.get("scale", (1, 1, 1)), item.get("translation", (0, 0, 0))

        def placed(p: Point) -> Point:
            if m:
                return place(
                    tuple(sum(m[4 * c + r] * (*p, 1)[c] for c in range(4)) for r in range(3))
                )
            a, b, c = (p[0] * s[0], p[1] * s[1], p[2] * s[2])
            # v + 2 q × (q × v + w v) over q's square, q the vector part.
            u = (y * c - z * b + w * a, z * a - x * c + w * b, x * b - y * a + w * c)
            return place(
                (
                    a + 2 * (y * u[2] - z * u[1]) / n + t[0],
                    b + 2 * (z * u[0] - x * u[2]) / n + t[1],
                    c + 2 * (x * u[1] - y * u[0]) / n + t[2],
                )
            )

        if m:
            d = (m[0] * (m[5] * m[10] - m[6] * m[9]) - m[4] * (m[1] * m[10] - m[2] * m[9])
                 + m[8] * (m[1] * m[6] - m[2] * m[5]))  # fmt: skip
        else:
            d = s[0] * s[1] * s[2]
        mirrored ^= d < 0
        for part in document["meshes"][item["mesh"]]["primitives"] if "mesh" in item else []:
            mode = part.get("mode", 4)
            if "extensions" in part:
                import DracoPy

                view = document["bufferViews"][
                    next(iter(part["extensions"].values()))["bufferView"]
                ]
                start = view.get("byteOffset", 0)
                mesh = DracoPy.decode(binary[start : start + view["byteLength"]])
                points, order = mesh.points.tolist(), mesh.faces.reshape(-1).tolist()
            else:
                points = accessor(part["attributes"]["POSITION"], 3)
                order = list(range(len(points)))
                if "indices" in part:
                    order = [k for (k,) in accessor(part["indices"], 1)]
            step = {4: 3, 5: 1, 6: 1}.get(mode, len(order) + 1)
            for at in range(0, len(order) - 2, step):
                chosen = order[at : at + 3]
                if mode == 5 and at % 2:
                    chosen.reverse()
                if mode == 6:
                    chosen = [order[0], *order[at + 1 : at + 3]]
                polygon = [placed(points[k]) for k in chosen]
                yield polygon[::-1] if mirrored else polygon
        for child in item.get("children", []):
            yield from node(child, placed, mirrored)

    children = [c for item in document["nodes"] for c in item.get("children", [])]
    roots = [k for k in range(len(document["nodes"])) if k not in children]
    if "scenes" in document:
        roots = document["scenes"][document.get("scene", 0)]["nodes"]
    return [polygon for k in roots for polygon in node(k, lambda p: p, False)]


def read_dae(content: bytes) -> list[Polygon]:
    root = ElementTree.fromstring(content)
    for element in root.iter():
        element.tag = element.tag.split("}")[-1]
    ids = {element.get("id"): element for element in root.iter() if element.get("id")}

    def geometry(item: ElementTree.Element) -> Iterator[Polygon]:
        for kind in ("triangles", "polylist", "polygons", "tristrips", "trifans"):
            for group in item.findall(f"mesh/{kind}"):
                inputs = group.findall("input")
                stride = 1 + max(int(i.get("offset", "")) for i in inputs)
                (vertex,) = (i for i in inputs if i.get("semantic") == "VERTEX")
                vertices = ids[vertex.get("source", "")[1:]]
                source = ids[vertices.findall("input")[0].get("source", "")[1:]]
                numbers = [number(w) for w in words_of(source.findall("float_array")[0].text or "")]
                points = [tuple(numbers[k : k + 3]) for k in range(0, len(numbers), 3)]
                runs = []
                for p in group.findall("p"):
                    words = words_of(p.text or "")[int(vertex.get("offset", "")) :: stride]
                    runs.append([points[index(word, len(points))] for word in words])
                if kind in ("triangles", "polylist"):
                    sizes = [3] * (len(runs[0]) // 3)
                    if kind == "polylist":
                        sizes = [int(w) for w in words_of(group.findall("vcount")[0].text or "")]
                    (run,), runs = runs, []
                    for size in sizes:
                        runs.append(run[:size])
                        del run[:size]
                for run in runs:
                    if kind == "tristrips":
                        for k in range(len(run) - 2):
                            yield run[k : k + 3][:: -1 if k % 2 else 1]
                    elif kind == "trifans":
                        for k in range(1, len(run) - 1):
                            yield [run[0], *run[k : k + 2]]
                    else:
                        yield run

    def node(item: ElementTree.Element) -> Iterator[Polygon]:
        steps = [(e.tag, [number(w) for w in words_of(e.text or "")]) for e in item
                 if e.tag in ("translate", "rotate", "scale")]  # fmt: skip

        def placed(p: Point) -> Point:
            for kind, v in reversed(steps):
                if kind == "translate":
                    p = (p[0] + v[0], p[1] + v[1], p[2] + v[2])
                elif kind == "scale":
                    p = (p[0] * v[0], p[1] * v[1], p[2] * v[2])
                else:
                    # p turned about the axis u: u (u·p) + c (p − u (u·p)) + s u × p.
                    length = math.hypot(*v[:3])
                    u = (v[0] / length, v[1] / length, v[2] / length)
                    c, s = math.cos(math.radians(v[3])), math.sin(math.radians(v[3]))
                    along = sum(a * b for a, b in zip(u, p, strict=True))
                    cross = (u[1] * p[2] - u[2] * p[1], u[2] * p[0] - u[0] * p[2],
                             u[0] * p[1] - u[1] * p[0])  # fmt: skip
                    p = tuple(a * along + c * (b - a * along) + s * d
                              for a, b, d in zip(u, p, cross, strict=True))  # fmt: skip
            return p

        mirrored = math.prod(math.prod(v) for kind, v in steps if kind == "scale") < 0
        for instance in item.findall("instance_geometry"):
            for polygon in geometry(ids[instance.get("url", "")[1:]]):
                moved = [placed(p) for p in polygon]
                yield moved[::-1] if mirrored else moved

    (instance,) = root.findall("scene/instance_visual_scene")
    scene = ids[instance.get("url", "")[1:]]
    found = [polygon for item in scene.findall("node") for polygon in node(item)]
    return [polygon for polygon in found if len(polygon) >= 3]


PLAIN: dict[str, Callable[[bytes], list[Polygon]]] = {
    ".obj": read_obj, ".off": read_off, ".ply": read_ply, ".stl": read_stl, ".glb": read_gltf,
    ".gltf": read_gltf, ".dae": read_dae,
}  # fmt: skip
