// Plots with history. Each plot asks the console for its span of time; peaks are kept when values are reduced.
import { say } from "/page/commands.js";
import { colour } from "/page/theme.js";
import { rounded, shownUnit } from "/page/values.js";

const CURVES = ["curve1", "curve2", "curve3", "curve4", "curve5", "curve6"];
const AXES = { x: "curve2", y: "curve3", z: "curve1", w: "curve4" }; // the colours of the axes in the drawing of the body
const POINTS = 1200;
const PERIOD_MS = 500;
const HEIGHT = 150;
const LONG_S = 900; // s; a longer span is asked for less often
const TESTBED = [["control.q2", "control.path_q2", "control.target_q2"], ["attitude.rate"], ["control.current_written"], ["housekeeping.coil_power"]];
const ORBIT = [["attitude.rate", "spin.rate"], ["attitude.angle_sigma"], ["attitude.dipole"], ["imu.field"], ["housekeeping.coil_power"]];
const CURRENT = { A: [1e3, "mA"] };
const make = (kind, properties, ...children) => { const element = Object.assign(document.createElement(kind), properties); element.append(...children); return element; };
const capital = (text) => text.charAt(0).toUpperCase() + text.slice(1);

export class Plots {
  constructor({ place, adder, span, unzoom, parameters }, table, state) {
    Object.assign(this, { place, span, unzoom, table, state, panels: [], busy: false, zoom: null, last: 0 });
    this.fields = new Map();
    for (const packet of table.packets) for (const field of packet.fields) {
      if (field.type.startsWith("S") || field.count > 9) continue;
      const [factor, unit] = CURRENT[field.unit] ?? shownUnit(field.unit);
      const name = `${packet.name}.${field.name}`;
      this.fields.set(name, { ...field, name, packet: packet.name, column: field.name, factor, shown: unit });
      parameters.append(make("option", { value: name, label: `${field.meaning}${unit ? ` (${unit})` : ""}` }));
    }
    adder.onchange = () => { if (this.fields.has(adder.value)) { this.add([adder.value]); adder.value = ""; } };
    span.onchange = () => this.zoomTo(null);
    unzoom.onclick = () => this.zoomTo(null);
    document.addEventListener("theme", () => { for (const panel of this.panels) panel.forget(); this.refresh(true); });
  }

  begin() {
    for (const names of this.table.body === "orbit" || this.table.orbit ? ORBIT : TESTBED) this.add(names);
    setInterval(() => this.refresh(), PERIOD_MS);
    new ResizeObserver(() => { for (const panel of this.panels) panel.plot?.setSize({ width: this.width(), height: HEIGHT }); }).observe(this.place);
  }

  width() { return Math.max(240, this.place.clientWidth - 16); }

  add(names) {
    const panel = new Panel(this, names.map((name) => this.fields.get(name)).filter(Boolean));
    this.panels.push(panel);
    this.place.append(panel.box);
    this.refresh(true);
  }

  remove(panel) {
    panel.forget();
    panel.box.remove();
    this.panels = this.panels.filter((other) => other !== panel);
  }

  // All plots show the same time, either the chosen length or the span that was selected with the pointer.
  zoomTo(span) {
    this.zoom = span;
    this.unzoom.disabled = span === null;
    this.refresh(true);
  }

  extent() {
    const { time, span } = this.state();
    if (this.zoom) return this.zoom;
    const length = Number(this.span.value);
    return [length > 0 ? Math.max(span[0], time - length) : span[0], time];
  }

  async refresh(now = false) {
    if (this.busy) { this.again ||= now; return; } // a slow console is asked again later, not more often
    const [from, to] = this.extent();
    const rest = performance.now() - this.last < (to - from > LONG_S ? 4 : 1) * PERIOD_MS * 0.9;
    if (!now && (rest || document.hidden || `${from} ${to}` === this.drawn)) return;
    this.busy = true;
    try {
      await Promise.all(this.panels.map((panel) => panel.draw(from, to)));
      this.drawn = `${from} ${to}`;
      this.last = performance.now();
    } catch { this.drawn = null; /* the light of the link says that the console is lost */ } finally { this.busy = false; }
    if (this.again) { this.again = false; this.refresh(true); }
  }
}

