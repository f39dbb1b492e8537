// Plots with history: each panel asks the console for its span, with the peaks kept.
const COLOURS = ["#79c0ff", "#ff7b72", "#7ee787", "#d2a8ff", "#ffa657", "#8b949e"];
const POINTS = 1200;
const PERIOD_MS = 500;
const TESTBED = [["control.q2", "control.path_q2", "control.target_q2"], ["attitude.rate"], ["control.current_written"], ["housekeeping.coil_power"]];
const ORBIT = [["attitude.rate", "spin.rate"], ["attitude.angle_sigma"], ["attitude.dipole"], ["imu.field"], ["housekeeping.coil_power"]];

export class Plots {
  constructor(place, chooser, span, table, state) {
    Object.assign(this, { place, span, table, state, panels: [], busy: false });
    this.fields = new Map();
    chooser.append(new Option("add a plot ...", ""));
    for (const packet of table.packets) for (const field of packet.fields) {
      if (field.type.startsWith("S") || field.count > 6) continue;
      this.fields.set(`${packet.name}.${field.name}`, field);
      chooser.append(new Option(`${packet.name}.${field.name}`));
    }
    chooser.onchange = () => { if (chooser.value) this.add([chooser.value]); chooser.value = ""; };
    span.onchange = () => this.refresh();
  }

  begin() {
    for (const names of this.table.orbit ? ORBIT : TESTBED) this.add(names);
    setInterval(() => this.refresh(), PERIOD_MS);
    new ResizeObserver(() => { for (const panel of this.panels) panel.plot?.setSize({ width: this.width(), height: 150 }); }).observe(this.place);
  }

  width() { return Math.max(300, this.place.clientWidth - 16); }

  add(names) {
    const box = document.createElement("div");
    box.className = "panel";
    const head = document.createElement("header");
    const first = this.fields.get(names[0]);
    head.append(Object.assign(document.createElement("span"), { textContent: `${names.join(", ")} [${first?.unit ?? "-"}]` }));
    const close = Object.assign(document.createElement("button"), { type: "button", textContent: "x", title: "remove this plot" });
    head.append(close);
    box.append(head);
    this.place.append(box);
    const curves = names.flatMap((name) => {
      const count = this.fields.get(name)?.count ?? 0;
      return [...Array(count).keys()].map((component) => ({ name, component, label: names.length === 1 ? (count > 1 ? `[${component}]` : "value") : count > 1 ? `${name}[${component}]` : name }));
    });
    const panel = { box, curves, plot: null };
    close.onclick = () => { panel.plot?.destroy(); box.remove(); this.panels = this.panels.filter((other) => other !== panel); };
    this.panels.push(panel);
  }

  async refresh() {
    if (this.busy) return; // a slow console is asked again later, not more often
    this.busy = true;
    try {
      const { time, span } = this.state();
      const length = Number(this.span.value);
      const from = length > 0 ? Math.max(span[0], time - length) : span[0];
      await Promise.all(this.panels.map((panel) => this.draw(panel, from, time)));
    } catch { /* the link's light says that the console is lost */ } finally { this.busy = false; }
  }

  async draw(panel, from, to) {
    const asked = panel.curves.map(async ({ name, component }) => {
      const [packet, field] = name.split(".");
      const query = new URLSearchParams({ packet, field, component, from, to, points: POINTS });
      const answer = await (await fetch(`/api/series?${query}`)).json();
      return [answer.times ?? [], answer.values ?? []];
    });
    const data = uPlot.join(await Promise.all(asked));
    if (panel.plot) panel.plot.setData(data); else panel.plot = new uPlot(this.options(panel.curves), data, panel.box);
    if (panel.plot.cursor.idx === null) panel.plot.setLegend({ idxs: data.map(newestOf) }); // nobody points at a moment
  }

  options(curves) {
    const short = (value) => (value === null || value === undefined ? "-" : Number(value.toPrecision(4)).toString());
    const seconds = (value) => (value === null || value === undefined ? "-" : value.toFixed(2));
    const axis = { stroke: "#8794a6", grid: { stroke: "#222b37", width: 1 }, ticks: { stroke: "#222b37" } };
    return {
      width: this.width(), height: 150, scales: { x: { time: false } }, axes: [axis, { ...axis, size: 72, space: 22, values: (_, ticks) => ticks.map(short) }],
      series: [{ label: "s", value: (_, value) => seconds(value) }, ...curves.map(({ label }, k) => ({ label, value: (_, value) => short(value), stroke: COLOURS[k % COLOURS.length], width: 1.2, spanGaps: true, points: { show: false } }))],
    };
  }
}

// Where the newest value of a curve stands; curves of several packets have gaps at each other's times.
function newestOf(values) {
  let at = values.length - 1;
  while (at > 0 && (values[at] === null || values[at] === undefined)) at -= 1;
  return Math.max(at, 0);
}
