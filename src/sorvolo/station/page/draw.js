// Drawing on the map: distances, areas and height profiles; areas of interest, alert zones and waypoints, shared by all.

import { get, now, Problem, put, siteUrl } from "./api.js";
import { button, cross, el, fill, message, press, quiet, report, svg } from "./dom.js";
import { isWritten } from "./feature_card.js";
import { say } from "./languages.js";
import { area_m2, boundsOf, featureOf, length_m } from "./places.js";
import { unsent, votes } from "./votes.js";
import { waypointsFor } from "./waypoints.js";
import * as words from "./words.js";

const TOOLS = {
  distance: [say("Distance"), "line", say("Tap points along the line; a double tap ends it.")], area: [say("Area"), "ring", say("Tap the corners; a double tap ends it.")],
  profile: [say("Height profile"), "line", say("Tap points along the line. It needs a map with heights (a flight mapped with heights, or “sorvolo heights”).")],
  interest: [say("Area of interest"), "ring", say("Tap the corners; filters and exports can be kept to it.")],
  alert: [say("Alert zone"), "ring", say("Tap the corners; what is found in it raises an alert on every open page.")],
  waypoint: [say("Waypoint"), "point", say("Tap the place to fly to.")], found: [say("Person seen"), "point", say("Tap where somebody is: a finding of the site.")],
};

const NONE = { features: [], revision: 0 };
const REFUSED = [400, 403, 413, 422]; // by the station, for good

export async function loadDrawings(screen) {
  if (!screen.drawings) show(screen, screen.drawings = NONE);
  if (screen.data.detail.is_new) return;
  try {
    const drawings = await get(siteUrl(screen.data.id, "drawings"));
    if (drawings.revision >= screen.drawings.revision) show(screen, drawings); // else an older answer that came later
  } catch (problem) {
    if (!(problem instanceof Problem)) throw problem;
  }
}

/** Drawings of the screen's site, by whom the page belongs to, that the station does not have yet. */
const unsentOf = ({ data }) => unsent.all.filter(({ site, who }) => site === data.id && who === votes.who).map(({ feature }) => feature);

function show(screen, drawings) {
  const { features } = drawings;
  const mine = unsentOf(screen).filter(({ id }) => !features.some((each) => each.id === id));
  Object.assign(screen, { zones: [...features, ...mine], drawings });
  screen.view?.ready.then(() => screen.view.put("drawings", screen.zones));
}

async function saveDrawings(screen, change) {
  const save = async () => {
    if ((screen.drawings ?? NONE) === NONE) await loadDrawings(screen); // what is there is not known yet
    const { features, revision } = screen.drawings ?? NONE;
    show(screen, await put(siteUrl(screen.data.id, "drawings"), { revision, features: change(features) }));
  };
  try {
    await save();
  } catch (problem) {
    if (problem.status !== 409) throw problem;
    await loadDrawings(screen); // somebody drew meanwhile: put ours into theirs
    await save();
  }
}

/** Send the drawings that wait, one time after another; what the station refuses for good is said and dropped. */
export const sendDrawings = (screen) => (screen.sending = Promise.resolve(screen.sending).catch(() => {}).then(() => send(screen)));

async function send(screen) {
  const mine = unsentOf(screen);
  if (!mine.length) return;
  const isMine = ({ id }) => mine.some((each) => each.id === id);
  try {
    await saveDrawings(screen, (list) => [...list.filter((each) => !isMine(each)), ...mine]);
  } catch (problem) {
    if (!REFUSED.includes(problem.status)) return; // they wait
    report(problem);
  }
  unsent.keep(unsent.all.filter(({ feature }) => !isMine(feature)));
  votes.changed();
  show(screen, screen.drawings ?? NONE);
  if (mine.some(({ properties }) => properties.purpose === "found")) await screen.data.load(["objects"]);
}

export class Draw {
  constructor(screen, body) {
    Object.assign(this, { screen, tool: null, points: [], cursor: null, over: new AbortController() });
    this.live = el("div", { role: "status" });
    this.list = el("div");
    this.may = screen.station.reviews;
    this.buttons = Object.entries(TOOLS).map(([tool, [name]]) => button(name, () => this.take(tool), { data: { tool }, "aria-pressed": false,
      hidden: !this.may && ["interest", "alert", "waypoint", "found"].includes(tool) }));
    fill(body, el("div.tools", { role: "group", "aria-label": say("Tools") }, this.buttons), this.live, this.list,
      this.may ? el("details", el("summary", say("Re-fly gaps")), el("p.note", say("A route over ground that a measured search saw badly; without one, over ground without pictures.")),
        button(say("Plan a route"), () => this.plan())) : null);
    screen.on("drawings.changed", () => loadDrawings(screen).then(() => { if (!isWritten(this.list)) this.showList(); }), this.over);
    loadDrawings(screen).then(() => this.showList());
  }

