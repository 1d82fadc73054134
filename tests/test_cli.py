"""The command line as a user meets it: results on stdout, errors in one line, exit statuses."""

import json
import os
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
import trimesh

from partialbench import registry
from partialbench.arguments import parts

RENDER = ("render", "pm40", "--views", "2", "--points", "64", "--resolution", "32")


def partialbench(*arguments, cwd=None, check=None):
    run = subprocess.run(
        [sys.executable, "-c", "from partialbench.cli import main; main()", *map(str, arguments)],
        capture_output=True, text=True, cwd=cwd, env={**os.environ, "COLUMNS": "200"}, timeout=300,
    )  # fmt: skip
    if check is not None:
        assert run.returncode == check, run.stderr
    return run


@pytest.fixture(scope="module")
def meshes(tmp_path_factory):
    """A folder of meshes: two classes, two splits, one broken file."""
    root = tmp_path_factory.mktemp("meshes")
    for split, scale in (("train", 1.0), ("test", 1.3)):
        for label, solid in (
            ("crate", trimesh.creation.box((1, scale, 2))),
            ("tin", trimesh.creation.cylinder(0.5, scale)),
        ):
            folder = root / label / split
            folder.mkdir(parents=True)
            for i in range(2):
                solid.export(folder / f"{label}_{split}_{i}.off")
    (root / "tin" / "train" / "tin_broken.off").write_text("OFF\n8 12 0\n0 0 0\n")
    return root


@pytest.fixture(scope="module")
def rendered(meshes, tmp_path_factory):
    out = tmp_path_factory.mktemp("data") / "mine"
    run = partialbench(*RENDER, "--source", meshes, "--out", out, "--workers", 1, "--json")
    return out, run


def test_a_broken_file_is_recorded_and_the_run_says_so_at_its_end(rendered):
    out, run = rendered
    assert run.returncode == 1
    assert json.loads(run.stdout)["rows"] == {"train": 8, "test": 4}
    assert "error: 1 input(s) could not be used" in run.stderr
    (failure,) = [json.loads(x) for x in (out / "failures.jsonl").read_text().splitlines()]
    assert failure["kind"] == "failed"
    assert "tin_broken" in failure["location"]


def test_the_same_command_again_changes_nothing_and_failures_can_be_accepted(rendered, meshes):
    out, _ = rendered
    before = {p.name: p.stat().st_mtime_ns for p in out.glob("*.h5")}
    run = partialbench(*RENDER, "--source", meshes, "--out", out, "--allow-failures", check=0)
    assert "8 train rows" in run.stdout
    assert {p.name: p.stat().st_mtime_ns for p in out.glob("*.h5")} == before


def test_another_configuration_is_refused(rendered, meshes):
    out, _ = rendered
    run = partialbench(*RENDER, "--source", meshes, "--out", out, "--seed", 3, check=1)
    assert "seed: folder has 0, asked for 3" in run.stderr


def test_ctrl_c_leaves_a_folder_that_the_same_command_completes(meshes, tmp_path):
    """SIGINT goes to the whole process group, as a terminal sends it."""
    command = [sys.executable, "-c", "from partialbench.cli import main; main()", *RENDER,
               "--source", str(meshes), "--out", str(tmp_path / "data"), "--workers", "2",
               "--rows-per-shard", "2", "--allow-failures"]  # fmt: skip
    whole = tmp_path / "whole"
    partialbench(*RENDER, "--source", meshes, "--out", whole, "--workers", 2, "--rows-per-shard", 2,
                 "--allow-failures", check=0)  # fmt: skip
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True)
    manifest = tmp_path / "data" / "manifest.json"
    deadline = time.monotonic() + 120
    while not manifest.exists() and time.monotonic() < deadline:
        time.sleep(0.02)
    os.killpg(process.pid, signal.SIGINT)
    _, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert "interrupted; what was finished is kept" in stderr
    assert "Traceback" not in stderr
    assert json.loads(manifest.read_text())["state"] == "building"
    subprocess.run(command, check=True, capture_output=True, timeout=120)
    assert {p.name: p.read_bytes() for p in (tmp_path / "data").glob("*.h5")} == {
        p.name: p.read_bytes() for p in whole.glob("*.h5")
    }


def test_verify_proves_the_folder_against_its_source(rendered, meshes):
    out, _ = rendered
    run = partialbench("verify", out, "--source", meshes, "--json", check=0)
    report = json.loads(run.stdout)
    assert report["sound"]
    assert report["surface"]["max"] < 1e-4


@pytest.mark.parametrize("suffix", ["png", "html"])
def test_show_draws_a_page(rendered, tmp_path, suffix):
    out, _ = rendered
    page = tmp_path / f"samples.{suffix}"
    run = partialbench("show", out, "--out", page, "--samples", 5, check=0)
    assert run.stdout.strip() == str(page)
    content = page.read_bytes()
    if suffix == "png":
        assert content.startswith(b"\x89PNG")
    else:
        text = content.decode()
        held = text.partition('id="samples">')[2].partition("</script>")[0]
        samples = json.loads(held)
        assert len(samples) == 5
        assert all(sample["points"] and sample["depth"] for sample in samples)
        assert "crate" in text
        assert '<script src="http' not in text, "one file, no request to another host"


