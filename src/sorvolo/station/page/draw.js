// Drawing on the map: distances, areas and height profiles; areas of interest, alert zones and waypoints, shared by all.

import { get, Problem, put, siteUrl } from "./api.js";
import { button, el, fill, message, svg } from "./dom.js";
import { isWritten } from "./feature_card.js";
import { area_m2, boundsOf, length_m } from "./places.js";
import { waypointsFor } from "./waypoints.js";
import * as words from "./words.js";

const TOOLS = {
  distance: ["Distance", "line", "Tap points along the line; a double tap ends it."], area: ["Area", "ring", "Tap the corners; a double tap ends it."],
  profile: ["Height profile", "line", "Tap points along the line. It needs a map with heights (a flight mapped with heights, or “sorvolo heights”)."],
  interest: ["Area of interest", "ring", "Tap the corners; filters and exports can be kept to it."],
  alert: ["Alert zone", "ring", "Tap the corners; what is found in it raises an alert on every open page."],
  waypoint: ["Waypoint", "point", "Tap the place to fly to."], found: ["Person seen", "point", "Tap where somebody is: a finding of the site."],
};

/** Load a site's shared drawings. */
export async function loadDrawings(screen) {
  screen.zones ??= [];
  if (screen.data.detail.is_new) return;
  try {
    const kept = await get(siteUrl(screen.data.id, "drawings"));
    Object.assign(screen, { zones: kept.features, zonesRevision: kept.revision });
  } catch (problem) {
    if (!(problem instanceof Problem)) throw problem;
  }
  screen.view?.ready.then(() => screen.view.put("drawings", screen.zones));
}

async function saveDrawings(screen, change) {
  const wanted = change(screen.zones ?? []);
  try {
    const kept = await put(siteUrl(screen.data.id, "drawings"), { revision: screen.zonesRevision ?? 0, features: wanted });
    Object.assign(screen, { zones: kept.features, zonesRevision: kept.revision });
  } catch (problem) {
    if (problem.status !== 409) throw problem;
    await loadDrawings(screen); // somebody drew meanwhile: put ours into theirs
    const kept = await put(siteUrl(screen.data.id, "drawings"), { revision: screen.zonesRevision ?? 0, features: change(screen.zones) });
    Object.assign(screen, { zones: kept.features, zonesRevision: kept.revision });
  }
  screen.view?.put("drawings", screen.zones);
}

/** The panel's life. */
export function drawPanel(screen, body) {
  return new Draw(screen, body);
}

class Draw {
  constructor(screen, body) {
    Object.assign(this, { screen, tool: null, points: [], cursor: null });
    this.live = el("div", { role: "status" });
    this.list = el("div", {});
    this.may = screen.station.status.role !== "view";
    this.buttons = Object.entries(TOOLS).map(([tool, [name]]) => el("button", { type: "button", data: { tool }, "aria-pressed": "false",
      hidden: !this.may && ["interest", "alert", "waypoint", "found"].includes(tool), on: { click: () => this.take(tool) } }, name));
    fill(body, el("div", { class: "tools", role: "group", "aria-label": "Tools" }, this.buttons), this.live, this.list,
      this.may ? el("details", {}, el("summary", {}, "Re-fly gaps"), el("p", { class: "note" }, "A route over ground that a measured search saw badly; without one, over ground without pictures."),
        button("Plan a route", () => this.plan())) : null);
    this.hearer = ({ detail }) => { if (detail.site === screen.data.id) loadDrawings(screen).then(() => { if (!isWritten(this.list)) this.showList(); }); };
    screen.station.events.addEventListener("drawings.changed", this.hearer);
    loadDrawings(screen).then(() => this.showList());
  }

  take(tool) {
    this.tool = this.tool === tool ? null : tool;
    this.points = [];
    this.pointer = null;
    this.cursor = this.tool ? "crosshair" : null;
    for (const each of this.buttons) each.setAttribute("aria-pressed", String(each.dataset.tool === this.tool));
    fill(this.live, this.tool ? el("p", { class: "hint" }, TOOLS[this.tool][2]) : null);
    this.sketch();
    if (this.tool) this.screen.view?.map.doubleClickZoom.disable();
    else this.screen.view?.map.doubleClickZoom.enable();
  }

  click(place) {
    if (!this.tool) return false;
    const last = this.points.at(-1);
    const { map } = this.screen.view;
    if (last && map.project(last).dist(map.project(place)) < 6) { // the second tap of a double one
      this.finish();
      return true;
    }
    this.points.push(place);
    if (TOOLS[this.tool][1] === "point") this.finish();
    else this.sketch();
    return true;
  }

