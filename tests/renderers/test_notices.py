"""What a reader leaves out reaches the folder, its card and the terminal."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from partialbench.cli.main import app
from partialbench.dataset.objects import notice_lines
from partialbench.errors import InputError
from renderers.sources.mesh import normalise, read_mesh

TETRAHEDRON = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"


def test_notices_are_kept_and_told(tmp_path: Path) -> None:
    files = {"plain": "", "one": "l 1 2\n", "two": "l 1 2\nl 2 3\n", "flat": "f 1 1 2\n"}
    for name, more in files.items():
        path = tmp_path / f"meshes/mug/train/{name}.obj"
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(TETRAHEDRON + more)
    out = tmp_path / "out"
    command = ["render", "pm40", "--source", str(tmp_path / "meshes"), "--out", str(out)]
    options = ["--setting", "rotated", "--views", "1", "--points", "32", "--workers", "1"]
    result = CliRunner().invoke(app, [*command, *options])
    assert result.exit_code == 0, result.output
    lines = [json.loads(line) for line in (out / "objects.jsonl").read_text().splitlines()]
    assert {line["name"]: line["notices"] for line in lines} == {
        "mug/plain": [],
        "mug/one": ["1 lines are no surface and were left out"],
        "mug/two": ["2 lines are no surface and were left out"],
        "mug/flat": ["1 faces without area are no shape and were left out"],
    }
    told = [
        "2 objects (the first: mug/one): 1 lines are no surface and were left out",
        "1 object (the first: mug/flat): 1 faces without area are no shape and were left out",
    ]
    assert notice_lines(out) == told
    for line in told:
        assert f"note: {line}" in result.stderr
        assert f"- {line}" in (out / "CARD.md").read_text()
    assert CliRunner().invoke(app, ["verify", str(out)]).exit_code == 0


def test_a_vertex_of_no_face_may_be_no_point() -> None:
    mesh = read_mesh((TETRAHEDRON + "v nan nan nan\n").encode(), ".obj")
    assert mesh.metadata["notices"] == ("1 vertices that no face uses are no finite points",)
    plain = normalise(read_mesh(TETRAHEDRON.encode(), ".obj"))
    np.testing.assert_array_equal(normalise(mesh).triangles, plain.triangles)


@pytest.mark.parametrize("number", ["nan", "inf", "-inf"])
def test_a_vertex_of_a_face_may_not(number: str) -> None:
    with pytest.raises(InputError, match="expected finite numbers"):
        read_mesh(TETRAHEDRON.replace("v 0 1 0", f"v 0 {number} 0").encode(), ".obj")
