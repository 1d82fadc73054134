"""``croissant.json``: a data folder in MLCommons' vocabulary, for search engines too.

Source: the Croissant format specification 1.1 and its extension for responsible AI 1.0. It lists
every file with its SHA-256; over Parquet it describes the rows too, so that ``mlcroissant`` reads
them (it reads no HDF5). Nothing in it depends on when or where it is written.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

import partialbench
from partialbench.dataset.descriptions import LICENCES, description

if TYPE_CHECKING:
    from partialbench.dataset.manifest import Manifest

NAME = "croissant.json"
HDF5, PARQUET, TAR = "application/x-hdf5", "application/x-parquet", "application/x-tar"

CONTEXT: dict[str, Any] = {
    "@language": "en", "@vocab": "https://schema.org/", "arrayShape": "cr:arrayShape",
    "citeAs": "cr:citeAs", "column": "cr:column", "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn", "cr": "http://mlcommons.org/croissant/",
    "rai": "http://mlcommons.org/croissant/RAI/", "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"}, "dct": "http://purl.org/dc/terms/",
    "description": {"@container": "@language"}, "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"}, "extract": "cr:extract",
    "field": "cr:field", "fileProperty": "cr:fileProperty", "fileObject": "cr:fileObject",
    "fileSet": "cr:fileSet", "format": "cr:format", "includes": "cr:includes",
    "isArray": "cr:isArray", "isLiveDataset": "cr:isLiveDataset", "jsonPath": "cr:jsonPath",
    "key": "cr:key", "md5": "cr:md5", "name": {"@container": "@language"},
    "parentField": "cr:parentField", "path": "cr:path", "recordSet": "cr:recordSet",
    "references": "cr:references", "regex": "cr:regex", "repeated": "cr:repeated",
    "replace": "cr:replace", "samplingRate": "cr:samplingRate", "sc": "https://schema.org/",
    "separator": "cr:separator", "source": "cr:source", "subField": "cr:subField",
    "transform": "cr:transform",
}  # fmt: skip
"""The specification's own, which every file has to repeat."""

CITATION = (
    "Classification of Single-View Object Point Clouds, arXiv:2012.10042v2 (the task); "
    "partialbench (these data)"
)

TableField = tuple[str, np.dtype, tuple[int, ...], str]
"""(name, dtype, shape of an entry, meaning) of a column."""


@dataclass(frozen=True)
class File:
    """One file of the folder."""

    name: str
    media_type: str
    bytes: int
    sha256: str


def shard_files(manifest: Manifest) -> list[File]:
    """The HDF5 shards of a data folder."""
    return [File(s.file, HDF5, s.bytes, s.sha256) for s in manifest.shards if s.rows]


def text(
    manifest: Manifest,
    files: Iterable[File],
    patterns: Mapping[str, str] | None = None,
    fields: Sequence[TableField] = (),
) -> str:
    """The file's content.

    Args:
        manifest: of the complete data folder.
        files: every file with data.
        patterns: split → glob of its Parquet files; with it the rows are described.
        fields: the columns of those.
    """
    rows = {split: manifest.rows(split) for split in manifest.splits()}
    counts = ", ".join(f"{count:,} in {split}" for split, count in rows.items())
    data: dict[str, Any] = {
        "@context": CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": [
            "http://mlcommons.org/croissant/1.1", "http://mlcommons.org/croissant/RAI/1.0",
        ],
        "name": manifest.dataset_id,
        "description": f"{description(manifest.dataset_id)} Rows: {counts}.",
        "license": LICENCES.get(manifest.dataset_id, LICENCES[""]).url_or_words,
        "version": f"{manifest.format_version}.0.0",
        "citeAs": CITATION,
        "creator": {"@type": "Organization", "name": f"partialbench {_made_by(manifest)}"},
        "keywords": ["point cloud", "single view", "object pose", "classification", "3D"],
        "isAccessibleForFree": True,
        **_responsible(manifest),
        "distribution": [
            {
                "@type": "cr:FileObject", "@id": file.name, "name": file.name,
                "contentUrl": file.name, "contentSize": f"{file.bytes} B",
                "encodingFormat": file.media_type, "sha256": file.sha256,
            }
            for file in files
        ],
    }  # fmt: skip
    for split, pattern in (patterns or {}).items():
        data["distribution"].append(
            {
                "@type": "cr:FileSet", "@id": f"{split}-files", "name": f"{split}-files",
                "description": f"The Parquet files of the split {split}.",
                "encodingFormat": PARQUET, "includes": pattern,
            }
        )  # fmt: skip
        data.setdefault("recordSet", []).append(
            {
                "@type": "cr:RecordSet", "@id": split, "name": split,
                "description": f"{rows[split]:,} clouds, one view of one object each.",
                "field": [_field(split, *field) for field in fields],
            }
        )  # fmt: skip
    return json.dumps(data, indent=1, ensure_ascii=False) + "\n"


def _field(
    split: str, name: str, dtype: np.dtype, shape: tuple[int, ...], meaning: str
) -> dict[str, Any]:
    kinds = {"f": "sc:Float", "i": "sc:Integer", "S": "sc:Text", "u": "sc:Text"}
    field: dict[str, Any] = {
        "@type": "cr:Field", "@id": f"{split}/{name}", "name": name, "description": meaning,
        "dataType": kinds[dtype.kind],
        "source": {"fileSet": {"@id": f"{split}-files"}, "extract": {"column": name}},
    }  # fmt: skip
    if shape and dtype.kind != "u":
        field |= {"isArray": True, "arrayShape": ",".join(map(str, shape))}
    return field


def _made_by(manifest: Manifest) -> str:
    return manifest.versions.get("partialbench", partialbench.__version__)


def _responsible(manifest: Manifest) -> dict[str, Any]:
    """The fields of the responsible-AI extension that can be said of these data."""
    configuration = manifest.configuration
    failed = len(manifest.failures)
    occluder = configuration["occluder"]["name"]
    return {
        "rai:dataCollection": (
            f"Generated by partialbench: source {configuration['source'].get('name')}, visibility "
            f"by {occluder}, setting {configuration['setting']}, seed {configuration['seed']}."
        ),
        "rai:dataCollectionType": "Software Collection",
        "rai:dataPreprocessingProtocol": [
            f"Shapes are centred and scaled into the unit ball; {configuration['points']} of the "
            f"seen points are drawn without replacement.",
            f"{failed} inputs or views gave no row; failures.jsonl has the reasons.",
        ],
        "rai:dataAnnotationProtocol": (
            "Class labels are the source's. Poses are those the clouds were made with."
            if manifest.has_poses
            else "Class labels are the source's. Poses are not known."
        ),
        "rai:dataUseCases": [
            "Training and testing classifiers and pose estimators on single-view point clouds."
        ],
        "rai:dataLimitations": [
            "One rigid object a cloud, segmented, without background. Simulated visibility is not "
            "a sensor's: noise, holes and mixed pixels are absent or modelled.",
        ],
        "rai:dataBiases": [
            "Object classes, and how many objects each has, are the source's choice; shapes follow "
            "what designers of CAD models made."
        ],
        "rai:personalSensitiveInformation": ["None: shapes of objects, no people or places named."],
    }
