"""The algebra whose last bit no processor decides."""

from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from partialbench.geometry import portable
from partialbench.geometry.rotations import axis_rotation, haar_rotations

RNG = np.random.default_rng(0)


def test_products_and_inverse_are_numpys() -> None:
    a, b, v = RNG.normal(size=(7, 3)), RNG.normal(size=(3, 3)), RNG.normal(size=3)
    np.testing.assert_allclose(portable.product(a, b), a @ b, atol=1e-14)
    np.testing.assert_allclose(portable.product(np.eye(4) * 2, np.ones((4, 4))), np.full((4, 4), 2))
    np.testing.assert_allclose(portable.apply(b, v), b @ v, atol=1e-14)
    np.testing.assert_allclose(portable.inverse(b), np.linalg.inv(b), rtol=1e-12)
    many = RNG.normal(size=(2, 5, 3, 3))
    np.testing.assert_allclose(portable.inverse(many), np.linalg.inv(many), rtol=1e-9)


@pytest.mark.parametrize("scale", [(1, 1, 1), (0.01, 0.02, 0.015), (300, 2, 40)])
def test_polar_rotation_takes_the_stretch_off(scale: tuple[float, ...]) -> None:
    R = haar_rotations(RNG, 20)
    stretched = R * np.array(scale, float)
    np.testing.assert_allclose(portable.polar_rotation(stretched), R, atol=1e-13)
    one = portable.polar_rotation(stretched[3])
    np.testing.assert_allclose(one, R[3], atol=1e-13)


def test_cosine_and_sine_are_the_librarys() -> None:
    angles = np.concatenate([RNG.uniform(-50, 50, 10_000), np.arange(-8, 9) * np.pi / 4])
    cosine, sine = portable.cosine_sine(angles)
    np.testing.assert_allclose(cosine, np.cos(angles), rtol=0, atol=3e-16)
    np.testing.assert_allclose(sine, np.sin(angles), rtol=0, atol=3e-16)
    for axis in "xyz":
        turn = portable.axis_rotation(axis, 0.7)
        np.testing.assert_allclose(turn, axis_rotation(axis, 0.7), atol=3e-16)


_POSES = """
import numpy as np
from partialbench.geometry import portable
from renderers.viewpoints import standing_pose
rng = np.random.default_rng(1)
for _ in range(200):
    R, position = standing_pose(rng, rng.normal(size=(9, 2)), 0.0, rng.normal(size=3), 1.0)
    print(R.tobytes().hex(), position.tobytes().hex())
for A in rng.normal(size=(200, 3, 3)):
    A *= np.sign(np.linalg.det(A))
    Q = portable.polar_rotation(A)
    print(portable.product(Q, A).tobytes().hex(), portable.apply(Q, A[0]).tobytes().hex())
"""


def test_every_blas_kernel_gives_the_same_bits() -> None:
    outputs = [
        subprocess.run(
            [sys.executable, "-c", _POSES], capture_output=True, check=True,
            env={**os.environ, "OPENBLAS_CORETYPE": kernel},
        ).stdout
        for kernel in ("Prescott", "Haswell")
    ]  # fmt: skip
    assert len(outputs[0]) > 10_000
    assert outputs[0] == outputs[1]
