"""What the page shows is what its data say, for names and numbers of every kind."""

from __future__ import annotations

import csv
import re

import pytest

from leaderboard.page import html
from leaderboard.tables import latex
from leaderboard.tables.plain import csv_cell
from leaderboard.words import percent

SHOW = "dispatchEvent(new HashChangeEvent('hashchange'))"
LOOKS = """() => [...document.querySelectorAll("main > section figure:has(.key)")].map(figure =>
  [...figure.querySelectorAll(".key li:not(.quiet)")].map(item => {
    const mark = item.querySelector("svg").firstElementChild;
    return [item.textContent, `${mark.getAttribute("class")} ${mark.getAttribute("d") || mark.tagName + mark.getAttribute("r")}`];
  }))"""  # noqa: E501
ABSENT = """() => [...document.querySelectorAll("#table tr.absent")].map(row =>
  [...row.cells].map(cell => [cell.tagName, cell.colSpan, cell.textContent]))"""


def change(page, script):
    """The page's data changed, and the page drawn anew."""
    page.evaluate(f"() => {{ const column = current(); {script}; {SHOW}; }}")


def names(page):
    return page.locator("#table tr.row .name .open").all_inner_texts()


@pytest.mark.parametrize("tab", ["partial", "noise", "pose", "cost"])
def test_a_model_looks_alike_in_every_figure_and_like_no_other(page, tab):
    page.evaluate(f"location.hash = '#tab={tab}'")
    page.locator(f"nav a[href*='tab={tab}'][aria-current]").wait_for()
    # Ten models before the rest, which have neither pose nor curve: the rest is far down.
    change(
        page,
        """
      const first = column.rows[0];
      const more = Array.from({ length: 10 }, (_, i) => (
        { ...structuredClone(first), id: `more${i}`, model: `more${i}`, title: `MORE ${i}` }));
      for (const row of more) {
        Object.assign(row, { main: true, pose: row.id === "more9" && first.pose, accuracy: 1 });
      }
      column.rows.unshift(...more);
      for (const view of column.views) {
        for (const row of more) view.rows[row.id] = Object.values(view.rows)[0];
      }
      const curves = DATA.curves[column.group];
      const points = [[25e3, 0.2, 0.1, 0.3], [50e3, 0.3, 0.2, 0.4], [100e3, 0.4, 0.3, 0.5]];
      for (const id of ["more1", "more9", "good", "even"]) curves[id] = { points, far: null };
    """,
    )
    figures = page.evaluate(LOOKS)
    assert len(figures) > 1
    looks = {}
    for figure in figures:
        assert len(dict(figure)) == len({look for _, look in figure})
        for name, look in figure:
            assert looks.setdefault(name, look) == look
    assert len(set(looks.values())) == len(looks)


def test_an_axis_has_numbers_wherever_its_values_lie(page):
    ticks = page.evaluate("""() => [[7e6, 8e6], [4e6, 4e6], [3.1e6, 4.9e6], [9e5, 1.1e9], [1, 3]]
      .map(([low, high]) => logTicks(low, high).filter(v => v >= low && v <= high))""")
    assert [len(found) for found in ticks] == [3, 1, 3, 10, 2]
    page.evaluate("location.hash = '#tab=cost'")
    page.locator("nav a[href*='tab=cost'][aria-current]").wait_for()
    change(page, "column.rows.forEach((row, i) => { row.multiply_adds = 7e6 + 3e5 * (i % 4); })")
    labels = page.locator("#shows svg.chart").first.locator("text").all_text_contents()
    assert [text for text in labels if text.endswith(" M")]


def test_a_share_is_printed_as_every_other_table_prints_it(page):
    """Ties too: 6.25 is 6.2 in Python and would be 6.3 in the page's language."""
    shares = [k / clouds for clouds in (16, 80, 120, 173, 400, 1975) for k in range(clouds + 1)]
    shares += [-share for share in shares[:400] if share]
    shown = page.evaluate("shares => shares.map(percent)", shares)
    assert shown == [percent(share, None).replace("-", "−") for share in shares]


