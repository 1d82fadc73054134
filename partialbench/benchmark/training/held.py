"""A training's folder is worked on by one process at a time."""

from __future__ import annotations

import contextlib
import errno
import fcntl
import json
import os
import socket
from collections.abc import Iterator
from pathlib import Path
from typing import TextIO

from partialbench.errors import InputError, PartialbenchError

LOCK = ".held.lock"
_UNSUPPORTED = (errno.ENOLCK, errno.ENOSYS, errno.EOPNOTSUPP)


class HeldError(PartialbenchError):
    """Another process works on the same training."""


@contextlib.contextmanager
def hold(folder: Path, first: bool = True) -> Iterator[None]:
    """Makes the folder and holds it while the block runs.

    Of several processes of one training, the ``first`` does.

    The system lets go of a lock when its process dies, however it does. Where a file system has no
    locks, the file says who holds it, and a holder of this host that is dead holds nothing.

    Raises:
        HeldError: another process holds it. InputError: the folder cannot be made or written to.
    """
    if not first:
        yield
        return
    try:
        folder.mkdir(parents=True, exist_ok=True)
        lock = open(folder / LOCK, "a+", encoding="utf-8")  # noqa: SIM115, closed below
    except OSError as error:
        raise InputError(
            f"{folder} cannot be made or written to: {error.strerror}; choose another --results"
        ) from error
    with lock:
        locks = True
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError as error:
            locks = error.errno not in _UNSUPPORTED
            if locks:
                raise _held(folder, _holder(lock)) from error
        holder = _holder(lock)
        if not locks and _is_alive(holder):
            raise _held(folder, holder)
        lock.truncate(0)
        json.dump({"pid": os.getpid(), "host": socket.gethostname()}, lock)
        lock.flush()
        try:
            yield
        finally:
            lock.truncate(0)


def _holder(lock: TextIO) -> dict[str, object]:
    """What the file says of who holds it, {} where it says nothing that can be read."""
    lock.seek(0)
    try:
        said = json.loads(lock.read())
    except (ValueError, UnicodeDecodeError):
        return {}
    return said if isinstance(said, dict) else {}


def _is_alive(holder: dict[str, object]) -> bool:
    """Whether a holder may be at work: one of another host may always be."""
    pid = holder.get("pid")
    if not isinstance(pid, int) or pid == os.getpid():
        return False
    if holder.get("host") != socket.gethostname():
        return True
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True


def _held(folder: Path, holder: dict[str, object]) -> HeldError:
    who = f"process {holder['pid']} on {holder.get('host')}" if "pid" in holder else "a process"
    return HeldError(
        f"{folder} is being worked on by {who}: wait for it and run the same command, "
        f"or choose another --results folder or other seeds. If that host is gone, "
        f"delete {folder / LOCK}"
    )
