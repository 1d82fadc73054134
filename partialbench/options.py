"""Options of a model's factory: of the types its parameters have, and plain data.

``symmetry=False`` on the command line is text, and text is true. What an option means is said by
the factory: by the annotation of the parameter, else by the type of its default. A parameter with
neither (or of ``**options``) takes what the text reads as: a number, true, false, none, a JSON list
or object, else text.
"""

from __future__ import annotations

import inspect
import json
import math
import types
import typing
from collections.abc import Callable, Mapping, Sequence
from typing import Any, Literal, Union

from partialbench.errors import InputError

_CONSTANTS = {"true": True, "false": False, "none": None, "null": None}
_ANY = object()


def plain(text: str) -> Any:
    """What a text reads as: JSON, with ``True``, ``False``, ``None`` as Python has them too.

    Raises:
        InputError: NaN or an infinity, which no record can hold.
    """
    if text.lower() in _CONSTANTS:
        return _CONSTANTS[text.lower()]

    def refuse(constant: str) -> Any:
        raise InputError(f"{text!r} holds {constant}; expected finite numbers")

    try:
        value = json.loads(text, parse_constant=refuse)
    except (json.JSONDecodeError, RecursionError):
        return text
    if isinstance(value, float) and not math.isfinite(value):
        refuse(text)
    return value


def is_plain(value: Any, depth: int = 8) -> bool:
    """Whether it is text, a finite number, a truth value, None, or a list or mapping of those."""
    if value is None or isinstance(value, bool | int | str):
        return True
    if isinstance(value, float):
        return math.isfinite(value)
    if depth == 0:
        return False
    if isinstance(value, list | tuple):
        return all(is_plain(item, depth - 1) for item in value)
    return isinstance(value, dict) and all(
        isinstance(k, str) and is_plain(v, depth - 1) for k, v in value.items()
    )


