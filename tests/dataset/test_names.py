"""No name of a file ends a run or loses an object; no stream that is closed does."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
import trimesh

from partialbench.dataset.build import build
from partialbench.dataset.executors import InlineExecutor
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.names import printable
from partialbench.dataset.render import plan_render, source_of
from partialbench.dataset.show import show
from partialbench.dataset.verify import verify

ODD = (
    b"caf\xe9", b"plain", b"new\nline", b"cup_$^_$", b"<b>bold", b"a|b", b"cup$1$x", b"#hash",
    b" lead", b"%s%d", b"cup.obj.old", "杯子".encode(), "é".encode(), "e\u0301".encode(), b"tab\t",
    b"long_" + b"x" * 180, b"long_" + b"x" * 181, "陶瓷马克杯".encode() * 12, b"caf\\xe9", b"[red]",
)  # fmt: skip


def test_printable_names_are_text_and_tell_what_was_not() -> None:
    assert printable(os.fsdecode(b"caf\xe9")) == r"caf\xe9"
    assert printable("new\nline\0") == r"new\nline\x00"
    assert printable("杯 é [x]") == "杯 é [x]"


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, Path]:
    tmp_path = tmp_path_factory.mktemp("names")
    folder = os.fsencode(tmp_path / "meshes" / "mug [old]" / "train")
    os.makedirs(folder)
    off = trimesh.creation.box((1, 2, 3)).export(file_type="off").encode()
    for name in ODD:
        with open(folder + b"/" + name + b".off", "wb") as file:
            file.write(off)
    out = tmp_path / "out"
    plan = plan_render("pm40", out, source=str(tmp_path / "meshes"), views=1, points=32,
                       occluder_options={"resolution": 24})  # fmt: skip
    build(plan, InlineExecutor)
    return tmp_path / "meshes", out


def test_every_name_gives_its_object(made) -> None:
    source, out = made
    data = ShardDataset(out, "train", 32)
    # One of the names is spelt as another is shown: that one is then told by its place.
    assert len(data) == len(set(data.object_ids.tolist())) >= len(ODD) - 1
    lost = [json.loads(line) for line in (out / "failures.jsonl").read_text().splitlines()]
    assert len(data) + len(lost) == len(ODD)
    assert verify(out, source_of(out, str(source))[0]).problems == []


def test_every_name_is_drawn(made, tmp_path) -> None:
    for name in ("page.png", "page.html"):
        show(made[1], tmp_path / name, samples=len(ODD))
    # On the page names are data, which a script sets as text.
    page = (tmp_path / "page.html").read_text()
    assert "\\u003cb>bold" in page
    assert "<b>bold" not in page


COMMAND = [sys.executable, "-m", "partialbench.cli", "render", "pm40", "--views", "1", "--points",
           "32", "--counts", "1,1", "--split", "test", "--split", "test",
           "--objects-per-class", "1", "--setting", "aligned"]  # fmt: skip


@pytest.mark.parametrize("closed", ["2>&-", ">&- 2>&-", "<&- >&- 2>&-"])
def test_closed_streams_do_not_end_a_run(closed: str, tmp_path: Path) -> None:
    words = " ".join(
        f"'{word}'" for word in [*COMMAND, "--workers", "1", "--out", str(tmp_path / "o")]
    )
    run = subprocess.run(
        f"{words} {closed}", shell=True, cwd=Path(__file__).parents[2], timeout=300
    )
    assert run.returncode == 0
    assert (tmp_path / "o" / "failures.jsonl").read_text() == ""
    # A split that is given twice is one.
    assert len(list((tmp_path / "o").glob("test-*.h5"))) == 1


def test_output_in_ascii_says_what_it_can(made, tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONIOENCODING": "ascii"}
    command = [sys.executable, "-m", "partialbench.cli"]
    out = tmp_path / "thé 杯"
    run = subprocess.run(
        [*command, "show", str(made[1]), "--out", str(out / "s.png"), "--samples", "1"],
        env=environment, capture_output=True, cwd=Path(__file__).parents[2], timeout=300,
    )  # fmt: skip
    assert run.returncode == 0, run.stderr
    assert run.stdout.decode("ascii").strip().endswith(r"\u676f/s.png")
