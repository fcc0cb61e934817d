// The map of a site: MapLibre with the mosaic's tiles, and the data of the site over it.

import * as maplibre from "./vendor/maplibre-gl.mjs";
import { siteUrl } from "./api.js";
import { choices, isDark } from "./choices.js";
import { say } from "./languages.js";
import { FADED, GROUPS, groundColour, mapStyle, pictures } from "./map_style.js";
import { distance_m, tileColumn, tileRow } from "./places.js";

const EARTH_M_PER_PX = 156543.034; // of a tile of 256 px at zoom 0, on the equator
const REFRESH_MS = 300;
const MOST_CHANGES = 500; // that are remembered of the growing map

export function canDraw() {
  return Boolean(document.createElement("canvas").getContext("webgl2"));
}

/**
 * The map in a container. `ready` is fulfilled once it can be drawn on. Events of clicks go to `onClick(place, hits)` with
 * [lon, lat] and the features below.
 */
export class MapView {
  constructor(container, site, { onClick = () => {}, onMove = () => {}, onDrag = () => {}, bare = false } = {}) {
    this.site = site;
    this.version = null;
    this.data = {};
    this.changes = []; // of the growing map: which bounds each revision touched
    this.base = null; // the revision of all that none of them touched
    this.fresh = [];
    const { layers, ...style } = mapStyle(isDark());
    this.groups = {};
    for (const each of layers) if (each.group) (this.groups[each.group] ??= []).push(each.id);
    style.layers = layers.map(({ group, ...each }) => (group && !this.isShown(group) ? { ...each, layout: { ...each.layout, visibility: "none" } } : each));
    this.map = new maplibre.Map({
      container, style, attributionControl: false, maxZoom: 24, dragRotate: true, fadeDuration: 0, boxZoom: false, maxTileCacheSize: 0,
      ...(site.bounds_wgs84 ? { bounds: site.bounds_wgs84, fitBoundsOptions: { padding: 30 } } : { center: [0, 20], zoom: 1.5 }),
      transformRequest: (url) => ({ url: this.tileAddress(url) }),
      locale: { "Map.Title": say("Map of the site. Arrow keys move it, plus and minus zoom."), "NavigationControl.ZoomIn": say("Zoom in"), "NavigationControl.ZoomOut": say("Zoom out"),
        "NavigationControl.ResetBearing": say("Drag to rotate, click for north up"), "GeolocateControl.FindMyLocation": say("Where am I?"), "GeolocateControl.LocationNotAvailable": say("This device gives no place") },
    });
    this.map.on("error", (event) => { if (event.error && event.error.status !== 404) console.warn(event.error.message); });
    if (!bare) {
      if (isSecureContext) this.map.addControl(new maplibre.GeolocateControl({ positionOptions: { enableHighAccuracy: true }, trackUserLocation: true }), "top-right");
      this.map.addControl(new maplibre.NavigationControl({ visualizePitch: false }), "top-right");
      this.scale = new maplibre.ScaleControl({ unit: choices.get("units") });
      this.map.addControl(this.scale, "bottom-right");
    }
    this.map.on("click", (event) => onClick([event.lngLat.lng, event.lngLat.lat], this.hits(event.point), event));
    this.map.on("dragstart", onDrag);
    this.map.on("mousemove", (event) => onMove([event.lngLat.lng, event.lngLat.lat], this.hits(event.point)));
    this.ready = new Promise((done) => this.map.once("style.load", () => {
      for (const name of ["coverage", "pod"]) this.map.setPaintProperty(name, FADED[name][0], this.opacity(name));
      for (const [name, picture] of Object.entries(pictures())) this.map.addImage(name, picture);
      for (const [name, features] of Object.entries(this.data)) this.put(name, features); // put before the style was there
      done();
    }));
  }

  isShown(group) {
    return choices.get("layers")[group] ?? GROUPS[group][1];
  }

  /** Show or hide a group of layers; `isKept` for the next time, too. */
  show(group, visible, isKept = true) {
    if (isKept) choices.set("layers", { ...choices.get("layers"), [group]: visible });
    for (const id of this.groups[group] ?? []) if (this.map.getLayer(id)) this.map.setLayoutProperty(id, "visibility", visible ? "visible" : "none");
  }

  opacity(group) {
    return choices.get("layers")[`${group}-opacity`] ?? FADED[group][1];
  }

  /** Make a layer over the ground fainter, for the next time, too. */
  fade(group, opacity) {
    choices.set("layers", { ...choices.get("layers"), [`${group}-opacity`]: opacity });
    if (this.map.getLayer(group)) this.map.setPaintProperty(group, FADED[group][0], opacity);
  }

  /** Follow the page's colours and units. */
  follow() {
    this.map.setPaintProperty("ground", "background-color", groundColour(isDark()));
    this.scale?.setUnit(choices.get("units"));
  }

