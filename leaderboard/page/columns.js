// The columns of the table: what each shows, how it sorts, what it means.
const share = (id, title, value, help, best = "high") => ({ id, title, value, help, best, show: row => percent(value(row)) });
const pose = key => row => (row.pose ? row.pose[key] : null);

const COLUMNS = [
  { id: "rank", title: "rank", value: row => row.rank, best: "low", show: row => row.rank ?? "",
    help: "1, and one more for each model that is better beyond doubt, or as the row above where that is more: a paired test over test objects and, where rows have several seeds, over seeds; Holm's correction over all pairs, 5 %. Equal ranks cannot be told apart." },
  { id: "model", title: "model", value: row => row.title.toLowerCase(), best: "low", text: true,
    help: "One row a model, as its card declares it; what was changed about a variant stands in brackets. Opens to its card, its command, its curves." },
  { id: "accuracy", title: "accuracy (%)", value: row => row.accuracy, best: "high",
    show: (row, low, high) => [percent(row.accuracy), row.std !== null && h("span", { class: "quiet" }, ` ± ${percent(row.std)}`), h("span", { class: "printed" }, bracketed(row.low, row.high)), rangeMark(row, low, high)],
    help: "Share of test clouds named rightly, mean ± standard deviation over seeds. The bar is the 95 % interval by bootstrap over test objects." },
  { id: "behind", title: "behind the first", value: row => (row.behind ? row.behind[0] : 0), best: "low",
    show: row => (row.behind ? [percent(row.behind[0]), h("span", { class: "quiet" }, bracketed(row.behind[1], row.behind[2]))] : dash),
    help: "Points of accuracy behind the first model, with the 95 % interval over test objects, both resampled alike." },
  share("over_classes", "over classes", row => row.over_classes, "Mean of the per-class accuracies."),
  share("without_duplicates", "without duplicates", row => row.without_duplicates, "Accuracy without test objects made from the very bytes of a training object."),
  share("shared", "shared classes only", row => row.shared, "The model may answer with classes that both data sets have only."),
  share("pose", "pose bin (%)", pose("top_1"), "Share of clouds whose best of the 60 rotation bins is the true one under the object's symmetry."),
  share("top5", "among 5 (%)", pose("top_5"), "Share of clouds whose true pose bin is among the five most probable."),
  { id: "pose_error", title: "pose error", value: pose("median_deg"), best: "low", show: row => (row.pose ? `${row.pose.median_deg.toFixed(0)}°` : dash),
    help: "Median angle from the best bin to the truth, modulo symmetry. Bins are 44° wide." },
  share("within30", "within 30° (%)", pose("within_30"), "Share of clouds whose best bin errs by less than 30°."),
  { id: "claims", title: "invariant to", value: row => row.claims.join(", ") || null, best: "low", text: true, show: row => row.claims.join(", ") || "nothing",
    help: "What the model's card says leaves its answer unchanged." },
  share("turned", "turned (%)", row => row.turned, "Measured: how far the logits move when a cloud is turned at random, in % of their size. 0 is invariant.", "low"),
  share("calibration", "calibration error", row => row.calibration, "Expected gap between confidence and accuracy, 15 bins, in points.", "low"),
  { id: "parameters", title: "parameters", value: row => row.parameters, best: "low", show: row => engineering(row.parameters), help: "Trainable numbers." },
  { id: "macs", title: "multiply-adds", value: row => row.multiply_adds, best: "low", show: row => engineering(row.multiply_adds), help: "Of the forward pass of one cloud." },
  { id: "ms", title: "ms a cloud", value: row => row.milliseconds, best: "low", show: row => row.milliseconds.toFixed(2), help: "Forward pass in a batch, on the hardware in the record." },
  { id: "memory", title: "memory", value: row => row.memory, best: "low", show: row => (row.memory ? `${engineering(row.memory)}B` : dash), help: "Peak memory of the training." },
  { id: "minutes", title: "training (min)", value: row => row.minutes, best: "low", show: row => row.minutes.toFixed(row.minutes < 10 ? 1 : 0), help: "Time of one seed's training, on the hardware in the record." },
  { id: "seen", title: "clouds seen", value: row => row.seen, best: "low", show: row => engineering(row.seen), help: "Training clouds seen, repeats counted; with those of the trainings it began from." },
  { id: "seeds", title: "seeds", value: row => row.seeds, best: "high", show: (row, low, high, column) => (column.asked[row.id] > row.seeds ? `${row.seeds} of ${column.asked[row.id]}` : row.seeds),
    help: "Trainings behind the row, and how many are asked for where some are not there yet. A row of one seed speaks of one network, not of a method." },
  { id: "date", title: "tested", value: row => row.date, best: "high", text: true, show: row => row.date || dash, help: "The day, in UTC, on which the last of its seeds was tested." },
  { id: "input", title: "input", value: row => row.input, best: "low", text: true, show: row => row.input, help: "What the network saw in this run." },
  { id: "groups", title: "group", value: row => row.groups, best: "low", text: true, show: row => row.groups, help: "Rows that share a number cannot be told apart." },
  { id: "paper", title: "paper's figure", value: row => row.paper, best: "high", show: row => percent(row.paper), help: "What the paper reports for this method, on its own data; the heading says where ours are other data." },
];

const DEFAULT = {
  partial: "rank model accuracy behind pose claims turned parameters seen seeds date",
  pose: "rank model accuracy pose top5 pose_error within30 claims turned seeds date",
  cost: "rank model accuracy parameters macs ms memory minutes seen seeds date",
};
DEFAULT.complete = DEFAULT.noise = DEFAULT.partial;
DEFAULT.transfer = "rank model accuracy behind shared pose claims turned parameters seen seeds date";

// Those chosen that have something to say: a column of dashes is left out unless it was asked for.
function shownColumns(column) {
  const asked = state.cols ? state.cols.split(" ") : null;
  const chosen = asked || (DEFAULT[state.tab] + (column.on_paper_data ? " paper" : "")).split(" ");
  return COLUMNS.filter(c => chosen.includes(c.id) || c.id === "model")
    .filter(c => asked || column.rows.some(row => c.value(row) !== null));
}
