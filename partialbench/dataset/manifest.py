"""``manifest.json``: what a data folder holds, how it was made, and the digests that prove it."""

from __future__ import annotations

import hashlib
import json
import platform
from dataclasses import asdict, dataclass, field
from importlib import metadata
from pathlib import Path
from typing import Any

import partialbench
from partialbench.dataset.manifest_check import require_sound
from partialbench.dataset.schema import FORMAT, FORMAT_VERSION, READABLE
from partialbench.dataset.shards import write_atomically
from partialbench.errors import ConfigurationMismatchError, InputError

NAME, FAILURES = "manifest.json", "failures.jsonl"
_LATER = ("listing", "card_sha256")
"""Fields that folders of earlier releases lack."""


@dataclass
class ShardEntry:
    """One finished shard.

    Attributes:
        file: name inside the folder.
        split, index: which slice of which split.
        rows, objects, bytes, sha256: of the file.
        failures: objects and views of this slice that gave no row, as in failures.jsonl.
        objects_sha256: of this shard's lines in objects.jsonl; "" without rows, and in format 1.
    """

    file: str
    split: str
    index: int
    rows: int
    objects: int
    bytes: int
    sha256: str
    failures: list[dict[str, Any]] = field(default_factory=list)
    objects_sha256: str = ""


@dataclass
class Manifest:
    """The whole manifest. ``configuration`` alone decides whether two folders hold the same data.

    Attributes:
        dataset_id: "pm40", "pm40-parametric", … (results of different ids are never mixed).
        configuration: source, occluder, setting, views, points, seed, …: JSON data.
        class_names: label → name.
        state: "building" or "complete".
        shards: finished shards in split and index order.
        listing: how the source's files were understood, in words; "" where there are none.
        listing_failures: what listing the source turned away.
        card_sha256: of CARD.md as it was written, "" before.
        digests: split → content digest over its rows in order (independent of the shard size).
        versions: of what made it; not part of the configuration.
        format_version: of the folder's files.
    """

    dataset_id: str
    configuration: dict[str, Any]
    class_names: list[str]
    state: str = "building"
    shards: list[ShardEntry] = field(default_factory=list)
    listing: str = ""
    listing_failures: list[dict[str, Any]] = field(default_factory=list)
    card_sha256: str = ""
    digests: dict[str, str] = field(default_factory=dict)
    versions: dict[str, str] = field(default_factory=dict)
    format_version: int = FORMAT_VERSION

    @property
    def configuration_digest(self) -> str:
        """SHA-256 of the configuration's canonical JSON."""
        return json_digest(
            {"dataset_id": self.dataset_id, "class_names": self.class_names, **self.configuration}
        )

    @property
    def sensor(self) -> str:
        """What distorted the depth, as "name:strength"; "" for exact depth, or none at all."""
        sensor = self.configuration["occluder"].get("sensor")
        if sensor is None or sensor["name"] == "ideal":
            return ""
        return f"{sensor['name']}:{sensor['strength']:g}"

    @property
    def occluders(self) -> float:
        """Of each object's image, the share that other objects are to hide; 0 for none."""
        return float(self.configuration["occluder"].get("occluders", 0))

    @property
    def has_poses(self) -> bool:
        """Whether the rows' rotations are poses; else they are placeholders."""
        return self.configuration.get("pose") != "none"

    @property
    def failures(self) -> list[dict[str, Any]]:
        """Everything recorded as failed or rejected, listing first, then in shard order."""
        return [*self.listing_failures, *(f for shard in self.shards for f in shard.failures)]

    def rows(self, split: str) -> int:
        """Number of rows of a split in finished shards."""
        return sum(shard.rows for shard in self.shards if shard.split == split)

    def splits(self) -> list[str]:
        """The splits that have shards, in order of appearance."""
        return list(dict.fromkeys(shard.split for shard in self.shards))

    def failures_text(self) -> str:
        """What failures.jsonl holds."""
        return "".join(json.dumps(f, sort_keys=True) + "\n" for f in self.failures)

    def save(self, folder: Path) -> None:
        """Write manifest.json and failures.jsonl, each atomically."""
        data = {
            "format": FORMAT,
            "configuration_digest": self.configuration_digest,
            **asdict(self),
        }
        write_atomically(folder / FAILURES, self.failures_text().encode())
        write_atomically(folder / NAME, (json.dumps(data, indent=1) + "\n").encode())


