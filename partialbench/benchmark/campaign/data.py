"""The data sets of a campaign: what is made of them, and whether it is what the file asks for."""

from __future__ import annotations

from pathlib import Path

from partialbench.benchmark.campaign.file import DataSet
from partialbench.dataset import manifest as manifests
from partialbench.dataset.manifest import Manifest
from partialbench.errors import InputError


def digests(data: DataSet) -> dict[str, str]:
    """Split → digest of a data set: of its folder where that is complete, else as declared. Of a
    grid, cell → digest of its test split, of those cells that are complete.

    Raises:
        InputError: a complete folder whose digests are not the declared ones, or that was made by
            another command than the file has now.
    """
    found = {cell: _complete(folder) for cell, folder in data.folders.items()}
    complete = {cell: manifest for cell, manifest in found.items() if manifest is not None}
    if len(complete) == len(found) and data.note.is_file():
        _require_same_command(data)
    if data.cells:
        return {cell: manifest.digests["test"] for cell, manifest in complete.items()}
    if not complete:
        return dict(data.digests)
    (manifest,) = complete.values()
    for split, wanted in data.digests.items():
        there = manifest.digests.get(split, "(no such split)")
        if there != wanted:
            made = ", ".join(f"{name} {version}" for name, version in manifest.versions.items())
            raise InputError(
                f"the {split} split of data set {data.name!r} in {data.folder} has the digest "
                f"{there}, made by {made}; the campaign declares {wanted}"
                + (f", made by {data.made_by}" if data.made_by else "")
                + ". Delete the folder to have it rendered again by this version, or correct the "
                "campaign file if the data are meant to have changed"
            )
    return dict(manifest.digests)


def _require_same_command(data: DataSet) -> None:
    """Its records would be of data that the file no longer asks for."""
    before = data.note.read_text(encoding="utf-8")
    if before.split() != data.command.split():
        raise InputError(
            f"the data set {data.name!r} in {data.folder} was rendered by {before!r}, the campaign "
            f"file now has {data.command!r}. Delete the folder to have it rendered anew, or "
            f"{data.note} if both make the same data"
        )


def _complete(folder: Path) -> Manifest | None:
    """What is in a data folder, None where it is not complete."""
    if not (folder / manifests.NAME).is_file():
        return None
    manifest = manifests.load(folder)
    return manifest if manifest.state == "complete" else None


def is_rendered(data: DataSet) -> bool:
    """Whether its folder, or that of each cell, is complete."""
    return all(_complete(folder) is not None for folder in data.folders.values())
