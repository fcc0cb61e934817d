// Elements made in code: whatever comes from outside becomes a text node or an attribute, never markup.

import { say } from "./languages.js";

/** An element, as "p.note" names its tag and classes. `props`, if any: attributes; `on` {event: listener}; `data` {name: value}; properties by `.name`. */
export function el(name, ...children) {
  const [tag, ...classes] = name.split(".");
  const node = document.createElement(tag);
  node.classList.add(...classes);
  if (children[0]?.constructor === Object) for (const [each, value] of Object.entries(children.shift())) set(node, each, value);
  node.append(...flat(children));
  return node;
}

function set(node, name, value) {
  if (value === null || value === undefined) return;
  if (name === "on") for (const [type, listener] of Object.entries(value)) node.addEventListener(type, listener);
  else if (name === "data") Object.assign(node.dataset, value);
  else if (name.startsWith(".")) node[name.slice(1)] = value;
  else if (typeof value === "boolean" && !name.startsWith("aria-")) node.toggleAttribute(name, value);
  else node.setAttribute(name, value);
}

function flat(children) {
  return children.flat(Infinity).filter((each) => each !== null && each !== undefined && each !== false);
}

export function fill(node, ...children) {
  node.replaceChildren(...flat(children));
  return node;
}

export function svg(tag, attributes = {}, ...children) {
  const node = document.createElementNS("http://www.w3.org/2000/svg", tag);
  for (const [name, value] of Object.entries(attributes)) node.setAttribute(name, value);
  node.append(...flat(children));
  return node;
}

export const icon = (name) => svg("svg", { class: "icon", "aria-hidden": true }, svg("use", { href: `/page/icons.svg#${name}` }));

/** A button with what is on it, and an icon where one is named. */
export function button(words, listener, { icon: drawn, ...props } = {}) {
  return el("button", { type: "button", on: { click: listener }, ...props }, drawn ? [icon(drawn), words ? el("span", words) : null] : words);
}

export const quiet = (words, listener, props) => button(words, listener, { class: "quiet", ...props });

/** A quiet button that takes something away. */
export const cross = (words, listener) => button("×", listener, { class: "quiet close", "aria-label": words });

/** Let those of some buttons look pressed that are on. */
export function press(buttons, isOn) {
  for (const each of buttons) each.setAttribute("aria-pressed", isOn(each));
}

let labels = 0;

/** A form control with its label, as one element. */
export function field(words, control, note = "") {
  labels += 1;
  control.id ||= `field-${labels}`;
  return el("div.field", el("label", { for: control.id }, words), control,
    note ? el("p.note", note) : null);
}

/** A choice among [value, words] pairs. */
export function choice(pairs, value, listener, props = {}) {
  return el("select", { ...props, on: { change: (event) => listener(event.target.value) } },
    pairs.map(([each, words]) => el("option", { value: each, ".selected": String(each) === String(value) }, words)));
}

export function tick(words, checked, listener, props = {}) {
  return el("label.tick",
    el("input", { type: "checkbox", ".checked": checked, ...props, on: { change: (event) => listener(event.target.checked) } }),
    words);
}

/** A dialog over the page, closed by Escape or its button; given back open. */
export function dialog(title, ...children) {
  const heading = el("h2", { id: "dialog-title" }, title);
  const box = el("dialog", { "aria-labelledby": "dialog-title" },
    el("div.dialog-head", heading, quiet(say("Close"), () => box.close(), { icon: "close" })),
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
    el("div", el("b", words), todo ? el("p", todo) : null),
    act, cross(say("Close message"), () => box.remove()));
  act?.addEventListener("click", () => box.remove());
  messages.append(box);
  while (messages.children.length > 4) (messages.querySelector(".message:not(.person)") ?? messages.firstElementChild).remove(); // a person found stays
  if (kind === "note") setTimeout(() => box.remove(), 6000);
  return box;
}

export function report(problem) {
  if (problem?.name === "AbortError") return;
  message(problem.title || say("This did not work"), { kind: `error${problem.status === 0 ? " away" : ""}`, todo: problem.detail || String(problem.message || problem) });
}
