"""Records that cannot be trusted are refused."""

from __future__ import annotations

import dataclasses
import datetime
import json
import shutil
from pathlib import Path

import pytest
import torch

from partialbench.benchmark.records import cards, results, testsets
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
         "format 9, this version reads 6"),
        (lambda p: p.write_text('{"format": "partialbench-result", "format_version": 5}'),
         "format 5, this version reads 6; test the run's checkpoint again"),
        (lambda p: p.write_text('{"format": "partialbench-result", "format_version": 6}'),
         "missing fields .'card'"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_record_says_so(done, tmp_path, damage, message):
    path = sorted(copy_of(done, tmp_path).glob("*.json"))[0]
    damage(path)
    with pytest.raises(InputError, match=message):
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


def test_a_record_says_the_day_of_its_test_and_older_ones_say_none(done, tmp_path):
    folder = copy_of(done, tmp_path)
    today = datetime.datetime.now(datetime.UTC).date()
    days = {str(today), str(today - datetime.timedelta(days=1))}  # begun before midnight
    path = sorted(folder.glob("*.json"))[0]
    assert results.read(path).date in days
    record = json.loads(path.read_text())
    del record["date"], record["record_sha256"]
    path.write_text(json.dumps({**record, "record_sha256": results.record_digest(record)}))
    assert results.read(path).date == ""
    record["date"] = "28.11.2026"
    path.write_text(json.dumps({**record, "record_sha256": results.record_digest(record)}))
    with pytest.raises(InputError, match="an entry is not what it should be: date"):
        results.read(path)


def test_two_records_of_one_run_are_refused(done, tmp_path):
    folder = copy_of(done, tmp_path)
    path = sorted(folder.glob("*.json"))[0]
    shutil.copy(path, folder / f"again-{path.name}")
    with pytest.raises(InputError, match="record the same run"):
        results.read_folder(folder)


def test_a_record_of_other_weights_is_not_replaced_without_a_word(done, tmp_path, caplog):
    folder, result = copy_of(done, tmp_path), done[0][0]
    predictions = results.read_predictions(folder, result)
    results.write(folder, result, predictions)
    assert not caplog.messages
    results.write(folder, dataclasses.replace(result, weights_sha256="0" * 64), predictions)
    (said,) = caplog.messages
    assert (
        f"was the record of other weights (SHA-256 {result.weights_sha256[:12]}, now 0000" in said
    )


def test_what_is_true_of_a_test_set_is_stored_once(done, tmp_path):
    folder = copy_of(done, tmp_path)
    found = results.read_folder(folder)
    assert len(found) == 4  # two seeds, two test sets
    assert len(list((folder / testsets.FOLDER).glob("*.npz"))) == 2
    assert len(list((folder / cards.FOLDER).glob("*.json"))) == 1
    for result in found:
        stored = results.read_predictions(folder, result)
        truth = testsets.load(folder, result.test_set_sha256)
        assert stored.labels is truth.labels
        assert result.clouds == result.training["clouds"]


def test_a_folder_without_its_test_sets_says_what_to_copy(done, tmp_path):
    folder = copy_of(done, tmp_path)
    result = results.read_folder(folder)[0]
    shutil.rmtree(folder / testsets.FOLDER)
    with pytest.raises(InputError, match="copy the folder testsets/ along"):
        results.read_predictions(folder, result)
    shutil.rmtree(folder / cards.FOLDER)
    with pytest.raises(InputError, match="copy the folder cards/ along"):
        results.read_folder(folder)


def test_a_record_names_the_weights_of_its_checkpoint(done):
    written, folder = done
    for path in (folder / "runs").glob("**/*.pt"):
        content = torch.load(path, map_location="cpu", weights_only=True)
        if "summary" in content:
            assert content["weights_sha256"] in {r.weights_sha256 for r in written}
    assert len({r.weights_sha256 for r in written}) == 2
