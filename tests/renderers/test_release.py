"""The authors' arrays become a data folder that says exactly what they say."""

from __future__ import annotations

import pickle
from pathlib import Path

import numpy as np
import pytest

from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.shards import read_columns
from partialbench.dataset.show import _title, picture, show
from partialbench.dataset.verify import verify
from partialbench.errors import ConfigurationMismatchError, InputError
from partialbench.geometry.rotations import haar_rotations
from renderers.release import ReleasedRows, import_release, read_release
from renderers.scanobjectnn import import_scanobjectnn


def released(folder: Path, rng: np.random.Generator, classes: int = 40) -> dict[str, np.ndarray]:
    arrays = {}
    for split, rows in (("train", 7), ("test", 3)):
        labels = rng.integers(0, classes, rows)
        labels[0] = classes - 1
        arrays |= {
            f"{split}_points": (0.3 * rng.standard_normal((rows, 50, 3)) + 2).astype(np.float32),
            f"{split}_labels": labels[:, None].astype(np.float64),
            f"{split}_gt_rot": haar_rotations(rng, rows).astype(np.float32),
        }
    write(folder, arrays)
    return arrays


def write(folder: Path, arrays: dict[str, np.ndarray]) -> None:
    for name, array in arrays.items():
        np.save(folder / f"{name}.npy", array)


def test_every_row_arrives_in_order(tmp_path: Path, rng: np.random.Generator) -> None:
    arrays = released(tmp_path, rng)
    manifest = import_release(tmp_path, tmp_path / "out")
    assert manifest.dataset_id == "pm40-release"
    assert (manifest.rows("train"), manifest.rows("test")) == (7, 3)
    assert verify(tmp_path / "out").problems == []
    for split in ("train", "test"):
        rows = read_columns(tmp_path / "out" / f"{split}-00000.h5")
        np.testing.assert_array_equal(rows["label"], arrays[f"{split}_labels"][:, 0])
        np.testing.assert_allclose(rows["R_camera_object"], arrays[f"{split}_gt_rot"], atol=1e-6)
        for stored, given in zip(rows["points"], arrays[f"{split}_points"], strict=True):
            centred = given - given.mean(axis=0, dtype=float)
            expected = centred / np.linalg.norm(centred, axis=1).max()
            # A row's points are stored in random order.
            np.testing.assert_allclose(
                stored[np.argsort(stored[:, 0])], expected[np.argsort(expected[:, 0])], atol=1e-6
            )
        assert (rows["n_visible"] == 50).all()


def test_few_labels_may_be_of_either_data_set(tmp_path: Path, rng: np.random.Generator) -> None:
    released(tmp_path, rng, classes=15)
    with pytest.raises(InputError, match=r"all labels are below 15.* say which with --data-set"):
        import_release(tmp_path, tmp_path / "out")
    for data_set, classes in (("ps15", 15), ("pm40", 40)):
        manifest = import_release(tmp_path, tmp_path / data_set, data_set)
        assert manifest.dataset_id == f"{data_set}-release"
        assert len(manifest.class_names) == classes


def test_labels_above_fourteen_are_not_ps15(tmp_path: Path, rng: np.random.Generator) -> None:
    released(tmp_path, rng, classes=40)
    with pytest.raises(InputError, match="labels up to 39, PS15 has 15 classes"):
        import_release(tmp_path, tmp_path / "out", "ps15")
    with pytest.raises(InputError, match="data_set must be pm40 or ps15, got 'pm41'"):
        import_release(tmp_path, tmp_path / "out", "pm41")


def test_ps15_has_no_symmetry_mapping_in_the_release(tmp_path, rng: np.random.Generator) -> None:
    """PM40 has: a bookshelf is label 4 there and label 9 here."""
    for classes, label, symmetry in ((15, 9, b"none"), (40, 4, b"xyz-180")):
        data_set = "ps15" if classes == 15 else "pm40"
        folder = tmp_path / str(classes)
        folder.mkdir()
        arrays = released(folder, rng, classes)
        arrays["train_labels"][3] = label
        write(folder, arrays)
        manifest = import_release(folder, folder / "out", data_set)
        assert manifest.class_names[label] == "bookshelf"
        rows = read_columns(folder / "out" / "train-00000.h5")
        assert rows["symmetry"][3] == symmetry


def test_distinct_points_come_first_and_repeats_after(tmp_path, rng: np.random.Generator) -> None:
    arrays = released(tmp_path, rng)
    arrays["train_points"][1, 20:] = arrays["train_points"][1, rng.integers(0, 20, 30)]
    write(tmp_path, arrays)
    import_release(tmp_path, tmp_path / "out")
    rows = read_columns(tmp_path / "out" / "train-00000.h5")
    assert rows["n_visible"].tolist() == [50, 20, 50, 50, 50, 50, 50]
    assert len(np.unique(rows["points"][1, :20], axis=0)) == 20
    assert len(np.unique(rows["points"][1], axis=0)) == 20


@pytest.mark.parametrize("suffix", [".png", ".html"])
def test_rows_without_a_translation_are_drawn(tmp_path, rng, suffix: str) -> None:
    """Their centre is at the origin, not in front of the camera, and the share seen not known."""
    released(tmp_path, rng)
    import_release(tmp_path, tmp_path / "out")
    data = ShardDataset(tmp_path / "out", "train", 50)
    drawn = picture(data.points([0])[0], data.translations[0])
    np.testing.assert_array_equal(drawn, data.points([0])[0][:, :2])
    assert _title(data, 0, " · ") == f"{data.class_names[data.labels[0]]} · row_000000"
    page = show(tmp_path / "out", tmp_path / f"page{suffix}", samples=3)
    assert page.stat().st_size > 5_000
    with pytest.raises(InputError, match=r"cannot make the folder .*page.*: Not a directory"):
        show(tmp_path / "out", page / "sub" / f"page{suffix}")


