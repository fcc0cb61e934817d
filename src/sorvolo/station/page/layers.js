// The panel of the map: layers, filters by class, kind, score, time and verdict, the version shown, the base map.

import { choices } from "./choices.js";
import { choice, el, field, fill, quiet, tick } from "./dom.js";
import { ALL, sortOf } from "./filters.js";
import { badge } from "./feature_card.js";
import { FADED, GROUPS, KINDS, CLASSES, PLACED, POD_RAMP } from "./map_style.js";
import { lookedAt } from "./sentence.js";
import { chooseBaseMap } from "./base_map.js";
import { say } from "./languages.js";
import { grouped } from "./site_data.js";
import { day, percent, VERDICTS } from "./words.js";

/** The panel's life: `refresh` after data changed. */
export function layersPanel(screen, body) {
  const { data, view } = screen;
  const legend = el("div");
  const { under_trees: under } = data.detail;
  const layers = el("fieldset.ticks", el("legend", say("Layers")),
    Object.entries(GROUPS).filter(([group]) => group !== "trees" || under).map(([group, [words]]) => [tick(words, choices.get("layers")[group] ?? GROUPS[group][1],
      (shown) => { view?.show(group, shown); refresh(); }),
    group === "trees" && heightSlider(under, view),
    FADED[group] && el("input", { type: "range", min: 0.1, max: 1, step: 0.05, "aria-label": say("Opacity: {layer}", { layer: words }), ".value": String(view?.opacity(group) ?? 1), on: { input: (event) => view?.fade(group, Number(event.target.value)) } })]));
  const found = el("div");
  const coverage = el("div");
  fill(body, legend, found, coverage, layers, filterForm(data), base(screen));

  function refresh() {
    const { detail } = data;
    fill(legend, el("p.soft", say("{n} flight|{n} flights", { n: detail.flights?.length ?? 0 }), " · ",
      detail.versions?.length ? say("latest {date}", { date: day(detail.versions.at(-1).flown_at ?? detail.versions.at(-1).made_at) }) : detail.bounds_wgs84 ? say("a first one is being mapped") : say("nothing mapped yet")),
      whyEmpty(data));
    fill(coverage, coverageCard(data));
    fill(found, kinds(data, "changes", say("Changes")), kinds(data, "objects", say("Objects")), placedLegend(data));
  }
  refresh();
  return { refresh };
}

/** The height at which pictures are put together: the floor is sharp at its own. */
function heightSlider({ floor_m: floor, low_m: min, high_m: max, ...under }, view) {
  const above = el("output", say("{n} m above the floor", { n: 0 }));
  return el("div.row", el("input", { type: "range", min, max, step: 1, "aria-label": say("Height under the trees"), ".value": String(floor),
    on: { input: (event) => fill(above, say("{n} m above the floor", { n: Number(event.target.value) - floor })), change: (event) => view?.showUnderTrees(under, Number(event.target.value)) } }), above);
}

function whyEmpty(data) {
  if (data.detail.versions?.length || data.detail.is_new || data.detail.bounds_wgs84) return null;
  return el("p.hint", say("This site has no map yet. Start a mission in “Live”."));
}

function kinds(data, name, title) {
  const all = data.all[name];
  if (!all.length) return null;
  const shown = data.shown(name).length;
  return el("fieldset.ticks", el("legend", shown === all.length ? `${title}: ${all.length}` : `${title}: ${say("{n} of {all} shown", { n: shown, all: all.length })}`),
    [...grouped(all, sortOf)].map(([sort, list]) => {
      const words = (KINDS[sort] ?? CLASSES[sort] ?? [sort])[0];
      const hidden = data.filters.hidden;
      return el("div.kind", badge(list[0]), tick(`${words} (${list.length})`, !hidden.includes(sort),
        (on) => data.filter({ hidden: on ? hidden.filter((each) => each !== sort) : [...hidden, sort] })));
    }));
}

function placedLegend(data) {
  if (!(choices.get("layers").frames ?? false)) return null;
  const rejected = data.detail.flights.reduce((sum, each) => sum + each.rejected, 0);
  return el("div.ticks", Object.values(PLACED).map(([words, colour]) => {
    const mark = el("span.badge.line");
    mark.style.setProperty("--colour", colour);
    return el("div.kind", mark, words);
  }), rejected ? el("p.soft", say("{n} frame rejected: no place, so not drawn|{n} frames rejected: no place, so not drawn", { n: rejected })) : null);
}

function filterForm(data) {
  const score = el("output", percent(data.filters.minScore));
  const slider = el("input", { type: "range", min: 0, max: 1, step: 0.05, ".value": String(data.filters.minScore),
    on: { input: (event) => { fill(score, percent(Number(event.target.value))); data.filter({ minScore: Number(event.target.value) }); } } });
  const least = el("input", { type: "number", min: 0, step: "any", inputmode: "decimal", ".value": data.filters.minArea_m2 || "",
    on: { input: (event) => data.filter({ minArea_m2: Number(event.target.value) || 0 }) } });
  const date = (name) => el("input", { type: "date", ".value": data.filters[name], on: { change: (event) => data.filter({ [name]: event.target.value }) } });
  return el("details.filters", el("summary", say("Filter")),
    field(say("Verdict"), choice([["all", say("all")], ["none", say("not reviewed")], ...["confirmed", "rejected", "disputed", "unsure"].map((each) => [each, VERDICTS[each]])],
      data.filters.verdict, (verdict) => data.filter({ verdict }))),
    el("div.row", field(say("Score at least"), slider), score),
    field(say("Flight"), choice([["", say("all")], ...(data.detail.flights ?? []).map((each) => [each.id, each.id])], data.filters.flight, (flight) => data.filter({ flight }))),
    el("div.row", field(say("Seen from"), date("from")), field(say("until"), date("to"))),
    field(say("Changes of at least (m²)"), least),
    el("p.note", data.filters.area ? say("Only what lies in the area of interest.") : say("Draw an area of interest with “Measure and draw” to filter by it.")),
    quiet(say("Show everything"), () => data.filter(ALL)));
}

/** How well the ground was looked at, with the legend of its layer. */
function coverageCard(data) {
  const looked = lookedAt(data.all.pod);
  if (!looked) return el("p.hint", say("How well the ground was searched is not measured. A search mission in “Live” does it."));
  return el("fieldset.ticks.coverage", el("legend", say("Chance to have seen a person")),
    el("ol.ramp", { "aria-label": say("Colours") }, POD_RAMP.map((colour, k) => {
      const step = el("li", `${20 * k}–${20 * k + 20} %`);
      step.style.setProperty("--colour", colour);
      return step;
    })), el("p.note", say("{share} of the ground was looked at. Somebody on it would have been seen with {from} to {to}. Tap the coloured ground for its value, dashed ground for the reason.", { share: percent(looked.share), from: percent(looked.from), to: percent(looked.to) })));
}

function base(screen) {
  return el("details", el("summary", say("Base map")),
    el("p.note", say("A PMTiles file of this device or the station, shown under the mosaic. Nothing is loaded from the network.")),
    chooseBaseMap(screen));
}