def json_digest(data: Any) -> str:
    """SHA-256 of canonical JSON (sorted keys, no spaces)."""
    text = json.dumps(data, sort_keys=True, separators=(",", ":"), allow_nan=False)
    return hashlib.sha256(text.encode()).hexdigest()


def bytes_sha256(data: bytes) -> str:
    """SHA-256 (hex) of bytes in memory."""
    return hashlib.sha256(data).hexdigest()


def load(folder: Path) -> Manifest:
    """The manifest of a data folder; ``InputError`` when there is none or it is not readable."""
    path = Path(folder) / NAME
    if Path(folder).is_file():
        raise InputError(f"{folder} is a file, expected a data folder, which has a {NAME}")
    if not path.is_file():
        inside = sorted(other.parent.name for other in Path(folder).glob(f"*/{NAME}"))
        more = f" and {len(inside) - 3} more" if len(inside) > 3 else ""
        raise InputError(
            f"{folder} is not a data folder: it has no {NAME}. "
            + (
                f"Folders in it are: give {', '.join(inside[:3])}{more}"
                if inside
                else f"Make one with 'partialbench render pm40 --out {folder}'"
            )
        )
    try:
        data = json.loads(path.read_text("utf-8"))
        if not isinstance(data, dict):
            raise TypeError(f"it holds a {type(data).__name__}")
        if data["format"] != FORMAT or data["format_version"] not in READABLE:
            raise InputError(
                f"{path} has format {data['format']!r} version {data['format_version']!r}, "
                f"expected {FORMAT!r} version {' or '.join(map(str, READABLE))}"
            )
        recorded = data["configuration_digest"]
        require_sound(data, str(path))
        names = [k for k in Manifest.__dataclass_fields__ if k in data or k not in _LATER]
        fields = {k: data[k] for k in names if k != "shards"}
        manifest = Manifest(**fields, shards=[ShardEntry(**entry) for entry in data["shards"]])
    except InputError:
        raise
    except (KeyError, TypeError, ValueError, RecursionError) as error:
        raise InputError(f"{path} is damaged ({type(error).__name__}: {error})") from error
    if manifest.configuration_digest != recorded:
        raise InputError(
            f"{path} was edited: its configuration hashes to "
            f"{manifest.configuration_digest[:12]}…, but it records {str(recorded)[:12]}…"
        )
    return manifest


def require_same(existing: Manifest, wanted: Manifest, folder: Path) -> None:
    """Raise ``ConfigurationMismatchError`` naming each setting in which the folder differs.

    A folder of an earlier format is not continued, whatever its configuration.
    """
    if existing.format_version != FORMAT_VERSION:
        raise ConfigurationMismatchError(
            f"{folder} was made by an earlier release, in format {existing.format_version} (this "
            f"one writes {FORMAT_VERSION}): it is read as it is, but not continued. Choose another "
            f"--out"
        )
    if existing.configuration_digest == wanted.configuration_digest:
        return
    old = {"dataset_id": existing.dataset_id, **existing.configuration}
    new = {"dataset_id": wanted.dataset_id, **wanted.configuration}
    if existing.class_names != wanted.class_names:
        old["class_names"], new["class_names"] = existing.class_names, wanted.class_names
    lines = [
        f"  {key}: folder has {there!r}, asked for {asked!r}"
        for key, there, asked in differences(old, new)
    ]
    raise ConfigurationMismatchError(
        f"{folder} was made with another configuration:\n" + "\n".join(lines) + "\n"
        "Choose another --out, or give the same options to continue it"
    )


def differences(old: dict[str, Any], new: dict[str, Any]) -> list[tuple[str, Any, Any]]:
    """(dotted key, old value, new value) of each setting in which two configurations differ."""
    before, after = _flat(old), _flat(new)
    absent = "(absent)"
    return [
        (key, before.get(key, absent), after.get(key, absent))
        for key in sorted(before.keys() | after.keys())
        if before.get(key, absent) != after.get(key, absent)
    ]


def _flat(data: Any, prefix: str = "") -> dict[str, Any]:
    if not isinstance(data, dict):
        return {prefix: data}
    return {
        key: value
        for name, inner in data.items()
        for key, value in _flat(inner, f"{prefix}.{name}" if prefix else name).items()
    }


def versions() -> dict[str, str]:
    """Versions of this project and of what the data depend on, as installed."""
    found = {"partialbench": partialbench.__version__, "python": platform.python_version()}
    for name in ("numpy", "scipy", "h5py", "trimesh", "mitsuba", "drjit", "manifold3d"):
        try:
            found[name] = metadata.version(name)
        except metadata.PackageNotFoundError:
            continue
    return found
