"""A campaign does what is missing, whatever stopped it."""

import json
import os
import random
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from typer.testing import CliRunner

from partialbench.benchmark.campaign import run as running
from partialbench.benchmark.campaign import worker
from partialbench.benchmark.campaign.failures import FAILURES
from partialbench.benchmark.campaign.file import load
from partialbench.benchmark.campaign.jobs import all_jobs, from_dict
from partialbench.benchmark.campaign.status import status
from partialbench.benchmark.records import results
from partialbench.benchmark.records.trials import FILE, read_trials
from partialbench.benchmark.training.train import DivergedError
from partialbench.cli import app
from partialbench.dataset.lock import sole_user
from partialbench.errors import InputError, PartialbenchError, TimeLimitError
from tests.benchmark.tiny_models import MODELS

ROOT = Path(__file__).resolve().parents[2]


def test_all_that_is_missing_is_done_the_lowest_milestone_first(campaign, in_this_process):
    before = status(campaign)
    assert len(before.missing) == len(all_jobs(campaign)) == 5
    assert before.without_speed == 5
    after = running.run(campaign, jobs=1)
    assert in_this_process == [
        ("train", "Bare", 32), ("train", "Posed", 32), ("train", "Bare", 64),
        ("train", "Posed", 64), ("tune", "Bare", 64),
    ]  # fmt: skip
    assert (len(after.done), after.missing, after.hours) == (5, [], 0.0)
    records = results.read_folder(campaign.results)
    assert len(records) == 3 + 4  # 64 clouds of Posed: two sets, each whole and on fewer points
    assert not (campaign.work / "running.json").exists()
    in_this_process.clear()
    running.run(campaign, jobs=1)
    assert in_this_process == []


def test_a_time_limit_ends_a_rendering_too(campaign, in_this_process, monkeypatch):
    shutil.rmtree(campaign.work / "data" / "toy")
    waited = []

    own = subprocess.run

    def takes_long(command, timeout=None, **options):
        if "render" not in command:
            return own(command, timeout=timeout, **options)
        waited.append(timeout)
        time.sleep(timeout)
        raise subprocess.TimeoutExpired(command, timeout)

    monkeypatch.setattr(running.subprocess, "run", takes_long)
    with pytest.raises(TimeLimitError, match="the time limit is over; 5 jobs are left"):
        running.run(campaign, jobs=1, time_limit_s=running.MARGIN_S + 0.5)
    assert 0 < waited[0] <= 0.5
    assert in_this_process == []


def test_what_names_no_run_of_the_file_is_no_success(campaign, in_this_process):
    for options, message in (
        ({"only": ["*Bare", "*Psed"]}, r"--only '\*Psed' fits no run of .*; known: .*:Posed"),
        ({"only": ["*@tyo"]}, r"--only '\*@tyo' fits no run of .*; did you mean toy"),
        ({"up_to": 25}, "--up-to is 25, its first milestone 32"),
    ):
        with pytest.raises(InputError, match=message):
            running.run(campaign, jobs=1, **options)
    assert in_this_process == []


def test_a_command_of_which_a_job_failed_has_failed(campaign, in_this_process, monkeypatch):
    train = worker._work

    def diverges(job, order, stop):
        raise DivergedError("the training loss became nan")

    command = ["campaign", "run", str(campaign.path), "--workers", "1", "--up-to", "32", "--json"]
    monkeypatch.setattr(worker, "_work", diverges)
    done = CliRunner().invoke(app, [*command, "--only", "*Posed"])
    assert isinstance(done.exception, PartialbenchError)
    assert "of what was asked for 1 failed" in str(done.exception)
    assert len(json.loads(done.stdout)["failed"]) == 2  # its later milestone as well
    monkeypatch.setattr(worker, "_work", train)
    assert CliRunner().invoke(app, [*command, "--only", "*Bare"]).exit_code == 0


