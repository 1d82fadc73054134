"""``partialbench show``: a page of samples that a person can judge, as PNG or interactive HTML.

Each cloud is drawn as its camera sees it (x right, y down), coloured by depth, near bright, with
the object's canonical axes (x red, y green, z blue) and the visible fraction in its title.
"""

from __future__ import annotations

import html
import io
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from plotly.graph_objects import Figure

from partialbench.dataset import manifest as manifests
from partialbench.dataset.loader import ShardDataset
from partialbench.dataset.names import printable
from partialbench.dataset.seeding import generator
from partialbench.dataset.shards import make_folder, write_atomically
from partialbench.dataset.sources import View
from partialbench.errors import InputError

AXIS_COLOURS = {"x": "#d62728", "y": "#2ca02c", "z": "#1f77b4"}


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
    stored = int(manifests.load(Path(folder)).configuration["points"])
    data = ShardDataset(folder, split, stored)
    rows = choose_rows(data.labels, samples, seed)
    make_folder(out.parent)
    if out.suffix.lower() == ".png":
        _write_png(data, rows, out)
    else:
        _write_html(data, rows, out)
    return out


def choose_rows(labels: NDArray, samples: int, seed: int) -> NDArray[np.int64]:
    """Row indices that go round the classes, so that a page shows as many of them as it can."""
    if samples < 1:
        raise InputError(f"samples must be at least 1, got {samples}")
    rng = generator(seed, "show")
    order = rng.permutation(len(labels))
    turn: dict[int, int] = {}
    rounds = np.zeros(len(labels), np.int64)
    for row in order:
        label = int(labels[row])
        rounds[row] = turn[label] = turn.get(label, -1) + 1
    ranked = order[np.argsort(rounds[order], kind="stable")]
    chosen = ranked[:samples]
    return chosen[np.argsort(labels[chosen], kind="stable")]


