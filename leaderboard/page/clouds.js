// Clouds on which the models disagree, to be turned by hand (viewer.js).
function gallery(column) {
  if (!column.samples.length) {
    // Of research data no cloud is shown unless it is asked for; those of other data may be.
    const other = columnsOf(state.tab).find(each => each.samples.length);
    return other ? h("p", { id: "disagree" }, h("a", { href: address({ data: other.group, clouds: other.milestone, row: "", variants: "" }), "data-key": "disagree" }, "Clouds on which the models disagree"), ` are shown for ${other.title}.`) : null;
  }
  return h("section", { id: "disagree" }, h("h2", {}, "Where the models disagree"),
    h("p", { class: "about" }, "Test clouds that one model names rightly and another wrongly, drawn at random. Blue: what the camera sees; grey: the whole object, which no model is shown, and the camera. Solid axes: the true pose (x red, y green, z blue); choose a model to see its pose dashed. Drag to turn, or use the arrow keys."),
    h("div", { class: "gallery" }, column.samples.map(sample => cloud(sample, column))));
}

function cloud(sample, column) {
  const stored = DATA.clouds[sample.cloud];
  const canvas = h("canvas", { width: 400, height: 400, tabindex: "0", role: "img", "data-yaw": "0.5", "data-pitch": "0.3", "aria-label": `cloud of a ${stored.true}; drag or use the arrow keys to turn it` });
  let answer = null;
  const lines = () => [
    ...axisLines(stored.axes, false), ...stored.camera.map(([from, to]) => [from, to, "--soft", false]),
    ...(answer !== null && sample.answers[answer][3] ? axisLines(sample.answers[answer][3], true) : []),
  ];
  const draw = turnable(canvas, { points: stored.points, whole: stored.whole, lines });
  const right = sample.answers.filter(answer => answer[2]).length, posed = sample.answers.some(answer => answer[3]);
  const answers = sample.answers.map(([title, said, isRight]) => h("li", { class: isRight ? "right" : "wrong" }, `${isRight ? "✓" : "✗"} ${title}: ${said}`));
  return h("figure", {}, canvas, h("figcaption", {}, h("strong", {}, stored.true), ` ${stored.object_id}, ${percent(stored.visible)} % of the surface seen`,
    posed && h("div", {}, h("label", {}, "pose of ", h("select", {
      "aria-label": `whose pose to draw for ${stored.object_id}`, onchange: event => { answer = event.target.value === "" ? null : +event.target.value; draw(); },
    }, h("option", { value: "" }, "nobody"), sample.answers.map(([title, , , frame], i) => frame && h("option", { value: i }, title))))),
    h("details", { open: answers.length <= 6 }, h("summary", {}, `${right} of ${answers.length} models right`), h("ol", {}, answers))));
}
