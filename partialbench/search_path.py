"""Where Python looks for modules. It imports next to nothing: it is what the rest is found by."""

from __future__ import annotations

import os
import sys


def current_folder_last() -> None:
    """Moves the current folder from the front of the path, where ``python -m`` has it, to its end.

    A user's ``random.py`` there must not become everyone's.
    """
    here = os.getcwd()
    if sys.path and sys.path[0] in ("", here):
        del sys.path[0]
    if here not in sys.path:
        sys.path.append(here)
