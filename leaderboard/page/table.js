// The table of one column of results.
function sorting(columns) {
  const by = columns.find(c => c.id === state.sort) || columns.find(c => c.id === (state.tab === "pose" ? "pose" : "accuracy")) || columns[0];
  const best = by.best === "high" ? "descending" : "ascending";
  return { by, direction: by.id === state.sort && state.dir === "worst" ? (best === "ascending" ? "descending" : "ascending") : best };
}

// Missing values come last either way; equals keep the order of accuracy.
function sorted(rows, { by, direction }) {
  const sign = direction === "ascending" ? 1 : -1;
  return rows.map((row, i) => [by.value(row), i, row]).sort(([a, i], [b, j]) => {
    const missing = v => v === null || v === undefined || v === "";
    if (missing(a) || missing(b)) return missing(a) - missing(b) || i - j;
    return sign * (typeof a === "string" ? a.localeCompare(b, "en", { numeric: true }) : a - b) || i - j;
  }).map(([, , row]) => row);
}

// The rows that a tab is about.
const rowsOn = column => (state.tab === "pose" ? column.rows.filter(row => row.pose) : column.rows);

function table(column) {
  const columns = shownColumns(column), order = sorting(columns);
  const asked = state.q.trim().toLowerCase(), unfolded = state.variants ? state.variants.split("|") : [];
  const fits = row => row.title.toLowerCase().includes(asked) || row.model.toLowerCase().includes(asked);
  const seen = rowsOn(column);
  const bounds = seen.flatMap(row => [row.accuracy, row.low, row.high]).filter(v => v !== null);
  const [low, high] = [Math.min(...bounds), Math.max(...bounds)];
  const variants = row => seen.filter(other => other.model === row.model && !other.main);
  // Variants stand below their model; alone where it is not on this tab.
  const heads = seen.filter(row => row.main || !seen.some(other => other.main && other.model === row.model));
  // What is looked for may be in the name of a variant alone: that one is shown then, folded or not.
  const below = row => (!row.main ? [] : unfolded.includes(row.model) ? variants(row) : fits(row) ? [] : variants(row).filter(fits));
  const lines = sorted(heads.filter(row => fits(row) || below(row).some(fits)), order).flatMap(row => [row, ...sorted(below(row), order)]);
  // A link to a variant's row shows that row.
  const linked = seen.find(row => row.id === state.row);
  if (linked && fits(linked) && !lines.includes(linked)) lines.push(linked);

  // The paper's figures say whether they are on other data than the rows beside them.
  const title = c => (c.id === "paper" ? column.reported || c.title : c.title);
  const head = h("tr", {}, columns.map(c => h("th", {
    scope: "col", class: [c.id === "model" && "name", c.text && "text"].filter(Boolean).join(" ") || null,
    "aria-sort": c === order.by ? order.direction : null,
    onmouseenter: event => showTip(event.currentTarget, c.help), onmouseleave: hideTip,
  }, h("span", { class: "head" }, h("button", {
    type: "button", class: "sort", "data-key": `sort-${c.id}`,
    onclick: () => go({ sort: c.id, dir: c === order.by && state.dir !== "worst" ? "worst" : "" }),
  }, title(c)), explained(c.help, title(c))))));

  const body = lines.flatMap(row => {
    const open = state.row === row.id;
    const others = row.main ? variants(row) : [];
    const folded = !unfolded.includes(row.model);
    const name = [
      h("button", { type: "button", class: "open", "aria-expanded": String(open), "data-key": `row-${row.id}`, onclick: () => go({ row: open ? "" : row.id }) }, row.title),
      others.length > 0 && h("button", {
        type: "button", class: "more plain", "aria-expanded": String(!folded), "data-key": `variants-${row.model}`,
        onclick: () => go({ variants: (folded ? [...unfolded, row.model] : unfolded.filter(m => m !== row.model)).join("|") }),
      }, `${others.length} variant${others.length > 1 ? "s" : ""}`),
    ];
    const cells = columns.map(c => (c.id === "model" ? h("th", { class: "name text", scope: "row" }, name) : h("td", { class: c.text ? "text" : null }, c.show(row, low, high, column))));
    const line = h("tr", {
      class: row.main ? "row" : "row variant", "data-row": row.id,
      // The whole line opens; its button is what keyboards and screen readers have.
      onclick: event => { if (!event.target.closest("button, a") && getSelection().isCollapsed) go({ row: open ? "" : row.id }); },
    }, cells);
    return open ? [line, h("tr", { class: "detail" }, h("td", { colspan: columns.length }, details(column, row)))] : [line];
  });
  const absent = absentRows(column, columns, asked);
  body.push(...absent);
  return h("div", { class: linked ? "scroll open" : "scroll", tabindex: "0", role: "region", "aria-label": "table of models" },
    h("table", { class: "board", "aria-label": column.name }, h("thead", {}, head), h("tbody", {}, body)),
    !lines.length && !absent.length && h("p", { class: "note" }, asked ? `No name of a row has “${state.q}” in it.` : "No rows."));
}

const MOST_ABSENT = 4;  // more are behind a button