class Panel {
  constructor(plots, fields) {
    Object.assign(this, { plots, fields, plot: null });
    this.title = make("h3", {});
    this.note = make("span", { className: "limits" });
    this.trouble = make("span", {});
    const adder = make("input", { placeholder: "+ parameter", autocomplete: "off" });
    adder.setAttribute("list", "parameters");
    adder.setAttribute("aria-label", "add a parameter to this plot");
    adder.onchange = () => {
      const field = plots.fields.get(adder.value);
      if (field && !this.fields.includes(field)) { adder.value = ""; this.fields.push(field); this.arrange(); plots.refresh(true); }
    };
    const button = (text, title, action) => make("button", { type: "button", textContent: text, title, onclick: action });
    this.box = make("section", { className: "panel" }, make("header", {}, this.title, make("span", { className: "tools" }, adder,
      button("CSV", "every value of the span that is shown", () => this.saveTable()), button("PNG", "picture of this plot", () => this.savePicture()),
      button("×", "remove this plot", () => plots.remove(this)))), this.note, this.trouble);
    this.box.querySelector(".tools button:last-child").setAttribute("aria-label", "remove this plot");
    this.arrange();
  }

  // Makes the curves: one of each component, with an axis of each unit.
  arrange() {
    this.forget();
    const meanings = [...new Set(this.fields.map((field) => `${capital(field.meaning.split(";")[0])}${field.shown ? ` (${field.shown})` : ""}`))];
    this.title.textContent = meanings.join(" · ");
    this.box.setAttribute("aria-label", this.title.textContent);
    const single = this.fields.length === 1;
    this.curves = this.fields.flatMap((field, place) => (field.components.length ? field.components : [""]).map((part, component) => ({
      field, component, label: single ? part || "value" : part ? `${field.name} ${part}` : field.name,
      stroke: AXES[part] ?? CURVES[(part ? component : place) % CURVES.length], dash: part && place ? [5, 4] : [],
    })));
    this.units = [...new Set(this.fields.map(({ shown }) => shown))];
  }

  forget() { this.plot?.destroy(); this.plot = null; }

  async series(from, to, points) {
    const asked = this.curves.map(async ({ field, component }) => {
      const query = new URLSearchParams({ packet: field.packet, field: field.column, component, from, to, points });
      const answer = await (await fetch(`/api/series?${query}`)).json();
      if (answer.error && !points) throw new Error(answer.error);
      return [answer.times ?? [], (answer.values ?? []).map((value) => (value === null ? null : value * field.factor))];
    });
    return uPlot.join(await Promise.all(asked));
  }

  async draw(from, to) {
    const curves = this.curves;
    const data = await this.series(from, to, POINTS);
    if (curves !== this.curves) return; // the plot was changed meanwhile
    this.extent = [from, to];
    this.limits = this.limitsNow();
    this.note.textContent = [...new Set(this.limits.map(({ text }) => text))].join(", ");
    if (this.plot) this.plot.setData(data); else this.plot = new uPlot(this.options(), data, this.box);
    // A new plot fills its legend later in this turn. Without a pointer, the legend shows the newest values.
    queueMicrotask(() => { if ((this.plot?.cursor.idx ?? null) === null) this.plot?.setLegend({ idxs: data.map(newestOf) }); });
  }

  // Limits by the table, and by the parameters in use.
  limitsNow() {
    const parameters = this.plots.newest().parameters;
    const found = [];
    for (const field of this.fields) {
      const add = (value, level, side) => found.push({ scale: field.shown, value: value * field.factor, level, text: `${level} ${side} ${rounded(value * field.factor)} ${field.shown}`.trim() });
      for (const [level, bounds] of [["warning", field.warning_outside], ["fault", field.fault_outside]]) {
        if (bounds?.length) { add(bounds[0], level, "below"); add(bounds[1], level, "above"); }
      }
      for (const [name, side, level] of field.limited_by ?? []) if (parameters) add(parameters[name], level, side);
    }
    return found;
  }

  // The range of an axis includes a limit that is as near as the values differ.
  rangeOf(scale, low, high) {
    if (low === null || low === undefined) return [0, 1];
    const reach = Math.max(high - low, 0.5 * Math.abs(high), 1e-12);
    let [bottom, top] = [low, high];
    for (const limit of this.limits) if (limit.scale === scale && limit.value > low - reach && limit.value < high + reach) {
      bottom = Math.min(bottom, limit.value); top = Math.max(top, limit.value);
    }
    const pad = 0.08 * (top - bottom) || 0.1 * Math.abs(top) || 1;
    return [bottom - pad, top + pad];
  }

