// A person's verdict on an object, a change or what a watch found: confirm, reject, note; another's verdict meanwhile is shown, not overwritten.

import { post, siteUrl } from "./api.js";
import { button, el, fill, message } from "./dom.js";
import { isChange } from "./site_data.js";
import * as words from "./words.js";

/** Send a verdict; gives whether it was taken. */
export async function judge(screen, feature, verdict, note = null) {
  const values = feature.properties;
  const kind = isChange(feature) ? "change" : values.watched ? "finding" : "object";
  try {
    const made = await post(siteUrl(screen.data.id, "reviews"),
      { kind, id: feature.id, verdict, note: note ?? values.note ?? "", revision: values.revision ?? 0 });
    screen.data.judge(made);
    return true;
  } catch (problem) {
    if (problem.status !== 409) {
      message(problem.title, { kind: "error", todo: problem.detail });
      return false;
    }
    const theirs = problem.more.current;
    if (theirs) screen.data.judge(theirs);
    else Object.assign(values, { review: null, revision: 0 });
    message(theirs ? `${theirs.who} was quicker: ${wordsOf(theirs.verdict)}${theirs.note ? `, “${theirs.note}”` : ""}` : "The verdict was withdrawn meanwhile",
      { kind: "warning", todo: "Yours was not saved. Look at it, and give it again if you still want to." });
    return false;
  }
}

const wordsOf = (verdict) => (verdict === "none" || !verdict ? "no verdict" : verdict);

/** Who judged it how and when, in a line. */
export function verdictLine(feature) {
  const { review, reviewer, reviewed_at: at, note } = feature.properties;
  if (!review && !note) return el("p", { class: "verdict none" }, "Not reviewed yet");
  return el("p", { class: `verdict ${review || "none"}` }, el("b", {}, wordsOf(review)),
    reviewer ? ` by ${reviewer}` : "", at ? `, ${words.time(at)}` : "", note ? el("span", { class: "remark" }, ` “${note}”`) : "");
}

/** Buttons and a note for a feature. */
export function verdictForm(screen, feature, { keys = false } = {}) {
  const may = screen.station.status.role !== "view";
  const line = el("div", {}, verdictLine(feature));
  if (!may) return el("div", {}, line, el("p", { class: "note" }, "Your token may look, not review."));
  const note = el("input", { type: "text", maxlength: 2000, placeholder: "Note", "aria-label": "Note", ".value": feature.properties.note ?? "" });
  const current = feature.properties.review;
  const give = async (verdict) => {
    await judge(screen, feature, verdict, note.value.trim());
    fill(line, verdictLine(screen.data.find(feature.id) ?? feature));
  };
  note.addEventListener("keydown", (event) => {
    if (event.key === "Enter") { give(feature.properties.review ?? "none"); note.blur(); }
    if (event.key === "Escape") note.blur();
    event.stopPropagation();
  });
  const hint = (key) => (keys ? el("kbd", { "aria-hidden": true }, key) : null);
  return el("div", { class: "verdict-form" }, line,
    el("div", { class: "row" },
      el("button", { type: "button", class: "confirm", "aria-pressed": String(current === "confirmed"), on: { click: () => give("confirmed") } }, "Confirm", hint("C")),
      el("button", { type: "button", class: "reject", "aria-pressed": String(current === "rejected"), on: { click: () => give("rejected") } }, "Reject", hint("R")),
      current ? el("button", { type: "button", class: "quiet", on: { click: () => give("none") } }, "Take back", hint("U")) : null),
    el("div", { class: "row" }, note, button("Save note", () => give(feature.properties.review ?? "none"), { class: "quiet" })));
}
