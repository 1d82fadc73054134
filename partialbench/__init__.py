"""partialbench: pose-labelled single-view partial point clouds, and a benchmark on them.

The data flow one way, and the packages are named after its stages::

    source → occluder → sample → shard → loader → model → prediction → metrics → result → table

Importing this package is light: neither torch nor Mitsuba nor Open3D is loaded. Each name below is
loaded when it is first asked for:

>>> import numpy as np
>>> import partialbench as pb
>>> sphere = np.random.default_rng(0).standard_normal((500, 3))
>>> sphere /= np.linalg.norm(sphere, axis=1, keepdims=True)
>>> view = pb.render_view(sphere, pose=pb.look_at(eye=(0, -3, 0)), num_points=128)
>>> view.points.shape, view.visible_fraction < 0.6  # one side of it
((128, 3), True)
>>> pb.list_models("pointnet*")
['pointnet', 'pointnet2-ssg', 'pointnet2-msg']
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

if TYPE_CHECKING:
    from partialbench.benchmark.board import Board, leaderboard
    from partialbench.benchmark.evaluation import evaluate
    from partialbench.benchmark.predict import Answer, Classifier, load_model
    from partialbench.benchmark.pretrained import create_model
    from partialbench.dataset.gallery import Gallery
    from partialbench.dataset.gallery import gallery as show
    from partialbench.dataset.loader import ShardDataset
    from partialbench.dataset.render import render_dataset
    from partialbench.dataset.render_grid import render_grid
    from partialbench.dataset.sources import View
    from partialbench.dataset.torch_dataset import TorchDataset, load_dataset
    from partialbench.dataset.view import render_view
    from partialbench.errors import InputError, PartialbenchError
    from partialbench.geometry.camera import look_at
    from partialbench.registry import card as model_info
    from partialbench.registry import list_models

_WHERE = {
    "load_dataset": "partialbench.dataset.torch_dataset:load_dataset",
    "TorchDataset": "partialbench.dataset.torch_dataset:TorchDataset",
    "ShardDataset": "partialbench.dataset.loader:ShardDataset",
    "render_view": "partialbench.dataset.view:render_view",
    "View": "partialbench.dataset.sources:View",
    "look_at": "partialbench.geometry.camera:look_at",
    "render_dataset": "partialbench.dataset.render:render_dataset",
    "render_grid": "partialbench.dataset.render_grid:render_grid",
    "show": "partialbench.dataset.gallery:gallery",
    "Gallery": "partialbench.dataset.gallery:Gallery",
    "list_models": "partialbench.registry:list_models",
    "model_info": "partialbench.registry:card",
    "create_model": "partialbench.benchmark.pretrained:create_model",
    "load_model": "partialbench.benchmark.predict:load_model",
    "Classifier": "partialbench.benchmark.predict:Classifier",
    "Answer": "partialbench.benchmark.predict:Answer",
    "evaluate": "partialbench.benchmark.evaluation:evaluate",
    "leaderboard": "partialbench.benchmark.board:leaderboard",
    "Board": "partialbench.benchmark.board:Board",
    "InputError": "partialbench.errors:InputError",
    "PartialbenchError": "partialbench.errors:PartialbenchError",
}
"""Public name → where it is. The imports above say the same to a type checker; a test compares."""

__all__ = [  # noqa: RUF022 - in the order of the data
    "load_dataset", "TorchDataset", "ShardDataset", "render_view", "View", "look_at",
    "render_dataset", "render_grid", "show", "Gallery", "list_models", "model_info", "create_model",
    "load_model", "Classifier", "Answer", "evaluate", "leaderboard", "Board", "InputError",
    "PartialbenchError",
]  # fmt: skip


def __getattr__(name: str) -> Any:
    """Loads a public name on its first use (PEP 562)."""
    if name not in _WHERE:
        raise AttributeError(f"module 'partialbench' has no attribute {name!r}")
    from partialbench import extras

    module, _, attribute = _WHERE[name].partition(":")
    with extras.needed():
        value = getattr(importlib.import_module(module), attribute)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
