"""A user's own capture, a cloud or a depth image → class, confidence, pose."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from partialbench import user_code
from partialbench.benchmark import inputs
from partialbench.benchmark.captures import captures, read_points
from partialbench.benchmark.device import find_device
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.training import checkpoint
from partialbench.benchmark.training.trunk import RunFolder, progress
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins

__all__ = ["Answer", "Classifier", "captures", "draw", "find_checkpoint", "predict", "read_points"]

log = logging.getLogger(__name__)

VOTES = 8


@dataclass(frozen=True)
class Answer:
    """What a model says about one cloud.

    Attributes:
        top: up to five (class name, probability), best first.
        points_given, points_used: in the file, and seen by the model over all votes.
        poses: up to five (R_camera_object (3,3), probability) over the 60 bins, best first; empty
            for a model without pose. A bin is within 44.5° of every rotation it stands for.
    """

    top: list[tuple[str, float]]
    points_given: int
    points_used: int
    poses: list[tuple[NDArray[np.float64], float]]

    @property
    def class_name(self) -> str:
        return self.top[0][0]

    @property
    def confidence(self) -> float:
        return self.top[0][1]


def predict(
    checkpoint_file: Path | str,
    file: Path | str,
    K: ArrayLike | None = None,
    depth_scale: float = 1.0,
    device: str = "cpu",
    votes: int = VOTES,
    model: str | None = None,
) -> Answer:
    """Classifies one segmented object: see ``Classifier``, which keeps its model for many."""
    return Classifier(checkpoint_file, device, model)(file, K, depth_scale, votes)


class Classifier:
    """A trained model, to be asked about files.

    A model is best on clouds of as many points as it was trained on. A denser capture is cut at
    random into clouds of that many, and their probabilities are averaged.

    Args:
        weights: a checkpoint written by ``partialbench eval``, its run's folder, or a folder of
            results with one run; nothing else is needed.
        device: "cpu", "cuda", "cuda:1", or "auto".
        model: "module:factory" of a model of one's own: named here, never by the checkpoint.

    Raises:
        InputError: no such device, or weights that make no model.
    """

    def __init__(self, weights: Path | str, device: str = "cpu", model: str | None = None) -> None:
        kind, index = find_device(device)
        self.device = torch.device(kind if index is None else f"{kind}:{index}")
        path = find_checkpoint(Path(weights))
        model = None if model is None else user_code.named(model)
        self.content = checkpoint.load(path)
        checkpoint.require_finished(self.content, path, "classify")
        self.model = checkpoint.build_model(self.content, model).to(self.device)
        if inputs.needs_normals(self.model):
            raise InputError(
                f"{path} holds a {self.content['model']!r}, which takes normals; captures are read "
                f"without, so give a checkpoint of a model that takes points alone"
            )
        if changed := checkpoint.changed_code(self.content, model):
            log.warning("%s: %s", path, changed)

    def __call__(
        self,
        file: Path | str,
        K: ArrayLike | None = None,
        depth_scale: float = 1.0,
        votes: int = VOTES,
    ) -> Answer:
        """What the model says of one file.

        Args:
            file: a cloud (.ply, .pcd, .xyz, .txt, .csv, .pts, .npy (N,3)) or a z-depth image (.png
                of 16 bits, .tif, .npy (H,W)), of the object alone; camera frame x right, y down,
                z forward.
            K: (3,3) intrinsics in pixels, or (fx, fy, cx, cy); needed for a depth image.
            depth_scale: units of the file's depth values: 0.001 for millimetres.
            votes: at most so many clouds, without a point in common.

        Raises:
            InputError: a file that cannot be read or is no shape, a depth image without K, no
                votes, or a model that cannot answer.
        """
        if votes < 1:
            raise InputError(f"votes must be at least 1, got {votes}")
        given = read_points(Path(file), K, depth_scale)
        count, names = self.content["num_points"], self.content["class_names"]
        clouds = draw(given, count, min(votes, max(1, len(given) // count)))
        try:
            with torch.inference_mode():
                output = self.model(torch.from_numpy(clouds).to(self.device))
            prediction = as_prediction(output, len(clouds), len(names))
        except Exception as error:  # whatever a model does not like about a cloud
            raise InputError(
                f"{file}: the model cannot answer ({type(error).__name__}: {error})"
            ) from error
        shares = prediction.class_logits.double().softmax(1).mean(0)
        if not bool(torch.isfinite(shares).all()):
            raise InputError(
                f"{file}: the model's answer is not a finite number; its weights, or this cloud, "
                f"are not what it can work with"
            )
        values, order = shares.topk(min(5, len(names)))
        top = [(names[int(i)], float(v)) for v, i in zip(values, order, strict=True)]
        poses = []
        if prediction.pose_logits is not None:
            values, order = prediction.pose_logits.double().softmax(1).mean(0).topk(5)
            poses = [
                (rotation_bins()[int(i)], float(v)) for v, i in zip(values, order, strict=True)
            ]
        return Answer(top, len(given), clouds.shape[0] * clouds.shape[1], poses)


BRANCHES = "branch-*/checkpoint.pt"


def _furthest(run: Path) -> Path:
    """Of a training's finished milestones the one with the most clouds."""
    done = progress(run).milestones_done
    if not done:
        raise InputError(f"{run} has no finished milestone yet; run the same eval again")
    return RunFolder(run).branch(max(done))


def find_checkpoint(path: Path) -> Path:
    """The checkpoint that a file, a run's folder or a folder of results with one run means."""
    if not path.is_dir():
        return path
    found = [
        _furthest(run)
        for pattern in (".", "*", "runs/*")
        for run in sorted(path.glob(pattern) if pattern != "." else [path])
        if any(run.glob(BRANCHES))
    ]
    if not found:
        raise InputError(f"no checkpoint in {path}; expected one that partialbench eval wrote")
    if len(found) > 1:
        named = ", ".join(str(one.parents[1].relative_to(path)) for one in found[:6])
        raise InputError(f"{path} has {len(found)} runs, give the folder of one: {named}")
    return found[0]


def draw(points: NDArray, count: int, clouds: int = 1) -> NDArray[np.float32]:
    """(clouds,count,3) of the points, drawn without replacement by a fixed seed, in random order.

    Where there are fewer, all of them, and repeats after: as the shards are made.
    """
    rng = generator(0, "predict", len(points))
    order, wanted = rng.permutation(len(points)), clouds * count
    if len(points) < wanted:
        order = np.concatenate([order, rng.integers(0, len(points), wanted - len(points))])
    return np.ascontiguousarray(points[order[:wanted]], np.float32).reshape(clouds, count, 3)
