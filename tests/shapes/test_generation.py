"""Digests name an edition of the families: a changed object must come with a new GENERATION."""

from __future__ import annotations

import hashlib

import numpy as np

from renderers.shapes.catalogue import FAMILIES, make
from renderers.shapes.family import GENERATION

PINNED = {2: "ac767df9486d591372d9d053905245ef3e65686c5a6c8dc627feca12b32b98d2"}
"""GENERATION → digest of ``fingerprint``; a new entry replaces the old one."""


def fingerprint() -> str:
    """SHA-256 over the vertices of six objects of every class.

    Sorted, since another release of a library may number the same corners otherwise.
    """
    digest = hashlib.sha256()
    for name in FAMILIES:
        for index in range(6):
            vertices = make(name, index).vertices.astype(np.float32)
            digest.update(vertices[np.lexsort(vertices.T)].tobytes())
    return digest.hexdigest()


def test_a_changed_object_comes_with_a_new_generation() -> None:
    assert PINNED.get(GENERATION) == fingerprint(), (
        "objects changed: raise renderers.shapes.family.GENERATION and pin its fingerprint here"
    )
