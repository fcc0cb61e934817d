// What a person chose for this browser: units, coordinates, theme, what the map shows. Kept by the browser.

const KEY = "sorvolo-choices";
const FIRST = {
  units: "metric", coordinates: "latlon", theme: "auto", language: "auto", clock: "local", sound: true, holdForBoxes: false,
  layers: {},
};

/** Text that the browser keeps, null to forget it; a private window may keep nothing. */
const storeIn = (place) => ({
  get(key) {
    try { return place().getItem(key); } catch { return null; }
  },
  /** Whether it is kept. */
  set(key, text) {
    try {
      if (text === null) place().removeItem(key);
      else place().setItem(key, text);
      return true;
    } catch { return false; }
  },
});
export const stored = storeIn(() => localStorage);
/** As long as the tab is open. */
export const tab = storeIn(() => sessionStorage);

/** A list that the browser keeps; where it keeps nothing, as long as the page, which then does not close without a question. */
export class KeptList {
  constructor(key) {
    Object.assign(this, { key, memory: [], isFull: false });
    addEventListener("beforeunload", (event) => { if (this.isFull && this.memory.length) event.preventDefault(); });
  }

  get all() {
    if (this.isFull) return this.memory;
    try {
      return JSON.parse(stored.get(this.key)) ?? [];
    } catch { return this.memory; }
  }

  keep(list) {
    this.memory = list;
    this.isFull = !stored.set(this.key, JSON.stringify(list));
  }
}

class Choices extends EventTarget {
  constructor() {
    super();
    this.all = { ...FIRST };
    try {
      Object.assign(this.all, JSON.parse(stored.get(KEY)));
    } catch { /* something else is kept there: begin anew */ }
  }

  get(name) {
    return this.all[name];
  }

  set(name, value) {
    this.all[name] = value;
    stored.set(KEY, JSON.stringify(this.all));
    this.dispatchEvent(new CustomEvent("change", { detail: name }));
  }
}

export const choices = new Choices();

export function applyTheme() {
  document.documentElement.dataset.theme = choices.get("theme");
}

export function isDark() {
  const theme = choices.get("theme");
  return theme === "dark" || (theme === "auto" && matchMedia("(prefers-color-scheme: dark)").matches);
}
