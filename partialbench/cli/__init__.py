"""The command line, a file a stage of the data."""

import sys

from partialbench.search_path import current_folder_last

# Run by ``python -m`` or ``-c``, the current folder comes first on the path: a user's
# random.py there would be imported by all that follows here.
if sys.argv[:1] in (["-m"], ["-c"]):
    current_folder_last()

from partialbench.cli.main import app, main

__all__ = ["app", "main"]
