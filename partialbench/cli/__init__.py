"""The command line, a file a stage of the data."""

from partialbench.cli.main import app, main

__all__ = ["app", "main"]
