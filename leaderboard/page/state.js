// What is shown is in the address, after "#": it survives a reload and can be passed on.
const DATA = JSON.parse(document.getElementById("data").textContent);
const TABS = [
  ["partial", "Partial"], ["complete", "Complete"], ["transfer", "Transfer"],
  ["noise", "Noise and density"], ["pose", "Pose"], ["cost", "Cost"],
];
const KEYS = ["tab", "data", "clouds", "sort", "dir", "q", "row", "cols", "variants", "absent"];

const state = {};
function readAddress() {
  const given = new URLSearchParams(location.hash.slice(1));
  for (const key of KEYS) state[key] = given.get(key) || "";
  if (!TABS.some(([tab]) => tab === state.tab)) state.tab = firstTab();
  const columns = columnsOf(state.tab), asked = [state.data, state.clouds && `${state.clouds} clouds`].filter(Boolean).join(", ");
  const known = !state.data || columns.some(c => c.group === state.data);
  if (!known || !state.data) state.data = fullest(columns)?.group || "";
  const here = columns.filter(c => c.group === state.data);
  const reached = !state.clouds || here.some(c => c.milestone === state.clouds);
  if (!reached || !state.clouds) state.clouds = fullest(here)?.milestone || "";
  // An address of another board, or of this one before its data were made anew, must not pass for what it shows.
  const row = state.row && !current()?.rows.some(each => each.id === state.row);
  state.lost = known && reached ? (row ? `Here is no row ${state.row}.` : "") : `The address asks for ${asked}, which this board has not; below are other results.`;
}

function address(changes) {
  const next = { ...state, ...changes }, text = new URLSearchParams();
  for (const key of KEYS) if (next[key]) text.set(key, next[key]);
  return `#${text}`;
}

// A change of what is chosen is a step back in the browser's history; typing is not.
function go(changes, quietly) {
  history[quietly ? "replaceState" : "pushState"](null, "", address(changes));
  show();
}

const own = column => column.kind !== "transfer";
const SHOWN = {
  partial: c => c.kind === "partial", complete: c => c.kind === "complete", transfer: c => c.kind === "transfer",
  noise: c => c.conditions.length > 0, pose: c => c.rows.some(row => row.pose), cost: own,
};
const columnsOf = tab => DATA.columns.filter(SHOWN[tab]);
const firstTab = () => (TABS.find(([tab]) => columnsOf(tab).length) || TABS[0])[0];
const models = column => column.rows.filter(row => row.main).length;

// The column with the most models; of equals the partial one, then the longest training.
function fullest(columns) {
  const order = c => [models(c), c.kind === "partial" ? 1 : 0, c.clouds];
  return columns.reduce((best, c) => {
    if (!best) return c;
    const [a, b] = [order(c), order(best)], i = a.findIndex((v, k) => v !== b[k]);
    return i >= 0 && a[i] > b[i] ? c : best;
  }, undefined);
}

const current = () => columnsOf(state.tab).find(c => c.group === state.data && c.milestone === state.clouds);
