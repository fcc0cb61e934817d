// The card of the object or change that is chosen: pictures, facts, verdict.

import { choices } from "./choices.js";
import { button, cross, el, fill, quiet } from "./dom.js";
import { say } from "./languages.js";
import { CLASSES, KINDS, OTHER_CLASS } from "./map_style.js";
import { middleOf } from "./places.js";
import { handover } from "./share.js";
import { verdictForm } from "./verdicts.js";
import { cropsOf, isChange } from "./site_data.js";
import * as words from "./words.js";

const SHOWN_IN = new Set(["live", "layers", "compare", "place"]); // elsewhere the map is needed whole

/** The card over the map; `show(feature)`, null hides it. */
export function featureCard(screen) {
  const box = el("aside.card-over", { hidden: true, "aria-label": say("What is chosen") });
  screen.stage.append(box);
  let told = "";
  return {
    show(feature) {
      const state = JSON.stringify([feature, screen.shown, choices.all]);
      if (state === told) return; // what a person is about to press stays under the finger
      const isHidden = !feature || !SHOWN_IN.has(screen.shown);
      if (!isHidden && !box.hidden && isWritten(box) && box.dataset.id === String(feature.id)) return;
      told = state;
      box.hidden = isHidden;
      box.dataset.id = feature?.id ?? "";
      if (isHidden) return;
      if (box.dataset.of !== String(feature.id)) box.classList.remove("whole");
      box.dataset.of = feature.id;
      fill(box, cardOf(screen, feature, box));
      requestAnimationFrame(() => { if (!screen.closed) screen.view?.reveal(middleOf(feature.geometry)); });
    },
  };
}

/** Whether a note is being written in it: that is not to vanish under the hands when something else changes. */
export const isWritten = (node) => node.contains(document.activeElement) && document.activeElement.matches("input");

function cardOf(screen, feature, box) {
  const place = middleOf(feature.geometry);
  return [
    el("div.card-head", badge(feature), el("h3", titleOf(feature)),
      button(say("More"), () => { box.classList.toggle("whole"); screen.view?.reveal(place); }, { class: "quiet only-phone" }),
      cross(say("Close"), () => screen.data.choose(null))),
    screen.data.detail.is_local ? null : handover(screen.data.id, titleOf(feature), place, feature.properties.sigma_m),
    pictures(feature),
    verdictForm(screen, feature),
    facts(feature, screen.data.detail.is_local),
    el("div.row.wrap",
      quiet(say("Memory of this place"), () => { screen.open("place"); screen.opened.look(place); }, { icon: "place" }),
      quiet(say("Zoom in"), () => screen.goTo(feature), { icon: "target" })),
  ];
}

export const titleOf = (feature) => (isChange(feature) ? words.changeWords(feature.properties) : words.className(feature.properties.class));

/** Its kind's or class's words, colour and letter on the map. */
export const lookOf = (feature) => (isChange(feature) ? KINDS[feature.properties.kind] : CLASSES[feature.properties.class]) ?? OTHER_CLASS;

/** A coloured mark of the feature's kind or class. */
export function badge(feature) {
  const [, colour] = lookOf(feature);
  const mark = el("span", { class: `badge ${isChange(feature) ? "square" : "round"}`, "aria-hidden": true });
  mark.style.setProperty("--colour", colour);
  return mark;
}

/** The pictures of a feature: before and after of a change, the latest view of an object. */
export function pictures(feature) {
  const names = isChange(feature) ? [say("before"), say("after")] : [say("latest view")];
  const crops = isChange(feature) ? cropsOf(feature) : cropsOf(feature).slice(-1); // of an object the latest, as in the lists
  if (!crops.length) return el("p.hint", say("Pictures come when the mission has ended."));
  return el("div", { class: `pictures n${names.length}` }, crops.map((src, k) =>
    el("figure", picture(src, `${titleOf(feature)}, ${names[k] ?? ""}`), el("figcaption", names[k] ?? ""))));
}

/** A picture, at most four times as large as it is; a note where it cannot be had. */
export function picture(src, alt) {
  const image = el("img", { src, alt, loading: "lazy", decoding: "async" });
  image.addEventListener("load", () => { image.style.maxWidth = `${4 * image.naturalWidth}px`; });
  image.addEventListener("error", () => image.replaceWith(el("div.gone", say("no picture"))));
  return image;
}

/** How much higher its ground lies than before, with the accuracy; null where that was not measured. */
function risenWords({ height_change_m: risen, height_change_sigma_m: sigma }) {
  if (risen === undefined || risen === null) return null;
  return say("{change} (accuracy {sigma}, 1 sigma)", { change: `${risen > 0 ? "+" : ""}${words.length(risen)}`, sigma: words.length(sigma) });
}

/** What is known of a feature, as a list of terms. */
export function facts(feature, local) {
  const values = feature.properties;
  const rows = [
    [say("Place"), words.place(middleOf(feature.geometry), { local })],
    [say("Position accuracy"), values.sigma_m === undefined || values.sigma_m === null ? null : say("{length} (1 sigma)", { length: words.length(values.sigma_m) })],
    [say("Position on this map"), values.sigma_in_map_m ? say("{length} (1 sigma)", { length: words.length(values.sigma_in_map_m) }) : null],
    [say("Height change"), risenWords(values)],
    [say("Score"), words.percent(values.score)],
    [say("Seen"), values.views ? (values.possible_views ? say("in {n} of {all} frames", { n: values.views, all: values.possible_views }) : say("in {n} frame|in {n} frames", { n: values.views })) : null],
    [say("Size"), values.length_m ? (values.width_m ? `${words.length(values.length_m)} × ${words.length(values.width_m)}` : words.length(values.length_m)) : null],
    [say("Area"), values.area_m2 ? words.area(values.area_m2) : null],
    [say("Speed"), values.velocity_m_s ? words.speed(Math.hypot(...values.velocity_m_s)) : null],
    [say("First seen"), values.first_seen ? words.time(values.first_seen) : null],
    [say("Flight"), values.flight],
    [say("Id"), feature.id],
  ];
  return el("dl.facts", rows.filter(([, value]) => value).map(([name, value]) => [el("dt", name), el("dd", value)]));
}
