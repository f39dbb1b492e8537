// Lists that grow: events with filters, frames with the results of vision, commands and their answers.
import { beyond, bitsOf, label } from "/page/values.js";

const MOST_ROWS = 500;
const MOST_ITEMS = 200; // events kept of one line
const GAP_S = 60; // longest time between events of one line

function row(cells, kind = "", packet = null) {
  const line = document.createElement("tr");
  line.className = kind;
  for (const cell of cells) line.append(Object.assign(document.createElement("td"), { textContent: cell }));
  line.firstChild.className = "t";
  if (packet) line.firstChild.title = utc(packet);
  return line;
}
let zero = null; // UTC of mission time zero, ms since 1970, or null while it is unknown
export function setZero(milliseconds) { zero = milliseconds; }
function utc(packet) {
  const date = new Date(zero === null ? NaN : zero + packet.time_ns / 1e6);
  return Number.isFinite(date.getTime()) ? `${date.toISOString().slice(0, 19)}Z` : ""; // a damaged log may have any time
}
const seconds = (packet) => `${(packet.time_ns / 1e9).toFixed(1)}`;

class Rows {
  constructor(table) { Object.assign(this, { table, body: table.tBodies[0], kept: [], older: 0 }); }
  clear() { this.body.replaceChildren(); this.table.deleteCaption(); this.kept = []; this.older = 0; }
  add(line) { this.body.prepend(line); while (this.body.rows.length > MOST_ROWS) { this.body.lastChild.remove(); this.omit(1); } }
  // The page must not look as if the flight began with its oldest row.
  omit(count = 0) {
    this.older += count;
    if (count) this.table.createCaption().textContent = `${this.older} older entries are not shown; knightcube export writes all`;
  }
}

// Events of one cause as one line with begin and end. An event that ends a condition closes the line of its begin, and
// an event that recurs within GAP_S extends its line.
export class Events extends Rows {
  constructor(table, severity, filter, field, endings, facts) {
    super(table);
    Object.assign(this, { severity, filter, field, endings, facts, begins: new Set(Object.values(endings).flat()), open: new Map() });
    severity.onchange = filter.oninput = () => { for (const episode of this.kept) this.hide(episode); };
  }

  show(newest, { omitted }, listed, again) {
    if (again) { this.clear(); this.open.clear(); }
    this.omit(omitted.event);
    const touched = new Set((listed.event ?? []).map((event) => this.take(event)));
    if (newest.health) for (const episode of this.endedBy(newest.health)) touched.add(episode);
    for (const episode of touched) this.draw(episode);
  }

  // The rate limit may suppress the event that ends a condition. The health packet then shows that it is over.
  endedBy(health) {
    const holding = new Set(bitsOf(health.facts, this.facts).map(([, name]) => name));
    const over = [...this.open.values()].filter(({ name, end }) => this.begins.has(name) && end < health.time_ns
      && this.facts.bits.some(([, fact]) => fact === name) && !holding.has(name));
    for (const episode of over) {
      Object.assign(episode, { end: health.time_ns, ended: true });
      this.open.delete(episode.key);
    }
    return over;
  }

  take(event) {
    const closed = this.closedBy(event);
    if (closed) {
      Object.assign(closed, { end: event.time_ns, ended: true });
      closed.events.push(event);
      this.open.delete(closed.key);
      return closed;
    }
    const key = this.keyOf(event);
    let episode = this.open.get(key);
    if (!episode || (!this.begins.has(event.name) && event.time_ns - episode.end > GAP_S * 1e9)) {
      episode = { key, name: event.name, severity: event.severity, begin: event.time_ns, count: 0, events: [], ended: false };
      this.open.set(key, episode);
      this.kept.push(episode);
      if (this.kept.length > MOST_ROWS) this.kept.shift();
    }
    episode.end = event.time_ns;
    episode.severity = Math.max(episode.severity, event.severity);
    episode.count += 1 + event.suppressed;
    episode.events.push(event);
    if (episode.events.length > MOST_ITEMS) episode.events.splice(1, 1);
    return episode;
  }

