"""The page in a real browser, where one is installed; what needs no browser is tested always."""

from __future__ import annotations

import csv
import json
import os
import re
from pathlib import Path

import pytest


def test_the_page_asks_nobody_and_escapes_what_it_is_given(built):
    text = built.read_text()
    assert not re.findall(r"""\ssrc=""", text)
    links = re.findall(r"""<(\w+)[^>]*\shref=["']([^"']*)""", text)
    # An address that is followed only when a person chooses it is no request.
    assert {tag for tag, address in links if not address.startswith("data:")} <= {"a"}
    assert "<i>right" not in text
    assert "\\u003ci>right\\u003c/i> & co" in text


def names(page):
    return page.locator("#table tr.row .name .open").all_inner_texts()


def test_the_first_screen_ranks_models_at_partial_views(page):
    assert page.locator("nav a[aria-current=page]").inner_text() == "Partial"
    assert names(page)[-1] == "POOR"
    assert page.locator("#table th[aria-sort]").inner_text().startswith("accuracy")
    assert page.locator("#table tr.row").first.locator("td").first.inner_text() == "1"
    assert page.locator("header svg").bounding_box()["y"] < 300
    assert page.locator("#table").bounding_box()["y"] < 400


def test_a_heading_sorts_best_first_then_worst_first_and_missing_values_last(page):
    page.get_by_role("button", name="pose bin (%)", exact=True).click()
    assert names(page)[0] == "GOOD"
    assert names(page)[-1] != "GOOD"  # nobody else has a pose
    page.get_by_role("button", name="pose bin (%)", exact=True).click()
    assert page.locator("#table th[aria-sort=ascending]").count() == 1
    assert names(page)[0] == "GOOD"
    page.get_by_role("button", name="parameters", exact=True).click()
    assert page.locator("#table th[aria-sort=ascending]").inner_text().startswith("parameters")
    page.get_by_role("button", name="model", exact=True).click()
    assert names(page) == sorted(names(page))


def test_what_is_shown_survives_a_reload_and_the_back_button(page):
    page.get_by_role("button", name="parameters", exact=True).click()
    page.fill("#filter", "oo")
    page.get_by_role("button", name="POOR", exact=True).click()
    assert names(page) == ["GOOD", "POOR"]
    shown, address = page.locator("#table").inner_text(), page.url
    page.reload()
    assert page.url == address
    assert page.locator("#table").inner_text() == shown
    assert page.locator("tr.detail").is_visible()
    page.go_back()
    assert page.locator("tr.detail").count() == 0


def test_a_row_opens_to_its_card_its_command_and_its_classes(page):
    page.get_by_role("button", name="GOOD", exact=True).click()
    detail = page.locator("tr.detail")
    detail.wait_for()
    assert page.evaluate("document.activeElement.textContent") == "GOOD"
    for summary in detail.locator(".fold summary").all():
        summary.click()
    text = detail.inner_text()
    assert "Somebody et al., 2021" in text
    assert "a choice with <b> & ünïcode" in text
    assert "29 epochs instead of 250" in text
    assert "partialbench eval --model good --data data/pm40-parametric" in text
    assert "named" in text
    assert detail.locator(".bars").bounding_box()["x"] < 1280 - 100  # seen without scrolling
    page.get_by_role("button", name="GOOD", exact=True).press("Enter")
    assert page.locator("tr.detail").count() == 0


def test_variants_unfold_below_their_model(page):
    assert "GOOD [k=5]" not in names(page)
    page.get_by_role("button", name="1 variant").click()
    assert names(page)[names(page).index("GOOD") + 1] == "GOOD [k=5]"


def test_columns_are_chosen_and_headings_explain_themselves(page):
    page.locator(".picker summary").click()
    page.get_by_role("checkbox", name="calibration error").check()
    assert page.get_by_role("button", name="calibration error", exact=True).count() == 1
    page.get_by_role("checkbox", name="seeds").uncheck()
    assert page.get_by_role("button", name="seeds", exact=True).count() == 0
    assert "cols=" in page.url
    help_button = page.get_by_role("button", name="what calibration error means")
    page.keyboard.press("Escape")
    help_button.focus()
    assert "15 bins" in page.locator("#tip").inner_text()
    page.keyboard.press("Escape")
    assert not page.locator("#tip").is_visible()


def test_every_tab_has_its_table_and_an_empty_one_says_what_would_fill_it(page):
    for tab, text in (("Complete", "GOOD"), ("Transfer", "GOOD"), ("Noise and density", "64"),
                      ("Pose", "true pose"), ("Cost", "multiply-adds")):  # fmt: skip
        page.get_by_role("link", name=tab, exact=True).click()
        assert text in page.locator("main").inner_text()
        assert page.locator("tbody tr").count() > 0
    page.evaluate("DATA.columns.length = 0; location.hash = '#tab=noise'")
    page.locator("#empty").wait_for()
    assert "--test-points" in page.locator("#empty").inner_text()


