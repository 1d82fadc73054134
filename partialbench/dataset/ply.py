"""What a PLY file's header promises, held against what follows it."""

from __future__ import annotations

from partialbench.errors import InputError


def require_whole(content: bytes) -> None:
    """Raise ``InputError`` where an ASCII PLY ends before all that its header counts.

    trimesh checks the length of binary files only and takes a text cut short for a smaller object.
    What is no ASCII PLY with a whole header passes: its parser says what is wrong with it.
    """
    end = content.find(b"end_header")
    lines = [
        line.split() for line in content[: max(end, 0)].decode("ascii", "replace").splitlines()
    ]
    if ["format", "ascii", "1.0"] not in lines:
        return
    elements: list[tuple[str, int]] = []
    properties: dict[str, list[bool]] = {}
    for keyword, *words in filter(None, lines):
        if keyword == "element" and len(words) == 2 and words[1].isdecimal():
            elements.append((words[0], int(words[1])))
        elif keyword == "property" and words and elements:
            properties.setdefault(elements[-1][0], []).append(words[0] == "list")
    counted = [(name, count) for name, count in elements if count]
    expected = sum(count for _, count in counted)
    # One line an element, behind the header's last.
    rows = content[end:].splitlines()[1:]
    said = " and ".join(f"{count} {name}" for name, count in counted)
    if len(rows) < expected:
        raise InputError(
            f"the ASCII PLY was cut short: its header says {said} lines, {len(rows)} follow it"
        )
    if expected and not _has_all(rows[expected - 1].split(), properties.get(counted[-1][0], [])):
        raise InputError(
            f"the ASCII PLY was cut short: of its {said} lines the last is "
            f"{rows[expected - 1].decode('ascii', 'replace')!r}"
        )


def _has_all(words: list[bytes], properties: list[bool]) -> bool:
    """Whether a line has a word for each property; a list (True) begins with its length."""
    at = 0
    for is_list in properties:
        if at >= len(words):
            return False
        at += 1 + (int(words[at]) if is_list and words[at].isdigit() else 0)
    return at <= len(words)
