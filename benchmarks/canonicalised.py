"""The paper's qualitative figure: a cloud turned back from its five likeliest poses.

    python -m benchmarks.canonicalised --checkpoint RUN/branch-25k/checkpoint.pt --data DIR \\
        --figure docs/images/canonicalised.png

For the first test cloud of each of some classes: the cloud as the camera sees it, then Rᵀ(p − mean)
for the five bins R of the greatest probability, and for the true R. All canonical clouds are drawn
from one direction, in front, to the right and above, so that a right pose gives an upright object
that faces the same way as the last picture of its row. A frame marks the bin nearest to the truth,
under the symmetry of the class.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np
import torch
from matplotlib.axes import Axes
from numpy.typing import NDArray

from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.training import checkpoint
from partialbench.dataset.loader import ShardDataset
from partialbench.geometry.bins import nearest_bins, rotation_bins
from partialbench.geometry.camera import look_at
from partialbench.geometry.symmetry import map_rotations

CLASSES = ("airplane", "chair", "car", "guitar", "toilet", "bottle")
POSES = 5
EYE = (-2.0, -3.0, 1.6)
"""Of the object frame: the canonical clouds are seen from here."""


def draw(axes: Axes, cloud: NDArray, title: str, marked: bool = False) -> None:
    """A cloud (N,3) in an OpenCV camera frame: x right, y down; near points dark and on top."""
    order = np.argsort(-cloud[:, 2])
    x, y, z = cloud[order].T
    axes.scatter(x, -y, s=5, c=z, cmap="viridis", linewidths=0)
    axes.set(xlim=(-1, 1), ylim=(-1, 1), aspect="equal", xticks=[], yticks=[])
    axes.set_title(title, fontsize=8, pad=3)
    for spine in axes.spines.values():
        spine.set(visible=marked, color="#d95f02", linewidth=2)


def figure(path: Path, data: Path, out: Path) -> None:
    content = checkpoint.load(path)
    model, names = checkpoint.build_model(content).eval(), content["class_names"]
    test = ShardDataset(data, "test", content["num_points"])
    classes = [c for c in CLASSES if c in test.class_names]
    rows = np.array([np.flatnonzero(test.labels == test.class_names.index(c))[0] for c in classes])
    points = test.points(rows)
    with torch.inference_mode():
        answer = as_prediction(model(torch.from_numpy(points)), len(rows), len(names))
    if answer.pose_logits is None:
        raise SystemExit(f"error: {content['model']} finds no poses; give a checkpoint that does")
    probabilities = answer.pose_logits.softmax(1).numpy()
    classified = answer.class_logits.softmax(1)
    true = map_rotations(test.rotations[rows], test.symmetries[rows])
    right = nearest_bins(true)[:, 0]
    view, _ = look_at(EYE)
    fig, axes = plt.subplots(
        len(rows), POSES + 2, figsize=(1.35 * (POSES + 2), 1.5 * len(rows)), squeeze=False
    )
    for i, line in enumerate(axes):
        centred = points[i] - points[i].mean(axis=0)
        centred /= np.linalg.norm(centred, axis=1).max()
        found = int(classified[i].argmax())
        draw(line[0], centred, f"{classes[i]}: {names[found]} {classified[i, found]:.0%}")
        for ax, b in zip(line[1:], np.argsort(-probabilities[i])[:POSES], strict=False):
            turned = centred @ rotation_bins()[b] @ view.T
            draw(ax, turned, f"{probabilities[i, b]:.0%}", marked=b == right[i])
        draw(line[-1], centred @ true[i] @ view.T, "true pose")
    fig.tight_layout(pad=0.4)
    fig.savefig(out, dpi=110, metadata={"Software": None})


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").split("\n")[0])
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument("--figure", type=Path, required=True)
    given = parser.parse_args()
    figure(given.checkpoint, given.data, given.figure)


if __name__ == "__main__":
    main()
