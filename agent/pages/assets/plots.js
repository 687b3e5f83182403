"use strict";
// Draws every plot of the page from the CSV behind its link; without this script its still picture stays.
(() => {
  if (!window.DecompressionStream || !window.uPlot) return;
  const colour = name => getComputedStyle(document.documentElement).getPropertyValue(name).trim();
  const linked = {}, every = []; // charts by the name of what zooms together, and all
  const narrow = () => window.innerWidth < 700;
  const make = (tag, attributes, ...children) => {
    const element = document.createElement(tag);
    for (const [key, value] of Object.entries(attributes)) element.setAttribute(key, value);
    element.append(...children);
    return element;
  };
  const digits = value => value == null || !isFinite(value) ? "–" : value === 0 ? "0" : Math.abs(value) >= 1e5 || Math.abs(value) < 1e-3 ? value.toExponential(2) : String(+value.toPrecision(4));
  const stamp = value => new Date(value * 1000).toISOString().slice(0, 16).replace("T", " ");

  async function unpack(link) {
    const bytes = Uint8Array.from(atob(link.href.split(",", 2)[1]), c => c.charCodeAt(0));
    return new Response(new Blob([bytes]).stream().pipeThrough(new DecompressionStream("gzip"))).text();
  }
  function columnsOf(text, dates) {
    const lines = text.trim().split("\n");
    const rows = lines.slice(1).map(line => line.split(","));
    const count = rows[0].length, columns = Array.from({ length: count }, () => new Array(rows.length));
    rows.forEach((row, i) => { for (let k = 0; k < count; k++) columns[k][i] = row[k] === "" ? null : dates && row[k].includes("T") ? Date.parse(row[k]) / 1000 : +row[k]; });
    return columns;
  }

  class Chart {
    constructor(figure, spec, panel, columns, box) {
      Object.assign(this, { figure, spec, panel, box });
      const end = columns[panel.x].indexOf(null);
      this.x = end < 0 ? columns[panel.x] : columns[panel.x].slice(0, end);
      this.raw = panel.series.map(one => one.columns.map(k => columns[k].slice(0, this.x.length)));
      this.on = panel.series.map(() => true);
      this.legend();
      this.over = make("div", { class: "canvas", tabindex: "0", role: "application", "aria-roledescription": "plot", "aria-label": `${panel.title || figure.dataset.name}: ${panel.series.map(s => s.label).join(", ")}${panel.unit ? " in " + panel.unit : ""} over ${spec.label}. Arrow keys read values, plus and minus zoom, 0 shows all.` });
      box.append(this.over);
      this.plot = new uPlot(this.options(), this.data(), this.over);
      this.group = spec.link === "-" ? [] : linked[spec.link] = linked[spec.link] || [];
      this.group.push(this); every.push(this);
      this.over.addEventListener("keydown", event => this.key(event));
      new ResizeObserver(() => { const width = this.over.clientWidth; if (width > 0 && width !== this.plot.width) this.plot.setSize({ width, height: this.height() }); }).observe(this.over);
    }
    height() { return this.spec.panels.length > 1 ? 200 : narrow() ? 240 : 300; }
    legend() {
      this.values = [];
      this.where = make("span", { class: "at" });
      const row = make("div", { class: "legend" });
      if (this.panel.title) row.append(make("strong", {}, this.panel.title));
      this.panel.series.forEach((one, k) => {
        const value = make("b", {});
        const mark = make("i", { class: one.look, style: `--c:${one.colour}` });
        if (one.dash.length) mark.innerHTML = `<svg viewBox="0 0 26 4"><path d="M0 2H26" stroke="${one.colour}" stroke-width="3" stroke-dasharray="${one.dash}"/></svg>`;
        const button = make("button", { type: "button", "aria-pressed": "true" }, mark, one.label, value);
        button.addEventListener("click", () => this.toggle(k, !this.on[k], button));
        one.button = button;
        row.append(button);
        this.values.push(value);
      });
      this.live = make("span", { class: "hidden", "aria-live": "polite" });
      row.append(this.where, this.live);
      this.box.append(row);
    }
    toggle(k, on) {
      this.on[k] = on;
      this.panel.series[k].button.setAttribute("aria-pressed", String(on));
      const scale = this.plot.scales.x, range = { min: scale.min, max: scale.max };
      this.plot.setData(this.data(), false);
      this.plot.setScale("x", range);
    }
    // what uPlot draws: x, then one column a line, two a band, and two running sums a part of a stack
    data() {
      const columns = [this.x], nothing = () => new Array(this.x.length).fill(null);
      let high = new Array(this.x.length).fill(0), low = high.slice();
      if (this.panel.series.some(one => one.look === "part")) columns.push(high.slice());
      this.panel.series.forEach((one, k) => {
        if (one.look !== "part") { for (const column of this.raw[k]) columns.push(this.on[k] ? column : nothing()); return; }
        const values = this.raw[k][0];
        if (this.on[k]) {
          high = high.map((sum, i) => sum + Math.max(values[i] || 0, 0));
          low = low.map((sum, i) => sum + Math.min(values[i] || 0, 0));
        }
        columns.push(high.slice(), low.slice());
      });
      return columns;
    }
    options() {
      const { spec, panel } = this, series = [{}], bands = [];
      let up = 0, down = 0;
      if (panel.series.some(one => one.look === "part")) { series.push({ width: 0, points: { show: false } }); up = down = 1; }
      panel.series.forEach(one => {
        const at = series.length, quiet = { width: 0, points: { show: false }, stroke: "transparent" };
        if (one.look === "part") {
          series.push(quiet, { ...quiet });
          bands.push({ series: [at, up], fill: one.colour + "99" }, { series: [down, at + 1], fill: one.colour + "99" });
          up = at; down = at + 1;
        } else if (one.look === "band") {
          series.push(quiet, { ...quiet });
          bands.push({ series: [at + 1, at], fill: one.colour + "40" });
        } else if (one.look === "points") series.push({ stroke: one.colour, width: 0, paths: () => null, points: { show: true, size: 5, fill: one.colour, stroke: one.colour } });
        else series.push({ stroke: one.colour, width: 1.4, dash: one.dash, points: { show: false } });
      });
      const axis = { stroke: () => colour("--soft"), font: "12px system-ui, sans-serif", grid: { stroke: () => colour("--grid"), width: 1 }, ticks: { stroke: () => colour("--line"), width: 1 } };
      const levels = panel.marks.map(mark => mark[1]);
      return {
        width: this.over.clientWidth || 300, height: this.height(), series, bands,
        tzDate: seconds => uPlot.tzDate(new Date(seconds * 1000), "Etc/UTC"),
        scales: { x: { time: spec.dates }, y: { range: (u, low, high) => {
          if (low == null) { low = 0; high = 1; }
          low = Math.min(low, ...levels, panel.zero ? 0 : Infinity); high = Math.max(high, ...levels);
          const pad = 0.06 * (high - low || Math.abs(high) || 1);
          return [panel.zero && low >= 0 ? 0 : low - pad, high + pad];
        } } },
        axes: [{ ...axis, size: 46, ...(!spec.unit && this.x.every(Number.isInteger) ? { incrs: [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000] } : {}), label: spec.unit ? `${spec.label} [${spec.unit}]` : spec.label, labelSize: 18, labelFont: "12px system-ui, sans-serif", ...(spec.dates ? { space: 90, values: (u, ticks, axis, space, step) => ticks.map(t => step >= 86400 ? stamp(t).slice(0, 10) : step >= 60 ? stamp(t).slice(5) : new Date(t * 1000).toISOString().slice(11, 19)) } : {}) },
          { ...axis, size: 62, label: panel.unit ? `[${panel.unit}]` : undefined, labelSize: 16, labelFont: "12px system-ui, sans-serif", values: (u, ticks) => ticks.map(v => Math.abs(v) >= 1e5 || (v !== 0 && Math.abs(v) < 1e-3) ? v.toExponential(0) : String(+v.toPrecision(6))) }],
        cursor: { y: false, drag: { x: true, y: false }, points: { size: 6 } },
        legend: { show: false },
        hooks: {
          setCursor: [u => this.read(u)],
          setScale: [(u, name) => { if (name === "x") this.spread(u); }],
          draw: [u => this.levels(u)],
        },
      };
    }
    levels(u) {
      for (const [name, level] of this.panel.marks) {
        const y = Math.round(u.valToPos(level, "y", true)), ratio = window.devicePixelRatio || 1;
        u.ctx.save();
        u.ctx.strokeStyle = u.ctx.fillStyle = colour("--soft");
        u.ctx.lineWidth = ratio; u.ctx.setLineDash([2 * ratio, 3 * ratio]);
        u.ctx.beginPath(); u.ctx.moveTo(u.bbox.left, y); u.ctx.lineTo(u.bbox.left + u.bbox.width, y); u.ctx.stroke();
        u.ctx.font = `${11 * ratio}px system-ui, sans-serif`; u.ctx.textAlign = "right";
        u.ctx.fillText(name, u.bbox.left + u.bbox.width - 4 * ratio, y - 4 * ratio);
        u.ctx.restore();
      }
    }
    read(u) {
      const i = u.cursor.idx;
      if (u.cursor.left >= 0 && i != null && !Chart.busy) {
        Chart.busy = true;
        for (const other of this.group) if (other !== this && other.box.offsetParent) { const left = other.plot.valToPos(this.x[i], "x"); other.plot.setCursor({ left, top: 5 }); }
        Chart.busy = false;
      }
      const inside = u.cursor.left >= 0 && i != null;
      this.values.forEach((cell, k) => { cell.textContent = !inside || !this.on[k] ? "" : ` ${this.raw[k].map(c => digits(c[i])).join(" to ")} ${this.panel.unit}`; });
      this.where.textContent = inside ? (this.spec.dates ? stamp(this.x[i]) : `${this.spec.label} ${digits(this.x[i])} ${this.spec.unit}`) : "";
    }
    spread(u) {
      if (Chart.spreading) return;
      Chart.spreading = true;
      const { min, max } = u.scales.x;
      for (const other of this.group) if (other !== this) {
        const scale = other.plot.scales.x;
        if (scale.min !== min || scale.max !== max) other.plot.setScale("x", { min, max });
      }
      Chart.spreading = false;
    }
    zoom(factor) {
      const { min, max } = this.plot.scales.x, first = this.x[0], last = this.x[this.x.length - 1];
      if (factor === 0) { this.plot.setScale("x", { min: first, max: last }); return; }
      const at = this.plot.cursor.left >= 0 && this.plot.cursor.idx != null ? this.x[this.plot.cursor.idx] : (min + max) / 2;
      const low = Math.max(first, at - (at - min) * factor), high = Math.min(last, at + (max - at) * factor);
      if (high > low) this.plot.setScale("x", { min: low, max: high });
    }
    key(event) {
      const u = this.plot, step = event.shiftKey ? 25 : 5, width = u.bbox.width / (window.devicePixelRatio || 1);
      const moves = { ArrowLeft: -step, ArrowRight: step }, zooms = { "+": 0.5, "=": 0.5, "-": 2, 0: 0 };
      if (event.key in moves) {
        const left = Math.max(0, Math.min(width, (u.cursor.left >= 0 ? u.cursor.left : width / 2) + moves[event.key]));
        u.setCursor({ left, top: 5 });
        this.live.textContent = [this.where.textContent, ...this.panel.series.map((s, k) => this.on[k] ? s.label + this.values[k].textContent : "")].filter(Boolean).join(", ");
      } else if (event.key in zooms) this.zoom(zooms[event.key]);
      else return;
      event.preventDefault();
    }
  }

  async function draw(figure) {
    const spec = JSON.parse(figure.querySelector("script").textContent), live = figure.querySelector(".live");
    const columns = columnsOf(await unpack(figure.querySelector("a.data")), spec.dates);
    const bar = make("div", { class: "bar" }), boxes = make("div", { class: "panels" });
    live.append(bar, boxes);
    figure.classList.add("drawn");
    let next = spec.shared ? 1 : 0; // columns: the plot's abscissa, then panel by panel
    for (const panel of spec.panels) {
      panel.x = panel.own ? next++ : 0;
      for (const one of panel.series) one.columns = one.look === "band" ? [next++, next++] : [next++];
    }
    const charts = spec.panels.map(panel => {
      const box = make("div", { class: "panel" });
      boxes.append(box);
      return new Chart(figure, spec, panel, columns, box);
    });
    const joints = [...new Set(charts.flatMap(c => [c.panel.joint, ...c.panel.series.map(s => s.joint)]))].filter(Boolean);
    const show = (joint, on) => charts.forEach(chart => {
      if (chart.panel.joint === joint) chart.box.hidden = !on;
      chart.panel.series.forEach((one, k) => { if (one.joint === joint) chart.toggle(k, on); });
    });
    const many = charts.length > 2 && joints.length > 1 && charts.every(c => c.panel.joint);
    if (joints.length > 1) for (const joint of joints) {
      const on = !(many && narrow() && joint !== joints[0]);
      const button = make("button", { type: "button", "aria-pressed": String(on) }, joint);
      button.addEventListener("click", () => { const now = button.getAttribute("aria-pressed") !== "true"; button.setAttribute("aria-pressed", String(now)); show(joint, now); });
      bar.append(button);
      if (!on) show(joint, false);
    }
    const zooms = make("span", { class: "zooms" });
    for (const [text, label, factor] of [["−", "zoom out", 2], ["+", "zoom in", 0.5], ["all", "show the whole axis", 0]]) {
      const button = make("button", { type: "button", "aria-label": `${label}: ${figure.dataset.name}` }, text);
      button.addEventListener("click", () => { const done = new Set(); for (const chart of charts) { if (!done.has(chart.group)) { done.add(chart.group); chart.zoom(factor); } } });
      zooms.append(button);
    }
    bar.append(zooms);
  }

  const plots = document.querySelectorAll("figure.plot");
  const near = new IntersectionObserver(entries => entries.forEach(entry => {
    if (entry.isIntersecting) { near.unobserve(entry.target); draw(entry.target); }
  }), { rootMargin: "600px" });
  plots.forEach(figure => {
    near.observe(figure);
    const link = figure.querySelector("a.data"), packed = link.href;
    link.addEventListener("click", event => { // as plain text, where a script can unpack it
      if (link.href !== packed) return;
      event.preventDefault();
      unpack(link).then(text => { link.href = URL.createObjectURL(new Blob([text], { type: "text/csv" })); link.download = link.download.replace(/\.gz$/, ""); link.click(); });
    });
  });
  matchMedia("(prefers-color-scheme: dark)").addEventListener("change", () => every.forEach(chart => chart.plot.redraw()));
})();
