"""What a campaign file may say, and what is said of one that is wrong."""

import itertools
import json
import subprocess
import sys
from collections import Counter
from pathlib import Path

import pytest

from partialbench.benchmark.campaign.file import load
from partialbench.benchmark.campaign.jobs import Condition, all_jobs, from_dict
from partialbench.benchmark.campaign.ledger import Ledger
from partialbench.benchmark.campaign.run import run
from partialbench.benchmark.testing import damage
from partialbench.errors import InputError

ROOT = Path(__file__).resolve().parents[2]

SMALL = """
results = "records"
work = "work"
preset = "smoke"

[data.shapes]
render = "pm40 --counts 2,1 --views 1"

[data.rooms]
render = "ps15 --source ${A_VARIABLE_THAT_IS_NOT_SET}"

[[train]]
models = ["pointnet", "dgcnn"]
data = "shapes"
clouds = ["100", "50"]
seeds = 2
test = "rooms"
points = 64

[[tune]]
models = "pointnet"
data = "shapes"
clouds = 50
tries = [{lr = 0.001}, {lr = 0.002}]
"""


def written(tmp_path, text):
    path = tmp_path / "board.toml"
    path.write_text(text)
    return path


def test_a_file_becomes_jobs_the_milestone_that_is_behind_first(tmp_path):
    campaign = load(written(tmp_path, SMALL))
    assert campaign.results == tmp_path / "records"
    assert campaign.data["shapes"].folder == tmp_path / "work" / "data" / "shapes"
    assert campaign.data["rooms"].missing == ("A_VARIABLE_THAT_IS_NOT_SET",)
    jobs = [job for job in all_jobs(campaign) if job.kind == "train"]
    assert [(j.model, j.seed, j.clouds) for j in jobs] == [
        ("pointnet", 0, 50), ("dgcnn", 0, 50), ("pointnet", 1, 50), ("dgcnn", 1, 50),
        ("pointnet", 0, 100), ("dgcnn", 0, 100), ("pointnet", 1, 100), ("dgcnn", 1, 100),
    ]  # fmt: skip
    assert jobs[0].tests == (
        Condition("shapes"), Condition("rooms"), Condition("shapes", 64), Condition("rooms", 64),
    )  # fmt: skip
    trials = [job for job in all_jobs(campaign) if job.kind == "tune"]
    assert [job.recipe for job in trials] == ['{"lr": 0.001}', '{"lr": 0.002}']


def test_two_entries_of_one_training_are_one_with_the_tests_of_both(tmp_path):
    more = '[[train]]\nmodels = "pointnet"\ndata = "shapes"\nclouds = 100\nposes = [0]\n'
    jobs = all_jobs(load(written(tmp_path, SMALL + more)))
    (job,) = [j for j in jobs if j.model == "pointnet" and j.clouds == 100 and j.seed == 0]
    assert Condition("shapes", None, "0") in job.tests
    assert Condition("rooms", 64) in job.tests


def test_an_entry_may_change_the_protocol_and_is_then_another_training(tmp_path):
    entry = '[[train]]\nmodels = "pointnet"\ndata = "shapes"\nclouds = 100\nprotocol = {}\n'
    more = "".join(entry.replace("{}", fields) for fields in ("{stretch = 1.25}", "{stretch = 1}"))
    campaign = load(written(tmp_path, SMALL + more))
    ledger = Ledger(campaign)
    jobs = [
        j for j in all_jobs(campaign)
        if j.kind == "train" and (j.model, j.seed, j.clouds) == ("pointnet", 0, 100)
    ]  # fmt: skip
    # A stretch of 1 is what the preset has: it is the file's first entry again.
    assert [job.protocol for job in jobs] == ["{}", '{"stretch": 1.25}']
    plain, stretched = (ledger.protocol_of(job) for job in jobs)
    assert (plain.preset, plain.stretch) == ("smoke", 1.0)
    assert (stretched.preset, stretched.stretch) == ("smoke+", 1.25)
    assert jobs[0].training != jobs[1].training
    assert "stretch=1.25" in jobs[1].title
    assert from_dict(jobs[1].as_dict()) == jobs[1]


