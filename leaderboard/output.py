"""The folder a board is written to: what an earlier board left there and this one lacks goes.

Only files that a board wrote, of which it keeps a list: what others put there is left as it is.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import Mapping
from pathlib import Path, PurePosixPath

from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.errors import InputError

LIST = ".board-files.json"


def write_board(out: Path, contents: Mapping[str, bytes]) -> list[Path]:
    """Writes the files (path within ``out`` → bytes) and removes an earlier board's others.

    Returns:
        the paths written.

    Raises:
        InputError: the folder cannot be made, or has files of others where the board's would go.
    """
    make_folder(out)
    earlier = _listed(out)
    taken = sorted(name for name in contents.keys() - earlier if (out / name).exists())
    if taken:
        raise InputError(
            f"{out} has files of such names that no board wrote: {', '.join(taken[:5])}. Choose "
            f"another folder, or delete them"
        )
    # All that may be there, before anything is: an interruption loses track of nothing.
    _write_list(out, earlier | contents.keys())
    for name, content in contents.items():
        make_folder((out / name).parent)
        write_atomically(out / name, content)
    for name in earlier - contents.keys():
        (out / name).unlink(missing_ok=True)
        with contextlib.suppress(OSError):  # not empty: it holds what others put there
            if (folder := (out / name).parent) != out:
                folder.rmdir()
    _write_list(out, set(contents))
    return [out / name for name in contents]


def _write_list(out: Path, names: set[str]) -> None:
    write_atomically(out / LIST, (json.dumps(sorted(names), indent=0) + "\n").encode())


def _listed(out: Path) -> set[str]:
    """What the list names, as far as it lies within the folder."""
    try:
        names = json.loads((out / LIST).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return set()
    if not isinstance(names, list):
        return set()
    return {
        name
        for name in names
        if isinstance(name, str)
        and not PurePosixPath(name).is_absolute()
        and ".." not in PurePosixPath(name).parts
        and not (out / name).is_dir()
    }
