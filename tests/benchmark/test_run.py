"""``run_eval`` from a data folder to records, ``predict`` from a checkpoint, a user's own model."""

from __future__ import annotations

import dataclasses
import json
import re
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
import trimesh
from PIL import Image
from typer.testing import CliRunner

from partialbench import registry
from partialbench.benchmark import audit, checkpoint, evaluate, metrics, results
from partialbench.benchmark.predict import draw, predict, read_points
from partialbench.benchmark.run import run_eval
from partialbench.cli import app
from partialbench.errors import InputError
from partialbench.geometry.camera import Camera
from tests.benchmark.memory_clouds import MemoryClouds, data_folder
from tests.benchmark.tiny_models import Bare, Posed

MODELS = "tests.benchmark.tiny_models"
ROOT = Path(__file__).resolve().parents[2]
SMALL = {
    "preset": "smoke", "device": "cpu", "num_points": 64, "epochs": 1, "max_train_clouds": 200,
    "max_test_clouds": 200,
}  # fmt: skip


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return data_folder(tmp_path_factory.mktemp("data") / "toy")


@pytest.fixture(scope="module")
def other(tmp_path_factory) -> Path:
    """Shares chair and table with ``data``, in another order, and has a class of its own."""
    folder = tmp_path_factory.mktemp("data") / "other"
    return data_folder(folder, "toy-rooms", ("table", "lamp", "chair"), seed=5)


@pytest.fixture(scope="module")
def done(data, other, tmp_path_factory):
    """Two seeds of a posed model on both data sets, and the folder of records."""
    folder = tmp_path_factory.mktemp("results")
    written = run_eval(f"{MODELS}:Posed", data, other, seeds=2, results_folder=folder, **SMALL)
    return written, folder


def test_a_record_per_seed_and_test_set(done):
    written, folder = done
    assert [(r.seed, r.test_data.id) for r in written] == [
        (0, "toy"), (0, "toy-rooms"), (1, "toy"), (1, "toy-rooms"),
    ]  # fmt: skip
    assert sorted(p.name for p in folder.glob("*.json")) == sorted(
        f"{r.run_name}.result.json" for r in written
    )
    assert {r.run_name for r in results.read_folder(folder)} == {r.run_name for r in written}


def test_a_record_says_what_made_it(done, data):
    record, folder = done[0][0], done[1]
    manifest = json.loads((data / "manifest.json").read_text())
    assert record.train_data.digest == manifest["digests"]["train"]
    assert record.test_data.digest == manifest["digests"]["test"]
    # 12 objects a class, one of each validates; two views.
    assert (record.train_data.clouds, record.train_data.objects) == (66, 33)
    assert record.protocol["preset"] == "smoke+"
    assert record.cost["parameters"] == sum(p.numel() for p in Bare(63).parameters())
    assert record.environment["instructions"] == torch.backends.cpu.get_cpu_capability()
    assert record.environment["packages"]["torch"] == torch.__version__.split("+")[0] or (
        record.environment["packages"]["torch"] == torch.__version__
    )
    assert record.training["clouds_seen"] == 64
    assert record.deviations
    assert record.seed == 0
    log = next((folder / "runs").glob("*seed0")) / "log.csv"
    assert len(log.read_text().splitlines()) == 2


def test_scores_are_those_of_the_stored_predictions(done):
    for record in done[0]:
        stored = results.read_predictions(done[1], record)
        again = metrics.scores(stored, record.train_data.class_names, record.test_data.class_names)
        assert again == record.scores
        assert record.scores["pose"]["top_k"][-1] >= record.scores["pose"]["top_k"][0]


def test_another_data_set_is_scored_on_the_shared_classes(done):
    crossed = done[0][1]
    assert crossed.scores["clouds"] == 48  # chair and table, 12 objects, 2 views
    assert crossed.scores["per_class"]["bottle"] is None
    assert crossed.scores["restricted_accuracy"] >= crossed.scores["accuracy"]
    assert crossed.column != done[0][0].column


