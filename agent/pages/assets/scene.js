"use strict";
for (const figure of document.querySelectorAll("figure.scene")) {
  const scene = JSON.parse(figure.querySelector("script").textContent);
  const canvas = figure.querySelector("canvas"), context = canvas.getContext("2d"), bar = figure.querySelector(".bar");
  const colours = ["#2a86c8", "#d55e00", "#009e73", "#c0649a", "#8f75d6", "#9a7d0a"];
  const ink = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const ramp = share => { // from blue by way of grey to orange: read by the colour-blind too
    const stops = [[42, 134, 200], [150, 150, 150], [235, 110, 0]], place = Math.max(0, Math.min(1.999, 2 * share)), k = Math.floor(place);
    return `rgb(${stops[k].map((c, i) => Math.round(c + (stops[k + 1][i] - c) * (place - k))).join(",")})`;
  };
  const shapes = [];
  let next = 0;
  for (const [name, line] of Object.entries(scene.lines)) shapes.push({ name, colour: colours[next++ % 6], strokes: Array.isArray(line[0][0]) ? line : [line], values: scene.colouring[name] });
  for (const [name, points] of Object.entries(scene.points)) shapes.push({ name, colour: colours[next++ % 6], points });
  for (const [name, [low, high]] of Object.entries(scene.boxes)) {
    const c = [0, 1, 2, 3, 4, 5, 6, 7].map(k => [k & 1 ? high[0] : low[0], k & 2 ? high[1] : low[1], k & 4 ? high[2] : low[2]]);
    const edges = [[0, 1], [2, 3], [4, 5], [6, 7], [0, 2], [1, 3], [4, 6], [5, 7], [0, 4], [1, 5], [2, 6], [3, 7]];
    shapes.push({ name, colour: name.startsWith("keep-out") ? "#c0392b" : "#8a949e", strokes: edges.map(([a, b]) => [c[a], c[b]]) });
  }
  const bodies = frame => Array.from({ length: scene.arm.radius.length }, (_, k) => ({ from: scene.arm.ends[frame].slice(6 * k, 6 * k + 3), to: scene.arm.ends[frame].slice(6 * k + 3, 6 * k + 6), radius: scene.arm.radius[k] }));
  const all = shapes.flatMap(s => (s.points || []).concat(...(s.strokes || []))).concat(scene.arm ? bodies(0).flatMap(b => [b.from, b.to]) : []);
  const middle = [0, 1, 2].map(k => (Math.min(...all.map(p => p[k])) + Math.max(...all.map(p => p[k]))) / 2);
  const reach = Math.max(1e-6, ...all.map(p => Math.hypot(p[0] - middle[0], p[1] - middle[1], p[2] - middle[2])));
  let turn = -0.9, tilt = 0.45, zoom = 1.1, frame = 0, playing = 0;

  function draw() {
    const ratio = window.devicePixelRatio || 1, width = canvas.clientWidth, height = canvas.clientHeight;
    canvas.width = width * ratio; canvas.height = height * ratio;
    context.setTransform(ratio, 0, 0, ratio, 0, 0);
    const scale = 0.46 * Math.min(width, height) / reach * zoom;
    const [ct, st, ci, si] = [Math.cos(turn), Math.sin(turn), Math.cos(tilt), Math.sin(tilt)];
    const flat = p => {
      const [x, y, z] = [p[0] - middle[0], p[1] - middle[1], p[2] - middle[2]];
      const u = ct * x - st * y, v = st * x + ct * y;
      return [width / 2 + scale * u, height / 2 - scale * (ci * z + si * v), v * ci - z * si];
    };
    context.font = "12px system-ui, sans-serif";
    context.lineCap = context.lineJoin = "round";
    if (scene.arm) for (const body of bodies(frame).sort((a, b) => flat(b.from)[2] - flat(a.from)[2])) {
      const [a, b] = [flat(body.from), flat(body.to)];
      context.strokeStyle = ink("--soft"); context.globalAlpha = 0.32;
      context.lineWidth = Math.max(3, 2 * body.radius * scale);
      context.beginPath(); context.moveTo(a[0], a[1]); context.lineTo(b[0] + 0.01, b[1]); context.stroke();
      context.globalAlpha = 1;
    }
    if (scene.arm) { // the line through the joints, which stays in view where bodies hide each other
      const joints = scene.arm.joints[frame], chain = [];
      for (let i = 0; i < joints.length; i += 3) chain.push(flat(joints.slice(i, i + 3)));
      context.strokeStyle = context.fillStyle = ink("--ink"); context.lineWidth = 3;
      context.beginPath(); chain.forEach((p, i) => i ? context.lineTo(p[0], p[1]) : context.moveTo(p[0], p[1])); context.stroke();
      for (const p of chain) { context.beginPath(); context.arc(p[0], p[1], 5, 0, 7); context.fillStyle = ink("--paper"); context.fill(); context.lineWidth = 2; context.stroke(); }
    }
    context.lineWidth = 1.6;
    shapes.forEach((shape, k) => {
      context.strokeStyle = context.fillStyle = shape.colour;
      if (shape.values) {
        const top = Math.max(1e-12, ...shape.values), line = shape.strokes[0];
        context.lineWidth = 3;
        for (let i = 1; i < line.length; i++) {
          context.strokeStyle = ramp(shape.values[i] / top);
          context.beginPath(); context.moveTo(...flat(line[i - 1]).slice(0, 2)); context.lineTo(...flat(line[i]).slice(0, 2)); context.stroke();
        }
        context.lineWidth = 1.6;
        context.fillStyle = ink("--ink");
        context.fillText(`${shape.name}: ${scene.by}`, 8, 16 + 15 * k, width - 16);
        [0, 0.5, 1].forEach((share, i) => { context.fillStyle = ramp(share); context.fillText(`● ${+(share * top).toPrecision(2)}`, 8 + 60 * i, height - 64); });
        return;
      }
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
      context.fillText(shape.name, 8, 16 + 15 * k, width - 16);
    });
    const origin = [34, height - 30];
    [["x", [1, 0, 0]], ["y", [0, 1, 0]], ["z", [0, 0, 1]]].forEach(([name, p]) => {
      const a = origin[0] + 24 * (ct * p[0] - st * p[1]), b = origin[1] - 24 * (ci * p[2] + si * (st * p[0] + ct * p[1]));
      context.strokeStyle = context.fillStyle = ink("--soft");
      context.beginPath(); context.moveTo(...origin); context.lineTo(a, b); context.stroke(); context.fillText(name, a + 2, b);
    });
  }
  const view = (a, b, z) => { turn += a; tilt = Math.max(-1.57, Math.min(1.57, tilt + b)); zoom *= z; draw(); };
  let from = null;
  canvas.addEventListener("pointerdown", e => { from = [e.clientX, e.clientY]; canvas.setPointerCapture(e.pointerId); });
  canvas.addEventListener("pointerup", () => { from = null; });
  canvas.addEventListener("pointermove", e => {
    if (!from) return;
    view((e.clientX - from[0]) * 0.008, (e.clientY - from[1]) * 0.008, 1);
    from = [e.clientX, e.clientY];
  });
  canvas.addEventListener("wheel", e => { if (document.activeElement !== canvas && !e.ctrlKey) return; e.preventDefault(); view(0, 0, Math.exp(-e.deltaY * 0.001)); }, { passive: false });
  canvas.addEventListener("keydown", e => {
    const keys = { ArrowLeft: [-0.1, 0, 1], ArrowRight: [0.1, 0, 1], ArrowUp: [0, 0.1, 1], ArrowDown: [0, -0.1, 1], "+": [0, 0, 1.2], "=": [0, 0, 1.2], "-": [0, 0, 1 / 1.2] };
    if (keys[e.key]) { e.preventDefault(); view(...keys[e.key]); }
  });
  if (scene.arm) {
    const last = scene.arm.time.length - 1, name = canvas.id;
    const slider = Object.assign(document.createElement("input"), { type: "range", min: 0, max: last, value: 0 });
    const play = Object.assign(document.createElement("button"), { type: "button", textContent: "run" });
    const clock = document.createElement("span");
    slider.setAttribute("aria-label", `time along the loop: ${name}`);
    play.setAttribute("aria-label", `run or stop the arm: ${name}`);
    const show = k => { frame = k; slider.value = k; clock.textContent = `${scene.arm.time[k].toFixed(1)} s`; draw(); };
    slider.addEventListener("input", () => show(+slider.value));
    const begin = () => {
      playing = requestAnimationFrame(function tick(now) {
        tick.start = tick.start ?? now - 1000 * (frame === last ? 0 : scene.arm.time[frame]);
        const at = (now - tick.start) / 1000 % scene.arm.time[last];
        show(Math.max(0, scene.arm.time.findIndex(t => t >= at)));
        playing = requestAnimationFrame(tick);
      });
    };
    play.addEventListener("click", () => { if (playing) { cancelAnimationFrame(playing); playing = 0; } else begin(); play.textContent = playing ? "stop" : "run"; });
    bar.append(play, slider, clock);
    show(0);
  }
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", draw);
  new ResizeObserver(draw).observe(canvas);
  draw();
}