def _write_png(data: ShardDataset, rows: NDArray[np.int64], out: Path) -> None:
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure as Page

    columns = min(6, len(rows))
    lines = -(-len(rows) // columns)
    figure = Page(figsize=(2.3 * columns, 2.55 * lines + 0.5), dpi=120)
    FigureCanvasAgg(figure)
    figure.suptitle(f"{data.dataset_id} · {data.split} · {data.setting}", fontsize=11)
    for n, (row, cloud) in enumerate(zip(rows, data.points(rows), strict=True)):
        axes = figure.add_subplot(lines, columns, n + 1)
        far_first = np.argsort(-cloud[:, 2])
        x, y = picture(cloud, data.translations[row])[far_first].T
        axes.scatter(x, y, c=-cloud[far_first, 2], s=1.5, cmap="viridis", lw=0)
        _draw_axes(axes, data.rotations[row])
        # A name may have signs that are mathematics to Matplotlib.
        axes.set_title(_title(data, row, "\n"), fontsize=6.5, parse_math=False)
        axes.set_aspect("equal")
        axes.set_xlim(-1.3, 1.3)
        axes.set_ylim(1.3, -1.3)  # y points down
        axes.axis("off")
    figure.tight_layout(rect=(0, 0, 1, 0.97))
    page = io.BytesIO()
    figure.savefig(page, format="png")
    write_atomically(out, page.getvalue())


def picture(cloud: NDArray, centre: NDArray) -> NDArray:
    """(n,2) where a camera-frame cloud (n,3) appears about its object's centre (3,), object units.

    In perspective, on the plane through the centre; flat where the centre is not in front of the
    camera: a release that gives no translation has it at the origin.
    """
    if centre[2] <= 0:
        return cloud[:, :2] - centre[:2]
    return (cloud[:, :2] / cloud[:, 2:] - centre[:2] / centre[2]) * centre[2]


def _title(data: ShardDataset, row: int, after_class: str) -> str:
    """Class, object and the share that is seen, where it is known."""
    share = data.visible_fraction[row]
    seen = f" · {share:.0%} seen" if share > 0 else ""
    category, name = data.class_names[data.labels[row]], str(data.object_ids[row])
    return f"{printable(category)}{after_class}{printable(name)}{seen}"


def _draw_axes(axes: Axes, rotation: NDArray, length: float = 0.3) -> None:
    """The object's canonical axes in the lower left corner, foreshortened as in the picture."""
    corner = np.array([-0.95, 0.95])
    for direction, colour in zip(rotation.T, AXIS_COLOURS.values(), strict=True):
        tip = direction[:2] * length
        axes.annotate(
            "",
            tuple(corner + tip),
            tuple(corner),
            arrowprops={"arrowstyle": "->", "color": colour, "lw": 1.2},
        )


def figure(
    data: Any,
    R: NDArray | None = None,
    *,
    split: str = "train",
    samples: int = 8,
    seed: int = 0,
) -> Figure:
    """Clouds to turn by hand, as a Plotly figure: a notebook shows it by itself.

    Args:
        data: a data folder, a ``ShardDataset`` or ``TorchDataset``, a ``View``, or clouds (N,3) or
            (B,N,3), camera frame.
        R: the pose R_camera_object (3,3) or (B,3,3) of given clouds, drawn as the object's axes.
        split: of a data folder.
        samples: how many rows of a data set.
        seed: which ones.

    Raises:
        InputError: nothing of the kind.

    ::

        partialbench.show("data/pm40")
        partialbench.show(view)                       # of render_view
        partialbench.show(points, answer.rotation)    # a capture, with the pose that was found
    """
    shards = getattr(data, "shards", data)
    if isinstance(shards, str | Path):
        stored = int(manifests.load(Path(shards)).configuration["points"])
        shards = ShardDataset(shards, split, stored)
    if isinstance(shards, ShardDataset):
        if R is not None:
            raise InputError("R belongs to given clouds; a data set has its own poses")
        return _of_rows(shards, choose_rows(shards.labels, samples, seed))
    if isinstance(data, View):
        seen = f"{data.visible_fraction:.0%} seen"
        return _drawn([data.points], [data.R_camera_object], [seen], "")
    clouds = np.asarray(data, np.float64)
    clouds = clouds[None] if clouds.ndim == 2 else clouds
    if clouds.ndim != 3 or clouds.shape[2] != 3 or 0 in clouds.shape:
        raise InputError(
            f"expected a data folder, a data set, a View, or clouds (N,3) or (B,N,3); got a "
            f"{type(data).__name__} of shape {np.shape(data)}"
        )
    rotations: list[NDArray | None] = [None] * len(clouds)
    if R is not None:
        given = np.asarray(R, np.float64)
        given = given[None] if given.ndim == 2 else given
        if given.shape != (len(clouds), 3, 3):
            raise InputError(f"R has shape {np.shape(R)}, expected (3,3) for each of the clouds")
        rotations = list(given)
    return _drawn(list(clouds), rotations, [""] * len(clouds), "")


def _write_html(data: ShardDataset, rows: NDArray[np.int64], out: Path) -> None:
    page = _of_rows(data, rows).to_html(include_plotlyjs=True, full_html=True, div_id="samples")
    write_atomically(out, page.encode())


def _of_rows(data: ShardDataset, rows: NDArray[np.int64]) -> Figure:
    titles = [html.escape(_title(data, row, " · "), quote=False) for row in rows]
    rotations: list[NDArray | None] = list(data.rotations[rows])
    about = f"{data.dataset_id} · {data.split} · {data.setting}: drag to turn"
    return _drawn(list(data.points(rows)), rotations, titles, about)


def _drawn(
    clouds: list[NDArray], rotations: list[NDArray | None], titles: list[str], about: str
) -> Figure:
    """A scene a cloud, seen from the camera, with the object's axes where the pose is known."""
    import plotly.graph_objects as go
    from plotly.subplots import make_subplots

    columns = min(4, len(clouds))
    lines = -(-len(clouds) // columns)
    figure = make_subplots(
        lines, columns, specs=[[{"type": "scene"}] * columns] * lines, subplot_titles=titles,
        horizontal_spacing=0.01, vertical_spacing=0.4 / lines / 4,
    )  # fmt: skip
    for n, (cloud, rotation) in enumerate(zip(clouds, rotations, strict=True)):
        place = {"row": n // columns + 1, "col": n % columns + 1}
        centred = cloud - cloud.mean(0)
        x, y, z = np.round(centred, 3).T
        marker = {"size": 1.6, "color": np.round(-cloud[:, 2], 3), "colorscale": "Viridis"}
        figure.add_trace(
            go.Scatter3d(x=x, y=y, z=z, mode="markers", marker=marker, hoverinfo="skip"), **place
        )
        axes = () if rotation is None else zip(rotation.T, AXIS_COLOURS.items(), strict=True)
        for direction, (axis, colour) in axes:
            tip = direction * 0.6
            figure.add_trace(
                go.Scatter3d(
                    x=[0, tip[0]], y=[0, tip[1]], z=[0, tip[2]], mode="lines+text",
                    text=["", axis], line={"color": colour, "width": 4}, hoverinfo="skip",
                ),
                **place,
            )  # fmt: skip
    # Seen from the camera: looking along +z, y down.
    view = {"eye": {"x": 0, "y": 0, "z": -1.8}, "up": {"x": 0, "y": -1, "z": 0}}
    hidden = {"visible": False}
    figure.update_scenes(camera=view, aspectmode="data", xaxis=hidden, yaxis=hidden, zaxis=hidden)
    figure.update_annotations(font_size=11)
    figure.update_layout(
        title=about or None, height=300 * lines + 80, showlegend=False,
        margin={"l": 8, "r": 8, "t": 70 if about else 30, "b": 8},
    )  # fmt: skip
    return figure
