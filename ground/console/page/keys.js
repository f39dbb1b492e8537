// Keyboard: one key for each common action. Keys do nothing while a form has the focus.
const FORMS = "input, select, textarea, dialog, [contenteditable]";

export function setUpKeys(dialog, button, actions) {
  const rows = dialog.querySelector("tbody");
  for (const [key, meaning] of [...actions.map(([key, meaning]) => [key === " " ? "space" : key, meaning]), ["?", "show these keys"]]) {
    const line = rows.insertRow();
    line.append(Object.assign(document.createElement("th"), { textContent: key, scope: "row" }));
    line.insertCell().textContent = meaning;
  }
  button.onclick = () => dialog.showModal();
  document.addEventListener("keydown", (event) => {
    if (event.ctrlKey || event.altKey || event.metaKey || event.target.closest(FORMS)) return;
    if (event.target.id === "attitude" && event.key.startsWith("Arrow")) return;
    if (event.key === " " && event.target.closest("button, summary")) return;
    const action = event.key === "?" ? button.onclick : actions.find(([key]) => key === event.key)?.[2];
    if (!action) return;
    event.preventDefault();
    action(event);
  });
}
