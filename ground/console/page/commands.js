// Forms made from the command table. A form refuses a wrong value, and nothing is sent before it was confirmed.
import { shownUnit } from "/page/values.js";

const CHECK_MS = 250;
const PAST = "The page shows the past: press live to send commands.";
const LAST_OF_FLIGHT = 0x21f; // APID; the link process obeys the commands above

export async function ask(path, body) {
  try {
    return await (await fetch(path, { method: "POST", body, headers: { "Content-Type": "application/json" } })).json();
  } catch { return { error: "the console does not answer: check that `knightcube console` runs" }; }
}
export function say(place, words, kind = "") { place.textContent = words; place.className = kind; }
const make = (kind, properties, ...children) => { const element = Object.assign(document.createElement(kind), properties); element.append(...children); return element; };
// Labels the cells of a line by the heads of its columns, which a narrow page does not show.
export function labelled(line) {
  const heads = line.closest("table").tHead.rows[0].cells;
  for (const cell of line.cells) if (cell.tagName === "TD") cell.dataset.label = heads[cell.cellIndex].textContent;
  return line;
}
const plain = (value) => Number(value.toPrecision(12));

// One input of a form, in the unit of the page. `read` returns the value in the unit of the table.
export class Input {
  constructor(one) {
    this.one = one;
    [this.factor, this.unit] = shownUnit(one.unit ?? "-");
    this.range = one.valid?.length ? one.valid.map((bound) => plain(bound * this.factor)) : null;
    const text = one.hex || one.type.startsWith("S");
    if (one.states?.length) {
      this.element = make("select", {}, ...one.states.map(([number, name]) => new Option(name, number)));
    } else {
      this.element = make("input", { type: text ? "text" : "number", step: one.type.startsWith("f") ? "any" : "1", autocomplete: "off" });
      this.element.placeholder = one.hint || (one.hex ? `${2 * one.hex} hexadecimal digits` : this.limits());
      if (this.range && !text) [this.element.min, this.element.max] = this.range;
    }
    if (text) this.element.classList.add("long");
    if (one.suggestions) {
      const list = make("datalist", { id: `suggestions-${one.field}` }, ...one.suggestions.map((name) => new Option(name)));
      this.element.setAttribute("list", list.id);
      this.list = list;
    }
    const unit = this.unit ? ` (${this.unit})` : "";
    this.label = make("label", { title: [one.meaning, this.limits()].filter(Boolean).join(", ") }, `${one.name}${unit} `, this.element, ...(this.list ? [this.list] : []));
  }

  limits() { return this.range && this.range[1] < 2 ** 32 - 1 ? `${this.range.map((bound) => Number(bound.toPrecision(4))).join(" to ")}${this.unit ? ` ${this.unit}` : ""}` : ""; }

  read() {
    const value = this.element.value.trim();
    if (this.one.hex || this.one.type.startsWith("S")) return value;
    return value === "" ? null : Number(value) / this.factor;
  }

  // What is wrong with the value, or an empty text.
  problem() {
    const value = this.element.value.trim();
    const found = this.fault(value);
    this.element.toggleAttribute("aria-invalid", found !== "");
    if (found) this.element.setAttribute("aria-invalid", "true");
    return found;
  }

  fault(value) {
    const { name, type, hex, length, optional } = this.one;
    if (this.element.validity.badInput) return `${name}: not a number`;
    if (value === "") return optional ? "" : `${name} is missing`;
    if (hex) return new RegExp(`^[0-9a-fA-F]{${2 * hex}}$`).test(value) ? "" : `${name}: give ${2 * hex} hexadecimal digits`;
    if (type.startsWith("S")) return new TextEncoder().encode(value).length > length ? `${name}: longer than ${length} bytes` : "";
    const number = Number(value);
    if (!Number.isFinite(number) || (!type.startsWith("f") && !Number.isInteger(number))) return `${name} = ${value}: not a ${type.startsWith("f") ? "" : "whole "}number`;
    return this.range && (number < this.range[0] || number > this.range[1]) ? `${name} = ${value}: give ${this.limits() || "a smaller number"}` : "";
  }
}

export class Commander {
  constructor(table, { form, which, inputs, safe, answer, dialog }) {
    Object.assign(this, { form, which, place: inputs, safe, answer, dialog, flight: table.name, possible: table.commanding, shown: [] });
    which.onchange = () => this.choose(which.value);
    form.oninput = (event) => { if (event.target !== which) this.soon(); };
    form.onsubmit = (event) => { event.preventDefault(); this.submit(); };
    safe.onclick = () => { this.choose("safe"); this.submit(); };
    this.offer(table);
  }

  // Offers the commands that the body can obey.
  offer(table) {
    this.commands = new Map(table.commands.map((command) => [command.name, command]));
    const own = table.commands.filter((command) => !command.own_form);
    const group = (label, commands) => (commands.length ? [make("optgroup", { label }, ...commands.map(({ name }) => new Option(name)))] : []);
    this.which.replaceChildren(...group("to the flight", own.filter(({ apid }) => apid <= LAST_OF_FLIGHT)), ...group("to the link", own.filter(({ apid }) => apid > LAST_OF_FLIGHT)));
    this.form.hidden = !this.possible;
    if (this.possible) this.choose(own[0].name); else say(this.answer, "This console is read-only: start it with --to SOCKET, --link ADDRESS or --fly CONFIG to send commands.");
  }

