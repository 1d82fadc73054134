"""A user's own file is loaded from where they stand, as itself, and hides nothing of ours."""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
from pathlib import Path

import pytest

from partialbench import registry, user_code
from partialbench.errors import InputError

ROOT = Path(__file__).resolve().parents[1]


@pytest.fixture
def here(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", list(sys.path))
    return tmp_path


@pytest.mark.parametrize(
    ("file", "name"),
    [
        ("random.py", "random:make"), ("types.py", "types:make"), ("code.py", "code:make"),
        ("my-net.py", "./my-net.py:make"), ("my-net.py", "my-net.py:make"),
        ("sub/my.net.py", "sub/my.net.py:make"), ("baselines/net.py", "baselines.net:make"),
    ],
)  # fmt: skip
def test_a_file_is_found_whatever_it_is_called(here, file, name):
    path = here / file
    path.parent.mkdir(exist_ok=True)
    path.write_text("def make(k): return ('mine', k)\n")
    assert registry.factory_of(name)(3) == ("mine", 3)
    assert user_code.digest(name) == hashlib.sha256(path.read_bytes()).hexdigest()
    assert not getattr(sys.modules.get("random"), "make", None)
    assert user_code.named(str(here / "my-net.py") + ":make") == "my-net.py:make"


def test_the_digest_is_of_the_file_as_it_was_imported(here):
    path = here / "live.py"
    path.write_text("WIDTH = 16\ndef make(k): return WIDTH\n")
    before = hashlib.sha256(path.read_bytes()).hexdigest()
    assert user_code.load("live:make")(3) == 16
    path.write_text("WIDTH = 64\ndef make(k): return WIDTH\n")
    assert user_code.load("live:make")(3) == 16
    assert user_code.digest("live:make") == before


def test_packages_import_their_own_and_neighbours(here):
    (here / "papnet").mkdir()
    (here / "papnet" / "__init__.py").write_text("")
    (here / "papnet" / "parts.py").write_text("WIDTH = 5\n")
    (here / "neighbour_of_mine.py").write_text("DEPTH = 2\n")
    (here / "papnet" / "net.py").write_text(
        "from .parts import WIDTH\nfrom neighbour_of_mine import DEPTH\n"
        "def make(k): return WIDTH, DEPTH\n"
    )
    assert user_code.load("papnet.net:make")(3) == (5, 2)
    assert "papnet" in registry.cards()
    assert str(here) not in sys.path[:-1]


@pytest.mark.parametrize(
    ("source", "name", "message"),
    [
        ("def make(k:\n", "broken:make", r"cannot be imported: SyntaxError.*line 1"),
        ("1 / 0\n", "broken:make", r"ZeroDivisionError.*broken.py, line 1"),
        ("import nowhere_at_all\n", "broken:make", "No module named 'nowhere_at_all'"),
        ("make = 3\n", "broken:make", "is a int; expected something to call"),
        ("", "broken:mak", "has no 'mak'"),
        ("", "broken.py:", "not of the form"),
        ("", "./absent.py:make", "no file at absent.py"),
        ("", "absent:make", "no module named 'absent'"),
    ],
)
def test_what_cannot_be_loaded_is_a_sentence(here, source, name, message):
    (here / "broken.py").write_text(source)
    with pytest.raises(InputError, match=message):
        registry.factory_of(name)


@pytest.mark.parametrize("how", [["-m", "partialbench.cli"], ["-c", "from partialbench.cli import "
                                 "main; main()"]])  # fmt: skip
def test_the_command_works_in_a_folder_of_packages_called_as_ours(here, how):
    for name in (*user_code.OURS, "random"):
        (here / name).mkdir()
        (here / name / "__init__.py").write_text("raise RuntimeError('the wrong one')\n")
    ran = subprocess.run(
        [sys.executable, *how, "models", "--json"], cwd=here, capture_output=True, text=True,
        check=False, env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    assert '"papnet"' in ran.stdout


@pytest.mark.parametrize("named", ["", "{here}", "{here}:/elsewhere"])
def test_the_current_folder_is_last_unless_the_path_of_the_user_names_it(tmp_path, named):
    """Called again, as a spawned worker does, it changes nothing more."""
    code = (
        "import os, sys; from partialbench.search_path import current_folder_last as last; last(); "
        "last(); here = os.getcwd(); print(sys.path.count(here), sys.path[-1] == here)"
    )
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    if named:
        environment["PYTHONPATH"] = named.format(here=tmp_path)
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, env=environment, capture_output=True, text=True
    )
    assert done.stdout.split() == ["1", str(not named)], done.stderr
