from __future__ import annotations

import numpy as np
import pytest
import trimesh

from partialbench.dataset.categories import PS15
from renderers.rooms.appliances import FAMILIES
from renderers.rooms.furniture import KINDS, LARGEST_M, make_cad, rotational_symmetry
from renderers.sources.scannet.instances import CLASSES_OF


@pytest.mark.parametrize("name", FAMILIES)
def test_appliances_are_sound_and_differ(name):
    family = FAMILIES[name]
    meshes = [family.mesh(i) for i in range(30)]
    assert {family.draw(i).variant for i in range(30)} == set(family.variants)
    assert len({m.vertices.tobytes() for m in meshes}) == 30
    for mesh in meshes:
        assert 300 <= len(mesh.faces) <= 20_000
        assert np.linalg.norm(mesh.vertices, axis=1).max() == pytest.approx(1, abs=1e-5)
        np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-5)
    again = family.mesh(3)
    assert again.vertices.tobytes() == meshes[3].vertices.tobytes()


def test_a_stove_has_its_door_in_front_and_its_guard_behind():
    """Handles stick out at −y; what rises above the cooktop is at +y."""
    family = FAMILIES["stove"]
    guarded = [i for i in range(40) if family.draw(i).variant == "backguard"]
    for i in guarded:
        mesh = family.mesh(i)
        top = mesh.vertices[mesh.vertices[:, 2] > mesh.vertices[:, 2].max() - 0.02]
        assert top[:, 1].min() > 0
        foremost = mesh.vertices[mesh.vertices[:, 1] < mesh.vertices[:, 1].min() + 0.01]
        assert foremost[:, 2].min() > mesh.vertices[:, 2].min() + 0.1


def test_a_printer_gives_paper_in_front():
    """The tray is the foremost part and narrower than the body."""
    for i in range(20):
        mesh = FAMILIES["printer"].mesh(i)
        foremost = mesh.vertices[mesh.vertices[:, 1] < mesh.vertices[:, 1].min() + 0.03]
        assert np.ptp(foremost[:, 0]) < 0.9 * np.ptp(mesh.vertices[:, 0])


@pytest.mark.parametrize("name", PS15)
def test_cads_are_in_shapenets_frame_at_a_real_size(name):
    kind = KINDS[name]
    assert name in CLASSES_OF[kind.catid]
    for index in range(5):
        cad = make_cad(name, index, 0)
        assert np.linalg.norm(cad.mesh.extents) == pytest.approx(1)
        np.testing.assert_allclose(cad.mesh.bounds.sum(axis=0), 0, atol=1e-12)
        measured = cad.size_m["xyz".index(kind.measure)]
        assert measured <= kind.size_m[1] * 1.081
        assert measured >= kind.size_m[0] * 0.919 or cad.size_m.max() > LARGEST_M * 0.9
        assert cad.size_m.max() < LARGEST_M * 1.081
        # Up is CAD y: the metric height is along it.
        assert cad.size_m[2] == pytest.approx(2 * cad.half_extent[1] * cad.scale[1])


@pytest.mark.parametrize(
    ("mesh", "expected"),
    [
        (trimesh.creation.box((1, 2, 1)), "__SYM_ROTATE_UP_4"),
        (trimesh.creation.box((1, 2, 1.2)), "__SYM_ROTATE_UP_2"),
        (
            trimesh.creation.cylinder(0.5, 1, transform=trimesh.transformations.rotation_matrix(
                np.pi / 2, (1, 0, 0))),
            "__SYM_ROTATE_UP_INF",
        ),
        (
            trimesh.util.concatenate(
                trimesh.creation.box((1, 1, 1)),
                trimesh.creation.box((1, 1, 0.1), transform=trimesh.transformations.
                                     translation_matrix((0, 0.8, 0.45))),
            ),
            "__SYM_NONE",
        ),
    ],
)  # fmt: skip
def test_symmetry_is_what_an_annotator_sees(mesh, expected, rng):
    mesh.apply_scale(1 / np.linalg.norm(mesh.extents))
    assert rotational_symmetry(mesh, rng) == expected


def test_round_things_stay_round():
    for index in range(30):
        cad = make_cad("lamp", index, 0)
        if cad.symmetry == "__SYM_ROTATE_UP_INF":
            assert cad.scale[0] == cad.scale[2]
            return
    raise AssertionError("no round lamp among thirty")
