"""A campaign says what is done by the records, data and failures that are there."""

import json
import os
import shutil
import socket
import subprocess
import time
from pathlib import Path

import pytest

from partialbench.benchmark.campaign import run as running
from partialbench.benchmark.campaign import worker
from partialbench.benchmark.campaign.declare import declare
from partialbench.benchmark.campaign.failures import FAILURES, Failures, failure_key
from partialbench.benchmark.campaign.file import load
from partialbench.benchmark.campaign.jobs import all_jobs
from partialbench.benchmark.campaign.status import RUNNING, status
from partialbench.benchmark.records import declared, results
from partialbench.benchmark.run import run_eval
from partialbench.benchmark.training.train import DivergedError
from partialbench.errors import InputError
from tests.benchmark.memory_clouds import data_folder
from tests.benchmark.tiny_models import MODELS
from tests.leaderboard.records import forge_file

ROOT = Path(__file__).resolve().parents[2]


def test_what_it_asks_for_stands_beside_the_records(campaign, in_this_process, monkeypatch):
    train = worker._work

    def diverges(job, order, stop):
        if job.model.endswith("Bare") and job.clouds == 64 and job.kind == "train":
            raise DivergedError("the training loss became nan")
        train(job, order, stop)

    monkeypatch.setattr(worker, "_work", diverges)
    declare(campaign)
    before = declared.read_folder(campaign.results)
    # Two rows at two milestones; the later test on other data is a row too, fewer points are none.
    assert len(before) == 5
    assert {each.state for each in before} == {"missing"}
    running.run(campaign, jobs=1)
    path = campaign.results / "board.campaign.json"
    after, written = declared.read(path), path.read_bytes()
    stood = {(each.model.partition(":")[2], each.test_data, each.clouds): each for each in after}
    assert stood["Bare", "toy", 64].state == "failed"
    assert stood["Bare", "toy", 64].reason == "the training loss became nan"
    assert stood["Posed", "other", 64].state == "done"
    records = {(r.row, r.test_data.digest, r.protocol_digest, r.clouds)
               for r in results.read_folder(campaign.results) if not r.conditions}  # fmt: skip
    done = {(each.row, each.test_digest, each.protocol_digest, each.clouds)
            for each in after if each.state == "done"}  # fmt: skip
    assert done <= records
    declare(campaign)
    assert path.read_bytes() == written


def test_what_is_trained_and_what_is_wholly_tested_are_told_apart(campaign, in_this_process):
    running.run(campaign, jobs=1, trials=False)
    (lost,) = (r for r in results.read_folder(campaign.results)
               if r.test_data.points == 32 and r.test_data.id == "toy")  # fmt: skip
    (campaign.results / f"{lost.run_name}{results.SUFFIX}").unlink()
    found = status(campaign)
    assert (len(found.trained), len(found.done)) == (4, 3)
    titles = found.as_dict()
    assert titles["missing"][0] in titles["trained"]
    assert titles["missing"][0] not in titles["done"]
    text = found.as_text()
    assert "32      2 of 2 trained, 2 wholly tested" in text
    assert "64      2 of 2 trained, 1 wholly tested" in text
    assert "64      0 of 1 done" in text  # the trial
    assert "tests alone of 1 trainings, not counted" in text


@pytest.mark.parametrize(
    ("host", "process", "age_s", "believed"),
    [
        ("here", "alive", 0, True),
        ("here", "gone", 0, False),
        ("elsewhere", "unknown", 60, True),
        ("elsewhere", "unknown", 3600, False),
    ],
)
def test_what_a_killed_campaign_left_is_not_running(campaign, host, process, age_s, believed):
    job = all_jobs(campaign)[0]
    path = campaign.work / RUNNING
    path.parent.mkdir(parents=True, exist_ok=True)
    pid = 2**22 + 1 if process == "gone" else os.getpid()  # Linux gives numbers up to 2**22
    name = socket.gethostname() if host == "here" else f"not-{socket.gethostname()}"
    path.write_text(json.dumps({"pid": pid, "host": name, "jobs": [job.as_dict()]}))
    written = time.time() - age_s
    os.utime(path, (written, written))
    found = status(campaign)
    assert found.running == ([job] if believed else [])
    assert (job in found.missing) is not believed


def test_a_record_without_the_precision_of_its_training_is_of_a_full_one(campaign, in_this_process):
    running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    (path,) = campaign.results.glob(f"*{results.SUFFIX}")
    forge_file(path, lambda record: record["training"]["environment"].pop("precision"))
    assert [job.clouds for job in status(campaign).done] == [32]


def test_a_record_whose_recipe_has_its_notes_in_other_words_counts(campaign, in_this_process):
    running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    (path,) = campaign.results.glob(f"*{results.SUFFIX}")
    forge_file(path, lambda record: record["recipe"].update(notes="Said otherwise before."))
    assert [job.clouds for job in status(campaign).done] == [32]


def test_a_fine_tuned_record_is_not_the_training_that_is_asked_for(campaign, in_this_process):
    running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    run_eval(
        f"{MODELS}:Bare", campaign.work / "data" / "toy", preset="smoke", clouds=64, device="cpu",
        start_from=campaign.work / "runs", results_folder=campaign.results,
    )  # fmt: skip
    assert len(results.read_folder(campaign.results)) == 2
    assert [job.clouds for job in status(campaign).done] == [32]