def test_the_page_prints_what_the_table_in_markdown_prints(page, built):
    sections = built.with_name("leaderboard.md").read_text(encoding="utf-8").split("\n## ")
    columns = page.evaluate("""() => DATA.columns.map(c => [c.name, c.rows.map(row => [row.title,
      percent(row.accuracy) + (row.std === null ? "" : ` ± ${percent(row.std)}`),
      range(row.low, row.high), percent(row.turned), row.milliseconds.toFixed(2)])])""")
    assert len(columns) > 2
    for name, shown in columns:
        (section,) = (each for each in sections if each.startswith(f"{name}\n"))
        head, _, *lines = (
            [cell.strip().replace("\\", "").replace("&lt;", "<") for cell in line.split("|")[1:-1]]
            for line in section.splitlines()
            if line.startswith("|")
        )
        wanted = ["model", "accuracy", "95 % interval", "turned", "ms a cloud"]
        told = [[line[head.index(column)] for column in wanted] for line in lines]
        assert sorted(told) == sorted(shown)


def test_marks_stand_where_the_values_are(page):
    """Of one figure, with both its axes: by the places of two ticks of each."""
    found = page.evaluate("""() => {
      const points = [[100, 10, 5, 15], [1000, 40, 30, 45], [10000, 90, 90, 95]];
      const figure = lineChart({ caption: "", width: 600, series: [{ name: "a", points }],
        x: { log: true, label: "x", text: String }, y: { label: "y", least: 0, most: 100 } });
      const number = (node, name) => +node.getAttribute(name), of = (what, ...names) =>
        [...figure.querySelectorAll(`svg.chart ${what}`)].map(node => names.map(n => n === "text" ? node.textContent : number(node, n)));
      return { marks: of("circle", "cx", "cy"), words: of("g > text", "text", "x", "y"), bounds: [...figure.querySelectorAll(".bound")].map(n => n.getAttribute("d")) };
    }""")  # noqa: E501
    words = {text: (x, y) for text, x, y in found["words"]}
    assert [cx for cx, _ in found["marks"]] == pytest.approx(
        [words[text][0] for text in ("100", "1000", "10000")]
    )
    # A label's foot is 4 below its line.
    levels = {float(t): y - 4 for t, (_, y) in words.items() if float(t) in (20, 40, 60, 80)}
    slope = (levels[80] - levels[20]) / 60
    place = [levels[20] + slope * (value - 20) for value in (10, 40, 90)]
    assert [cy for _, cy in found["marks"]] == pytest.approx(place)
    for path, (low, high) in zip(found["bounds"], [(5, 15), (30, 45), (90, 95)], strict=True):
        ends = [float(v) for v in re.fullmatch(r"M[\d.]+,([\d.]+)V([\d.]+)", path).groups()]
        assert ends == pytest.approx([levels[20] + slope * (v - 20) for v in (low, high)])


def test_a_log_is_drawn_over_what_was_seen_when_it_was_written(page):
    places = page.evaluate("""() => {
      const lines = [[100, 3], [800, 2], [1000, 1]];
      const [figure] = trainingLog({ log: { "training loss": lines }, training: { clouds: 1000 } }, 500);
      return [...figure.querySelectorAll("svg.chart circle")].map(it => +it.getAttribute("cx"));
    }""")  # noqa: E501
    first, second, last = places
    assert (second - first) / (last - second) == pytest.approx(700 / 200)


def test_the_names_of_axes_are_within_the_picture_on_a_phone(page):
    page.set_viewport_size({"width": 360, "height": 740})
    page.evaluate("location.hash = '#tab=partial&row=good'")
    page.locator("tr.detail svg.chart").first.wait_for()
    outside = page.evaluate("""() => [...document.querySelectorAll("svg.chart text")].filter(text => {
      const a = text.getBoundingClientRect(), b = text.closest("svg").getBoundingClientRect();
      return a.top < b.top - 1 || a.bottom > b.bottom + 1 || a.left < b.left - 1;
    }).map(text => text.textContent)""")  # noqa: E501
    assert outside == []


def test_groups_sort_by_number(page):
    change(
        page, "column.rows.forEach((row, i) => { row.groups = ['10', '2', '9 10', '1'][i % 4]; })"
    )
    page.evaluate("location.hash = '#cols=model+groups&sort=groups&variants=good'")
    page.locator("#table th[aria-sort]", has_text="group").wait_for()
    shown = [
        t.split()[0]
        for t in page.locator("#table tr.row:not(.variant) td:last-child").all_inner_texts()
    ]
    assert shown == sorted(shown, key=int)
    assert len(set(shown)) > 2


def test_the_filter_finds_a_variant_that_is_folded(page):
    page.fill("#filter", "k=5")
    assert names(page) == ["GOOD", "GOOD [k=5]"]
    assert page.locator("#said").text_content() == "2 rows"
    page.fill("#filter", "good")
    assert names(page) == ["GOOD"]
    page.fill("#filter", "nobody")
    assert "No name of a row has “nobody” in it." in page.locator("#table").inner_text()