  /** Put features in the place of those of a source. */
  put(name, features) {
    this.data[name] = features;
    this.map.getSource(name)?.setData({ type: "FeatureCollection", features });
  }

  /** Show the map of a site's detail as it is now: growing, or its newest version. */
  showNewest({ live_revision: live, versions }) {
    this.showVersion(live ? `live-${live}` : versions.at(-1)?.n);
  }

  /** Show a version of the mosaic: a number, or `live-REVISION` of the growing map. */
  showVersion(version) {
    if (version === null || version === undefined || version === this.version) return;
    this.version = version;
    if (String(version).startsWith("live-")) this.base ??= version.slice(5);
    this.groups.mosaic = ["mosaic"];
    if (this.map.getLayer("mosaic")) this.map.removeLayer("mosaic");
    if (this.map.getSource("mosaic")) this.map.removeSource("mosaic");
    const { m_per_px: finest, bounds_wgs84: bounds } = this.site;
    const lat = bounds ? (bounds[1] + bounds[3]) / 2 : 0;
    const deepest = finest ? Math.ceil(Math.log2(EARTH_M_PER_PX * Math.cos(lat * Math.PI / 180) / finest)) : 22;
    this.map.addSource("mosaic", {
      type: "raster", tileSize: 256, minzoom: 8, maxzoom: Math.max(9, Math.min(24, deepest)),
      tiles: [location.origin + siteUrl(this.site.id, "tiles", version, "{z}/{x}/{y}.webp")], // URL() would escape the braces
      ...(bounds && !String(version).startsWith("live") ? { bounds } : {}),
    });
    this.map.addLayer({ id: "mosaic", type: "raster", source: "mosaic", paint: { "raster-fade-duration": 0, "raster-resampling": "linear", "raster-opacity": this.opacity("mosaic") },
      layout: { visibility: this.isShown("mosaic") ? "visible" : "none" } }, "coverage");
  }

  /** Show the pictures put together at a height below the crowns, m; `under` is the site's look through them. */
  showUnderTrees(under, up_m = under?.floor_m) {
    this.groups.trees = ["trees"];
    if (this.map.getLayer("trees")) this.map.removeLayer("trees");
    if (this.map.getSource("trees")) this.map.removeSource("trees");
    if (!under) return;
    this.map.addSource("trees", {
      type: "raster", tileSize: 256, minzoom: 17, maxzoom: 21, ...(this.site.bounds_wgs84 ? { bounds: this.site.bounds_wgs84 } : {}),
      tiles: [location.origin + siteUrl(this.site.id, "under-trees", under.run, up_m, "{z}/{x}/{y}.webp")],
    });
    this.map.addLayer({ id: "trees", type: "raster", source: "trees", paint: { "raster-fade-duration": 0 }, layout: { visibility: this.isShown("trees") ? "visible" : "none" } }, "coverage");
  }

  /** The growing map changed within bounds: only its tiles there are asked for again. */
  refresh(revision, bounds) {
    this.changes.push({ revision, bounds });
    if (this.changes.length > MOST_CHANGES) this.base = this.changes.shift().revision;
    if (!String(this.version).startsWith("live")) return this.showVersion(`live-${revision}`);
    this.fresh.push(bounds);
    this.timer ??= setTimeout(() => this.refreshNow(), REFRESH_MS);
  }

  refreshNow() {
    this.timer = null;
    const fresh = this.fresh.splice(0);
    if (!this.map.getSource("mosaic")) return;
    const view = this.map.getBounds();
    const seen = [view.getWest(), view.getSouth(), view.getEast(), view.getNorth()];
    const zoom = Math.floor(this.map.getZoom()) + 1;
    const tiles = new Map();
    for (const bounds of fresh) {
      for (let z = Math.max(8, zoom - 6); z <= Math.min(24, zoom + 1); z++) {
        for (const tile of tilesWithin(z, bounds ? meet(bounds, seen) : seen)) tiles.set(`${z}/${tile.x}/${tile.y}`, tile);
      }
    }
    if (tiles.size) this.map.refreshTiles("mosaic", [...tiles.values()]);
  }

  /** A tile of the growing map by the revision that touched it last: the others stay in the browser's cache. */
  tileAddress(url) {
    const found = /^(.*\/tiles\/live-)[0-9a-f]+(\/(\d+)\/(\d+)\/(\d+)\.webp)$/.exec(url); // a site's name may begin so, too
    if (!found) return url;
    const [z, x, y] = found.slice(3).map(Number);
    const last = this.changes.findLast(({ bounds }) => !bounds || tileMeets(z, x, y, bounds));
    const revision = last?.revision ?? this.base;
    return revision ? `${found[1]}${revision}${found[2]}` : url;
  }

