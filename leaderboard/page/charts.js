// Figures as SVG, drawn from the page's data at the width there is.
const SHAPES = ["circle", "square", "up", "diamond", "down", "cross", "bar", "ring"];
const FEWEST_MARKS = 3;  // fewer are a sentence, not a figure
const MOST_LINES = 8;    // as many colours as can be told apart

// Which colour a key has; its mark is another one in each round of the colours, so that no two of 64 look alike.
const hue = key => `k${key % MOST_LINES}`;
const shapeOf = key => SHAPES[(key + Math.floor(key / MOST_LINES)) % SHAPES.length];

// Row → its key in every figure that compares rows: models in the table's own order, then their variants.
const looks = column => new Map([...column.rows.filter(row => row.main), ...column.rows.filter(row => !row.main)].map((row, i) => [row.id, i]));

function mark(key, x, y) {
  const at = (points) => s("path", { d: `M${points.map(([a, b]) => `${x + a},${y + b}`).join("L")}Z`, class: hue(key) });
  switch (shapeOf(key)) {
    case "square": return at([[-3.5, -3.5], [3.5, -3.5], [3.5, 3.5], [-3.5, 3.5]]);
    case "up": return at([[0, -4.5], [4.2, 3.2], [-4.2, 3.2]]);
    case "diamond": return at([[0, -5], [5, 0], [0, 5], [-5, 0]]);
    case "down": return at([[0, 4.5], [4.2, -3.2], [-4.2, -3.2]]);
    case "cross": return s("path", { d: `M${x - 4},${y - 4}l8,8M${x - 4},${y + 4}l8,-8`, class: hue(key), "stroke-width": 2.2 });
    case "bar": return at([[-5, -2], [5, -2], [5, 2], [-5, 2]]);
    case "ring": return s("circle", { cx: x, cy: y, r: 3.6, class: hue(key), "fill-opacity": 0, "stroke-width": 2 });
    default: return s("circle", { cx: x, cy: y, r: 3.8, class: hue(key) });
  }
}

// Round numbers that span [low, high], about as many as asked.
function roundTicks(low, high, about) {
  const raw = (high - low) / about || 1, power = 10 ** Math.floor(Math.log10(raw));
  const step = [1, 2, 5, 10].map(m => m * power).find(size => size >= raw * 0.999);
  const ticks = [];
  for (let v = Math.ceil(low / step - 1e-9) * step; v <= high + step * 1e-9; v += step) ticks.push(+v.toPrecision(12));
  return ticks;
}

// The width of a column where as many stand side by side as fit (style.css has the least widths).
function columnWidth(whole, least) {
  const gap = 32, columns = Math.max(1, Math.floor((whole + gap) / (least + gap)));
  return Math.max(240, (whole - gap * (columns - 1)) / columns);
}

// 1, 2 and 5 times powers of ten within [low, high]; where fewer than two lie there, round numbers or the ends.
function logTicks(low, high) {
  const ticks = [];
  for (let power = 10 ** Math.floor(Math.log10(low)); power <= high; power *= 10) {
    ticks.push(...[1, 2, 5].map(m => m * power).filter(v => v >= low && v <= high));
  }
  if (ticks.length > 1) return ticks;
  const round = roundTicks(low, high, 4).filter(v => v >= low && v <= high);
  return round.length > 1 ? round : [...new Set([low, high])];
}