// What campaigns ask for here and no record answers yet.
function absentRows(column, columns, asked) {
  const fits = column.absent.filter(each => each.title.toLowerCase().includes(asked) || each.id.toLowerCase().includes(asked));
  if (state.tab === "pose" || !fits.length) return [];
  const shown = state.absent ? fits : fits.length > MOST_ABSENT ? fits.filter(each => each.state !== "not yet").slice(0, MOST_ABSENT) : fits;
  const hidden = fits.filter(each => !shown.includes(each)), states = [...new Set(hidden.map(each => each.state))];
  // Below the model's name, wherever that stands, and across the columns after it.
  const before = columns.findIndex(c => c.id === "model"), after = columns.length - before - 1;
  const line = (name, ...said) => h("tr", { class: "absent" }, columns.slice(0, before).map(() => h("td", {})),
    h("th", { class: "name text", scope: "row" }, name, after ? null : [" ", said]), after > 0 && h("td", { class: "text", colspan: after }, said));
  const lines = shown.map(each => line(each.title, each.state, h("span", { class: "quiet" }, ` asked for after ${column.milestone} clouds`)));
  if (fits.length > MOST_ABSENT) {
    const button = h("button", {
      type: "button", class: "plain", "data-key": "absent", "aria-expanded": String(Boolean(state.absent)), onclick: () => go({ absent: state.absent ? "" : "all" }, true),
    }, state.absent ? "show fewer" : `${hidden.length} ${states.some(told => told !== "not yet") ? "more" : "not yet"}`);
    lines.push(line(button, states.map(told => `${told}: ${hidden.filter(each => each.state === told).map(each => each.title).join("; ")}`).join(". ")));
  }
  return lines;
}

function picker(column) {
  const now = shownColumns(column).map(c => c.id);
  const close = (box, focus) => { box.open = false; if (focus) box.querySelector("summary").focus(); };
  return h("details", {
    class: "picker", "data-open": "picker",
    onkeydown: event => { if (event.key === "Escape") close(event.currentTarget, true); },
    onfocusout: event => { if (event.relatedTarget && !event.currentTarget.contains(event.relatedTarget)) close(event.currentTarget); },
  }, h("summary", { "data-key": "picker" }, "Columns"), h("div", {},
    COLUMNS.filter(c => c.id !== "model").map(c => h("label", {}, h("input", {
      type: "checkbox", checked: now.includes(c.id), "data-key": `col-${c.id}`,
      onchange: event => go({ cols: event.target.checked ? [...now, c.id].join(" ") : now.filter(id => id !== c.id).join(" ") }, true),
    }), ` ${c.title}`)),
    h("button", { type: "button", class: "plain", "data-key": "cols-reset", onclick: () => go({ cols: "" }) }, "as it was")));
}

// The table that is shown, unfolded and unfiltered, as a file. Numbers are as the records have them, shares in [0, 1].
const FILES = {
  CSV: column => text(column, rows => rows.map(row => row.map(csv).join(",")).join("\n")),
  JSON: column => JSON.stringify({ column: column.name, about: column.about, rows: rowsOn(column).map(({ more, ...row }) => row) }, null, 1),
  LaTeX: column => text(column, ([head, ...rows]) => [
    `% ${column.name}. ${column.about}`.replace(/\s+/g, " "), `\\begin{tabular}{l${"r".repeat(head.length - 1)}}`, "\\hline",
    ...[head, ...rows].map(row => `${row.map(latex).join(" & ").replace(/^[[*]/, "{}$&")} \\\\`), "\\hline", "\\end{tabular}"].join("\n")),
};
// A spreadsheet would run a text that begins as a formula does (as in tables/plain.py).
const csv = cell => {
  const written = typeof cell === "string" && /^[=+\-@\t\r]/.test(cell) ? `'${cell}` : String(cell);
  return /[",\n\r]/.test(written) ? `"${written.replaceAll('"', '""')}"` : written;
};
const LATEX = { "\\": "\\textbackslash{}", "&": "\\&", "%": "\\%", "$": "\\$", "#": "\\#", "_": "\\_", "{": "\\{", "}": "\\}", "~": "\\textasciitilde{}", "^": "\\textasciicircum{}", "<": "\\textless{}", ">": "\\textgreater{}", "\"": "''", "×": "$\\times$", "→": "$\\rightarrow$", "–": "--", "±": "$\\pm$", "²": "$^2$", "³": "$^3$", "δ": "$\\delta$", "°": "$^\\circ$", "−": "$-$", "…": "\\dots{}" };
// As in tables/latex.py: a letter that its usual fonts have not is told by its code point.
const latex = cell => [...String(cell)].map(sign => LATEX[sign] ?? (sign.codePointAt(0) < 0x180 ? sign : `[U+${sign.codePointAt(0).toString(16).toUpperCase().padStart(4, "0")}]`)).join("");

function text(column, write) {
  const columns = shownColumns(column);
  const value = (c, row) => (c.id === "model" ? row.title : c.value(row) ?? "");
  return `${write([columns.map(c => c.id), ...sorted(rowsOn(column), sorting(columns)).map(row => columns.map(c => value(c, row)))])}\n`;
}

function downloads(column) {
  return h("p", {}, "This table with all variants: ", Object.entries(FILES).map(([kind, make]) => [h("button", {
    type: "button", class: "plain", "data-key": `download-${kind}`,
    onclick: () => {
      const url = URL.createObjectURL(new Blob([make(column)], { type: "text/plain" }));
      h("a", { href: url, download: `${column.group}-${column.milestone}.${{ CSV: "csv", JSON: "json", LaTeX: "tex" }[kind]}` }).click();
      URL.revokeObjectURL(url);
    },
  }, kind), " "]));
}
