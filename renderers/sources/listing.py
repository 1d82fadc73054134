"""From a tree of files to objects with ids, labels and splits, and what is said about it."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import PurePosixPath
from typing import Any

from partialbench.dataset.categories import MODELNET40
from partialbench.dataset.names import printable
from partialbench.dataset.sources import ObjectRef, RejectedObject
from partialbench.errors import InputError
from renderers.sources.files import Files
from renderers.sources.layout import Entry, Layout, understand
from renderers.sources.lists import apply_lists
from renderers.sources.unread import unread

SPLITS = ("train", "test")
TRAIN_SHARE = 0.8
_NAMED = 5


@dataclass
class Listing:
    """The objects of a tree.

    Attributes:
        class_names: label → name: ModelNet40's forty where all are of these, else in order.
        objects: split → its objects by label, then by name.
        rejected: files that gave no object.
        words: how the tree was understood, for a person.
        pattern: how the objects lie.
        notes: what else the words say.
    """

    class_names: tuple[str, ...]
    objects: dict[str, list[ObjectRef]]
    rejected: list[RejectedObject] = field(default_factory=list)
    words: str = ""
    pattern: str = ""
    notes: list[str] = field(default_factory=list)

    def splits(self) -> tuple[str, ...]:
        """The splits that have objects."""
        return tuple(split for split in SPLITS if self.objects.get(split))

    def of(self, split: str) -> list[ObjectRef]:
        """A split's objects; ``InputError`` for a name that is none."""
        if split not in SPLITS:
            raise InputError(f"no split {split!r}; expected one of {', '.join(SPLITS)}")
        return list(self.objects.get(split, []))

    def describe(self) -> dict[str, Any]:
        """What defines it, as JSON data: where it lies does not, what it lists does."""
        listed = [
            (ref.split, ref.object_id, ref.label, PurePosixPath(ref.location).suffix.lower())
            for split in SPLITS
            for ref in self.of(split)
        ]
        return {
            "layout": "; ".join([self.pattern, *self.notes]),
            "objects": {split: len(self.of(split)) for split in self.splits()},
            "listing_sha256": hashlib.sha256(json.dumps(listed).encode()).hexdigest(),
        }


def list_tree(files: Files, locations: list[str], suffixes: tuple[str, ...]) -> Listing | None:
    """The objects among these files of a tree; None where no file lies as an object does.

    Args:
        locations: the files that may be objects: of the formats in ``suffixes``.
        suffixes: the first of these is taken where an object comes in several formats.

    Raises:
        InputError: as ``lists.apply_lists``.
    """
    layout = understand(locations)
    apply_lists(files, layout)
    if not layout.entries:
        return None
    layout.left_out += unread(files, layout, suffixes)
    notes = list(layout.notes)
    if any(not entry.split for entry in layout.entries):
        notes.append("where nothing says the split, four in five are training objects by name")
    names = {entry.category: printable(entry.category) for entry in layout.entries}
    present = sorted(set(names.values()))
    known = set(present) <= set(MODELNET40)
    listing = Listing(MODELNET40 if known else tuple(present), {}, pattern=layout.pattern)
    listing.notes = notes
    order = {suffix: rank for rank, suffix in enumerate(suffixes)}
    ranked = sorted(
        layout.entries,
        key=lambda e: (order[PurePosixPath(e.location).suffix.lower()], e.location),
    )
    taken: dict[tuple[str, str], Entry] = {}
    for entry in ranked:
        _add(listing, entry, names[entry.category], taken)
    for split in listing.objects:
        listing.objects[split].sort(key=lambda ref: (ref.label, ref.object_id))
    listing.rejected += [_left_out(place, why, failed=True) for place, why in layout.left_out]
    listing.rejected += [_left_out(place, why, failed=False) for place, why in layout.alternates]
    listing.rejected.sort(key=lambda r: r.location)
    listing.words = _words(listing, present, layout)
    return listing


def _add(
    listing: Listing, entry: Entry, category: str, taken: dict[tuple[str, str], Entry]
) -> None:
    # As it is shown: two names of bytes may be shown alike.
    full = printable(f"{entry.category}/{entry.name}")
    split = entry.split or split_of(full)
    if earlier := taken.get((split, full)):
        if _bare(earlier.location) == _bare(entry.location):
            listing.rejected.append(
                RejectedObject(
                    full, split, "another file gives an object of this name",
                    entry.location, {"taken": earlier.location},
                )
            )  # fmt: skip
            return
        # Another object of the same name, in another folder: its place tells them apart.
        full = printable(f"{entry.category}/{_bare(entry.location)}")
    taken[split, full] = entry
    label = listing.class_names.index(category)
    ref = ObjectRef(full, label, split, entry.location)
    listing.objects.setdefault(split, []).append(ref)


def split_of(name: str) -> str:
    """The split of an object that lies in none: "train" for four in five names, by their digest.

    It depends on the name alone, so that adding or removing files moves no other.
    """
    digest = hashlib.sha256(name.encode()).digest()
    return "train" if int.from_bytes(digest[:8], "big") < TRAIN_SHARE * 2**64 else "test"


def _bare(location: str) -> str:
    return str(PurePosixPath(location).with_suffix(""))


def _left_out(location: str, reason: str, failed: bool) -> RejectedObject:
    name = printable(_bare(location))
    return RejectedObject(name, "", printable(reason), location, failed=failed)


def _spelt_otherwise(names: list[str]) -> list[str]:
    """What there is to say of classes that look like ModelNet40's and are not called so."""
    theirs = {_letters(name): name for name in MODELNET40}
    alike = {name: theirs[_letters(name)] for name in names if _letters(name) in theirs}
    if not (odd := {name: known for name, known in alike.items() if name != known}):
        return []
    said = ", ".join(f"{name!r} ({known})" for name, known in list(odd.items())[:_NAMED])
    more = ", …" if len(odd) > _NAMED else ""
    return [f"{said}{more} would be ModelNet40's, with its symmetries, were the folders called so"]


def _letters(name: str) -> str:
    """The letters of a class's name, small, without what makes it a plural."""
    return re.sub(r"[\W_]+", "", name.casefold()).removesuffix("s")


def _words(listing: Listing, present: list[str], layout: Layout) -> str:
    train, test = (len(listing.of(split)) for split in SPLITS)
    classes = f"{len(present)} class" + ("es" if len(present) > 1 else "")
    where = printable(layout.root + listing.pattern)
    text = f"{where}: {classes}, {train:,} training, {test:,} test objects"
    text = "; ".join([text, *map(printable, listing.notes), *_spelt_otherwise(present)])
    out = [printable(location) for location, _ in layout.left_out]
    if out:
        more = f" and {len(out) - _NAMED:,} more" if len(out) > _NAMED else ""
        files = "file" if len(out) == 1 else "files"
        text += f"; {len(out):,} {files} left out: {', '.join(out[:_NAMED])}{more}"
    return text