  move(place) {
    if (!this.tool || !this.points.length) return;
    this.pointer = place;
    this.sketch();
  }

  sketch() {
    const shape = this.tool && TOOLS[this.tool][1];
    const points = this.pointer ? [...this.points, this.pointer] : this.points;
    const features = [];
    if (points.length > 1) features.push({ type: "Feature", properties: { purpose: this.tool }, geometry: shape === "ring" && points.length > 2 ? { type: "Polygon", coordinates: [[...points, points[0]]] } : { type: "LineString", coordinates: points } });
    for (const each of this.points) features.push({ type: "Feature", properties: { purpose: this.tool }, geometry: { type: "Point", coordinates: each } });
    this.screen.view?.put("sketch", features);
    if (points.length > 1 || this.points.length) this.showLive(points, shape);
  }

  showLive(points, shape) {
    const closed = shape === "ring";
    fill(this.live,
      el("p", { class: "size" }, closed ? words.area(area_m2(points)) : words.length(length_m(points)),
        closed ? el("small", {}, ` perimeter ${words.length(length_m([...points, points[0]]))}`) : null),
      el("div", { class: "row wrap" }, button("Done", () => this.finish(), { class: "main" }),
        button("Remove last point", () => { this.points.pop(); this.pointer = null; this.sketch(); }, { class: "quiet" }), button("Cancel", () => this.take(null), { class: "quiet" })));
  }

  async finish() {
    const { tool, points } = this;
    const [name, shape] = TOOLS[tool];
    if (points.length < { point: 1, line: 2, ring: 3 }[shape]) {
      message(`${name}: ${shape === "ring" ? "three corners are" : "two points are"} needed`);
      return;
    }
    this.pointer = null;
    if (tool === "profile") await this.profile(points);
    else if (this.may) await this.keep(tool, shape, points);
    else {
      this.take(null);
      fill(this.live, el("p", { class: "size" }, sizeOf(geometryOf(shape, points))));
    }
  }

  async keep(tool, shape, points) {
    const purpose = ["distance", "area"].includes(tool) ? "measure" : tool;
    const count = (this.screen.zones ?? []).filter((each) => each.properties.purpose === purpose).length + 1;
    const geometry = geometryOf(shape, points);
    const name = purpose === "measure" ? sizeOf(geometry) : `${TOOLS[purpose][0]} ${count}`;
    const feature = { type: "Feature", id: crypto.randomUUID?.() ?? String(Date.now()), geometry, properties: { purpose, name } };
    this.take(null);
    await saveDrawings(this.screen, (list) => [...list, feature]);
    this.showList();
    if (purpose === "found") await this.screen.data.load(["objects"]);
    if (purpose === "measure") fill(this.live, el("p", { class: "size" }, name));
  }

  async profile(points) {
    this.take(null);
    this.screen.view?.put("sketch", [{ type: "Feature", properties: { purpose: "profile" }, geometry: { type: "LineString", coordinates: points } }]);
    const line = points.map((each) => each.map((value) => value.toFixed(8)).join(",")).join(";");
    try {
      if (!this.screen.data.detail.is_new) await this.screen.data.loadDetail(); // heights made in a terminal are announced by nobody
      if (!this.screen.data.detail.has_heights) {
        fill(this.live, el("p", { class: "hint" }, "This site has no heights yet. Whoever runs the station can make them with “sorvolo heights”; then try again."));
        return;
      }
      const found = await get(`${siteUrl(this.screen.data.id, "profile")}?line=${line}`);
      fill(this.live, profilePlot(found), button("Clear", () => this.take(null), { class: "quiet" }));
    } catch (problem) {
      fill(this.live, el("p", { class: "hint" }, problem.detail));
    }
  }

  async plan() {
    const made = waypointsFor(this.screen.data);
    if (!made.length) {
      fill(this.live, el("p", { class: "hint" }, "No gaps to re-fly: no search, flight or comparison of this site left out ground that another flight would show."));
      return;
    }
    await saveDrawings(this.screen, (list) => [...list.filter((each) => !each.properties.planned), ...made]);
    this.showList();
  }

