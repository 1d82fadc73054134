"""Whatever is done to a data folder, ``verify`` says it in a sentence and falls over nothing."""

from __future__ import annotations

import json
import re

import h5py
import numpy as np
import pytest

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.manifest import Manifest, bytes_sha256
from partialbench.dataset.verify import verify
from partialbench.errors import InputError
from tests.dataset.toy import ToySource, plan

SHARD = "train-00000.h5"


@pytest.fixture
def folder(tmp_path):
    build(plan(tmp_path), InlineExecutor)
    assert verify(tmp_path).problems == []
    return tmp_path


def edit(folder, change):
    """Change a shard and let the manifest vouch for its bytes."""
    with h5py.File(folder / SHARD, "r+") as shard:
        change(shard)
    manifest = json.loads((folder / "manifest.json").read_text())
    [entry] = [entry for entry in manifest["shards"] if entry["file"] == SHARD]
    entry["sha256"] = bytes_sha256((folder / SHARD).read_bytes())
    entry["bytes"] = (folder / SHARD).stat().st_size
    (folder / "manifest.json").write_text(json.dumps(manifest))


def replaced(name, value):
    def change(shard):
        del shard[name]
        if value is not None:
            shard[name] = value

    return change


def as_group(shard):
    del shard["label"]
    shard.create_group("label")


def dangling(shard):
    del shard["label"]
    shard["label"] = h5py.SoftLink("/nowhere")


def not_text(shard):
    ids = shard["object_id"][()]
    ids[0] = b"\xff\xfe"
    shard["object_id"][...] = ids


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (as_group, "'label' is no array of numbers"),
        (dangling, "'label' is no array of numbers"),
        (replaced("label", np.int32(1)), r"'label' is \(\), expected \(6,\)"),
        (replaced("label", None), "lacks the field 'label'"),
        (replaced("label", np.zeros(6, "f4")), "'label' has dtype float32, expected int32"),
        (replaced("points", np.zeros((6, 3), "f4")), r"'points' is \(6, 3\), expected"),
        (not_text, r"object_id is no UTF-8 in 1 row\(s\), the first is row 0"),
        (lambda s: s.create_dataset("evil", (10**9,), "f8"), "holds 'evil', which is no field"),
        (lambda s: s.create_dataset("depth", (10**6, 9, 9), "f4", chunks=True), "'depth' is"),
        (lambda s: s.attrs.__delitem__("configuration_digest"), "does not say which configuration"),
        (lambda s: s.attrs.__setitem__("format_version", "two"), "not readable: .* version 'two'"),
    ],
)
def test_an_edited_shard_is_told(folder, change, message):
    edit(folder, change)
    problems = verify(folder).problems
    assert any(re.match(f"{SHARD}: .*{message}", p) for p in problems), problems


def entry_of(data, **values):
    data["shards"][0].update(values)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: entry_of(m, rows="9"), r"shards\[0\]\.rows is '9', expected int"),
        (lambda m: entry_of(m, rows=True), r"shards\[0\]\.rows is True, expected int"),
        (lambda m: entry_of(m, rows=-1), r"shards\[0\]\.rows is -1, below 0"),
        (lambda m: entry_of(m, rows=0), r"shards\[0\] has 0 rows in the file"),
        (lambda m: entry_of(m, file="../" + SHARD), "expected the name of a file in the folder"),
        (lambda m: entry_of(m, file=m["shards"][1]["file"]), "a file in the folder, once"),
        (lambda m: entry_of(m, failures=["x"]), "a failure is 'x'"),
        (lambda m: m.update(shards=None), "shards is None, expected list"),
        (lambda m: m.update(shards=[3]), r"shards\[0\] is 3"),
        (lambda m: m.update(class_names=[1, 2]), "class_names holds something that is no text"),
        (lambda m: m.update(digests={"train": 1}), "digests holds something that is no text"),
        (lambda m: m.update(state="done"), "state is 'done'"),
        (lambda m: m["configuration"].update(points="64"), "configuration.points is '64'"),
        (lambda m: m["configuration"].pop("occluder"), "its configuration lacks occluder"),
        (lambda m: m.pop("versions"), "damaged"),
    ],
)
def test_a_manifest_of_another_kind_is_an_error(folder, change, message):
    path = folder / "manifest.json"
    data = json.loads(path.read_text())
    change(data)
    # As whoever edits it on purpose would.
    if isinstance(data.get("configuration"), dict):
        data["configuration_digest"] = Manifest(
            data["dataset_id"], data["configuration"], data["class_names"]
        ).configuration_digest
    path.write_text(json.dumps(data))
    with pytest.raises(
        InputError, match=rf"manifest\.json (is damaged|was edited).*{message}|damaged"
    ):
        verify(folder)


@pytest.mark.parametrize("content", ["", "{", "[]", "3", "null", "[" * 100_000, "9" * 5000])
def test_a_manifest_that_is_none_is_an_error(folder, content):
    (folder / "manifest.json").write_text(content)
    with pytest.raises(InputError, match=r"manifest\.json is damaged"):
        verify(folder)


def test_removed_digests_are_missed(folder):
    path = folder / "manifest.json"
    data = json.loads(path.read_text())
    data["digests"] = {"val": data["digests"].pop("test")}
    path.write_text(json.dumps(data))
    assert verify(folder).problems == [
        "manifest.json has no content digest of the split 'train'",
        "manifest.json has no content digest of the split 'test'",
        "manifest.json has a digest of 'val', a split without shards",
    ]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda m: entry_of(m, bytes=1), f"{SHARD}: has .* bytes, the manifest says 1"),
        (lambda m: entry_of(m, index=7), f"{SHARD}: was made as .*0., the manifest .*7"),
        (lambda m: m.pop("card_sha256"), r"manifest\.json has no digest of CARD\.md"),
    ],
)
def test_what_no_digest_covers_is_checked_too(folder, change, message):
    path = folder / "manifest.json"
    data = json.loads(path.read_text())
    change(data)
    path.write_text(json.dumps(data))
    [problem] = verify(folder).problems
    assert re.match(message, problem)


def test_what_lies_beside_the_shards_is_checked(folder):
    (folder / "CARD.md").write_text("lies")
    (folder / "failures.jsonl").write_text("{}\n")
    assert verify(folder).problems == [
        "failures.jsonl does not say what manifest.json recorded",
        "CARD.md is not as it was written: damaged or edited",
    ]
    (folder / "CARD.md").unlink()
    (folder / "failures.jsonl").unlink()
    assert verify(folder).problems == ["failures.jsonl is missing", "CARD.md is missing"]


def test_a_source_that_lost_a_file_is_a_problem_not_an_end(folder):
    source = ToySource(broken=("dresser_0000",))
    problems = verify(folder, source).problems
    assert any("cannot be checked" in p and "0 faces" in p for p in problems)
