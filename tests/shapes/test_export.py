"""The families as files and as a picture."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from partialbench.errors import InputError
from renderers.shapes.catalogue import FAMILIES
from renderers.shapes.contact_sheet import draw, varied
from renderers.shapes.export import export_tree
from renderers.shapes.family import GRID
from renderers.shapes.source import ParametricShapes


def test_the_tree_is_modelnet40s_and_holds_the_sources_objects(tmp_path: Path) -> None:
    written = export_tree(tmp_path, (2, 1), ("off", "obj", "glb"), ["chair", "cone"], seed=3)
    assert written == 2 * 3 * 3
    found = sorted(str(p.relative_to(tmp_path)) for p in tmp_path.rglob("*.off"))
    assert found == [
        "chair/test/chair_0003.off", "chair/train/chair_0001.off", "chair/train/chair_0002.off",
        "cone/test/cone_0003.off", "cone/train/cone_0001.off", "cone/train/cone_0002.off",
    ]  # fmt: skip
    source = ParametricShapes((2, 1), seed=3)
    for split in source.splits():
        for ref in source.objects(split):
            name = source.class_names[ref.label]
            if name not in ("chair", "cone"):
                continue
            mesh = source.load(ref)
            path = tmp_path / name / split / ref.object_id
            for suffix in ("off", "obj", "glb"):
                read = trimesh.load_mesh(path.with_suffix(f".{suffix}"), process=False)
                vertices = np.array(read.vertices)
                if suffix == "glb":  # y up: undo, then z is up again
                    vertices = vertices[:, [0, 2, 1]] * (1, -1, 1)
                corners = vertices[read.faces]
                # far closer than the grid they lie on
                np.testing.assert_allclose(corners, mesh.triangles, atol=GRID / 100)


def test_wrong_arguments_are_refused_before_anything_is_written(tmp_path: Path) -> None:
    for arguments, message in (
        (((1, 1), ("stl",)), "'stl'.*off, obj, glb"),
        (((1, 1), ("off",), ["chare"]), "did you mean chair"),
        (("many",), "counts is 'many'"),
    ):
        with pytest.raises(InputError, match=message):
            export_tree(tmp_path / "tree", *arguments)
    assert not (tmp_path / "tree").exists()
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match=r"cannot make the folder .*file.*: Not a directory"):
        export_tree(tmp_path / "file", (1, 1), classes=["chair"])


def test_objects_of_other_counts_are_not_mixed_into_one_tree(tmp_path: Path) -> None:
    """They are numbered on from the training objects: cup_0002 of one is cup_0003 of the other."""
    export_tree(tmp_path, (1, 1), classes=["cup"])
    kept = (tmp_path / "cup/test/cup_0002.off").read_bytes()
    with pytest.raises(InputError, match=r"test/cup_0002\.off is of an export with other --counts"):
        export_tree(tmp_path, (2, 1), classes=["chair", "cup"])
    assert sorted(p.name for p in tmp_path.rglob("*.off")) == ["cup_0001.off", "cup_0002.off"]
    export_tree(tmp_path, (2, 1), classes=["chair"])  # another class has numbers of its own
    (tmp_path / "cup/test/cup_0002.off").write_text("cut short")
    (tmp_path / "cup/test/mine_0007.off").write_text("")
    assert export_tree(tmp_path, (1, 1), ["off", "obj"], ["cup"]) == 4  # again, and goes on
    assert (tmp_path / "cup/test/cup_0002.off").read_bytes() == kept
    other = export_tree(tmp_path / "other", (2, 1), classes=["cup"])
    assert other == 3
    assert (tmp_path / "other/cup/test/cup_0003.off").read_bytes() == kept


def test_the_sheet_shows_different_variants() -> None:
    family = FAMILIES["lamp"]
    shown = [family.draw(i).variant for i in varied(family, len(family.variants))]
    assert sorted(shown) == sorted(family.variants)
    assert len(set(varied(family, 30))) == 30


@pytest.mark.slow
def test_the_contact_sheet_shows_every_cell(tmp_path: Path) -> None:
    import matplotlib.image

    path = draw(tmp_path / "sheet.png", instances=1, columns=8, pixels=40, samples=2)
    image = matplotlib.image.imread(path)[..., :3]
    height, width = image.shape[:2]
    assert width == 8 * 40
    for row in range(5):
        for column in range(8):
            cell = image[
                row * height // 5 : (row + 1) * height // 5, column * 40 : column * 40 + 40
            ]
            assert 0.02 < (cell.mean(axis=-1) < 0.9).mean() < 0.9
