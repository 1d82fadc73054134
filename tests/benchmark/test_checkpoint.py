"""A checkpoint is data: whole or refused with a sentence, and never a reason to import anything."""

from __future__ import annotations

import io
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import torch

from partialbench.benchmark.predict import Classifier
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training import checkpoint
from partialbench.errors import InputError
from tests.benchmark.tiny_models import MODELS

MODEL = f"{MODELS}:Posed"


@pytest.fixture(scope="module")
def weights(done) -> Path:
    return next((done[1] / "runs").glob("*seed0/branch-64/checkpoint.pt"))


@pytest.fixture(scope="module")
def content(weights) -> dict:
    return checkpoint.load(weights)


@pytest.fixture
def cloud(tmp_path, rng) -> Path:
    np.save(tmp_path / "cloud.npy", rng.standard_normal((80, 3)))
    return tmp_path / "cloud.npy"


def resigned(path: Path, content: dict, **changes) -> Path:
    """Written as eval would, digests and all, with fields changed: by someone who knows how."""
    changed = {**content, **changes}
    parts = {k: v for k, v in changed.items() if k not in ("format", "format_version")}
    identity = {name: parts.pop(name) for name in checkpoint.IDENTITY}
    checkpoint.save(path, identity, parts)
    return path


def test_what_is_loaded_is_what_was_saved_with_a_digest_of_the_weights(content, tmp_path):
    again = checkpoint.load(resigned(tmp_path / "again.pt", content))
    assert again["weights_sha256"] == content["weights_sha256"]
    assert again["weights_sha256"] == checkpoint.weights_digest(content["state"])
    assert again["content_sha256"] == content["content_sha256"]
    state = {name: tensor.clone() for name, tensor in content["state"].items()}
    assert checkpoint.weights_digest(dict(reversed(state.items()))) == again["weights_sha256"]
    state["body.head.2.bias"][0] += 1e-6
    assert checkpoint.weights_digest(state) != again["weights_sha256"]
    as_double = {name: tensor.double() for name, tensor in content["state"].items()}
    assert checkpoint.weights_digest(as_double) != again["weights_sha256"]


def test_a_model_is_not_imported_because_a_file_says_so(content, tmp_path, cloud, monkeypatch):
    monkeypatch.chdir(tmp_path)
    Path("planted.py").write_text("open('OWNED', 'w')\ndef make(k): return None\n")
    for name in ("planted:make", "./planted.py:make", "pydoc:pipepager"):
        path = resigned(
            tmp_path / "evil.pt", content, model=name, model_code="", state={},
            options={"cmd": "touch OWNED"} if "pydoc" in name else {},
        )  # fmt: skip
        with pytest.raises(InputError, match="Code is imported only if you name it"):
            Classifier(path)(cloud)
        with pytest.raises(InputError, match="is not one of ours"):
            checkpoint.build_model(checkpoint.load(path))
        for known in (MODEL, "pointnet"):
            with pytest.raises(InputError):
                run_eval(known, tmp_path, checkpoint_file=path, device="cpu")
    assert not Path("OWNED").exists()
    assert not any("planted" in name for name in sys.modules)


def test_a_user_names_their_own_model(weights, cloud):
    assert Classifier(weights, model=MODEL)(cloud).points_given == 80
    with pytest.raises(InputError, match="give --model with the module:factory"):
        Classifier(weights)(cloud)
    with pytest.raises(InputError, match="give --model with the module:factory"):
        Classifier(weights, model="pointnet")(cloud)


def test_options_of_a_stranger_reach_only_parameters_of_the_factory(content, tmp_path, cloud):
    path = resigned(tmp_path / "a.pt", content, model="dgcnn", options={"k": 5, "cmd": "id"})
    with pytest.raises(InputError, match="dgcnn has no option 'cmd'"):
        Classifier(path)(cloud)
    path = resigned(tmp_path / "b.pt", content, model="dgcnn", options={"k": "touch OWNED"})
    with pytest.raises(InputError, match="option k must be a whole number"):
        Classifier(path)(cloud)
    path = resigned(tmp_path / "c.pt", content, model="nonesuch", model_code="")
    with pytest.raises(InputError, match="no model named 'nonesuch'"):
        Classifier(path)(cloud)


def test_weights_of_another_shape_or_kind_are_named(content, tmp_path):
    state = dict(content["state"])
    for wrong in (state["body.head.2.bias"][:5].clone(), state["body.head.2.bias"].double()):
        path = resigned(tmp_path / "a.pt", content, state={**state, "body.head.2.bias": wrong})
        with pytest.raises(InputError, match=r"do not fit .*body\.head\.2\.bias is float"):
            Classifier(path, model=MODEL)


