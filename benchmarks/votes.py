"""What cutting a dense cloud into clouds that vote is worth, as ``predict`` does it.

    python -m benchmarks.votes --checkpoint results/runs/…/checkpoint.pt --data DIR

Test accuracy of the mean probabilities over 1, 2, 4 and 8 clouds without a point in common, each of
as many points as the model was trained on, and of one cloud of all these points.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np
import torch

from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.predict import draw
from partialbench.benchmark.training import checkpoint
from partialbench.benchmark.training.memory import keep_freed_memory
from partialbench.dataset.loader import ShardDataset

BATCH = 16
NUMBERS = (1, 2, 4, 8)


def measure(path: Path, data: Path, most: int) -> dict[int, tuple[float, float]]:
    """{clouds: (accuracy by vote, accuracy of one cloud of all the points)}."""
    content = checkpoint.load(path)
    model, count = checkpoint.build_model(content), content["num_points"]
    numbers = [n for n in NUMBERS if n <= most]
    test = ShardDataset(data, "test", count * numbers[-1])

    def probabilities(clouds: torch.Tensor) -> torch.Tensor:
        output = as_prediction(model(clouds), len(clouds), len(content["class_names"]))
        return output.class_logits.softmax(1)

    right = {n: np.zeros(2) for n in numbers}
    with torch.inference_mode():
        for start in range(0, len(test), BATCH):
            rows = np.arange(start, min(start + BATCH, len(test)))
            points, label = test.points(rows), torch.from_numpy(test.labels[rows])
            clouds = torch.from_numpy(np.stack([draw(p, count, numbers[-1]) for p in points]))
            each = probabilities(clouds.flatten(0, 1)).unflatten(0, clouds.shape[:2])
            for n in numbers:
                together = clouds[:, :n].flatten(1, 2)
                for i, answer in enumerate((each[:, :n].mean(1), probabilities(together))):
                    right[n][i] += int((answer.argmax(1) == label).sum())
    return {n: (float(a), float(b)) for n, (a, b) in ((n, r / len(test)) for n, r in right.items())}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--checkpoint", type=Path, required=True)
    parser.add_argument("--data", type=Path, required=True)
    parser.add_argument(
        "--most", type=int, default=8, choices=NUMBERS, help="clouds; the data need their points"
    )
    arguments = parser.parse_args()
    keep_freed_memory()
    print(f"{'clouds':>6} {'by vote':>8} {'as one':>8}")
    for n, (vote, one) in measure(arguments.checkpoint, arguments.data, arguments.most).items():
        print(f"{n:6} {vote:8.1%} {one:8.1%}")


if __name__ == "__main__":
    main()
