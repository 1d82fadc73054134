"""Where Python looks for modules. It imports next to nothing: it is what the rest is found by."""

from __future__ import annotations

import os
import sys


def current_folder_last() -> None:
    """Moves the current folder from the front of the path, where ``python -m`` has it, to its end.

    A user's ``random.py`` there must not become everyone's. Where ``PYTHONPATH`` names the folder
    it is meant, and stays once: so it may be the tree that all of this is to be imported from.
    """
    here = os.getcwd()
    meant = "PYTHONPATH" in os.environ and here in map(
        os.path.abspath, os.environ["PYTHONPATH"].split(os.pathsep)
    )
    if sys.path and sys.path[0] in ("", here) and not (meant and sys.path.count(here) == 1):
        del sys.path[0]
    if here not in sys.path:
        sys.path.append(here)
