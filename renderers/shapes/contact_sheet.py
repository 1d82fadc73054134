"""All families in one picture: ``python -m renderers.shapes.contact_sheet --out FILE.png``.

Every object stands on the picture plane, seen from the front left and above, in one scene that
Mitsuba renders once.
"""

from __future__ import annotations

import io
import itertools
import math
import os
import tempfile
from pathlib import Path
from typing import Annotated

import mitsuba as mi
import numpy as np
import trimesh
import typer
from numpy.typing import NDArray

from partialbench.dataset.shards import write_atomically
from partialbench.geometry.rotations import axis_rotation
from renderers.shapes.catalogue import FAMILIES, make
from renderers.shapes.family import Family
from renderers.shapes.solids import Solid, join
from renderers.variants import activate

PITCH, LINE = 2.05, 2.5
"""Distance of neighbours along a row and between rows, in object radii."""
TURNED = {"piano": 180.0}
"""Classes whose front is not to be seen from −x, −y: degrees about z."""
SEE_THROUGH = ("glass_box",)

# From the object frame to the picture's: x right, y up, z towards the eye.
_VIEW = axis_rotation("x", math.radians(-90 + 24)) @ axis_rotation("z", math.radians(35))


def draw(
    out: Path,
    instances: int = 4,
    columns: int = 5,
    pixels: int = 80,
    samples: int = 64,
    seed: int = 0,
) -> Path:
    """Render ``instances`` objects of every class, of different variants, as a PNG.

    Args:
        out: the file to write.
        columns: classes side by side.
        pixels: width of one object.
        samples: light paths a pixel.
        seed: of the objects.

    Returns:
        ``out``.
    """
    rows = math.ceil(len(FAMILIES) / columns)
    width, height = columns * instances * PITCH, rows * LINE
    parts: dict[bool, list[Solid]] = {False: [], True: []}
    labels = []
    for at, name in enumerate(FAMILIES):
        row, column = divmod(at, columns)
        y = height / 2 - (row + 0.57) * LINE
        left = column * instances * PITCH
        labels.append((left / width, row / rows, name))
        view = _VIEW @ axis_rotation("z", math.radians(TURNED.get(name, 0.0)))
        for i, index in enumerate(varied(FAMILIES[name], instances, seed)):
            mesh = make(name, index, seed)
            x = left + (i + 0.5) * PITCH - width / 2
            placed = Solid(mesh.vertices @ view.T, mesh.faces).at(x, y)
            parts[name in SEE_THROUGH].append(placed)
    clay, glass = join(parts[False]), join(parts[True])
    image = _render(clay, glass, width, height, pixels / PITCH, samples)
    return _write(image, labels, Path(out))


def varied(family: Family, count: int, seed: int = 0) -> list[int]:
    """The first ``count`` indices that show as many variants as they can, the heaviest first."""
    found: dict[str, list[int]] = {}
    for index in range(64 * count):
        found.setdefault(family.draw(index, seed).variant, []).append(index)
    rounds = itertools.zip_longest(*sorted(found.values(), key=len, reverse=True))
    return [index for row in rounds for index in row if index is not None][:count]


def _render(
    clay: Solid, glass: Solid, width: float, height: float, scale: float, samples: int
) -> NDArray[np.uint8]:
    """(H,W,3) picture of both on white, seen along −z; ``scale`` is pixels a unit."""
    activate("scalar_rgb", threads=os.cpu_count() or 1)  # the same picture on every machine
    transform = mi.ScalarTransform4f
    matt = {
        "type": "twosided",
        "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.55, 0.62, 0.72]}},
    }
    with tempfile.TemporaryDirectory() as folder:
        meshes = {}
        for name, solid, bsdf in (
            ("clay", clay, matt),
            ("glass", glass, {"type": "mask", "opacity": 0.3, "bsdf": matt}),
        ):
            path = Path(folder) / f"{name}.ply"
            trimesh.Trimesh(solid.vertices, solid.faces, process=False).export(path)
            meshes[name] = {
                "type": "ply", "filename": str(path), "face_normals": True, "bsdf": bsdf,
            }  # fmt: skip
        scene = mi.load_dict({
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 9, "rr_depth": 3, "hide_emitters": True},
            "sensor": {
                "type": "orthographic",
                "to_world": transform().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0])
                @ transform().scale([width / 2, width / 2, 1]),
                "film": {"type": "hdrfilm", "width": round(width * scale),
                         "height": round(height * scale), "pixel_format": "rgba"},
                "sampler": {"type": "independent", "sample_count": samples},
            },
            "sky": {"type": "constant", "radiance": 0.45},
            "sun": {"type": "directional", "direction": [0.5, -0.9, -0.8], "irradiance": 1.9},
            **meshes,
        })  # fmt: skip
        rgba = np.array(mi.render(scene), np.float64)
    linear = rgba[..., :3] + 1 - rgba[..., 3:]
    curve = 1.055 * linear.clip(1e-9) ** (1 / 2.4) - 0.055
    srgb = np.where(linear < 0.0031308, 12.92 * linear, curve)
    return np.round(srgb.clip(0, 1) * 255).astype(np.uint8)


def _write(image: NDArray[np.uint8], labels: list[tuple[float, float, str]], out: Path) -> Path:
    """The picture with the class names, at one screen pixel a pixel."""
    import matplotlib

    matplotlib.use("agg")
    from matplotlib import pyplot

    height, width = image.shape[:2]
    figure = pyplot.figure(figsize=(width / 100, height / 100), dpi=100)
    axes = figure.add_axes((0, 0, 1, 1))
    axes.imshow(image, interpolation="nearest")
    axes.set_axis_off()
    for x, y, name in labels:
        axes.text(x * width + 8, y * height + 2, name, va="top", fontsize=10, color="#222222")
    out.parent.mkdir(parents=True, exist_ok=True)
    png = io.BytesIO()
    figure.savefig(png, format="png")
    pyplot.close(figure)
    write_atomically(out, png.getvalue())
    return out


def main(
    out: Annotated[Path, typer.Option(help="the PNG to write")] = Path("docs/images/shapes.png"),
    instances: Annotated[int, typer.Option(help="objects of each class")] = 4,
    seed: Annotated[int, typer.Option(help="another seed, other shapes")] = 0,
) -> None:
    """Draw objects of every built-in family."""
    draw(out, instances, seed=seed)


if __name__ == "__main__":
    typer.run(main)