  // Conditions with the same events, such as those of several streams, differ in the first word of the text.
  keyOf(event) { return this.begins.has(event.name) ? `${event.name} ${subject(event)}` : event.name; }

  closedBy(event) {
    const candidates = [...this.open.values()].filter(({ name }) => this.endings[event.name]?.includes(name));
    return candidates.find(({ events }) => subject(events[0]) === subject(event)) ?? candidates.at(-1);
  }

  draw(episode) {
    const { name, count, events, begin, end, ended, severity } = episode;
    const open = !ended && this.begins.has(name);
    const last = events.at(-1);
    const title = `${name}${count > 1 ? ` × ${count}` : ""}: ${ended && last.name !== name ? `${events[0].text}; ${last.name}: ${last.text}` : last.text}`;
    const cells = [seconds({ time_ns: begin }), open ? "open" : end > begin || ended ? seconds({ time_ns: end }) : "", label(severity, this.field), title];
    if (!episode.line) {
      episode.line = row(cells, beyond(severity, this.field), { time_ns: begin });
      this.add(episode.line);
    }
    episode.line.className = open || !ended ? beyond(severity, this.field) : "";
    cells.slice(0, 3).forEach((text, k) => { episode.line.cells[k].textContent = text; });
    if (events.length > 1) this.unfold(episode, title); else episode.line.cells[3].textContent = title;
    this.hide(episode);
  }

  unfold(episode, title) {
    const cell = episode.line.cells[3];
    let fold = cell.querySelector("details");
    if (!fold) {
      fold = document.createElement("details");
      fold.append(document.createElement("summary"), document.createElement("div"));
      fold.ontoggle = () => this.list(episode, fold);
      cell.replaceChildren(fold);
    }
    fold.firstChild.textContent = title;
    this.list(episode, fold);
  }

  list({ events }, fold) {
    if (fold.open) fold.lastChild.replaceChildren(...events.map((event) => Object.assign(document.createElement("div"), { textContent: `${seconds(event)} ${event.name}: ${event.text}` })));
  }

  hide({ line, severity, events }) {
    const wanted = this.filter.value.toLowerCase();
    line.hidden = severity < Number(this.severity.value) || !events.some((event) => `${event.name} ${event.text}`.toLowerCase().includes(wanted));
  }
}
const subject = (event) => event.text.split(/[ :]/)[0];

export class Frames extends Rows {
  show(_, { omitted }, listed, again) {
    if (again) { this.clear(); this.lines = new Map(); }
    this.omit(omitted.streak ?? omitted.stars);
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
  // The packets of one frame have its number and share one line.
  line(frame) {
    const known = this.lines.get(frame.sequence);
    if (known?.isConnected) return known;
    const line = row([seconds(frame), "", "", "", "", "", ""], "", frame);
    line.tabIndex = 0;
    line.dataset.sequence = frame.sequence;
    this.lines.set(frame.sequence, line);
    this.add(line);
    return line;
  }
}

// Commands that reached the flight, and by a link each stage of a command with its counter.
export class History extends Rows {
  constructor(table, stage) { super(table); this.stage = stage; }
  show(_, { omitted }, listed, again) {
    if (again) this.clear();
    this.omit((omitted.command ?? 0) + (omitted.verification ?? 0));
    for (const command of listed.command ?? []) {
      this.add(row([seconds(command), command.source, command.obeyed ? "executed" : "refused", command.text], command.obeyed ? "" : "warn", command));
    }
    for (const step of listed.verification ?? []) {
      const name = label(step.stage, this.stage);
      this.add(row([seconds(step), `link ${step.spi}:${step.counter}`, name, step.text], ["refused", "failed", "repeated"].includes(name) ? "warn" : "", step));
    }
  }
}
