"""One concave body off centre comes back from every format and dialect as it went in."""

from __future__ import annotations

from pathlib import PurePosixPath

import numpy as np
import pytest
import trimesh

from renderers.sources.mesh import READERS, normalise, read_mesh
from tests.renderers.mesh_dialects import DIALECTS, TRUTH, dae, glb, scene

MOVED = {"graph.glb": (5.0, 6.0, 7.0)}
STEP = {"normalised.glb": 1e-4, "quantised.glb": 1e-4}
"""Half a step of 16 bits over the body is 0.00003."""


def spread(mesh: trimesh.Trimesh) -> np.ndarray:
    """Points all over a mesh's faces, its corners and edges among them."""
    weights = np.array([[a, b, 8 - a - b] for a in range(9) for b in range(9 - a)]) / 8
    return np.einsum("wk,fkj->fwj", weights, mesh.vertices[mesh.faces]).reshape(-1, 3)


def test_every_format_has_a_dialect() -> None:
    assert {PurePosixPath(name).suffix for name in DIALECTS} == set(READERS)


@pytest.mark.parametrize("name", DIALECTS)
def test_the_body_comes_back(name: str) -> None:
    found = read_mesh(DIALECTS[name], PurePosixPath(name).suffix, name=name)
    # A strip's jumps have no area, which the search for closest points does not stand.
    found.update_faces(found.area_faces > 0)
    truth = TRUTH.copy().apply_translation(MOVED.get(name, (0, 0, 0)))
    tolerance = STEP.get(name, 1e-5) * np.linalg.norm(np.ptp(TRUTH.vertices, axis=0) / 2)
    assert trimesh.proximity.closest_point(truth, spread(found))[1].max() < tolerance
    assert trimesh.proximity.closest_point(found, spread(truth))[1].max() < tolerance
    # Nothing is covered twice, and faces look outward.
    assert found.area == pytest.approx(truth.area, rel=STEP.get(name, 1e-6))
    assert found.volume == pytest.approx(truth.volume, rel=STEP.get(name, 1e-6))
    assert found.vertices.dtype == np.float64
    unit = normalise(found)
    np.testing.assert_allclose(unit.bounds, normalise(truth).bounds, atol=STEP.get(name, 1e-6))


def test_up_y_turns_every_format_alike() -> None:
    for name in ("plain.obj", "plain.glb", "triangles.off", "polylist.dae"):
        found = read_mesh(DIALECTS[name], PurePosixPath(name).suffix, up="y")
        x, y, z = TRUTH.bounds.T
        np.testing.assert_allclose(found.bounds.T, [x, -z[::-1], y], atol=1e-6)


@pytest.mark.parametrize(
    ("content", "suffix", "said"),
    [(DIALECTS["plain.glb"], ".glb", "y"), (dae(), ".dae", "z"),
     (dae().replace(b"Z_UP", b"Y_UP"), ".dae", "y"), (dae().replace(b"Z_UP", b"X_UP"), ".dae", "x"),
     (DIALECTS["plain.obj"], ".obj", ""), (dae().replace(b"Z_UP", b""), ".dae", "")],
)  # fmt: skip
def test_another_axis_than_the_file_says_is_told(content: bytes, suffix: str, said: str) -> None:
    for up in "zy":
        told = read_mesh(content, suffix, up).metadata["notices"]
        if said in ("", up):
            assert told == ()
        else:
            (notice,) = told
            assert notice.startswith(f"{said} is up by what the file")
            assert f"read with {up} up" in notice


def test_what_was_left_out_is_told() -> None:
    def notices(name: str) -> str:
        found = read_mesh(DIALECTS[name], PurePosixPath(name).suffix)
        return "; ".join(found.metadata["notices"])

    assert notices("plain.obj") == ""
    assert notices("lines.obj") == (
        "1 lines are no surface and were left out; 1 points are no surface and were left out"
    )
    assert "1 faces of fewer than three corners" in notices("edges.off")
    assert notices("graph.glb") == (
        "1 meshes stand outside the scene and were left out; y is up by what the file or its "
        "format says, but it was read with z up; the option --up decides"
    )
    document, data = scene()
    document["meshes"][0]["primitives"].append({"attributes": {"POSITION": 0}, "mode": 1})
    assert "1 lines are no surface" in read_mesh(glb(document, data), ".glb").metadata["notices"][0]