def test_a_field_of_the_protocol_may_be_called_as_an_argument_is(data, tmp_path):
    """The command line takes any field, "recipe" too, and refuses what is none."""
    fields = {"recipe": "short", "num_points": 64}
    command = [
        "eval", "--model", f"{MODELS}:Posed", "--data", str(data), "--preset", "smoke",
        "--device", "cpu", "--results", str(tmp_path),
    ]  # fmt: skip
    for name, value in fields.items():
        command += ["--protocol", f"{name}={value}"]
    ran = CliRunner().invoke(app, command)
    assert ran.exit_code == 0, ran.output
    (record,) = results.read_folder(tmp_path)
    assert {name: record.protocol[name] for name in fields} == fields
    assert record.recipe["schedule"] == "one-cycle"
    for name in ("seeds", "preset"):
        with pytest.raises(InputError, match=f"the protocol has no field '{name}'"):
            run_eval(f"{MODELS}:Posed", data, device="cpu", protocol={name: 1})


def test_the_same_weights_on_clouds_of_other_sizes(done, data, tmp_path):
    """One record each; only those of the size trained on are of the table's column."""
    written, folder = done
    (weights,) = (folder / "runs").glob("*seed0/checkpoint.pt")
    found = run_eval(
        f"{MODELS}:Posed", data, checkpoint_file=weights, device="cpu", results_folder=tmp_path,
        test_points=[16, 32, 64],
    )  # fmt: skip
    assert [r.test_data.points for r in found] == [64, 16, 32]
    assert [r.conditions for r in found] == [{}, {"points": "16"}, {"points": "32"}]
    assert found[0].column == written[0].column
    assert found[1].column != found[2].column
    assert len(results.read_folder(tmp_path)) == 3
    with pytest.raises(InputError, match="100000 were asked for"):
        run_eval(
            f"{MODELS}:Posed", data, checkpoint_file=weights, device="cpu",
            results_folder=tmp_path, test_points=[100_000],
        )  # fmt: skip


def test_a_checkpoint_tested_alone_gives_the_same_record(done, data, tmp_path):
    first, folder = done[0][0], done[1]
    weights = next((folder / "runs").glob("*seed0")) / "checkpoint.pt"
    (again,) = run_eval(
        first.model, data, checkpoint_file=weights, device="cpu", results_folder=tmp_path
    )
    assert again.identity == first.identity
    assert again.predictions_sha256 == first.predictions_sha256
    assert again.scores == first.scores
    assert again.training == first.training
    with pytest.raises(InputError, match=r"holds a .*Posed', not a 'pointnet'"):
        run_eval("pointnet", data, checkpoint_file=weights, device="cpu", results_folder=tmp_path)


def test_options_that_weights_do_not_depend_on_can_be_changed_for_a_test(data, tmp_path):
    """A row of its own, and the one that training under those options would have made."""
    trained = {
        "data": data,
        "recipe": {"lr": 0.01},
        **SMALL,
        "max_train_clouds": 32,
        "max_test_clouds": 12,
    }
    alike, other = (
        run_eval(
            "papnet", options={"grid": 16, "variant": variant}, results_folder=tmp_path / variant,
            **trained,
        )[0]
        for variant in ("predicted", "predicted-ensemble")
    )  # fmt: skip
    (weights,) = (tmp_path / "predicted" / "runs").glob("*/checkpoint.pt")

    def with_options(**options):
        return run_eval(
            "papnet", data, checkpoint_file=weights, device="cpu", options=options,
            results_folder=tmp_path / "changed",
        )[0]  # fmt: skip

    changed = with_options(variant="predicted-ensemble")
    assert changed.row == other.row != alike.row
    assert changed.options == other.options
    assert changed.identity == other.identity
    assert changed.predictions_sha256 == other.predictions_sha256 != alike.predictions_sha256
    with pytest.raises(InputError, match="weights do not fit"):
        with_options(variant="cascaded")


