"""Configuration files: a command's own options by their names, the command line before them."""

from __future__ import annotations

import inspect
import subprocess
import sys
import tomllib
import typing
from enum import StrEnum
from pathlib import Path
from typing import Annotated

import pytest
import typer
from typer.testing import CliRunner

from partialbench.cli import app
from partialbench.cli.verbs import Verbs

commands = Verbs("Panel")


class Colour(StrEnum):
    red = "red"
    blue = "blue"


@commands.command()
def paint(
    folder: Annotated[Path, typer.Argument()],
    num_points: Annotated[int, typer.Option()] = 3,
    colour: Annotated[Colour, typer.Option()] = Colour.red,
    tries: Annotated[list[str] | None, typer.Option("--try")] = None,
    as_json: Annotated[bool, typer.Option("--json")] = False,
    shiny: Annotated[bool, typer.Option()] = False,
    rate: Annotated[float | None, typer.Option()] = None,
) -> None:
    """Paint."""
    print((str(folder), num_points, colour.value, tries, as_json, shiny, rate))


@commands.command()
def keep(out: Annotated[list[Path] | None, typer.Option()] = None) -> None:
    """Keep."""
    print([str(path) for path in out or []])


@commands.command()
def other() -> None:
    """Another."""


def run(*arguments, code=0):
    done = CliRunner().invoke(commands, [str(a) for a in arguments])
    assert done.exit_code == code, done.output
    return " ".join(done.output.replace("│", " ").split())


def test_a_file_has_the_options_by_their_names_and_the_command_line_goes_before_it(tmp_path):
    file = tmp_path / "paint.toml"
    file.write_text(
        'folder = "wall"\nnum-points = 7\ncolour = "blue"\ntry = ["a", "b"]\njson = true\n'
        "shiny = true\nrate = 0.5\n"
    )
    everything = "('wall', 7, 'blue', ['a', 'b'], True, True, 0.5)"
    assert run("paint", "--config", file) == everything
    assert run("paint", "fence", "--config", file, "--num-points", 9, "--no-shiny") == (
        "('fence', 9, 'blue', ['a', 'b'], True, False, 0.5)"
    )
    file.write_text('num_points = 8\ntry = "one"\n[paint]\nfolder = "door"\n[other]\n')
    assert run("paint", "--config", file) == "('door', 8, 'red', ['one'], False, False, None)"


def test_what_was_given_is_saved_and_read_back(tmp_path):
    file, again = tmp_path / "a.toml", tmp_path / "b.toml"
    given = ("--num-points", 5, "--try", 'x="1,2"', "--try", "é\\", "--colour", "blue", "--json")
    first = run("paint", "my wall", *given, "--rate", "1e-3", "--save-config", file)
    assert file.read_text().startswith("# partialbench paint\n")
    saved = tomllib.loads(file.read_text())
    assert saved == {
        "folder": "my wall", "num-points": 5, "try": ['x="1,2"', "é\\"], "colour": "blue",
        "json": True, "rate": 0.001,
    }  # fmt: skip
    assert run("paint", "--config", file, "--save-config", again) == first
    assert tomllib.loads(again.read_text()) == saved


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("num_pionts = 3", "paint has no option 'num_pionts'; did you mean num-points?"),
        ("num-points = 'many'", "integer"),
        ("num-points = [1, 2]", "num-points takes one value, got [1, 2]"),
        ("colour = 'green'", "green"),
        ("x =", "is no TOML file"),
        ("[pant]\nnum-points = 1", "has no table [paint]; did you mean pant?"),
        ("config = 'x'", "has no option 'config'"),
    ],
)
def test_a_wrong_file_is_wrong_usage(tmp_path, content, message):
    file = tmp_path / "c.toml"
    file.write_text(content)
    assert message in run("paint", "wall", "--config", file, code=2)
    assert "cannot be read" in run("paint", "wall", "--config", tmp_path / "absent.toml", code=2)


SEVERAL = {
    "model",  # needed, or several, or only for weights of one's own
    "data",  # needed, or optional, or several
    "clouds", "split",  # one, or several
    "counts",  # of a data set as large as the real one, or of a folder to look into
    "checkpoint",  # predict has one of its own
    "workers",  # of a campaign as many as there are devices
    "data_set",  # needed, or optional
}  # fmt: skip
"""Needed by one command and not by another, or given several times to one and once to another."""


def functions(group):
    for one in group.registered_commands:
        yield one.callback
    for inner in group.registered_groups:
        yield from functions(inner.typer_instance)