  take(tool) {
    this.tool = this.tool === tool ? null : tool;
    this.points = [];
    this.pointer = null;
    this.cursor = this.tool ? "crosshair" : null;
    press(this.buttons, (each) => each.dataset.tool === this.tool);
    fill(this.live, this.tool ? el("p.hint", TOOLS[this.tool][2]) : null);
    this.sketch();
    this.screen.view?.map.doubleClickZoom[this.tool ? "disable" : "enable"]();
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
    const features = points.length > 1 ? [this.drawn(points.length > 2 ? shape : "line", points)] : [];
    this.screen.view?.put("sketch", [...features, ...this.points.map((each) => this.drawn("point", [each]))]);
    if (points.length) this.showLive(points, shape);
  }

  drawn(shape, points) {
    const { type, coordinates } = geometryOf(shape, points);
    return featureOf(type, coordinates, { purpose: this.tool });
  }

  back() {
    this.points.pop();
    this.pointer = null;
    this.sketch();
  }

  showLive(points, shape) {
    const closed = shape === "ring";
    fill(this.live,
      el("p.size", closed ? words.area(area_m2(points)) : words.length(length_m(points)),
        closed ? el("small", ` ${say("perimeter {length}", { length: words.length(length_m([...points, points[0]])) })}`) : null),
      el("div.row.wrap", button(say("Done"), () => this.finish(), { class: "main" }),
        quiet(say("Remove last point"), () => this.back()), quiet(say("Cancel"), () => this.take(null))));
  }

  async finish() {
    const { tool, points } = this;
    const [name, shape] = TOOLS[tool];
    if (points.length < { point: 1, line: 2, ring: 3 }[shape]) {
      message(`${name}: ${shape === "ring" ? say("three corners are needed") : say("two points are needed")}`);
      return;
    }
    this.pointer = null;
    if (tool === "profile") await this.profile(points);
    else if (this.may) await this.keep(tool, shape, points);
    else {
      this.take(null);
      fill(this.live, el("p.size", sizeOf(geometryOf(shape, points))));
    }
  }

  async keep(tool, shape, points) {
    const purpose = ["distance", "area"].includes(tool) ? "measure" : tool;
    const count = (this.screen.zones ?? []).filter((each) => each.properties.purpose === purpose).length + 1;
    const geometry = geometryOf(shape, points);
    const name = purpose === "measure" ? sizeOf(geometry) : `${TOOLS[purpose][0]} ${count}`;
    const feature = { type: "Feature", id: crypto.randomUUID?.() ?? String(Date.now()), geometry, properties: { purpose, name, at: new Date(now()).toISOString() } };
    this.take(null);
    unsent.keep([...unsent.all, { site: this.screen.data.id, who: votes.who, feature }]);
    votes.changed();
    show(this.screen, this.screen.drawings ?? NONE);
    await sendDrawings(this.screen);
    this.showList();
    if (purpose === "measure") fill(this.live, el("p.size", name));
  }

  async profile(points) {
    this.take(null);
    this.screen.view?.put("sketch", [featureOf("LineString", points, { purpose: "profile" })]);
    const line = points.map((each) => each.map((value) => value.toFixed(8)).join(",")).join(";");
    try {
      if (!this.screen.data.detail.is_new) await this.screen.data.loadDetail(); // heights made in a terminal are announced by nobody
      if (!this.screen.data.detail.has_heights) {
        fill(this.live, el("p.hint", say("This site has no heights yet. Whoever runs the station can make them with “sorvolo heights”; then try again.")));
        return;
      }
      const found = await get(`${siteUrl(this.screen.data.id, "profile")}?line=${line}`);
      fill(this.live, profilePlot(found), quiet(say("Clear"), () => this.take(null)));
    } catch (problem) {
      fill(this.live, el("p.hint", problem.detail));
    }
  }

  async plan() {
    const made = waypointsFor(this.screen.data);
    if (!made.length) {
      fill(this.live, el("p.hint", say("No gaps to re-fly: no search, flight or comparison of this site left out ground that another flight would show.")));
      return;
    }
    await saveDrawings(this.screen, (list) => [...list.filter((each) => !each.properties.planned), ...made]);
    this.showList();
  }

