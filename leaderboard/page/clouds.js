// Clouds on which the models disagree, to be turned by hand. Camera frame: x right, y down, z forward.
const decoded = text => {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0)), points = [];
  for (let i = 0; i < bytes.length; i += 3) points.push([0, 1, 2].map(k => (bytes[i + k] - 128) / 100));
  return points;
};
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

function gallery(column) {
  if (!column.samples.length) return null;
  return h("section", { id: "disagree" }, h("h2", {}, "Where the models disagree"),
    h("p", { class: "about" }, "Test clouds that one model names rightly and another wrongly, drawn at random. Blue: what the camera sees; grey: the whole object, which no model is shown. Solid axes: the true pose (x red, y green, z blue); choose a model to see its pose dashed. Drag to turn, or use the arrow keys."),
    h("div", { class: "gallery" }, column.samples.map(sample => cloud(sample, column))));
}

function cloud(sample, column) {
  const stored = DATA.clouds[sample.cloud], points = decoded(stored.points), whole = decoded(stored.whole);
  const canvas = h("canvas", { width: 400, height: 400, tabindex: "0", role: "img", "aria-label": `cloud of a ${stored.true}; drag or use the arrow keys to turn it` });
  const pen = canvas.getContext("2d");
  // A little from the side: seen straight from the camera a cloud hides its own depth.
  const view = { yaw: 0.35, pitch: 0.2, answer: null };
  const place = ([x, y, z]) => {
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    const u = cy * x + sy * z, w = -sy * x + cy * z;
    return [200 + 165 * u, 200 + 165 * (cp * y - sp * w), sp * y + cp * w];
  };
  const axes = (frame, dashes) => frame.forEach((axis, i) => {
    const from = place([0, 0, 0]), to = place(axis.map(v => 0.8 * v));
    pen.setLineDash(dashes); pen.lineWidth = 3; pen.strokeStyle = colour(["--x", "--y", "--z"][i]);
    pen.beginPath(); pen.moveTo(from[0], from[1]); pen.lineTo(to[0], to[1]); pen.stroke();
  });
  const dots = (cloud, size, style, alpha) => {
    pen.fillStyle = style;
    for (const [x, y, z] of cloud.map(place).sort((a, b) => b[2] - a[2])) {
      pen.globalAlpha = alpha * (0.75 - 0.25 * Math.max(-1, Math.min(1, z)));
      pen.fillRect(x - size / 2, y - size / 2, size, size);
    }
    pen.globalAlpha = 1;
  };
  const draw = () => {
    pen.clearRect(0, 0, 400, 400);
    dots(whole, 4, colour("--soft"), 0.45);
    dots(points, 6, colour("--accent"), 1);
    axes(stored.axes, []);
    if (view.answer !== null && sample.answers[view.answer][3]) axes(sample.answers[view.answer][3], [7, 6]);
    canvas.dataset.yaw = view.yaw.toFixed(3);
  };
  const move = (dx, dy) => { view.yaw -= dx; view.pitch = Math.max(-1.5, Math.min(1.5, view.pitch + dy)); draw(); };
  canvas.addEventListener("pointerdown", event => canvas.setPointerCapture(event.pointerId));
  canvas.addEventListener("pointermove", event => { if (event.buttons) move(event.movementX * 0.012, -event.movementY * 0.012); });
  canvas.addEventListener("keydown", event => {
    const step = { ArrowLeft: [-0.2, 0], ArrowRight: [0.2, 0], ArrowUp: [0, 0.2], ArrowDown: [0, -0.2] }[event.key];
    if (step) { event.preventDefault(); move(...step); }
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  draw();
  const right = sample.answers.filter(answer => answer[2]).length, posed = sample.answers.some(answer => answer[3]);
  const answers = sample.answers.map(([title, said, isRight, frame], i) => h("li", { class: isRight ? "right" : "wrong" }, `${isRight ? "✓" : "✗"} ${title}: ${said}`));
  return h("figure", {}, canvas, h("figcaption", {}, h("strong", {}, stored.true), ` ${stored.object_id}, ${percent(stored.visible)} % of the surface seen`,
    posed && h("div", {}, h("label", {}, "pose of ", h("select", {
      "aria-label": `whose pose to draw for ${stored.object_id}`, onchange: event => { view.answer = event.target.value === "" ? null : +event.target.value; draw(); },
    }, h("option", { value: "" }, "nobody"), sample.answers.map(([title, , , frame], i) => frame && h("option", { value: i }, title))))),
    h("details", { open: answers.length <= 6 }, h("summary", {}, `${right} of ${answers.length} models right`), h("ol", {}, answers))));
}
