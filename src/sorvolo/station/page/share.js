// Places handed on: every way to write one, a link, what the device can send by.

import { roomUrl } from "./api.js";
import { button, el, fill } from "./dom.js";
import { numeral, say } from "./languages.js";
import { placeIn } from "./words.js";

export const NOT_COPIED = say("Not copied: the browser forbids it. Write it down, or take a photo of it.");

/** Copy text, also where the page is not secure and the browser has no clipboard for it; whether it was copied. */
export async function copy(text) {
  try {
    await navigator.clipboard.writeText(text);
    return true;
  } catch {
    const box = el("textarea", { ".value": text, readonly: true });
    (document.querySelector("dialog[open]") ?? document.body).append(box);
    box.select();
    const isCopied = document.execCommand("copy");
    box.remove();
    return isCopied;
  }
}

export const placeUrl = (site, place) => `${roomUrl(site, "place")}?at=${place.map((each) => each.toFixed(7)).join(",")}`;

/** Whether the page's address means another device on another device. */
export const isOwn = /^(localhost|127\.|\[::1\])/.test(location.hostname);

/** What is sent of a place: what is there, where, how surely, a link. */
function wordsOf(name, place, sigma_m, link) {
  const lines = [name, ...["latlon", "mgrs", "utm"].map((kind) => placeIn(kind, place))];
  if (sigma_m) lines.push(say("to {sigma} m (1 sigma)", { sigma: numeral(sigma_m, 1) }));
  return [...new Set(lines), `geo:${place[1].toFixed(6)},${place[0].toFixed(6)}`, isOwn ? say("{link} (on this computer alone)", { link }) : link].join("\n");
}

/** Buttons that hand a place on; `name` says what is there. */
export function handover(site, name, place, sigma_m = null) {
  const link = `${location.origin}/${placeUrl(site, place)}`;
  const done = el("span.soft", { role: "status" });
  const give = async (what, text) => {
    const is = await copy(text);
    fill(done, is ? say("{what} copied", { what }) : [NOT_COPIED, el("pre", text)]); // else what was copied before would be sent
  };
  const send = async () => {
    const text = wordsOf(name, place, sigma_m, link);
    if (navigator.share) {
      try {
        await navigator.share({ title: name, text });
        return void fill(done, say("Sent"));
      } catch (error) {
        if (error.name === "AbortError") return;
      }
    }
    await give(say("Place"), text);
  };
  const systems = [["latlon", say("Degrees")], ["dms", say("Degrees, minutes, seconds")], ["utm", "UTM"], ["mgrs", "MGRS"]];
  return el("div.handover",
    el("div.row", button(say("Send place"), send, { class: "main", icon: "export" }), el("a.button", { href: `geo:${place[1].toFixed(6)},${place[0].toFixed(6)}` }, say("Navigate")), done),
    el("details", el("summary", say("Coordinates and link")), el("ul.plain",
      systems.map(([kind, words]) => [words, placeIn(kind, place)]).concat([[say("Link"), link]]).map(([words, text]) =>
        el("li", button(text, () => give(words, text), { class: "link", title: say("{what}: a tap copies it", { what: words }) }))))));
}
