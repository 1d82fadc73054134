"""Forged and damaged records: each is found, and said in a sentence."""

from __future__ import annotations

import contextlib
import dataclasses
import hashlib
import json
import random
import shutil

import numpy as np
import pytest

from leaderboard import check
from leaderboard.build import build_leaderboard
from leaderboard.check import problems
from partialbench.benchmark import models
from partialbench.benchmark.protocol.protocol import PRESETS
from partialbench.benchmark.protocol.recipe import as_dict, of_protocol
from partialbench.benchmark.records import cards, results, testsets
from partialbench.benchmark.records import predictions as prediction_files
from partialbench.benchmark.records.results import PREDICTIONS_SUFFIX, SUFFIX
from partialbench.benchmark.testing import metrics
from partialbench.benchmark.testing.run import _card_as_dict
from partialbench.errors import InputError
from tests.leaderboard.records import CLASSES, add, forge_file, predictions, record

MODEL = "pointnet"


def honest(folder, seed, accuracy=0.6, **other):
    """A record of a registered model."""
    stored = predictions(accuracy, seed)
    made = record(MODEL, stored, seed, **other)
    parameters = models.num_parameters(models.create(MODEL, len(CLASSES)))
    card = models.card_of(MODEL)
    made = dataclasses.replace(
        made, card=_card_as_dict(card), recipe=as_dict(of_protocol(card, PRESETS["board"])),
        cost=made.cost | {"parameters": parameters},
    )  # fmt: skip
    return results.write(folder, made, stored)


@pytest.fixture(scope="module")
def sound(tmp_path_factory):
    folder = tmp_path_factory.mktemp("sound")
    for seed in range(2):
        honest(folder, seed)
    assert problems(folder) == []
    return folder


@pytest.fixture
def folder(sound, tmp_path):
    return shutil.copytree(sound, tmp_path / "results")


def first(folder):
    return sorted(folder.glob(f"*{SUFFIX}"))[0]


def forge(folder, change):
    """``forge_file`` of the first record."""
    forge_file(first(folder), change)


def forge_predictions(folder, change):
    """Predictions (and truth) changed by one who mends scores and all digests."""
    path = first(folder)
    result = results.read(path)
    stored = change(results.read_predictions(folder, result))
    data = prediction_files.to_bytes(stored)
    (folder / result.predictions_file).write_bytes(data)

    def mend(text):
        text["predictions_sha256"] = hashlib.sha256(data).hexdigest()
        text["test_set_sha256"] = testsets.write(folder, stored)
        with contextlib.suppress(ValueError):  # of answers that give no scores
            text["scores"] = metrics.scores(stored, CLASSES, CLASSES)

    forge(folder, mend)


def found(folder):
    return "\n".join(problems(folder))


def test_labels_that_became_the_answers_do_not_fit_the_other_records(folder):
    forge_predictions(folder, lambda p: dataclasses.replace(p, labels=p.predicted.copy()))
    assert "held against other labels of its clouds" in found(folder)