def test_resuming_a_finished_evaluation_changes_no_prediction(done, data, other):
    written, folder = done
    weights = sorted((folder / "runs").glob("*/checkpoint.pt"))
    before = [w.read_bytes() for w in weights]
    again = run_eval(
        f"{MODELS}:Posed", data, other, seeds=2, results_folder=folder, resume=True, **SMALL
    )
    assert [w.read_bytes() for w in weights] == before
    assert [r.predictions_sha256 for r in again] == [r.predictions_sha256 for r in written]


def test_what_the_user_changes_is_another_row(data, tmp_path):
    (plain,) = run_eval(f"{MODELS}:Bare", data, results_folder=tmp_path, **SMALL)
    (changed,) = run_eval(
        f"{MODELS}:Bare", data, results_folder=tmp_path, recipe={"lr": 0.1}, options={"width": 8},
        **SMALL,
    )  # fmt: skip
    assert plain.row == f"{MODELS}:Bare"
    assert changed.row == f"{MODELS}:Bare [lr=0.1 width=8]"
    assert changed.column == plain.column
    assert "lr 0.1 instead of 0.001" in changed.deviations
    assert changed.cost["parameters"] < plain.cost["parameters"]
    assert len(results.read_folder(tmp_path)) == 2


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"seeds": 0}, "seeds must be at least 1, got 0"),
        ({"device": "gpu"}, "device must be auto, cpu, cuda"),
        ({"preset": "papr"}, "did you mean paper"),
        ({"epoch": 1}, "did you mean epochs"),
        ({"recipe": {"learning_rate": 1}}, "a recipe has no field 'learning_rate'"),
        ({"num_points": 4096}, "4096 were asked for"),
        ({"data": None}, "nothing to train on"),
        ({"checkpoint_file": "no.pt"}, "no checkpoint at no.pt"),
        ({"precision": "32-false"}, "precision '32-false'"),
    ],
)
def test_wrong_arguments_are_named(data, tmp_path, arguments, message):
    given = {**SMALL, "data": data, "results_folder": tmp_path, **arguments}
    with pytest.raises(InputError, match=message):
        run_eval(f"{MODELS}:Bare", **given)


def test_a_test_set_without_a_shared_class_is_refused(data, tmp_path):
    foreign = data_folder(tmp_path / "foreign", "foreign", ("sink", "stove"))
    with pytest.raises(InputError, match="share no class"):
        run_eval(f"{MODELS}:Bare", data, foreign, results_folder=tmp_path, **SMALL)


# Records that cannot be trusted.


def copy_of(done, tmp_path) -> Path:
    shutil.copytree(done[1], tmp_path / "copy", ignore=shutil.ignore_patterns("runs"))
    return tmp_path / "copy"


def test_a_record_edited_by_hand_is_refused(done, tmp_path):
    folder = copy_of(done, tmp_path)
    path = sorted(folder.glob("*.json"))[0]
    record = json.loads(path.read_text())
    record["scores"]["accuracy"] = 0.99
    path.write_text(json.dumps(record))
    with pytest.raises(InputError, match="was changed after it was written"):
        results.read(path)


@pytest.mark.parametrize(
    ("damage", "message"),
    [
        (lambda p: p.write_text("{"), "not a readable JSON"),
        (lambda p: p.write_text("[]"), "not a result record"),
        (lambda p: p.write_text('{"format": "partialbench-result", "format_version": 9}'),
         "format 9, this version reads 2"),
        (lambda p: p.write_text('{"format": "partialbench-result", "format_version": 2}'),
         "missing fields .'card'"),
    ],
)  # fmt: skip
def test_a_file_that_is_no_record_says_so(done, tmp_path, damage, message):
    path = sorted(copy_of(done, tmp_path).glob("*.json"))[0]
    damage(path)
    with pytest.raises(InputError, match=message):
        results.read(path)