  showList() {
    const { data } = this.screen;
    const zones = this.screen.zones ?? [];
    const mine = unsentOf(this.screen);
    const route = zones.filter((each) => each.properties.planned);
    fill(this.list, zones.length ? el("h3", say("Drawn here")) : null, el("ul.plain.drawn", zones.filter((each) => !each.properties.planned).map((each) => el("li",
      this.may ? el("input", { type: "text", ".value": each.properties.name ?? "", "aria-label": say("Name"), maxlength: 80, on: { change: (event) => this.rename(each, event.target.value) } }) : each.properties.name,
      el("span.soft", sizeOf(each.geometry), each.properties.by ? ` · ${words.nameOf(each.properties.by)}` : "", mine.some(({ id }) => id === each.id) ? ` · ${say("waits to be sent")}` : ""),
      quiet(say("Show"), () => this.screen.view?.go(each.geometry.type === "Point" ? each.geometry.coordinates : boundsOf([each.geometry]))),
      each.properties.purpose === "interest" ? quiet(say("Filter"), () => this.narrow(each), { "aria-pressed": isArea(data, each) }) : null,
      this.may ? cross(say("Delete {name}", { name: each.properties.name ?? "" }), () => this.remove([each.id])) : null)),
    route.length ? el("li.route", el("b", say("Re-fly route")), el("span.soft", `${say("{n} point|{n} points", { n: route.length })}, ${words.length(length_m(route.map((each) => each.geometry.coordinates)))}`),
      quiet(say("Show"), () => this.screen.view?.go(boundsOf(route.map((each) => each.geometry)))),
      this.may ? quiet(say("Delete"), () => this.remove(route.map((each) => each.id))) : null) : null));
  }

  narrow(zone) {
    this.screen.data.filter({ area: isArea(this.screen.data, zone) ? null : zone.geometry.coordinates[0] });
    this.showList();
  }

  async rename(zone, name) {
    await saveDrawings(this.screen, (list) => list.map((each) => (each.id === zone.id ? { ...each, properties: { ...each.properties, name } } : each)));
  }

  async remove(ids) {
    unsent.keep(unsent.all.filter(({ feature }) => !ids.includes(feature.id)));
    votes.changed();
    if (this.screen.zones.some((each) => ids.includes(each.id) && isArea(this.screen.data, each))) this.screen.data.filter({ area: null });
    await saveDrawings(this.screen, (list) => list.filter((each) => !ids.includes(each.id)));
    this.showList();
  }

  key(event) {
    if (!this.tool) return false;
    if (event.key === "Enter") this.finish();
    else if (event.key === "Escape") this.take(null);
    else if (event.key === "Backspace") this.back();
    else return false;
    return true;
  }

  close() {
    this.take(null);
    this.over.abort();
  }
}

/** Whether the filter keeps to a zone. */
const isArea = ({ filters }, { geometry }) => JSON.stringify(filters.area) === JSON.stringify(geometry.coordinates[0]);

const geometryOf = (shape, points) => ({ point: { type: "Point", coordinates: points[0] }, line: { type: "LineString", coordinates: points }, ring: { type: "Polygon", coordinates: [[...points, points[0]]] } })[shape];

/** A drawing's length or area; a point's place. */
function sizeOf({ type, coordinates }) {
  if (type === "Point") return words.place(coordinates);
  return type === "LineString" ? words.length(length_m(coordinates)) : words.area(area_m2(coordinates[0].slice(0, -1)));
}

/** Heights along a line as a drawing with its axis. `found`: distance_m, height_m (null: not known), and sigma_m. */
function profilePlot({ distance_m: along, height_m: heights, sigma_m: sigma }) {
  const known = heights.filter((each) => each !== null);
  if (!known.length) return el("p.hint", say("No height is known along this line."));
  const [low, high] = [Math.min(...known), Math.max(...known)];
  const [wide, tall] = [300, 130];
  const x = (m) => 4 + (m / along.at(-1)) * (wide - 8);
  const y = (m) => tall - 22 - ((m - low) / Math.max(high - low, 0.5)) * (tall - 40);
  let path = "";
  heights.forEach((each, k) => { if (each !== null) path += `${path && heights[k - 1] !== null ? "L" : "M"}${x(along[k]).toFixed(1)} ${y(each).toFixed(1)}`; });
  const label = (text, at, top, anchor) => svg("text", { x: at, y: top, "text-anchor": anchor, class: "label" }, text);
  return el("figure.profile", svg("svg", { viewBox: `0 0 ${wide} ${tall}`, role: "img", "aria-label": say("Heights from {low} to {high} over {length}", { low: words.length(low), high: words.length(high), length: words.length(along.at(-1)) }) },
    svg("path", { d: path, class: "line" }), label(words.length(high), 4, 12, "start"), label(words.length(low), 4, tall - 24, "start"), label(words.length(along.at(-1)), wide - 4, tall - 6, "end"), label("0", 4, tall - 6, "start")),
  el("figcaption", [say("Difference {length}", { length: words.length(high - low) }), sigma ? `, ${say("accuracy of a height {sigma} (1 sigma)", { sigma: words.length(sigma) })}` : ""]));
}
