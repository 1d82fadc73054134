"""A folder is held by one run, also where the file system has no flock."""

from __future__ import annotations

import errno
import json
import os
import socket
import subprocess
import sys

import pytest

from partialbench.dataset.lock import NAME, OWNER, _started, sole_user
from partialbench.errors import PartialbenchError


@pytest.fixture(params=[errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP])
def no_flock(request, monkeypatch):
    def flock(*_):
        raise OSError(request.param, os.strerror(request.param))

    monkeypatch.setattr("fcntl.flock", flock)


def require_held(folder, message):
    with pytest.raises(PartialbenchError, match=message), sole_user(folder):
        pytest.fail("it was given")


def test_two_runs_cannot_hold_one_folder(tmp_path):
    with sole_user(tmp_path / "new"):
        require_held(tmp_path / "new", "another run is writing to")
        assert [p.name for p in (tmp_path / "new").iterdir()] == [NAME]
    with sole_user(tmp_path / "new"):
        pass


def test_nor_where_there_is_no_flock(tmp_path, no_flock):
    with sole_user(tmp_path):
        require_held(tmp_path, f"another run .* .process {os.getpid()} on")
        assert (tmp_path / OWNER).is_file()
    assert not (tmp_path / OWNER).exists()
    with pytest.raises(KeyError), sole_user(tmp_path):
        raise KeyError
    assert not (tmp_path / OWNER).exists()


def left_by(host: str, pid: int, started: str | None) -> str:
    return json.dumps({"host": host, "pid": pid, "started": started})


def test_what_a_killed_run_of_this_machine_left_is_taken_over(tmp_path, no_flock):
    gone = subprocess.Popen([sys.executable, "-c", ""])
    gone.wait()
    for text in (
        left_by(socket.gethostname(), gone.pid, "123"),
        # The number was given anew: this process began at another time.
        left_by(socket.gethostname(), os.getpid(), "1"),
    ):
        (tmp_path / OWNER).write_text(text)
        with sole_user(tmp_path):
            assert json.loads((tmp_path / OWNER).read_text())["started"] == _started("self")
        assert sorted(p.name for p in tmp_path.iterdir()) == [NAME]


@pytest.mark.parametrize("text", [left_by("elsewhere", 7, "1"), "", "{", "[]"])
def test_another_machines_is_named_with_what_to_do(tmp_path, no_flock, text):
    (tmp_path / OWNER).write_text(text)
    require_held(tmp_path, r"held by process .* on .* remove .*\.lock\.owner")
    assert (tmp_path / OWNER).read_text() == text


def test_other_errors_of_the_lock_are_told(tmp_path, monkeypatch):
    def flock(*_):
        raise OSError(errno.EIO, os.strerror(errno.EIO))

    monkeypatch.setattr("fcntl.flock", flock)
    require_held(tmp_path, r"cannot lock .* Input/output error")