def test_predictions_must_be_there_and_be_the_records_own(done, tmp_path):
    folder = copy_of(done, tmp_path)
    a, b = results.read_folder(folder)[:2]
    shutil.copy(folder / b.predictions_file, folder / a.predictions_file)
    with pytest.raises(InputError, match="is not the file its record was written with"):
        results.read_predictions(folder, a)
    (folder / a.predictions_file).unlink()
    with pytest.raises(InputError, match="is missing"):
        results.read_predictions(folder, a)


def test_two_records_of_one_run_are_refused(done, tmp_path):
    folder = copy_of(done, tmp_path)
    path = sorted(folder.glob("*.json"))[0]
    shutil.copy(path, folder / f"again-{path.name}")
    with pytest.raises(InputError, match="record the same run"):
        results.read_folder(folder)


# The evaluation itself.


def test_predictions_do_not_depend_on_the_batch_size():
    torch.manual_seed(0)
    model, clouds = Bare(3), MemoryClouds()
    rows = np.arange(50)
    a = evaluate.predict_rows(model, clouds, rows, 3, batch_size=7)
    b = evaluate.predict_rows(model, clouds, rows, 3, batch_size=50)
    assert np.array_equal(a.predicted, b.predicted)
    assert np.allclose(a.log_probabilities, b.log_probabilities, atol=2e-3)
    assert np.allclose(a.rotations, clouds.rotations[rows], atol=1e-6)
    assert np.allclose(np.exp(a.log_probabilities.astype(float)).sum(1), 1, atol=2e-3)


@pytest.mark.parametrize("variant", ["ground-truth", "predicted", "without-pose"])
def test_what_is_stored_gives_the_score_of_every_ensemble(variant):
    """Against PAPNet itself, made anew with each k."""
    clouds, rows = MemoryClouds(objects=4, views=1), np.arange(12)

    def papnet(k):
        torch.manual_seed(0)
        model = registry.create("papnet", 3, variant=variant, k=k, grid=16).eval()
        model.k = 1
        with torch.no_grad():  # fresh weights name one class always; so far as it is the same, off
            logits = model(torch.from_numpy(clouds.points(rows))).class_logits
            model.class_head.fc[-1].bias -= logits.mean(0)
        model.k = k
        return model

    stored = evaluate.predict_rows(papnet(20), clouds, rows, 3)
    labels = stored.labels.astype(int)
    by_k = metrics.ensemble_accuracy(stored.candidate_logits, stored.candidate_classes, labels)
    if variant != "ground-truth":  # which decide by one pose, or by none
        assert by_k is None
        return
    assert stored.candidate_logits.shape == (12, 20)
    assert by_k[19] == metrics.accuracy(labels, stored.predicted)
    assert len(set(by_k)) > 1
    seven = evaluate.predict_rows(papnet(7), clouds, rows, 3)
    assert seven.candidate_logits.shape == (12, 7)
    assert by_k[6] == metrics.accuracy(labels, seven.predicted)
    loudest = stored.candidate_logits[:, :7].argmax(1)
    answer = np.take_along_axis(stored.candidate_classes, loudest[:, None], 1)[:, 0]
    assert np.array_equal(seven.predicted, answer)


def test_candidates_of_another_shape_are_refused():
    class Wrong(Posed):
        def forward(self, clouds):
            shape = len(clouds), 20
            said = torch.zeros(shape), torch.zeros(len(clouds), 19)
            return super().forward(clouds)._replace(candidates=said)

    with pytest.raises(InputError, match=r"classes have shape \(8, 19\), expected \(8, 20\) for 8"):
        evaluate.predict_rows(Wrong(3), MemoryClouds(), np.arange(8), 3)