def test_a_diverged_training_is_recorded_and_the_rest_goes_on(
    campaign, in_this_process, monkeypatch
):
    train = worker._work

    def diverges(job, order, stop):
        if job.model.endswith("Bare") and job.kind == "train":
            raise DivergedError("the training loss became nan")
        train(job, order, stop)

    monkeypatch.setattr(worker, "_work", diverges)
    after = running.run(campaign, jobs=1)
    # Its later milestone would diverge too, and is not tried.
    assert in_this_process.count(("train", "Bare", 64)) == 0
    assert len(after.failed) == 2
    assert len(after.done) == 3
    (line,) = (campaign.results / FAILURES).read_text().splitlines()
    assert "became nan" in json.loads(line)["reason"]
    monkeypatch.setattr(worker, "_work", train)
    assert len(running.run(campaign, jobs=1, retry_failed=True).done) == 5
    assert not (campaign.results / FAILURES).exists()


def test_a_job_whose_process_is_killed_is_begun_again_once(campaign, monkeypatch):
    begun = []

    def run_here(order, stop):
        job = from_dict(order["job"])
        begun.append((job.model, job.clouds, job.kind))
        if begun[-1] == (f"{MODELS}:Posed", 64, "train") or len(begun) == 1:
            command = "import os, signal; os.kill(os.getpid(), signal.SIGKILL)"
            with monkeypatch.context() as patched:
                patched.setattr(worker, "_COMMAND", ["-c", command])
                return run_in_process(order, stop)
        return worker.outcome_of(job, order, Path(stop))

    run_in_process = worker.run_in_process
    monkeypatch.setattr(running, "run_in_process", run_here)
    after = running.run(campaign, jobs=1)
    assert begun[0] == begun[1], "a training goes on from what was saved"
    assert begun.count((f"{MODELS}:Posed", 64, "train")) == 2, "and is not tried for ever"
    (failed,) = after.failed
    assert failed.clouds == 64
    (line,) = (campaign.results / FAILURES).read_text().splitlines()
    assert "was killed by SIGKILL without a word" in json.loads(line)["reason"]


def test_failures_that_are_left_out_keep_their_record(campaign, in_this_process, monkeypatch):
    train = worker._work

    def breaks(job, order, stop):
        raise DivergedError("the training loss became nan")

    monkeypatch.setattr(worker, "_work", breaks)
    assert len(running.run(campaign, jobs=1).failed) == 5
    monkeypatch.setattr(worker, "_work", train)
    after = running.run(campaign, jobs=1, only=["*Bare"], retry_failed=True)
    assert {job.model for job in after.failed} == {f"{MODELS}:Posed"}
    assert {job.model for job in after.done} == {f"{MODELS}:Bare"}


def test_an_earlier_pattern_comes_first_within_a_milestone(campaign, in_this_process):
    running.run(campaign, jobs=1, only=["*Posed", "*Bare"])
    assert in_this_process[:2] == [("train", "Posed", 32), ("train", "Bare", 32)]
    assert in_this_process[2] == ("train", "Posed", 64)


def test_what_lies_beyond_the_last_milestone_asked_for_waits(campaign, in_this_process):
    # Nor are data rendered that only later milestones need.
    shutil.rmtree(campaign.work / "data" / "other")
    after = running.run(campaign, jobs=1, up_to="32")
    assert in_this_process == [("train", "Bare", 32), ("train", "Posed", 32)]
    assert {job.clouds for job in after.missing} == {64}
    assert not (campaign.work / "data" / "other").exists()
    with pytest.raises(InputError, match="positive whole number such as 25000, 100k or 1M"):
        running.run(campaign, jobs=1, up_to="soon")
    running.run(campaign, jobs=1, only=["*Bare"], trials=False)
    assert in_this_process[2:] == [("train", "Bare", 64)]


def test_data_that_cannot_be_rendered_cost_their_own_jobs_alone(campaign, in_this_process):
    shutil.rmtree(campaign.work / "data" / "other")
    text = campaign.path.read_text()
    at = text.index("render =", text.index("[data.other]"))
    broken = text[:at] + 'render = "pm40 --source nowhere"\n' + text[text.index("\n", at) :]
    campaign.path.write_text(broken)
    with pytest.raises(PartialbenchError, match=r"all was done but for 1 data set.*nowhere"):
        running.run(load(campaign.path), jobs=1)
    assert ("train", "Posed", 64) not in in_this_process  # tested on it
    assert len(in_this_process) == 4


