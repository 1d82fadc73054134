// What a row opens to.
function details(column, row) {
  const more = row.more, card = DATA.cards[row.model], width = columnWidth(Math.min(innerWidth - 80, 83 * 16), 21 * 16);
  // Without what it does not say.
  const list = items => h("ul", {}, items.filter(Boolean).map(item => h("li", {}, item)));
  const classes = [...more.per_class].sort((a, b) => a[1] - b[1]);
  return h("div", { class: "cards" },
    h("div", { class: "wide" }, h("h3", {}, "Run it"), h("pre", { tabindex: "0" }, h("code", {}, more.command)),
      h("button", { type: "button", class: "plain", "data-key": "copy", onclick: event => copy(more.command, event.target) }, "copy"),
      " ", h("a", { href: address({ row: row.id }) }, "link to this row")),
    h("div", {}, h("h3", {}, "Card"), list([
      card.paper, card.reference && `after ${card.reference}${card.licence ? ` (${card.licence})` : ""}`,
      card.links.length > 0 && card.links.map(([label, url]) => [h("a", { href: url, rel: "noreferrer" }, label), " "]),
      `claims invariance to ${row.claims.join(", ") || "nothing"}; turned, its logits move by ${percent(row.turned)} % of their size`,
      ...card.deviations.map(text => `deviates: ${text}`),
    ]), folded("This run against the publication's recipe", more.deviations), folded("What the publication leaves open, and how it is settled here", card.choices)),
    h("div", {}, h("h3", {}, "Training"), list([
      `${more.training.seeds.length > 1 ? `seed ${more.training.seed}: ` : ""}${thousands(more.training.clouds)} clouds seen in ${more.training.minutes.toFixed(1)} min, ${thousands(more.training.per_second)} a second while it learns`,
      `on ${more.training.device}; commit ${more.training.commit}`,
      `seeds ${more.training.seeds.join(", ")}; weights ${more.training.weights.join(", ")}`,
      `input ${row.input}`,
    ]), learning(column, [row], width), trainingLog(more, width)),
    h("div", {}, h("h3", {}, "Classes, the hardest first"), h("div", { class: "bars", tabindex: "0", role: "region", "aria-label": "accuracy per class" }, classes.map(([label, value]) => [
      h("span", {}, label),
      s("svg", { viewBox: "0 0 100 6", preserveAspectRatio: "none", "aria-hidden": "true" }, s("rect", { width: 100 * value, height: 6 })),
      h("span", {}, percent(value))]))),
    h("div", {}, h("h3", {}, "Confusion"), confusionMatrix(column.classes, more.per_class, more.confusions, width),
      h("p", { class: "about" }, `True class down, answer across, in the order of their names; blue is right. The ${more.confusions.length} most frequent confusions of all seeds.`),
      list(more.confusions.slice(0, 5).map(([i, j, value]) => `${column.classes[i]} named ${column.classes[j]}: ${percent(value)} %`))),
    h("div", {}, h("h3", {}, "Calibration"), reliability(row, width)),
    column.views.map(view => [ACCURACY, POSE_ERROR].map(what => viewChart(view, [row], what, width)).filter(Boolean))
      .filter(charts => charts.length).map((charts, i) => h("div", {}, i === 0 && h("h3", {}, "By what the camera sees"), charts)));
}

const folded = (title, texts) => texts.length > 0 && h("details", { class: "fold" }, h("summary", {}, `${title} (${texts.length})`), h("ul", {}, texts.map(text => h("li", {}, text))));

// Over what a view shows. Places are [middle, clouds, accuracy, low, high, pose error, low, high].
const QUANTITIES = {
  "visible fraction": { scale: 100, label: "visible share of the surface (%)", text: "the share of the surface that is seen" },
  distance: { scale: 1, label: "distance of the camera (object radii)", text: "the camera's distance" },
  elevation: { scale: 1, label: "elevation of the camera (°)", text: "the camera's elevation, 90° straight above the object" },
};
const ACCURACY = { from: 2, scale: 100, label: "accuracy (%)", text: "Accuracy", most: 100 };
const POSE_ERROR = { from: 5, scale: 1, label: "median pose error (°)", text: "Pose error", most: 180 };

function viewChart(view, rows, what, width, keys = new Map()) {
  const over = QUANTITIES[view.quantity], scaled = v => (v === null ? null : what.scale * v);
  const clouds = rows.flatMap(row => view.rows[row.id] || []).map(place => place[1]);
  return lineChart({
    caption: `${what.text} over ${over.text} (95 % intervals over test objects; ${thousands(Math.min(...clouds))} to ${thousands(Math.max(...clouds))} clouds a bin).`, width,
    series: rows.map(row => ({
      name: row.title, key: keys.get(row.id) ?? 0, points: (view.rows[row.id] || []).filter(place => place[what.from] !== null).map(place => [over.scale * place[0], ...[0, 1, 2].map(i => scaled(place[what.from + i]))]),
    })),
    x: { label: over.label, text: v => String(+v.toFixed(2)).replace("-", "−") }, y: { label: what.label, least: 0, most: what.most }, apart: 4,
  });
}

