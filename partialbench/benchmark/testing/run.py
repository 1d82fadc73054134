"""Testing a finished training: its model on each test set, a record of each."""

from __future__ import annotations

import dataclasses
import datetime
import functools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from lightning.fabric import Fabric
from numpy.typing import NDArray
from torch import nn

from partialbench.benchmark import environment, models
from partialbench.benchmark.clouds import Clouds
from partialbench.benchmark.protocol import protocol as protocols
from partialbench.benchmark.protocol import recipe as recipes
from partialbench.benchmark.protocol.split import balanced_subset
from partialbench.benchmark.records import origin, results
from partialbench.benchmark.records.results import DataRecord, Result
from partialbench.benchmark.testing import (
    audit,
    company,
    damage,
    evaluate,
    given_pose,
    isolation,
    metrics,
)
from partialbench.errors import InputError
from partialbench.registry import ModelCard, Recipe

log = logging.getLogger(__name__)


@dataclasses.dataclass(frozen=True)
class Test:
    """Clouds to be tested on as they are, with each pose given, and with each damage done.

    Poses and damages are named as ``given_pose.parse`` and ``damage.parse`` do.
    """

    clouds: Clouds
    poses: Sequence[str] = ()
    damages: Sequence[str] = ()


def run_tests(
    content: Mapping[str, Any],
    model: nn.Module,
    tests: Sequence[Test],
    fabric: Fabric,
    folder: Path,
) -> list[Result]:
    """Makes the tests of a finished checkpoint's model.

    Cost and audit are measured once for each, and once for all cells of a grid.
    """
    device, classes = fabric.device, len(content["class_names"])
    model = model.to(device)
    written = []
    of_grid: dict[str, Any] = {}
    for test in tests:
        test_set = test.clouds
        if test_set.grid and of_grid:
            written.append(_test(content, model, test_set, fabric, folder, of_grid))
            continue
        # A protocol that tests few clouds is meant to be quick; these are not to outlast it.
        most = content["protocol"]["max_test_clouds"] or len(test_set)
        with isolation.unchanged(model):
            cost = audit.cost(model, test_set, device, min(audit.COST_BATCH, most))
        with isolation.unchanged(model), isolation.keyed_draws("rotation audit", device=device):
            turned = audit.rotation_audit(
                model, test_set, classes, device, min(audit.AUDIT_CLOUDS, most)
            )
        found = company.company_audit(model, test_set, classes, device, min(company.COMPANY, most))
        _tell(content["model"], found)
        measured: dict[str, Any] = {
            "cost": cost, "rotation_audit": turned, "company_audit": found,
        }  # fmt: skip
        one = functools.partial(_test, content, model, test_set, fabric, folder, measured)
        written.append(one())
        if test_set.grid:
            of_grid = measured
        written += [one(pose=pose) for pose in test.poses]
        written += [one(damaged=name) for name in test.damages]
    return written


def _tell(name: str, found: Mapping[str, Any]) -> None:
    """Says what of a company audit keeps a model from a row, or is odd about it."""
    if found["drift"] > results.INDEPENDENT:
        log.warning(
            "the answers of %s depend on the clouds that are scored beside one (its logits move by "
            "%.1f %% of their size): its record stands apart and is no row of the board",
            name, 100 * found["drift"],
        )  # fmt: skip
    if found["changed_buffers"]:
        log.warning(
            "scoring clouds changes %s of %s; each test begins from what was trained",
            ", ".join(found["changed_buffers"][:5]), name,
        )  # fmt: skip


def _test(
    content: Mapping[str, Any],
    model: nn.Module,
    test_set: Clouds,
    fabric: Fabric,
    folder: Path,
    measured: dict[str, dict[str, Any]],
    pose: str = "",
    damaged: str = "",
) -> Result:
    """Tests on one test split and writes the record; returns it as its file has it."""
    protocol = protocols.from_dict(content["protocol"])
    card = models.card_of(content["model"])
    recipe, train_data = content["recipe"], DataRecord(**content["train_data"])
    rows = _test_rows(test_set, train_data.class_names, protocol.max_test_clouds)
    result = Result(
        model=card.name,
        variant=content["variant"],
        model_code=content["model_code"],
        weights_sha256=content["weights_sha256"],
        options=dict(content["options"]),
        card=_card_as_dict(card),
        recipe=recipe,
        deviations=[
            *recipes.deviations(
                card.recipe, Recipe(**recipe), protocol, train_data.clouds, content["clouds"]
            ),
            *origin.deviations(content["summary"].get("start")),
            *content.get("deviations", ()),
        ],
        protocol=protocol.as_dict(),
        protocol_digest=protocol.digest,
        train_data=train_data,
        test_data=results.describe_data(test_set, rows),
        seed=content["seed"],
        clouds=content["clouds"],
        given_pose=pose,
        damage=damaged,
        grid=test_set.grid,
        date=datetime.datetime.now(datetime.UTC).date().isoformat(),
        training=content["summary"],
        **measured,
        environment=environment.describe(fabric.device),
        test_set_sha256="",
        predictions_file="",
        predictions_sha256="",
        scores={},
    )
    clouds = damage.DamagedClouds(test_set, damaged) if damaged else test_set
    predictions = evaluate.predict_rows(
        model, clouds, rows, train_data.class_names, fabric.device,
        train_sources=content["train_sources"],
        given=given_pose.told(pose, test_set, rows, train_data.class_names) if pose else None,
        answers_alone=bool(result.conditions),
    )  # fmt: skip
    scores = metrics.scores(predictions, train_data.class_names, test_set.class_names)
    path = results.write(folder, dataclasses.replace(result, scores=scores), predictions)
    log.info("wrote %s", path)
    return results.read(path)


def _test_rows(
    test_set: Clouds, class_names: Sequence[str], limit: int | None
) -> NDArray[np.int64]:
    """Which clouds are tested: those of a balanced subset, whatever their class.

    Of few clouds and many classes none may be of a class that the model knows; then the subset is
    of those that are.

    Raises:
        InputError: no cloud is.
    """
    every = np.arange(len(test_set))
    known = np.isin(np.array(test_set.class_names)[test_set.labels], class_names)
    if not known.any():
        raise InputError(
            f"no cloud of the test data ({test_set.dataset_id}) is of a class that the model "
            f"knows: {', '.join(test_set.class_names)} against {', '.join(class_names)}"
        )
    rows = balanced_subset(every, test_set.labels, limit)
    return rows if known[rows].any() else balanced_subset(every[known], test_set.labels, limit)


def try_given_pose(
    name: str, model: nn.Module, test_set: Clouds, pose: str, class_names: Sequence[str]
) -> None:
    """Gives a pose with one cloud. Raises ``InputError`` where the model takes none, or the data
    have none of this kind."""
    given_pose.require_taken(model, name)
    rows = np.arange(1)
    given = given_pose.told(pose, test_set, rows, class_names)
    list(evaluate.run_model(model, test_set, rows, len(class_names), given=given))


def _card_as_dict(card: ModelCard) -> dict[str, Any]:
    """Plain JSON data."""
    return {
        **dataclasses.asdict(dataclasses.replace(card, recipe=Recipe())),
        "recipe": recipes.as_dict(card.recipe),
        "invariances": sorted(card.invariances),
        "parameters": {str(k): v for k, v in card.parameters.items()},
    }
