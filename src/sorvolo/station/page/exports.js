// Share: a link, what is shown as GeoJSON, CSV, KMZ, for CalTopo and TAK; the station's own files (map, GeoPackage, reports); print.

import { get, now, roomUrl, siteUrl } from "./api.js";
import { button, el, fill, report } from "./dom.js";
import { lookOf, titleOf } from "./feature_card.js";
import { say } from "./languages.js";
import { middleOf } from "./places.js";
import { copy, isOwn, NOT_COPIED } from "./share.js";
import { siteName } from "./sites.js";
import { bytes, length, place, time, VERDICTS } from "./words.js";
import { zip } from "./zip.js";

const COLUMNS = ["id", "what", "kind", "class", "score", "latitude", "longitude", "coordinates", "sigma_m", "length_m", "area_m2", "first_seen", "last_seen", "flight", "review", "reviewer", "note"];
const DAY_MS = 86400000;
const FORMATS = [["GeoJSON", ".geojson", geojson], ["CSV", ".csv", csv], ["KMZ", ".kmz", kmz, true], ["CalTopo", "-caltopo.json", caltopo, true], [say("TAK package"), "-tak.zip", tak, true]];

export function exportPanel(screen, body) {
  const shown = el("div");
  const files = el("div");
  const copied = el("span.soft", { role: "status" });
  const link = async () => {
    const is = await copy(`${location.origin}/${roomUrl(screen.data.id, screen.room)}`);
    fill(copied, is ? say("Link copied") : NOT_COPIED);
  };
  fill(body, el("div.row.wrap", button(say("Copy link"), link, { class: "main" }), copied),
    el("p.note", isOwn ? say("This address works on this computer alone. Open the station by its address in the network to share it.") : say("Who opens it needs a token of their own where the station has tokens.")), el("h3", say("What is shown")), shown,
    el("div.row.wrap", button(say("Print or PDF"), () => print(screen))), el("details", { open: true }, el("summary", say("All files")), files));

  function refresh() {
    const features = shownFeatures(screen);
    const local = screen.data.detail.is_local;
    fill(shown, el("p.soft", say("{n} feature: the filters and the area of interest apply.|{n} features: the filters and the area of interest apply.", { n: features.length })),
      el("div.row.wrap", FORMATS.filter(([, , , isOnEarth]) => !(isOnEarth && local)).map(([words, ending, made]) =>
        button(words, () => save(made(features, screen.data.detail.name, screen.data.id), ending)))));
  }

  function save(content, ending) {
    download(new Blob([content]), `${screen.data.detail.name.replaceAll(/[^\w.-]+/g, "_")}${ending}`);
  }

  async function load() {
    fill(files, el("p.soft", say("Looking…")));
    try {
      const list = await get(siteUrl(screen.data.id, "exports"));
      fill(files, list.length ? el("ul.plain.files", list.map((each) => el("li",
        el("a", { href: each.url, download: each.name ?? "" }, each.title ?? each.name), el("span.soft", each.bytes ? ` ${bytes(each.bytes)}` : "", each.note ? ` · ${each.note}` : ""))))
        : el("p.hint", say("No files yet: they come with the first map.")));
    } catch (problem) {
      if (problem.status === 404) fill(files, el("p.hint", say("This station offers no files; they lie in the site's folder.")));
      else report(problem);
    }
  }

  refresh();
  if (!screen.data.detail.is_new) load();
  return { refresh };
}

function shownFeatures(screen) {
  const { data, view } = screen;
  const on = (group) => !view || view.isShown(group);
  return [...(on("changes") ? data.shown("changes") : []), ...(on("objects") ? data.shown("objects") : []), ...(screen.zones ?? []).filter((each) => each.properties.purpose !== "found")]; // that is among the objects
}

function download(blob, name) {
  const url = URL.createObjectURL(blob);
  const link = el("a", { href: url, download: name });
  document.body.append(link);
  link.click();
  link.remove();
  setTimeout(() => URL.revokeObjectURL(url), 10000);
}

function extentWords(screen) {
  const { middle, width_m: width, bearing_deg: bearing } = screen.view.extent();
  const up = Math.abs(bearing) < 0.5 ? say("north up") : say("up is {angle}° from north", { angle: Math.round((bearing + 360) % 360) });
  return say("the picture is {width} wide, {up}, its middle at {place}", { width: length(width), up, place: place(middle, { local: screen.data.detail.is_local }) });
}

const listed = (features) => `{"type": "FeatureCollection", "features": [\n${features.map((each) => JSON.stringify(each)).join(",\n")}\n]}\n`;
const nameOf = (feature) => feature.properties.name ?? titleOf(feature);
const saidOf = ({ id, properties: { review, note } }) => [id, VERDICTS[review], note].filter(Boolean).join(" · ");
const colourOf = (feature) => (feature.properties.purpose ? "#ffe066" : lookOf(feature)[1]);

function geojson(features) {
  return listed(features.map(({ type, id, geometry, properties: { crops, ...properties } }) => ({ type, id, geometry, properties })));
}

/** GeoJSON as CalTopo and SARTopo take it: markers and shapes with their titles and colours. */
function caltopo(features) {
  return listed(features.map((each) => {
    const colour = colourOf(each);
    const look = each.geometry.type === "Point" ? { class: "Marker", "marker-symbol": "point", "marker-color": colour } : { class: "Shape", stroke: colour, "stroke-width": 2, fill: colour, "fill-opacity": 0.1 };
    return { type: "Feature", id: each.id, geometry: each.geometry, properties: { title: nameOf(each), description: saidOf(each), ...look } };
  }));
}

