"""The verbs for others, and the core without any extra."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest
from typer.testing import CliRunner

from partialbench import doctor, extras
from partialbench.cli import app
from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from tests.dataset.toy import plan

ROOT = Path(__file__).resolve().parents[1]
WITHOUT = """
import sys

class Without:
    names = {names!r}
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in self.names:
            raise ModuleNotFoundError(f"No module named {{name!r}}", name=name)

sys.meta_path.insert(0, Without())
from partialbench.cli import main
main()
"""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    out = tmp_path_factory.mktemp("share") / "data"
    build(plan(out), InlineExecutor)
    return out


def run(*arguments):
    return CliRunner().invoke(app, [str(a) for a in arguments])


def core(*arguments, cwd):
    """A command where no extra is installed."""
    names = {module for modules in extras.EXTRAS.values() for module in modules}
    return subprocess.run(
        [sys.executable, "-c", WITHOUT.format(names=names), *map(str, arguments)],
        capture_output=True, text=True, cwd=cwd, env={"PYTHONPATH": str(ROOT), "PATH": ""},
    )  # fmt: skip


def test_an_export_is_made_checked_and_found_damaged(folder, tmp_path):
    out = tmp_path / "tar"
    made = run("export", folder, "--to", "webdataset", "--out", out, "--json")
    assert made.exit_code == 0
    about = json.loads(made.stdout)
    assert about["rows"] == 24
    assert run("verify", out).exit_code == 0
    with open(out / about["parts"][0]["name"], "r+b") as file:
        file.write(b"x")
    checked = run("verify", out, "--json")
    assert checked.exit_code == 1
    (problem,) = json.loads(checked.stdout)["problems"]
    assert problem == f"{about['parts'][0]['name']} is not as it was written: damaged or edited"


def test_the_core_reads_verifies_and_exports_without_any_extra(folder, tmp_path):
    verified = core("verify", folder, cwd=tmp_path)
    assert verified.returncode == 0, verified.stderr
    assert "is sound" in verified.stdout
    exported = core("export", folder, "--to", "webdataset", "--out", "tar", cwd=tmp_path)
    assert exported.returncode == 0, exported.stderr
    assert core("verify", "tar", cwd=tmp_path).returncode == 0
    assert "pointnet" in core("models", "--json", cwd=tmp_path).stdout


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        (["export", "data", "--to", "parquet", "--out", "x"], "export"),
        (["render", "pm40", "--out", "x"], "render"),
        (["eval", "--model", "pointnet", "--data", "data"], "train"),
        (["show", "data"], "board"),
        (["render", "pm40", "--out", "x", "--scheduler", "tcp://localhost:1"], "render"),
    ],
)
def test_what_lacks_its_extra_says_which_in_one_line(folder, arguments, extra):
    done = core(*arguments, cwd=folder.parent)
    assert done.returncode == 1
    (line,) = done.stderr.splitlines()
    assert line.endswith(f"pip install 'partialbench[{extra}]'")


def test_doctor_tries_what_it_tells(monkeypatch):
    found = {one.what: one for one in doctor.examine()}
    assert found["numpy"].works
    assert found["Mitsuba scalar_rgb"].details == "traces a ray"
    assert all(one.works for one in found.values() if one.needed)
    monkeypatch.setitem(doctor.extras.EXTRAS, "board", ("matplotlib", "no_such_library"))
    lacking = {one.what: one for one in doctor.examine()}["extra [board]"]
    assert not lacking.works
    assert lacking.details == "no_such_library missing: pip install 'partialbench[board]'"


def test_doctor_fails_where_what_every_command_needs_is_broken(monkeypatch):
    broken = [doctor.Finding("numpy", False, "ImportError: no", needed=True)]
    monkeypatch.setattr(doctor, "examine", lambda: broken)
    done = run("doctor", "--json")
    assert json.loads(done.stdout.partition("\nerror")[0])["findings"][0]["works"] is False
    assert done.exit_code == 1
