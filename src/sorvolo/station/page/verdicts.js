// A person's vote on an object or a change: confirm, reject, not sure, note; votes that differ are shown as disputed, none is overwritten.

import { get, siteUrl } from "./api.js";
import { button, el, fill, quiet } from "./dom.js";
import { say } from "./languages.js";
import { isChange } from "./site_data.js";
import { mayNot } from "./sites.js";
import { votes } from "./votes.js";
import * as words from "./words.js";

/** Give a vote: shown at once, sent in its turn. */
export function judge(screen, feature, verdict, note = null) {
  const kind = isChange(feature) ? "change" : "object";
  votes.add({ site: screen.data.id, kind, id: feature.id, verdict, note: note ?? feature.properties.note ?? "" });
}

/** Who judged it how and when, in a line. */
export function verdictLine(feature) {
  const { review, reviewer, reviewed_at: at, note, review_state: state, waiting } = feature.properties;
  if (!waiting && !review && !note) return el("p.verdict.none", say("Not reviewed yet"));
  return el("p", { class: `verdict ${review || "none"}` }, el("b", words.VERDICTS[review] ?? words.VERDICTS.none),
    waiting ? ` · ${say("waits to be sent")}` : [state === "agreed" ? `, ${say("agreed")}` : "", reviewer ? ` ${say("by {name}", { name: words.nameOf(reviewer) })}` : "", at ? `, ${words.time(at)}` : ""], note ? el("span.remark", ` “${note}”`) : "");
}

/** Buttons and a note for a feature. `given(verdict, note)`: what a button does, if not only to judge. */
export function verdictForm(screen, feature, { keys = false, given = null } = {}) {
  const line = el("div", verdictLine(feature));
  const others = el("ul.plain.votes", { "aria-label": say("Votes") });
  showVotes(screen, feature, others);
  if (!screen.station.reviews) return el("div", line, others, mayNot("reviewer"));
  const note = el("input", { type: "text", maxlength: 2000, placeholder: say("Note"), "aria-label": say("Note"), ".value": feature.properties.note ?? "" });
  const current = feature.properties.review;
  const give = (verdict) => {
    judge(screen, feature, verdict, note.value.trim());
    fill(line, verdictLine(screen.data.find(feature.id) ?? feature));
  };
  note.addEventListener("keydown", (event) => {
    if (event.key === "Enter") { give(null); note.blur(); } // one's own vote stays as it is
    if (event.key === "Escape") note.blur();
    event.stopPropagation();
  });
  const vote = (words, verdict, key, style) => button([words, keys && key ? el("kbd", { "aria-hidden": true }, key) : null],
    () => (given ? given(verdict, note.value.trim()) : give(verdict)), { class: style, "aria-pressed": current === verdict });
  return el("div.verdict-form", line, others,
    el("div.row",
      vote(say("Confirm"), "confirmed", "C", "confirm"), vote(say("Reject"), "rejected", "R", "reject"), vote(say("Not sure"), "unsure", "", "quiet"),
      current ? vote(say("Withdraw"), "none", "U", "quiet") : null),
    el("div.row", note, quiet(say("Save note"), () => give(null))));
}

/** Each person's last vote, where several people voted. */
async function showVotes(screen, feature, list) {
  if (!feature.properties.review && !feature.properties.reviewer) return;
  const query = new URLSearchParams({ kind: isChange(feature) ? "change" : "object", id: feature.id });
  const given = await get(`${siteUrl(screen.data.id, "reviews")}?${query}`).catch(() => []);
  const last = [...new Map(given.reverse().map((each) => [each.who, each])).values()].filter(({ verdict }) => verdict !== "none");
  if (last.length > 1) fill(list, last.map(({ who, verdict, at }) => el("li", el("b", words.nameOf(who)), `: ${words.VERDICTS[verdict] ?? verdict}, ${words.time(at)}`)));
}
