"""What tests of boards share."""

from __future__ import annotations

import dataclasses
import shutil

import pytest
from scipy.spatial.transform import Rotation

from leaderboard import consistency
from leaderboard.build import build_leaderboard
from partialbench.benchmark.records import declared, results
from partialbench.benchmark.records.declared import Declared
from partialbench.dataset.loader import ShardDataset
from tests.benchmark.memory_clouds import data_folder
from tests.leaderboard.records import CLASSES, add, predictions, record, small_board


@pytest.fixture
def made_up_models(monkeypatch):
    """Records are of models that no registry has, and are not held against it."""
    monkeypatch.setattr(consistency, "registry_faults", lambda result: iter(()))


@pytest.fixture(scope="session")
def built(tmp_path_factory):
    """A board of three models over a data folder that is at hand."""
    root = tmp_path_factory.mktemp("page")
    small_board(root / "results")
    data = data_folder(root / "data", "solids", CLASSES, objects=10, views=2)
    test = ShardDataset(data, "test", 64)
    for name, chance, posed in (("right", 0.8, True), ("wrong", 0.3, False)):
        stored = predictions(chance, len(name), len(test) // 2, 2, posed)
        # Made-up answers about the real rows of the folder.
        shift = (stored.predicted - stored.labels) % len(CLASSES)
        said = (test.labels + shift) % len(CLASSES)
        stored = dataclasses.replace(
            stored, labels=test.labels.astype("int16"),
            classes=((stored.classes + said[:, None] - stored.predicted[:, None])
                     % len(CLASSES)).astype("int16"),
            object_ids=test.object_ids, views=test.views, symmetries=test.symmetries,
            quaternions=Rotation.from_matrix(test.rotations).as_quat().astype("float32"),
        )  # fmt: skip
        made = record(name, stored, data="solids", title=f"<i>{name}</i> & co")
        made = dataclasses.replace(
            made, test_data=dataclasses.replace(made.test_data, digest=test.digest)
        )
        results.write(root / "results", made, stored)
    add(root / "results", "good", 0.9, options={"k": 5}, posed=True)
    add(root / "results", "good", 0.5, points=64, posed=True)
    add(root / "results", "good", 0.95, given_pose="0", posed=True)
    add(root / "results", "good", 0.98, setting="aligned", digest="e")
    first = next(r for r in results.read_folder(root / "results") if r.row == "good")
    asked = [
        Declared(
            first.train_data.id, first.test_data.id, first.train_data.digest,
            first.test_data.digest, "board", first.protocol_digest, 100_000, name, "",
            name.upper(), seed, state, reason,
        )
        for name, seed, state, reason in [
            ("wild", 0, "failed", "the loss became nan"),
            *((f"late{i}", 0, "missing", "") for i in range(5)),
            *(("good", seed, "missing", "") for seed in range(3)),
        ]
    ]  # fmt: skip
    declared.write(root / "results" / f"a{declared.SUFFIX}", asked)
    build_leaderboard(root / "results", root / "board", data=[data])
    return root / "board" / "leaderboard.html"


@pytest.fixture(scope="session")
def browser():
    api = pytest.importorskip("playwright.sync_api", reason="playwright is not installed")
    chromium = shutil.which("chromium") or shutil.which("google-chrome")
    if chromium is None:
        pytest.skip("no chromium on this machine")
    with api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        yield browser
        browser.close()


@pytest.fixture
def page(browser, built):
    """The page, open; afterwards: no console message, no error, no request but its own file."""
    page = browser.new_page(viewport={"width": 1280, "height": 900})
    trouble: list[str] = []
    page.on("console", lambda message: trouble.append(message.text))
    page.on("pageerror", lambda error: trouble.append(str(error)))
    page.on(
        "request",
        lambda r: None if r.url.startswith(("file:", "data:")) else trouble.append(r.url),
    )
    page.goto(built.as_uri())
    yield page
    page.close()
    assert trouble == []
