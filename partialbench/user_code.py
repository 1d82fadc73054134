"""A user's own "module:factory": found where they stand, loaded under a name of its own.

A file called ``random.py`` or ``baselines/net.py`` is thus neither hidden by the package of that
name nor hides it. What is executed is what was hashed: the source is read once, and no byte code
kept from an earlier run is used.
"""

from __future__ import annotations

import hashlib
import importlib
import importlib.util
import os
import sys
import traceback
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, PathFinder, SourceFileLoader
from pathlib import Path
from types import ModuleType
from typing import Any

from partialbench.errors import InputError

_PREFIX = "_partialbench_own_"
_DIGEST = "__partialbench_source_sha256__"


def is_own(name: str) -> bool:
    """Whether a model's name is a user's "module:factory", not a registered one.

    Raises:
        InputError: what is no name at all, such as the factory itself.
    """
    if not isinstance(name, str):
        raise InputError(f"a model is named by a text such as 'my_model:make', got {name!r}")
    return ":" in name


def named(name: str) -> str:
    """The name that stands in records: a file under the current folder is told from there."""
    if not is_own(name):
        return name
    module, _, factory = name.rpartition(":")
    if not _is_file(module):
        return name
    path = Path(os.path.normpath(module))
    if path.is_absolute() and path.is_relative_to(Path.cwd()):
        path = path.relative_to(Path.cwd())
    return f"{path.as_posix()}:{factory}"


def find(name: str) -> Path | None:
    """The file a "module:factory" is in, looked for from the current folder; imports nothing.

    None where it can only be an installed module.

    Raises:
        InputError: not of that form, or a path at which there is no file.
    """
    module, _, factory = name.rpartition(":")
    if not module or not factory:
        raise InputError(
            f"{name!r} is not of the form module:object, e.g. my_model:make or ./my-net.py:make"
        )
    if _is_file(module):
        path = Path(module)
        if not path.is_file():
            raise InputError(f"no file at {path} (from {name!r})")
        return path.absolute()
    bare = Path.cwd().joinpath(*module.split("."))
    for path in (bare / "__init__.py", bare.with_name(bare.name + ".py")):
        if path.is_file():
            return path
    return None


def load(name: str) -> Any:
    """The object behind a user's "module:factory".

    Raises:
        InputError: no such file or module, one that fails on being imported, or no such object.
    """
    module, attribute = _module(name), name.rpartition(":")[2]
    try:
        return getattr(module, attribute)
    except AttributeError:
        from partialbench.registry import close_matches

        near = close_matches(attribute, [n for n in dir(module) if not n.startswith("_")])
        raise InputError(f"module {name.rpartition(':')[0]!r} has no {attribute!r}{near}") from None


def digest(name: str) -> str:
    """SHA-256 (hex) of the file behind a user's "module:factory" as it was imported.

    Of that file alone: what it imports is not followed. "" where a module has no file.
    """
    module = _module(name)
    if _DIGEST not in vars(module):  # imported by someone else, before
        file = getattr(module, "__file__", None)
        sha256 = hashlib.sha256(Path(file).read_bytes()).hexdigest() if file else ""
        setattr(module, _DIGEST, sha256)
    return str(vars(module)[_DIGEST])


def digest_of_file(name: str) -> str:
    """The same of the file as it is now; imports nothing. "" where only an import would find it."""
    path = find(name)
    return "" if path is None else hashlib.sha256(path.read_bytes()).hexdigest()


def where(error: BaseException) -> str:
    """The last line of code an error came through: "my_model.py, line 7"."""
    frames = traceback.extract_tb(error.__traceback__)
    if isinstance(error, SyntaxError) and error.filename:
        return f"{Path(error.filename).name}, line {error.lineno}"
    return f"{Path(frames[-1].filename).name}, line {frames[-1].lineno}" if frames else "no line"


def _is_file(module: str) -> bool:
    return module.endswith(".py") or "/" in module or os.sep in module


