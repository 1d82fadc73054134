"""``CARD.md``: a page in every data folder that says what it holds and how it was made."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from partialbench.dataset.descriptions import description, front_matter, licence_line
from partialbench.dataset.manifest import Manifest
from partialbench.dataset.objects import notice_lines
from partialbench.dataset.schema import as_markdown
from partialbench.dataset.shards import read_columns, write_atomically

HPR_MEASURED = {
    1.0: (0.879, 0.667), 1.25: (0.849, 0.728), 1.5: (0.807, 0.789), 1.75: (0.756, 0.844),
    2.0: (0.693, 0.891), 2.5: (0.549, 0.955), 3.0: (0.420, 0.986),
}  # fmt: skip
"""Gamma → (precision, recall) of hidden point removal on clouds of 1,024 points (docs/hpr.md)."""

PAPER_ROWS = {"pm40": {"train": 98_430, "test": 2_468}, "ps15": {"train": 22_670, "test": 5_650}}
"""Rows of the paper's data sets (section 5.1). No other data set stands beside them."""


NAME = "CARD.md"


def write_card(folder: Path, manifest: Manifest) -> bytes:
    """Write the card of a finished folder; what was written."""
    content = card_text(folder, manifest).encode()
    write_atomically(folder / NAME, content)
    return content


def card_text(folder: Path, manifest: Manifest, patterns: Mapping[str, str] | None = None) -> str:
    """The card as Markdown: what, counts per class, fields, configuration, digests, versions.

    Args:
        patterns: split → glob of its files, for libraries that read the card's front matter; those
            of the shards where it is not given.
    """
    files = patterns or {split: f"{split}-*.h5" for split in manifest.splits()}
    rows = sum(manifest.rows(split) for split in manifest.splits())
    counts = {split: class_counts(folder, manifest, split) for split in manifest.splits()}
    splits = list(counts)
    kinds = Counter(f["kind"] for f in manifest.failures)
    lines = [
        front_matter(manifest.dataset_id, manifest.class_names, rows, files),
        f"# {manifest.dataset_id}",
        "",
        description(manifest.dataset_id),
        "",
        licence_line(manifest.dataset_id),
        "",
        "| class | " + " | ".join(splits) + " |",
        "|---|" + "---|" * len(splits),
        *(
            f"| {label} {name} | " + " | ".join(str(counts[s][label]) for s in splits) + " |"
            for label, name in enumerate(manifest.class_names)
            if any(counts[s][label] for s in splits)
        ),
        "| **all** | " + " | ".join(f"**{counts[s].sum()}**" for s in splits) + " |",
        *(
            ["| the paper's | " + " | ".join(str(paper_rows(manifest, s)) for s in splits) + " |"]
            if any(paper_rows(manifest, s) for s in splits)
            else []
        ),
        "",
        f"Failed: {kinds['failed']}, turned away by a rule: {kinds['rejected']} "
        "(`failures.jsonl` has the reasons).",
        "",
        *visibility_lines(manifest),
        *_noticed(folder),
        "## Fields of a row",
        "",
        "Camera frame: x right, y down, z forward. Object frame: z up, unit ball, bounding-box "
        "centre at the origin.",
        "",
        as_markdown(),
        "## Content digests",
        "",
        *(f"- {split}: `{digest}`" for split, digest in manifest.digests.items()),
        "",
        "## Configuration",
        "",
        "```json",
        json.dumps(manifest.configuration, indent=1),
        "```",
        "",
        "Made with " + ", ".join(f"{k} {v}" for k, v in manifest.versions.items()) + ".",
        "",
    ]
    return "\n".join(lines)


def _noticed(folder: Path) -> list[str]:
    """What reading the objects' files brought to light; nothing where nothing did."""
    lines = notice_lines(folder)
    if not lines:
        return []
    return ["Noticed in the files (`objects.jsonl` has each):", "", *(f"- {x}" for x in lines), ""]


def visibility_lines(manifest: Manifest) -> list[str]:
    """How far the points of clouds are those a camera would see; nothing for other data."""
    occluder = manifest.configuration["occluder"]
    if occluder["name"] != "hpr":
        return []
    words = (
        "Which points are seen is decided by hidden point removal, without a surface: not what a "
        "depth camera would return."
    )
    gamma = occluder.get("gamma")
    if gamma in HPR_MEASURED:
        precision, recall = HPR_MEASURED[gamma]
        words += (
            f" Against ray casting, on shapes sampled as complete clouds of 1,024 points are, at "
            f"gamma {gamma:g}: precision {precision:.2f} ({1 - precision:.0%} of the reported "
            f"points are in fact hidden), recall {recall:.2f}, F "
            f"{2 * precision * recall / (precision + recall):.2f} (docs/hpr.md)."
        )
    else:
        words += " This radius was not measured against ray casting (docs/hpr.md)."
    return [words, ""]


def paper_rows(manifest: Manifest, split: str) -> int:
    """Rows of the paper's data set of this id; 0 where the paper has none."""
    return PAPER_ROWS.get(manifest.dataset_id, {}).get(split, 0)


def class_counts(folder: Path, manifest: Manifest, split: str) -> np.ndarray:
    """(K,) int64: rows of each class in a split."""
    total = np.zeros(len(manifest.class_names), np.int64)
    for entry in manifest.shards:
        if entry.split == split and entry.rows:
            labels = read_columns(folder / entry.file, ["label"])["label"]
            total += np.bincount(labels, minlength=len(total))
    return total
