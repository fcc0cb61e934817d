// Which objects and changes are shown: by class and kind, score, time, area and verdict.

import { button } from "./dom.js";
import { say } from "./languages.js";
import { CLASSES, KINDS } from "./map_style.js";
import { inRing, middleOf } from "./places.js";
import { dateOf, percent, VERDICTS } from "./words.js";

export const ALL = { hidden: [], minScore: 0, from: "", to: "", flight: "", verdict: "all", area: null, minArea_m2: 0 };

/** The key of a feature's sort: its kind for a change, its class for an object. */
export const sortOf = (feature) => feature.properties.kind ?? feature.properties.class ?? "other";

/** The features that pass. `filters`: as ALL; `area` a ring of [lon, lat]. */
export function passing(list, filters) {
  return list.filter((each) => passes(each, filters));
}

function passes(feature, filters) {
  const values = feature.properties;
  if (filters.hidden.includes(sortOf(feature))) return false;
  if ((values.score ?? 1) < filters.minScore) return false;
  if (filters.flight && values.flight !== filters.flight && !(values.flights ?? []).includes(filters.flight)) return false;
  if (filters.verdict !== "all" && (values.review ?? "none") !== filters.verdict) return false;
  if (values.area_m2 !== undefined && values.area_m2 < filters.minArea_m2) return false;
  if (filters.from && dateOf(values.last_seen ?? values.first_seen) < filters.from) return false;
  if (filters.to && dateOf(values.first_seen) > filters.to) return false;
  return !filters.area || inRing(middleOf(feature.geometry), filters.area);
}

/** A button for each filter that hides something: a tap takes it off. */
export function chips(data) {
  const { filters } = data;
  const said = {
    hidden: filters.hidden.length ? say("Without {what}", { what: filters.hidden.map((each) => (KINDS[each] ?? CLASSES[each] ?? [each])[0]).join(", ") }) : null, minScore: filters.minScore ? say("Score of {share} and more", { share: percent(filters.minScore) }) : null,
    from: filters.from && say("Seen from {date}", { date: filters.from }), to: filters.to && say("Seen until {date}", { date: filters.to }), flight: filters.flight && say("Flight {name}", { name: filters.flight }),
    verdict: filters.verdict !== "all" ? say("Only {verdict}", { verdict: filters.verdict === "none" ? say("unreviewed") : VERDICTS[filters.verdict] }) : null,
    area: filters.area && say("Only in the area of interest"), minArea_m2: filters.minArea_m2 ? say("Changes of {area} m² and more", { area: filters.minArea_m2 }) : null,
  };
  return Object.entries(said).filter(([, words]) => words).map(([name, words]) => button(words, () => data.filter({ [name]: ALL[name] }), { class: "chip", icon: "close", title: say("Show everything again") }));
}
