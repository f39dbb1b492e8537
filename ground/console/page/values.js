// Values as they stand: cards of the health, and every field of every packet. States, alarms and limits are the table's.
const KINDS = { warning: "warn", fault: "bad" };

export function fieldOf(table, packet, name) {
  return table.packets.find((each) => each.name === packet)?.fields.find((field) => field.name === name);
}

// The state's name of a number, the number where it has none.
export function label(value, field) { return field?.states?.find(([number]) => number === value)?.[1] ?? String(value); }

export function text(value, field) {
  if (value === null || value === undefined) return "-";
  if (Array.isArray(value)) return value.map((part) => text(part, field)).join("  ");
  if (field?.states) return `${label(value, field)} (${value})`;
  return typeof value === "number" && !Number.isInteger(value) ? value.toPrecision(6).replace(/\.?0+(e|$)/, "$1") : String(value);
}

// How poor a value is by its alarms and limits: "", "warn" or "bad".
export function beyond(value, field) {
  if (typeof value !== "number" || !field) return "";
  const alarm = field.alarms?.find(([number]) => number === value)?.[1];
  const outside = (range) => range?.length && (value < range[0] || value > range[1]);
  return KINDS[alarm] ?? (outside(field.fault_outside) ? "bad" : outside(field.warning_outside) ? "warn" : "");
}

export class Health {
  constructor(place, table) {
    this.place = place;
    const fields = table.packets.find((packet) => packet.name === "health")?.fields ?? [];
    this.streams = fields.filter((field) => field.states?.some(([, name]) => name === "not-fitted"));
  }
  show(newest) {
    const cards = [];
    const { health, housekeeping: supply, link } = newest;
    if (health) for (const field of this.streams) {
      const state = label(health[field.name], field);
      if (state !== "not-fitted") cards.push([field.name, state, beyond(health[field.name], field) || "good"]);
    }
    if (supply) {
      cards.push(["coil supply", `${text(supply.coil_voltage)} V`, ""], ["coil power", supply.coil_power === null ? "-" : `${(1e3 * supply.coil_power).toFixed(1)} mW`, ""]);
    }
    if (health) {
      cards.push(["slots lost", String(health.slips), health.slips > 0 ? "warn" : "good"]);
      cards.push(["processor", health.cpu_share === null ? "-" : `${(100 * health.cpu_share).toFixed(0)} %`, ""]);
      cards.push(["memory", health.resident === null ? "-" : `${(health.resident / 1048576).toFixed(0)} MiB`, ""]);
    }
    if (link) {
      const causes = Object.entries(link).filter(([name, count]) => name.startsWith("refused_") && count > 0);
      const words = causes.map(([name, count]) => `${name.slice("refused_".length)} ${count}`).join(", ");
      cards.push(["frames let in", String(link.admitted), ""], ["frames refused", words || "none", words ? "warn" : "good"]);
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