def test_a_variant_that_alone_has_a_pose_is_on_the_tab_of_poses(page):
    page.evaluate("location.hash = '#tab=pose'")
    page.locator("nav a[href*='tab=pose'][aria-current]").wait_for()
    change(
        page,
        """const of = name => column.rows.find(row => row.title === name);
      of("GOOD [k=5]").pose = of("GOOD").pose; of("GOOD").pose = null""",
    )
    assert names(page) == ["GOOD [k=5]"]


def test_what_is_not_there_stands_below_the_models_whatever_the_columns(page):
    absent = """column.absent = ["A", "B", "C", "D", "E", "F"].map(title => (
      { id: title, title, state: title < "F" ? "failed: the loss became nan" : "not yet" }))"""
    change(page, absent)
    *shown, button = page.evaluate(ABSENT)
    assert [(row[1][2], row[2][2]) for row in shown] == [
        (name, "failed: the loss became nan asked for after 100k clouds") for name in "ABCD"
    ]
    assert [button[1][2], button[2][2]] == ["2 more", "failed: the loss became nan: E. not yet: F"]
    for columns, width in (("model+accuracy", 2), ("model", 1), ("rank+model", 2)):
        page.evaluate(f"location.hash = '#cols={columns}'")
        page.wait_for_timeout(100)
        for cells in page.evaluate(ABSENT):
            assert sum(span for _, span, _ in cells) == width
            name = cells[columns.split("+").index("model")]
            assert name[0] == "TH"
            assert name[2][:1] in "ABCD2"


def test_a_row_without_an_interval_says_so_and_shows_no_empty_brackets(page):
    change(page, "for (const row of column.rows) { row.low = row.high = null; }")
    ranges = page.locator("#table svg.range").all()
    assert {it.get_attribute("aria-label") for it in ranges} == {"no interval: one test object"}
    assert set(page.locator("#table .printed").all_text_contents()) == {""}


def test_an_address_of_what_is_not_here_says_so(page):
    assert page.locator("#lost").count() == 0
    page.evaluate("location.hash = '#data=elsewhere&clouds=800k'")
    told = page.locator("#lost")
    told.wait_for()
    assert "asks for elsewhere, 800k clouds, which this board has not" in told.inner_text()
    page.evaluate("location.hash = '#clouds=800k'")
    page.locator("#lost", has_text="asks for 800k clouds").wait_for()
    page.evaluate("location.hash = '#row=nobody'")
    page.locator("#lost", has_text="Here is no row nobody.").wait_for()
    page.get_by_role("link", name="Cost", exact=True).click()
    assert page.locator("#lost").count() == 0


NAMES = ["=1+1", "-x", "@a", "[3pt] or *", "* star", 'a "b", c', "é ² δ × − < > | \\ {}", "猫 😀"]


def test_a_file_of_the_table_is_of_the_tab_and_its_names_are_text(page):
    change(
        page, f"const names = {NAMES}; column.rows.forEach((row, i) => {{ row.title = names[i]; }})"
    )
    page.evaluate("location.hash = '#cols=model+behind+accuracy'")
    page.locator("#table th").nth(2).wait_for()
    rows = page.evaluate("current().rows.map(row => [row.title, row.behind && row.behind[0]])")
    assert len(rows) >= 4
    for start in range(0, len(NAMES), len(rows)):
        change(
            page,
            f"const names = {NAMES[start:]}; "
            "column.rows.forEach((row, i) => { row.title = names[i % names.length]; })",
        )
        titles = page.evaluate("current().rows.map(row => row.title)")
        text = page.evaluate("FILES.CSV(current())")
        told = list(csv.DictReader(text.splitlines()))
        assert sorted(line["model"] for line in told) == sorted(map(csv_cell, titles))
        assert {line["behind"] for line in told} >= {str(behind) for _, behind in rows if behind}
        lines = [line for line in page.evaluate("FILES.LaTeX(current())").splitlines()
                 if line.endswith(r"\\")][1:]  # fmt: skip
        assert sorted(line.split(" & ")[0] for line in lines) == sorted(
            "{}" + text if text[0] in "[*" else text for text in map(latex.escape, titles)
        )
    page.evaluate("location.hash = '#tab=pose'")
    page.locator("nav a[href*='tab=pose'][aria-current]").wait_for()
    posed = page.evaluate("current().rows.filter(row => row.pose).length")
    assert len(page.evaluate("FILES.CSV(current())").splitlines()) == 1 + posed
    assert page.evaluate("JSON.parse(FILES.JSON(current())).rows.length") == posed
    assert posed < len(rows)