def test_a_lone_records_labels_are_held_against_the_data(folder):
    for path in sorted(folder.glob("*seed1*")):
        path.unlink()
    truth = testsets.load(folder, results.read_folder(folder)[0].test_set_sha256)
    digest = results.read_folder(folder)[0].test_data.digest
    forge_predictions(folder, lambda p: dataclasses.replace(p, labels=p.predicted.copy()))
    (sentence,) = check.against_data(folder, [(digest, truth)])
    assert "held against other labels than its data have" in sentence


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: dataclasses.replace(p, classes=np.roll(p.classes, 1, axis=1)), None),
        (lambda p: dataclasses.replace(p, log_probabilities=p.log_probabilities[:, ::-1].copy()),
         "not finite, at most 1 and falling"),
        (lambda p: dataclasses.replace(p, log_probabilities=0 * p.log_probabilities),
         "sum to more than 1"),
        (lambda p: dataclasses.replace(p, classes=0 * p.classes), "name one twice"),
        (lambda p: dataclasses.replace(p, classes=p.classes + np.int16(4)), r"must lie in [0, 4)"),
        (lambda p: dataclasses.replace(p, classes=p.classes.astype(np.int64)), "expected int16"),
        (lambda p: dataclasses.replace(p, shared=p.classes[:, :1]), "shared classes a cloud"),
        (lambda p: dataclasses.replace(p, quaternions=2 * p.quaternions), "not of length 1"),
        (lambda p: dataclasses.replace(p, symmetries=np.full(len(p), "z-7")), "unknown symmetries"),
        (lambda p: dataclasses.replace(p, rows=p.rows * 0), "comes twice"),
        (lambda p: dataclasses.replace(p, class_names=np.array(["a", "b", "c", "d"])),
         "other classes"),
    ],
)  # fmt: skip
def test_answers_that_no_model_gave(folder, change, message):
    forge_predictions(folder, change)
    if message is None:  # invented answers are beyond what a record can tell
        assert problems(folder) == []
    else:
        assert message in found(folder)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t["protocol"].update(max_train_clouds=7), "has the digest"),
        (lambda t: t["training"].update(clouds_seen=10**6), "its protocol and recipe take"),
        (lambda t: t["training"].update(steps=10**6), "its protocol and recipe take"),
        (lambda t: t.update(clouds=200_000), "to the milestone 200k"),
        (lambda t: t["recipe"].update(lr=0.5), "differ in recipe"),
        (lambda t: t["recipe"].update(epochs=-1), "recipe.epochs"),
        (lambda t: t["options"].update(grid=16), "and precision it is pointnet [grid=16]"),
        (lambda t: t.update(variant="wide"), "its row is pointnet [wide], but by its options"),
        (lambda t: t["training"]["environment"].update(precision="bf16-mixed"),
         "precision it is pointnet [precision bf16-mixed]"),
        (lambda t: t["training"]["curve"].update(clouds_seen=[5, 6]), "its curve ends at 6 clouds"),
        (lambda t: t["training"].update(train_loss=0.1), "its train_loss is 0.1, the last of its"),
        (lambda t: t["train_data"]["class_names"].reverse(), "tell of other class names of it"),
        (lambda t: t.update(seed=7), "is the record of another run than its name says"),
        (lambda t: t.update(predictions_file="x.predictions.npz"),
         "names the predictions of another run, x.predictions.npz"),
        (lambda t: t["cost"].update(parameters=12), "it says 12"),
        (lambda t: t.update(weights_sha256="0" * 64, seed=1), "record the same run"),
        (lambda t: t["scores"].update(accuracy=0.99), "give another accuracy"),
        (lambda t: t["scores"].update(extra=1), "give another extra"),
        (lambda t: t["test_data"].update(clouds=7), "tells of 7 test clouds"),
        (lambda t: t.update(test_set_sha256="0" * 64), "is missing: the labels and poses"),
        (lambda t: t.update(card="0" * 64), "is missing: a model card"),
        (lambda t: t.update(model="pointnt"), "no model named 'pointnt'"),
        (lambda t: t.update(given_pose="sideways"), "a test pose is 'random' or"),
        (lambda t: t["test_data"].update(sensor="kinect-v1:much"), "test_data.sensor"),
        (lambda t: t.update(predictions_file="../x.predictions.npz"), "predictions_file"),
    ],
)  # fmt: skip
def test_a_forgery_with_mended_digests_is_found(folder, change, message):
    forge(folder, change)
    assert message in found(folder)


def test_two_records_that_changed_places_are_found(folder):
    one, other = sorted(folder.glob(f"*{SUFFIX}"))
    kept = one.read_bytes()
    one.write_bytes(other.read_bytes())
    other.write_bytes(kept)
    assert found(folder).count("is the record of another run than its name says") == 2


def test_answers_of_one_seed_are_not_those_of_another(folder):
    first_record, other = (results.read(path) for path in sorted(folder.glob(f"*{SUFFIX}")))
    data = (folder / other.predictions_file).read_bytes()
    (folder / first_record.predictions_file).write_bytes(data)
    forge(folder, lambda text: text.update(
        predictions_sha256=other.predictions_sha256, scores=other.scores
    ))  # fmt: skip
    assert "have the same answers under the seeds 1 and 0" in found(folder)


def test_a_card_with_another_title_and_figure_is_not_the_registrys(folder):
    result = results.read(first(folder))
    card = result.card | {"title": "PAPNet, steered", "paper_scores": {"pm40": 99.9}}
    digest = cards.write(folder, card)
    forge(folder, lambda text: text.update(card=digest))
    assert "its card has another title, paper_scores than the registry's" in found(folder)
    build_leaderboard(folder, folder / "out")
    with pytest.raises(InputError, match="its card has another title"):
        build_leaderboard(folder, folder / "out", check=True)


def test_one_training_does_not_count_as_two_seeds(tmp_path):
    honest(tmp_path, 0)
    path = honest(tmp_path, 1)
    weights = results.read(sorted(tmp_path.glob(f"*seed0*{SUFFIX}"))[0]).weights_sha256
    forge_file(path, lambda text: text.update(weights_sha256=weights))
    assert "have the same weights under the seeds 1 and 0" in found(tmp_path)


def test_one_training_does_not_count_as_two_milestones(tmp_path):
    weights = results.read(honest(tmp_path, 0)).weights_sha256
    path = honest(tmp_path, 0, milestone=200_000)
    forge_file(path, lambda text: text.update(weights_sha256=weights))
    assert "have the same weights under the milestones 200k and 100k" in found(tmp_path)


