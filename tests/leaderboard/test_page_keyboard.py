"""The page by keyboard alone: every control is reached, is seen to be, and does what it does."""

from __future__ import annotations

import pytest

FOCUS = """() => {
  const it = document.activeElement, style = getComputedStyle(it), box = it.getBoundingClientRect();
  return it === document.body ? null : {
    order: [...document.querySelectorAll("*")].indexOf(it),
    name: (it.getAttribute("aria-label") || it.textContent || it.id).trim().slice(0, 60),
    outlined: style.outlineStyle !== "none" && parseFloat(style.outlineWidth) >= 1.5,
    seen: box.bottom > 0 && box.top < innerHeight && box.width > 0,
  };
}"""
CONTROLS = """() => {
  const all = [...document.querySelectorAll("*")];
  return [...document.querySelectorAll("a[href], button, input, select, summary, [tabindex]")]
    .filter(it => it.tabIndex >= 0 && it.checkVisibility()).map(it => all.indexOf(it));
}"""


def walk(page, limit=250):
    """What Tab comes to, from the page's beginning, in its order."""
    page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    found = []
    for _ in range(limit):
        page.keyboard.press("Tab")
        focus = page.evaluate(FOCUS)
        if focus is None or (found and focus["order"] == found[0]["order"]):
            return found
        found.append(focus)
    raise AssertionError("Tab never comes to the end of the page")


def to(page, selector):
    """Tab from the beginning to the first control that fits, as a person would."""
    page.evaluate("document.activeElement.blur(); scrollTo(0, 0)")
    for _ in range(250):
        page.keyboard.press("Tab")
        if page.evaluate("selector => document.activeElement.matches(selector)", selector):
            return
    raise AssertionError(f"Tab never comes to {selector}")


@pytest.mark.parametrize("address", ["#tab=partial&row=good", "#tab=noise", "#tab=pose&row=good"])
def test_tab_comes_to_every_control_and_shows_where_it_is(page, address):
    page.evaluate(f"location.hash = '{address}'")
    page.locator(f"nav a[href*='{address[1:].split('&')[0]}'][aria-current]").wait_for()
    found = walk(page)
    assert {each["order"] for each in found} == set(page.evaluate(CONTROLS))
    assert [each["order"] for each in found] == sorted(each["order"] for each in found)
    assert [each["name"] for each in found if not each["outlined"]] == []
    assert [each["name"] for each in found if not each["seen"]] == []


def test_tabs_headings_filter_and_rows_answer_to_keys(page):
    to(page, "nav a[data-key=tab-cost]")
    page.keyboard.press("Enter")
    assert page.locator("nav a[aria-current=page]").inner_text() == "Cost"
    page.go_back()
    to(page, "[data-key=sort-parameters]")
    page.keyboard.press("Enter")
    assert page.locator("#table th[aria-sort=ascending]").inner_text().startswith("parameters")
    page.keyboard.press("Space")  # it still has the focus
    assert page.locator("#table th[aria-sort=descending]").inner_text().startswith("parameters")
    to(page, "[data-key=filter]")
    page.keyboard.type("goo")
    assert page.locator("#table tr.row").count() == 1
    to(page, "button.open")
    page.keyboard.press("Enter")
    assert "Run it" in page.locator("tr.detail").inner_text()
    page.keyboard.press("Enter")
    assert page.locator("tr.detail").count() == 0
    to(page, "[data-key=variants-good]")
    page.keyboard.press("Enter")
    assert page.locator("#table tr.variant").count() == 1


def test_columns_are_chosen_by_keys_and_escape_leaves_them(page):
    to(page, ".picker summary")
    page.keyboard.press("Enter")
    to(page, "[data-key=col-calibration]")
    page.keyboard.press("Space")
    assert page.locator("[data-key=sort-calibration]").count() == 1
    assert page.evaluate("document.activeElement.dataset.key") == "col-calibration"
    page.keyboard.press("Escape")
    assert not page.locator(".picker").evaluate("box => box.open")
    assert page.evaluate("document.activeElement.dataset.key") == "picker"
    page.keyboard.press("Enter")
    page.keyboard.press("Shift+Tab")  # left, it does not stay in the way
    assert not page.locator(".picker").evaluate("box => box.open")


def test_help_clouds_files_and_what_is_folded_answer_to_keys(page):
    page.select_option("#data-set", label="solids, partial, board")
    to(page, "canvas")
    yaw = page.evaluate("document.activeElement.dataset.yaw")
    page.keyboard.press("ArrowLeft")
    page.keyboard.press("ArrowUp")
    assert page.evaluate("document.activeElement.dataset.yaw") != yaw
    to(page, "figure select")
    page.keyboard.press("ArrowDown")
    assert page.evaluate("document.activeElement.value") != ""
    to(page, "[data-key=open-Downloads]")
    page.keyboard.press("Enter")
    to(page, "[data-key=download-CSV]")
    with page.expect_download() as started:
        page.keyboard.press("Enter")
    assert started.value.suggested_filename.endswith(".csv")
    to(page, "th .help")
    assert page.locator("#tip").is_visible()
    page.keyboard.press("Escape")
    assert not page.locator("#tip").is_visible()
    to(page, "a[data-jump=add]")
    page.keyboard.press("Enter")
    assert page.evaluate("document.activeElement.textContent") == "Add a row"


def test_rows_that_are_not_there_are_told_and_unfold(page):
    absent = page.locator("#table tr.absent")
    assert absent.first.inner_text().split() == [
        "WILD", "failed:", "the", "loss", "became", "nan", "asked", "for", "after", "100k", "clouds"
    ]  # fmt: skip
    assert absent.count() == 2
    seeds = page.locator("#table tr[data-row=good] td").last
    assert seeds.inner_text() == "2 of 3"
    assert "LATE0; LATE1" in absent.last.inner_text()
    to(page, "[data-key=absent]")
    page.keyboard.press("Enter")
    assert absent.count() == 7
    assert "not yet" in absent.nth(1).inner_text()
    assert page.evaluate("document.activeElement.dataset.key") == "absent"
    page.fill("#filter", "late3")
    assert absent.count() == 1


def test_going_back_no_row_has_the_focus_beneath_the_head_of_the_table(page):
    page.evaluate(
        """() => {
          const column = current(), first = column.rows[0];
          column.rows.push(...Array.from({ length: 60 }, (_, i) => (
            { ...first, id: `more${i}`, model: `more${i}`, title: `MORE ${i}`, accuracy: 0 })));
          dispatchEvent(new HashChangeEvent("hashchange"));
        }"""
    )
    page.locator("#table button.open").last.focus()
    for _ in range(55):
        page.keyboard.press("Shift+Tab")
        assert page.evaluate(
            """() => {
              const it = document.activeElement, box = it.getBoundingClientRect();
              const on = document.elementFromPoint(box.left + 3, box.top + box.height / 2);
              return it === on || it.contains(on);
            }"""
        ), page.evaluate("document.activeElement.textContent")
