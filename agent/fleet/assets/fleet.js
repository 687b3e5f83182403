"use strict";
(async () => {
  const ROW = 16, LABEL = 150, HEAD = 60;
  const $ = (id) => document.getElementById(id);
  const packed = await fetch("data:application/gzip;base64," + $("data").textContent);
  const data = await new Response(packed.body.pipeThrough(new DecompressionStream("gzip"))).json();
  $("data").remove();
  const machines = data.machines, joints = data.joints, n = joints.length;
  const map = $("map"), list = $("list"), head = $("head"), rest = $("rest");
  let shown = machines, chosen = null, family = null, cell = 20, width = 0;

  const style = (name) => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const mix = (a, b, x) => `rgb(${a.map((v, k) => Math.round(v + (b[k] - v) * x)).join(",")})`;
  const stops = [[247, 247, 230], [253, 187, 99], [215, 48, 39], [80, 8, 30]];
  const gapColour = (value) => {
    const x = Math.min(Math.max(value / 1e4 / (2 * data.gate), 0), 1) * 3, k = Math.min(Math.floor(x), 2);
    return mix(stops[k], stops[k + 1], x - k);
  };
  const trendColour = (value) => {
    const x = Math.max(-1, Math.min(1, value / 1500));
    return x < 0 ? mix([247, 247, 247], [33, 102, 172], -x) : mix([247, 247, 247], [178, 24, 43], x);
  };
  const gradient = (id, colour, low, high) => {
    const at = [...Array(13).keys()].map((k) => colour(low + ((high - low) * k) / 12));
    $(id).style.background = `linear-gradient(to right, ${at.join(",")})`;
  };
  gradient("gaps", gapColour, 0, 2e4 * data.gate);
  gradient("trends", trendColour, -1500, 1500);

  const place = machines.map((one) => {
    const column = new Map(one.joints.map((joint, k) => [joint, k]));
    return joints.map((joint) => (column.has(joint) ? column.get(joint) : -1));
  });
  machines.forEach((one, k) => { one.place = place[k]; });

  const context = (canvas, height) => {
    const scale = window.devicePixelRatio || 1;
    canvas.width = Math.round(width * scale);
    canvas.height = Math.round(height * scale);
    canvas.style.width = `${width}px`;
    canvas.style.height = `${height}px`;
    const pen = canvas.getContext("2d");
    pen.setTransform(scale, 0, 0, scale, 0, 0);
    pen.font = "12px system-ui, sans-serif";
    pen.textBaseline = "middle";
    return pen;
  };
  const left = (block, k) => LABEL + block * (n * cell + 12) + k * cell;

  function draw() {
    const height = list.clientHeight, top = list.scrollTop, first = Math.floor(top / ROW);
    const pen = context(map, height), ink = style("--ink"), none = style("--none"), link = style("--link");
    const rows = Math.min(shown.length, first + Math.ceil(height / ROW) + 1);
    for (let row = first; row < rows; row++) {
      const one = shown[row], y = row * ROW - top;
      if (one === chosen) { pen.fillStyle = link; pen.fillRect(0, y, 4, ROW); }
      pen.fillStyle = ink;
      pen.fillText(one.robot.length > 20 ? "…" + one.robot.slice(-19) : one.robot, 8, y + ROW / 2, LABEL - 12);
      for (let k = 0; k < n; k++) {
        const at = one.place[k], gap = at < 0 ? null : one.gap[at], trend = at < 0 ? null : one.trend[at];
        pen.fillStyle = gap === null || gap === undefined ? none : gapColour(gap);
        pen.fillRect(left(0, k), y, cell - 1, ROW - 1);
        pen.fillStyle = trend === null || trend === undefined ? none : trendColour(trend);
        pen.fillRect(left(1, k), y, cell - 1, ROW - 1);
        if (at >= 0 && one.alarm[at]) {
          pen.fillStyle = "#000";
          pen.beginPath();
          pen.arc(left(1, k) + cell / 2, y + ROW / 2, 3, 0, 7);
          pen.fill();
        }
      }
    }
  }
  function drawHead() {
    const pen = context(head, HEAD);
    pen.fillStyle = style("--ink");
    pen.fillText("error", left(0, 0), 8);
    pen.fillText("change", left(1, 0), 8);
    [0, 1].forEach((block) => joints.forEach((joint, k) => {
      pen.save();
      pen.translate(left(block, k) + cell / 2, HEAD - 2);
      pen.rotate(-Math.PI / 3);
      pen.fillText(joint, 0, 0, 48);
      pen.restore();
    }));
  }
  let waiting = false;
  const later = () => {
    if (!waiting) { waiting = true; requestAnimationFrame(() => { waiting = false; draw(); }); }
  };
  function size() {
    width = list.clientWidth;
    cell = Math.max(4, Math.min(28, (width - LABEL - 20) / (2 * n)));
    drawHead();
    draw();
  }
  const worst = (values) => values.reduce((a, b) => Math.max(a, Math.abs(b ?? 0)), 0);
  const orders = {
    urgency: (a, b) => b.urgency - a.urgency,
    robot: (a, b) => (a.robot < b.robot ? -1 : 1),
    gap: (a, b) => worst(b.gap) - worst(a.gap),
    trend: (a, b) => worst(b.trend) - worst(a.trend),
  };
  function choose() {
    const text = $("search").value.toLowerCase(), only = $("only").checked;
    const inside = family === null ? null : new Set(data.families[family].robots);
    shown = machines.filter((one) =>
      (!only || one.why.length) && (!inside || inside.has(one.robot)) &&
      (!text || one.robot.toLowerCase().includes(text) || one.of.some((v) => v && v.toLowerCase().includes(text))));
    shown.sort(orders[$("order").value]);
    rest.style.height = `${Math.max(0, shown.length * ROW - list.clientHeight)}px`;
    list.scrollTop = 0;
    $("count").textContent = `${shown.length} of ${machines.length} machines`;
    later();
  }

  const make = (parent, tag, text, more) => {
    const made = Object.assign(document.createElement(tag), more || {});
    if (text !== undefined) made.textContent = text;
    parent.append(made);
    return made;
  };
  const percent = (value, sign) =>
    value === null || value === undefined ? "-" : (sign && value > 0 ? "+" : "") + (value / 100).toFixed(2);
  function table(parent, header, rows) {
    const made = make(parent, "table"), line = make(make(made, "thead"), "tr"), body = make(made, "tbody");
    header.forEach((text) => make(line, "th", text, { scope: "col" }));
    rows.forEach((cells) => {
      const row = make(body, "tr");
      cells.forEach((content) => {
        const into = make(row, "td");
        if (content instanceof Node) into.append(content); else into.textContent = content;
      });
    });
  }
  function plot(parent, course) {
    const ns = "http://www.w3.org/2000/svg", w = 420, h = 120, svg = document.createElementNS(ns, "svg");
    svg.setAttribute("viewBox", `0 0 ${w} ${h}`);
    svg.setAttribute("role", "img");
    svg.setAttribute("aria-label", course.text);
    const days = course.days, span = Math.max(1, days[days.length - 1] - days[0]);
    const low = Math.min(...course.values, -100), high = Math.max(...course.values, 100);
    const x = (day) => 45 + ((w - 55) * (day - days[0])) / span, y = (v) => 8 + ((h - 30) * (high - v)) / (high - low);
    const add = (tag, of, text) => {
      const made = document.createElementNS(ns, tag);
      Object.entries(of).forEach(([key, value]) => made.setAttribute(key, value));
      if (text) made.textContent = text;
      svg.append(made);
    };
    const grey = style("--soft");
    [low, 0, high].forEach((v) => {
      add("line", { x1: 45, x2: w - 10, y1: y(v), y2: y(v), stroke: grey, "stroke-width": 0.4 });
      add("text", { x: 40, y: y(v) + 4, "text-anchor": "end", "font-size": 11, fill: grey }, `${(v / 100).toFixed(1)} %`);
    });
    add("text", { x: 45, y: h - 4, "font-size": 11, fill: grey }, `${span} days`);
    days.forEach((day, k) => add("circle", { cx: x(day), cy: y(course.values[k]), r: 2, fill: style("--link") }));
    const figure = make(parent, "figure");
    figure.append(svg);
    make(figure, "figcaption", `${course.joint}: ${course.of}, over its median`);
  }
  function show(one) {
    chosen = one;
    const panel = $("machine");
    panel.replaceChildren();
    make(panel, "h3", one.robot);
    const facts = data.columns.map((name, k) => `${name} ${one.of[k] ?? "-"}`);
    make(panel, "p", [`urgency ${one.urgency.toFixed(2)}`, ...facts].join(" · "), { className: "soft" });
    if (one.why.length) {
      const why = make(panel, "ul");
      one.why.forEach((text) => make(why, "li", text));
    }
    const courses = new Map(one.courses.map((course) => [course.joint, course]));
    const drawn = make(panel, "div");
    const select = (joint) => { drawn.replaceChildren(); if (courses.has(joint)) plot(drawn, courses.get(joint)); };
    table(panel, ["joint", "error [% of nominal]", "change [%]", "95 % interval", ""], one.joints.map((joint, k) => {
      const course = courses.get(joint);
      const name = Object.assign(document.createElement("button"), { className: "robot", textContent: joint });
      name.addEventListener("click", () => select(joint));
      const interval = course ? `${percent(course.interval[0], true)} to ${percent(course.interval[1], true)}` : "";
      return [course ? name : joint, percent(one.gap[k]), percent(one.trend[k], true), interval, one.alarm[k] ? "alarm" : ""];
    }));
    select(one.joints[Math.max(0, one.alarm.indexOf(1))]);
    make(panel, "h3", `${one.runs.length} runs`);
    table(panel, ["run", "day", "status", ""], one.runs.slice().reverse().map(([run, day, status, reason, page]) => {
      let name = run;
      if (page) { name = document.createElement("a"); name.href = page; name.textContent = run; }
      return [name, day, status, reason];
    }));
    panel.scrollTop = 0;
    later();
  }
  function go(robot) {
    const found = machines.find((one) => one.robot === robot);
    if (!found) return;
    show(found);
    const row = shown.indexOf(found);
    if (row >= 0 && (row * ROW < list.scrollTop || (row + 1) * ROW > list.scrollTop + list.clientHeight)) {
      list.scrollTop = Math.max(0, row * ROW - list.clientHeight / 2);
    }
  }
  list.addEventListener("scroll", later, { passive: true });
  window.addEventListener("resize", size);
  map.addEventListener("click", (event) => {
    const one = shown[Math.floor((event.offsetY + list.scrollTop) / ROW)];
    if (one) show(one);
  });
  map.addEventListener("mousemove", (event) => {
    const one = shown[Math.floor((event.offsetY + list.scrollTop) / ROW)];
    if (!one) { map.title = ""; return; }
    const block = event.offsetX >= left(1, 0) ? 1 : 0, k = Math.floor((event.offsetX - left(block, 0)) / cell);
    const at = k >= 0 && k < n ? one.place[k] : -1;
    const value = at < 0 ? "" : block ? ` ${joints[k]}: change ${percent(one.trend[at], true)} %` : ` ${joints[k]}: error ${percent(one.gap[at])} %`;
    map.title = one.robot + value;
  });
  map.addEventListener("keydown", (event) => {
    const step = { ArrowDown: 1, ArrowUp: -1, PageDown: 20, PageUp: -20 }[event.key];
    if (!step || !shown.length) return;
    event.preventDefault();
    const row = chosen ? shown.indexOf(chosen) : -1;
    go(shown[Math.max(0, Math.min(shown.length - 1, row + step))].robot);
  });
  document.querySelectorAll("button.robot[data-robot]").forEach((button) =>
    button.addEventListener("click", () => go(button.dataset.robot)));
  document.querySelectorAll("button.family").forEach((button) => button.addEventListener("click", () => {
    family = family === +button.dataset.family ? null : +button.dataset.family;
    document.querySelectorAll("button.family").forEach((each) => {
      each.textContent = +each.dataset.family === family ? "show all again" : "show these in the map";
    });
    choose();
  }));
  ["search", "order", "only"].forEach((id) => $(id).addEventListener("input", choose));
  choose();
  size();
  rest.style.height = `${Math.max(0, shown.length * ROW - list.clientHeight)}px`;
  if (machines.length && machines[0].why.length) show(machines[0]);
  document.body.dataset.ready = "yes";
})();
