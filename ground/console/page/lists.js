// Lists that grow: events with filters, frames with what was found in them, commands and their answers.
import { beyond, label } from "/page/values.js";

const MOST_ROWS = 500;

function row(cells, kind = "") {
  const line = document.createElement("tr");
  line.className = kind;
  for (const cell of cells) line.append(Object.assign(document.createElement("td"), { textContent: cell }));
  line.firstChild.className = "t";
  return line;
}
const seconds = (packet) => `${(packet.time_ns / 1e9).toFixed(1)}`;

class Rows {
  constructor(table) { this.body = table.tBodies[0]; this.kept = []; }
  clear() { this.body.replaceChildren(); this.kept = []; }
  add(line) { this.body.prepend(line); while (this.body.rows.length > MOST_ROWS) this.body.lastChild.remove(); }
}

export class Events extends Rows {
  constructor(table, severity, filter, field) {
    super(table);
    this.severity = severity; this.filter = filter; this.field = field;
    severity.onchange = filter.oninput = () => { this.body.replaceChildren(); this.kept.forEach((event) => this.list(event)); };
  }
  show(_, __, listed, again) {
    if (again) this.clear();
    for (const event of listed.event ?? []) { this.kept.push(event); this.list(event); }
    this.kept = this.kept.slice(-5 * MOST_ROWS);
  }
  list(event) {
    const words = `${event.name} ${event.text}`;
    if (event.severity < Number(this.severity.value) || !words.toLowerCase().includes(this.filter.value.toLowerCase())) return;
    this.add(row([seconds(event), label(event.severity, this.field), `${event.name}: ${event.text}`], beyond(event.severity, this.field)));
  }
}

export class Frames extends Rows {
  show(_, __, listed, again) {
    if (again) { this.clear(); this.lines = new Map(); }
    for (const frame of listed.streak ?? []) {
      const rate = frame.rate.every((part) => part !== null) ? `${(180 / Math.PI * Math.hypot(...frame.rate)).toFixed(3)} deg/s` : frame.status;
      const line = this.line(frame);
      line.cells[1].textContent = `${frame.used} of ${frame.streaks}`;
      line.cells[2].textContent = frame.length?.toFixed(0) ?? "-";
      line.cells[3].textContent = `${rate}${frame.accepted ? " ✓" : ""}`;
    }
    for (const frame of listed.stars ?? []) {
      const line = this.line(frame);
      line.cells[4].textContent = `${frame.matched} of ${frame.found}`;
      line.cells[5].textContent = `${frame.status}${frame.accepted ? " ✓" : ""}`;
    }
    for (const frame of listed.sightings ?? []) this.line(frame).cells[6].textContent = String(frame.found);
  }
  // Vision's results come as a packet of each kind; those of a frame share its number and a line.
  line(frame) {
    const known = this.lines.get(frame.sequence);
    if (known?.isConnected) return known;
    const line = row([seconds(frame), "", "", "", "", "", ""]);
    line.dataset.sequence = frame.sequence;
    this.lines.set(frame.sequence, line);
    this.add(line);
    return line;
  }
}

// Commands that reached the flight, and by a link each stage of a command with its counter.
export class History extends Rows {
  constructor(table, stage) { super(table); this.stage = stage; }
  show(_, __, listed, again) {
    if (again) this.clear();
    for (const command of listed.command ?? []) {
      this.add(row([seconds(command), command.source, command.obeyed ? "obeyed" : "refused", command.text], command.obeyed ? "" : "warn"));
    }
    for (const step of listed.verification ?? []) {
      const name = label(step.stage, this.stage);
      this.add(row([seconds(step), `link ${step.spi}:${step.counter}`, name, step.text], ["refused", "failed", "repeated"].includes(name) ? "warn" : ""));
    }
  }
}
