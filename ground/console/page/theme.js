// Light and dark theme. Drawings on a canvas read their colours from the style sheet.
const root = document.documentElement;
let colours = {};

export function colour(name) { return (colours[name] ??= getComputedStyle(root).getPropertyValue(`--${name}`).trim()); }

function use(theme) {
  root.dataset.theme = theme;
  colours = {};
  document.dispatchEvent(new Event("theme"));
}

export function setUpTheme(button) {
  const dark = matchMedia("(prefers-color-scheme: dark)");
  const kept = localStorage.getItem("theme");
  use(kept ?? (dark.matches ? "dark" : "light"));
  dark.onchange = () => { if (!localStorage.getItem("theme")) use(dark.matches ? "dark" : "light"); };
  button.onclick = () => {
    use(root.dataset.theme === "dark" ? "light" : "dark");
    localStorage.setItem("theme", root.dataset.theme);
  };
}
