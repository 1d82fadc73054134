"""What every command takes: ``--config FILE`` and ``--save-config FILE``.

A configuration is a TOML file with a command's own options as keys, as they are on the command
line but for the dashes: ``num-points = 512`` or ``num_points = 512``. Several commands may share a
file: each then has a table by its name. The command line goes before the file.

What is called the same means the same everywhere: the folder that a command is about stands without
an option, data that it needs besides are ``--data``, records ``--results``, weights
``--checkpoint``, what it writes ``--out``.
"""

from __future__ import annotations

import copy
import functools
import inspect
import json
import re
import tomllib
import typing
from collections.abc import Callable, Mapping
from enum import Enum
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from partialbench import paths
from partialbench.registry import close_matches

_OWN = ("config", "save_config", "help")
_GIVEN = ("COMMANDLINE", "DEFAULT_MAP", "ENVIRONMENT")


EMPTY = "is empty; leave it out, or write . for the current folder"


class _Command(TyperCommand):
    """A command that refuses an argument that is empty.

    Mostly it is a variable of the shell that is not set. Taken for what it says, ``--out ""`` is
    the current folder, and ``--classes ""`` no choice of classes, so that all are made.
    """

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        for before, argument in zip(["", *args], args, strict=False):
            if not argument.strip() or re.fullmatch(r"--[\w-]+=\s*", argument):
                what = argument.rstrip("= ") or (
                    before if before.startswith("-") else "an argument"
                )
                raise typer.BadParameter(f"{what} {EMPTY}", ctx=ctx)
        return super().parse_args(ctx, args)


class Verbs(typer.Typer):
    """A Typer whose commands take a configuration, and stand under one heading of the help."""

    def __init__(self, panel: str | None = None, **kwargs: Any) -> None:
        super().__init__(**kwargs)
        self.panel = panel

    def command(  # type: ignore[override]
        self, *args: Any, panels: Mapping[str, str] | None = None, **kwargs: Any
    ) -> Callable[[Callable], Callable]:
        """As Typer's; the function is returned as it was.

        Args:
            panels: heading of the command's help → the parameters under it, separated by blanks.
                The rest stand under "Options", before them.
        """
        headings = {name: title for title, some in (panels or {}).items() for name in some.split()}
        if self.panel:
            kwargs.setdefault("rich_help_panel", self.panel)
        register = super().command(*args, cls=_Command, **kwargs)

        def decorate(function: Callable) -> Callable:
            register(_configured(function, headings))
            return function

        return decorate


def _configured(function: Callable, headings: Mapping[str, str]) -> Callable:
    hints = typing.get_type_hints(function, include_extras=True)
    parameters = inspect.signature(function).parameters
    assert set(headings) <= set(parameters), f"{function.__name__} has no {headings}"
    for name, parameter in parameters.items():
        hints[name] = _shown(hints[name], headings.get(name), parameter.default is not False)

    @functools.wraps(function)
    def run(context: typer.Context, save_config: Path | None, **options: Any) -> Any:
        options.pop("config")
        if save_config is not None:
            from partialbench.dataset.shards import write_atomically  # NumPy, not by every --help

            write_atomically(_at_home(save_config), as_toml(context).encode())
        return function(**{name: _at_home(value) for name, value in options.items()})

    own = {"context": typer.Context, "config": Config, "save_config": SaveConfig}
    options = [parameter.replace(annotation=hints[name]) for name, parameter in parameters.items()]
    keyword = inspect.Parameter.KEYWORD_ONLY
    added = [
        inspect.Parameter("context", keyword, annotation=typer.Context),
        inspect.Parameter("config", keyword, default=None, annotation=Config),
        inspect.Parameter("save_config", keyword, default=None, annotation=SaveConfig),
    ]
    del run.__wrapped__  # what is called is told by the signature below
    run.__annotations__ = {**hints, **own}
    run.__signature__ = inspect.Signature(options + added)  # type: ignore[attr-defined]
    return run


def _at_home(value: Any) -> Any:
    """Paths as ``paths.path`` has them: no shell may have looked at a leading "~"."""
    if isinstance(value, list):
        return [_at_home(one) for one in value]
    return paths.path(value, "the path") if isinstance(value, Path) else value


