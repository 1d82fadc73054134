"""A user's own capture, a cloud or a depth image → class, confidence, pose."""

from __future__ import annotations

import io
import logging
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from partialbench.benchmark import checkpoint, inputs
from partialbench.benchmark.models import as_prediction
from partialbench.dataset.cloud_files import FORMATS, read_cloud
from partialbench.dataset.seeding import generator
from partialbench.errors import InputError
from partialbench.geometry.bins import rotation_bins
from partialbench.geometry.camera import Camera

log = logging.getLogger(__name__)

MIN_POINTS = 16
VOTES = 8
IMAGES = (".png", ".tif", ".tiff")


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
) -> Answer:
    """Classifies one segmented object.

    A model is best on clouds of as many points as it was trained on. A denser capture is cut at
    random into clouds of that many, and their probabilities are averaged.

    Args:
        checkpoint_file: written by ``partialbench eval``; nothing else is needed.
        file: a cloud (.ply, .pcd, .xyz, .txt, .csv, .pts, .npy (N,3)) or a z-depth image (.png of
            16 bits, .tif, .npy (H,W)), of the object alone; camera frame x right, y down,
            z forward.
        K: (3,3) intrinsics in pixels, or (fx, fy, cx, cy); needed for a depth image.
        depth_scale: units of the file's depth values: 0.001 for millimetres.
        votes: at most so many clouds, without a point in common.

    Raises:
        InputError: a file that cannot be read or has too few points, a depth image without K, no
            votes.
    """
    if votes < 1:
        raise InputError(f"votes must be at least 1, got {votes}")
    content = checkpoint.load(checkpoint_file)
    model = checkpoint.build_model(content).to(device)
    if inputs.needs_normals(model):
        raise InputError(
            f"{checkpoint_file} holds a {content['model']!r}, which takes normals; captures are "
            f"read without, so give a checkpoint of a model that takes points alone"
        )
    if changed := checkpoint.changed_code(content):
        log.warning("%s: %s", checkpoint_file, changed)
    given = read_points(Path(file), K, depth_scale)
    count = content["num_points"]
    clouds = draw(given, count, min(votes, max(1, len(given) // count)))
    names = content["class_names"]
    with torch.inference_mode():
        output = model(torch.from_numpy(clouds).to(device))
    prediction = as_prediction(output, len(clouds), len(names))
    values, order = prediction.class_logits.softmax(1).mean(0).topk(min(5, len(names)))
    top = [(names[int(i)], float(v)) for v, i in zip(values, order, strict=True)]
    poses = []
    if prediction.pose_logits is not None:
        values, order = prediction.pose_logits.softmax(1).mean(0).topk(5)
        poses = [(rotation_bins()[int(i)], float(v)) for v, i in zip(values, order, strict=True)]
    return Answer(top, len(given), clouds.shape[0] * clouds.shape[1], poses)


def draw(points: NDArray, count: int, clouds: int = 1) -> NDArray[np.float32]:
    """(clouds,count,3) of the points, drawn without replacement by a fixed seed, in random order.

    Where there are fewer, all of them, and repeats after: as the shards are made.
    """
    rng = generator(0, "predict", len(points))
    order, wanted = rng.permutation(len(points)), clouds * count
    if len(points) < wanted:
        order = np.concatenate([order, rng.integers(0, len(points), wanted - len(points))])
    return np.ascontiguousarray(points[order[:wanted]], np.float32).reshape(clouds, count, 3)


def read_points(path: Path, K: ArrayLike | None = None, depth_scale: float = 1.0) -> NDArray:
    """The finite points (n,3) of a cloud file or of a depth image (see ``predict``)."""
    if not path.is_file():
        raise InputError(f"no file at {path}")
    kind = path.suffix.lower()
    if kind not in (*FORMATS, *IMAGES):
        raise InputError(
            f"{path}: {kind or 'a file without suffix'} is not read; give a cloud "
            f"({', '.join(FORMATS)}) or a depth image ({', '.join(IMAGES)}, .npy)"
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    image = _image(content, path)
    if image is not None:
        points = _from_depth(path, image, K, depth_scale)
        points = points[np.isfinite(points).all(axis=1)]
    else:
        points = read_cloud(content, str(path), drop_unmeasured=True)
    if len(points) < MIN_POINTS:
        raise InputError(
            f"{path} has {len(points)} finite points, at least {MIN_POINTS} are needed"
        )
    return points


def _image(content: bytes, path: Path) -> NDArray | None:
    """What an image file holds, or an array that cannot be points; None for any other file."""
    kind = path.suffix.lower()
    if kind not in (*IMAGES, ".npy"):
        return None
    try:
        if kind in IMAGES:
            from PIL import Image

            with Image.open(io.BytesIO(content)) as image:
                return np.asarray(image)
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    # Further columns of a cloud are intensity, colours or normals.
    return None if array.ndim == 2 and array.shape[1] in (3, 4, 6) else array


def _from_depth(path: Path, image: NDArray, K: ArrayLike | None, scale: float) -> NDArray:
    if image.ndim != 2:
        raise InputError(f"{path} has shape {image.shape}; a depth image is one channel (H,W)")
    if K is None:
        raise InputError(
            f"{path} is a depth image of {image.shape[1]}×{image.shape[0]} pixels: its intrinsics "
            f"are needed (fx, fy, cx, cy in pixels)"
        )
    if not scale > 0:
        raise InputError(f"depth_scale must be positive, got {scale!r}")
    matrix = np.asarray(K, np.float64)
    if matrix.shape == (4,):
        fx, fy, cx, cy = matrix
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    depth = image.astype(np.float64) * scale
    depth[~np.isfinite(depth)] = 0
    try:
        return Camera(matrix, image.shape[1], image.shape[0]).unproject_depth(depth)
    except ValueError as error:
        raise InputError(f"intrinsics {np.asarray(K).tolist()}: {error}") from error
