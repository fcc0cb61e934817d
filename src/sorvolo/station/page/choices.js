// What a person chose for this browser: units, coordinates, theme, what the map shows. Kept by the browser.

const KEY = "sorvolo-choices";
const FIRST = {
  units: "metric", coordinates: "latlon", theme: "auto", clock: "local", sound: true, holdForBoxes: false,
  layers: {},
};

class Choices extends EventTarget {
  constructor() {
    super();
    let kept = {};
    try {
      kept = JSON.parse(localStorage.getItem(KEY) || "{}");
    } catch { /* a browser without storage, or with something else in it: begin anew */ }
    this.all = { ...FIRST, ...kept };
  }

  get(name) {
    return this.all[name];
  }

  set(name, value) {
    this.all[name] = value;
    try {
      localStorage.setItem(KEY, JSON.stringify(this.all));
    } catch { /* private windows may refuse; the choice then lasts as long as the page */ }
    this.dispatchEvent(new CustomEvent("change", { detail: name }));
  }
}

export const choices = new Choices();

/** Let the page's colours follow the choice. */
export function applyTheme() {
  document.documentElement.dataset.theme = choices.get("theme");
}

/** Whether the page is dark now. */
export function isDark() {
  const theme = choices.get("theme");
  return theme === "dark" || (theme === "auto" && matchMedia("(prefers-color-scheme: dark)").matches);
}
