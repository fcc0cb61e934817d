// The list of sites, and the first-run page where there is none.

import { ask, get, siteUrl } from "./api.js";
import { button, dialog, el, field, fill, report } from "./dom.js";
import * as words from "./words.js";
import { choices } from "./choices.js";

const PREVIEW_SHAPE = 1.6; // width over height

/** Show the sites; keeps the list fresh while missions run. */
export async function showSites(main, title, station) {
  fill(title, el("h1", { class: "sr" }, "Sites"));
  document.title = "Sorvolo station";
  const load = async () => {
    const sites = await get("/api/sites");
    fill(main, sites.length ? list(sites, station) : firstRun(station));
  };
  await load();
  const again = () => load().catch(() => {});
  const types = ["run.started", "run.finished", "run.failed", "site.changed", "site.gone"];
  for (const type of types) station.events.addEventListener(type, again);
  choices.addEventListener("change", again);
  return {
    close() {
      for (const type of types) station.events.removeEventListener(type, again);
      choices.removeEventListener("change", again);
    },
  };
}

function list(sites, station) {
  return el("div", { class: "sites" },
    el("h2", {}, "Sites"),
    el("ul", { class: "cards" }, sites.map((site) => card(site, station.status.role === "operate"))),
    station.status.role === "operate" ? newSite() : null);
}

function card(site, may) {
  const remove = may ? button("Delete", () => showDeletion(site).catch(report), { class: "quiet", "aria-label": `Delete ${site.id}` }) : null;
  if (site.error) {
    return el("li", { class: "card broken" }, el("h3", {}, site.name), el("p", {}, site.error), remove);
  }
  const href = `#/site/${encodeURIComponent(site.id)}`;
  const where = site.is_local ? "no GPS" : site.center_wgs84 ? words.place(site.center_wgs84) : "nothing mapped yet";
  return el("li", { class: "card" },
    el("a", { href },
      site.versions && site.bounds_wgs84 ? preview(site) : el("div", { class: "preview none" }, "no map yet"),
      el("h3", {}, siteName(site))),
    el("p", {}, words.counted(site.flights, "flight"), " · ", words.counted(site.versions, "version")),
    el("p", { class: "soft" }, where, site.updated_at ? ` · ${words.time(site.updated_at)}` : ""),
    remove);
}

/** State what would be lost with a site, and delete it when its id is typed (two may have one name); or why it cannot be deleted now. */
async function showDeletion(site) {
  const loss = await get(siteUrl(site.id, "deletion"));
  const name = el("input", { autocomplete: "off", spellcheck: "false" });
  const remove = el("button", { class: "main", disabled: true }, "Delete");
  name.addEventListener("input", () => { remove.disabled = name.value.trim() !== site.id; });
  const form = el("form", { class: "stack", on: { submit: async (event) => {
    event.preventDefault();
    box.close();
    try { await ask("DELETE", siteUrl(site.id), undefined, { headers: { "if-match": loss.etag } }); } catch (problem) { report(problem); }
  } } },
  el("p", {}, loss.versions === null ? "This site cannot be read." : `${words.counted(loss.flights, "flight")}, ${words.counted(loss.versions, "version")} of the map.`,
    ` ${words.counted(loss.files, "file")}, ${words.bytes(loss.bytes)}.`),
  el("p", { class: "note" }, `Verdicts and drawings go with it, and the records of its missions (${loss.missions}) with what watches found. Recordings and uploads stay.`),
  field(`Type ${site.id} to confirm`, name), remove);
  const box = dialog(`Delete the site ${site.id} for good?`, form);
  name.focus();
}

/** A site as its list and title name it: its folder below the root. */
export const siteName = (site) => (site.id.includes(":") ? site.id.replaceAll(":", " / ") : site.name);

/** The tiles over the site's box, laid so that the box fills the picture. */
function preview(site) {
  const [west, south, east, north] = site.bounds_wgs84;
  const x = (lon) => (lon + 180) / 360;
  const y = (lat) => (1 - Math.asinh(Math.tan(lat * (Math.PI / 180))) / Math.PI) / 2;
  const box = [x(west), y(north), Math.max(x(east) - x(west), 1e-9), Math.max(y(south) - y(north), 1e-9)];
  const z = Math.max(8, Math.min(22, Math.floor(-Math.log2(Math.max(box[2], box[3]))) + 1));
  const size = 1 / 2 ** z;
  const images = [];
  for (let column = Math.floor(box[0] / size); column * size < box[0] + box[2]; column++) {
    for (let row = Math.floor(box[1] / size); row * size < box[1] + box[3]; row++) {
      const image = el("img", { src: `/api/sites/${encodeURIComponent(site.id)}/tiles/live/${z}/${column}/${row}.webp`, alt: "", loading: "lazy" });
      const share = Math.max(box[2], box[3] * PREVIEW_SHAPE); // of the world, over the picture's width
      Object.assign(image.style, {
        left: `${(column * size - box[0] - (box[2] - share) / 2) / share * 100}%`, width: `${size / share * 100}%`,
        top: `${(row * size - box[1] - (box[3] - share / PREVIEW_SHAPE) / 2) / share * PREVIEW_SHAPE * 100}%`,
      });
      image.addEventListener("error", () => image.remove()); // nothing is mapped there
      images.push(image);
    }
  }
  return el("div", { class: "preview" }, images);
}

function newSite() {
  const name = el("input", { required: true, maxlength: 80, pattern: "[A-Za-z0-9][A-Za-z0-9 ._\\-]*", placeholder: "my-field" });
  name.setAttribute("aria-label", "Name of a new site");
  return el("form", { class: "row new-site", on: { submit: (event) => {
    event.preventDefault();
    location.hash = `#/site/${encodeURIComponent(name.value.trim())}/missions`;
  } } }, name, el("button", {}, "New site"));
}

function firstRun(station) {
  return el("div", { class: "first-run" },
    el("h2", {}, "No site yet"),
    el("p", {}, "A site is a piece of ground with its maps, flight after flight. Three ways to the first one:"),
    el("ol", { class: "ways" },
      el("li", {}, el("h3", {}, "See it with a demo flight"),
        el("p", {}, "Two simulated flights over a village, mapped and compared in about two minutes. On the station's machine, in the folder it serves:"),
        el("pre", { tabindex: 0 }, el("code", {}, "sorvolo demo")),
        el("p", { class: "soft" }, "The site appears here when it is done.")),
      el("li", {}, el("h3", {}, "Map a flight of yours"),
        el("p", {}, "Name the site, then upload a video with its telemetry, or a folder of photos."),
        station.status.role === "operate" ? newSite() : el("p", { class: "soft" }, "Your token may look, not start missions.")),
      el("li", {}, el("h3", {}, "Let the drone stream"),
        el("p", {}, "On its companion computer, or to replay a recorded flight:"),
        el("pre", { tabindex: 0 }, el("code", {}, `sorvolo stream FLIGHT.MP4 --to ${location.origin}`)))));
}
