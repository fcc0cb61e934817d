// The start page: drones that send, with one button each; the sites; flights dropped on the page.

import { ask, get, now, post, put, roomUrl, siteUrl } from "./api.js";
import { button, dialog, el, field, fill, quiet, report } from "./dom.js";
import { isWithin, tileColumn, tileRow } from "./places.js";
import { DroneVideo } from "./video.js";
import * as words from "./words.js";
import { choices } from "./choices.js";
import { say } from "./languages.js";

const PREVIEW_SHAPE = 1.6; // width over height
const LOOK_MS = 5000;
const HEARD = ["run.started", "run.finished", "run.failed", "site.changed", "site.gone", "stream.state"];

export async function showSites({ main, title }, station) {
  fill(title, el("h1.sr", say("Sites")));
  document.title = say("Sorvolo station");
  const videos = new Map();
  let [shown, closed] = ["", false];
  const drones = el("section.drones", { "aria-label": say("Drones") });
  const below = el("div");
  const load = async () => {
    const [sites, streams] = await Promise.all([get("/api/sites"), get("/api/streams")]);
    if (closed) return;
    const on = streams.filter((each) => each.is_connected);
    for (const [name, video] of videos) {
      if (on.some((each) => each.stream === name)) continue;
      video.close();
      videos.delete(name);
    }
    for (const { stream } of on) if (!videos.has(stream)) videos.set(stream, new DroneVideo(stream));
    const state = JSON.stringify([sites, on.map(({ stream, telemetry }) => [stream, siteAt(sites, telemetry)?.id, Boolean(telemetry)]), choices.all]);
    if (state === shown) return; // what a person is about to press stays under the finger
    shown = state;
    fill(drones, on.map((each) => droneCard(each, videos.get(each.stream), sites, station)));
    fill(below, sites.length ? list(sites, station) : on.length ? null : firstRun(station));
  };
  fill(main, el("div.sites", drones, below));
  await load();
  const again = () => load().catch(() => {});
  const over = new AbortController();
  for (const type of HEARD) station.events.addEventListener(type, again, over);
  choices.addEventListener("change", again, over);
  const timer = setInterval(again, LOOK_MS); // where a drone is becomes known as it flies
  return {
    close() {
      closed = true;
      clearInterval(timer);
      over.abort();
      for (const each of videos.values()) each.close();
    },
  };
}

/** The site over whose ground a drone flies. */
function siteAt(sites, telemetry) {
  const { latitude_deg: lat, longitude_deg: lon } = telemetry ?? {};
  return sites.find(({ bounds_wgs84: box }) => box && isWithin([lon, lat], box));
}

/** A drone with its moving picture, and the next act: to map what it flies over and look for people. */
function droneCard({ stream, telemetry }, video, sites, station) {
  const { latitude_deg: lat, longitude_deg: lon } = telemetry ?? {};
  const here = siteAt(sites, telemetry);
  const site = here?.id ?? `${stream} ${new Date(now()).toISOString().slice(0, 10)}`;
  const fault = el("p.error", { role: "alert" });
  const start = async (event) => {
    const pressed = event.currentTarget;
    pressed.disabled = true;
    try {
      await (await import("./missions.js")).mapAndFind(stream, site, Boolean(here?.versions));
      location.hash = roomUrl(site);
    } catch (problem) {
      fill(fault, problem.words);
      pressed.disabled = false;
    }
  };
  return el("article.card.drone", video.pane, el("p", [say("Sends now"), lat === undefined || lat === null ? "" : words.place([lon, lat]), here ? say("over {site}", { site: siteName(here) }) : ""].filter(Boolean).join(", ")),
    station.operates ? button(say("Map and find people"), start, { class: "main" }) : mayNot(),
    here ? el("p", el("a", { href: roomUrl(here.id) }, say("Look at {site}", { site: siteName(here) }))) : null, fault);
}

function list(sites, station) {
  return [el("h2", say("Sites")),
    el("ul.cards", sites.map((site) => card(site, station.operates))),
    station.operates ? newSite() : null];
}

function card(site, may) {
  const remove = may ? quiet(say("Delete"), () => showDeletion(site).catch(report), { "aria-label": say("Delete {name}", { name: site.id }) }) : null;
  if (site.error) {
    return el("li.card.broken", el("h3", site.name), el("p", site.error), remove);
  }
  const where = site.is_local ? say("no GPS") : site.center_wgs84 ? words.place(site.center_wgs84) : say("nothing mapped yet");
  return el("li.card",
    el("a", { href: roomUrl(site.id) },
      site.versions && site.bounds_wgs84 ? preview(site) : el("div.preview.none", say("no map yet")),
      el("h3", siteName(site))),
    el("p", say("{n} flight|{n} flights", { n: site.flights }), " · ", say("{n} version|{n} versions", { n: site.versions })),
    el("p.soft", where, site.updated_at ? ` · ${words.time(site.updated_at)}` : ""),
    remove ? el("details.more", el("summary", { "aria-label": say("More of {name}", { name: site.id }) }, "⋯"), quiet(say("Rename"), () => rename(site), { "aria-label": say("Rename {name}", { name: site.id }) }), remove) : null);
}

