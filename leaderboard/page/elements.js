// Elements made from data: text is always text, never markup.
const SVG = "http://www.w3.org/2000/svg";

function fill(node, attributes, children) {
  for (const [name, value] of Object.entries(attributes || {})) {
    if (value === null || value === undefined || value === false) continue;
    if (name.startsWith("on")) node.addEventListener(name.slice(2), value);
    else node.setAttribute(name, value === true ? "" : value);
  }
  for (const child of children.flat(Infinity)) {
    if (child !== null && child !== undefined && child !== false) node.append(child);
  }
  return node;
}

const h = (tag, attributes, ...children) => fill(document.createElement(tag), attributes, children);
const s = (tag, attributes, ...children) => fill(document.createElementNS(SVG, tag), attributes, children);

const dash = "–";
// One digit after the point, as the tables in Python have it: a tie goes to the even digit (6.25 is 6.2).
const oneDigit = value => (value * 4 % 1 === 0 && value * 2 % 1 !== 0 ? 2 * Math.round(value * 5) / 10 : value).toFixed(1);
const percent = share => (share === null || share === undefined ? dash : oneDigit(100 * share).replace("-", "−"));
const range = (low, high) => `${percent(low)} – ${percent(high)}`;
// An interval in brackets; nothing where there is none.
const bracketed = (low, high) => (low === null ? "" : ` (${range(low, high)})`);
const thousands = number => number.toLocaleString("en-US");
const engineering = count => {
  for (const [unit, size] of [["G", 1e9], ["M", 1e6], ["k", 1e3]]) {
    if (count >= size) return `${+(count / size).toPrecision(3)} ${unit}`;
  }
  return String(Math.round(count));
};

// What a heading means, on hover, on focus and on tap.
const tip = document.getElementById("tip");
function showTip(target, text) {
  tip.textContent = text;
  tip.hidden = false;
  if (target.matches("button")) target.setAttribute("aria-describedby", "tip");  // read out where it has the focus
  const box = target.getBoundingClientRect();
  tip.style.left = `${Math.max(8, Math.min(box.left, innerWidth - tip.offsetWidth - 8))}px`;
  const below = box.bottom + 6;
  tip.style.top = `${below + tip.offsetHeight > innerHeight ? box.top - tip.offsetHeight - 6 : below}px`;
}
const hideTip = () => { tip.hidden = true; };
addEventListener("keydown", event => { if (event.key === "Escape") hideTip(); });
addEventListener("scroll", hideTip, { passive: true, capture: true });

// What has changed, for those who do not see it.
const said = document.getElementById("said");
const say = text => { said.textContent = text; };

const explained = (text, label) => h("button", {
  type: "button", class: "help", "aria-label": `what ${label} means`,
  onfocus: event => showTip(event.target, text), onblur: hideTip,
  onclick: event => { event.stopPropagation(); showTip(event.target, text); },
}, "?");
