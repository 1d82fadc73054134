// The page for the state in the address.
const main = document.getElementById("main");
const EMPTY = {
  partial: "No model was tested on partial views yet: partialbench eval --model pointnet --data FOLDER --results results, and make the board again.",
  complete: "No model was tested on complete clouds yet. Render a data set with --setting aligned or rotated, and run eval on it.",
  transfer: "No model was tested on another data set than its own yet: partialbench eval … --test-data FOLDER.",
  noise: "No model was tested on other clouds than it was trained for yet: partialbench eval … --checkpoint FILE --test-points 64, or --test-data with a folder rendered with --sensor.",
  pose: "No model that finds poses was tested yet; papnet and papnet-steered do.",
  cost: "No model was tested yet.",
};

function choices(id, label, options, value, change) {
  if (options.length < 2) return h("span", {}, `${label} `, h("strong", {}, options[0]?.[1] || dash));
  return h("label", {}, `${label} `, h("select", { id, "data-key": id, onchange: event => change(event.target.value) },
    options.map(([key, title]) => h("option", { value: key, selected: key === value }, title))));
}

function controls(column) {
  const here = columnsOf(state.tab), groups = new Map(here.map(c => [c.group, c.title]));
  const milestones = here.filter(c => c.group === state.data).sort((a, b) => a.clouds - b.clouds);
  return h("div", { class: "controls" },
    choices("data-set", "Data", [...groups], state.data, group => go({ data: group, clouds: "", row: "" })),
    choices("milestone", "Training clouds seen", milestones.map(c => [c.milestone, `${c.milestone} (${models(c)} model${models(c) === 1 ? "" : "s"})`]), state.clouds, clouds => go({ clouds })),
    h("label", {}, "Model ", h("input", { type: "search", id: "filter", "data-key": "filter", value: state.q, placeholder: "part of a name", oninput: event => {
      history.replaceState(null, "", address({ q: event.target.value })); state.q = event.target.value;
      document.getElementById("table").replaceChildren(table(column));
      say(`${document.querySelectorAll("#table tr.row").length} rows`);
    } })),
    picker(column));
}

function conditions(column, width) {
  return column.conditions.map(family => h("section", {}, h("h2", {}, `Against the ${family.axis}`),
    h("p", { class: "about" }, "The same weights throughout, tested on other clouds than they were trained for. In brackets the 95 % interval over test objects."),
    lineChart({
      caption: `Accuracy against the ${family.axis}.`, width,
      series: family.rows.map(row => ({ name: row.title, key: looks(column).get(row.id), points: row.points.map(p => [p[0], 100 * p[1], p[2] === null ? null : 100 * p[2], p[3] === null ? null : 100 * p[3]]) })),
      x: { log: family.condition === "points", label: family.axis, text: String, places: [...new Set(family.rows.flatMap(row => row.points.map(p => p[0])))].sort((a, b) => a - b) },
      y: { label: "accuracy (%)", least: 0, most: 100 },
    }),
    grid([`model`, ...[...new Set(family.rows.flatMap(row => row.points.map(p => p[0])))].sort((a, b) => a - b)],
      family.rows, (row, x) => { const p = row.points.find(point => point[0] === x); return p && [p[1], p[2], p[3]]; })));
}

function given(column) {
  if (!column.given) return null;
  const titles = new Map(column.given.poses);
  return h("section", {}, h("h2", {}, "What the pose is worth"),
    h("p", { class: "about" }, "Accuracy (%) of the same weights with the pose they find themselves, and told the labelled one, that with noise on every Euler angle, or one at random. Gain: of the true pose over its own, paired."),
    grid(["model", ...titles.keys(), "gain"], column.given.rows, (row, pose) => (pose === "gain" ? row.gain : row.accuracy[pose]), pose => titles.get(pose) || pose));
}

// A table of means with their intervals.
function grid([first, ...places], rows, value, heading = String) {
  return h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": "table" }, h("table", {},
    h("thead", {}, h("tr", {}, h("th", { class: "name text", scope: "col" }, first), places.map(place => h("th", { scope: "col" }, heading(place))))),
    h("tbody", {}, rows.map(row => h("tr", {}, h("th", { class: "name text", scope: "row" }, row.title), places.map(place => {
      const found = value(row, place);
      return h("td", {}, found ? [percent(found[0]), h("span", { class: "quiet" }, bracketed(found[1], found[2]))] : dash);
    }))))));
}

function whatItShows(column, width) {
  const main = column.rows.filter(row => row.main), steps = column.settings, keys = looks(column);
  // Rows of another table, in this one's order.
  const keyed = rows => rows.map(row => ({ ...row, key: main.findIndex(each => each.id === row.id) }))
    .filter(row => row.key >= 0).sort((a, b) => a.key - b.key);
  const settings = steps && lineChart({
    caption: `From complete clouds in a known pose to what one side shows: accuracy of the same models after ${steps.milestone} clouds.`, width,
    series: keyed(steps.rows).map(row => ({ name: row.title, key: row.key, points: row.shares.flatMap((share, i) => (share === null ? [] : [[i, 100 * share]])) })),
    x: { label: "what is tested", places: steps.settings.map((_, i) => i), text: i => steps.settings[i] }, y: { label: "accuracy (%)", least: 0, most: 100 },
  });
  const cost = state.tab === "cost" && lineChart({
    caption: "Accuracy against the multiply-adds of one cloud.", width, lines: false,
    series: main.map(row => ({ name: row.title, key: keys.get(row.id), points: [[Math.max(row.multiply_adds, 1), 100 * row.accuracy, row.low && 100 * row.low, row.high && 100 * row.high]] })),
    x: { log: true, label: "multiply-adds of one cloud", places: logTicks(...[Math.min, Math.max].map(of => of(...main.map(row => Math.max(row.multiply_adds, 1))))) },
    y: { label: "accuracy (%)", most: 100, least: 0 },
  });
  const topK = state.tab === "pose" && lineChart({
    caption: "Share of clouds whose true pose bin is among the k most probable of the 60.", width,
    series: main.filter(row => row.more.top_k.length).map(row => ({ name: row.title, key: keys.get(row.id), points: row.more.top_k.map((v, i) => [i + 1, 100 * v]) })),
    x: { label: "k", text: String }, y: { label: "share of clouds (%)", least: 0, most: 100 },
  });
  return h("section", { id: "shows" }, h("h2", {}, "What this shows"),
    h("ul", { class: "facts" }, (state.tab === "cost" ? column.cost : column.facts).map(text => h("li", {}, text))),
    h("div", { class: "figures" }, cost, topK, learning(column, main, width), settings));
}

