// Elements made in code: whatever comes from outside becomes a text node or an attribute, never markup.

const SVG = "http://www.w3.org/2000/svg";

/** An element. `props`: attributes; `class`; `on` {event: listener}; `data` {name: value}; properties by `.name`. */
export function el(tag, props = {}, ...children) {
  const node = document.createElement(tag);
  for (const [name, value] of Object.entries(props)) set(node, name, value);
  node.append(...flat(children));
  return node;
}

function set(node, name, value) {
  if (value === null || value === undefined || value === false) return;
  if (name === "on") for (const [type, listener] of Object.entries(value)) node.addEventListener(type, listener);
  else if (name === "data") Object.assign(node.dataset, value);
  else if (name.startsWith(".")) node[name.slice(1)] = value;
  else node.setAttribute(name, value === true ? "" : String(value));
}

function flat(children) {
  return children.flat(Infinity).filter((each) => each !== null && each !== undefined && each !== false);
}

/** Put new children in the place of all old ones. */
export function fill(node, ...children) {
  node.replaceChildren(...flat(children));
  return node;
}

/** One of the drawings of icons.svg. */
export function icon(name) {
  const svg = document.createElementNS(SVG, "svg");
  svg.setAttribute("class", "icon");
  svg.setAttribute("aria-hidden", "true");
  const use = document.createElementNS(SVG, "use");
  use.setAttribute("href", `/page/icons.svg#${name}`);
  svg.append(use);
  return svg;
}

/** An SVG element with attributes. */
export function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS(SVG, tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, String(value));
  node.append(...flat(children));
  return node;
}

/** A button with words, and an icon where one is named. */
export function button(words, listener, props = {}) {
  const { icon: drawn, ...rest } = props;
  return el("button", { type: "button", on: { click: listener }, ...rest }, drawn ? icon(drawn) : null,
    el("span", {}, words));
}

let labels = 0;

/** A form control with its label, as one element. */
export function field(words, control, note = "") {
  labels += 1;
  control.id ||= `field-${labels}`;
  return el("div", { class: "field" }, el("label", { for: control.id }, words), control,
    note ? el("p", { class: "note" }, note) : null);
}

/** A choice among [value, words] pairs. */
export function choice(pairs, value, listener, props = {}) {
  return el("select", { ...props, on: { change: (event) => listener(event.target.value) } },
    pairs.map(([each, words]) => el("option", { value: each, ".selected": String(each) === String(value) }, words)));
}

/** A checkbox with its words. */
export function tick(words, checked, listener, props = {}) {
  return el("label", { class: "tick" },
    el("input", { type: "checkbox", ".checked": checked, ...props, on: { change: (event) => listener(event.target.checked) } }),
    words);
}

/** A dialog over the page, closed by Escape or its button; given back open. */
export function dialog(title, ...children) {
  const heading = el("h2", { id: "dialog-title" }, title);
  const box = el("dialog", { "aria-labelledby": "dialog-title" },
    el("div", { class: "dialog-head" }, heading, button("Close", () => box.close(), { class: "quiet", icon: "close" })),
    children);
  box.addEventListener("close", () => box.remove());
  document.body.append(box);
  box.showModal();
  return box;
}

const messages = document.getElementById("messages");
new ResizeObserver(() => document.body.style.setProperty("--said", `${messages.offsetHeight}px`)).observe(messages); // room is made for them: they lie over nothing

/** A message that goes away by itself, or stays until closed where a person must act. */
export function message(words, { kind = "note", todo = "", act = null } = {}) {
  const box = el("div", { class: `message ${kind}` },
    el("div", {}, el("b", {}, words), todo ? el("p", {}, todo) : null),
    act, el("button", { type: "button", class: "quiet", "aria-label": "Close message", on: { click: () => box.remove() } }, icon("close")));
  act?.addEventListener("click", () => box.remove());
  messages.append(box);
  while (messages.children.length > 4) (messages.querySelector(".message:not(.person)") ?? messages.firstElementChild).remove(); // a person found stays
  if (kind === "note") setTimeout(() => box.remove(), 6000);
  return box;
}

/** A problem in words, with what to do. */
export function report(problem) {
  if (problem?.name === "AbortError") return;
  message(problem.title || "This did not work", { kind: `error${problem.status === 0 ? " away" : ""}`, todo: problem.detail || String(problem.message || problem) });
}
