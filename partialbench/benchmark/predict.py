"""A user's own capture, a cloud or a depth image → class, confidence, pose."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from partialbench import given, user_code
from partialbench.benchmark import inputs
from partialbench.benchmark.captures import captures, given_points, read_points
from partialbench.benchmark.device import find_device
from partialbench.benchmark.models import as_prediction
from partialbench.benchmark.records import weights as packaged
from partialbench.benchmark.testing.isolation import keyed_draws, unchanged
from partialbench.benchmark.training import checkpoint, packed
from partialbench.benchmark.training.find import find_checkpoint
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins

__all__ = [
    "Answer", "Classifier", "captures", "draw", "find_checkpoint", "load_model", "read_points",
]  # fmt: skip

log = logging.getLogger(__name__)

VOTES = 8


@dataclass(frozen=True, eq=False)
class Answer:
    """What a model says about one cloud.

    Attributes:
        class_names: of the K classes, by label.
        probabilities: (K,) float64 over them, the mean over the votes.
        pose_probabilities: (60,) float64 over the rotation bins (``geometry.bins``), or None for a
            model without pose. A bin is within 44.5° of every rotation it stands for.
        points_given, points_used: in the cloud, and seen by the model over all votes.
    """

    class_names: tuple[str, ...]
    probabilities: NDArray[np.float64]
    pose_probabilities: NDArray[np.float64] | None
    points_given: int
    points_used: int

    @property
    def top(self) -> list[tuple[str, float]]:
        """Up to five (class name, probability), best first."""
        return [
            (self.class_names[i], float(self.probabilities[i])) for i in _best(self.probabilities)
        ]

    @property
    def poses(self) -> list[tuple[NDArray[np.float64], float]]:
        """Up to five (R_camera_object (3,3), probability), best first; empty without pose."""
        if self.pose_probabilities is None:
            return []
        shares = self.pose_probabilities
        return [(rotation_bins()[i], float(shares[i])) for i in _best(shares)]

    @property
    def class_name(self) -> str:
        """The most probable class."""
        return self.top[0][0]

    @property
    def confidence(self) -> float:
        """Its probability."""
        return self.top[0][1]

    @property
    def rotation(self) -> NDArray[np.float64] | None:
        """R_camera_object (3,3) of the most probable bin, or None for a model without pose."""
        return self.poses[0][0] if self.poses else None

    def __repr__(self) -> str:
        shares = ", ".join(f"{name} {share:.1%}" for name, share in self.top[:3])
        return f"<Answer {shares}; {self.points_used:,} of {self.points_given:,} points>"


def _best(shares: NDArray[np.float64]) -> NDArray[np.int64]:
    """Indices of up to five, the largest first; of equal ones the first."""
    return np.argsort(-shares, kind="stable")[:5]


def load_model(
    weights: Path | str = packaged.DEFAULT, device: str = "auto", model: str | None = None
) -> Classifier:
    """A trained model, to be asked about clouds and files.

    Args, errors: see ``Classifier``; of a folder with several trainings give that of one.

    ::

        classifier = partialbench.load_model()            # comes with this release
        classifier = partialbench.load_model("results")   # a folder of eval's with one run
        answer = classifier.predict(points)               # (N,3), camera frame
        answer.class_name, answer.confidence, answer.rotation
    """
    return Classifier(weights, device, model)


class Classifier:
    """A trained model, to be asked about clouds (``predict``) and files (called).

    A model is best on clouds of as many points as it was trained on. A denser capture is cut at
    random into clouds of that many, and their probabilities are averaged.

    Args:
        weights: a checkpoint written by ``partialbench eval``, its run's folder, or a folder of
            results with one run; or the name of a model whose weights come with this release
            (``list_models(pretrained=True)``). Nothing else is needed.
        device: "cpu", "cuda", "cuda:1", or "auto".
        model: "module:factory" of a model of one's own: named here, never by the checkpoint.

    Attributes:
        path: of the weights. content: what they hold, as a checkpoint.
        card: of weights that come with this release, what they were trained and tested on.
        name: of the model as it was found: registered, or your "module:factory".
        model: the ``nn.Module``, in evaluation mode.

    Raises:
        InputError: no such device, or weights that make no model.
    """

    def __init__(self, weights: Path | str, device: str = "cpu", model: str | None = None) -> None:
        kind, index = find_device(device)
        self.device = torch.device(kind if index is None else f"{kind}:{index}")
        path = find_checkpoint(weights)
        # What the user named: a checkpoint never names code to import.
        model = None if model is None else user_code.named(model)
        self.path = path
        self.content = packed.load(path)
        checkpoint.require_finished(self.content, path, "classify")
        self.card = packaged.read_card(path) if path.suffix == packaged.SUFFIX else None
        self.name = checkpoint.model_of(self.content, model)
        self.model = checkpoint.build_model(self.content, model).to(self.device)
        if inputs.needs_normals(self.model):
            raise InputError(
                f"{path} holds a {self.content['model']!r}, which takes normals; captures are read "
                f"without, so give a checkpoint of a model that takes points alone"
            )
        if changed := checkpoint.changed_code(self.content, model):
            log.warning("%s: %s", path, changed)

    def __repr__(self) -> str:
        return f"<Classifier {self.about}>"

    @property
    def class_names(self) -> tuple[str, ...]:
        """Of the classes it tells apart, by label."""
        return tuple(self.content["class_names"])

    @property
    def about(self) -> str:
        """What it was trained on, and, where that was measured, how often it is right."""
        if self.card is not None:
            return packaged.in_a_sentence(self.card)
        data, seen = self.content["train_data"], self.content["summary"]["clouds_seen"]
        return f"{self.name}, trained on {seen:,} clouds of {data['id']} ({data['setting']} views)"

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
        path = given.path(file, "a capture's file")
        return self._answer(read_points(path, K, depth_scale), str(file), votes)

    def predict(self, points: Any, votes: int = VOTES) -> Answer | list[Answer]:
        """What the model says of clouds in memory; of each what it says of that cloud alone.

        Args:
            points: one cloud (N,3), several of one size (B,N,3), or a list of clouds of any sizes:
                arrays or tensors of any real dtype, in any unit, camera frame x right, y down, z
                forward. Points that are not finite are left out. Clouds far from the origin are
                moved in 64 bits before they are rounded to 32.
            votes: at most so many clouds, without a point in common, are cut from a dense one.

        Returns:
            One ``Answer`` for (N,3); else a list with one for each cloud.

        Raises:
            InputError: as for a file. Which cloud it was is said.
        """
        if isinstance(points, str | Path):
            raise InputError(f"predict takes points; for a file call it: classifier({points!r})")
        named, alone = given.clouds(points, "(N,3), (B,N,3) or a list of clouds")
        shapes = [(given_points(cloud, name), name) for name, cloud in named]
        answers = [self._answer(shape, name, votes) for shape, name in shapes]
        return answers[0] if alone else answers

    def _answer(self, points: NDArray, name: str, votes: int) -> Answer:
        """What the model says of points (n,3) that ``captures.shaped`` let pass."""
        votes = given.whole_number(votes, "votes", 1)
        count, class_names = self.content["num_points"], self.class_names
        clouds = draw(points, count, min(votes, max(1, len(points) // count)))
        try:
            # What a model draws or remembers is of no other cloud: the same cloud, the same answer.
            with unchanged(self.model), torch.inference_mode(), keyed_draws(device=self.device):
                output = self.model(torch.from_numpy(clouds).to(self.device))
            prediction = as_prediction(output, len(clouds), len(class_names))
        except Exception as error:  # whatever a model does not like about a cloud
            raise InputError(
                f"{name}: the model cannot answer ({type(error).__name__}: {error})"
            ) from error
        shares = prediction.class_logits.double().softmax(1).mean(0)
        poses = prediction.pose_logits
        if poses is not None:
            poses = poses.double().softmax(1).mean(0)
        if not all(
            bool(torch.isfinite(part).all()) for part in (shares, poses) if part is not None
        ):
            raise InputError(
                f"{name}: the model's answer is not a finite number; its weights, or this cloud, "
                f"are not what it can work with"
            )
        return Answer(
            class_names,
            shares.cpu().numpy(),
            None if poses is None else poses.cpu().numpy(),
            len(points),
            clouds.shape[0] * clouds.shape[1],
        )


def draw(points: NDArray, count: int, clouds: int = 1) -> NDArray[np.float32]:
    """(clouds,count,3) of the points, drawn without replacement by a fixed seed, in random order.

    Where there are fewer, all of them, and repeats after: as the shards are made.
    """
    rng = generator(0, "predict", len(points))
    order, wanted = rng.permutation(len(points)), clouds * count
    if len(points) < wanted:
        order = np.concatenate([order, rng.integers(0, len(points), wanted - len(points))])
    return np.ascontiguousarray(points[order[:wanted]], np.float32).reshape(clouds, count, 3)
