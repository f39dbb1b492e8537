// Values as they stand: cards of the health, and every field of every packet.
const STREAMS = { 0: "-", 1: "never", 2: "stale", 3: "invalid", 4: "slow", 5: "good" };

export function text(value, field) {
  if (value === null || value === undefined) return "-";
  if (Array.isArray(value)) return value.map((part) => text(part, field)).join("  ");
  const label = field?.states?.find(([number]) => number === value)?.[1];
  if (label !== undefined) return `${label} (${value})`;
  return typeof value === "number" && !Number.isInteger(value) ? value.toPrecision(6).replace(/\.?0+(e|$)/, "$1") : String(value);
}

// The worst of a field's limits that its value is beyond: "", "warn" or "bad".
export function beyond(value, field) {
  if (typeof value !== "number" || !field?.limits) return "";
  const out = (range) => range && ((range[0] !== null && value < range[0]) || (range[1] !== null && value > range[1]));
  return out(field.limits.fault) ? "bad" : out(field.limits.warning) ? "warn" : "";
}

export class Health {
  constructor(place, table) {
    this.place = place;
    this.streams = (table.packets.find((packet) => packet.name === "health")?.fields ?? []).filter((field) => ["imu", "field", "coils", "power", "camera"].includes(field.name));
  }
  show(newest) {
    const cards = [];
    const health = newest.health, supply = newest.housekeeping;
    if (health) for (const field of this.streams) {
      const state = health[field.name];
      if (state === 0) continue;
      cards.push([field.name, field.states?.find(([number]) => number === state)?.[1] ?? STREAMS[state] ?? state, state === 5 ? "good" : state === 4 ? "warn" : "bad"]);
    }
    if (supply) {
      cards.push(["coil supply", `${text(supply.coil_voltage)} V`, ""], ["coil power", supply.coil_power === null ? "-" : `${(1e3 * supply.coil_power).toFixed(1)} mW`, ""]);
    }
    if (health) {
      cards.push(["slots lost", String(health.slips), health.slips > 0 ? "warn" : "good"]);
      cards.push(["processor", health.cpu_share === null ? "-" : `${(100 * health.cpu_share).toFixed(0)} %`, ""]);
      cards.push(["memory", health.resident === null ? "-" : `${(health.resident / 1048576).toFixed(0)} MiB`, ""]);
    }
    this.place.replaceChildren(...cards.map(([name, value, kind]) => {
      const card = Object.assign(document.createElement("div"), { className: "card" });
      card.append(Object.assign(document.createElement("span"), { textContent: name }), Object.assign(document.createElement("b"), { textContent: value, className: kind }));
      return card;
    }));
  }
}

export class Packets {
  constructor(place, fold, table) {
    this.fold = fold; this.cells = new Map();
    for (const packet of table.packets) {
      const grid = document.createElement("table");
      const head = grid.createTHead().insertRow();
      head.append(Object.assign(document.createElement("th"), { textContent: packet.name, title: packet.meaning }), Object.assign(document.createElement("th"), { textContent: "never" }));
      for (const field of packet.fields) {
        const line = grid.insertRow();
        line.title = field.meaning;
        line.insertCell().textContent = `${field.name}${field.unit === "-" ? "" : ` [${field.unit}]`}`;
        this.cells.set(`${packet.name}.${field.name}`, [line.insertCell(), field]);
      }
      this.cells.set(packet.name, [head.cells[1], null]);
      place.append(grid);
    }
  }
  show(newest) {
    if (!this.fold.open) return; // nobody looks
    for (const [name, packet] of Object.entries(newest)) {
      this.cells.get(name)[0].textContent = `${(packet.time_ns / 1e9).toFixed(3)} s`;
      for (const [key, value] of Object.entries(packet)) {
        const found = this.cells.get(`${name}.${key}`);
        if (!found) continue;
        found[0].textContent = text(value, found[1]);
        found[0].className = beyond(value, found[1]);
      }
    }
  }
}
