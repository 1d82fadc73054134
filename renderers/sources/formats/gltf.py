"""glTF 2.0, packed (.glb) or as text with its buffers inside (.gltf): its scene's triangles.

Source: the Khronos glTF 2.0 specification, KHR_mesh_quantization, KHR_draco_mesh_compression. What
places and shapes a surface is read or refused by name, so that no part of an object is missing.
Own, because no library that was tried does so: trimesh takes normalised integers for coordinates
and passes over sparse accessors, Draco, meshopt and skins in silence; pygltflib decodes no
accessor. Draco is DracoPy's.
"""

from __future__ import annotations

import base64
import binascii
import json
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from partialbench.errors import InputError
from renderers.sources.formats.gltf_accessors import Accessors, integer, known, sequence
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.strips import of_fan, of_strip

_JSON, _BIN = 0x4E4F534A, 0x004E4942
_MODES = ("points", "lines", "line loops", "line strips", "triangles", "strips", "fans")
_HARMLESS = ("KHR_materials_", "KHR_texture_", "EXT_texture_", "KHR_lights_", "EXT_lights_")
"""Extensions that bear on no position."""
_UNDERSTOOD = ("KHR_mesh_quantization", "KHR_draco_mesh_compression", "KHR_xmp_json_ld")
_DOCUMENT = (
    "accessors", "animations", "asset", "buffers", "bufferViews", "cameras", "extensionsUsed",
    "extensionsRequired", "images", "materials", "meshes", "nodes", "samplers", "scene", "scenes",
    "skins", "textures",
)  # fmt: skip
_PLACING = ("EXT_mesh_gpu_instancing", "KHR_node_visibility", "MSFT_lod")
"""Extensions of a node that change what of it is there."""


@dataclass
class _Found:
    """What the walk through the scene gathers."""

    vertices: list[NDArray]
    triangles: list[NDArray]
    left_out: dict[str, int]
    count: int = 0


def read_gltf(content: bytes) -> Polygons:
    """The triangles of the default scene, every instance of a mesh placed by its nodes.

    Lists, strips and fans; positions of any type, normalised, strided, sparse or Draco compressed.
    Where no scene is the default it is the first, where there is none all nodes are taken. Points
    and lines are left out; these and meshes outside the scene are told in the notices.

    Raises:
        InputError: the file is broken or cut short, is glTF 1, has no triangles, or needs what is
            not read: skins, morph targets, meshopt, instancing, buffers in other files, any
            required extension that is not known.
    """
    document, binary = _unpack(content)
    known(document, "file", _DOCUMENT)
    version = str(document.get("asset", {}).get("version", ""))
    if version.split(".")[0] != "2":
        raise InputError(f"is glTF version {version or 'unknown'}; expected 2.0")
    for name in sequence(document, "extensionsRequired"):
        if name not in _UNDERSTOOD and not str(name).startswith(_HARMLESS):
            raise _refuse(f"the extension {name}")
    accessors = Accessors(document, _buffers(document, binary))
    roots, notices = _roots(document)
    found = _Found([], [], {})
    seen: set[int] = set()
    for node in roots:
        _walk(document, accessors, node, np.eye(4), seen, found)
    outside = [
        k for k, node in enumerate(sequence(document, "nodes")) if "mesh" in node and k not in seen
    ]
    if outside:
        notices.append(f"{len(outside)} meshes stand outside the scene and were left out")
    notices += [
        f"{n} {kind} are no surface and were left out" for kind, n in found.left_out.items()
    ]
    if not found.triangles:
        raise InputError("has no faces; expected a mesh, not points or lines")
    mesh = Polygons.of_triangles(
        np.concatenate(found.vertices), np.concatenate(found.triangles), tuple(notices)
    )
    return replace(mesh, up="y")  # section 3.4 of the specification


def _refuse(feature: str) -> InputError:
    return InputError(
        f"uses {feature}, which is not read; without it a part of the object would be missing or "
        f"in the wrong place. Export it as plain triangles"
    )