def test_one_training_may_be_a_row_under_options_of_its_test(tmp_path):
    made = record("mine:make", predictions(0.6, 0))
    for options, answers in (({}, 0), ({"k": 5}, 1)):
        variant = "k=5" if options else ""
        stored = predictions(0.6, answers)
        other = record("mine:make", stored, variant=variant, options=options)
        other = dataclasses.replace(other, weights_sha256=made.weights_sha256)
        results.write(tmp_path, other, stored)
    assert problems(tmp_path, recompute=False) == []


@pytest.mark.parametrize("condition", [{}, {"damage": "jitter:3"}, {"points": 64}])
@pytest.mark.parametrize("kept", [slice(0, 60), slice(1, None), np.r_[1:120, 0]])
def test_what_is_set_side_by_side_is_tested_on_the_same_clouds(tmp_path, condition, kept):
    honest(tmp_path, 0)
    stored = predictions(0.6, 0 if condition else 1).select(kept)
    made = record(MODEL, stored, 0 if condition else 1, **condition)
    before = results.read(first(tmp_path))
    made = dataclasses.replace(made, card=before.card, recipe=before.recipe, cost=before.cost)
    results.write(tmp_path, made, stored)
    assert f"was tested on {len(stored)} clouds" in found(tmp_path) or (
        f"on {len(stored)}, of which" in found(tmp_path)
    )


def test_which_clouds_are_duplicates_is_no_matter_of_the_model(folder):
    """What a model got wrong would else be left out of its accuracy without them."""
    forge_predictions(folder, lambda p: dataclasses.replace(p, duplicate=p.predicted != p.labels))
    assert "one says that they are of a training object's bytes" in found(folder)


@pytest.mark.parametrize("milestone", [100_000, 200_000])
def test_one_row_is_of_one_version_of_a_model_at_every_milestone(tmp_path, milestone):
    """Its curve over clouds seen would else join two models."""
    add(tmp_path, "mine:make", 0.9, model_code="a" * 64)
    add(tmp_path, "mine:make", 0.9, 1, milestone=milestone, model_code="b" * 64)
    (wrong,) = problems(tmp_path, recompute=False)
    assert "are of one row, mine:make, but the model's file was another" in wrong


def leaves(value, path=()):
    """Every entry of JSON data, containers too."""
    yield path
    inner = value.items() if isinstance(value, dict) else (
        enumerate(value) if isinstance(value, list) else ()
    )  # fmt: skip
    for key, below in inner:
        yield from leaves(below, (*path, key))


def test_a_hundred_mutated_records_give_a_sentence_each(folder):
    """Entries missing or of another kind, with a digest that fits."""
    rng = random.Random(0)
    text = json.loads(first(folder).read_text())
    places = [path for path in leaves(text) if path and path != ("record_sha256",)]
    quiet = []
    for _ in range(120):
        mutated = json.loads(json.dumps(text))
        *above, last = rng.choice(places)
        holder = mutated
        for key in above:
            holder = holder[key]
        value = rng.choice([None, "x", -1, 1.5, [], {}, True, [1], {"a": 1}, 10**30])
        if rng.random() < 0.3:
            del holder[last]
        else:
            holder[last] = value
        mutated["record_sha256"] = results.record_digest(mutated)
        first(folder).write_text(json.dumps(mutated))
        if not problems(folder):
            quiet.append((above, last, value))
            build_leaderboard(folder, folder / "out")  # what is let through stumbles nowhere
    # What is told of hardware, dates and prose nothing contradicts; records from before there was
    # damage or a grid have neither entry.
    told = ("environment", "training", "deviations", "cost", "rotation_audit", "company_audit",
            "protocol", "test_data", "train_data", "recipe", "given_pose", "model_code", "card",
            "scores", "options", "variant", "weights_sha256", "seed", "clouds",
            *results.LATER)  # fmt: skip
    assert [place for place in quiet if (*place[0], place[1])[0] not in told] == []
    assert len(quiet) < 40


@pytest.mark.parametrize("pattern", [f"*{SUFFIX}", f"*{PREDICTIONS_SUFFIX}", "testsets/*",
                                     "cards/*"])  # fmt: skip
def test_bits_flipped_and_files_cut_give_a_sentence(folder, pattern):
    rng = random.Random(1)
    path = sorted(folder.glob(pattern))[0]
    whole = path.read_bytes()
    for turn in range(40):
        data = bytearray(whole)
        if turn % 2:
            data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)
        else:
            del data[rng.randrange(len(data)) :]
        path.write_bytes(data)
        sentences = check.problems(folder, recompute=False)
        # Bits that no reader looks at (a zip's own times) change nothing.
        if not sentences:
            assert pattern == "testsets/*"
            assert turn % 2
            results.read_predictions(folder, results.read(first(folder)))
    path.write_bytes(whole)
    assert problems(folder) == []
