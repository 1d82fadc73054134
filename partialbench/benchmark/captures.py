"""Files of a user's own capture, a cloud or a depth image, as points that a model can be given."""

from __future__ import annotations

import io
import logging
import os
import warnings
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from partialbench import given
from partialbench.dataset.cloud_files import FORMATS, parse_cloud
from partialbench.dataset.cloud_formats.points import WIDEST, padding
from partialbench.dataset.ply import is_mesh
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera

log = logging.getLogger(__name__)

MIN_POINTS = 16
IMAGES = (".png", ".tif", ".tiff")

LEAST_EXTENT, MOST_EXTENT = 1e-5, 1e9
"""Of an object in whatever unit: models square and add coordinates in 32 bits."""
LEAST_FLOAT32_STEPS = 1e4
"""Steps of 32-bit coordinates along the object, below which it is moved before it is rounded."""


def captures(folder: Path) -> Iterator[Path]:
    """The files of a folder that can be read, at any depth, sorted; what is left out is named.

    But for what is hidden: files and folders whose name begins with a dot. A file that is none by
    more than its name (a link to nowhere) is among them, and is an error when it is read.

    Raises:
        InputError: none.
    """
    files: list[Path] = []
    closed: list[str] = []

    def not_opened(error: OSError) -> None:
        closed.append(f"{error.filename} ({error.strerror})")

    # Links to folders are not followed: one may lead back to where it lies.
    for place, folders, names in os.walk(folder, onerror=not_opened):
        folders[:] = [name for name in folders if not name.startswith(".")]
        closed += [
            f"{Path(place, name)} (a link; give the folder it leads to)"
            for name in folders
            if Path(place, name).is_symlink()
        ]
        files += [Path(place, name) for name in names if not name.startswith(".")]
    read = sorted(path for path in files if path.suffix.lower() in (*FORMATS, *IMAGES))
    if closed:
        log.warning("%s: folders in it were not read: %s", folder, ", ".join(closed))
    if not read:
        raise InputError(f"{folder} holds no file of {', '.join((*FORMATS, *IMAGES))}")
    if left := sorted({path.name for path in files} - {path.name for path in read}):
        shown = ", ".join(left[:5]) + (", …" if len(left) > 5 else "")
        log.warning("%s: %d of %d files are no cloud and no depth image: %s",
                    folder, len(files) - len(read), len(files), shown)  # fmt: skip
    yield from read


def read_points(path: Path, K: ArrayLike | None = None, depth_scale: float = 1.0) -> NDArray:
    """The finite points (n,3) of a cloud file or of a depth image (see ``predict.Classifier``).

    Points far from the origin for their extent, as in UTM coordinates, are moved, in double
    precision, to be centred at (0, 0, 3 radii): in 32 bits they would lie on a coarse grid.

    Raises:
        InputError: a file that cannot be read, or whose points are no shape: too few distinct ones,
            all on a line, or of an extent that 32 bits cannot work with.
    """
    _require_file(path)
    kind = path.suffix.lower()
    if kind not in (*FORMATS, *IMAGES):
        mesh = kind in (".off", ".obj", ".stl", ".glb", ".gltf", ".dae")
        raise InputError(
            f"{path}: {kind or 'a file without suffix'} is not read; give a cloud "
            f"({', '.join(FORMATS)}) or a depth image ({', '.join(IMAGES)}, .npy)"
            + ("; of a mesh render a view first (partialbench.render_view)" if mesh else "")
        )
    try:
        content = path.read_bytes()
    except OSError as error:
        raise InputError(f"{path} cannot be read: {error}") from error
    matrix = _intrinsics(K)
    image = _image(content, path, matrix)
    if image is not None:
        points = _from_depth(path, image, matrix, depth_scale)
        points = points[np.isfinite(points).all(axis=1)]
    else:
        cloud = parse_cloud(content, str(path))
        points = _finite(cloud.points, path)
        if cloud.columns > 3:
            log.warning(
                "%s: of %d columns the first three are taken for x, y, z", path, cloud.columns
            )
        if kind == ".ply" and is_mesh(content):
            log.warning(
                "%s is a mesh: its %d vertices are taken for the points of a scan; of a CAD model "
                "render a view first (partialbench.render_view)", path, len(points),
            )  # fmt: skip
    return shaped(points, path)


def _require_file(path: Path) -> None:
    try:
        if path.is_file():
            return
        where = "is not there"
        if path.is_dir():
            where = "is a folder; give one of its files"
        elif path.is_symlink():
            where = f"is a link to {path.readlink()}, where none is"
        elif path.exists():
            where = "is a pipe or a device"
    except OSError as error:  # of what lies in a closed folder not even the kind is told
        raise InputError(f"{path} cannot be read: {error}") from error
    raise InputError(f"no file at {path}: it {where}")


