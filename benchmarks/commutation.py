"""Does a network's answer for a turned cloud equal its turned answer? PAPNet's method rests on it.

    python -m benchmarks.commutation [--clouds 4] [--figure docs/images/commutation.png]

For a rotation R of a given angle about a random axis, the relative error ‖Φ(R·P) − T_R Φ(P)‖/‖Φ(P)‖
over clouds P, for the backbone of the release, the same backbone with its pooling and upsampling
centred on the grid, what either leaves of it once the class branch has pooled it, and the
descriptor of ``papnet-steered``. Weights are random, batch norm is settled on the same clouds;
clouds are the visible part of built-in shapes by hidden point removal. Turns of the grid by 90° and
180° about its axes come first: there nothing is interpolated.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation
from torch import Tensor, nn

from baselines.points import normalise
from baselines.steerable.fields import wigner_matrix
from papnet.parts import GRID, Backbone, ClassHead, pool
from papnet.rotate_field import rotate_field
from papnet.steered.model import PAPNetSteered
from renderers.hpr import hidden_point_removal, paper_radius
from renderers.shapes.source import ParametricShapes
from renderers.whole import sample_surface

CLASSES = ("airplane", "chair", "guitar", "lamp", "toilet", "car", "sofa", "piano")
ANGLES_DEG = (2, 5, 10, 20, 30, 45, 60, 90, 120, 150, 180)
GRID_TURNS = {"grid 90": np.array([0, 0, 90.0]), "grid 180": np.array([0, 180.0, 0])}
Curves = dict[str, dict[str, float]]


def centred_pool(x: Tensor) -> Tensor:
    """Pooling to half the edge whose output voxels lie between the input's: no drift."""
    return nn.functional.avg_pool3d(x, 2)


class CentredBackbone(Backbone):
    """The released backbone, its weights and layers, on grids that share one centre."""

    align_corners = False

    def first(self, volume: Tensor) -> Tensor:
        return centred_pool(self.conv1(volume))

    def halve(self, x: Tensor) -> Tensor:
        return centred_pool(x)


def single_views(count: int, points: int) -> Tensor:
    """(count, points, 3) normalised visible parts of built-in shapes, one class each."""
    rng = np.random.default_rng(0)
    source = ParametricShapes((1, 0))
    objects = {source.class_names[ref.label]: ref for ref in source.objects("train")}
    clouds = []
    for name in CLASSES[:count]:
        whole = sample_surface(source.load(objects[name]), 4 * points, rng)
        viewpoint = rng.standard_normal(3)
        viewpoint *= 3 / np.linalg.norm(viewpoint)
        radius = paper_radius(whole, viewpoint, gamma=1.75)
        visible = whole[hidden_point_removal(whole, viewpoint, radius)]
        clouds.append(visible[rng.choice(len(visible), points, replace=len(visible) < points)])
    return normalise(torch.as_tensor(np.stack(clouds), dtype=torch.float32))


def relative(difference: Tensor, reference: Tensor) -> float:
    return float(difference.norm() / reference.norm())


def grid_errors(
    backbone: Backbone, head: ClassHead, pooling: Callable[[Tensor], Tensor], clouds: Tensor
) -> Callable[[Tensor], dict[str, float]]:
    """R → errors of the volume (its inner half) and of the pooled scalars and vectors."""

    def describe(volume: Tensor) -> Tensor:
        return head.describe(pooling(head.conv0(volume)))

    seen = backbone(clouds, GRID)
    described = describe(seen)
    quarter = seen.shape[-1] // 4
    inner = (..., *(slice(quarter, -quarter),) * 3)

    def errors(R: Tensor) -> dict[str, float]:
        turned = backbone(clouds @ R[0].T, GRID)
        expected = rotate_field(seen, R.expand(len(clouds), 3, 3), Backbone.fields)
        after = head.descriptor.rotate_components(
            described, head.descriptor.wigner(R.expand(len(clouds), 3, 3))
        )
        # What the method does: the volume turned, then described; against the description turned.
        before, scalars = describe(expected), head.descriptor.degrees[0][2]
        vectors = head.descriptor.degrees[1][2]
        return {
            "volume": relative((turned - expected)[inner], seen[inner]),
            "pooled scalars": relative((before - after)[:, scalars], described[:, scalars]),
            "pooled vectors": relative((before - after)[:, vectors], described[:, vectors]),
        }

    return errors