  choose(name, values = {}) {
    const command = this.commands.get(name);
    this.which.value = name;
    this.shown = command.inputs.map((one) => new Input(one));
    this.place.replaceChildren(...this.shown.map(({ label }) => label));
    for (const input of this.shown) if (values[input.one.field] !== undefined) input.element.value = values[input.one.field];
    this.arrange();
    this.describe();
  }

  describe() {
    const { meaning, hazard } = this.commands.get(this.which.value);
    say(this.answer, meaning + (hazard ? `. Hazard: ${hazard}.` : "."));
  }

  // Shows the inputs that belong to the chosen states, such as latitude and longitude of a ground target.
  arrange() {
    const chosen = (field) => Number(this.shown.find(({ one }) => one.field === field).element.value);
    for (const { one, label } of this.shown) label.hidden = Boolean(one.only) && !one.only[1].includes(chosen(one.only[0]));
  }

  active() { return this.shown.filter(({ label }) => !label.hidden); }

  values() {
    const found = {};
    for (const input of this.active()) {
      const { field, index } = input.one;
      if (index === undefined) found[field] = input.read(); else (found[field] ??= [])[index] = input.read();
    }
    return found;
  }

  problem() { return this.active().map((input) => input.problem()).find(Boolean) ?? ""; }

  soon() {
    this.arrange();
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.check(), CHECK_MS);
  }

  // Says what the command would do, or why it is refused. The satellite's own checks run in the console.
  async check() {
    const problem = this.problem();
    if (problem) { say(this.answer, problem, "error"); return null; }
    const body = this.body(this.which.value, this.values());
    const checked = await ask("/api/words", body);
    say(this.answer, checked.error ?? checked.words, checked.error ? "error" : "");
    return checked.error ? null : { body, words: checked.words };
  }

  body(command, values) { return JSON.stringify({ command, values }); }

  async submit() {
    clearTimeout(this.timer);
    const checked = await this.check();
    if (checked) this.confirm(this.commands.get(this.which.value), checked, this.answer);
    else this.active().find((input) => input.problem())?.element.focus();
  }

  // Sends a command of another form after confirmation.
  async send(name, values, place) {
    if (!this.live) { say(place, PAST, "error"); return; }
    const body = this.body(name, values);
    const checked = await ask("/api/words", body);
    if (checked.error) say(place, checked.error, "error"); else this.confirm(this.commands.get(name), { body, words: checked.words }, place);
  }

  confirm(command, { body, words }, place) {
    const part = (id) => this.dialog.querySelector(id);
    part("#whom").textContent = this.flight;
    part("#words").textContent = words;
    part("#hazard").hidden = !command.hazard;
    part("#hazard").textContent = command.hazard ?? "";
    this.dialog.returnValue = "cancel";
    this.dialog.showModal();
    this.dialog.onclose = async () => {
      if (this.dialog.returnValue !== "send") return;
      say(place, "sent ...");
      const answer = await ask("/api/command", body);
      say(place, answer.error ?? `${answer.obeyed ? "executed" : "refused"}: ${answer.text}`, answer.obeyed ? "answer" : "error");
    };
  }

  // A replay cannot be commanded.
  show(_, state) {
    if (!this.possible || state.live === this.live) return;
    this.live = state.live;
    for (const element of this.form.elements) element.disabled = !state.live;
    if (!state.live) say(this.answer, PAST); else this.describe();
  }
}

// Table of the parameters in use, whose values can be changed and loaded as a whole.
export class Parameters {
  constructor(panel, table, commander) {
    const load = table.commands.find(({ name }) => name === "load-parameters");
    this.form = panel.querySelector("form"); this.status = panel.querySelector("p"); this.loaded = null; this.possible = table.commanding;
    const body = panel.querySelector("tbody");
    this.rows = load.inputs.filter(({ field }) => !["crc", "replaced"].includes(field)).map((one) => {
      const [key, meaning] = one.meaning.split(": ");
      const input = new Input({ ...one, name: key });
      input.element.setAttribute("aria-label", key);
      input.element.placeholder = "";
      input.element.readOnly = !table.commanding;
      const line = body.insertRow();
      line.append(make("th", { textContent: key, scope: "row" }));
      for (const cell of [input.element, input.unit, input.range.map((bound) => Number(bound.toPrecision(4))).join(" to "), meaning]) line.insertCell().append(cell);
      labelled(line);
      return { input, field: one.field };
    });
    for (const button of this.form.querySelectorAll("button")) button.hidden = !table.commanding;
    this.form.oninput = () => { const problem = this.problem(); say(this.status, problem, problem ? "error" : ""); };
    this.form.querySelector("[name=dump]").onclick = () => commander.send("dump-parameters", {}, this.status);
    this.form.onsubmit = (event) => {
      event.preventDefault();
      const problem = this.loaded ? this.problem() : "the table in use is not known: read it from the satellite first";
      if (problem) say(this.status, problem, "error");
      else commander.send("load-parameters", { ...Object.fromEntries(this.rows.map((row) => [row.field, this.value(row)])), replaced: this.loaded.crc }, this.status);
    };
  }

  problem() { return this.rows.map(({ input }) => input.problem()).find(Boolean) ?? ""; }

  // A value that was not changed is loaded exactly as it was, without the rounding of its unit.
  value({ input, field }) { return input.element.value === input.filled ? this.loaded[field] : input.read(); }

  show(newest, state) {
    for (const button of this.form.querySelectorAll("button")) button.disabled = !state.live;
    const flown = newest.parameters;
    if (!flown || flown.crc === this.loaded?.crc) return;
    this.loaded = flown;
    for (const { input, field } of this.rows) {
      input.filled = String(plain(flown[field] * input.factor));
      input.element.value = input.filled;
    }
  }
}