def test_a_long_name_stays_in_its_place(page):
    change(page, "column.rows[0].title = 'x'.repeat(150)")
    cell = page.locator("#table tr.row .name").first.bounding_box()
    button = page.locator("#table tr.row .open").first.bounding_box()
    assert button["x"] + button["width"] <= cell["x"] + cell["width"]
    assert page.evaluate("document.documentElement.scrollWidth <= innerWidth")


def test_a_table_of_a_transfer_is_not_among_those_of_its_test_data(page):
    named = page.evaluate("""() => {
      const name = DATA.columns[0].name;
      DATA.columns.push({ ...DATA.columns[0], name: `rooms → ${name}` });
      return [`Transfer: rooms → ${name}`, `Pose: ${name}`, "All of them"].map(columnNamed)
        .map(found => found && found.replace(name, "HERE"));
    }""")
    assert named == ["rooms → HERE", "HERE", None]


def test_help_is_read_out_and_every_row_has_a_heading(page):
    button = page.get_by_role("button", name="what calibration error means")
    page.locator(".picker summary").click()
    page.get_by_role("checkbox", name="calibration error").check()
    button.focus()
    assert button.get_attribute("aria-describedby") == "tip"
    assert page.locator("#tip[role=tooltip]").is_visible()
    for tab in ("partial", "noise", "pose"):
        page.evaluate(f"location.hash = '#tab={tab}'")
        page.locator(f"nav a[href*='tab={tab}'][aria-current]").wait_for()
        for row in page.locator("tbody tr:not(.detail)").all():
            assert row.locator("th[scope=row]").count() == 1


def test_paper_is_white_whatever_the_screen(page):
    page.emulate_media(media="print", color_scheme="dark")
    of = "names => names.map(n => getComputedStyle(document.documentElement).getPropertyValue(n))"
    wanted = ["--back", "--text", "--s0", "--s4", "--bad", "--y"]
    dark = page.evaluate(of, wanted)
    page.emulate_media(media="print", color_scheme="light")
    assert dark == page.evaluate(of, wanted)
    page.emulate_media(media="screen", color_scheme="dark")
    assert dark != page.evaluate(of, wanted)


def _light(colour):
    channels = [int(colour[i : i + 2], 16) / 255 for i in (1, 3, 5)]
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in channels]
    return sum(w * c for w, c in zip((0.2126, 0.7152, 0.0722), linear, strict=True))


def _contrast(one, other):
    high, low = sorted((_light(one), _light(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def _mixed(front, back, opacity):
    pairs = [(int(front[i : i + 2], 16), int(back[i : i + 2], 16)) for i in (1, 3, 5)]
    return "#" + "".join(f"{round(opacity * f + (1 - opacity) * b):02x}" for f, b in pairs)


@pytest.mark.parametrize("scheme", ["light", "dark"])
def test_colours_can_be_told_from_what_is_behind_them(scheme):
    """WCAG 2.2: text 4.5 to 1, what a figure is read by 3 to 1."""
    style = (html.FOLDER / "style.css").read_text(encoding="utf-8")
    light, _, rest = style.partition("@media screen and (prefers-color-scheme: dark)")
    colours = dict(re.findall(r"--(\w+): (#[0-9a-f]+)", light))
    if scheme == "dark":
        colours |= dict(re.findall(r"--(\w+): (#[0-9a-f]+)", rest.partition("\n} }")[0]))
    colours = {
        name: value if len(value) == 7 else "#" + "".join(2 * c for c in value[1:])
        for name, value in colours.items()
    }
    bounds = float(re.search(r"\.chart \.bound \{ stroke-opacity: ([\d.]+)", style)[1])
    bar = float(re.search(r"\.range rect \{ fill: var\(--accent\); opacity: ([\d.]+)", style)[1])
    for behind in (colours["back"], colours["panel"]):
        for name in ("text", "soft", "accent", "good", "bad"):
            assert _contrast(colours[name], behind) >= 4.5, name
        for name in (f"s{i}" for i in range(8)):
            assert _contrast(_mixed(colours[name], behind, bounds), behind) >= 3, name
        assert _contrast(_mixed(colours["accent"], behind, bar), behind) >= 3