def steered_error(model: PAPNetSteered, clouds: Tensor) -> Callable[[Tensor], dict[str, float]]:
    """R → error of the whole descriptor."""

    def stacked(points: Tensor) -> list[Tensor]:
        return list(model.descriptor(points).steerable.values())

    seen = stacked(clouds)

    def errors(R: Tensor) -> dict[str, float]:
        turned = [x @ wigner_matrix(degree, R[0]).T for degree, x in enumerate(seen)]
        difference = [a - b for a, b in zip(stacked(clouds @ R[0].T), turned, strict=True)]
        flat = [torch.cat([part.flatten(1) for part in parts], 1) for parts in (difference, seen)]
        return {"descriptor": relative(*flat)}

    return errors


@torch.no_grad()
def measure(count: int) -> Curves:
    """{curve: {turn: error}}, means over three axes an angle."""
    clouds = single_views(count, 1024)
    curves: Curves = {}
    axes: NDArray[Any] = np.random.default_rng(1).standard_normal((3, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = {name: vector[None] for name, vector in GRID_TURNS.items()}
    turns |= {str(angle): angle * axes for angle in ANGLES_DEG}
    for name, maker, pooling in (
        ("released", Backbone, pool), ("centred", CentredBackbone, centred_pool)
    ):  # fmt: skip
        torch.manual_seed(0)
        backbone, head = maker(), ClassHead(40)
        for _ in range(3):
            head.describe(pooling(head.conv0(backbone(clouds, GRID))))
        _measure(name, grid_errors(backbone.eval(), head.eval(), pooling, clouds), turns, curves)
    torch.manual_seed(0)
    steered = PAPNetSteered(40)
    steered.joint(clouds)
    _measure("papnet-steered", steered_error(steered.eval(), clouds), turns, curves)
    return curves


def _measure(
    name: str,
    errors: Callable[[Tensor], dict[str, float]],
    turns: dict[str, NDArray[Any]],
    curves: Curves,
) -> None:
    for turn, vectors in turns.items():
        found = []
        for vector in vectors:
            R = Rotation.from_rotvec(vector, degrees=True).as_matrix()
            found.append(errors(torch.as_tensor(R[None], dtype=torch.float32)))
        for part in found[0]:
            mean = float(np.mean([each[part] for each in found]))
            curves.setdefault(f"{name}: {part}", {})[turn] = mean


def draw(curves: Curves, path: Path) -> None:
    """Error against the angle; the turns of the grid are marked at their angle."""
    import matplotlib as mpl

    mpl.use("Agg")
    from matplotlib import pyplot as plt

    figure, axes = plt.subplots(figsize=(7.2, 4.2), layout="constrained")
    styles = {"volume": "-", "pooled scalars": "--", "pooled vectors": ":", "descriptor": "-"}
    colours = {"released": "#b2432f", "centred": "#2f6db2", "papnet-steered": "#2a8a4a"}
    for label, curve in curves.items():
        name, part = label.split(": ")
        values = [curve[str(angle)] for angle in ANGLES_DEG]
        axes.plot(ANGLES_DEG, values, styles[part], color=colours[name], label=label, lw=1.6)
        for turn, vector in GRID_TURNS.items():
            # An exact zero has no place on a logarithmic axis: it is drawn at rounding.
            angle, value = np.abs(vector).max(), max(curve[turn], 1e-8)
            axes.plot(angle, value, "s", color=colours[name], ms=4, mfc="white")
    axes.set(
        yscale="log", ylim=(5e-9, 20), xlabel="angle of the rotation (°)", ylabel="relative error",
        xticks=range(0, 181, 30),
    )  # fmt: skip
    axes.grid(alpha=0.3)
    axes.legend(fontsize=7, loc=(0.02, 0.29), title="squares: turns of the grid", title_fontsize=8)
    figure.savefig(path, dpi=150)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--clouds", type=int, default=4, choices=range(1, len(CLASSES) + 1))
    parser.add_argument("--figure", type=Path, help="draw the curves into this file")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    curves = measure(arguments.clouds)
    if arguments.figure:
        draw(curves, arguments.figure)
    if arguments.json:
        sys.stdout.write(json.dumps(curves, indent=1) + "\n")
        return
    turns = list(next(iter(curves.values())))
    sys.stdout.write(f"{'angle (°)':<28}" + "".join(f"{turn:>9}" for turn in turns) + "\n")
    for label, curve in curves.items():
        values = "".join(f"{value:>9.1e}" for value in curve.values())
        sys.stdout.write(f"{label:<28}{values}\n")


if __name__ == "__main__":
    main()
