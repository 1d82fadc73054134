"""``partialbench show``: a page of samples that a person can judge, as PNG or interactive HTML.

Each sample twice: as its camera sees it (the depth image, x right, y down, near bright), and from
the side (the cloud, fainter the whole object where its source is at hand, the camera, and the
object's canonical axes: x red, y green, z blue). Picture and page show the same view.
"""

from __future__ import annotations

import base64
import html
import io
import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

from partialbench import given
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.names import printable
from partialbench.dataset.samples import PITCH, YAW, Scene, packed, projected, scenes
from partialbench.dataset.seeding import generator
from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.errors import InputError

AXIS_COLOURS = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}
POINTS = 1024
"""Of a cloud, at most."""
WHOLE_POINTS = 400
IMAGE = 96
"""Pixels of a depth image's longer side on a page, at most."""
_SPLAT = 40
"""Pixels of a depth image that is made of a cloud: few enough for a thousand points to fill."""


def show(folder: Path, out: Path, split: str = "train", samples: int = 24, seed: int = 0) -> Path:
    """Draw ``samples`` random rows of a data folder, classes mixed.

    Args:
        folder: made by ``partialbench render``.
        out: where to write; the suffix says what: .png or .html.
        split: which split to draw from.
        seed: which rows; the same seed shows the same rows.

    Returns:
        ``out``.
    """
    out = Path(out)
    if out.suffix.lower() not in (".png", ".html"):
        raise InputError(f"--out {out} must end in .png (a picture) or .html (to turn by hand)")
    data = ShardDataset(folder, split, num_points=1)
    stored: int = data.manifest.configuration["points"]
    data = ShardDataset(folder, split, num_points=min(POINTS, stored))
    rows = choose_rows(data.labels, samples, seed)
    make_folder(out.parent)
    write_atomically(out, _png(data, rows) if out.suffix.lower() == ".png" else _page(data, rows))
    return out


def choose_rows(labels: NDArray, samples: int, seed: int) -> NDArray[np.int64]:
    """Row indices that go round the classes, so that a page shows as many of them as it can."""
    samples = given.whole_number(samples, "samples", 1)
    rng = generator(given.whole_number(seed, "seed"), "show")
    order = rng.permutation(len(labels))
    turn: dict[int, int] = {}
    rounds = np.zeros(len(labels), np.int64)
    for row in order:
        label = int(labels[row])
        rounds[row] = turn[label] = turn.get(label, -1) + 1
    ranked = order[np.argsort(rounds[order], kind="stable")]
    chosen = ranked[:samples]
    return chosen[np.argsort(labels[chosen], kind="stable")]