  showList() {
    const { data } = this.screen;
    const zones = this.screen.zones ?? [];
    const route = zones.filter((each) => each.properties.planned);
    fill(this.list, zones.length ? el("h3", {}, "Drawn here") : null, el("ul", { class: "plain drawn" }, zones.filter((each) => !each.properties.planned).map((each) => el("li", {},
      this.may ? el("input", { type: "text", ".value": each.properties.name ?? "", "aria-label": "Name", maxlength: 80, on: { change: (event) => this.rename(each, event.target.value) } }) : each.properties.name,
      el("span", { class: "soft" }, sizeOf(each.geometry), each.properties.by ? ` · ${each.properties.by}` : ""),
      button("Show", () => this.screen.view?.go(each.geometry.type === "Point" ? each.geometry.coordinates : boundsOf([each.geometry])), { class: "quiet" }),
      each.properties.purpose === "interest" ? el("button", { type: "button", class: "quiet", "aria-pressed": String(data.filters.area === each.geometry.coordinates[0]), on: { click: () => this.narrow(each) } }, "Filter") : null,
      this.may ? el("button", { type: "button", class: "quiet", "aria-label": `Delete ${each.properties.name ?? ""}`, on: { click: () => this.remove([each.id]) } }, "×") : null)),
    route.length ? el("li", { class: "route" }, el("b", {}, "Re-fly route"), el("span", { class: "soft" }, `${words.counted(route.length, "point")}, ${words.length(length_m(route.map((each) => each.geometry.coordinates)))}`),
      button("Show", () => this.screen.view?.go(boundsOf(route.map((each) => each.geometry))), { class: "quiet" }),
      this.may ? button("Delete", () => this.remove(route.map((each) => each.id)), { class: "quiet" }) : null) : null));
  }

  narrow(zone) {
    const ring = zone.geometry.coordinates[0];
    this.screen.data.filter({ area: this.screen.data.filters.area === ring ? null : ring });
    this.showList();
  }

  async rename(zone, name) {
    await saveDrawings(this.screen, (list) => list.map((each) => (each.id === zone.id ? { ...each, properties: { ...each.properties, name } } : each)));
  }

  async remove(ids) {
    if (this.screen.zones.some((each) => ids.includes(each.id) && this.screen.data.filters.area === each.geometry.coordinates[0])) this.screen.data.filter({ area: null });
    await saveDrawings(this.screen, (list) => list.filter((each) => !ids.includes(each.id)));
    this.showList();
  }

  key(event) {
    if (!this.tool) return false;
    if (event.key === "Enter") this.finish();
    else if (event.key === "Escape") this.take(null);
    else if (event.key === "Backspace") { this.points.pop(); this.pointer = null; this.sketch(); } else return false;
    return true;
  }

  close() {
    this.take(null);
    this.screen.station.events.removeEventListener("drawings.changed", this.hearer);
  }
}

const geometryOf = (shape, points) => ({ point: { type: "Point", coordinates: points[0] }, line: { type: "LineString", coordinates: points }, ring: { type: "Polygon", coordinates: [[...points, points[0]]] } })[shape];

/** A drawing's length or area; a point's place. */
function sizeOf({ type, coordinates }) {
  if (type === "Point") return words.place(coordinates);
  return type === "LineString" ? words.length(length_m(coordinates)) : words.area(area_m2(coordinates[0].slice(0, -1)));
}

/** Heights along a line as a drawing with its axis. `found`: distance_m, height_m (null: not known), and sigma_m. */
function profilePlot({ distance_m: along, height_m: heights, sigma_m: sigma }) {
  const known = heights.filter((each) => each !== null);
  if (!known.length) return el("p", { class: "hint" }, "No height is known along this line.");
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const [wide, tall] = [300, 130];
  const x = (m) => 4 + (m / along.at(-1)) * (wide - 8);
  const y = (m) => tall - 22 - ((m - low) / Math.max(high - low, 0.5)) * (tall - 40);
  let path = "";
  heights.forEach((each, k) => { if (each !== null) path += `${path && heights[k - 1] !== null ? "L" : "M"}${x(along[k]).toFixed(1)} ${y(each).toFixed(1)}`; });
  const label = (text, at, top, anchor) => svg("text", { x: at, y: top, "text-anchor": anchor, class: "label" }, text);
  return el("figure", { class: "profile" }, svg("svg", { viewBox: `0 0 ${wide} ${tall}`, role: "img", "aria-label": `Heights from ${words.length(low)} to ${words.length(high)} over ${words.length(along.at(-1))}` },
    svg("path", { d: path, class: "line" }), label(words.length(high), 4, 12, "start"), label(words.length(low), 4, tall - 24, "start"), label(words.length(along.at(-1)), wide - 4, tall - 6, "end"), label("0", 4, tall - 6, "start")),
  el("figcaption", {}, `Difference ${words.length(high - low)}${sigma ? `, accuracy of a height ${words.length(sigma)} (1 sigma)` : ""}`));
}
