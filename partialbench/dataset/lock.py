"""Holding a folder, so that two runs never write into one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple, TextIO

from partialbench.errors import InputError, PartialbenchError

NAME, OWNER = ".lock", ".lock.owner"
FILES = (NAME, OWNER)
"""What a lock leaves in a folder."""

_NO_FLOCK = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)
"""How file systems say that they have no ``flock`` (Lustre mounted without, NFS without lockd)."""


class InUseError(PartialbenchError):
    """Another run holds the folder."""


@contextlib.contextmanager
def sole_user(
    folder: Path, doing: str = "writing to", instead: str = "choose another --out"
) -> Iterator[None]:
    """Make the folder and hold it.

    By ``flock``, which ends with the process; where the file system has none, by a file that says
    which process of which machine holds it. That file outlives a run that was killed: one of this
    machine is then taken over, as its process is gone; one of another is named in the error.

    Args:
        doing: what a run does with the folder, for the error.
        instead: what to do where another does so.

    Raises:
        InUseError: another run holds it.
        InputError: it cannot be made or written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        # Appending: who holds it is to be read there. Closed below, after the lock is released.
        lock = open(folder / NAME, "a+", encoding="utf-8")  # noqa: SIM115
    except OSError as error:
        raise InputError(
            f"cannot use {folder} as output folder: {error.strerror}; {instead}"
        ) from error
    busy = _Busy(f"another run is {doing} {folder}", f"wait for it or {instead}")
    with lock:
        otherwise: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise busy.error(_holder(lock)) from None
        except OSError as error:
            if error.errno not in _NO_FLOCK:
                raise PartialbenchError(f"cannot lock {folder}: {error.strerror}") from error
            otherwise = _owned(folder, busy)
        with otherwise:
            lock.truncate(0)
            lock.write(_myself())
            lock.flush()
            yield


class _Busy(NamedTuple):
    """The words of the error."""

    what: str
    advice: str

    def error(self, who: str = "") -> InUseError:
        return InUseError(f"{self.what}{who}; {self.advice}")


def _myself() -> str:
    return json.dumps(
        {"host": socket.gethostname(), "pid": os.getpid(), "started": _started("self")}
    )


def _holder(lock: TextIO) -> str:
    """Which process holds a lock, as far as its file says so, for the error."""
    lock.seek(0)
    try:
        said = json.loads(lock.read())
        return f" (process {int(said['pid'])} on {said['host']})"
    except (OSError, ValueError, KeyError, TypeError):
        return ""


@contextlib.contextmanager
def _owned(folder: Path, busy: _Busy) -> Iterator[None]:
    path = folder / OWNER
    for _ in range(2):
        try:
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            _remove_if_left_behind(folder, path, busy)
            continue
        except OSError as error:
            raise PartialbenchError(f"cannot lock {folder}: {error.strerror}") from error
        with os.fdopen(handle, "w") as file:
            file.write(_myself())
        break
    else:
        raise busy.error()
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _remove_if_left_behind(folder: Path, path: Path, busy: _Busy) -> None:
    """Remove the file of a process of this machine that is gone; else say who holds the folder."""
    try:
        said = path.read_text()
        owner = json.loads(said)
        host, pid, started = owner["host"], int(owner["pid"]), owner.get("started")
    except FileNotFoundError:
        return
    except (OSError, ValueError, KeyError, TypeError):
        host, pid, started, said = "?", 0, None, ""
    if host != socket.gethostname() or not pid:
        raise InUseError(
            f"{folder} is held by process {pid or '?'} on {host} (its file system has no flock). "
            f"If that run is over, remove {path} and give the command again"
        )
    if _started(str(pid)) == started and started is not None:
        raise busy.error(f" (process {pid} on {host})")
    # Two runs may come here at once: only the one whose rename takes the file it has read goes on.
    aside = path.with_name(f"{OWNER}.{os.getpid()}")
    try:
        os.rename(path, aside)
    except OSError:
        return
    taken = aside.read_text()
    if taken != said:
        os.rename(aside, path)
        raise busy.error()
    aside.unlink(missing_ok=True)


def _started(pid: str) -> str | None:
    """When a process began, as Linux counts it: a number given anew is then another process."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except OSError:
        pass
    try:  # no /proc: whether there is one of this number
        os.kill(os.getpid() if pid == "self" else int(pid), 0)
    except ProcessLookupError:
        return None
    except OSError:
        return "running"
    return "running"
