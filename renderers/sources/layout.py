"""How a tree of files says which object each is: its class, its split, its name.

    <class>/<file>                      one file an object
    <class>/<split>/<file>              as ModelNet40
    <class>/<object>/…/<file>           as ShapeNet and OmniObject3D; also behind a split
    <split>/<class>/…                   the other way round
    <split>/<class>_<number>.<suffix>   the class in the name

each below any number of folders that hold all of it. What is understood is said in words
(``Layout.words``); a file that lies otherwise is left out by name, never taken for something else.
"""

from __future__ import annotations

import re
import unicodedata
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import PurePosixPath

from partialbench.dataset.categories import MODELNET40
from partialbench.errors import InputError

SPLIT_NAMES = {
    "train": "train", "training": "train", "trainval": "train", "test": "test", "testing": "test",
    "val": "val", "valid": "val", "validation": "val", "dev": "val",
}  # fmt: skip
"""Folder names in small letters, without "set" and the like behind them → what they are."""
_BESIDE_SPLIT = re.compile(r"[ _.\-]+|(?:set|split|data)$")

MAIN_FILES = (
    "model_normalized", "model", "textured", "nontextured", "scan", "mesh", "visual_geometry",
    "pointcloud", "points",
)  # fmt: skip
"""Names of the file that is the object where its folder holds several, the preferred one first."""

_NUMBERED = re.compile(r"(.*?[^\W\d_])[ _.\-]*\d+")


@dataclass(frozen=True)
class Entry:
    """One object found.

    Attributes:
        category: the class's folder, or the class in the file's name.
        name: the object's own name, unique in its class and split but for other formats of it.
        split: "train", "test", "val", or "" where nothing says it.
        location: the file.
        pattern: how it lies.
    """

    category: str
    name: str
    split: str
    location: str
    pattern: str


@dataclass
class Layout:
    """What a tree was understood as.

    Attributes:
        entries: an object each, in the order of the locations.
        left_out: (location, reason) of files that lie otherwise.
        alternates: (location, reason) of further files of an object that is there.
        notes: what else a person should know.
        root: the folders above classes or splits, as "data/meshes/".
    """

    entries: list[Entry] = field(default_factory=list)
    left_out: list[tuple[str, str]] = field(default_factory=list)
    alternates: list[tuple[str, str]] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    root: str = ""

    @property
    def pattern(self) -> str:
        """How the objects lie, the commonest way first."""
        return ", ".join(p for p, _ in Counter(e.pattern for e in self.entries).most_common())


def split_name(folder: str) -> str:
    """The split that a folder's name says ("Train", "test_set"), "" for any other name."""
    return SPLIT_NAMES.get(_BESIDE_SPLIT.sub("", folder.casefold()), "")


def understand(locations: Sequence[str]) -> Layout:
    """The layout of a tree from the paths ("/" between parts) of its meshes or clouds.

    Raises:
        InputError: several data sets lie beside each other, each with classes and splits.
    """
    paths = [PurePosixPath(location) for location in sorted(locations)]
    layout = Layout()
    folders = {path: path.parts[:-1] for path in paths}
    level, split_first = _class_level(list(folders.values()), [p.stem for p in paths])
    if not split_first:
        inner_folders = [folder[max(level, 0) :] for folder in folders.values()]
        _require_one_set(inner_folders, [p.stem for p in paths])
    found: list[tuple[PurePosixPath, str, str, tuple[str, ...], str]] = []
    above = folders[paths[0]][:level] if paths and level > 0 else ()
    layout.root = "".join(f"{part}/" for part in above)
    for path in paths:
        inner = folders[path][max(level, 0) :]
        split = root = ""
        if split_first:
            if not inner or not split_name(inner[0]):
                layout.left_out.append((str(path), "lies in no split's folder"))
                continue
            split, inner = split_name(inner[0]), inner[1:]
            root += "<split>/"
        if inner:
            category, inner = inner[0], inner[1:]
            root += "<class>/"
            if not split_first and inner and split_name(inner[0]):
                split, inner = split_name(inner[0]), inner[1:]
                root += "<split>/"
            found.append((path, category, split, inner, root))
        elif (split_first or level < 0) and (match := _NUMBERED.fullmatch(path.stem)):
            found.append((path, match[1], split, (), root + "<class>_"))
        else:
            layout.left_out.append((str(path), "lies in no class's folder"))
    if split_first and any("<class>/" in root for *_, root in found):
        # Some lie in folders of classes: then a name alone is none.
        for path, *_, root in found:
            if "<class>/" not in root:
                layout.left_out.append((str(path), "lies in no class's folder"))
        found = [item for item in found if "<class>/" in item[-1]]
    _name_objects(found, layout)
    _settle_validation(layout)
    layout.notes += _doubts({entry.category for entry in layout.entries})
    return layout


