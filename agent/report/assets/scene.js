"use strict";
for (const source of document.querySelectorAll("script[data-scene]")) {
  const scene = JSON.parse(source.textContent);
  const canvas = document.getElementById(source.dataset.scene);
  const context = canvas.getContext("2d");
  const colours = ["#3b82c4", "#d9822b", "#4f9d69", "#c75d8a", "#8f75d6", "#a0823c"];
  const corners = (low, high) => [0, 1, 2, 3, 4, 5, 6, 7].map(k => [k & 1 ? high[0] : low[0], k & 2 ? high[1] : low[1], k & 4 ? high[2] : low[2]]);
  const shapes = [];
  let next = 0;
  for (const [name, line] of Object.entries(scene.lines)) shapes.push({ name, colour: colours[next++ % 6], strokes: [line] });
  for (const [name, points] of Object.entries(scene.points)) shapes.push({ name, colour: colours[next++ % 6], points });
  for (const [name, [low, high]] of Object.entries(scene.boxes)) {
    const c = corners(low, high);
    const edges = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
    shapes.push({ name, colour: "#8a949e", strokes: edges.map(([a, b]) => [c[a], c[b]]) });
  }
  const all = shapes.flatMap(s => (s.points || []).concat(...(s.strokes || [])));
  const middle = [0, 1, 2].map(k => (Math.min(...all.map(p => p[k])) + Math.max(...all.map(p => p[k]))) / 2);
  const reach = Math.max(1e-6, ...all.map(p => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2])));
  let turn = -0.9, tilt = 0.45, zoom = 1;

  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const scale = 0.46 * Math.min(width, height) / reach * zoom;
    const [ct, st, ci, si] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const flat = p => {
      const [x, y, z] = [p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]];
      const u = ct * x - st * y, v = st * x + ct * y;
      return [width / 2 + scale * u, height / 2 - scale * (ci * z + si * v)];
    };
    context.lineWidth = 1.4;
    context.font = "12px system-ui, sans-serif";
    shapes.forEach((shape, k) => {
      context.strokeStyle = context.fillStyle = shape.colour;
      for (const stroke of shape.strokes || []) {
        context.beginPath();
        stroke.forEach((p, i) => { const [a, b] = flat(p); i ? context.lineTo(a, b) : context.moveTo(a, b); });
        context.stroke();
      }
      (shape.points || []).forEach((p, i) => {
        const [a, b] = flat(p);
        context.beginPath(); context.arc(a, b, 3.5, 0, 7); context.fill();
        context.fillText(String(i + 1), a + 6, b - 6);
      });
      context.fillText(shape.name, 8, 16 + 15 * k);
    });
    const origin = [34, height - 34];
    [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]].forEach(([name, p]) => {
      const a = origin[0] + 24 * (ct * p[0] - st * p[1]), b = origin[1] - 24 * (ci * p[2] + si * (st * p[0] + ct * p[1]));
      context.strokeStyle = context.fillStyle = "#8a949e";
      context.beginPath(); context.moveTo(...origin); context.lineTo(a, b); context.stroke(); context.fillText(name, a + 2, b);
    });
  }
  let from = null;
  canvas.addEventListener("pointerdown", e => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { from = null; });
  canvas.addEventListener("pointermove", e => {
    if (!from) return;
    turn += (e.clientX - from[0]) * 0.008;
    tilt = Math.max(-1.57, Math.min(1.57, tilt + (e.clientY - from[1]) * 0.008));
    from = [e.clientX, e.clientY];
    draw();
  });
  canvas.addEventListener("wheel", e => { e.preventDefault(); zoom *= Math.exp(-e.deltaY * 0.001); draw(); }, { passive: false });
  window.addEventListener("resize", draw);
  draw();
}
