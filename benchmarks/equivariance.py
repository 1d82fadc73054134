"""How far the steerable layers are from equivariant, against the angle of the rotation.

    python -m benchmarks.equivariance [--trials 4] [--json]

For a rotation R of a given angle about a random axis, the relative error
‖Φ(T_R f) − T_R Φ(f)‖ / ‖Φ(f)‖ over the inner half of the volume, for smooth random fields f (a blur
of σ voxels) and three maps Φ: one gated block of size 3, one of size 5, and two of size 3 with the
release's pooling between, whose centre drifts. Turns of the grid by 90° come first.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Callable

import numpy as np
import torch
from scipy.spatial.transform import Rotation
from torch import Tensor

from baselines.steerable import Fields, GatedBlock
from papnet.parts import pool
from papnet.rotate_field import rotate_field

EDGE = 24
FIELDS = Fields((2, 2, 2, 2))
ANGLES_DEG = (1, 5, 10, 20, 30, 45, 60, 90, 120, 150, 180)


def _squared_norm(axis: Tensor) -> Tensor:
    """x² + y² + z² on the grid of one axis' values."""
    return torch.cartesian_prod(axis, axis, axis).square().sum(1).view((len(axis),) * 3)


def smooth_field(generator: torch.Generator, sigma: float) -> Tensor:
    """(1,C,24,24,24) white noise blurred by σ voxels and faded out before the border."""
    field = torch.randn(1, FIELDS.channels, EDGE, EDGE, EDGE, generator=generator)
    frequency = torch.fft.fftfreq(EDGE) * 2 * torch.pi
    squared = _squared_norm(frequency)
    spectrum = torch.fft.fftn(field, dim=(2, 3, 4)) * torch.exp(-squared * sigma**2 / 2)
    field = torch.fft.ifftn(spectrum, dim=(2, 3, 4)).real
    axis = torch.arange(EDGE) - (EDGE - 1) / 2
    radius = _squared_norm(axis).sqrt()
    field = field * torch.sigmoid((EDGE / 3 - radius) * 2)
    return field / field.std()


def maps() -> dict[str, tuple[Callable[[Tensor], Tensor], Fields]]:
    torch.manual_seed(0)
    blocks = [GatedBlock(FIELDS, FIELDS, size, padding=size // 2).eval() for size in (3, 5, 3, 3)]
    return {
        "size 3": (blocks[0], FIELDS),
        "size 5": (blocks[1], FIELDS),
        "size 3, pool, size 3": (lambda x: blocks[3](pool(blocks[2](x))), FIELDS),
    }


def error(phi: Callable[[Tensor], Tensor], fields: Fields, field: Tensor, R: np.ndarray) -> float:
    rotation = torch.as_tensor(R, dtype=torch.float32)[None]
    with torch.no_grad():
        out = phi(field)
        a = phi(rotate_field(field, rotation, FIELDS))
        b = rotate_field(out, rotation, fields)
    quarter = out.shape[-1] // 4
    inner = (slice(None), slice(None), *(slice(quarter, -quarter),) * 3)
    return float((a[inner] - b[inner]).norm() / out[inner].norm())


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("--trials", type=int, default=4)
    parser.add_argument("--sigma", type=float, default=2.0, help="smoothness of the fields, voxels")
    parser.add_argument("--json", action="store_true")
    arguments = parser.parse_args()
    generator, rng = torch.Generator().manual_seed(0), np.random.default_rng(0)
    fields = [smooth_field(generator, arguments.sigma) for _ in range(arguments.trials)]
    axes = rng.standard_normal((arguments.trials, 3))
    axes /= np.linalg.norm(axes, axis=1, keepdims=True)
    turns = {"grid 90": np.eye(3)} | {str(angle): axes for angle in ANGLES_DEG}
    table: dict[str, dict[str, float]] = {}
    for name, (phi, out) in maps().items():
        table[name] = {}
        for label, about in turns.items():
            angle = float(label.split()[-1])
            errors = [
                error(phi, out, field, Rotation.from_rotvec(np.radians(angle) * axis).as_matrix())
                for field, axis in zip(fields, np.resize(about, (len(fields), 3)), strict=True)
            ]
            table[name][label] = float(np.mean(errors))
    write = sys.stdout.write
    if arguments.json:
        write(json.dumps(table) + "\n")
        return
    write(f"{'angle (°)':<24}" + "".join(f"{label:>9}" for label in turns) + "\n")
    for name, row in table.items():
        write(f"{name:<24}" + "".join(f"{value:>9.1e}" for value in row.values()) + "\n")


if __name__ == "__main__":
    main()
