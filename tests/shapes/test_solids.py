"""The vocabulary against closed forms: volumes, areas, extents, outward winding."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
import trimesh

from renderers.shapes.outlines import arc, circle, rounded_rectangle, smooth, superellipse
from renderers.shapes.solids import (
    Solid,
    beam,
    body,
    both,
    box,
    cylinder,
    difference,
    ellipsoid,
    extrude,
    four,
    hull,
    intersection,
    join,
    loft,
    revolve,
    ring,
    rod,
    rounded_box,
    sheet,
    sweep,
    tube,
)


def mesh(solid: Solid) -> trimesh.Trimesh:
    made = trimesh.Trimesh(solid.vertices, solid.faces, process=True)
    made.update_faces(made.nondegenerate_faces())
    return made


def polygon_area(n: int, radius: float) -> float:
    return n / 2 * radius**2 * np.sin(2 * np.pi / n)


TRIANGLE = hull([(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)])

# Volumes derived by hand; inscribed polygons where a round section has n facets.
VOLUMES = {
    "box": (box(2, 3, (1, 5)), 24.0),
    "cylinder": (cylinder(0.5, (1, 3), 24), 2 * polygon_area(24, 0.5)),
    "frustum": (cylinder(1.0, (0, 3), 24, top=0.5), polygon_area(24, 1) * 3 * (1 + 0.5 + 0.25) / 3),
    "rod": (rod((0, 0, 0), (1, 2, 2), 0.1, 12), 3 * polygon_area(12, 0.1)),
    "rod down": (rod((0, 0, 3), (0, 0, 0), 0.1, 12), 3 * polygon_area(12, 0.1)),
    "tapered beam": (beam((0, 0, 0), (3, 0, 0), 0.2, 0.4, 0.5), 0.08 * 3 * 1.75 / 3),
    "L": (extrude([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], (0, 2)), 6.0),
    "L along y": (extrude([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], (0, 2), "y"), 6.0),
    "L along x": (extrude([(0, 0), (2, 0), (2, 1), (1, 1), (1, 2), (0, 2)], (0, 2), "x"), 6.0),
    "washer": (extrude(circle(2, 48), 0.5, holes=[circle(1, 48)]), 0.5 * 3 * polygon_area(48, 1)),
    "tetrahedron": (TRIANGLE, 1 / 6),
    "drilled": (difference(box(1, 1, 1), cylinder(0.2, 2.0, 24)), 1 - polygon_area(24, 0.2)),
    "shared": (intersection(box(1, 1, 1), box(1, 1, 1).at(0.5, 0.5)), 0.25),
    "mirrored": (box((1, 2), 1, 1).turned("z", 30).mirrored("x"), 1.0),
    "subdivided": (TRIANGLE.subdivided(3), 1 / 6),
    "scaled": (box(1, 1, 1).scaled(2, 3, 4), 24.0),
    "prism body": (body([(0, 1, 1, 0), (2, 1, 1, 0)], 24), 2 * polygon_area(24, 1)),
    "two": (both(box((1, 2), 1, 1)), 2.0),
    "four": (four(box((1, 2), (1, 2), 1)), 4.0),
    "ring": (ring(box((1, 2), 0.1, 1), 5), 0.5),
}  # fmt: skip


@pytest.mark.parametrize("name", VOLUMES)
def test_volume_and_outward_winding(name: str) -> None:
    solid, expected = VOLUMES[name]
    made = mesh(solid)
    assert made.is_watertight
    assert made.is_winding_consistent
    assert made.volume == pytest.approx(expected, rel=1e-5)


def test_an_inside_out_solid_would_fail() -> None:
    inverted = Solid(box(1, 1, 1).vertices, box(1, 1, 1).faces[:, ::-1])
    assert mesh(inverted).volume == pytest.approx(-1.0)


@pytest.mark.parametrize("make", [
    lambda n: (ellipsoid(1, 2, 3, n), 4 / 3 * np.pi * 6),
    lambda n: (rounded_box(2, 3, 4, 0.5, n // 4),  # Steiner: V + A r + π r² Σl/4·… + 4/3 π r³
               1 * 2 * 3 + 2 * (2 + 3 + 6) * 0.5 + np.pi * 0.25 * (1 + 2 + 3) + np.pi / 6),
    lambda n: (tube(np.insert(circle(1.0, n), 2, 0, axis=1), 0.2, n, closed=True),
               2 * np.pi**2 * 0.04),
    lambda n: (revolve([(0, 0), (1, 0), (0, 2)], n), 2 / 3 * np.pi),
])  # fmt: skip
def test_round_solids_converge_on_the_smooth_volume(
    make: Callable[[int], tuple[Solid, float]],
) -> None:
    """Halving the facets' size divides the error by about four."""
    errors = []
    for n in (32, 64):
        solid, expected = make(n)
        assert mesh(solid).is_winding_consistent
        errors.append(1 - mesh(solid).volume / expected)
    assert 0 < errors[1] < 0.01
    assert errors[0] / errors[1] == pytest.approx(4, rel=0.1)


