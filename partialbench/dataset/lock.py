"""Holding a data folder, so that two runs never write into one."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path

from partialbench.errors import PartialbenchError

NAME, OWNER = ".lock", ".lock.owner"
FILES = (NAME, OWNER)
"""What a lock leaves in a folder."""

_NO_FLOCK = (errno.ENOSYS, errno.ENOLCK, errno.EOPNOTSUPP, errno.ENOTSUP, errno.EINVAL)
"""How file systems say that they have no ``flock`` (Lustre mounted without, NFS without lockd)."""


@contextlib.contextmanager
def sole_user(out: Path) -> Iterator[None]:
    """Make the folder and hold it.

    By ``flock``, which ends with the process; where the file system has none, by a file that says
    which process of which machine holds it. That file outlives a run that was killed: one of this
    machine is then taken over, as its process is gone; one of another is named in the error.

    Raises:
        PartialbenchError: another run holds it, or it cannot be written.
    """
    try:
        out.mkdir(parents=True, exist_ok=True)
        lock = open(out / NAME, "w")  # noqa: SIM115 (closed below, after the lock is released)
    except OSError as error:
        raise PartialbenchError(f"cannot use {out} as output folder: {error.strerror}") from error
    with lock:
        otherwise: contextlib.AbstractContextManager[None] = contextlib.nullcontext()
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise _in_use(out) from None
        except OSError as error:
            if error.errno not in _NO_FLOCK:
                raise PartialbenchError(f"cannot lock {out}: {error.strerror}") from error
            otherwise = _owned(out)
        with otherwise:
            yield


@contextlib.contextmanager
def _owned(out: Path) -> Iterator[None]:
    path = out / OWNER
    mine = json.dumps(
        {"host": socket.gethostname(), "pid": os.getpid(), "started": _started("self")}
    )
    for _ in range(2):
        try:
            handle = os.open(path, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644)
        except FileExistsError:
            _remove_if_left_behind(out, path)
            continue
        except OSError as error:
            raise PartialbenchError(f"cannot lock {out}: {error.strerror}") from error
        with os.fdopen(handle, "w") as file:
            file.write(mine)
        break
    else:
        raise _in_use(out)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)


def _remove_if_left_behind(out: Path, path: Path) -> None:
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
        raise PartialbenchError(
            f"{out} is held by process {pid or '?'} on {host} (its file system has no flock). If "
            f"that run is over, remove {path} and give the command again"
        )
    if _started(str(pid)) == started and started is not None:
        raise _in_use(out, f" (process {pid} on {host})")
    # Two runs may come here at once: only the one whose rename takes the file it has read goes on.
    aside = path.with_name(f"{OWNER}.{os.getpid()}")
    try:
        os.rename(path, aside)
    except OSError:
        return
    taken = aside.read_text()
    if taken != said:
        os.rename(aside, path)
        raise _in_use(out)
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


def _in_use(out: Path, who: str = "") -> PartialbenchError:
    return PartialbenchError(
        f"another run is writing to {out}{who}; wait for it or choose another --out"
    )