def _doubts(categories: set[str]) -> list[str]:
    """What looks like a mistake in the names of classes, for a person to judge."""
    notes = [
        f"{name!r} is taken for a class, though it is called as a split is"
        for name in sorted(categories)
        if split_name(name)
    ]
    alike = defaultdict(list)
    for name in sorted(categories):
        letters = unicodedata.normalize("NFC", name).casefold()
        alike[re.sub(r"[\W_]+", "", letters) or letters].append(name)
    return notes + [
        f"{', '.join(map(ascii, names))} are a class each, though only capitals, blanks and signs "
        f"or the way an accent is written tell them apart"
        for names in alike.values()
        if len(names) > 1
    ]


def _class_level(folders: list[tuple[str, ...]], stems: list[str]) -> tuple[int, bool]:
    """How many folders lie above classes (or above splits), and whether splits come first.

    −1 where there are no folders at all and the names tell the classes apart.
    """
    if not any(folders):
        prefixes = {m[1] for m in map(_NUMBERED.fullmatch, stems) if m}
        return (-1 if len(prefixes) > 1 else 0), False
    shared = 0
    while len({f[shared] if len(f) > shared else None for f in folders}) == 1:
        if len(folders[0]) <= shared or split_name(folders[0][shared]):
            break
        shared += 1
    below = Counter(f[shared] for f in folders if len(f) > shared)
    splits = {name for name in below if split_name(name)}
    is_split_level = bool(splits) and (
        len(splits) == len(below) or len({split_name(name) for name in splits}) > 1
    )
    if is_split_level:
        if shared and _is_one_class(folders, stems, shared):
            return shared - 1, False
        return shared, True
    if shared and (not below or _hold_one_object_each(folders, stems, shared)):
        return shared - 1, False
    return shared, False


def _is_one_class(folders: list[tuple[str, ...]], stems: list[str], level: int) -> bool:
    """Whether the folder above the splits is the only class, not the root of a data set."""
    inside = [(f[level], f[level + 1]) for f in folders if len(f) > level + 1]
    if not inside:
        prefixes = {m[1] for m in map(_NUMBERED.fullmatch, stems) if m}
        return len(prefixes) < 2
    names = {name for _, name in inside}
    again = len(set(inside)) > len(names)  # a folder of this name in several splits
    return not (again or names <= set(MODELNET40) or max(Counter(inside).values()) > 1)


def _require_one_set(inner: list[tuple[str, ...]], stems: list[str]) -> None:
    """``InputError`` where the folders at the level of classes are data sets, from how all files
    lie in them: <class>/<split>/…, or <split>/<class>/… with several files of a class that is in
    both splits."""
    sets = sorted({folder[0] for folder in inner if folder})
    if len(sets) < 2 or any(len(folder) < 3 for folder in inner):
        return
    splits_below = all(split_name(f[2]) and not split_name(f[1]) for f in inner)
    files: dict[tuple[str, str], dict[str, set[str]]] = defaultdict(lambda: defaultdict(set))
    for folder, stem in zip(inner, stems, strict=True):
        files[folder[0], folder[2]][folder[1]].add(stem)
    # An object may be numbered anew in each split, but is one file, or one of a known name.
    classes_below = all(split_name(f[1]) for f in inner) and any(
        len(of_split) > 1 and len(names) > 1 and not {n.casefold() for n in names} & {*MAIN_FILES}
        for of_split in files.values()
        for names in of_split.values()
    )
    if splits_below or classes_below:
        raise InputError(
            f"{', '.join(sets[:3])}{', …' if len(sets) > 3 else ''} each hold classes and splits "
            f"of their own ({'/'.join(inner[0])}), as data sets do; give one of these folders, or "
            f"put the classes of all into one"
        )


