"""The campaign file: a TOML file that declares data sets, trainings, trials and tests.

    results = "records"            # records go here, and are read from here
    work = "../runs/board"         # data, trunks and logs: may be thrown away, are made again
    board = "../docs/board"        # optional: tables and page, made anew after a run
    preset = "board"

    [data.shapes]
    render = "pm40 --counts modelnet40 --views 10"       # what follows `partialbench render`
    digests = {train = "3f…", test = "a0…"}              # optional: what it must come out as

    [data.clouds]
    render = "pm40 --source ${MODELNET40_CLOUDS}"         # waits until the variable is set

    [data.grid]
    render = "pm40 --counts modelnet40"
    grid = "grid.toml"             # a data folder for each cell of it, see ``dataset.grid``

    [[train]]
    models = ["pointnet", "papnet"]
    data = ["shapes"]
    clouds = ["25k", "50k"]        # milestones
    seeds = 3                      # how many from 0, or a list
    test = ["clouds"]              # other data sets to test on as well
    points = [64]                  # tests on fewer points; poses = ["0", "15"]: with the pose given
    damages = ["all"]              # tests on damaged clouds; ["jitter:3"]
    grids = ["grid"]               # tests on every cell of these
    options = {grid = 16}          # of the model; recipe = {lr = 0.002}; precision = "bf16-mixed"
    protocol = {stretch = 1.25}    # fields of the preset to change: another protocol, other columns

    [[tune]]
    models = ["pointnet"]
    data = ["shapes"]
    clouds = ["50k"]
    tries = [{lr = 0.001}, {lr = 0.002}]

Paths are relative to the file; a model of one's own ("my_net:make") is looked for from the current
folder. An entry may say one model, data set or milestone without brackets.
"""

from __future__ import annotations

import os
import re
import shlex
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from partialbench import registry, user_code
from partialbench.benchmark import preflight
from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.testing import damage, given_pose
from partialbench.dataset import grid as grid_files
from partialbench.errors import InputError
from partialbench.registry import ModelCard, close_matches

TOP = ("results", "work", "board", "preset", "data", "train", "tune")
DATA = ("render", "digests", "made_by", "grid")
COMMON = ("models", "data", "clouds", "options", "recipe", "precision", "protocol")
TRAIN = (*COMMON, "seeds", "test", "points", "poses", "damages", "grids")
TUNE = (*COMMON, "tries", "seed")


@dataclass(frozen=True)
class DataSet:
    """One data folder of a campaign, or a grid: a folder of such folders.

    Attributes:
        name: as the file calls it.
        folder: where it is or will be.
        render: the arguments of ``partialbench render`` but for ``--out``.
        cells: of a grid, the names of its cells; () for a data folder.
        command: ``render`` as the file has it, variables by their names.
        digests: split → digest that its content must have; {} where the file declares none.
        made_by: what the file says made those, "" for nothing.
        missing: names of environment variables in ``render`` that are not set.
    """

    name: str
    folder: Path
    render: tuple[str, ...]
    digests: Mapping[str, str] = field(default_factory=dict)
    made_by: str = ""
    missing: tuple[str, ...] = ()
    cells: tuple[str, ...] = ()
    command: str = ""

    @property
    def note(self) -> Path:
        """Beside the folder: the command that it was made by."""
        return self.folder.with_name(f"{self.name}.render")

    @property
    def folders(self) -> dict[str, Path]:
        """The data folders: of each cell by its name, or the one by ""."""
        return {cell: self.folder / cell for cell in self.cells} or {"": self.folder}


@dataclass(frozen=True)
class Entry:
    """One ``[[train]]`` or ``[[tune]]`` of the file, every name in it known.

    Attributes:
        kind: "train" or "tune". data, test: names of data sets. grids: of those that are grids.
        clouds: milestones, ascending. seeds: one or more.
        protocol: fields of the preset to change.
        tries: of a "tune", fields of the recipe to change, one mapping a trial.
    """

    kind: str
    models: tuple[str, ...]
    data: tuple[str, ...]
    clouds: tuple[int, ...]
    options: Mapping[str, Any]
    recipe: Mapping[str, Any]
    precision: str
    protocol: Mapping[str, Any]
    seeds: tuple[int, ...]
    test: tuple[str, ...] = ()
    points: tuple[int, ...] = ()
    poses: tuple[str, ...] = ()
    tries: tuple[Mapping[str, Any], ...] = ()
    damages: tuple[str, ...] = ()
    grids: tuple[str, ...] = ()


@dataclass(frozen=True)
class Campaign:
    """A campaign file that holds together: see the module's text."""

    path: Path
    results: Path
    work: Path
    board: Path | None
    preset: str
    data: Mapping[str, DataSet]
    entries: tuple[Entry, ...]


