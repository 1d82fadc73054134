"""COLLADA (.dae): the polygons of the visual scene, every instance of a geometry placed.

Source: the Khronos COLLADA 1.4.1 and 1.5 specifications. Own, over lxml: pycollada (and trimesh
through it) holds coordinates and transforms in float32, cuts polygons into fans whatever their
shape and passes over strips, holes and elements that it does not know.
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
from lxml import etree
from numpy.typing import NDArray

from partialbench.errors import InputError
from renderers.sources.formats.polygons import Polygons
from renderers.sources.formats.strips import of_fan, of_strip
from renderers.sources.formats.text import decimals, whole

_SURFACES = ("triangles", "polylist", "polygons", "tristrips", "trifans")
_NO_SURFACE = ("lines", "linestrips")
_TRANSFORMS = {"matrix": 16, "translate": 3, "rotate": 4, "scale": 3}
_IN_NODE = ("asset", "instance_camera", "instance_light", "extra", "instance_geometry",
            "instance_node", "node")  # fmt: skip


class _Reader:
    """One document: what its ids name, and what the walk through the scene gathers."""

    def __init__(self, root: Any) -> None:
        self.root = root
        self.by_id: dict[str, list[Any]] = {}
        for element in root.iter(etree.Element):
            if "id" in element.attrib:
                self.by_id.setdefault(element.attrib["id"], []).append(element)
        self.vertices: list[NDArray] = []
        self.corners: list[NDArray] = []
        self.sizes: list[NDArray] = []
        self.count = 0
        self.left_out: dict[str, int] = {}

    def named(self, element: Any, attribute: str, kinds: tuple[str, ...]) -> Any:
        """The element that an attribute such as url="#body" names."""
        url = element.get(attribute, "")
        if not url.startswith("#"):
            raise InputError(
                f"<{_kind(element)}> names {url[:80]!r}, which lies in another file or is missing; "
                f"export one file"
            )
        found = self.by_id.get(url[1:], [])
        if len(found) != 1 or _kind(found[0]) not in kinds:
            raise InputError(
                f"<{_kind(element)}> names {url[:80]!r}, which {len(found)} elements are called; "
                f"expected one <{'> or <'.join(kinds)}>"
            )
        return found[0]

    def walk(self, node: Any, above: NDArray, path: tuple[Any, ...]) -> None:
        """Gather a node and what is below it; ``above`` (4,4) places its parent in the scene."""
        if node in path or len(path) > 200:
            raise InputError("a node of its scene is below itself")
        placed = above
        for child in node.iterchildren(etree.Element):
            kind = _kind(child)
            if kind in _TRANSFORMS:
                placed = placed @ _transform(child, kind)
            elif kind in ("lookat", "skew"):
                raise InputError(
                    f"a node has a <{kind}>, which is not read; bake it into a <matrix>"
                )
            elif kind == "instance_controller":
                raise InputError(
                    "uses a skin or morph (<instance_controller>), which is not read; export the "
                    "mesh as it is posed"
                )
            elif kind not in _IN_NODE:
                raise InputError(f"a node has a <{kind}>, which COLLADA does not have there")
        for child in node.iterchildren(etree.Element):
            kind = _kind(child)
            if kind == "node":
                self.walk(child, placed, (*path, node))
            elif kind == "instance_node":
                self.walk(self.named(child, "url", ("node",)), placed, (*path, node))
            elif kind == "instance_geometry":
                self.geometry(self.named(child, "url", ("geometry",)), placed)

    def geometry(self, geometry: Any, placed: NDArray) -> None:
        """Gather one instance of a geometry."""
        shapes = [e for e in geometry.iterchildren(etree.Element)
                  if _kind(e) not in ("asset", "extra")]  # fmt: skip
        if [_kind(e) for e in shapes] == ["spline"]:
            self.left_out["splines"] = self.left_out.get("splines", 0) + 1
            return
        if [_kind(e) for e in shapes] != ["mesh"]:
            found = ", ".join(f"<{_kind(e)}>" for e in shapes) or "nothing"
            raise InputError(f"a geometry is {found}, which is not read; export a <mesh>")
        for element in shapes[0].iterchildren(etree.Element):
            kind = _kind(element)
            if kind in _NO_SURFACE:
                self.left_out[kind] = self.left_out.get(kind, 0) + 1
            elif kind in _SURFACES:
                self.primitive(element, kind, placed)
            elif kind not in ("source", "vertices", "extra"):
                raise InputError(f"a mesh has a <{kind}>, which COLLADA does not have there")

    def primitive(self, element: Any, kind: str, placed: NDArray) -> None:
        """Gather one list of polygons, strips or fans."""
        offsets = [_number(e, "offset") for e in _children(element, "input")]
        inputs = [e for e in _children(element, "input") if e.get("semantic") == "VERTEX"]
        if len(inputs) != 1:
            raise InputError(f"<{kind}> has {len(inputs)} inputs VERTEX; expected one")
        stride, offset, count = (
            max(offsets) + 1,
            _number(inputs[0], "offset"),
            _number(element, "count"),
        )
        if _children(element, "ph"):
            raise InputError("a polygon has a hole (<ph>), which is not read; export triangles")
        lists = [whole(_words(p), f"an index of <{kind}>") for p in _children(element, "p")]
        if any(len(p) % stride for p in lists):
            raise InputError(
                f"<{kind}> has {len(lists[0])} indices, which is no multiple of {stride}"
            )
        corners = [p[offset::stride] for p in lists]
        if kind in ("triangles", "polylist"):
            if len(corners) > 1 or (count and not corners):
                raise InputError(f"<{kind}> of {count} has {len(corners)} lists of indices (<p>)")
            flat = corners[0] if corners else np.zeros(0, np.int64)
            sizes = np.full(count, 3)
            if kind == "polylist":
                words = [word for v in _children(element, "vcount") for word in _words(v)]
                sizes = whole(words, "a corner count of <polylist>")
            if len(sizes) != count or (sizes < 0).any() or sizes.sum() != len(flat):
                raise InputError(
                    f"<{kind}> says {count} polygons of {sizes.sum()} corners, but lists "
                    f"{len(flat)} corners: it was cut short or is damaged"
                )
        else:
            if len(corners) != count:
                raise InputError(f"<{kind}> says {count}, but lists {len(corners)}")
            if any(len(run) < 3 for run in corners):
                raise InputError(f"<{kind}> has a run of fewer than three corners")
            cut = {"tristrips": of_strip, "trifans": of_fan}.get(kind)
            if cut is not None:
                corners = [triangle for run in corners for triangle in cut(run)]
            sizes = np.array([len(p) for p in corners], np.int64)
            flat = np.concatenate([*corners, np.zeros(0, np.int64)])
        points = self.positions(inputs[0])
        if len(flat) and (flat.min() < 0 or flat.max() >= len(points)):
            raise InputError(f"<{kind}> names vertex {flat.max()} of {len(points)}")
        if np.linalg.det(placed[:3, :3]) < 0:  # a mirror turns faces round
            order = np.arange(len(flat))
            starts = np.repeat(np.cumsum(sizes) - sizes, sizes)
            flat = flat[2 * starts + np.repeat(sizes, sizes) - 1 - order]
        self.vertices.append(points @ placed[:3, :3].T + placed[:3, 3])
        self.corners.append(flat + self.count)
        self.sizes.append(sizes)
        self.count += len(points)

    def positions(self, vertex_input: Any) -> NDArray[np.float64]:
        """The points (n,3) behind an input VERTEX."""
        vertices = self.named(vertex_input, "source", ("vertices",))
        inputs = [e for e in _children(vertices, "input") if e.get("semantic") == "POSITION"]
        if len(inputs) != 1:
            raise InputError(f"<vertices> has {len(inputs)} inputs POSITION; expected one")
        source = self.named(inputs[0], "source", ("source",))
        accessors = list(source.iter("{*}accessor"))
        if len(accessors) != 1:
            raise InputError(f"a <source> of positions has {len(accessors)} accessors")
        array = self.named(accessors[0], "source", ("float_array", "int_array"))
        numbers = decimals(_words(array), "a coordinate")
        if len(numbers) != _number(array, "count"):
            raise InputError(
                f"<{_kind(array)}> says {array.get('count')} numbers, but has {len(numbers)}: it "
                f"was cut short or is damaged"
            )
        names = [p.get("name", "") for p in _children(accessors[0], "param")]
        columns = [names.index(axis) if axis in names else -1 for axis in "XYZ"]
        if -1 in columns:
            if len(names) < 3:
                raise InputError(f"positions have the parameters {names}; expected X, Y and Z")
            columns = [0, 1, 2]
        stride, count = _number(accessors[0], "stride", 1), _number(accessors[0], "count")
        start = _number(accessors[0], "offset", 0)
        if stride < len(names) or start + stride * (count - 1) + len(names) > len(numbers):
            raise InputError(
                f"an accessor says {count} positions of stride {stride}; its array has "
                f"{len(numbers)} numbers"
            )
        rows = start + stride * np.arange(count)[:, None] + np.array(columns)
        return numbers[rows]


def read_dae(content: bytes) -> Polygons:
    """The polygons of a COLLADA file's scene, in the file's own unit and axes.

    Neither the unit nor the upward axis that the file declares is applied: an object is scaled to
    the unit ball anyway, and which axis is up is said by whoever opens the files; ``up`` is what it
    declares. Lines and splines that were left out are told in the notices.

    Raises:
        InputError: the XML is broken, an element is missing or unknown where it would matter, what
            is counted and what is there differ, or it needs what is not read: skins, morphs, holes,
            other files, ``lookat``, ``skew``, convex hulls, boundary representations.
    """
    parser = etree.XMLParser(resolve_entities=False, no_network=True, huge_tree=True)
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise InputError(f"its XML is broken ({error})") from error
    if _kind(root) != "COLLADA":
        raise InputError(f"its XML is <{_kind(root)}>; expected <COLLADA>")
    reader = _Reader(root)
    scenes = [s for e in _children(root, "scene") for s in _children(e, "instance_visual_scene")]
    if len(scenes) != 1:
        raise InputError(f"has {len(scenes)} instances of a visual scene; expected one")
    for child in reader.named(scenes[0], "url", ("visual_scene",)).iterchildren(etree.Element):
        if _kind(child) == "node":
            reader.walk(child, np.eye(4), ())
        elif _kind(child) not in ("asset", "evaluate_scene", "extra"):
            raise InputError(f"a scene has a <{_kind(child)}>, which COLLADA does not have there")
    if not sum(len(sizes) for sizes in reader.sizes):
        raise InputError("has no faces; expected a mesh, not points or lines")
    mesh = Polygons.of_faces(
        np.concatenate(reader.vertices),
        np.concatenate(reader.corners),
        np.concatenate(reader.sizes),
    )
    notices = [
        f"{n} {kind} are no surface and were left out" for kind, n in reader.left_out.items()
    ]
    up = next((e.text or "" for e in root.iter("{*}up_axis")), "").strip()
    up = up.removesuffix("_UP").lower()
    return replace(mesh, notices=(*mesh.notices, *notices), up=up)


def _kind(element: Any) -> str:
    return etree.QName(element).localname


def _children(element: Any, kind: str) -> list[Any]:
    return [child for child in element.iterchildren(etree.Element) if _kind(child) == kind]


def _words(element: Any) -> list[bytes]:
    if len(element):
        raise InputError(f"<{_kind(element)}> has something else among its numbers")
    return (element.text or "").encode().split()


def _number(element: Any, attribute: str, default: int | None = None) -> int:
    text = element.get(attribute)
    if text is None and default is not None:
        return default
    if text is None or not (text.strip().isascii() and text.strip().isdecimal()):
        raise InputError(f"the {attribute} of <{_kind(element)}> is {text!r}; expected a number")
    return int(text)


def _transform(element: Any, kind: str) -> NDArray[np.float64]:
    values = decimals(_words(element), f"a number of <{kind}>")
    if len(values) != _TRANSFORMS[kind] or not np.isfinite(values).all():
        raise InputError(f"<{kind}> has {len(values)} numbers; expected {_TRANSFORMS[kind]}")
    if kind == "matrix":
        if not np.allclose(values[12:], (0, 0, 0, 1)):
            raise InputError("a <matrix> is no affine transform")
        return values.reshape(4, 4)
    matrix = np.eye(4)
    if kind == "translate":
        matrix[:3, 3] = values
    elif kind == "scale":
        matrix[:3, :3] = np.diag(values)
    else:
        axis, angle = values[:3], np.deg2rad(values[3])
        length = np.linalg.norm(axis)
        if length == 0 and angle:
            raise InputError("a <rotate> has no axis")
        x, y, z = axis / (length or 1)
        cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
        # Rodrigues' formula.
        matrix[:3, :3] += np.sin(angle) * cross + (1 - np.cos(angle)) * cross @ cross
    return matrix
