"""Settings: how much of an object a cloud shows, and in what frame.

What is seen and where the camera is are keyed alike in all of them: clouds of one object and view
differ by the setting alone. ``partial-z`` and ``partial-aligned`` show what ``partial`` shows,
moved from the camera's frame to one with the object's axes.
"""

from __future__ import annotations

from dataclasses import dataclass

from partialbench.errors import InputError


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


def require_camera_frame(name: str, depth_images: bool, normals: bool) -> None:
    """Raises ``InputError`` where a setting moves clouds out of the frame of what is to be kept
    beside the points. ``name``: of ``SETTINGS``."""
    setting = SETTINGS[name]
    for what, kept in (("depth images", depth_images), ("normals", normals)):
        if kept and not setting.whole and setting.turns != "so3":
            raise InputError(
                f"the setting {name!r} moves clouds out of their camera's frame, to which {what} "
                f"belong; render the setting 'partial' with them"
            )
