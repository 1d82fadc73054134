"""The docs: every command they show is one, blocks of Python run, the reference is current."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh
import typer
from PIL import Image

from partialbench.benchmark.records import weights
from partialbench.cli import app

ROOT = Path(__file__).resolve().parents[1]
DATED = ("findings",)
"""Pages that say what was run when they were written."""
PAGES = [
    ROOT / "README.md",
    *(page for page in sorted((ROOT / "docs").rglob("*.md")) if page.stem not in DATED),
]
WITH_PYTHON = [
    ROOT / "docs" / f"{page}.md"
    for page in ("index", "how_to/see_a_sample", "how_to/own_meshes", "how_to/dataloader",
                 "how_to/train", "how_to/open_the_board", "how_to/classify", "weights",
                 "data_format")
] + [ROOT / "README.md"]  # fmt: skip
"""In the order in which one makes what the next one reads."""


def blocks(page: Path, language: str) -> list[str]:
    return re.findall(rf"^```{language}\n(.*?)^```", page.read_text(), re.M | re.S)


def commands(page: Path) -> list[list[str]]:
    """The words of every command of ours that a page shows, in blocks of shell and in sentences."""
    text = page.read_text()
    shown = [
        line for block in blocks(page, "sh") for line in block.replace("\\\n", " ").splitlines()
    ]
    inline = re.findall(
        r"`(partialbench [^`]+)`", re.sub(r"^```.*?^```", "", text, flags=re.M | re.S)
    )
    lines = [line for line in (*shown, *inline) if line.startswith("partialbench ")]
    return [shlex.split(line.replace("\n", " "), comments=True) for line in lines]


def parse(words: list[str]) -> None:
    """Raises where a command or an option does not exist, or a value is of another type."""
    command, rest = typer.main.get_command(app), words[1:]
    while rest and rest[0] in getattr(command, "commands", {}):
        command, rest = command.commands[rest[0]], rest[1:]
    if getattr(command, "commands", None):
        assert not rest or rest[0].startswith("-"), f"no command {words}"
        known = {option for parameter in command.params for option in parameter.opts}
        assert {word for word in rest if word.startswith("-")} <= {*known, "--help", "-h"}, words
        return
    if "…" in " ".join(rest) or len(rest) == 0:  # named, not shown
        return
    command.make_context(command.name, rest)


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_every_command_that_is_shown_exists(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for words in commands(page):
        if "--config" in words:
            Path(words[words.index("--config") + 1]).write_text('out = "x"\ndata-set = "pm40"\n')
        try:
            parse(words)
        except Exception as error:  # of Typer, of whichever version
            said = getattr(error, "format_message", lambda error=error: str(error))()
            if "Missing" not in said:  # a part of a command, in a sentence
                raise AssertionError(f"{' '.join(words)}: {said}") from error


def test_the_check_of_commands_can_fail():
    for wrong in ("partialbench rendr x", "partialbench render pm40 --outt x",
                  "partialbench render pm40 --views many"):  # fmt: skip
        with pytest.raises(Exception, match=r"(?i)no |outt|integer"):
            parse(wrong.split())


def test_the_reference_of_commands_is_the_programs(tmp_path):
    page = tmp_path / "commands.md"
    subprocess.run(
        [sys.executable, "-m", "typer", "partialbench.cli.main", "utils", "docs", "--name",
         "partialbench", "--output", str(page)],
        check=True, capture_output=True, cwd=ROOT,
    )  # fmt: skip
    shown = (ROOT / "docs" / "reference" / "commands.md").read_text()
    assert page.read_text() == shown, (
        "make it anew: python -m typer partialbench.cli.main utils docs --name partialbench "
        "--output docs/reference/commands.md"
    )


def test_the_page_of_the_weights_has_what_their_cards_say():
    """``pack_weights --page docs/weights.md`` writes it."""
    cards = {name: weights.read_card(weights.file_of(name)) for name in weights.names()}
    assert weights.block(cards) in (ROOT / "docs" / "weights.md").read_text()


def test_every_page_is_in_the_navigation():
    yaml = pytest.importorskip("yaml")
    site = yaml.safe_load((ROOT / "mkdocs.yml").read_text())
    listed = re.findall(r"[\w/]+\.md", str(site["nav"]))
    assert sorted(listed) == sorted(set(listed))
    pages = {path.relative_to(ROOT / "docs").as_posix() for path in (ROOT / "docs").rglob("*.md")}
    assert pages == set(listed)


def test_links_of_the_site_stay_on_it():
    """The site has nothing but docs/; a file elsewhere is named, not linked."""
    docs = ROOT / "docs"
    for page in docs.rglob("*.md"):
        for target in re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", page.read_text()):
            if not target.startswith(("http:", "https:")):
                place = (page.parent / target).resolve()
                assert place.is_file(), f"{page.name}: {target}"
                assert place.is_relative_to(docs), f"{page.name}: {target}"


def test_every_page_with_python_is_run():
    """But that whose code is a file that is tested: examples/my_model.py."""
    pages = {page for page in PAGES if blocks(page, "python") and page.stem != "own_model"}
    assert pages <= set(WITH_PYTHON)


@pytest.mark.slow
def test_the_picture_of_the_readme_is_what_its_script_draws(tmp_path):
    subprocess.run(
        [sys.executable, str(ROOT / "examples" / "view_picture.py"), "view.png"],
        check=True, cwd=tmp_path, env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    shown, drawn = (
        np.asarray(Image.open(path).convert("L").resize((144, 63)), float)
        for path in (ROOT / "docs" / "images" / "view.png", tmp_path / "view.png")
    )
    assert np.abs(shown - drawn).mean() < 2  # of 255: fonts differ between machines
    assert np.abs(shown - 251).mean() > 5, "it shows something"


@pytest.mark.slow
def test_every_block_of_python_runs(tmp_path, monkeypatch):
    """In one folder, one page after the other; each page by itself in an interpreter of its own."""
    from partialbench.dataset.render import render_dataset

    trimesh.creation.annulus(0.4, 0.5, 1.0).export(tmp_path / "mug.off")
    for split in ("train", "test"):
        for name, solid in (("box", trimesh.creation.box((1, 2, 3))),
                            ("can", trimesh.creation.cylinder(1, 3))):  # fmt: skip
            for number in range(6):
                path = tmp_path / "meshes" / name / split / f"{name}_{split}_{number}.off"
                path.parent.mkdir(parents=True, exist_ok=True)
                solid.apply_scale((1, 1, 1 + number / 10)).export(path)
    render_dataset(
        tmp_path / "meshes", tmp_path / "data" / "pm40", views=4, points=1024,
        occluder_options={"resolution": 48, "keep_depth": True}, normals=True,
    )  # fmt: skip
    for page in WITH_PYTHON:
        code = "\n".join(blocks(page, "python"))
        assert code or page.name == "README.md"
        done = subprocess.run(
            [sys.executable, "-c", code], cwd=tmp_path, capture_output=True, text=True,
            env={**os.environ, "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
                 "HF_HOME": str(tmp_path / "hub")},
        )  # fmt: skip
        assert done.returncode == 0, f"{page.name}: {done.stderr[-2000:]}"