def test_figures_have_legends_and_labels_do_not_overlap(page):
    for figure in page.locator("figure:has(svg.chart)").all():
        assert figure.locator(".key li").count() >= 1
        boxes = [t.bounding_box() for t in figure.locator("svg.chart text").all()]
        for i, a in enumerate(boxes):
            for b in boxes[i + 1 :]:
                apart = (
                    a["x"] + a["width"] <= b["x"] + 0.5 or b["x"] + b["width"] <= a["x"] + 0.5
                    or a["y"] + a["height"] <= b["y"] + 2 or b["y"] + b["height"] <= a["y"] + 2
                )  # fmt: skip
                assert apart


def test_a_cloud_turns_by_mouse_and_by_key_and_shows_the_predicted_pose(page):
    assert page.locator("canvas").count() == 0
    page.get_by_role("link", name="Clouds on which the models disagree").click()
    assert page.locator("#data-set").input_value().startswith("solids")
    canvas = page.locator("canvas").first
    canvas.scroll_into_view_if_needed()
    first, yaw = canvas.screenshot(), float(canvas.get_attribute("data-yaw"))
    box = canvas.bounding_box()
    page.mouse.move(box["x"] + 60, box["y"] + 60)
    page.mouse.down()
    page.mouse.move(box["x"] + 120, box["y"] + 80, steps=4)
    page.mouse.up()
    dragged = canvas.screenshot()
    assert dragged != first
    assert float(canvas.get_attribute("data-yaw")) == pytest.approx(yaw - 60 * 0.012, abs=1e-3)
    canvas.press("ArrowLeft")
    before = canvas.screenshot()
    assert before != dragged
    page.locator("figure:has(canvas) select").first.select_option(index=1)
    after = canvas.screenshot()
    assert after != before
    canvas.evaluate("c => { c.getContext('2d').clearRect(0, 0, c.width, c.height); }")
    assert len(canvas.screenshot()) < 0.5 * len(after)  # and there was something to see


def test_downloads_have_the_numbers_of_the_table(page):
    page.locator("summary", has_text="Downloads").click()
    texts = {}
    for kind in ("CSV", "JSON", "LaTeX"):
        with page.expect_download() as started:
            page.get_by_role("button", name=kind, exact=True).click()
        texts[kind] = Path(started.value.path()).read_text()
    rows = json.loads(texts["JSON"])["rows"]
    lines = list(csv.DictReader(texts["CSV"].splitlines()))
    assert [float(line["accuracy"]) for line in lines] == [row["accuracy"] for row in rows]
    assert texts["LaTeX"].count(r"\\") == len(rows) + 1


@pytest.mark.parametrize("width", [390, 1280, 1440])
@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_nothing_is_wider_than_the_screen_on_any_tab(page, width, scheme):
    page.set_viewport_size({"width": width, "height": 850})
    page.emulate_media(color_scheme=scheme)
    for tab in ("partial", "complete", "transfer", "noise", "pose", "cost"):
        page.evaluate(f"location.hash = '#tab={tab}&row=good'")
        page.locator(f"nav a[href*='tab={tab}'][aria-current]").wait_for()
        page.locator(".picker summary").click()
        box = page.locator(".picker > div").bounding_box()
        assert box["x"] >= 0
        assert box["x"] + box["width"] <= width
        assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_paper_has_every_column_of_the_table(page):
    page.emulate_media(media="print")
    page.set_viewport_size({"width": 1040, "height": 700})  # A4 across, less its margins
    assert not page.locator(".controls").is_visible()
    # The page draws its table anew some time after its window has another width. Its policy allows
    # no script to be made from text, so that playwright's own waiting for one cannot.
    for _ in range(50):
        if page.locator("#table table").bounding_box()["width"] <= 1040:
            break
        page.wait_for_timeout(100)
    box = page.locator("#table table").bounding_box()
    assert box["x"] + box["width"] <= 1040


@pytest.mark.parametrize(("width", "scheme"), [(1280, "light"), (390, "dark")])
def test_axe_finds_no_serious_fault(page, width, scheme):
    axe = os.environ.get("AXE_CORE")
    if axe is None:
        pytest.skip("AXE_CORE does not name axe.min.js (npm pack axe-core)")
    page.set_viewport_size({"width": width, "height": 850})
    page.emulate_media(color_scheme=scheme)
    page.evaluate(Path(axe).read_text())
    for tab in ("partial", "noise", "pose", "cost"):
        page.evaluate(f"location.hash = '#tab={tab}&row=good'")
        page.locator(f"nav a[href*='tab={tab}'][aria-current]").wait_for()
        found = page.evaluate("axe.run()")["violations"]
        assert [(f["id"], f["nodes"][0]["html"]) for f in found] == []


def test_the_papers_figures_say_that_they_are_on_other_data(page):
    heads = page.locator("#table th .sort")
    assert not [head for head in heads.all_inner_texts() if head.startswith("paper")]
    page.locator(".picker summary").click()
    page.get_by_role("checkbox", name="paper's figure").check()
    heads = heads.all_inner_texts()
    assert "paper, PM40 (reported, other data)" in heads
