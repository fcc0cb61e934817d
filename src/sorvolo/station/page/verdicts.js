// A person's verdict on an object, a change or what a watch found: confirm, reject, note; another's verdict meanwhile is shown, not overwritten.

import { post, siteUrl } from "./api.js";
import { button, el, fill, message } from "./dom.js";
import { isChange } from "./site_data.js";
import * as words from "./words.js";

const sending = new Map(); // by feature's id: the revision that the verdict before this one will have made, null if it was not taken

/** Send a verdict; gives whether it was taken. One given before the last one was answered follows it. */
export async function judge(screen, feature, verdict, note = null) {
  const seen = feature.properties.revision ?? 0;
  const sent = (sending.get(feature.id) ?? Promise.resolve(null)).then((mine) => send(screen, feature, verdict, note, Math.max(seen, mine ?? 0)));
  sending.set(feature.id, sent);
  const revision = await sent;
  if (sending.get(feature.id) === sent) sending.delete(feature.id);
  return revision !== null;
}

async function send(screen, feature, verdict, note, revision) {
  const values = feature.properties;
  const kind = isChange(feature) ? "change" : values.watched ? "finding" : "object";
  const act = screen.opened?.see ? button("Show it", () => screen.opened?.see?.(feature)) : null; // the gallery has moved on
  try {
    const made = await post(siteUrl(screen.data.id, "reviews"), { kind, id: feature.id, verdict, note: note ?? values.note ?? "", revision });
    screen.data.judge(made);
    return made.revision;
  } catch (problem) {
    if (problem.status !== 409) {
      message(problem.title, { kind: "error", todo: problem.detail, act });
      return null;
    }
    const theirs = problem.more.current;
    if (theirs) screen.data.judge(theirs);
    else Object.assign(values, { review: null, revision: 0 });
    message(theirs ? `${theirs.who} was quicker: ${wordsOf(theirs.verdict)}${theirs.note ? `, “${theirs.note}”` : ""}` : "The verdict was withdrawn meanwhile",
      { kind: "warning", todo: "Yours was not saved. Look at it, and give it again if you still want to.", act });
    return null;
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

/** Buttons and a note for a feature. `given(verdict, note)`: what a button does, if not only to judge. */
export function verdictForm(screen, feature, { keys = false, given = null } = {}) {
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
  const press = (verdict) => (given ? given(verdict, note.value.trim()) : give(verdict));
  const hint = (key) => (keys ? el("kbd", { "aria-hidden": true }, key) : null);
  return el("div", { class: "verdict-form" }, line,
    el("div", { class: "row" },
      el("button", { type: "button", class: "confirm", "aria-pressed": String(current === "confirmed"), on: { click: () => press("confirmed") } }, "Confirm", hint("C")),
      el("button", { type: "button", class: "reject", "aria-pressed": String(current === "rejected"), on: { click: () => press("rejected") } }, "Reject", hint("R")),
      current ? el("button", { type: "button", class: "quiet", on: { click: () => press("none") } }, "Withdraw", hint("U")) : null),
    el("div", { class: "row" }, note, button("Save note", () => give(feature.properties.review ?? "none"), { class: "quiet" })));
}
