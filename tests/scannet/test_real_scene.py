"""The real scene at hand: five chairs, a round table and a bin. Nothing of it is stored here."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest

from partialbench.dataset.seeding import generator
from partialbench.dataset.sources import View
from partialbench.geometry.rotations import is_rotation
from renderers.sources.scannet.occluder import ScanHprOccluder
from renderers.sources.scannet.show import draw_instances
from renderers.sources.scannet.source import ScanNetInstances

VIEWS = 3


@pytest.fixture
def source(shared):
    data = shared / "data"
    return ScanNetInstances(data / "scannet", data / "scan2cad" / "full_annotations.json")


def shapes(source):
    return {ref.object_id: source.load(ref) for s in source.splits() for ref in source.objects(s)}


def digest(source) -> str:
    """SHA-256 over every point, pose and view."""
    whole = hashlib.sha256()
    for object_id, shape in shapes(source).items():
        rngs = [generator(0, object_id, view) for view in range(VIEWS)]
        poses = source.poses(shape, rngs)
        for (R, t), view in zip(poses, ScanHprOccluder().views(shape, poses, rngs), strict=True):
            assert isinstance(view, View)
            for array in (shape.points, shape.normals, R, t, view.points):
                whole.update(array.tobytes())
    return whole.hexdigest()


def test_chairs_and_table_are_found_and_the_bin_is_not(source):
    found = {i: s.class_name for i, s in shapes(source).items()}
    assert found == {f"scene0470_00/{i}": "table" if i == 5 else "chair" for i in range(1, 7)}
    [bin_] = source.rejected
    assert (bin_.object_id, bin_.failed) == ("scene0470_00/0", False)
    assert bin_.reason == "CAD category trash bin (02747177) is not a PS15 class"


def test_points_agree_with_the_canonical_frame(source):
    """Upright; a chair's upper part behind its middle (+y) and its seat below it; the box fits."""
    for shape in shapes(source).values():
        assert is_rotation(shape.R_scan_object, 1e-9)
        assert shape.R_scan_object[2, 2] > np.cos(np.deg2rad(6))
        assert shape.residual_m < 0.06
        inside = np.abs(shape.points - shape.box_centre) <= (
            shape.box_half_extent + 0.08 / shape.scale_m + 1e-6
        )
        assert inside.all()
        x, y, z = shape.points.T
        if shape.class_name == "chair":
            back = z > 0.6 * z.max()
            assert y[back].mean() > 0.25
            assert abs(x[back].mean()) < 0.15
            # A wrong turn would put the back at another side: it is a plate across y.
            assert np.ptp(x[back]) > 1.5 * y[back].std() * 2
            assert shape.symmetry == "none"
        else:
            assert shape.symmetry == "z-inf"
            assert (z > 0).mean() > 0.5


def test_a_second_run_gives_the_same_bits(source, shared):
    again = ScanNetInstances(source.scannet, source.scan2cad)
    assert digest(source) == digest(again)


def test_the_picture_is_drawn(source, tmp_path):
    draw_instances(list(shapes(source).items())[:2], tmp_path / "instances.png")
    assert (tmp_path / "instances.png").read_bytes()[:4] == b"\x89PNG"