def test_a_model_that_answers_nan_is_refused():
    class Nan(Bare):
        def forward(self, clouds):
            logits = super().forward(clouds)
            logits[1, 0] = float("nan")
            return logits

    with pytest.raises(evaluate.NotFiniteError, match=r"1 of 8 clouds \(rows 0 to 7\)"):
        evaluate.predict_rows(Nan(3), MemoryClouds(), np.arange(8), 3)


def test_the_rotation_audit_tells_an_invariant_model_from_one_that_is_not():
    class Radii(torch.nn.Module):
        def forward(self, clouds):
            centred = clouds - clouds.mean(1, keepdim=True)
            return centred.norm(dim=2).sort(dim=1).values[:, ::16]

    clouds = MemoryClouds()
    still = audit.rotation_audit(Radii(), clouds, 4)
    assert still["drift"] < 1e-5
    assert still["changed"] == 0
    torch.manual_seed(0)
    assert audit.rotation_audit(Bare(3), clouds, 3)["drift"] > 0.05


def test_cost_counts_the_multiply_adds_of_a_known_network():
    class Known(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.a, self.b = torch.nn.Linear(3, 8), torch.nn.Linear(8, 5)

        def forward(self, clouds):
            return self.b(self.a(clouds).amax(1))

    cost = audit.cost(Known(), MemoryClouds(num_points=64))
    assert cost["multiply_adds"] == 64 * 3 * 8 + 8 * 5
    assert cost["parameters"] == 3 * 8 + 8 + 8 * 5 + 5
    assert cost["latency_ms"] > 0
    assert cost["peak_memory_bytes"] > 2**20


# A user's own capture.


@pytest.fixture(scope="module")
def weights(done) -> Path:
    return next((done[1] / "runs").glob("*seed0")) / "checkpoint.pt"


def test_every_cloud_format_gives_the_same_answer(weights, tmp_path):
    cloud = MemoryClouds().points([3])[0]
    trimesh.PointCloud(cloud).export(tmp_path / "a.ply")
    np.save(tmp_path / "a.npy", cloud)
    np.savetxt(tmp_path / "a.xyz", cloud, fmt="%.9g")
    np.savetxt(tmp_path / "a.csv", cloud, fmt="%.9g", delimiter=",")
    answers = [predict(weights, tmp_path / f"a.{kind}") for kind in ("ply", "npy", "xyz", "csv")]
    first = answers[0]
    assert first.points_given == first.points_used == 64
    assert [name for name, _ in first.top] == [name for name, _ in answers[1].top]
    assert sum(p for _, p in first.top) == pytest.approx(1, abs=1e-5)  # three classes, top 3
    assert first.class_name == first.top[0][0]
    assert first.confidence == max(p for _, p in first.top)
    assert len(first.poses) == 5
    assert np.allclose(first.poses[0][0] @ first.poses[0][0].T, np.eye(3))
    for answer in answers[1:]:
        assert [p for _, p in answer.top] == pytest.approx([p for _, p in first.top], abs=1e-6)


def test_a_depth_image_is_the_cloud_it_was_made_from(weights, tmp_path):
    camera = Camera(np.array([[60, 0, 20.5], [0, 60, 16.0], [0, 0, 1.0]]), 40, 32)
    rng = np.random.default_rng(0)
    depth = np.where(rng.random((32, 40)) < 0.3, rng.integers(1500, 2500, (32, 40)), 0)
    Image.fromarray(depth.astype(np.uint16)).save(tmp_path / "d.png")
    np.save(tmp_path / "d.npy", np.where(depth > 0, depth / 1000, np.nan))
    expected = camera.unproject_depth(depth / 1000)
    from_png = read_points(tmp_path / "d.png", camera.K, 0.001)
    assert np.allclose(from_png, expected)
    assert np.allclose(read_points(tmp_path / "d.npy", (60, 60, 20.5, 16.0)), expected)
    found = predict(weights, tmp_path / "d.png", camera.K, 0.001)
    assert found.points_used == len(expected) // 64 * 64 > 64


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("a.xyz", "1 2 3\n4 x 6\n", "cannot be read"),
        ("a.xyz", "1 2 3\n4 5 6\n", "2 finite points, at least 16"),
        ("a.xyz", "nan nan nan\n" * 20, "0 finite points"),
        ("a.obj", "v 0 0 0", ".obj is not read"),
        ("a.ply", "ply", "cannot be read|holds no points"),
    ],
)
def test_a_file_that_is_no_cloud_says_so(weights, tmp_path, name, content, message):
    (tmp_path / name).write_text(content)
    with pytest.raises(InputError, match=message):
        predict(weights, tmp_path / name)