function rename(site) {
  const name = el("input", { required: true, maxlength: 80, ".value": siteName(site) });
  const fault = el("p.error", { role: "alert" });
  const box = dialog(say("Rename {name}", { name: siteName(site) }), el("form.stack", { on: { submit: async (event) => {
    event.preventDefault();
    try {
      await put(`${siteUrl(site.id)}/name`, { name: name.value.trim() });
      box.close();
      choices.dispatchEvent(new CustomEvent("change", { detail: "name" }));
    } catch (problem) { fill(fault, problem.words); }
  } } }, field(say("Name"), name, say("Its folder and links stay.")), fault, el("button.main", say("Rename"))));
  name.select();
}

/** State what would be lost with a site, and delete it when its id is typed (two may have one name); or why it cannot be deleted now. */
async function showDeletion(site) {
  const loss = await get(siteUrl(site.id, "deletion"));
  const name = el("input", { autocomplete: "off", spellcheck: "false" });
  const remove = el("button.main", { disabled: true }, say("Delete"));
  name.addEventListener("input", () => { remove.disabled = name.value.trim() !== site.id; });
  const form = el("form.stack", { on: { submit: async (event) => {
    event.preventDefault();
    box.close();
    try { await ask("DELETE", siteUrl(site.id), undefined, { headers: { "if-match": loss.etag } }); } catch (problem) { report(problem); }
  } } },
  el("p", loss.versions === null ? say("This site cannot be read.") : `${say("{n} flight|{n} flights", { n: loss.flights })}, ${say("{n} version of the map|{n} versions of the map", { n: loss.versions })}.`,
    ` ${say("{n} file|{n} files", { n: loss.files })}, ${words.bytes(loss.bytes)}.`),
  el("p.note", say("Verdicts and drawings go with it, and the records of its missions ({missions}) with what watches found. Recordings and uploads stay.", { missions: loss.missions })),
  field(say("Type {name} to confirm", { name: site.id }), name), remove);
  const box = dialog(say("Delete the site {name} for good?", { name: site.id }), form);
  name.focus();
}

/** What stands in the place of what a person may not do. */
export const mayNot = (role = "operator") => el("p.note", role === "operator" ? say("To start missions, ask the team lead for operator access.") : say("View only. Ask the team lead for reviewer access."));

/** A site as its list and title name it: as it was renamed, else its folder below the root, since two may have been made under one name. */
export const siteName = ({ id, name }) => (!name || name === id.split(":").at(-1) ? id.replaceAll(":", " / ") : name);

/** The tiles over the site's box, laid so that the box fills the picture. */
function preview(site) {
  const [west, south, east, north] = site.bounds_wgs84;
  const [x, y] = [tileColumn(west, 0), tileRow(north, 0)];
  const box = [x, y, Math.max(tileColumn(east, 0) - x, 1e-9), Math.max(tileRow(south, 0) - y, 1e-9)];
  const z = Math.max(8, Math.min(22, Math.floor(-Math.log2(Math.max(box[2], box[3]))) + 1));
  const size = 1 / 2 ** z;
  const images = [];
  for (let column = Math.floor(box[0] / size); column * size < box[0] + box[2]; column++) {
    for (let row = Math.floor(box[1] / size); row * size < box[1] + box[3]; row++) {
      const image = el("img", { src: siteUrl(site.id, "tiles/live", z, column, `${row}.webp`), alt: "", loading: "lazy" });
      const share = Math.max(box[2], box[3] * PREVIEW_SHAPE); // of the world, over the picture's width
      Object.assign(image.style, {
        left: `${(column * size - box[0] - (box[2] - share) / 2) / share * 100}%`, width: `${size / share * 100}%`,
        top: `${(row * size - box[1] - (box[3] - share / PREVIEW_SHAPE) / 2) / share * PREVIEW_SHAPE * 100}%`,
      });
      image.addEventListener("error", () => image.remove()); // nothing is mapped there
      images.push(image);
    }
  }
  return el("div.preview", images);
}

function newSite() {
  const name = el("input", { required: true, maxlength: 80, placeholder: say("My field"), "aria-label": say("Name of a new site") });
  return el("form.row.new-site", { on: { submit: (event) => {
    event.preventDefault();
    const id = name.value.trim().replaceAll(/[/\\:]+/g, "-"); // a site is a folder
    location.hash = roomUrl(id);
  } } }, name, el("button", say("New site")));
}

async function tryDemo(pressed) {
  pressed.disabled = true;
  try {
    await post("/api/runs", { mission: "demo", site: "demo" });
    location.hash = roomUrl("demo");
  } finally { pressed.disabled = false; }
}

function firstRun(station) {
  return el("div.first-run",
    el("h2", say("No site yet")),
    el("p", say("A site is a piece of ground with its maps, flight after flight. Three ways to the first one:")),
    el("ol.ways",
      el("li", el("h3", say("See it with a demo flight")),
        el("p", say("Two simulated flights over a village, mapped and compared in a few minutes.")),
        station.operates ? button(say("Try the demo"), (event) => tryDemo(event.currentTarget).catch(report), { class: "main" }) : mayNot()),
      el("li", el("h3", say("Map a flight of yours")),
        el("p", say("Name the site, then upload a video with its telemetry, or a folder of photos.")),
        station.operates ? newSite() : mayNot()),
      el("li", el("h3", say("Let the drone stream")),
        el("p", say("On its companion computer, or to replay a recorded flight:")),
        el("pre", { tabindex: 0 }, el("code", `sorvolo stream FLIGHT.MP4 --to ${location.origin}`)))));
}
