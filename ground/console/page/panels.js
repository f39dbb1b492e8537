// Panels below the plots: passes over ground stations, and the files of the satellite.
import { labelled, say } from "/page/commands.js";

const make = (kind, properties, ...children) => { const element = Object.assign(document.createElement(kind), properties); element.append(...children); return element; };
const clock = (utc) => utc.slice(0, 19).replace("T", " ");

async function answerOf(request) {
  try { return await (await request).json(); } catch { return { error: "the console does not answer: check that `knightcube console` runs" }; }
}

export class Passes {
  constructor(panel, table, commander, state) {
    Object.assign(this, { form: panel.querySelector("form"), body: panel.querySelector("tbody"), status: panel.querySelector("p"), commander, state });
    panel.hidden = !table.orbit;
    this.form.stations.value = table.stations.join("; ") || localStorage.getItem("stations") || "";
    this.form.onsubmit = (event) => { event.preventDefault(); this.predict(); };
    panel.ontoggle = () => { if (panel.open && this.form.stations.value && !this.body.rows.length) this.predict(); };
    this.schedules = table.commanding && table.commands.some(({ name }) => name === "schedule");
  }

  async predict() {
    localStorage.setItem("stations", this.form.stations.value);
    const query = new URLSearchParams({ at: this.state().time, days: this.form.days.value });
    for (const station of this.form.stations.value.split(";")) if (station.trim()) query.append("station", station.trim());
    if (!query.has("station")) { say(this.status, "give a ground station, such as Berlin,52.5,13.4", "error"); return; }
    say(this.status, "predicting ...");
    const answer = await answerOf(fetch(`/api/passes?${query}`));
    this.body.replaceChildren();
    if (answer.error) { say(this.status, answer.error, "error"); return; }
    say(this.status, `${answer.passes.length} passes; standard deviation of the times at the end of the span: ${answer.timing_error_s.toFixed(1)} s.${this.schedules ? "" : " To schedule from here, start with --link."}`, "legend");
    for (const one of answer.passes) this.add(one);
  }

  add(one) {
    const line = this.body.insertRow();
    const light = `satellite ${one.sunlit > 0.5 ? "sunlit" : "in shadow"}, Sun at ${one.sun_elevation_deg.toFixed(0)}° there`;
    const cells = [one.station, clock(one.rise_utc), clock(one.set_utc).slice(11), `${one.elevation_deg.toFixed(1)}°`, `${one.mask_deg}°`, one.azimuths_deg.map((angle) => `${angle.toFixed(0)}°`).join(" → "), light];
    for (const text of cells) line.insertCell().textContent = text;
    const schedule = line.insertCell();
    for (const { at, words, text } of one.schedule) {
      const entry = make("div", {}, make("code", { textContent: `${at}Z ${text}` }));
      if (this.schedules) entry.append(" ", make("button", { type: "button", textContent: "schedule ...", onclick: () => this.commander.send("schedule", { at, words }, this.status) }));
      schedule.append(entry);
    }
    labelled(line);
  }
}

export class Files {
  constructor(panel, table, commander) {
    Object.assign(this, { form: panel.querySelector("form"), body: panel.querySelector("tbody"), status: panel.querySelector("p"), commander, busy: false });
    panel.hidden = !table.files;
    this.form.list.onclick = () => this.list();
    this.form.kind.append(...table.puts.map((kind) => new Option(kind)));
    for (const element of this.form.elements) if (element !== this.form.list) (element.closest("label") ?? element).hidden = !table.puts.length;
    this.form.onsubmit = (event) => { event.preventDefault(); this.put(); };
    panel.ontoggle = () => { if (panel.open && !table.puts.length) this.list(); };
    this.puts = table.puts.length > 0;
  }

  // By a link the state of a transfer is in the telemetry.
  show(newest) {
    const transfer = newest.transfer;
    if (this.busy && transfer?.done !== undefined) say(this.status, `transfer ${transfer.number}: ${transfer.done} of ${transfer.size} bytes`);
  }

  async during(words, request, then) {
    say(this.status, words);
    this.busy = true;
    const answer = await request();
    this.busy = false;
    if (answer.error) say(this.status, answer.error, "error"); else then(answer);
  }

  list() {
    return this.during("listing ...", () => answerOf(fetch("/api/files")), ({ files, free }) => {
      say(this.status, `${files.length} files${free === undefined ? "" : `; ${(free / 1e6).toFixed(0)} MB are free`}`, "legend");
      this.body.replaceChildren();
      for (const { name, bytes } of files) {
        const line = this.body.insertRow();
        line.insertCell().textContent = name;
        line.insertCell().textContent = bytes;
        line.insertCell().append(make("button", { type: "button", textContent: "get", ariaLabel: `get ${name}`, onclick: () => this.get(name) }));
        labelled(line);
      }
    });
  }

  get(name) {
    const request = async () => {
      try {
        const answer = await fetch(`/api/file?${new URLSearchParams({ name })}`);
        return answer.ok ? { blob: await answer.blob() } : await answer.json();
      } catch { return { error: "the console does not answer: check that `knightcube console` runs" }; }
    };
    return this.during(`getting ${name} ...`, request, ({ blob }) => {
      const link = make("a", { href: URL.createObjectURL(blob), download: name.split("/").at(-1) });
      link.click();
      setTimeout(() => URL.revokeObjectURL(link.href), 10_000);
      say(this.status, `got ${name}, ${blob.size} bytes`, "answer");
    });
  }

  put() {
    const file = this.form.file.files[0];
    if (!this.commander.live) { say(this.status, "The page shows the past: press live to put a file.", "error"); return; }
    if (!file) { say(this.status, "choose a file first", "error"); return; }
    const query = new URLSearchParams({ kind: this.form.kind.value, name: file.name });
    this.during(`putting ${file.name} ...`, () => answerOf(fetch(`/api/file?${query}`, { method: "POST", body: file })), ({ name, bytes, sha256 }) => {
      say(this.status, `on board: ${name}, ${bytes} bytes. `, "answer");
      this.status.append(make("button", { type: "button", textContent: "use ...", onclick: () => this.commander.send("use-file", { name, sum: sha256 }, this.status) }));
    });
  }
}
