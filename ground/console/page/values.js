// Newest values: cards of the health, and every field of every packet. States, alarms and limits come from the table.
const KINDS = { warning: "warn", fault: "bad" };
const DEGREES = 180 / Math.PI;
const SHOWN = { "-": [1, ""], rad: [DEGREES, "deg"], "rad/s": [DEGREES, "deg/s"], "rad/s^2": [DEGREES, "deg/s²"], T: [1e6, "µT"], W: [1e3, "mW"], B: [1e-6, "MB"], "B/h": [1e-6, "MB/h"], "B/s": [1e-6, "MB/s"], "degree C": [1, "°C"], "deg C": [1, "°C"] };

// The factor from the table's unit to the unit on the page, and the latter.
export function shownUnit(unit) { return SHOWN[unit] ?? [1, unit.replace("^2", "²")]; }

export function rounded(value, digits = 4) { return value === null || value === undefined ? "-" : String(Number(value.toPrecision(digits))); }

export function fieldOf(table, packet, name) {
  return table.packets.find((each) => each.name === packet)?.fields.find((field) => field.name === name);
}

// The state's name of a number, the number where it has none.
export function label(value, field) { return field?.states?.find(([number]) => number === value)?.[1] ?? String(value); }

// The names of the bits that are set; a number of 64 bits is divided, for JavaScript shifts 32.
export function bitsOf(value, field) { return (field?.bits ?? []).filter(([bit]) => Math.floor(value / 2 ** bit) % 2 === 1); }

export function text(value, field) {
  if (value === null || value === undefined) return "-";
  if (field?.bits) return bitsOf(value, field).map(([, name]) => name).join(", ") || "none";
  if (Array.isArray(value)) return value.map((part) => text(part, field)).join("  ");
  if (field?.states) return `${label(value, field)} (${value})`;
  return typeof value === "number" && !Number.isInteger(value) ? value.toPrecision(6).replace(/\.?0+(e|$)/, "$1") : String(value);
}

// How poor a value is by its alarms and limits: "", "warn" or "bad".
export function beyond(value, field) {
  if (Array.isArray(value)) return worst(value.map((part) => beyond(part, field)));
  if (typeof value !== "number" || !field) return "";
  const level = (number) => KINDS[field.alarms?.find(([state]) => state === number)?.[1]] ?? "";
  if (field.bits) return worst(bitsOf(value, field).map(([bit]) => level(bit)));
  const outside = (range) => range?.length && (value < range[0] || value > range[1]);
  return level(value) || (outside(field.fault_outside) ? "bad" : outside(field.warning_outside) ? "warn" : "");
}

function worst(kinds) { return kinds.includes("bad") ? "bad" : kinds.includes("warn") ? "warn" : ""; }

// Description of a field by the table, shown to a pointer.
function meaning(field) {
  const range = (word, bounds) => (bounds?.length ? [`${word} outside ${bounds.join(" to ")}`] : []);
  const states = (field.states ?? []).map(([number, name]) => {
    const level = field.alarms?.find(([state]) => state === number)?.[1];
    return level ? `${name}: ${level}` : name;
  });
  return [field.meaning, ...(states.length ? [states.join(", ")] : []), ...range("warning", field.warning_outside), ...range("fault", field.fault_outside)].join("; ");
}

const HEAT = { meaning: "heat in the coils, resistance times the square of each commanded current, summed over the coils" };

// Heat of the coils in W, or null while currents or resistances are not known. A satellite with three coils reports its
// dipole moment, from which the currents follow.
export function heatOf({ control, coil_currents: many, attitude, run }, { resistance, currents }) {
  const ohms = resistance.length ? resistance : (run?.coil_resistance ?? []);
  const whole = (values) => values?.every((value) => value !== null);
  const amperes = many?.written ?? control?.current_written
    ?? (currents && whole(attitude?.dipole) ? currents.map((row) => row.reduce((sum, part, k) => sum + part * attitude.dipole[k], 0)) : null);
  if (!amperes) return null;
  const parts = amperes.map((current, k) => (current ? (ohms[k] ?? NaN) * current ** 2 : 0));
  const sum = parts.reduce((total, part) => total + part, 0);
  return Number.isFinite(sum) ? sum : null;
}

