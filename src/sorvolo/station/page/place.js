// Memory of a place: everything that ever saw a spot of ground, in order of time.

import { get, siteUrl } from "./api.js";
import { button, el, fill, quiet } from "./dom.js";
import { picture } from "./feature_card.js";
import { say } from "./languages.js";
import { featureOf } from "./places.js";
import { handover, placeUrl } from "./share.js";
import { grouped } from "./site_data.js";
import * as words from "./words.js";

/** The panel's life; `look(place)` asks for a [lon, lat]. */
export function placePanel(screen, body) {
  let turn = 0;
  let shown = null;
  let ground = null; // how well it was looked at, where that layer is shown
  let drawn = ""; // what of the page's state the list was last drawn with
  let last = screen.lastPlace ?? null;
  const hint = el("p.hint", say("Tap the ground on the map: every flight that saw it, in order, what changed there, and people's verdicts."));

  async function look(place, hits = []) {
    turn += 1;
    ground = chanceAt(hits);
    const mine = turn;
    shown = null;
    last = screen.lastPlace = place;
    history.replaceState(null, "", placeUrl(screen.data.id, place));
    mark(screen, place);
    fill(body, el("p.place-name", words.place(place, { local: screen.data.detail.is_local })), el("p.soft", say("Looking through the flights…")));
    let views;
    try {
      views = await get(`${siteUrl(screen.data.id, "place")}?lon=${place[0]}&lat=${place[1]}`);
    } catch (problem) {
      if (mine === turn) fill(body, el("p.hint", problem.words));
      return;
    }
    if (mine !== turn) return;
    shown = views;
    show(place, views);
    screen.view?.ready.then(() => requestAnimationFrame(() => { if (mine === turn && !screen.closed) screen.view.reveal(place); }));
  }

  function show(place, views) {
    const flights = grouped(views, (each) => each.flight);
    const found = unique(views.flatMap((each) => [...each.changes, ...each.objects]));
    const reviews = unique(views.flatMap((each) => each.reviews), (each) => `${each.id} ${each.at}`);
    fill(body,
      el("div.row", el("p.place-name", words.place(place, { local: screen.data.detail.is_local }))), ground, screen.data.detail.is_local ? null : handover(screen.data.id, say("Place on {site}", { site: screen.data.detail.name }), place),
      views.length ? el("p.soft", say("{views} in {flights}, first {time}", { views: say("{n} view|{n} views", { n: views.length }), flights: say("{n} flight|{n} flights", { n: flights.size }), time: words.time(views[0].time) }))
        : el("p.hint", say("No flight saw this place.")),
      found.length ? el("section", el("h3", say("What was found here")), el("ul.plain", found.map((each) => change(screen, each)))) : null,
      reviews.length ? el("section", el("h3", say("Reviews")), el("ul.plain", reviews.map(review))) : null,
      [...flights].map(([flight, list]) => el("section.dates",
        el("h3", words.day(list[0].time), el("small", ` ${flight}`)),
        el("ol.film", { tabindex: 0, "aria-label": say("Views of {flight}", { flight }) }, apart(list).map((each) => view(screen, each, place))))));
  }

  if (last) look(last);
  else fill(body, hint);
  return { look, refresh() {
      const now = `${words.place(last ?? [0, 0])} ${screen.data.all.changes.length} ${screen.data.all.objects.length}`;
      if (shown && now !== drawn) show(last, shown);
      drawn = now;
    }, cursor: "crosshair", click(place, hits) {
      if (hits.some((each) => each.source === "objects")) return false;
      screen.data.choose(null);
      look(place, hits);
      return true;
    },
    close() { mark(screen, null); } };
}

function mark(screen, place) {
  screen.view?.put("sketch", place ? [featureOf("Point", place, { purpose: "waypoint" })] : []);
}

function unique(list, key = (each) => each.id ?? each) {
  return [...new Map(list.map((each) => [key(each), each])).values()];
}

/** A change or an object of the place's list. `each`: as the station's memory states it. */
function change(screen, each) {
  const feature = screen.data.find(each.id);
  const what = each.type === "change" ? words.changeWords(feature?.properties ?? each) : say("{what} found", { what: words.className(each.class) });
  const text = `${words.day(each.first_seen)}: ${what}`;
  return el("li", feature ? button(text, () => screen.data.choose(feature), { class: "link" }) : text, ` (${each.id})`);
}

function review(each) {
  return el("li", el("b", words.VERDICTS[each.verdict] ?? each.verdict), ` ${say("by {name}, {time}", { name: words.nameOf(each.who), time: words.time(each.at) })}`, each.note ? ` “${each.note}”` : "");
}

/** A button that plays the video of a place's view; null where there is none. */
export const jump = (screen, each, place) => (each.video_s === null || !each.video_url ? null
  : quiet(`▶ ${words.duration(each.video_s)}`, () => screen.video.play(each, place), { title: say("Show the video at this second") }));

/** Of views less than a second apart, which look alike, the one in the middle. */
export function apart(views) {
  const runs = [];
  for (const each of views) {
    const last = runs.at(-1);
    if (last && last[0].flight === each.flight && new Date(each.time) - new Date(last[0].time) < 1000) last.push(each);
    else runs.push([each]);
  }
  return runs.map((run) => run[run.length >> 1]);
}

function view(screen, each, place) {
  return el("li.marked", each.crop_url ? picture(each.crop_url, say("Seen {time}", { time: words.time(each.time) })) : el("div.gone", say("no picture kept")), el("span", words.clock(each.time)), jump(screen, each, place));
}

/** With which chance somebody at a place would have been seen, and why so little; null where the map shows no such layer. */
function chanceAt(hits) {
  const at = (kind) => hits.find(({ source, properties }) => source === "pod" && properties.kind === kind)?.properties;
  const [pod, hole] = [at("pod"), at("hole")];
  if (!pod && !hole) return null;
  const chance = pod ? say("A {what} here would have been seen with {from} to {to}", { what: words.className(pod.class ?? "person"), from: words.percent(pod.pod_from), to: words.percent(pod.pod_to) }) : say("Nobody here would have been seen");
  return el("p.hint.chance", hole ? `${chance}: ${words.reason(hole.reason)}.` : `${chance}.`);
}