def test_a_bar_keeps_its_thickness_round_a_corner() -> None:
    """A mitred right angle has the volume of its centre line times the section."""
    section = np.array([(-0.1, -0.1), (0.1, -0.1), (0.1, 0.1), (-0.1, 0.1)])
    bent = sweep(section, [(0, 0, 0), (2, 0, 0), (2, 2, 0)])
    assert mesh(bent).is_watertight
    assert mesh(bent).volume == pytest.approx(4 * 0.04, rel=1e-6)


def test_turning_is_right_handed() -> None:
    turned = Solid(np.eye(3), np.array([[0, 1, 2]])).turned("z", 90).vertices
    np.testing.assert_allclose(turned, [[0, 1, 0], [-1, 0, 0], [0, 0, 1]], atol=1e-15)


def test_open_sheets_keep_their_rim() -> None:
    shell = mesh(revolve([(1, 0), (1, 2)], 24))
    assert not shell.is_watertight
    assert shell.area == pytest.approx(24 * 2 * np.sin(np.pi / 24) * 2)
    half = mesh(revolve([(1, 0), (1, 2)], 24, degrees=180))
    assert half.area == pytest.approx(shell.area / 2)
    assert mesh(sheet([[(0, 0, 0), (1, 0, 0)], [(0, 1, 0), (1, 1, 0)]])).area == pytest.approx(1)
    uncapped = loft([np.insert(circle(1, 8), 2, z, axis=1) for z in (0, 1)], caps=False)
    assert len(uncapped.faces) == 16


def test_outlines() -> None:
    np.testing.assert_allclose(np.linalg.norm(superellipse(2, 2, 2.0), axis=1), 2)
    assert np.abs(superellipse(2, 1, 60.0)).max(axis=0) == pytest.approx([2, 1])
    rounded = rounded_rectangle(4, 2, 0.5, 16)
    area = mesh(extrude(rounded, 1)).volume
    assert area == pytest.approx(8 - (4 - np.pi) * 0.25, rel=1e-3)
    points = np.array([(0.0, 0), (1, 3), (2, 0)])
    np.testing.assert_allclose(smooth(points, 5)[::2], points, atol=1e-12)
    np.testing.assert_allclose(smooth([(0, 0), (1, 1), (2, 2)], 9)[:, 0], np.linspace(0, 2, 9))
    np.testing.assert_allclose(arc((1, 1), 2, 0, 90, 3)[[0, -1]], [(3, 1), (1, 3)], atol=1e-12)


def test_join_keeps_every_part() -> None:
    parts = [box(1, 1, 1).at(x=3 * i) for i in range(3)]
    assert len(mesh(join(parts[0], parts[1:])).split()) == 3
    assert len(join([]).faces) == 0


@pytest.mark.parametrize("noise", [1e-15, 1e-12])
def test_a_hoop_does_not_depend_on_rounding(noise: float) -> None:
    """Two right angles, one after the other: the bar turns by 90° from one corner to the next."""
    path = np.array([(1.0, 0, 1), (1, 0, 0), (-1, 0, 0), (-1, 0, 1)])
    hoop = tube(path, 0.1, 8)
    nudge = noise * np.random.default_rng(0).standard_normal(path.shape)
    np.testing.assert_allclose(tube(path + nudge, 0.1, 8).vertices, hoop.vertices, atol=100 * noise)
    # The hoop is its own mirror image.
    mirrored = hoop.vertices * (-1, 1, 1)
    nearest = np.linalg.norm(mirrored[:, None] - hoop.vertices, axis=-1).min(axis=1)
    assert nearest.max() < 1e-9
