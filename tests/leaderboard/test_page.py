"""The page in a real browser, where one is installed; what needs no browser is tested always."""

from __future__ import annotations

import dataclasses
import re
import shutil

import pytest
from scipy.spatial.transform import Rotation

from leaderboard.build import build_leaderboard
from partialbench.benchmark.records import results
from partialbench.dataset.loader import ShardDataset
from tests.benchmark.memory_clouds import data_folder
from tests.leaderboard.records import CLASSES, predictions, record, small_board


@pytest.fixture(scope="module")
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
    build_leaderboard(root / "results", root / "board", data=[data])
    return root / "board" / "leaderboard.html"


def test_the_page_asks_nobody_and_escapes_what_it_is_given(built):
    text = built.read_text()
    assert not re.findall(r"""(?:src|href)=["'](?!data:)""", text)
    assert "http" not in re.sub(r'content="default-src[^"]*"|http-equiv', "", text)
    assert "<i>right" not in text
    assert "&lt;i&gt;right&lt;/i&gt; &amp; co" in text
    assert "a choice with &lt;b&gt; &amp; ünïcode" in text


@pytest.fixture(scope="module")
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


def models(page, section=1):
    return page.locator(
        f"section:nth-of-type({section}) tr.row:visible td:first-child"
    ).evaluate_all("cells => cells.map(c => c.dataset.value)")


def test_a_heading_sorts_both_ways_by_number_and_rows_keep_their_detail(page):
    assert models(page)[-1] == "POOR"  # by accuracy, best first
    head = page.locator("section").first.get_by_role("button", name="parameters")
    head.click()
    numbers = page.locator("section:nth-of-type(1) tr.row td").evaluate_all(
        "cells => cells.filter(c => c.cellIndex == 10).map(c => +c.dataset.value)"
    )
    assert numbers == sorted(numbers)
    head.click()
    assert page.locator("section th[aria-sort=descending]").first.inner_text().startswith("param")
    by_name = page.locator("section").first.get_by_role("button", name="model", exact=True)
    by_name.click()
    assert models(page) == sorted(models(page))
    page.locator("section").first.get_by_role("button", name="POOR").click()
    assert page.locator("tr.row:has-text('POOR') + tr.detail").first.is_visible()


def test_a_row_opens_to_its_card_and_closes(page):
    button = page.locator("section").first.get_by_role("button", name="GOOD")
    detail = page.locator("section").first.locator("tr.row:has-text('GOOD') + tr.detail")
    assert not detail.is_visible()
    button.click()
    assert detail.is_visible()
    assert "Somebody et al., 2021" in detail.inner_text()
    assert "29 epochs instead of 250" in detail.inner_text()
    assert "bottle" in detail.inner_text()
    assert "training loss over epochs: 1.500 → 0.500" in detail.inner_text()
    assert detail.locator("polyline").first.get_attribute("points") == "0.0,1.0 100.0,29.0"
    assert detail.locator(".bars").bounding_box()["x"] < 1280 - 100  # seen without scrolling
    button.click()
    assert not detail.is_visible()


def test_filters_hide_other_data_and_other_models(page):
    assert page.locator("section:visible").count() == 3
    page.select_option("#column", "0")
    assert page.locator("section:visible").count() == 1
    page.select_option("#column", "")
    page.fill("#model", "ev")
    assert models(page) == ["EVEN"]
    page.fill("#model", "")
    assert len(models(page)) == 3


def test_a_cloud_turns_by_mouse_and_by_key_and_shows_the_predicted_pose(page):
    canvas = page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    empty = "c => { c.getContext('2d').clearRect(0, 0, c.width, c.height); }"
    first = canvas.screenshot()
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 60, box["y"] + 60)
    page.mouse.down()
    page.mouse.move(box["x"] + 120, box["y"] + 80, steps=4)
    page.mouse.up()
    dragged = canvas.screenshot()
    assert dragged != first
    assert float(canvas.get_attribute("data-yaw")) == pytest.approx(-60 * 0.012, abs=1e-3)
    canvas.press("ArrowLeft")
    before = canvas.screenshot()
    assert before != dragged
    page.locator("figure:has(canvas)").first.locator("input").first.check()
    after = canvas.screenshot()
    assert after != before
    canvas.evaluate(empty)
    assert len(canvas.screenshot()) < 0.5 * len(after)  # and there was something to see


def test_it_fits_a_phone_and_paper(page):
    page.set_viewport_size({"width": 380, "height": 800})
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")
    page.emulate_media(media="print")
    assert not page.locator(".filters").is_visible()
    assert page.locator("table").first.is_visible()