def given_points(points: Any, name: str = "the cloud") -> NDArray[np.float64]:
    """The finite points (n,3) float64 of a cloud in memory, as ``read_points`` gives a file's.

    Args:
        points: (N,3), see ``given.cloud``.

    Raises:
        InputError: see ``given.cloud`` and ``read_points``.
    """
    array = given.cloud(points, name).astype(np.float64)
    return shaped(_finite(array, name), name)


def _finite(points: NDArray, name: Path | str) -> NDArray:
    """Without those that are not: NaN says that nothing was measured, infinity may say another."""
    if infinite := int(np.isinf(points).any(axis=1).sum()):
        log.warning(
            "%s: %d of %d points are infinite and were left out; floats of 16 bits overflow above "
            "65504", name, infinite, len(points),
        )  # fmt: skip
    return points[np.isfinite(points).all(axis=1)]


def shaped(points: NDArray, path: Path | str) -> NDArray[np.float64]:
    """Points of a shape, moved where they are too far away for 32 bits; each is still another.

    Args:
        points: (n,3), finite; those that stand for "no measurement" are left out.
        path: what errors call them.

    Raises:
        InputError: see ``read_points``.
    """
    empty = padding(points)
    if empty.any():
        log.warning("%s: %d of %d points are (0, 0, 0), as where nothing was measured; they were "
                    "left out", path, empty.sum(), len(points))  # fmt: skip
        points = points[~empty]
    if len(points) < MIN_POINTS:
        raise InputError(
            f"{path} has {len(points)} finite points, at least {MIN_POINTS} are needed"
        )
    points = np.asarray(points, np.float64)
    low, high = points.min(axis=0), points.max(axis=0)
    extent = float((high / 2 - low / 2).max()) * 2  # of halves: a difference could be infinite
    if extent > MOST_EXTENT:
        raise InputError(
            f"{path}: the points extend over {extent:.3g} units; expected one object, of "
            f"{MOST_EXTENT:g} at most in any unit. Divide them by a constant"
        )
    centred = points - (low / 2 + high / 2)
    distinct = len(np.unique(centred, axis=0))
    if distinct < MIN_POINTS:
        raise InputError(
            f"{path} has {distinct} distinct point{'s' if distinct > 1 else ''} among "
            f"{len(points)}, at least {MIN_POINTS} are needed"
        )
    if extent < LEAST_EXTENT:
        raise InputError(
            f"{path}: the points extend over {extent:.3g} units; expected {LEAST_EXTENT:g} or "
            f"more. Multiply them by a constant, or check that it is one object"
        )
    spread = np.linalg.svd((centred - centred.mean(axis=0)) / extent, compute_uv=False)
    if spread[1] < 1e-6 * spread[0]:
        raise InputError(f"{path}: all points lie on one line; expected the surface of an object")
    step = float(np.spacing(np.float32(np.abs(points).max())))
    if step * LEAST_FLOAT32_STEPS <= extent:
        return points
    log.info("%s: moved to the origin before it is rounded to 32 bits", path)
    radius = float(np.linalg.norm(centred, axis=1).max())
    return centred + (0.0, 0.0, 3 * radius)


def _image(content: bytes, path: Path, K: NDArray | None) -> NDArray | None:
    """What an image file holds, or an array that cannot be points; None for any other file."""
    kind = path.suffix.lower()
    if kind in IMAGES:
        return _pixels(content, path)
    if kind != ".npy":
        return None
    try:
        array = np.load(io.BytesIO(content), allow_pickle=False)
    except Exception as error:  # NumPy fails in several ways
        raise InputError(f"{path} cannot be read: {error}") from error
    if not isinstance(array, np.ndarray) or not (array.dtype.names or array.dtype.kind in "fiu"):
        raise InputError(f"{path} holds no array of real numbers")
    while array.ndim > 2 and len(array) == 1:
        array = array[0]
    return None if array.dtype.names or _are_points(path, array, K) else array


def _pixels(content: bytes, path: Path) -> NDArray:
    """The pixels of a PNG or TIFF; whether they are depths is not asked here."""
    from PIL import Image, UnidentifiedImageError

    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            with Image.open(io.BytesIO(content), formats=("PNG", "TIFF")) as image:
                if image.mode in ("1", "P"):
                    what = "two values" if image.mode == "1" else "a palette"
                    raise InputError(
                        f"{path} is an image of {what}, not of depths; save the depths "
                        f"themselves, in 16 bits"
                    )
                if (pages := getattr(image, "n_frames", 1)) > 1:
                    raise InputError(f"{path} has {pages} images; expected one, of depths")
                return np.asarray(image)
    except InputError:
        raise
    except UnidentifiedImageError:
        raise InputError(
            f"{path} cannot be read: it begins with {content[:8]!r}, as no PNG or TIFF does"
        ) from None
    except Exception as error:  # Pillow fails in its own ways
        raise InputError(f"{path} cannot be read: {error}") from error