def walk(command, name=""):
    inner = getattr(command, "commands", None)
    if inner is None:
        yield name, command
    else:
        for word, one in inner.items():
            yield from walk(one, f"{name} {word}".strip())


def test_every_command_takes_one():
    found = dict(walk(typer.main.get_command(app)))
    assert {"render", "eval", "campaign run", "export", "doctor"} <= found.keys()
    for name, command in found.items():
        options = {option for parameter in command.params for option in parameter.opts}
        assert {"--config", "--save-config"} <= options, name


def test_an_option_is_of_one_kind_with_one_default_in_every_command():
    seen: dict[str, dict[str, set[str]]] = {}
    for function in functions(app):
        for name, parameter in inspect.signature(function).parameters.items():
            if name not in ("context", "out"):  # each writes its own
                kind = str(typing.get_args(parameter.annotation)[:1])
                default = parameter.default
                said = kind if default is parameter.empty else f"{kind} = {default!r}"
                seen.setdefault(name, {}).setdefault(said, set()).add(function.__name__)
    several = {name for name, kinds in seen.items() if len(kinds) > 1}
    assert several == SEVERAL, {name: seen[name] for name in several ^ SEVERAL}


def test_no_help_leaves_a_default_unsaid_in_brackets_of_its_own():
    for name, command in walk(typer.main.get_command(app)):
        for parameter in command.params:
            assert not (parameter.help or "").endswith("]"), f"{name} {parameter.name}"
            assert "default" not in (parameter.help or ""), f"{name} {parameter.name}"


def test_long_helps_are_grouped():
    for name, command in walk(typer.main.get_command(app)):
        plain = [p for p in command.params if not getattr(p, "rich_help_panel", None)]
        assert len(plain) <= 12, f"{name}: {len(plain)} options under one heading"


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["rendr"], "error: No such command 'rendr'"),
        (["render", "pm99", "--out", "x"], "error: Invalid value for 'data_set'"),
        (["verify"], "error: Missing argument"),
        (["export", "absent", "--to", "parquet", "--out", "x"],
         "error: absent is not a data folder: it has no manifest.json."),
    ],
)  # fmt: skip
def test_an_error_is_one_line_in_a_pipe(tmp_path, arguments, message):
    done = subprocess.run(
        [sys.executable, "-m", "partialbench.cli", *arguments],
        capture_output=True, text=True, cwd=tmp_path,
    )  # fmt: skip
    assert done.returncode == (1 if arguments[0] == "export" else 2)
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert message in line


def test_help_has_a_short_name_and_a_heading_for_each_stage():
    done = CliRunner().invoke(app, ["-h"])
    assert done.exit_code == 0
    for words in ("Data", "Models", "Tables", "For others", "--install-completion"):
        assert words in done.output


def test_an_empty_argument_is_no_argument_and_no_current_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for wrong, words in (
        (("paint", ""), "an argument is empty"),
        (("paint", "wall", "--try", ""), "--try is empty"),
        (("paint", "wall", "--try="), "--try is empty"),
        (("keep", "--out", "c", "--out", " "), "--out is empty"),
        (("keep", "--save-config", ""), "--save-config is empty"),
    ):
        assert words in run(*wrong, code=2)
    file = tmp_path / "keep.toml"
    for content in ('out = ""', 'out = ["a", " "]'):
        file.write_text(content)
        assert "out is empty; leave it out, or write . for" in run(
            "keep", "--config", "keep.toml", code=2
        )
    done = CliRunner().invoke(app, ["shapes", "--out", "", "--counts", "1,1"])
    assert done.exit_code == 2
    assert list(tmp_path.iterdir()) == [file]
    assert run("keep", "--out", ".") == "['.']"
    assert run("paint", "wall", "--try", "a=", "--try", "b= c")[:20] == "('wall', 3, 'red', ["


def test_a_tilde_is_the_home_folder(tmp_path, monkeypatch):
    """No shell has looked at ``--out=~/x``, or at a file."""
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.chdir(tmp_path)
    (tmp_path / "keep.toml").write_text('out = ["~/a", "b/~"]\n')
    assert run("keep", "--config", "~/keep.toml") == f"['{tmp_path}/a', 'b/~']"
    assert run("keep", "--out=~", "--save-config", "~/saved.toml") == f"['{tmp_path}']"
    assert run("keep", "--config", "saved.toml") == f"['{tmp_path}']"
    assert {path.name for path in tmp_path.iterdir()} == {"keep.toml", "saved.toml"}
    done = CliRunner().invoke(commands, ["keep", "--out", "~no_such_user_here/x"])
    assert "~no_such_user_here/x' begins with a home folder" in str(done.exception)