def test_a_depth_image_needs_intrinsics_that_make_sense(weights, tmp_path):
    np.save(tmp_path / "d.npy", np.ones((20, 30)))
    with pytest.raises(InputError, match="30×20 pixels: its intrinsics are needed"):
        predict(weights, tmp_path / "d.npy")
    with pytest.raises(InputError, match="focal lengths must be positive"):
        predict(weights, tmp_path / "d.npy", (-1, 1, 0, 0))
    with pytest.raises(InputError, match="no file at"):
        predict(weights, tmp_path / "absent.ply")


def test_few_points_are_all_used_before_any_is_repeated(rng):
    points = rng.standard_normal((20, 3)).astype(np.float32)
    (drawn,) = draw(points, 50)
    assert drawn.shape == (50, 3)
    assert {tuple(p) for p in drawn} == {tuple(p) for p in points}
    apart = draw(rng.standard_normal((110, 3)), 50, 2)
    assert len({tuple(p) for p in apart.reshape(-1, 3)}) == 100


def test_a_dense_capture_is_cut_into_clouds_that_vote(weights, tmp_path, rng):
    points = rng.standard_normal((64 * 3 + 10, 3))
    np.save(tmp_path / "dense.npy", points)
    model = checkpoint.build_model(checkpoint.load(weights))
    with torch.inference_mode():
        each = model(torch.from_numpy(draw(points, 64, 3)))
    for votes, used in ((8, 3), (2, 2), (1, 1)):
        found = predict(weights, tmp_path / "dense.npy", votes=votes)
        assert found.points_used == used * 64
        expected = each.class_logits[:used].softmax(1).mean(0)
        assert found.confidence == pytest.approx(float(expected.max()), abs=1e-6)
        pose = each.pose_logits[:used].softmax(1).mean(0)
        assert found.poses[0][1] == pytest.approx(float(pose.max()), abs=1e-6)
    with pytest.raises(InputError, match="votes must be at least 1, got 0"):
        predict(weights, tmp_path / "dense.npy", votes=0)


def test_the_example_of_a_users_own_model_runs_from_its_folder(data, tmp_path):
    example = ROOT / "examples" / "my_model.py"
    code = [line for line in example.read_text().splitlines() if line.strip()]
    assert len(code) < 30
    # The page's code is the example's, and what runs is the page's.
    (block,) = re.findall(r"```python\n(.*?)```", (ROOT / "docs/own_model.md").read_text(), re.S)
    assert block == example.read_text()
    (tmp_path / "my_model.py").write_text(block)
    command = [
        sys.executable, "-P", "-c", "from partialbench.cli import main; main()",
        "eval", "--model", "my_model:make",
        "--data", str(data), "--preset", "smoke", "--protocol", "num_points=64",
        "--device", "cpu", "--results", "out",
    ]  # fmt: skip
    ran = subprocess.run(
        command, cwd=tmp_path, capture_output=True, text=True, check=False, timeout=300,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1",
             "HOME": str(tmp_path)},
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    (record,) = results.read_folder(tmp_path / "out")
    assert record.model == "my_model:make"
    assert record.cost["parameters"] == 3 * 64 + 64 + 64 * 256 + 256 + 256 * 3 + 3
    assert dataclasses.asdict(record)["scores"]["clouds"] == 16