def test_a_trial_that_diverges_is_done(campaign, in_this_process):
    text = campaign.path.read_text().replace("{lr = 0.01}", "{lr = 0.01}, {lr = 1e30}")
    campaign.path.write_text(text.replace("Bare\"\ndata = \"toy\"\nclouds = 64",
                                          "Bare\"\ndata = \"toy\"\nclouds = 640"))  # fmt: skip
    after = running.run(load(campaign.path), jobs=1, only=["*Bare"])
    assert [job.recipe for job in after.done if job.kind == "tune"] == [
        '{"lr": 0.01}', '{"lr": 1e+30}'
    ]  # fmt: skip
    assert sorted(trial.diverged for trial in read_trials(campaign.results / FILE)) == [False, True]


def test_time_that_is_over_ends_it_with_75_and_keeps_what_is_done(campaign, in_this_process):
    with pytest.raises(TimeLimitError, match="5 jobs are left"):
        running.run(campaign, jobs=1, time_limit_s=1e-3)
    assert TimeLimitError.exit_status == 75
    assert in_this_process == []


def test_two_campaigns_in_one_folder_and_a_full_disk(campaign, in_this_process, monkeypatch):
    with sole_user(campaign.work), pytest.raises(PartialbenchError, match="another"):
        running.run(campaign, jobs=1)
    monkeypatch.setattr(running, "LEAST_FREE_BYTES", 1 << 62)
    with pytest.raises(PartialbenchError, match=r"only \d+ MB are free .* Make room"):
        running.run(campaign, jobs=1)
    assert in_this_process == []


@pytest.mark.slow
@pytest.mark.parametrize("way", ["two at once", "killed", "cluster"])
def test_processes_end_with_the_same_answers_however_they_ran(campaign, in_this_process, way):
    """Really several processes; killed with SIGKILL three times at random moments."""
    other = campaign.path.parent / "again"
    other.mkdir()
    shutil.copy(campaign.path, other)
    shutil.copytree(campaign.work / "data", other / "work" / "data")
    running.run(campaign, jobs=1)
    command = [sys.executable, "-m", "partialbench.cli", "campaign", "run", "board.toml"]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}

    def start(*options):
        return subprocess.Popen([*command, *options], cwd=other, env=environment)

    if way == "killed":
        moments = random.Random(0)
        for _ in range(3):
            process = start("--jobs", "2")
            time.sleep(moments.uniform(5, 25))
            process.send_signal(signal.SIGKILL)
            process.wait()
            time.sleep(3)  # its trainings notice
    if way == "cluster":
        distributed = pytest.importorskip("distributed")
        with distributed.LocalCluster(
            n_workers=2, threads_per_worker=1, dashboard_address=None
        ) as cluster:
            assert start("--scheduler", cluster.scheduler_address).wait() == 0
    else:
        assert start("--jobs", "2").wait() == 0
    for folder in (campaign.results, other / "records"):
        assert len(results.read_folder(folder)) == 7
    for record in results.read_folder(campaign.results):
        again = results.read(other / "records" / f"{record.run_name}{results.SUFFIX}")
        assert again.predictions_sha256 == record.predictions_sha256
        assert again.weights_sha256 == record.weights_sha256
        assert again.scores == record.scores


@pytest.mark.slow
def test_a_termination_leaves_no_rendering_behind(campaign):
    """As Slurm ends a job: what was rendering ends too, and the same command goes on."""
    shutil.rmtree(campaign.work)
    text = campaign.path.read_text().replace("--counts 1,1", "--counts 300,1")
    campaign.path.write_text(text)
    process = subprocess.Popen(
        [sys.executable, "-m", "partialbench.cli", "campaign", "run", "board.toml"],
        cwd=campaign.path.parent, env={**os.environ, "PYTHONPATH": str(ROOT)},
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    folder = campaign.work / "data" / "toy"

    def renderers():
        commands = [path.read_bytes() for path in Path("/proc").glob("[0-9]*/cmdline")]
        return [c for c in commands if b"render" in c and str(folder).encode() in c]

    while not list(folder.glob("*.h5")):
        assert process.poll() is None
        time.sleep(0.2)
    assert renderers()
    process.send_signal(signal.SIGTERM)
    assert process.wait(30) == 130
    assert "the same command continues it" in process.stderr.read()
    time.sleep(1)
    assert renderers() == []