def _module(name: str) -> ModuleType:
    module_name, path = name.rpartition(":")[0], find(name)
    try:
        if path is None:
            return importlib.import_module(module_name)
        known = sys.modules.get(module_name)
        if known is not None and getattr(known, "__file__", None) == str(path):
            return known
        # Its neighbours can be imported too, after everything that is installed.
        folder = path.parent if _is_file(module_name) else Path.cwd()
        if str(folder) not in sys.path:
            sys.path.append(str(folder))
        root = _root(folder)
        if not _is_file(module_name):
            return importlib.import_module(f"{root}.{module_name}")
        return _from_file(f"{root}.{path.stem.replace('.', '-')}", path)
    except ModuleNotFoundError as error:
        if path is None and error.name and (module_name + ".").startswith(error.name + "."):
            raise InputError(
                f"no module named {error.name!r} (from {name!r}); "
                f"run from the folder that holds it, or install it"
            ) from error
        raise InputError(f"{name} cannot be imported: {error} ({where(error)})") from error
    except InputError:
        raise
    except Exception as error:  # whatever a user's file does when it is run
        raise InputError(
            f"{name} cannot be imported: {type(error).__name__}: {error} ({where(error)})"
        ) from error


def _root(folder: Path) -> str:
    """The package of our own naming that stands for a folder; its modules are the folder's."""
    name = _PREFIX + hashlib.sha256(str(folder).encode()).hexdigest()[:12]
    if name not in sys.modules:
        package = ModuleType(name)
        package.__path__ = [str(folder)]
        sys.modules[name] = package
    if not any(isinstance(finder, _OwnFinder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OwnFinder())
    importlib.invalidate_caches()  # a file may have been written a moment ago
    return name


def _from_file(name: str, path: Path) -> ModuleType:
    if name in sys.modules:
        return sys.modules[name]
    loader = _HashedSource(name, str(path))
    spec = importlib.util.spec_from_loader(name, loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module
    try:
        loader.exec_module(module)
    except BaseException:
        del sys.modules[name]
        raise
    return module


class _HashedSource(SourceFileLoader):
    """Runs the source that it read and hashed."""

    def exec_module(self, module: ModuleType) -> None:
        source = Path(self.path).read_bytes()
        vars(module)[_DIGEST] = hashlib.sha256(source).hexdigest()
        exec(compile(source, self.path, "exec", dont_inherit=True), vars(module))


class _OwnFinder(MetaPathFinder):
    """Python's own search, with that loader, for what stands under our prefix."""

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if not fullname.startswith(_PREFIX):
            return None
        spec = PathFinder.find_spec(fullname, path, target)
        if spec is not None and isinstance(spec.loader, SourceFileLoader):
            spec.loader = _HashedSource(fullname, spec.loader.path)
        return spec


OURS = ("baselines", "leaderboard", "papnet", "renderers")


class _OursFirst(MetaPathFinder):
    """The packages that come with this one are found beside it, whatever stands on the path."""

    def __init__(self, home: Path) -> None:
        self.home = str(home)

    def find_spec(self, fullname: str, path: Any, target: Any = None) -> ModuleSpec | None:
        if fullname in OURS:
            return PathFinder.find_spec(fullname, [self.home], target)
        return None


def ours_first() -> None:
    """From now on a package of the user's own called as one of ours does not stand in for it.

    Raises:
        InputError: one was imported already.
    """
    home = Path(__file__).resolve().parents[1]
    if not any(isinstance(finder, _OursFirst) for finder in sys.meta_path):
        sys.meta_path.insert(0, _OursFirst(home))
    for name in OURS:
        known = sys.modules.get(name)
        file = getattr(known, "__file__", None)
        if known is not None and file and Path(file).resolve().parent != home / name:
            raise InputError(
                f"the package {name!r} of {Path(file).parent} was imported before this project's "
                f"of the same name; rename it"
            )