def load(path: Path | str) -> Campaign:
    """Reads and checks a campaign file.

    Raises:
        InputError: no such file, not TOML, or anything in it that is unknown or out of range: the
            line, what was found and what was expected.
    """
    path = Path(path)
    try:
        text = path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise InputError(f"{path} is not a readable campaign file: {error}") from error
    try:
        content = tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise InputError(f"{path} is not TOML: {error}") from error
    return _Reader(path, text).campaign(content)


class _Reader:
    """The checks of one file; every complaint names the file and, where it can be found, the line.

    TOML's parser does not say where a value stood, so the line is searched for: a name that is
    unknown is hardly ever written twice.
    """

    def __init__(self, path: Path, text: str) -> None:
        self.path, self.lines = path, text.splitlines()

    def campaign(self, content: Mapping[str, Any]) -> Campaign:
        self.known(content, TOP, "the file")
        here = self.path.resolve().parent
        work = here / self.text(content.get("work", f"{self.path.stem}-work"), "work")
        preset = self.text(content.get("preset", protocols.DEFAULT_PRESET), "preset")
        if preset not in protocols.PRESETS:
            raise self.wrong(preset, f"no preset named {preset!r}", protocols.PRESETS)
        data = {
            name: self.data_set(name, fields, work)
            for name, fields in self.table(content.get("data", {}), "data").items()
        }
        entries = [
            self.entry(kind, fields, data, preset)
            for kind in ("train", "tune")
            for fields in self.tables(content.get(kind, []), kind)
        ]
        if not entries:
            raise InputError(f"{self.path} declares no run; give it a [[train]] section")
        board = content.get("board")
        return Campaign(
            self.path,
            here / self.text(content.get("results", "records"), "results"),
            work,
            None if board is None else here / self.text(board, "board"),
            preset,
            data,
            tuple(entries),
        )

    def data_set(self, name: str, fields: Any, work: Path) -> DataSet:
        fields = self.table(fields, f"data.{name}")
        self.known(fields, DATA, f"[data.{name}]")
        if not re.fullmatch(r"[A-Za-z0-9][A-Za-z0-9._-]*", name):
            raise self.wrong(name, f"{name!r} names a folder: letters, digits, . _ - only")
        if "render" not in fields:
            raise self.wrong(name, f"[data.{name}] needs render, the arguments of that command")
        command = self.text(fields["render"], "render")
        try:
            parts = shlex.split(command)
        except ValueError as error:
            raise self.wrong(
                "render", f"render of [data.{name}]: {error} in {command!r}"
            ) from error
        missing = tuple(v for v in re.findall(r"\$\{(\w+)\}", command) if v not in os.environ)
        arguments = tuple(
            re.sub(r"\$\{(\w+)\}", lambda m: os.environ.get(m[1], m[0]), part) for part in parts
        )
        if "--out" in arguments:
            raise self.wrong("--out", "render must not say --out: the folder is the campaign's own")
        cells = self.cells(name, fields, arguments)
        if cells:
            arguments += "--grid", str(self.path.resolve().parent / fields["grid"])
        digests = self.table(fields.get("digests", {}), "digests")
        self.known(digests, ("train", "test"), "digests")
        for split, digest in digests.items():
            if not re.fullmatch(r"[0-9a-f]{64}", str(digest)):
                raise self.wrong(
                    str(digest), f"the {split} digest is {digest!r}; expected 64 digits 0-9, a-f"
                )
        return DataSet(
            name, work / "data" / name, arguments, dict(digests),
            self.text(fields.get("made_by", ""), "made_by"), missing, cells, command,
        )  # fmt: skip

    def cells(self, name: str, fields: Mapping[str, Any], render: Sequence[str]) -> tuple[str, ...]:
        """The names of a grid's cells, () of a data set that is none."""
        if "--grid" in render:
            raise self.wrong("--grid", f'[data.{name}] says its grid by grid = "FILE.toml"')
        if "grid" not in fields:
            return ()
        if "digests" in fields:
            raise self.wrong("digests", f"[data.{name}] is a grid, which declares no digests")
        path = self.path.resolve().parent / self.text(fields["grid"], "grid")
        try:
            return tuple(cell.name for cell in grid_files.load(path))
        except InputError as error:
            raise self.wrong("grid", f"[data.{name}]: {error}") from error

    def entry(self, kind: str, fields: Any, data: Mapping[str, DataSet], preset: str) -> Entry:
        self.known(fields, TRAIN if kind == "train" else TUNE, f"[[{kind}]]")
        for name in ("models", "data", "clouds", *(["tries"] if kind == "tune" else [])):
            if name not in fields:
                raise self.wrong(f"[[{kind}]]", f"a [[{kind}]] needs {name}")
        models = self.several(fields["models"], str, "models")
        recipe = dict(self.table(fields.get("recipe", {}), "recipe"))
        changes = dict(self.table(fields.get("protocol", {}), "protocol"))
        try:
            protocol = protocols.protocol(preset, **changes)
        except InputError as error:
            raise self.wrong("protocol", str(error)) from error
        # What the preset has anyway is no change: such an entry's trainings are the preset's own.
        own_fields, followed = protocols.PRESETS[preset].as_dict(), protocol.as_dict()
        changes = {name: followed[name] for name in changes if followed[name] != own_fields[name]}
        tries = self.tables(fields.get("tries", []), "tries")
        for model in models:
            try:
                preflight.check_model(model)
                own = recipes.of_protocol(card_of(model), protocol)
                for tried in (recipe, *tries):
                    recipes.override(own, tried)
            except InputError as error:
                raise self.wrong(model, str(error)) from error
        names, tests, grids = (
            self.data_names(fields, field, data) for field in ("data", "test", "grids")
        )
        seeds = fields.get("seeds", fields.get("seed", 1 if kind == "train" else [0]))
        if isinstance(seeds, int) and not isinstance(seeds, bool) and kind == "train":
            seeds = list(range(seeds))
        try:
            clouds = {milestones.parse(m) for m in self.several(fields["clouds"], object, "clouds")}
        except InputError as error:
            raise self.wrong("clouds", str(error)) from error
        poses = self.several(fields.get("poses", []), object, "poses")
        precision = self.text(fields.get("precision", preflight.FULL_PRECISION), "precision")
        try:  # each as records name it
            precision = preflight.check_precision(precision)
            poses = tuple(dict.fromkeys(map(given_pose.parse, poses)))
        except InputError as error:
            raise self.wrong(precision, str(error)) from error
        found = Entry(
            kind,
            tuple(map(user_code.named, models)),
            names,
            tuple(sorted(clouds)),
            dict(self.table(fields.get("options", {}), "options")),
            recipe,
            precision,
            changes,
            self.several(seeds, int, "seeds"),
            tests,
            self.several(fields.get("points", []), int, "points"),
            poses,
            tuple(tries),
            self.damages(fields),
            grids,
        )
        if found.points and min(found.points) < 1:
            raise self.wrong("points", f"points must be 1 or more, got {min(found.points)}")
        if not found.seeds or min(found.seeds) < 0:
            raise self.wrong("seeds", f"seeds must be one or more, from 0 on; got {seeds!r}")
        return found

    def data_names(
        self, fields: Mapping[str, Any], field: str, data: Mapping[str, DataSet]
    ) -> tuple[str, ...]:
        """What a field names: data sets, or in ``grids`` those that are grids."""
        names = self.several(fields.get(field, []), str, field)
        for name in names:
            if name not in data:
                raise self.wrong(name, f"no data set named {name!r}", data)
            if bool(data[name].cells) != (field == "grids"):
                kind = "a grid" if data[name].cells else "one data set and no grid"
                raise self.wrong(f'"{name}"', f"{field} names {name!r}, which is {kind}")
        return names

    def damages(self, fields: Mapping[str, Any]) -> tuple[str, ...]:
        try:
            return damage.parse(self.several(fields.get("damages", []), str, "damages"))
        except InputError as error:
            raise self.wrong("damages", str(error)) from error

    def known(self, fields: Mapping[str, Any], names: Sequence[str], where: str) -> None:
        for name in fields:
            if name not in names:
                raise self.wrong(name, f"{where} has no field {name!r}", names)

    def table(self, value: Any, name: str) -> Mapping[str, Any]:
        if not isinstance(value, Mapping):
            raise self.wrong(name, f"{name} must be a table, got {value!r}")
        return value

    def tables(self, value: Any, name: str) -> list[Mapping[str, Any]]:
        if not isinstance(value, list):
            raise self.wrong(name, f"{name} must be a list of tables, got {value!r}")
        return [self.table(each, name) for each in value]

    def text(self, value: Any, name: str) -> str:
        if not isinstance(value, str):
            raise self.wrong(name, f"{name} must be text, got {value!r}")
        return value

    def several(self, value: Any, kind: type, name: str) -> tuple[Any, ...]:
        """One or more values of a kind, each once."""
        values = value if isinstance(value, list) else [value]
        for each in values:
            if not isinstance(each, kind) or isinstance(each, bool):
                raise self.wrong(name, f"{name} holds {each!r}; expected {kind.__name__} values")
        return tuple(dict.fromkeys(values))

    def wrong(self, found: str, what: str, known: Any = ()) -> InputError:
        near = close_matches(found, known) if known else ""
        return InputError(f"{self.path}{self.line(found)}: {what}{near}")

    def line(self, found: str) -> str:
        """ ", line 7" for the first line where ``found`` stands as a word, "" for nowhere."""
        word = re.compile(rf"(?<![\w-]){re.escape(found)}(?![\w-])")
        for number, line in enumerate(self.lines, 1):
            if word.search(line.partition("#")[0]):
                return f", line {number}"
        return ""


def card_of(model: str) -> ModelCard:
    """The card of a registered model, or a bare one for a user's own "module:factory"."""
    return ModelCard(model, model, model, "") if ":" in model else registry.card(model)