def _shown(hint: Any, heading: str | None, with_default: bool) -> Any:
    """An ``Annotated`` option as the help has it; one that commands share stays as it is.

    That a flag is off where it is not given goes without saying.
    """
    kind, *options = typing.get_args(hint)
    options = [copy.copy(one) for one in options]
    for one in options:
        one.rich_help_panel = one.rich_help_panel or heading
        one.show_default = one.show_default if with_default else False
    return Annotated[(kind, *options)]


def _read(context: typer.Context, path: Path | None) -> Path | None:
    """Makes what the file says the defaults of the command's options."""
    if path is None:
        return None
    path = paths.path(path, "--config")
    try:
        content = tomllib.loads(path.read_text("utf-8"))
    except OSError as error:
        raise typer.BadParameter(f"{path} cannot be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise typer.BadParameter(f"{path} is no TOML file: {error}") from error
    context.default_map = {**(context.default_map or {}), **_options(content, context, path)}
    return path


def _options(content: Mapping[str, Any], context: typer.Context, path: Path) -> dict[str, Any]:
    """Parameter → value, from a file for this command or one with a table for each."""
    name = context.command.name or ""
    tables = {key: value for key, value in content.items() if isinstance(value, dict)}
    plain = {key: value for key, value in content.items() if key not in tables}
    if tables and not plain and name not in tables:
        raise typer.BadParameter(f"{path} has no table [{name}]{close_matches(name, tables)}")
    parameters = {key: value for value in _parameters(context) for key in _keys(value)}
    found: dict[str, Any] = {}
    for key, value in {**plain, **tables.get(name, {})}.items():
        parameter = parameters.get(key.replace("-", "_"))
        if parameter is None:
            known = [_keys(one)[0].replace("_", "-") for one in _parameters(context)]
            raise typer.BadParameter(
                f"{path}: {name} has no option {key!r}{close_matches(key, known)}"
            )
        several = getattr(parameter, "multiple", False)
        if (isinstance(value, list) and not several) or isinstance(value, dict):
            raise typer.BadParameter(f"{path}: {key} takes one value, got {value!r}")
        if any(isinstance(one, str) and not one.strip()
               for one in (value if isinstance(value, list) else [value])):  # fmt: skip
            raise typer.BadParameter(f"{path}: {key} {EMPTY}")
        found[parameter.name] = [value] if several and not isinstance(value, list) else value
    return found


def _parameters(context: typer.Context) -> list[Any]:
    return [one for one in context.command.params if one.name not in _OWN]


def _keys(parameter: Any) -> list[str]:
    """What a parameter is called in a file: as its long options without the dashes, or its name."""
    options = [o for o in (*parameter.opts, *parameter.secondary_opts) if o.startswith("--")]
    options = [o for o in options if not o.startswith("--no-")]
    return [o.removeprefix("--").replace("-", "_") for o in options] or [parameter.name]


def as_toml(context: typer.Context) -> str:
    """The options that were given, by the command line or a file, as a file has them."""
    lines = [" ".join(["# partialbench", *_words(context)])]
    for parameter in _parameters(context):
        source = context.get_parameter_source(parameter.name)
        value = context.params.get(parameter.name)
        if source is not None and source.name in _GIVEN and value is not None:
            lines.append(f"{_keys(parameter)[0].replace('_', '-')} = {_toml(value)}")
    return "\n".join(lines) + "\n"


def _words(context: Any) -> list[str]:
    """Of the command as it is typed: "campaign run", whatever the program was started by."""
    return [] if context.parent is None else [*_words(context.parent), context.info_name]


def _toml(value: Any) -> str:
    if isinstance(value, Enum):
        value = value.value
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_toml, value)) + "]"
    if isinstance(value, Path):
        value = str(value)
    # A JSON string is a TOML string, but for DEL and for halves of characters.
    text = json.dumps(value, ensure_ascii=False)
    return text.replace("\x7f", "\\u007f")


Config = Annotated[
    Path | None,
    typer.Option(
        "--config", callback=_read, is_eager=True, rich_help_panel="Configuration file",
        help="TOML file with this command's options; what is given here goes before it",
    ),
]  # fmt: skip
SaveConfig = Annotated[
    Path | None,
    typer.Option(
        "--save-config", rich_help_panel="Configuration file",
        help="write the options given here to such a file, and go on",
    ),
]  # fmt: skip