def test_every_flipped_bit_is_found(weights, tmp_path, rng):
    raw = weights.read_bytes()
    begin = raw.find(checkpoint.load(weights)["state"]["body.head.2.weight"].numpy().tobytes())
    places = [begin, *rng.integers(0, len(raw), 40)]
    refused = 0
    for place in places:
        damaged = bytearray(raw)
        damaged[place] ^= 1 << int(rng.integers(8))
        (tmp_path / "flip.pt").write_bytes(damaged)
        try:  # a bit of padding between the parts may be another, but no value
            same = checkpoint.load(tmp_path / "flip.pt")
            assert same["content_sha256"] == checkpoint.load(weights)["content_sha256"]
        except InputError as error:
            refused += "flip.pt" in str(error)
    assert refused > 10


def test_other_files_are_refused_with_what_to_do(weights, tmp_path):
    raw = weights.read_bytes()
    others = {
        "empty": b"", "text": b"hello", "json": b'{"format": "partialbench-checkpoint"}',
        "half": raw[: len(raw) // 2], "short": raw[:-1], "tail": raw[100:],
    }  # fmt: skip
    for name, data in others.items():
        (tmp_path / name).write_bytes(data)
        with pytest.raises(InputError, match=r"no checkpoint, or it is damaged .*train again"):
            checkpoint.load(tmp_path / name)
    torch.save({"some": torch.ones(3)}, tmp_path / "foreign.pt")
    with pytest.raises(InputError, match="was not written by partialbench eval"):
        checkpoint.load(tmp_path / "foreign.pt")
    torch.save({"format": checkpoint.FORMAT, "format_version": 2}, tmp_path / "old.pt")
    with pytest.raises(InputError, match="format 2, this version reads 3: train again"):
        checkpoint.load(tmp_path / "old.pt")
    with pytest.raises(InputError, match="no checkpoint at"):
        checkpoint.load(tmp_path)


def test_a_pickle_that_calls_something_calls_nothing(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    class Caller:
        def __reduce__(self):
            return (exec, ("open('OWNED', 'w')",))

    torch.save({"format": checkpoint.FORMAT, "x": Caller()}, "call.pt")
    with pytest.raises(InputError, match="loads safely"):
        checkpoint.load("call.pt")
    assert not Path("OWNED").exists()


def test_an_archive_that_says_it_is_larger_than_its_file_is_not_unpacked(tmp_path):
    with zipfile.ZipFile(tmp_path / "bomb.pt", "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("archive/data.pkl", bytes(20_000_000))
    with pytest.raises(InputError, match="larger than the file"):
        checkpoint.load(tmp_path / "bomb.pt")


def test_a_tensor_larger_than_its_data_is_refused(content, tmp_path):
    huge = torch.ones(1).expand(1 << 40)
    data = io.BytesIO()
    torch.save({**content, "state": {**content["state"], "huge": huge}}, data)
    (tmp_path / "huge.pt").write_bytes(data.getvalue())
    with pytest.raises(InputError, match="larger than its data"):
        checkpoint.load(tmp_path / "huge.pt")


def said(call: Callable[[], object]) -> bool:
    """Whether it was refused, in one line. Any other error is one."""
    try:
        call()
    except InputError as error:
        return "\n" not in str(error)
    return False


OTHERS = (None, 3, -1, 0.5, float("nan"), "x", "", [], {}, True, [1], {"a": 1}, torch.ones(2))


def test_a_hundred_changed_fields_are_a_sentence_each(content, data, tmp_path):
    """Signed anew by who changed them or not, tested or asked: a sentence, or the old answer."""
    rng = np.random.default_rng(0)
    np.save(tmp_path / "cloud.npy", rng.standard_normal((80, 3)))
    names = [name for name in content if not name.endswith("sha256")]
    refused = 0
    for number in range(100):
        name = names[number % len(names)]
        changed = dict(content)
        if number % 7 == 0:
            del changed[name]
        else:
            changed[name] = OTHERS[int(rng.integers(len(OTHERS)))]
        path = tmp_path / "changed.pt"
        if number % 2 or name not in changed or name in ("state", "format", "format_version"):
            torch.save(changed, path)
        else:
            resigned(path, changed)
        refused += said(lambda path=path: Classifier(path, model=MODEL)(tmp_path / "cloud.npy"))
        if number % 5 == 0:
            test = {"checkpoint_file": path, "device": "cpu", "results_folder": tmp_path / "r"}
            said(lambda test=test: run_eval(MODEL, data, **test))
    assert refused > 70
