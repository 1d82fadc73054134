"""The distribution: what is installed, from a wheel and from a source archive, and what it says."""

from __future__ import annotations

import itertools
import json
import re
import subprocess
import sys
import tarfile
import tomllib
import venv
import zipfile
from pathlib import Path

import pytest

import partialbench
from partialbench import extras

ROOT = Path(__file__).resolve().parents[1]
RECORDS, WEIGHTS = ROOT / "leaderboard" / "records", ROOT / "partialbench" / "weights"
CONTENT = tomllib.loads((ROOT / "pyproject.toml").read_text())
PROJECT, BUILD = CONTENT["project"], CONTENT["tool"]["hatch"]["build"]["targets"]
PACKAGES = {"partialbench", "renderers", "baselines", "papnet", "leaderboard"}
IMPORTED_AS = {
    "mapbox-earcut": "mapbox_earcut", "dracopy": "DracoPy", "pillow": "PIL", "open3d-cpu": "open3d",
    "opencv-python-headless": "cv2",
}  # fmt: skip


def named(requirements):
    names = [re.match(r"[A-Za-z0-9-]+", one).group() for one in requirements]
    return {IMPORTED_AS.get(name, name) for name in names}


def test_an_error_names_the_extra_that_brings_a_library():
    optional = PROJECT["optional-dependencies"]
    assert set(extras.EXTRAS) | {"all", "docs", "test"} == set(optional)
    core = named(PROJECT["dependencies"])
    for extra, modules in extras.EXTRAS.items():
        # Dask comes with its scheduler.
        brought = named(optional[extra]) | ({"dask"} if extra == "cluster" else set())
        assert set(modules) <= brought, extra
        assert not set(modules) & core, extra
    assert set(re.findall(r"\w+", optional["all"][0].partition("[")[2])) == set(extras.EXTRAS)


def test_every_requirement_has_a_pin():
    pinned = {
        line.partition("==")[0].lower().replace("_", "-")
        for line in (ROOT / "constraints.txt").read_text().splitlines()
        if "==" in line
    }
    optional = PROJECT["optional-dependencies"].values()
    wanted = [*PROJECT["dependencies"], *itertools.chain.from_iterable(optional)]
    names = {re.match(r"[A-Za-z0-9_-]+", one).group().lower().replace("_", "-") for one in wanted}
    assert names - pinned <= {"partialbench", "open3d"}


def test_the_versions_agree():
    assert PROJECT["version"] == partialbench.__version__
    citation = (ROOT / "CITATION.cff").read_text()
    assert re.search(r"^version: (.+)$", citation, re.M).group(1) == partialbench.__version__


def test_a_type_checker_takes_the_types_of_every_package():
    for name in PACKAGES:
        assert (ROOT / name / "py.typed").is_file(), name


def test_a_source_archive_has_all_that_a_checkout_has():
    """``make`` and the tests read more than the packages: .ci, benchmarks, mkdocs.yml."""
    if not (ROOT / ".git").exists():
        pytest.skip("no checkout to compare with")
    listed = subprocess.run(
        ["git", "ls-files", "-z"], cwd=ROOT, check=True, capture_output=True, text=True
    ).stdout
    checkout = {name.partition("/")[0] for name in listed.split("\0") if name}
    always = {"pyproject.toml", "README.md", "LICENSE", ".gitignore"}  # by hatchling itself
    assert checkout - always - set(BUILD["sdist"]["include"]) == {".github"}
    assert set(BUILD["sdist"]["include"]) <= checkout


@pytest.mark.slow
def test_wheel_and_source_archive_install_and_run(tmp_path):
    """The core alone, in a bare environment: it verifies, exports, and names what is missing."""
    subprocess.run(
        [sys.executable, "-m", "build", "--outdir", str(tmp_path / "dist"), str(ROOT)],
        check=True, capture_output=True,
    )  # fmt: skip
    (wheel,) = (tmp_path / "dist").glob("*.whl")
    (archive,) = (tmp_path / "dist").glob("*.tar.gz")
    held = {name.split("/")[0] for name in zipfile.ZipFile(wheel).namelist()}
    assert {name for name in held if not name.endswith(".dist-info")} == PACKAGES
    typed = {f"{name}/py.typed" for name in PACKAGES}
    assert typed <= set(zipfile.ZipFile(wheel).namelist())
    weights = [f"partialbench/weights/{path.name}" for path in WEIGHTS.iterdir() if path.is_file()]
    assert set(weights) <= set(zipfile.ZipFile(wheel).namelist())
    assert not any("leaderboard/weights" in n for n in zipfile.ZipFile(wheel).namelist())
    with tarfile.open(archive) as tar:
        assert not any("leaderboard/weights" in n for n in tar.getnames())
        inside = {name.split("/")[1] for name in tar.getnames() if "/" in name}
    assert set(BUILD["sdist"]["include"]) | {"LICENSE", "README.md", "pyproject.toml"} <= inside

    from partialbench.dataset.build import build
    from partialbench.dataset.executors import InlineExecutor
    from tests.dataset.toy import plan

    build(plan(tmp_path / "data"), InlineExecutor)
    for number, package in enumerate((wheel, archive)):
        home = tmp_path / f"venv{number}"
        venv.create(home, with_pip=True)
        pip = [str(home / "bin" / "python"), "-m", "pip", "install", "--quiet"]
        subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), str(package)], check=True)

        def run(*arguments, command=str(home / "bin" / "partialbench")):
            return subprocess.run(
                [command, *map(str, arguments)], capture_output=True, text=True, cwd=tmp_path
            )

        assert run("--version").stdout.strip() == partialbench.__version__
        assert "sound" in run("verify", "data").stdout
        out = f"tar{number}"
        done = run("export", "data", "--to", "webdataset", "--out", out, "--json")
        assert json.loads(done.stdout)["rows"] == 24
        assert json.loads(run("doctor", "--json").stdout)["findings"][0]["works"]
        refused = run("eval", "--model", "pointnet", "--data", "data")
        assert refused.returncode == 1
        assert "pip install 'partialbench[train]'" in refused.stderr
        assert "partialbench[board]" in run("leaderboard", "--results", RECORDS, "--check").stderr
    # Whoever checks a submitted row needs no torch.
    subprocess.run([*pip, "-c", str(ROOT / "constraints.txt"), f"{archive}[board]"], check=True)
    checked = run("leaderboard", "--results", RECORDS, "--check", "--out", "board")
    assert checked.returncode == 0, checked.stderr
    assert (tmp_path / "board" / "leaderboard.html").is_file()