  drawLimits(plot) {
    const { ctx, bbox } = plot;
    ctx.save();
    ctx.lineWidth = devicePixelRatio;
    ctx.setLineDash([6 * devicePixelRatio, 4 * devicePixelRatio]);
    for (const { scale, value, level } of this.limits) {
      const y = Math.round(plot.valToPos(value, scale, true));
      if (y < bbox.top || y > bbox.top + bbox.height) continue;
      ctx.strokeStyle = colour(level === "fault" ? "bad" : "warn");
      ctx.beginPath(); ctx.moveTo(bbox.left, y); ctx.lineTo(bbox.left + bbox.width, y); ctx.stroke();
    }
    ctx.restore();
  }

  options() {
    const axis = { stroke: colour("dim"), grid: { stroke: colour("grid"), width: 1 }, ticks: { stroke: colour("grid") } };
    const scales = Object.fromEntries(this.units.map((unit) => [unit, { range: (_, low, high) => this.rangeOf(unit, low, high) }]));
    const axes = this.units.map((unit, k) => ({ ...axis, scale: unit, side: k ? 1 : 3, size: 62, space: 22, grid: { ...axis.grid, show: k === 0 },
      label: unit, labelSize: unit ? 16 : 0, labelFont: "11px sans-serif", values: (_, ticks) => ticks.map((value) => rounded(value)) }));
    return {
      width: this.plots.width(), height: HEIGHT, scales: { x: { time: false, range: () => this.extent }, ...scales }, axes: [axis, ...axes],
      cursor: { sync: { key: "time" }, drag: { x: true, y: false, setScale: false }, bind: { dblclick: () => () => { this.plots.zoomTo(null); return null; } } },
      hooks: { draw: [(plot) => this.drawLimits(plot)], setSelect: [(plot) => this.selected(plot)] },
      series: [{ label: "s", value: (_, value) => (value === null || value === undefined ? "-" : value.toFixed(2)) }, ...this.curves.map(({ label, field, stroke, dash }) => ({
        label, scale: field.shown, value: (_, value) => rounded(value), stroke: colour(stroke), dash, width: 1.3, spanGaps: true, points: { show: false } }))],
    };
  }

  selected(plot) {
    const { left, width } = plot.select;
    if (width < 4) return;
    const span = [plot.posToVal(left, "x"), plot.posToVal(left + width, "x")];
    plot.setSelect({ left: 0, top: 0, width: 0, height: 0 }, false);
    this.plots.zoomTo(span);
  }

  fileName(kind) { return `${this.plots.table.name}_${this.fields.map(({ name }) => name).join("_")}.${kind}`.replace(/[^A-Za-z0-9_.-]/g, "_"); }

  async saveTable() {
    let data;
    try { data = await this.series(...this.extent, 0); } catch (error) { say(this.trouble, error.message, "error"); return; }
    say(this.trouble, "");
    const heads = this.curves.map(({ field, component }) => [field.name, field.components[component]].filter(Boolean).join(".") + (field.shown ? ` [${field.shown}]` : ""));
    const lines = [["time [s]", ...heads].join(",")];
    for (let row = 0; row < data[0].length; row++) lines.push(data.map((column) => column[row] ?? "").join(","));
    save(new Blob([`${lines.join("\n")}\n`], { type: "text/csv" }), this.fileName("csv"));
  }

  // Draws title, plot and legend on one picture.
  savePicture() {
    const from = this.plot.ctx.canvas;
    const [scale, line] = [devicePixelRatio, 18 * devicePixelRatio];
    const to = make("canvas", { width: from.width, height: from.height + 2 * line });
    const ctx = to.getContext("2d");
    ctx.fillStyle = colour("panel"); ctx.fillRect(0, 0, to.width, to.height);
    ctx.font = `${12 * scale}px sans-serif`; ctx.fillStyle = colour("text");
    ctx.fillText(this.title.textContent, 6 * scale, 13 * scale, to.width - 12 * scale);
    ctx.drawImage(from, 0, line);
    let x = 6 * scale;
    this.curves.forEach(({ label, stroke }) => {
      ctx.fillStyle = colour(stroke); ctx.fillText(label, x, to.height - 5 * scale);
      x += ctx.measureText(`${label}    `).width;
    });
    to.toBlob((blob) => save(blob, this.fileName("png")));
  }
}

function save(blob, name) {
  const link = make("a", { href: URL.createObjectURL(blob), download: name });
  link.click();
  setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
}

// Position of the newest value of a curve. Curves of several packets have gaps at each other's times.
function newestOf(values) {
  let at = values.length - 1;
  while (at > 0 && (values[at] === null || values[at] === undefined)) at -= 1;
  return Math.max(at, 0);
}