// Series: {name, key, points: [[x, y, low, high]], far: {x, y, low, high}}; y in the unit of its axis. The key is
// of colour and mark: a model's place in the table (looks), so that it looks alike in every figure that compares.
// Returns a figure with its legend, or null where there is too little to draw.
function lineChart({ caption, series, x, y, width, lines = true, apart = 0 }) {
  const there = series.filter(each => each.points.length).map((each, i) => ({ key: i, ...each }));
  const drawn = there.slice(0, MOST_LINES);
  const left = there.length - drawn.length;
  const all = drawn.flatMap(each => [...each.points, ...(each.far ? [[each.far.x, each.far.y, each.far.low, each.far.high]] : [])]);
  if (all.length < FEWEST_MARKS) return null;
  // As high as the longest name of an axis is long.
  const W = Math.max(280, Math.min(width, 620)), H = Math.max(184, Math.round(W * 0.52)), box = { l: 46, r: 14, t: 10, b: 40 };
  const xs = all.map(p => p[0]), ys = all.flatMap(p => [p[1], p[2], p[3]]).filter(v => v !== null && v !== undefined);
  const to = x.log ? Math.log : v => v;
  let [x0, x1] = [Math.min(...xs), Math.max(...xs)].map(to);
  if (x0 === x1) { x0 -= 1; x1 += 1; }
  const margin = (x1 - x0) * 0.04;
  let [y0, y1] = [Math.min(...ys), Math.max(...ys)];
  const room = (y1 - y0) * 0.06 || 1;
  y0 = Math.max(y.least ?? -Infinity, y0 - room); y1 = Math.min(y.most ?? Infinity, y1 + room);
  const px = v => box.l + (to(v) - x0 + margin) / (x1 - x0 + 2 * margin) * (W - box.l - box.r);
  const py = v => H - box.b - (v - y0) / (y1 - y0) * (H - box.t - box.b);
  // Intervals of several rows at one place stand side by side.
  const beside = i => apart * (i - (drawn.length - 1) / 2);
  const places = x.places || (x.log ? [...new Set(xs)].sort((a, b) => a - b) : roundTicks(Math.min(...xs), Math.max(...xs), 5));
  const text = x.text || engineering;
  let last = -Infinity;
  const ticks = places.map(v => {
    const at = px(v), label = text(v), half = 3.4 * label.length;
    if (at - half < last + 6) return s("line", { x1: at, x2: at, y1: H - box.b, y2: H - box.b + 4, class: "grid" });
    last = at + half;
    return s("g", {}, s("line", { x1: at, x2: at, y1: box.t, y2: H - box.b + 4, class: "grid" }),
      s("text", { x: at, y: H - box.b + 17, "text-anchor": "middle" }, label));
  });
  const levels = roundTicks(y0, y1, 5).map(v => s("g", {},
    s("line", { x1: box.l, x2: W - box.r, y1: py(v), y2: py(v), class: "grid" }),
    s("text", { x: box.l - 6, y: py(v) + 4, "text-anchor": "end" }, String(v))));
  const curves = drawn.map(({ key: i, ...each }, n) => s("g", {}, s("title", {}, each.name),
    lines && s("path", { class: `line ${hue(i)}`, d: "M" + each.points.map(p => `${(px(p[0]) + beside(n)).toFixed(1)},${py(p[1]).toFixed(1)}`).join("L") }),
    each.far && s("path", { class: `line far ${hue(i)}`, d: `M${px(each.points.at(-1)[0])},${py(each.points.at(-1)[1])}L${px(each.far.x)},${py(each.far.y)}` }),
    each.far && s("path", { class: `line ${hue(i)}`, d: `M${px(each.far.x)},${py(each.far.low)}V${py(each.far.high)}` }),
    each.points.map(p => [
      typeof p[2] === "number" && s("path", { class: `line bound ${hue(i)}`, d: `M${px(p[0]) + beside(n)},${py(p[2])}V${py(p[3])}` }),
      mark(i, px(p[0]) + beside(n), py(p[1]))])));
  const chart = s("svg", { class: "chart", viewBox: `0 0 ${W} ${H}`, width: W, height: H, role: "img", "aria-label": caption },
    levels, ticks, curves,
    s("text", { x: (box.l + W - box.r) / 2, y: H - 5, "text-anchor": "middle" }, x.label),
    s("text", { transform: `translate(12,${(H - box.b + box.t) / 2}) rotate(-90)`, "text-anchor": "middle" }, y.label));
  return h("figure", {}, chart, legend(drawn, left), h("figcaption", {}, caption));
}

const legend = (drawn, left) => h("ul", { class: "key" },
  drawn.map(({ name, key: i }) => h("li", {}, s("svg", { width: 13, height: 13, viewBox: "-7 -7 14 14", "aria-hidden": "true" }, mark(i, 0, 0)), name)),
  left > 0 && h("li", { class: "quiet" }, `and ${left} more in the table`));

// Where a row's accuracy lies between the lowest and the highest bound of the table.
function rangeMark(row, low, high) {
  const at = v => 3 + 94 * (v - low) / (high - low || 1);
  const told = row.low === null ? "no interval: one test object" : `95 % interval ${range(row.low, row.high)}`;
  return s("svg", { class: "range", width: 100, height: 14, viewBox: "0 0 100 14", role: "img", "aria-label": told },
    s("title", {}, told),
    s("line", { class: "ground", x1: 3, x2: 97, y1: 7, y2: 7 }),
    row.low !== null && s("rect", { x: at(row.low), width: Math.max(1.5, at(row.high) - at(row.low)), y: 3.5, height: 7, rx: 1.5 }),
    s("line", { x1: at(row.accuracy), x2: at(row.accuracy), y1: 1, y2: 13 }));
}

// Shares of one class named as another; the diagonal is what is right.
function confusionMatrix(classes, perClass, confusions, width) {
  const names = classes.filter(name => perClass.some(([label]) => label === name) || confusions.some(c => classes[c[1]] === name));
  const index = new Map(names.map((name, i) => [name, i]));
  const room = Math.min(86, 7 + 6.3 * Math.max(...names.map(n => Math.min(n.length, 13))));
  const size = Math.min(width, 460), labelled = (size - room) / names.length >= 8;
  const margin = labelled ? room : 0, cell = (size - margin) / names.length;
  const square = (i, j, share, diagonal) => s("rect", {
    x: margin + j * cell, y: i * cell, width: cell * 0.94, height: cell * 0.94, "fill-opacity": Math.max(0.06, share), class: `cell ${diagonal ? "k0" : "k1"}`,
  }, s("title", {}, `${names[i]} named ${names[j]}: ${percent(share)} %`));
  const short = name => (name.length > 13 ? `${name.slice(0, 12)}…` : name);
  return s("svg", { class: "chart", width: size, height: size, viewBox: `0 0 ${size} ${size}`, role: "img", "aria-label": "confusion of classes" },
    perClass.map(([label, share]) => square(index.get(label), index.get(label), share, true)),
    confusions.map(([i, j, share]) => square(index.get(classes[i]), index.get(classes[j]), share, false)),
    labelled && names.map((name, i) => [
      s("text", { x: margin - 4, y: (i + 0.5) * cell + 3, "text-anchor": "end", class: cell < 12 ? "small" : null }, short(name)),
      s("text", { transform: `translate(${margin + (i + 0.5) * cell + 3},${size - margin + 4}) rotate(-90)`, "text-anchor": "end", class: cell < 12 ? "small" : null }, short(name)),
    ]));
}