def _unpack(content: bytes) -> tuple[dict[str, Any], bytes | None]:
    """The JSON document and the binary chunk."""
    binary = None
    text = content
    if content[:4] == b"glTF":
        if len(content) < 20:
            raise InputError(f"the GLB was cut short: it has {len(content)} bytes")
        version, length = (int(n) for n in np.frombuffer(content, "<u4", 2, 4))
        if version != 2:
            raise InputError(f"is GLB version {version}; expected 2: convert it to glTF 2.0")
        if length != len(content):
            raise InputError(
                f"the GLB says that it has {length} bytes, but has {len(content)}: it was cut "
                f"short or something was added"
            )
        chunks = []
        at = 12
        while at < length:
            size, kind = (int(n) for n in np.frombuffer(content[at : at + 8].ljust(8), "<u4", 2))
            if at + 8 + size > length:
                raise InputError(f"a chunk of the GLB says {size} bytes, more than there are")
            chunks.append((kind, content[at + 8 : at + 8 + size]))
            at += 8 + size
        if chunks[0][0] != _JSON or sum(kind == _BIN for kind, _ in chunks) > 1:
            raise InputError("the GLB does not begin with its JSON, or has more than one buffer")
        text = chunks[0][1]
        binary = next((data for kind, data in chunks if kind == _BIN), None)
    elif not content.lstrip(b"\xef\xbb\xbf \t\r\n").startswith(b"{"):
        raise InputError("is no glTF: it begins neither as GLB nor as JSON does")

    def no_duplicates(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        if len({key for key, _ in pairs}) < len(pairs):
            raise InputError("an object of its JSON has a key twice")
        return dict(pairs)

    def no_constant(name: str) -> float:
        raise InputError(f"its JSON has the number {name}")

    try:
        document = json.loads(
            text.decode("utf-8-sig"), object_pairs_hook=no_duplicates, parse_constant=no_constant
        )
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"its JSON is broken ({error})") from error
    if not isinstance(document, dict):
        raise InputError("its JSON is no object")
    return document, binary


def _buffers(document: dict[str, Any], binary: bytes | None) -> list[bytes | InputError]:
    """Each buffer's bytes, or why it has none: only what is needed must be there."""
    buffers: list[bytes | InputError] = []
    for k, buffer in enumerate(sequence(document, "buffers")):
        length, uri = integer(buffer, "byteLength"), buffer.get("uri")
        data = binary if uri is None and k == 0 else None
        if isinstance(uri, str) and uri.startswith("data:") and ";base64," in uri[:200]:
            try:
                data = base64.b64decode(uri.partition(";base64,")[2], validate=True)
            except binascii.Error as error:
                raise InputError(f"buffer {k} is no base64 ({error})") from error
        if data is None:
            where = f"in another file ({str(uri)[:80]})" if uri else "nowhere"
            buffers.append(InputError(f"buffer {k} lies {where}; pack the object into one .glb"))
        elif len(data) < length:
            buffers.append(
                InputError(f"buffer {k} says {length} bytes, {len(data)} are there: cut short")
            )
        else:
            buffers.append(data[:length])
    return buffers


def _roots(document: dict[str, Any]) -> tuple[list[int], list[str]]:
    """The nodes that the scene begins with."""
    scenes, nodes = sequence(document, "scenes"), sequence(document, "nodes")
    if scenes:
        k = integer(document, "scene", 0, below=len(scenes))
        known(scenes[k], "scene", ("nodes",))
        unsaid = len(scenes) > 1 and "scene" not in document
        notices = [f"none of its {len(scenes)} scenes is the default; the first was taken"]
        return sequence(scenes[k], "nodes"), notices if unsaid else []
    children = {child for node in nodes for child in sequence(node, "children")}
    roots = [k for k in range(len(nodes)) if k not in children]
    return roots, ["it has no scene; all its nodes were taken"]


