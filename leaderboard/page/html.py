"""The page as one HTML file that asks no other host for anything."""

from __future__ import annotations

import base64
import hashlib
import json
from pathlib import Path
from typing import Any

import jinja2

from leaderboard.page.content import Found, content
from partialbench.dataset import samples

FOLDER = Path(__file__).parent
VIEWER = Path(samples.__file__).with_name("viewer.js")
SCRIPTS = (
    "elements.js", "charts.js", "state.js", "columns.js", "table.js", "details.js", "clouds.js",
    "main.js",
)  # fmt: skip
"""In this order, after the viewer, they make one script."""


def as_html(found: Found, folder: Path) -> str:
    """The page.

    Style and script are allowed by their digests, and nothing else is: what a record or a user's
    model says can run nothing.

    Args:
        folder: of the records, with their predictions.
    """
    return render(content(found, folder))


def render(data: dict[str, Any]) -> str:
    """The page of some ``content``."""
    style = (FOLDER / "style.css").read_text(encoding="utf-8")
    scripts = [VIEWER, *(FOLDER / name for name in SCRIPTS)]
    script = "\n".join(path.read_text(encoding="utf-8") for path in scripts)
    # Jinja ends a file with no newline, and a digest is of every byte.
    style, script = f"\n{style.strip()}\n", f'\n"use strict";\n{script.strip()}\n'
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    template = environment.from_string((FOLDER / "page.html.jinja").read_text(encoding="utf-8"))
    return template.render(
        style=style,
        script=script,
        policy=(
            f"default-src 'none'; style-src {_source(style)}; script-src {_source(script)}; "
            "img-src data:; base-uri 'none'; form-action 'none'"
        ),
        picture=(FOLDER / "picture.svg").read_text(encoding="utf-8"),
        # "</script" would end the element, whatever the quotes around it.
        data=json.dumps(data, separators=(",", ":"), ensure_ascii=False, allow_nan=False).replace(
            "<", "\\u003c"
        ),
    )


def _source(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"
