"""Records that cannot be trusted are refused."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest

from partialbench.benchmark.records import results
from partialbench.errors import InputError


def copy_of(done, tmp_path) -> Path:
    shutil.copytree(done[1], tmp_path / "copy", ignore=shutil.ignore_patterns("runs"))
    return tmp_path / "copy"


def test_a_record_edited_by_hand_is_refused(done, tmp_path):
    folder = copy_of(done, tmp_path)
    path = sorted(folder.glob("*.json"))[0]
    record = json.loads(path.read_text())
    record["scores"]["accuracy"] = 0.99
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match="was changed after it was written"):
        results.read(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: p.write_text("{"), "not a readable JSON"),
        (lambda p: p.write_text("[]"), "not a result record"),
        (lambda p: p.write_text('{"format": "partialbench-result", "format_version": 9}'),
         "format 9, this version reads 2"),
        (lambda p: p.write_text('{"format": "partialbench-result", "format_version": 2}'),
         "missing fields .'card'"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_record_says_so(done, tmp_path, damage, message):
    path = sorted(copy_of(done, tmp_path).glob("*.json"))[0]
    damage(path)
    with pytest.raises(InputError, match=message):
        results.read(path)


def rewrite(path: Path, change) -> None:
    """The record changed as ``change`` changes it, with a digest that fits."""
    text = json.loads(path.read_text())
    change(text)
    text["record_sha256"] = results.record_digest(text)
    path.write_text(json.dumps(text))


def test_a_record_of_an_earlier_format_is_read_as_todays_says_it(done, tmp_path):
    folder = copy_of(done, tmp_path)

    def age(text):
        text["format_version"] = 4
        del text["model_code"]
        text["deviations"] = ["1 epochs of 2 clouds instead of 1 published epochs"]
        text["training"]["environment"]["precision"] = "bf16-mixed"
        text["variant"] = "lr=0.1 width=8"

    now = {path.name: results.read(path) for path in folder.glob("*.json")}
    for path in folder.glob("*.json"):
        rewrite(path, age)
        old, same = results.read(path), now[path.name]
        assert old.variant == "lr=0.1 precision=bf16-mixed width=8"
        assert old.deviations == same.deviations
        assert old.model_code == ""
        # Of several test sets the first one's clouds were turned, and no record says which it was.
        crossed = same.test_data.id != same.train_data.id
        assert old.rotation_audit == ({} if crossed else same.rotation_audit)
    assert {r.rotation_audit == {} for r in now.values()} == {False}
    rewrite(path, lambda text: text["card"].pop("recipe"))
    with pytest.raises(InputError, match="an entry is not what it should be"):
        results.read(path)


def test_predictions_must_be_there_and_be_the_records_own(done, tmp_path):
    folder = copy_of(done, tmp_path)
    a, b = results.read_folder(folder)[:2]
    shutil.copy(folder / b.predictions_file, folder / a.predictions_file)
    with pytest.raises(InputError, match="is not the file its record was written with"):
        results.read_predictions(folder, a)
    (folder / a.predictions_file).unlink()
    with pytest.raises(InputError, match="is missing"):
        results.read_predictions(folder, a)


def test_two_records_of_one_run_are_refused(done, tmp_path):
    folder = copy_of(done, tmp_path)
    path = sorted(folder.glob("*.json"))[0]
    shutil.copy(path, folder / f"again-{path.name}")
    with pytest.raises(InputError, match="record the same run"):
        results.read_folder(folder)
