"""Settings: how much of an object a cloud shows, and in what frame.

What is seen and where the camera is are keyed alike in all of them: clouds of one object and view
differ by the setting alone. ``partial-z`` and ``partial-aligned`` show what ``partial`` shows,
moved from the camera's frame to one with the object's axes.
"""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Setting:
    """One setting.

    Attributes:
        whole: complete clouds, nothing hidden; else one view.
        turns: the rotations from object to cloud: "so3" for any, "z" for those about the object's
            z, "none" for the identity. Training clouds are turned by such as well.
    """

    whole: bool
    turns: str


SETTINGS: dict[str, Setting] = {
    "partial": Setting(False, "so3"),
    "partial-z": Setting(False, "z"),
    "partial-aligned": Setting(False, "none"),
    "rotated": Setting(True, "so3"),
    "z-rotated": Setting(True, "z"),
    "aligned": Setting(True, "none"),
}


def turns_of(name: str) -> str:
    """``Setting.turns`` by name; "so3" for a setting of somebody else's data."""
    return SETTINGS[name].turns if name in SETTINGS else "so3"