const COMPARED = 5;  // rows whose intervals can still be told apart

// The first rows over all that is known of the views.
function byView(column, width) {
  const rows = column.rows.filter(row => row.main && (state.tab !== "pose" || row.pose)).slice(0, COMPARED);
  const what = state.tab === "pose" ? POSE_ERROR : ACCURACY;
  const charts = column.views.map(view => viewChart(view, rows, what, width, looks(column))).filter(Boolean);
  if (!charts.length) return null;
  const lacking = column.views.length < 3 && h("p", { class: "about" }, "Distance and elevation of the camera are in the data: they are drawn where the data folder is at hand when the board is made (partialbench leaderboard --look-in FOLDER).");
  return h("section", { id: "views" }, h("h2", {}, "By what the camera sees"), h("div", { class: "figures" }, charts), lacking);
}

function copy(text, button) {
  const byHand = () => { button.textContent = "select it and copy by hand"; say(button.textContent); };
  if (!navigator.clipboard) byHand();  // pages served without encryption have none
  else navigator.clipboard.writeText(text).then(() => { button.textContent = "copied"; say("copied"); }, byHand);
}

function reliability(row, width) {
  const points = row.more.reliability.map(([x, y]) => [100 * x, 100 * y]);
  return lineChart({
    caption: `Right as often as it says? On the diagonal confidence is what it claims; the mean gap is ${percent(row.calibration)} points.`, width,
    series: [{ name: row.title, points }, { name: "exactly as sure as it is right", points: [[0, 0], [100, 100]] }],
    x: { label: "confidence (%)", text: v => String(v) }, y: { label: "share that is right (%)", least: 0, most: 100 },
  }) || h("p", { class: "about" }, `The mean gap between confidence and accuracy is ${percent(row.calibration)} points.`);
}

// Lines of the log are [clouds seen, value], each of what went before it.
function trainingLog({ log, training }, width) {
  return Object.entries(log).filter(([, lines]) => lines.length > 2).map(([name, lines]) => {
    const scale = name.endsWith("accuracy") ? 100 : 1, values = lines.map(([, value]) => scale * value);
    return lineChart({
      caption: `${name} over the training: ${values[0].toPrecision(3)} → ${values.at(-1).toPrecision(3)}.`, width,
      series: [{ name, points: lines.map(([clouds], i) => [100 * clouds / training.clouds, values[i]]) }],
      x: { label: "share of the training (%)", text: v => String(v) }, y: { label: scale === 100 ? `${name} (%)` : name },
    });
  });
}

const MOST_FAR = 3;  // more intervals on one spot hide each other

// Accuracy over clouds seen, with what a power law expects of more where there are milestones enough.
function learning(column, rows, width) {
  const curves = DATA.curves[column.group] || {};
  // Where several rows are compared, one milestone is no curve.
  const long = rows.filter(row => curves[row.id] && (rows.length === 1 || curves[row.id].points.length > 1));
  const keys = rows.length > 1 ? looks(column) : new Map();
  const series = long.map((row, i) => ({
    name: row.title, key: keys.get(row.id) ?? 0,
    points: curves[row.id].points.map(p => [p[0], 100 * p[1], p[2] === null ? null : 100 * p[2], p[3] === null ? null : 100 * p[3]]),
    far: i < MOST_FAR && curves[row.id].far && { x: DATA.far, y: 100 * curves[row.id].far[0], low: 100 * curves[row.id].far[1], high: 100 * curves[row.id].far[2] },
  }));
  if (!series.some(each => each.points.length > 1)) return null;
  const far = series.filter(each => each.far);
  const told = far.map(({ name, far: f }) => `${name} ${f.y.toFixed(1)} % (${f.low.toFixed(1)} – ${f.high.toFixed(1)})`).join("; ");
  return lineChart({
    caption: "Accuracy over the training clouds seen, with 95 % intervals over test objects." +
      (far.length ? ` Dashed, an extrapolation, not a result: a power law of the error, fitted to the milestones, at ${engineering(DATA.far)} clouds: ${told} (95 % prediction interval).` : ""),
    series, width, x: { log: true, label: "training clouds seen" }, y: { label: "accuracy (%)", most: 100, least: 0 },
  });
}