  hits(point) {
    const layers = ["objects", "changes-fill", "changes-line", "pod-hole-fill", "pod", "drawings-fill", "drawings-point"].filter((id) => this.map.getLayer(id));
    const box = [[point.x - 6, point.y - 6], [point.x + 6, point.y + 6]];
    return this.map.queryRenderedFeatures(box, { layers });
  }

  /** The map as a picture, PNG in a data URL: taken while it is drawn, since nothing keeps it afterwards. */
  picture() {
    return new Promise((done) => {
      this.map.once("render", () => done(this.map.getCanvas().toDataURL("image/png")));
      this.map.triggerRepaint();
    });
  }

  /** How wide the ground on the screen is in its middle, m, and where that middle is. */
  extent() {
    const { lng, lat } = this.map.getCenter();
    const row = this.map.getContainer().clientHeight / 2;
    const [west, east] = [0, this.map.getContainer().clientWidth].map((column) => this.map.unproject([column, row]).toArray());
    return { middle: [lng, lat], width_m: distance_m(west, east), bearing_deg: this.map.getBearing() };
  }

  /** How much of the map's lower part a sheet or a card of a phone lies over, and of its left part a card beside it, px. */
  covered() {
    const whole = this.map.getContainer().getBoundingClientRect();
    const boxes = [...document.querySelectorAll(".card-over, .panel, #messages")].map((each) => each.getBoundingClientRect()).filter((box) => box.height);
    const [wide, narrow] = [true, false].map((is) => boxes.filter((box) => box.width > whole.width * 0.8 === is));
    const low = wide.filter((box) => box.bottom > whole.bottom - whole.height / 3).map((box) => whole.bottom - box.top);
    const left = narrow.filter((box) => box.left > whole.left).map((box) => box.right - whole.left);
    return { low: Math.min(Math.max(0, ...low), whole.height * 0.7), left: Math.min(Math.max(0, ...left), whole.width * 0.7) };
  }

  /** Move to a [lon, lat] or to bounds, where nothing lies over the map. */
  go(place, zoom = 20.5, atOnce = false) {
    const still = atOnce || matchMedia("(prefers-reduced-motion: reduce)").matches;
    const { low, left } = this.covered();
    if (place.length === 4) this.map.fitBounds(place, { padding: { top: 40, left: 40 + left, right: 40, bottom: 40 + low }, maxZoom: 21.5, animate: !still });
    else this.map.easeTo({ center: place, zoom: Math.max(this.map.getZoom(), zoom), offset: [left / 2, -low / 2], animate: !still, duration: 500 });
  }

  /** Whether a place lies in the middle half of what is seen of the map. */
  isCentral(place) {
    const { x, y } = this.map.project(place);
    const { clientWidth: width, clientHeight: height } = this.map.getContainer();
    const { low, left } = this.covered();
    return Math.abs(x - (width + left) / 2) < (width - left) / 4 && Math.abs(y - (height - low) / 2) < (height - low) / 4;
  }

  shows([west, south, east, north]) {
    const view = this.map.getBounds();
    return west < view.getEast() && east > view.getWest() && south < view.getNorth() && north > view.getSouth();
  }

  /** Bring a place into the part of the map that nothing lies over. */
  reveal(place) {
    this.map.resize();
    const { x, y } = this.map.project(place);
    const { clientWidth: width, clientHeight: height } = this.map.getContainer();
    const { low, left } = this.covered();
    if (x < left + 20 || y < 20 || x > width - 20 || y > height - low - 20) this.go(place, 0, true);
  }

  close() {
    clearTimeout(this.timer);
    this.map.remove();
  }
}

/** Let two maps show the same ground, whichever is moved. Gives what ends it. */
export function tie(one, other) {
  let busy = false;
  const copy = (from, to) => () => {
    if (busy) return;
    busy = true;
    to.jumpTo({ center: from.getCenter(), zoom: from.getZoom(), bearing: from.getBearing(), pitch: from.getPitch() });
    busy = false;
  };
  const [there, back] = [copy(one, other), copy(other, one)];
  one.on("move", there);
  other.on("move", back);
  there();
  return () => { one.off("move", there); other.off("move", back); };
}

function tileMeets(z, x, y, [west, south, east, north]) {
  return tileColumn(west, z) <= x + 1 && tileColumn(east, z) >= x && tileRow(north, z) <= y + 1 && tileRow(south, z) >= y;
}

function meet(one, other) {
  return [Math.max(one[0], other[0]), Math.max(one[1], other[1]), Math.min(one[2], other[2]), Math.min(one[3], other[3])];
}

function tilesWithin(z, [west, south, east, north]) {
  const tiles = [];
  if (west > east || south > north) return tiles;
  for (let x = Math.floor(tileColumn(west, z)); x <= tileColumn(east, z); x++) {
    for (let y = Math.floor(tileRow(north, z)); y <= tileRow(south, z) && tiles.length < 400; y++) tiles.push({ z, x, y });
  }
  return tiles;
}