/** Features as CSV (RFC 4180); a cell that a spreadsheet would run as a formula gets an apostrophe. */
function csv(features) {
  const cell = (value) => {
    const text = typeof value === "string" && /^[=+\-@\t\r]/.test(value) ? `'${value}` : String(value ?? "");
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  const rows = features.map((each) => {
    const [lon, lat] = middleOf(each.geometry);
    const values = { ...each.properties, id: each.id, what: nameOf(each), latitude: Number(lat.toFixed(8)), longitude: Number(lon.toFixed(8)), coordinates: place([lon, lat]) };
    return COLUMNS.map((name) => cell(values[name])).join(",");
  });
  return `${[COLUMNS.join(","), ...rows].join("\r\n")}\r\n`;
}

class Xml extends String {}

/** An element of XML: its name, its attributes if any, its children: elements, or one text. */
function xml(name, ...children) {
  const safe = (text) => String(text).replace(/[^\t\n\r -\ufffd]/g, "").replace(/[&<>"]/g, (each) => `&#${each.charCodeAt(0)};`);
  const attributes = children[0].constructor === Object ? children.shift() : {};
  const inner = children.flat().map((each) => (each instanceof Xml ? each : safe(each))).join("");
  return new Xml(`<${name}${Object.entries(attributes).map(([key, value]) => ` ${key}="${safe(value)}"`).join("")}>${inner}</${name}>`);
}

const file = (root) => new TextEncoder().encode(`<?xml version="1.0" encoding="UTF-8"?>\n${root}`);

/** Features as KMZ, each in its colour. */
function kmz(features, name) {
  const along = (places) => xml("coordinates", places.map((each) => each.slice(0, 2).join(",")).join(" "));
  const polygon = ([outer]) => xml("Polygon", xml("outerBoundaryIs", xml("LinearRing", along(outer))));
  const shapes = { Point: (place) => xml("Point", along([place])), LineString: (line) => xml("LineString", along(line)), Polygon: polygon,
    MultiPolygon: (several) => xml("MultiGeometry", several.map(polygon)) };
  const marks = features.map((each) => {
    const [, red, green, blue] = /#(..)(..)(..)/.exec(colourOf(each));
    const look = ["IconStyle", "LineStyle", "PolyStyle"].map((tag, k) => xml(tag, xml("color", ["ff", "ff", "40"][k] + blue + green + red)));
    return xml("Placemark", xml("name", nameOf(each)), xml("description", saidOf(each)), xml("Style", look), shapes[each.geometry.type](each.geometry.coordinates));
  });
  return zip({ "doc.kml": file(xml("kml", { xmlns: "http://www.opengis.net/kml/2.2" }, xml("Document", xml("name", name), marks))) });
}

/** Features as a data package of ATAK, WinTAK and iTAK: a Cursor on Target event each. */
function tak(features, name, site) {
  const at = new Date(now()).toISOString();
  const stale = new Date(now() + DAY_MS).toISOString();
  const events = features.map((each) => {
    const [lon, lat] = middleOf(each.geometry);
    const uid = `sorvolo.${site}.${each.id}`;
    const type = { person: "a-u-G", car: "a-u-G-E-V-C" }[each.properties.class] ?? "b-m-p-s-m";
    return [uid, xml("event", { version: "2.0", uid, type, how: "m-g", time: at, start: at, stale },
      xml("point", { lat, lon, hae: 9999999, ce: each.properties.sigma_m ?? 9999999, le: 9999999 }),
      xml("detail", xml("contact", { callsign: nameOf(each) }), xml("remarks", saidOf(each))))];
  });
  const setting = (key, value) => xml("Parameter", { name: key, value });
  const manifest = xml("MissionPackageManifest", { version: 2 }, xml("Configuration", setting("uid", `sorvolo.${site}.${at}`), setting("name", name)),
    xml("Contents", events.map(([uid], k) => xml("Content", { ignore: false, zipEntry: `${k}/event.cot` }, setting("uid", uid)))));
  return zip({ "MANIFEST/manifest.xml": file(manifest), ...Object.fromEntries(events.map(([, event], k) => [`${k}/event.cot`, file(event)])) });
}

async function print(screen) {
  const features = shownFeatures(screen);
  const picture = screen.view ? el("img", { alt: say("The map"), src: await screen.view.picture() }) : null;
  const sheet = el("section.sheet", el("h1", siteName(screen.data.detail)), el("p", `${time(now())}${screen.view ? ` · ${extentWords(screen)}` : ""}`), picture,
    el("table", el("thead", el("tr", [say("Id"), say("What"), say("Place"), say("Score"), say("Verdict"), say("Note")].map((each) => el("th", each)))),
      el("tbody", features.map((each) => el("tr", [each.id, each.properties.name ?? titleOf(each), place(middleOf(each.geometry), { local: screen.data.detail.is_local }), each.properties.score ? Math.round(each.properties.score * 100) : "",
        VERDICTS[each.properties.review] ?? "", each.properties.note ?? ""].map((value) => el("td", String(value))))))));
  document.body.append(sheet);
  const done = () => sheet.remove();
  addEventListener("afterprint", done, { once: true });
  const begin = () => window.print();
  if (picture && !picture.complete) picture.addEventListener("load", begin, { once: true });
  else begin();
}
