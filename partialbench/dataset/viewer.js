// A cloud to be turned by hand. Camera frame: x right, y down, z forward, in [−1.27, 1.27].
const decoded = text => {
  const bytes = Uint8Array.from(atob(text), c => c.charCodeAt(0)), points = [];
  for (let i = 0; i < bytes.length; i += 3) points.push([0, 1, 2].map(k => (bytes[i + k] - 128) / 100));
  return points;
};
// A colour of the page's style: the scheme may change while it is looked at.
const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();

// Points, and fainter those of the whole object, packed; lines as [from, to, colour, dashed].
// Returns what draws it anew; `lines` is asked each time.
function turnable(canvas, { points, whole, lines }) {
  const pen = canvas.getContext("2d"), half = canvas.width / 2;
  const seen = decoded(points), hidden = decoded(whole);
  const view = { yaw: +canvas.dataset.yaw, pitch: +canvas.dataset.pitch };
  const place = ([x, y, z]) => {
    const [cy, sy, cp, sp] = [Math.cos(view.yaw), Math.sin(view.yaw), Math.cos(view.pitch), Math.sin(view.pitch)];
    const u = cy * x + sy * z, w = -sy * x + cy * z;
    return [half * (1 + 0.76 * u), half * (1 + 0.76 * (cp * y - sp * w)), sp * y + cp * w];
  };
  const dots = (cloud, size, style, alpha) => {
    pen.fillStyle = style;
    for (const [x, y, z] of cloud.map(place).sort((a, b) => b[2] - a[2])) {
      pen.globalAlpha = alpha * (0.75 - 0.25 * Math.max(-1, Math.min(1, z)));  // the nearer the brighter
      pen.fillRect(x - size / 2, y - size / 2, size, size);
    }
    pen.globalAlpha = 1;
  };
  const draw = () => {
    pen.clearRect(0, 0, canvas.width, canvas.height);
    dots(hidden, half / 50, colour("--soft"), 0.45);
    dots(seen, half / (seen.length > 600 ? 45 : 33), colour("--accent"), 1);
    for (const [from, to, style, dashed] of lines()) {
      const [a, b] = [place(from), place(to)];
      pen.setLineDash(dashed ? [7, 6] : []); pen.lineWidth = half / 67; pen.strokeStyle = colour(style);
      pen.beginPath(); pen.moveTo(a[0], a[1]); pen.lineTo(b[0], b[1]); pen.stroke();
    }
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
  return draw;
}
const axisLines = (frame, dashed) => frame.map((axis, i) => [[0, 0, 0], axis.map(v => 0.8 * v), ["--x", "--y", "--z"][i], dashed]);