def _hold_one_object_each(folders: list[tuple[str, ...]], stems: list[str], level: int) -> bool:
    """Whether the folders below the only one are objects of one class, not classes."""
    inside = Counter(f[level] for f in folders if len(f) > level)
    if set(inside) <= set(MODELNET40) or any(
        split_name(f[level + 1]) for f in folders if len(f) > level + 1
    ):
        return False
    # Classes of one object each would not call it the same.
    if max(inside.values()) == 1 and len(set(stems)) == 1:
        return True
    # Nor would classes hold the same files, one of them called as the object of a folder is.
    files: dict[str, set[str]] = defaultdict(set)
    for folder, stem in zip(folders, stems, strict=True):
        if len(folder) > level:
            files[folder[level]].add("/".join((*folder[level + 1 :], stem)))
    same = next(iter(files.values()))
    return all(names == same for names in files.values()) and any(
        name.rpartition("/")[2].casefold() in MAIN_FILES for name in same
    )


def _name_objects(
    found: list[tuple[PurePosixPath, str, str, tuple[str, ...], str]], layout: Layout
) -> None:
    """Fill ``entries``: a file is an object, or the folder is that it shares with other files."""
    groups: dict[tuple[str, str, str], list[tuple[PurePosixPath, str, str]]] = defaultdict(list)
    for path, category, split, inner, root in found:
        if inner:
            own = "/".join((*inner[1:], path.stem))
            groups[category, split, inner[0]].append((path, own, root))
        else:
            ending = "<file>" if not root.endswith("_") else f"<number>{path.suffix.lower()}"
            layout.entries.append(Entry(category, path.stem, split, str(path), root + ending))
    times = Counter(own for members in groups.values() for own in {o for _, o, _ in members})
    for (category, split, folder), members in groups.items():
        names = {own for _, own, _ in members}
        if len(names) > 1 and not any(times[own] > 1 for own in names):
            for path, own, root in members:
                name, pattern = f"{folder}/{own}", f"{root}…/<file>"
                layout.entries.append(Entry(category, name, split, str(path), pattern))
            continue
        main = _main_file(names, times)
        if not main:
            said = ", ".join(sorted(names))
            for path, _, _ in members:
                layout.left_out.append(
                    (str(path), f"its folder holds {said}: which of them is the object?")
                )
            continue
        for path, own, root in members:
            if own == main:
                pattern = root + ("<object>/<file>" if "/" not in own else "<object>/…/<file>")
                layout.entries.append(Entry(category, folder, split, str(path), pattern))
            else:
                layout.alternates.append((str(path), "another file gives this object"))
    layout.entries.sort(key=lambda entry: entry.location)


def _main_file(names: set[str], times: Counter[str]) -> str:
    """Which of an object's files is the object; "" where nothing tells."""
    if len(names) == 1:
        return next(iter(names))
    for known in MAIN_FILES:
        of_it = sorted(name for name in names if name.rpartition("/")[2].casefold() == known)
        if of_it:
            return of_it[0]
    again = [name for name in names if times[name] > 1]
    return again[0] if len(again) == 1 else ""


def _settle_validation(layout: Layout) -> None:
    """There are two splits: validation is the test where there is no other, else training."""
    splits = {entry.split for entry in layout.entries}
    if "val" not in splits:
        return
    to = "train" if "test" in splits else "test"
    layout.notes.append(
        "validation objects join the training objects"
        if to == "train"
        else "validation objects are the test objects, as there are no others"
    )
    layout.entries = [
        # Files are often numbered anew in each split.
        replace(e, split=to, name=f"val/{e.name}" if to == "train" else e.name)
        if e.split == "val"
        else e
        for e in layout.entries
    ]