def test_other_arrays_do_not_continue_a_folder(tmp_path: Path, rng: np.random.Generator) -> None:
    released(tmp_path, rng)
    import_release(tmp_path, tmp_path / "out")
    released(tmp_path, rng)
    with pytest.raises(ConfigurationMismatchError):
        import_release(tmp_path, tmp_path / "out")


def test_points_are_mapped_not_read(tmp_path: Path, rng: np.random.Generator) -> None:
    released(tmp_path, rng)
    assert isinstance(read_release(tmp_path)["train"].points, np.memmap)
    # Neither does a worker receive them: it opens the files itself.
    source = ReleasedRows(tmp_path)
    sent = pickle.dumps(source)
    assert len(sent) < 500
    ref = source.objects("test")[1]
    assert pickle.loads(sent).digest(ref) == source.digest(ref)


def test_missing_files_are_named(tmp_path: Path, rng: np.random.Generator) -> None:
    released(tmp_path, rng)
    (tmp_path / "test_gt_rot.npy").unlink()
    with pytest.raises(InputError, match=r"lacks test_gt_rot\.npy; expected the six"):
        read_release(tmp_path)


@pytest.mark.parametrize(
    ("name", "array", "message"),
    [
        ("train_points", np.zeros((7, 3, 50)), r"float64 \(7, 3, 50\), expected floats of shape"),
        ("train_points", np.zeros((7, 50, 3), int), r"int64 \(7, 50, 3\), expected floats"),
        ("train_labels", np.zeros((7, 2)), r"\(7, 2\), expected \(M,\): one whole number"),
        ("train_labels", np.full(7, "1"), "label is <U1, expected whole numbers"),
        ("train_labels", np.zeros(6), r"counts differ: \{'points': 7, 'labels': 6, 'gt_rot': 7"),
        ("train_labels", np.full(7, 40), "row 0 has label 40, but there are 40 class names"),
        ("train_labels", np.full(7, 1.5), r"row 0 of label is 1\.5, expected a whole number"),
        ("train_gt_rot", np.zeros((7, 9)), r"\(7, 9\), expected \(M,3,3\)"),
        ("train_gt_rot", np.tile(np.eye(3), (7, 1, 1)) + 0j, "is complex128 .*real numbers"),
        ("train_gt_rot", np.tile(np.eye(3), (7, 1, 1)).astype(str), "is <U32 .*real numbers"),
        ("train_gt_rot", -np.tile(np.eye(3), (7, 1, 1)), "7 of 7 matrices are no rotations"),
        ("train_gt_rot", 1.01 * np.tile(np.eye(3), (7, 1, 1)), "7 of 7 matrices are no rotations"),
    ],
)
def test_wrong_arrays_are_told(tmp_path, rng, name: str, array, message: str) -> None:
    arrays = released(tmp_path, rng)
    write(tmp_path, {**arrays, name: array})
    with pytest.raises(InputError, match=message):
        read_release(tmp_path)


def test_a_broken_file_is_told(tmp_path: Path, rng: np.random.Generator) -> None:
    released(tmp_path, rng)
    (tmp_path / "train_points.npy").write_bytes(b"not an array")
    with pytest.raises(InputError, match=r"train_points\.npy is not a readable \.npy array"):
        read_release(tmp_path)


def test_an_archive_by_the_name_of_an_array_is_told(tmp_path, rng: np.random.Generator) -> None:
    arrays = released(tmp_path, rng)
    for name, array in arrays.items():
        write(tmp_path, arrays)
        with (tmp_path / f"{name}.npy").open("wb") as file:
            np.savez(file, array)
        with pytest.raises(InputError, match=rf"{name}\.npy is an archive of arrays \(NPZ\)"):
            read_release(tmp_path)


def test_what_is_no_folder_is_told(tmp_path: Path) -> None:
    for folder, out in ((None, tmp_path), (tmp_path, None)):
        with pytest.raises(InputError, match=r"must be a path|lacks train_points"):
            import_release(folder, out)
        with pytest.raises(InputError, match=r"must be a path|has no pairs"):
            import_scanobjectnn(folder, out)


def test_mended_files_are_read_again_in_the_same_process(tmp_path, rng) -> None:
    """A build does not go on with files as an earlier one had them open."""
    (tmp_path / "in").mkdir()
    arrays = released(tmp_path / "in", rng)
    import_release(tmp_path / "in", tmp_path / "before", "pm40")
    for path in (tmp_path / "in").iterdir():
        path.unlink()
    arrays["train_points"] = arrays["train_points"][::-1] * (1, 2, 3)
    write(tmp_path / "in", arrays)
    import_release(tmp_path / "in", tmp_path / "after", "pm40")
    given = arrays["train_points"][0]
    stored = read_columns(tmp_path / "after" / "train-00000.h5")["points"][0]
    centred = given - given.mean(axis=0)
    expected = centred / np.linalg.norm(centred, axis=1).max()
    np.testing.assert_allclose(np.sort(stored[:, 0]), np.sort(expected[:, 0]), atol=1e-6)


def test_a_row_without_extent_is_recorded_and_the_rest_imported(
    tmp_path: Path, rng: np.random.Generator
) -> None:
    arrays = released(tmp_path, rng)
    arrays["train_points"][2] = 1.0
    arrays["train_points"][4, 3] = np.nan
    write(tmp_path, arrays)
    manifest = import_release(tmp_path, tmp_path / "out")
    assert manifest.rows("train") == 5
    assert [f["object_id"] for f in manifest.failures] == ["row_000002", "row_000004"]
