// Share: a link, what is shown as GeoJSON, CSV, KMZ; the station's own files (map, GeoPackage, reports); print.

import { get, siteUrl } from "./api.js";
import { button, el, fill, report } from "./dom.js";
import { titleOf } from "./feature_card.js";
import { middleOf } from "./places.js";
import { copy } from "./share.js";
import { siteName } from "./sites.js";
import { bytes, counted, length, place, time } from "./words.js";
import { zip } from "./zip.js";

const COLUMNS = ["id", "what", "kind", "class", "score", "latitude", "longitude", "coordinates", "sigma_m", "length_m", "area_m2", "first_seen", "last_seen", "flight", "review", "reviewer", "note"];

/** The panel's life. */
export function exportPanel(screen, body) {
  const shown = el("div", {});
  const files = el("div", {});
  const copied = el("span", { class: "soft", role: "status" });
  const link = async () => {
    await copy(`${location.origin}/#/site/${encodeURIComponent(screen.data.id)}/${screen.room}`);
    fill(copied, "Link copied");
  };
  fill(body, el("div", { class: "row wrap" }, button("Copy link", link, { class: "main" }), copied),
    el("p", { class: "note" }, "Who opens it needs a token of their own where the station has tokens."), el("h3", {}, "What is shown"), shown,
    el("div", { class: "row wrap" }, button("Print or PDF", () => print(screen))), el("details", { open: true }, el("summary", {}, "All files"), files));

  function refresh() {
    const features = shownFeatures(screen);
    const local = screen.data.detail.is_local;
    fill(shown, el("p", { class: "soft" }, `${counted(features.length, "feature")}: the filters and the area of interest apply.`),
      el("div", { class: "row wrap" },
        button("GeoJSON", () => save(geojson(features), "geojson", "application/geo+json")),
        button("CSV", () => save(csv(features), "csv", "text/csv")),
        local ? null : button("KMZ", () => save(zip({ "doc.kml": new TextEncoder().encode(kml(screen.data.detail.name, features)) }, "application/vnd.google-earth.kmz"), "kmz"))));
  }

  function save(content, ending, type) {
    const name = screen.data.detail.name.replaceAll(/[^\w.-]+/g, "_");
    download(content instanceof Blob ? content : new Blob([content], { type }), `${name}.${ending}`);
  }

  async function load() {
    fill(files, el("p", { class: "soft" }, "Looking…"));
    try {
      const list = await get(siteUrl(screen.data.id, "exports"));
      fill(files, list.length ? el("ul", { class: "plain files" }, list.map((each) => el("li", {},
        el("a", { href: each.url, download: each.name ?? "" }, each.title ?? each.name), el("span", { class: "soft" }, each.bytes ? ` ${bytes(each.bytes)}` : "", each.note ? ` · ${each.note}` : ""))))
        : el("p", { class: "hint" }, "No files yet: they come with the first map."));
    } catch (problem) {
      if (problem.status === 404) fill(files, el("p", { class: "hint" }, "This station offers no files; they lie in the site's folder."));
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
  return [...(on("changes") ? data.shown("changes") : []), ...(on("objects") ? data.shown("objects") : []), ...(screen.zones ?? [])];
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
  const up = Math.abs(bearing) < 0.5 ? "north up" : `up is ${Math.round((bearing + 360) % 360)}° from north`;
  return `the picture is ${length(width)} wide, ${up}, its middle at ${place(middle, { local: screen.data.detail.is_local })}`;
}

/** Features as GeoJSON text, one a line. */
export function geojson(features) {
  const lines = features.map(({ type, id, geometry, properties: { crops, ...properties } }) => JSON.stringify({ type, id, geometry, properties }));
  return `{"type": "FeatureCollection", "features": [\n${lines.join(",\n")}\n]}\n`;
}

/** Features as CSV (RFC 4180); a cell that a spreadsheet would run as a formula gets an apostrophe. */
export function csv(features) {
  const cell = (value) => {
    let text = value === null || value === undefined ? "" : String(value);
    if (typeof value === "string" && /^[=+\-@\t\r]/.test(text)) text = `'${text}`;
    return /[",\r\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text;
  };
  const rows = features.map((each) => {
    const [lon, lat] = middleOf(each.geometry);
    const values = { ...each.properties, id: each.id, what: each.properties.name ?? titleOf(each), latitude: lat.toFixed(8), longitude: lon.toFixed(8), coordinates: place([lon, lat]) };
    return COLUMNS.map((name) => cell(values[name])).join(",");
  });
  return `${[COLUMNS.join(","), ...rows].join("\r\n")}\r\n`;
}

/** Features as KML. */
export function kml(name, features) {
  const doc = document.implementation.createDocument("http://www.opengis.net/kml/2.2", "kml");
  const add = (parent, tag, text = null) => {
    const node = doc.createElementNS("http://www.opengis.net/kml/2.2", tag);
    if (text !== null) node.textContent = text;
    parent.append(node);
    return node;
  };
  const folder = add(doc.documentElement, "Document");
  add(folder, "name", name);
  const coordinates = (list) => list.map((each) => each.slice(0, 2).join(",")).join(" ");
  for (const feature of features) {
    const mark = add(folder, "Placemark");
    add(mark, "name", feature.properties.name ?? titleOf(feature));
    add(mark, "description", [feature.id, feature.properties.review, feature.properties.note].filter(Boolean).join(" · "));
    const { type, coordinates: places } = feature.geometry;
    if (type === "Point") add(add(mark, "Point"), "coordinates", places.slice(0, 2).join(","));
    else if (type === "Polygon") add(add(add(add(mark, "Polygon"), "outerBoundaryIs"), "LinearRing"), "coordinates", coordinates(places[0]));
    else if (type === "LineString") add(add(mark, "LineString"), "coordinates", coordinates(places));
    else add(add(mark, "Point"), "coordinates", middleOf(feature.geometry).join(","));
  }
  return `<?xml version="1.0" encoding="UTF-8"?>\n${new XMLSerializer().serializeToString(doc)}`;
}

async function print(screen) {
  const features = shownFeatures(screen);
  const picture = screen.view ? el("img", { alt: "The map", src: await screen.view.picture() }) : null;
  const sheet = el("section", { class: "sheet" }, el("h1", {}, siteName(screen.data.detail)), el("p", {}, `${time(new Date().toISOString())}${screen.view ? ` · ${extentWords(screen)}` : ""}`), picture,
    el("table", {}, el("thead", {}, el("tr", {}, ["Id", "What", "Place", "Score", "Verdict", "Note"].map((each) => el("th", {}, each)))),
      el("tbody", {}, features.map((each) => el("tr", {}, [each.id, each.properties.name ?? titleOf(each), place(middleOf(each.geometry), { local: screen.data.detail.is_local }), each.properties.score ? Math.round(each.properties.score * 100) : "",
        each.properties.review ?? "", each.properties.note ?? ""].map((value) => el("td", {}, String(value))))))));
  document.body.append(sheet);
  const done = () => sheet.remove();
  addEventListener("afterprint", done, { once: true });
  const begin = () => window.print();
  if (picture && !picture.complete) picture.addEventListener("load", begin, { once: true });
  else begin();
}