def _are_points(path: Path, array: NDArray, K: NDArray | None) -> bool:
    """Whether an array is of points, a row or a column each, and not an image.

    Further columns of a cloud are intensity, colours or normals. Intrinsics decide of a very narrow
    array: it is an image where their principal point lies in it.

    Raises:
        InputError: a narrow array that can be neither.
    """
    if array.ndim != 2:
        return False
    rows, columns = array.shape
    if columns == 3:
        return True
    if min(rows, columns) > WIDEST or (K is not None and _has_centre(array, K)):
        return False
    if (rows in (3, 6) and columns > WIDEST) or (columns >= 4 and rows > columns):
        return True
    if K is None:
        return False
    raise InputError(
        f"{path} has shape {array.shape}: too narrow for a depth image, and the principal point of "
        f"the intrinsics ({K[0, 2]:g}, {K[1, 2]:g}) is not in it; save a cloud as (N,3), a point a "
        f"row"
    )


def _has_centre(image: NDArray, K: NDArray) -> bool:
    """Whether the principal point lies in an image."""
    cx, cy = K[:2, 2]
    return bool(0 <= cx <= image.shape[1] and 0 <= cy <= image.shape[0])


def _intrinsics(K: ArrayLike | None) -> NDArray[np.float64] | None:
    """(3,3) from that or from (fx, fy, cx, cy); what the numbers say is the camera's to judge."""
    if K is None:
        return None
    try:
        matrix = given.real_numbers(K, "intrinsics", "(3,3)")
    except InputError:
        matrix = np.zeros(0)
    if matrix.shape == (4,):
        fx, fy, cx, cy = matrix
        matrix = np.array([[fx, 0, cx], [0, fy, cy], [0, 0, 1]])
    if matrix.shape != (3, 3):
        raise InputError(f"intrinsics must be K (3,3) or (fx, fy, cx, cy) in pixels, got {K!r}")
    return matrix


def _from_depth(path: Path, image: NDArray, K: NDArray | None, scale: float) -> NDArray:
    if image.ndim != 2:
        raise InputError(
            f"{path} has shape {image.shape}; a depth image is one channel (H,W), a cloud is (N,3)"
        )
    if K is None:
        raise InputError(
            f"{path} is a depth image of {image.shape[1]}×{image.shape[0]} pixels: its intrinsics "
            f"are needed (fx, fy, cx, cy in pixels)"
        )
    scale = given.positive(scale, "depth_scale")
    _require_depths(path, image)
    if image.dtype == np.uint8:
        log.warning(
            "%s has 8 bits a pixel, at most 256 depths, as a picture to look at has; sensors write "
            "16", path,
        )  # fmt: skip
    if not _has_centre(image, K):
        log.warning(
            "%s: the principal point (%g, %g) is not in the image of %d×%d pixels, as for a part "
            "cut out of a larger one; intrinsics of another size of image would distort the cloud",
            path, K[0, 2], K[1, 2], image.shape[1], image.shape[0],
        )  # fmt: skip
    depth = image.astype(np.float64) * scale
    depth[~np.isfinite(depth)] = 0
    try:
        return Camera(K, image.shape[1], image.shape[0]).unproject_depth(depth)
    except ValueError as error:
        raise InputError(f"intrinsics {K.tolist()}: {error}") from error


def _require_depths(path: Path, image: NDArray) -> None:
    """Raises ``InputError`` for an image whose values are no depths of an object."""
    if image.dtype.kind in "iu":
        most = np.iinfo(image.dtype).max
        if saturated := int((image == most).sum()):
            raise InputError(
                f"{path}: {saturated} of {image.size} pixels have the greatest value of "
                f"{image.dtype}, {most}: saturated, or a mark for no surface. Set them to 0, "
                f"which is no surface"
            )
    measured = image[np.isfinite(image) & (image > 0)]
    if not len(measured) and (behind := int((image < 0).sum())):
        raise InputError(
            f"{path}: no depth is above 0 and {behind} are below; depth is z forward of the "
            f"camera, so negate them"
        )
    if len(measured) and (measured == measured[0]).all():
        raise InputError(
            f"{path}: all {len(measured)} pixels with a surface have the one depth "
            f"{measured[0]:g}: a mask, or saturated; expected the depths of an object"
        )