def typed(name: str, factory: Callable[..., Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """The options as their parameters have them, to be stored: lists for tuples, sorted by name.

    Args:
        name: of the model, for errors.
        factory: takes the number of classes first.
        given: text of the command line, or values.

    Raises:
        InputError: an option that the factory has no parameter for, or a value that does not fit
            its type.
    """
    parameters = _parameters(factory)
    found = {}
    for option, value in sorted(given.items()):
        kind, default = _kind_of(name, option, parameters)
        fits = _fit(value, kind)
        if fits is _ANY or not is_plain(fits):
            raise InputError(
                f"{name}: option {option} must be {_words(kind)}, got {value!r}"
                + ("" if default is inspect.Parameter.empty else f" (by default {default!r})")
            )
        found[option] = list(fits) if isinstance(fits, tuple) else fits
    return found


def without_defaults(factory: Callable[..., Any], chosen: Mapping[str, Any]) -> dict[str, Any]:
    """Typed options but those that are what the factory would take anyway: they make no row."""
    if (parameters := _parameters(factory)) is None:
        return dict(chosen)
    kept = {}
    for option, value in chosen.items():
        parameter = parameters[0].get(option)
        default = inspect.Parameter.empty if parameter is None else parameter.default
        default = list(default) if isinstance(default, tuple) else default
        if type(value) is not type(default) or value != default:
            kept[option] = value
    return kept


def as_called(factory: Callable[..., Any], stored: Mapping[str, Any]) -> dict[str, Any]:
    """Stored options as the factory is called with them: a list is a tuple where one is meant."""
    if (parameters := _parameters(factory)) is None:
        return dict(stored)
    called = {}
    for option, value in stored.items():
        parameter = parameters[0].get(option)
        kind = _ANY if parameter is None else _kind(parameter, parameters[2])
        tuples = any(typing.get_origin(one) is tuple or one is tuple for one in _members(kind))
        called[option] = tuple(value) if tuples and isinstance(value, list) else value
    return called


_Parameters = tuple[dict[str, inspect.Parameter], set[str] | None, dict[str, Any]]
"""Those that are options, by name; all names where any other option is taken too, else None; the
resolved annotations."""


def _parameters(factory: Callable[..., Any]) -> _Parameters | None:
    """None for a builtin, which says nothing about itself."""
    try:
        signature = inspect.signature(factory)
    except (TypeError, ValueError):
        return None
    parameters = list(signature.parameters.values())
    kinds = (inspect.Parameter.POSITIONAL_OR_KEYWORD, inspect.Parameter.KEYWORD_ONLY)
    # The first is the number of classes, whatever it is called.
    options = {p.name: p for p in parameters[1:] if p.kind in kinds}
    annotated = factory.__init__ if inspect.isclass(factory) else factory
    try:
        hints = typing.get_type_hints(annotated)
    except Exception:  # names that only a type checker knows: the defaults say what they can
        hints = {}
    more = {p.name for p in parameters if p.kind is p.VAR_KEYWORD}
    # A name that is taken cannot be given again: that of the number of classes.
    return options, {p.name for p in parameters} - more if more else None, hints


def _kind_of(name: str, option: str, parameters: _Parameters | None) -> tuple[Any, Any]:
    """What an option may be, and its default."""
    if parameters is None:
        return _ANY, inspect.Parameter.empty
    options, taken, hints = parameters
    if option in options:
        return _kind(options[option], hints), options[option].default
    if taken is None or option in taken or not option.isidentifier():
        from partialbench.registry import close_matches

        raise InputError(f"{name} has no option {option!r}{close_matches(option, options)}")
    return _ANY, inspect.Parameter.empty


def _kind(parameter: inspect.Parameter, hints: Mapping[str, Any]) -> Any:
    hint = hints.get(parameter.name, _ANY)
    if hint is Any or hint is _ANY:
        default = parameter.default
        hint = _ANY if default is inspect.Parameter.empty or default is None else type(default)
    return hint


def _members(kind: Any) -> tuple[Any, ...]:
    if typing.get_origin(kind) in (Union, types.UnionType):
        return tuple(m for one in typing.get_args(kind) for m in _members(one))
    if typing.get_origin(kind) is typing.Annotated:
        return _members(typing.get_args(kind)[0])
    return (kind,)


_PLAIN_KINDS = (bool, int, float, str, type(None), list, tuple, dict)


def _known(kind: Any) -> bool:
    origin = typing.get_origin(kind) or kind
    return origin is Literal or origin in (*_PLAIN_KINDS, Sequence, Mapping)


def _fit(value: Any, kind: Any) -> Any:
    """The value as a kind has it, ``_ANY`` where it is of no such kind. Text is read."""
    members = _members(kind)
    if not all(map(_known, members)):  # a type of the user's own: plain data is all there is
        return plain(value) if isinstance(value, str) else value
    # Exact kinds first, so that "3" for int | float is 3, and text last, for it takes anything.
    order = (type(None), bool, int, float)
    for member in sorted(members, key=lambda m: order.index(m) if m in order else 5 + (m is str)):
        fitted = _fit_one(value, member)
        if fitted is not _ANY:
            return fitted
    return _ANY


def _fit_one(value: Any, kind: Any) -> Any:
    if kind is str:
        return value if isinstance(value, str) else _ANY
    origin = typing.get_origin(kind) or kind
    if origin is Literal:
        for choice in typing.get_args(kind):
            if _fit_one(value, type(choice)) == choice:
                return choice
        return _ANY
    read = plain(value) if isinstance(value, str) else value
    number = isinstance(read, int | float) and not isinstance(read, bool) and math.isfinite(read)
    if kind is type(None):
        return None if read is None else _ANY
    if kind is bool:
        return read if isinstance(read, bool) else _ANY
    if kind is int:
        return int(read) if number and read == int(read) else _ANY
    if kind is float:
        return float(read) if number else _ANY
    if origin in (dict, Mapping):
        return dict(read) if isinstance(read, Mapping) else _ANY
    if not isinstance(read, list | tuple):
        return _ANY
    inner = [a for a in typing.get_args(kind) if a is not Ellipsis]
    if not inner:
        return list(read)
    kinds = inner if len(inner) == len(read) and origin is tuple and ... not in typing.get_args(
        kind
    ) else [inner[0]] * len(read)  # fmt: skip
    fitted = [_fit(item, one) for item, one in zip(read, kinds, strict=True)]
    return _ANY if any(item is _ANY for item in fitted) else fitted


def _words(kind: Any) -> str:
    """A kind as an error has it: "a whole number", "true or false or none"."""
    names = {
        bool: "true or false", int: "a whole number", float: "a finite number", str: "text",
        type(None): "none", list: "a list", tuple: "a list", dict: "a JSON object",
    }  # fmt: skip
    said = []
    for member in _members(kind):
        origin = typing.get_origin(member) or member
        if origin is Literal:
            said.append("one of " + ", ".join(map(str, typing.get_args(member))))
        elif origin in (list, tuple, Sequence) and typing.get_args(member):
            said.append(f"a list of {_words(typing.get_args(member)[0])}")
        else:
            said.append(names.get(origin, "a list" if origin is Sequence else "plain data"))
    return " or ".join(dict.fromkeys(said))