// Cards of the measured health, coloured by the table; the findings of the monitors; and every value of a periodic
// packet that lies beyond its limits.
export class Health {
  constructor(place, table) {
    this.place = place; this.table = table;
    this.fields = new Map(table.packets.filter((packet) => packet.rate.includes("Hz")).flatMap((packet) => packet.fields.map((field) => [`${packet.name}.${field.name}`, field])));
    this.judged = [...this.fields].filter(([, field]) => field.alarms || field.warning_outside || field.fault_outside);
    this.streams = this.judged.filter(([key, field]) => key.startsWith("health.") && field.states?.some(([, name]) => name === "not-fitted"));
  }

  show(newest) {
    const { health, housekeeping: supply, link } = newest;
    const heat = heatOf(newest, this.table);
    const value = (key) => { const [packet, name] = key.split("."); return newest[packet]?.[name]; };
    const cards = [];
    const add = (name, words, kind, field) => cards.push([name, words, kind, field ? meaning(field) : ""]);
    const number = (name, key, scale, digits, unit) => {
      const [found, field] = [value(key), this.fields.get(key)];
      if (found !== null && found !== undefined) add(name, `${(scale * found).toFixed(digits)} ${unit}`, beyond(found, field), field);
    };
    for (const [key, field] of health ? this.streams : []) {
      const state = label(value(key), field);
      if (state !== "not-fitted") add(field.name, state, beyond(value(key), field) || (state === "good" ? "good" : ""), field);
    }
    if (health) {
      const field = this.fields.get("health.facts");
      add("conditions", bitsOf(health.facts, field).length ? text(health.facts, field) : "none", beyond(health.facts, field) || "good");
      const wrong = this.judged.filter(([key, each]) => key !== "health.facts" && !this.streams.some(([other]) => other === key) && beyond(value(key), each));
      const poor = worst(wrong.map(([key, each]) => beyond(value(key), each)));
      add("beyond limits", wrong.map(([key, each]) => `${key} ${Array.isArray(value(key)) ? text(value(key), each) : label(value(key), each)}`).join(", ") || "nothing", poor || "good");
      add("coils in use", text(health.coils_in_use, this.fields.get("health.coils_in_use")), "", this.fields.get("health.coils_in_use"));
      add("slots skipped", String(health.slips), health.slips > 0 ? "warn" : "good", this.fields.get("health.slips"));
    }
    if (heat !== null) add("coil heat (R I²)", `${(1e3 * heat).toFixed(1)} mW`, "", HEAT);
    if (supply) {
      number("coil bus voltage", "housekeeping.coil_voltage", 1, 2, "V");
      number("coil bus power", "housekeeping.coil_power", 1e3, 1, "mW");
      add("records lost", String(supply.records_lost), supply.records_lost > 0 ? "warn" : "good", this.fields.get("housekeeping.records_lost"));
    }
    number("processor", "health.cpu_share", 100, 0, "%");
    number("memory", "health.resident", 1 / 1048576, 0, "MiB");
    number("disk free", "health.disk_free", 1e-9, 1, "GB");
    number("warmest", "health.temperature", 1, 1, "°C");
    if (link) {
      const causes = Object.entries(link).filter(([name, count]) => name.startsWith("refused_") && count > 0);
      const words = causes.map(([name, count]) => `${name.slice("refused_".length)} ${count}`).join(", ");
      add("accepted frames", String(link.admitted), "");
      add("frames refused", words || "none", words ? "warn" : "good");
    }
    this.draw(cards);
  }

  // A card is made once, because a new one ten times a second would never show its meaning to a pointer.
  draw(cards) {
    const names = cards.map(([name]) => name).join();
    if (names !== this.drawn) {
      this.drawn = names;
      this.place.replaceChildren(...cards.map(([name]) => {
        const card = Object.assign(document.createElement("div"), { className: "card" });
        card.append(Object.assign(document.createElement("span"), { textContent: name }), document.createElement("b"));
        return card;
      }));
    }
    cards.forEach(([, words, kind, title], k) => {
      const card = this.place.children[k];
      card.title = title;
      card.classList.toggle("wide", words.length > 18);
      Object.assign(card.lastChild, { textContent: words, className: kind });
    });
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
    if (!this.fold.open) return; // the panel is closed
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