@pytest.mark.parametrize(
    ("arguments", "status", "message"),
    [
        (("render", "pm41", "--out", "x"), 2, "'pm41' is not one of"),
        (("render", "pm40"), 2, "--out"),
        (("render", "pm40", "--source", "parametrc", "--out", "x"), 1, "parametric"),
        (("render", "pm40", "--counts", "3", "--out", "x"), 2, "2 numbers with commas, got '3'"),
        (("render", "pm40", "--views", "0", "--out", "x"), 1, "at least 1, got 0"),
        (("verify", "nowhere"), 1, "not a data folder"),
        (("eval", "--model", "pointnt", "--data", "nowhere"), 1, "pointnet"),
        (("import", "papnt", "x", "--out", "y"), 1, "did you mean papnet?"),
        (("leaderboard", "--results", "nowhere"), 1, "nowhere"),
    ],
)
def test_wrong_use_and_wrong_input_are_told_apart(tmp_path, arguments, status, message):
    run = partialbench(*arguments, cwd=tmp_path, check=status)
    assert message in run.stderr.replace("\n", " ")
    assert "Traceback" not in run.stderr
    assert run.stdout == ""


def test_help_has_examples_and_every_verb():
    verbs = ("quickstart", "render", "verify", "show", "models", "eval", "predict", "leaderboard")
    assert all(verb in partialbench("--help", check=0).stdout for verb in verbs)
    for verb in ("render", "eval", "predict"):
        assert "Example" in partialbench(verb, "--help", check=0).stdout


def test_models_lists_a_line_for_each_and_cuts_no_name():
    lines = partialbench("models", check=0).stdout.splitlines()[1:]
    assert [line.split()[0] for line in lines] == list(registry.cards())
    assert "3,480,049" in lines[0]


def test_models_lists_the_table_as_data():
    cards = json.loads(partialbench("models", "--json", check=0).stdout)
    by_name = {card["name"]: card for card in cards}
    assert by_name["pointnet"]["parameters"]["40"] == 3_480_049
    assert by_name["pointnet"]["paper_scores"]["pm40"] == 68.8


def test_shapes_exports_a_tree_that_render_reads(tmp_path):
    partialbench("shapes", "--out", tmp_path / "cad", "--counts", "2,1", "--classes", "chair,cup",
                 check=0)  # fmt: skip
    assert len(list((tmp_path / "cad").rglob("*.off"))) == 6
    run = partialbench(*RENDER, "--source", tmp_path / "cad", "--aligned", "--out",
                       tmp_path / "data", "--workers", 1, check=0)  # fmt: skip
    assert run.stdout.startswith("pm40-custom in")
    assert "the paper" not in run.stdout  # two of its forty classes are not its data
    assert "source: <class>/<split>/<file>: 2 classes, 4 training, 2 test objects" in run.stderr


def test_eval_predict_and_leaderboard_form_a_chain(rendered, tmp_path):
    data, _ = rendered
    small = ("--protocol", "num_points=32", "--protocol", "validation_fraction=0.4",
             "--clouds", "16", "--recipe", "batch_size=4")  # fmt: skip
    (tmp_path / "my_model.py").write_text(
        "import torch\n"
        "def make(num_classes):\n"
        "    class Mine(torch.nn.Module):\n"
        "        def __init__(self):\n"
        "            super().__init__()\n"
        "            self.point = torch.nn.Linear(3, 16)\n"
        "            self.head = torch.nn.Linear(16, num_classes)\n"
        "        def forward(self, points):\n"
        "            centred = points - points.mean(1, keepdim=True)\n"
        "            return self.head(self.point(centred).relu().amax(1))\n"
        "    return Mine()\n"
    )
    run = partialbench("eval", "--model", "my_model:make", "--data", data, "--preset", "smoke",
                       *small, "--json", cwd=tmp_path, check=0)  # fmt: skip
    (record,) = json.loads(run.stdout)
    assert record["model"] == "my_model:make"
    assert 0 <= record["scores"]["accuracy"] <= 1
    run = partialbench("leaderboard", "--out", "board", cwd=tmp_path, check=0)
    assert "my_model:make" in (tmp_path / "board" / "leaderboard.md").read_text()
    (checkpoint,) = (tmp_path / "results" / "runs").rglob("checkpoint.pt")
    np.save(tmp_path / "capture.npy", np.random.default_rng(0).normal(size=(100, 3)))
    run = partialbench("predict", "capture.npy", "--checkpoint", checkpoint, "--json",
                       "--model", "my_model:make", cwd=tmp_path, check=0)  # fmt: skip
    assert json.loads(run.stdout)["class"] in ("crate", "tin")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("lr=0.01", ["lr=0.01"]),
        ("lr=0.01,batch_size=16", ["lr=0.01", "batch_size=16"]),
        ('a={"b":[1,2],"c":3},d=4', ['a={"b":[1,2],"c":3}', "d=4"]),
        ('a="x,y",b=1', ['a="x,y"', "b=1"]),
    ],
)
def test_a_trial_is_cut_at_the_commas_between_its_fields(text, expected):
    assert parts(text) == expected
