"""Made-up records with predictions that fit them, to build boards from."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from partialbench.benchmark.protocol import milestones
from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.protocol.recipe import as_dict, of_protocol
from partialbench.benchmark.records import results
from partialbench.benchmark.records.predictions import Predictions, deciding_classes
from partialbench.benchmark.records.results import DataRecord, Result
from partialbench.benchmark.testing import metrics
from partialbench.registry import ModelCard


def hash_of(name: str) -> str:
    """A digest that a test calls ``name``; a digest stays as it is."""
    return name if re.fullmatch("[0-9a-f]{64}", name) else hashlib.sha256(name.encode()).hexdigest()


def forge_file(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """A record changed by one who mends its digest."""
    text = json.loads(path.read_text())
    change(text)
    text["record_sha256"] = results.record_digest(text)
    path.write_text(json.dumps(text))


ENVIRONMENT = {"device": "cpu", "cpu": "a processor", "git_commit": "0" * 40, "packages": {},
               "precision": "32-true"}  # fmt: skip
CLASSES = ["bottle", "chair", "lamp", "table"]


def predictions(
    accuracy, seed, objects=40, views=3, posed=False, truth_seed=0, candidates=False, duplicates=0
) -> Predictions:
    """Right with chance ``accuracy``; the clouds are the same for every model and seed."""
    truth, rng = np.random.default_rng(truth_seed), np.random.default_rng(seed)
    size = objects * views
    labels = np.repeat(np.arange(objects) % len(CLASSES), views)
    answer = np.where(
        rng.random(size) < accuracy, labels, (labels + rng.integers(1, 4, size)) % len(CLASSES)
    )
    logits = rng.normal(0, 0.3, (size, len(CLASSES)))
    logits[np.arange(size), answer] = 3
    logs = logits - np.log(np.exp(logits).sum(1, keepdims=True))
    order = np.argsort(-logs, axis=1)
    bins = np.argsort(rng.random((size, 60)), axis=1)[:, :20]
    each = np.argsort(rng.random((size, 20)), axis=1)  # which of the poses speaks loudest
    under_poses = np.where(each > 4, answer[:, None], rng.integers(0, 4, (size, 20)))
    kept = 20 if candidates else 0
    return Predictions(
        rows=np.arange(size, dtype=np.int32), labels=labels.astype(np.int16),
        classes=order.astype(np.int16), shared=np.zeros((size, 0), np.int16),
        log_probabilities=np.take_along_axis(logs, order, axis=1).astype(np.float16),
        pose_bins=(bins if posed else bins[:, :0]).astype(np.uint8),
        decided=deciding_classes(each[:, :kept], under_poses[:, :kept]),
        duplicate=np.arange(size) < duplicates * views,
        quaternions=Rotation.random(size, rng=truth).as_quat().astype(np.float32),
        symmetries=np.array(["z-inf", "none", "z-inf", "z-180"])[labels],
        object_ids=np.array([f"{CLASSES[i % 4]}_{i:04d}" for i in range(objects)]).repeat(views),
        views=np.tile(np.arange(views, dtype=np.int32), objects),
        visible_fraction=truth.uniform(0.1, 0.6, size).astype(np.float32),
        class_names=np.array(CLASSES),
    )  # fmt: skip


def record(
    name: str, stored: Predictions, seed=0, data="pm40-parametric", digest="a", preset="board",
    test=None, test_digest="b", paper=None, title=None, variant="", options=None,
    points=None, sensor="", setting="partial", given_pose="", clouds=100, model_code="",
    milestone=100_000, damage="", grid="", date="",
) -> Result:  # fmt: skip
    card = ModelCard(
        name=name, entry=f"x:{name}", title=title or name.upper(), paper="Somebody et al., 2021",
        representation="pc (1024×3)", paper_scores=paper or {},
        choices=("a choice with <b> & ünïcode",), deviations=("it deviates",),
    )  # fmt: skip
    fields = dataclasses.asdict(dataclasses.replace(card, recipe=card.recipe))
    fields |= {"invariances": ["permutation"], "recipe": as_dict(card.recipe), "parameters": {}}
    protocol = PRESETS[preset]
    recipe = of_protocol(card, protocol)
    plan = milestones.plan(protocol, recipe, milestone, clouds)
    test = test or data
    objects = len(np.unique(stored.object_ids))
    return Result(
        model=name, variant=variant, options=options or {}, card=fields, recipe=as_dict(recipe),
        deviations=["29 epochs instead of 250"], protocol=protocol.as_dict(),
        protocol_digest=protocol.digest,
        train_data=DataRecord(data, setting, hash_of(digest), clouds, 20, CLASSES,
                              protocol.num_points),
        test_data=DataRecord(
            test, setting, hash_of(test_digest), len(stored), objects, CLASSES,
            points or protocol.num_points, sensor,
        ),
        seed=seed,
        clouds=milestone,
        weights_sha256=hash_of(
            repr((name, variant, data, digest, setting, preset, milestone, seed))
        ),
        test_set_sha256="",
        given_pose=given_pose,
        damage=damage,
        grid=grid,
        date=date,
        model_code=model_code,
        training={"epochs": 2, "steps": plan.steps, "clouds_seen": plan.clouds_seen, "seconds": 1.5,
                  "clouds_per_second": 300.0, "train_loss": 0.5, "validation_accuracy": 0.7,
                  "peak_memory_bytes": 2**28, "environment": ENVIRONMENT,
                  "curve": {"train_loss": [1.5, 0.5], "validation_accuracy": [0.4, 0.7]}},
        cost={"parameters": 1234 + 100 * len(name), "multiply_adds": 10**6 * len(name),
              "latency_ms": 3.0, "batch_ms": 0.5 * len(name), "batch_size": 32,
              "peak_memory_bytes": 2**27},
        rotation_audit={"drift": 0.25, "changed": 0.1, "clouds": 24, "turns": 2},
        company_audit={"drift": 0.0, "clouds": 8, "random": False, "changed_buffers": []},
        environment=ENVIRONMENT,
        predictions_file="", predictions_sha256="",
        scores=metrics.scores(stored, CLASSES, CLASSES),
    )  # fmt: skip


def add(
    folder: Path, name: str, accuracy: float, seed=0, posed=False, objects=40, views=3,
    candidates=False, duplicates=0, options=None, **other,
):  # fmt: skip
    """Writes one record; returns its path."""
    other["variant"] = other.get("variant") or " ".join(
        f"{k}={v}" for k, v in sorted((options or {}).items())
    )
    drawn = 1000 * seed + sum(map(ord, name + other["variant"]))
    stored = predictions(accuracy, drawn, objects, views, posed, 0, candidates, duplicates)
    other["options"] = options
    return results.write(folder, record(name, stored, seed, **other), stored)


def small_board(folder: Path) -> Path:
    """Three models, two of them alike, one of them posed; two columns."""
    for seed in range(2):
        add(folder, "good", 0.9, seed, posed=True, paper={"pm40": 83.5})
        add(folder, "even", 0.9, seed, paper={"pm40": 81.5})
        add(folder, "poor", 0.4, seed)
    add(folder, "good", 0.7, test="ps15-rooms", test_digest="c", posed=True)
    return folder