def test_records_of_a_model_that_was_edited_since_do_not_count(
    tmp_path, campaign, in_this_process, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    shutil.copy(ROOT / "tests" / "benchmark" / "tiny_models.py", "my_own_tiny.py")
    text = campaign.path.read_text().replace(MODELS, "my_own_tiny")
    campaign.path.write_text(text)
    campaign = load(campaign.path)
    running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    assert [job.clouds for job in status(campaign).done] == [32]
    with open("my_own_tiny.py", "a") as file:
        file.write("# edited\n")
    after = status(campaign)
    assert after.done == []
    (note,) = after.notes
    assert "my_own_tiny:Bare before its file was edited" in note


def test_what_is_done_is_known_where_the_data_are_not(campaign, in_this_process, monkeypatch):
    """As in a fresh checkout: else the board would be said to lack all that it has."""
    running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    path = campaign.results / "board.campaign.json"
    written, toy = path.read_bytes(), campaign.work / "data" / "toy"
    aside = toy.rename(campaign.work / "aside")
    found = status(campaign)
    assert [job.clouds for job in found.done] == [32]
    assert any("not here are the data of toy" in note for note in found.notes)
    declare(campaign)
    assert path.read_bytes() == written
    # What can be made is made before it is believed: the file may ask for other data by now.
    asked = []

    def render(data, *_):
        asked.append(data.name)
        aside.rename(toy)

    monkeypatch.setattr(running, "_render", render)
    running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    assert asked == ["toy"]
    # What cannot be made here is done all the same, and does not wait.
    toy.rename(aside)
    campaign.path.write_text(campaign.path.read_text().replace("--counts", "--source ${NO_SUCH}"))
    campaign = load(campaign.path)
    after = running.run(campaign, jobs=1, only=["*Bare"], up_to=32)
    assert asked == ["toy"]
    assert [job.clouds for job in after.done] == [32]
    assert len(after.waiting) == 4


def test_data_that_were_rendered_by_another_command_are_told(campaign, monkeypatch):
    def makes(command, **_):
        data_folder(Path(command[command.index("--out") + 1]), points=256)
        return subprocess.CompletedProcess(command, 0)

    shutil.rmtree(campaign.work / "data" / "toy")
    monkeypatch.setattr(running.subprocess, "run", makes)
    running._render(campaign.data["toy"], 1, None, print)
    assert len(status(campaign).missing) == 5
    text = campaign.path.read_text()
    campaign.path.write_text(text.replace("--counts 1,1", "--counts  1,1"))
    status(load(campaign.path))
    campaign.path.write_text(text.replace("--counts 1,1", "--counts 2,1", 1))
    with pytest.raises(InputError, match=r"'pm40 --counts 1,1', .* now has 'pm40 --counts 2,1'"):
        status(load(campaign.path))


def test_a_failure_under_another_preset_is_not_this_campaign_s(campaign, tmp_path):
    """Two files may share a folder of records, and call their data alike."""
    other = tmp_path / "other.toml"
    other.write_text(campaign.path.read_text().replace('"smoke"', '"board"'))
    campaign.results.mkdir()
    job = all_jobs(campaign)[0]
    Failures(load(other)).add(failure_key(job), job.title, "the loss became nan")
    assert status(campaign).failed == []
    assert [each.title for each in status(load(other)).failed] == [job.title]
    Failures(campaign).add(failure_key(job), job.title, "out of memory")
    Failures(load(other)).forget({failure_key(job)})
    assert Failures(campaign).reasons() == {failure_key(job): "out of memory"}
    (campaign.results / FAILURES).write_text('{"job": "x"}\n')
    with pytest.raises(InputError, match=r"not a list of failures: a line lacks .*; delete it"):
        status(campaign)


def test_hours_to_go_come_from_recorded_speeds(campaign, in_this_process):
    running.run(campaign, jobs=1, only=["*Bare"])
    left = status(campaign)
    assert {job.model for job in left.missing} == {f"{MODELS}:Posed"}
    assert left.without_speed == 2
    for record in results.read_folder(campaign.results):
        if record.clouds == 64:
            next(campaign.results.glob(f"{record.run_name}*.json")).unlink()
    left = status(campaign)
    (speed,) = {
        r.training["clouds_per_second"] for r in results.read_folder(campaign.results)
        if r.clouds == 32
    }  # fmt: skip
    # From the trunk at 32 to 64: what the trunk still needs, and the branch.
    assert left.hours == pytest.approx((0.8 * 32 + 0.2 * 64) / speed / 3600)


def test_data_of_another_digest_are_named_with_both_and_with_what_made_them(campaign):
    text = campaign.path.read_text().replace(
        "[data.other]", f'digests = {{train = "{"a" * 64}"}}\nmade_by = "release 9"\n[data.other]'
    )
    campaign.path.write_text(text)
    both = (
        f"has the digest [0-9a-f]+, made by partialbench .* declares {'a' * 64}, made by release 9"
    )
    with pytest.raises(InputError, match=both):
        status(load(campaign.path))