def _walk(
    document: dict[str, Any], accessors: Accessors, index: Any, above: NDArray, seen: set[int],
    found: _Found,
) -> None:  # fmt: skip
    """Gather a node and what is below it; ``above`` (4,4) places its parent in the scene."""
    waiting = [(index, above)]
    nodes = sequence(document, "nodes")
    while waiting:
        index, above = waiting.pop()
        k = integer({"node": index}, "node", below=len(nodes))
        if k in seen:
            raise InputError(f"node {k} has two parents, or is below itself")
        seen.add(k)
        node = nodes[k]
        known(node, "node", ("children", "matrix", "translation", "rotation", "scale", "mesh",
                             "skin", "weights", "camera"))  # fmt: skip
        for name in _PLACING:
            if name in node.get("extensions", {}):
                raise _refuse(f"the extension {name}")
        placed = above @ _matrix(node, k)
        if "mesh" in node:
            if "skin" in node:
                raise _refuse(f"a skin (node {k})")
            meshes = sequence(document, "meshes")
            mesh = meshes[integer(node, "mesh", below=len(meshes))]
            known(mesh, "mesh", ("primitives", "weights"))
            primitives = sequence(mesh, "primitives")
            if "weights" in node or "weights" in mesh or any("targets" in p for p in primitives):
                raise _refuse(f"morph targets (node {k})")
            for primitive in primitives:
                _add(accessors, primitive, placed, found)
        waiting += [(child, placed) for child in reversed(sequence(node, "children"))]


def _matrix(node: dict[str, Any], k: int) -> NDArray[np.float64]:
    def numbers(key: str, default: list[float]) -> NDArray[np.float64]:
        value = np.array(node.get(key, default), np.float64)
        if value.shape != (len(default),) or not np.isfinite(value).all():
            raise InputError(
                f"the {key} of node {k} is {node[key]!r}; expected {len(default)} numbers"
            )
        return value

    if "matrix" in node:
        if any(key in node for key in ("translation", "rotation", "scale")):
            raise InputError(f"node {k} has a matrix and other transforms; only one may be")
        matrix = numbers("matrix", [0.0] * 16).reshape(4, 4).T
        if not np.allclose(matrix[3], (0, 0, 0, 1)):
            raise InputError(f"the matrix of node {k} is no affine transform")
        return matrix
    x, y, z, w = numbers("rotation", [0, 0, 0, 1])
    square = x * x + y * y + z * z + w * w
    if abs(square - 1) > 0.01:
        raise InputError(f"the rotation of node {k} is no unit quaternion: {node['rotation']}")
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turned = np.eye(3) + 2 / square * (w * cross + cross @ cross)
    matrix = np.eye(4)
    matrix[:3, :3] = turned * numbers("scale", [1, 1, 1])
    matrix[:3, 3] = numbers("translation", [0, 0, 0])
    return matrix


def _add(accessors: Accessors, primitive: dict[str, Any], placed: NDArray, found: _Found) -> None:
    known(primitive, "primitive", ("attributes", "indices", "material", "mode", "targets"))
    mode = integer(primitive, "mode", 4, below=len(_MODES))
    if mode < 4:
        found.left_out[_MODES[mode]] = found.left_out.get(_MODES[mode], 0) + 1
        return
    draco = primitive.get("extensions", {}).get("KHR_draco_mesh_compression")
    if draco is not None:
        if mode != 4:
            raise _refuse(f"Draco with {_MODES[mode]}")
        points, indices = accessors.draco(primitive, draco)
    else:
        points = accessors.positions(primitive)
        indices = accessors.indices(primitive, len(points))
    if len(indices) and (indices.min() < 0 or indices.max() >= len(points)):
        raise InputError(
            f"a face names vertex {indices.max()} of a part with {len(points)} vertices"
        )
    if len(indices) < 3 or (mode == 4 and len(indices) % 3):
        raise InputError(f"a part has {len(indices)} indices, which make no {_MODES[mode]}")
    triangles = indices.reshape(-1, 3) if mode == 4 else (of_strip, of_fan)[mode - 5](indices)
    if np.linalg.det(placed[:3, :3]) < 0:
        triangles = triangles[:, ::-1]
    found.vertices.append(points @ placed[:3, :3].T + placed[:3, 3])
    found.triangles.append(triangles + found.count)
    found.count += len(points)