def test_a_recipe_as_the_model_has_it_is_no_other_training(tmp_path):
    entry = '[[train]]\nmodels = "pointnet"\ndata = "shapes"\nclouds = 100\nrecipe = {}\n'
    more = "".join(
        entry.replace("{}", fields) for fields in ("{lr = 1e-3}", "{lr = 2e-3}", "{lr = 1}")
    )
    jobs = [
        j for j in all_jobs(load(written(tmp_path, SMALL + more)))
        if j.kind == "train" and (j.model, j.seed, j.clouds) == ("pointnet", 0, 100)
    ]  # fmt: skip
    # As rows are named by it: a whole number is the rate that it is trained with.
    assert [job.recipe for job in jobs] == ["{}", '{"lr": 0.002}', '{"lr": 1.0}']


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('"dgcnn"', '"dgcn"', r"line 13: no model named 'dgcn'; did you mean dgcnn"),
        ("points = 64", "pionts = 64", r"line 18: .* has no field 'pionts'; did you mean points"),
        ('data = "shapes"', 'data = "shape"', r"line 14: no data set named 'shape'; did you mean"),
        ('preset = "smoke"', 'preset = "smok"', "line 4: no preset named 'smok'; did you mean"),
        ("lr = 0.002", "rl = 0.002", "recipe has no field 'rl'; did you mean lr"),
        ("lr = 0.002", "lr = -1", "lr of a recipe must be a number, not negative, got -1"),
        ("seeds = 2", "seeds = 0", "seeds must be one or more"),
        ("seeds = 2", 'seeds = "two"', "seeds holds 'two'; expected int values"),
        ('"100"', '"many"', "many"),
        ('render = "pm40 --counts 2,1 --views 1"', 'rendr = "x"', "has no field 'rendr'"),
        ("--views 1", "--views 1 --out x", "must not say --out"),
        (
            "points = 64",
            "protocol = {strech = 2}",
            "line 18: .* no field 'strech'; did you mean",
        ),
        ("points = 64", "protocol = {stretch = 0.5}", "stretch must be 1 .none. or more, got 0.5"),
        ("--views 1", "--views '1", "line 7: render of .data.shapes.: No closing quotation"),
        ("tries = [{lr = 0.001}, {lr = 0.002}]", 'tries = "lr"', "tries must be a list of tables"),
        ("points = 64", "points = 0", "line 18: points must be 1 or more, got 0"),
        ("points = 64", 'precision = "64-true"', "line 18: precision '64-true' is not trained in"),
        ("points = 64", 'poses = ["up"]', "a test pose is 'random' or the half width"),
        ('"dgcnn"', '"./none.py:make"', "line 13: no file at none.py"),
        ("[[tune]]", "[[tune]", "is not TOML: .*line 20"),
    ],
)
def test_what_is_wrong_is_said_with_its_line(tmp_path, old, new, message):
    assert old in SMALL
    with pytest.raises(InputError, match=message):
        load(written(tmp_path, SMALL.replace(old, new, 1)))


def test_what_records_write_otherwise_is_one_job(tmp_path, monkeypatch):
    """Else it would be looked for under one name and recorded under another."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my-net.py").write_text("")
    text = SMALL.replace('"dgcnn"', '"./my-net.py:make"').replace(
        "points = 64", 'precision = "bf16"\nposes = [0.0, "0", 15, "random"]'
    )
    (entry, _) = load(written(tmp_path, text)).entries
    assert entry.models == ("pointnet", "my-net.py:make")
    assert entry.precision == "bf16-mixed"
    assert entry.poses == ("0", "15", "random")


def test_options_that_a_record_would_have_otherwise_are_refused_before_anything_is_made(tmp_path):
    for options, message in (
        ("{k = 20}", r"options of dgcnn are \{'k': 20\}; .* they are \{\}: write them so"),
        ('{k = "5"}', "they are {'k': 5}: write them so"),
        ("{k = 5.0}", "they are {'k': 5}: write them so"),
        ("{kk = 5}", "dgcnn has no option 'kk'; did you mean k"),
    ):
        more = f"[[train]]\nmodels = 'dgcnn'\ndata = 'shapes'\nclouds = 50\noptions = {options}\n"
        with pytest.raises(InputError, match=message):
            run(load(written(tmp_path, SMALL + more)))
    assert [path.name for path in tmp_path.iterdir()] == ["board.toml"]


def test_a_status_loads_no_torch(tmp_path):
    path = written(tmp_path, SMALL)
    code = (
        "import sys; from partialbench.benchmark.campaign import file, status; "
        f"status.status(file.load({str(path)!r})); sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=ROOT).returncode == 0


def test_no_file_and_no_run_are_said(tmp_path):
    with pytest.raises(InputError, match="not a readable campaign file"):
        load(tmp_path / "none.toml")
    with pytest.raises(InputError, match="declares no run"):
        load(written(tmp_path, "preset = 'smoke'"))


def test_the_pose_study_is_a_full_factorial():
    campaign = load(ROOT / "leaderboard" / "pose.toml")
    ledger = Ledger(campaign)
    cells = Counter(
        (
            json.loads(job.options).get("pose_weight", "λ"),
            "ray" in json.loads(job.options),
            ledger.protocol_of(job).stretch,
        )
        for job in all_jobs(campaign)
        if job.kind == "train" and job.model == "papnet-steered"
    )
    # Pose weight × ray × stretch, three seeds each; 0.3 is the default and not written.
    expected = itertools.product(("λ", 0.0), (False, True), (1.0, 1.25))
    assert cells == dict.fromkeys(expected, 3)


def test_the_board_s_own_file_holds_together():
    campaign = load(ROOT / "leaderboard" / "campaign.toml")
    models = {job.model for job in all_jobs(campaign)}
    assert {"pointnet", "papnet", "papnet-steered", "rri-pointnet2"} <= models


def test_the_board_tests_its_rows_under_all_damages_and_on_a_grid():
    """By the common recipe, all but what takes normals: damaged and moved clouds have none."""
    campaign = load(ROOT / "leaderboard" / "campaign.toml")
    tested = {"pm40-clouds": len(damage.parse("all")), "pm40-parametric": 39}
    for data, count in tested.items():
        jobs = [
            j for j in all_jobs(campaign)
            if (j.data, j.clouds, j.seed, j.kind, j.recipe) == (data, 100_000, 0, "train", "{}")
        ]  # fmt: skip
        found = {j.model: sum(bool(t.damage or t.cell) for t in j.tests) for j in jobs}
        assert len(found) == 24
        assert {model for model, tests in found.items() if tests < count} == {"riconv2-normals"}