function behindAClick(column) {
  // Made when it is opened: most never are.
  const section = (title, make) => h("details", {
    class: "section", "data-open": title, ontoggle: event => { if (event.target.open && event.target.childElementCount === 1) event.target.append(make()); },
  }, h("summary", { "data-key": `open-${title}` }, title));
  const others = DATA.layouts.filter(layout => [undefined, column.name].includes(columnNamed(layout.title)));
  return h("section", { id: "more" }, h("h2", {}, "More"),
    section("Downloads", () => downloads(column)),
    section("Data, protocol and digests", () => h("div", {}, h("p", {}, column.about), h("p", { class: "about" }, "What a record does not share with these, by digest, stands in another table. The digest of every row's weights is in its card."))),
    others.map(layout => section(layout.title, () => textTable(layout))));
}

// The name of the column that a table is of, at the end of its title; of a transfer's the whole one.
const columnNamed = title => DATA.columns.map(c => c.name).filter(name => title.endsWith(name)).sort((a, b) => b.length - a.length)[0];

const textTable = layout => h("div", {}, h("p", { class: "about" }, layout.about), h("div", { class: "scroll", tabindex: "0", role: "region", "aria-label": layout.title }, h("table", {},
  h("thead", {}, h("tr", {}, layout.head.map((text, i) => h("th", { scope: "col", class: i ? null : "name text" }, text)))),
  h("tbody", {}, layout.rows.map(row => h("tr", {}, row.map((text, i) => (i ? h("td", {}, text) : h("th", { class: "name text", scope: "row" }, text)))))))));
const progress = () => DATA.layouts.find(layout => layout.title.startsWith("Asked for"));

// What follows the table, in its order; the table is there before it.
const below = (column, width) => [
  state.tab === "pose" && given(column), whatItShows(column, width), byView(column, width), gallery(column), behindAClick(column),
].filter(Boolean);

function show(firstTime) {
  readAddress();
  const focus = document.activeElement?.dataset?.key, opened = [...main.querySelectorAll("details[data-open][open]")].map(d => d.dataset.open);
  const scroll = [scrollX, scrollY], across = main.querySelector("#table .scroll")?.scrollLeft || 0;
  const column = current(), width = Math.min(columnWidth(main.clientWidth, 432), 620);
  const tabs = h("nav", { "aria-label": "what is tested" }, TABS.map(([tab, title]) => h("a", {
    href: address({ tab, data: "", clouds: "", sort: "", dir: "", cols: "", row: "" }), "aria-current": tab === state.tab ? "page" : null, "data-key": `tab-${tab}`,
  }, title)));
  hideTip();
  const asked = progress();
  main.replaceChildren(tabs, ...(column ? [
    state.lost && h("p", { class: "note", id: "lost" }, state.lost), controls(column), state.tab === "noise" && h("div", {}, conditions(column, width)),
    h("h2", { class: state.tab === "noise" ? null : "unseen" }, state.tab === "noise" ? "On clouds as they were trained for" : "Results"),
    h("div", { id: "table" }, table(column)), h("p", { class: "about" }, "A line opens to the command that runs it again, its card, its curves and its classes."), h("p", { class: "about" }, column.what && `${column.what} `, column.about),
    ...(firstTime === true ? [] : below(column, width)),
  ].filter(Boolean) : [h("p", { class: "note", id: "empty" }, EMPTY[state.tab]), asked && h("section", {}, h("h2", {}, asked.title), textTable(asked))].filter(Boolean)));
  if (firstTime === true && column) {
    // The table is painted, and answers, before the rest is drawn.
    requestAnimationFrame(() => setTimeout(() => { if (column === current()) main.append(...below(column, width)); document.body.dataset.whole = "yes"; }));
  } else {
    document.body.dataset.whole = "yes";
  }
  for (const each of main.querySelectorAll("details[data-open]")) each.open = opened.includes(each.dataset.open);
  main.querySelector("#table .scroll")?.scrollTo(across, 0);
  if (focus) main.querySelector(`[data-key="${CSS.escape(focus)}"]`)?.focus({ preventScroll: true });
  scrollTo(...scroll);
}

addEventListener("popstate", show);
addEventListener("hashchange", show);
// Charts are drawn to the width there is; a phone's address bar changes the height alone.
let drawnAt = innerWidth;
addEventListener("resize", () => { if (innerWidth !== drawnAt) { drawnAt = innerWidth; show(); } });
for (const link of document.querySelectorAll("a[data-jump]")) {
  link.addEventListener("click", event => {
    event.preventDefault();  // the address is the table's
    const place = document.getElementById(link.dataset.jump);
    place.scrollIntoView(); place.querySelector("h2").focus({ preventScroll: true });
  });
}
show(true);
if (state.row) main.querySelector("tr.detail")?.previousElementSibling.scrollIntoView();