def _png(data: ShardDataset, rows: NDArray[np.int64]) -> bytes:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    columns = min(4, len(rows))
    lines = -(-len(rows) // columns)
    figure = Figure(figsize=(3.9 * columns, 2.35 * lines + 0.5), dpi=110)
    FigureCanvasAgg(figure)
    figure.suptitle(_heading(data), fontsize=11, parse_math=False)
    pairs = zip(rows, scenes(data, rows.tolist(), WHOLE_POINTS), strict=True)
    for n, (row, scene) in enumerate(pairs):
        seen = figure.add_subplot(lines, 2 * columns, 2 * n + 1)
        seen.imshow(_depth_image(data, row))
        seen.axis("off")
        axes = figure.add_subplot(lines, 2 * columns, 2 * n + 2)
        _draw(axes, scene)
        # A name may have signs that are mathematics to Matplotlib.
        axes.set_title(_title(data, row, "\n"), fontsize=6.5, parse_math=False)
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    page = io.BytesIO()
    figure.savefig(page, format="png")
    return page.getvalue()


def _draw(axes: Axes, scene: Scene) -> None:
    """The scene from the side; the nearer the brighter, as on the page."""
    from matplotlib.colors import to_rgba

    for cloud, size, colour, alpha in (
        (scene.whole, 1.5, "#55606c", 0.45), (scene.points, 3.0, "#1f5fa8", 1.0),
    ):  # fmt: skip
        if not len(cloud):
            continue
        placed = projected(cloud)
        far_first = placed[np.argsort(-placed[:, 2])]
        nearness = alpha * (0.75 - 0.25 * far_first[:, 2].clip(-1, 1))
        colours = [to_rgba(colour, float(near)) for near in nearness]
        axes.scatter(far_first[:, 0], far_first[:, 1], s=size, c=colours, lw=0)
    for direction, colour in zip(scene.axes, AXIS_COLOURS.values(), strict=True):
        tip = projected(0.8 * direction)
        axes.plot([0, tip[0]], [0, tip[1]], color=colour, lw=1.6)
    for segment in scene.camera:
        axes.plot(*projected(segment)[:, :2].T, color="#55606c", lw=0.8)
    axes.set_aspect("equal")
    axes.set_xlim(-1.3, 1.3)
    axes.set_ylim(1.3, -1.3)  # y points down
    axes.axis("off")


def picture(cloud: NDArray, centre: NDArray) -> NDArray:
    """(n,2) where a camera-frame cloud (n,3) appears about its object's centre (3,), object units.

    In perspective, on the plane through the centre; flat where the centre is not in front of the
    camera: a release that gives no translation has it at the origin.
    """
    if centre[2] <= 0:
        return cloud[:, :2] - centre[:2]
    return (cloud[:, :2] / cloud[:, 2:] - centre[:2] / centre[2]) * centre[2]


def _depth_image(data: ShardDataset, row: int) -> NDArray[np.float64]:
    """(H,W,4) colours in [0, 1], nothing where there is no surface.

    Where the folder has no depth images it is made of the row's points, coarser.
    """
    if data.has_depth:
        depth = data.depth([row])[0].astype(float)
        depth = depth[:: -(-depth.shape[0] // IMAGE), :: -(-depth.shape[1] // IMAGE)]
    else:
        depth = splat(data.points([row])[0], data.translations[row])
    return coloured(depth)


def coloured(depth: NDArray) -> NDArray[np.float64]:
    """A depth image (H,W) as (H,W,4) colours in [0, 1], near bright, nothing where it is 0."""
    from matplotlib import colormaps

    surface = depth > 0
    near, far = (depth[surface].min(), depth[surface].max()) if surface.any() else (0.0, 1.0)
    colours: NDArray[np.float64] = colormaps["viridis"]((far - depth) / max(far - near, 1e-9))
    colours[~surface] = 0
    return colours


def splat(cloud: NDArray, centre: NDArray) -> NDArray[np.float64]:
    """(S,S) z-depth of the nearest point (n,3) in each pixel, 0 for none.

    A cloud without a camera in front of it is seen from afar along z, its depths made positive.
    """
    depth = cloud[:, 2].astype(float)
    depth = depth if depth.min() > 0 else depth - depth.min() + 1
    seen = picture(cloud, centre)
    places = (seen / (2.1 * max(1.0, float(np.abs(seen).max()))) + 0.5) * _SPLAT
    column, line = np.clip(places.astype(int), 0, _SPLAT - 1).T
    image = np.full((_SPLAT, _SPLAT), np.inf)
    np.minimum.at(image, (line, column), depth)
    return np.where(np.isfinite(image), image, 0.0)


def _heading(data: ShardDataset) -> str:
    return f"{data.dataset_id} · {data.split} · {data.setting}"


def _title(data: ShardDataset, row: int, after_class: str) -> str:
    """Class, object and the share that is seen, where it is known."""
    share = data.visible_fraction[row]
    seen = f" · {share:.0%} seen" if share > 0 else ""
    category, name = data.class_names[data.labels[row]], str(data.object_ids[row])
    return f"{printable(category)}{after_class}{printable(name)}{seen}"


def _page(data: ShardDataset, rows: NDArray[np.int64]) -> bytes:
    return page_of(_heading(data), samples_of(data, rows)).encode()


def samples_of(data: ShardDataset, rows: NDArray[np.int64]) -> list[dict[str, Any]]:
    """Rows as ``page_of`` takes them."""
    return [
        sample(_title(data, row, " · "), _depth_image(data, row), scene)
        for row, scene in zip(rows, scenes(data, rows.tolist(), WHOLE_POINTS), strict=True)
    ]


def sample(title: str, colours: NDArray, scene: Scene) -> dict[str, Any]:
    """One sample of a page: its depth image as colours (H,W,4), and its scene."""
    return {
        "title": title,
        "depth": _data_url(colours),
        "points": packed(scene.points),
        "whole": packed(scene.whole),
        "axes": np.round(scene.axes, 3).tolist(),
        "camera": np.round(scene.camera, 3).tolist(),
    }


def _data_url(colours: NDArray) -> str:
    from matplotlib import image

    buffer = io.BytesIO()
    image.imsave(buffer, colours, format="png")
    return f"data:image/png;base64,{base64.b64encode(buffer.getvalue()).decode()}"


def page_of(heading: str, samples: list[dict[str, Any]]) -> str:
    """The HTML page, one file; the samples' fields are what gallery.html reads."""
    folder = Path(__file__).parent
    script = (folder / "viewer.js").read_text(encoding="utf-8")
    text = (folder / "gallery.html").read_text(encoding="utf-8")
    # "</script" would end the element, whatever the quotes around it.
    data = json.dumps(samples, separators=(",", ":")).replace("<", "\\u003c")
    for mark, content in (
        ("@HEADING@", html.escape(heading)), ("@VIEW@", f"{YAW} {PITCH}"),
        ("@VIEWER@", script), ("@SAMPLES@", data),
    ):  # fmt: skip
        text = text.replace(mark, content)
    return text
