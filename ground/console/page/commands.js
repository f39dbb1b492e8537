// Forms made from the command table; nothing is sent before its words were confirmed.
export class CommandForms {
  constructor(place, note, dialog, table) {
    this.buttons = []; this.tables = []; this.possible = table.commanding; this.note = note;
    note.textContent = table.commanding ? "" : "This console only looks. Start it with --to SOCKET to command.";
    if (!table.commanding) return;
    for (const command of table.commands) place.append(this.form(command, dialog, table.name));
  }

  // The past cannot be commanded, and who looks at it should not try.
  show(newest, state) {
    for (const fill of this.tables) fill(newest);
    for (const button of this.buttons) button.disabled = !state.live;
    if (this.possible) this.note.textContent = state.live ? "" : "You look at the past: press live to command.";
  }

  form(command, dialog, flight) {
    const form = Object.assign(document.createElement("form"), { className: "command" });
    form.append(Object.assign(document.createElement("b"), { textContent: command.name }));
    const table = command.name === "load-parameters";
    const place = table ? form.appendChild(document.createElement("details")) : form;
    if (table) place.append(Object.assign(document.createElement("summary"), { textContent: "the table that flies, to be changed" }));
    const inputs = command.fields.map((field) => this.input(place, field));
    if (table) this.tables.push(filling(command.fields, [...place.querySelectorAll("input")]));
    const button = Object.assign(document.createElement("button"), { textContent: "send ..." });
    const result = document.createElement("p");
    result.textContent = command.meaning;
    if (command.hazard) form.append(Object.assign(document.createElement("i"), { textContent: "!", title: `hazard: ${command.hazard}` }));
    form.append(button, result);
    this.buttons.push(button);
    form.onsubmit = async (event) => {
      event.preventDefault();
      const body = JSON.stringify({ command: command.name, values: Object.fromEntries(command.fields.map((field, k) => [field.name, inputs[k]()])) });
      const checked = await ask("/api/words", body);
      if (checked.error) return say(result, checked.error, "error");
      dialog.querySelector("#whom").textContent = flight;
      dialog.querySelector("#words").textContent = checked.words;
      dialog.querySelector("#hazard").hidden = !command.hazard;
      dialog.querySelector("#hazard").textContent = command.hazard ?? "";
      dialog.returnValue = "cancel";
      dialog.showModal();
      dialog.onclose = async () => {
        if (dialog.returnValue !== "send") return;
        say(result, "sent ...", "");
        const answer = await ask("/api/command", body);
        say(result, answer.error ?? `${answer.obeyed ? "obeyed" : "refused"}: ${answer.text}`, answer.obeyed ? "answer" : "error");
      };
    };
    return form;
  }

  input(form, field) {
    const label = Object.assign(document.createElement("label"), { textContent: `${field.name} `, title: `${field.meaning} [${field.unit}]${field.valid ? `, ${field.valid[0]} to ${field.valid[1]}` : ""}` });
    if (field.states) {
      const choice = document.createElement("select");
      for (const [number, name] of field.states) choice.append(new Option(name, number));
      label.append(choice); form.append(label);
      return () => Number(choice.value);
    }
    const hint = field.count > 1 ? "a, b, ..." : field.valid ? `${rounded(field.valid[0])} to ${rounded(field.valid[1])}` : field.unit === "-" ? "" : field.unit;
    const input = Object.assign(document.createElement("input"), { type: "text", placeholder: hint });
    input.classList.toggle("long", field.count > 1 || field.type.startsWith("S"));
    label.append(input); form.append(label);
    if (field.type.startsWith("S")) return () => input.value;
    const numbers = () => input.value.split(/[\s,]+/).filter((word) => word !== "");
    return () => (field.count > 1 ? numbers() : numbers()[0] ?? null);
  }
}

// Fills the form of the parameters with the table that flies, whenever another one does; the console reckons the CRC.
function filling(fields, inputs) {
  let filled = null;
  fields.forEach((field, k) => { inputs[k].parentElement.hidden = field.name === "crc" || field.name === "replaced"; });
  return (newest) => {
    const flown = newest.parameters;
    if (!flown || flown.crc === filled) return;
    filled = flown.crc;
    fields.forEach((field, k) => { inputs[k].value = field.name === "replaced" ? flown.crc : field.name === "crc" ? "" : flown[field.name]; });
  };
}

async function ask(path, body) {
  try {
    return await (await fetch(path, { method: "POST", body, headers: { "Content-Type": "application/json" } })).json();
  } catch { return { error: "the console does not answer" }; }
}
const rounded = (bound) => String(Number(bound.toPrecision(4)));
function say(place, words, kind) { place.textContent = words; place.className = kind; }
