// The running flight: the drone on the map, its track, tiles that change, people found, zones that raise an alert.

import { choices } from "./choices.js";
import { button, el, fill, message } from "./dom.js";
import { featureOf, inRing, middleOf } from "./places.js";
import { titleOf } from "./feature_card.js";
import { say } from "./languages.js";
import { openOf, thereOf } from "./sentence.js";
import * as words from "./words.js";

const PLACED_FOR_MS = 3000; // a frame's place counts for so long before telemetry alone is shown
const FORGOTTEN_MS = 10000;
const CLOCKS_AGREE_S = 0.5;
const WORLD_ZOOM = 6; // a map of no ground yet
const LONGEST_DELAY_S = 600; // more is a recording, or a clock that is wrong

/** Follows the site's live events while its screen is shown; `figures(run)` are a mission's own. */
export class Live {
  constructor(screen) {
    Object.assign(this, { screen, flown: new Map(), drones: new Map(), alerted: new Set(), follows: true });
    const on = screen.on.bind(screen);
    on("map.tiles", (data) => screen.view?.ready.then(() => this.refresh(data)));
    on("coverage.changed", () => this.coverSoon());
    on("frame.placed", (data, event) => this.placed(data, event));
    on("run.started", (data, event) => this.started(data, event));
    on("run.progress", (data, event) => this.progressed(data, event));
    for (const type of ["run.finished", "run.failed", "run.stopped"]) on(type, (data, event) => this.ended(type, data, event));
    on("object.found", ({ feature }, event) => this.found("objects", watched(feature, event.run)));
    on("person.found", ({ feature, is_local: local }, event) => this.person(feature, local, event.run));
    on("change.announced", ({ feature }) => this.found("changes", feature));
    on("change.withdrawn", ({ feature, id }) => screen.data.drop("changes", feature?.id ?? id));
  }

  refresh({ revision, bounds }) {
    if (this.screen.closed || !this.screen.view) return;
    const data = this.screen.data;
    if (!data.detail.bounds_wgs84 && bounds) {
      data.detail.bounds_wgs84 = bounds;
      this.screen.view.go(bounds);
      this.screen.opened?.refresh?.();
    } else if (this.follows && bounds && !this.drones.size && !this.screen.view.shows(bounds)) this.screen.view.go(bounds);
    if (!this.screen.opened?.versions) this.screen.view.refresh(revision, bounds);
  }

  /** Load the holes of the flight in the air anew, once at a time. */
  async coverSoon() {
    if (this.covering) { this.coversAgain = true; return; }
    this.covering = true;
    try {
      do {
        this.coversAgain = false;
        await this.screen.data.load(["coverage"]);
      } while (this.coversAgain && !this.screen.closed);
    } catch { /* the connection's own sign shows it; the next change loads it */ } finally { this.covering = false; }
  }

  /** What a running mission has reported so far. */
  of(run) {
    if (!this.flown.has(run)) this.flown.set(run, { trail: [], progress: null, statuses: {}, reasons: {} });
    return this.flown.get(run);
  }

  started(_, event) {
    this.flown.delete(event.run);
    this.of(event.run);
  }

  progressed(data, event) {
    const run = this.of(event.run);
    run.progress = data;
    if (data.reason) run.reasons[data.reason] = (run.reasons[data.reason] ?? 0) + 1;
  }

  placed(data, event) {
    const run = this.of(event.run);
    const { position } = data;
    run.statuses[data.status] = (run.statuses[data.status] ?? 0) + 1;
    const delay_s = (new Date(event.at) - new Date(data.time)) / 1000;
    // a recorded flight has none, and a drone whose clock is ahead of the station's has none that is known
    run.delay_s = delay_s > -CLOCKS_AGREE_S && delay_s < LONGEST_DELAY_S ? Math.max(0, delay_s) : undefined;
    if (position) run.trail.push(position.slice(0, 2));
    this.drones.set(this.droneOf(event.run), { ...data, placed_at: Date.now() });
    this.drawSoon();
  }

  /** The stream behind a mission; else its own name. */
  droneOf(run) {
    return this.screen.runs.find(({ id }) => id === run)?.input?.stream ?? run;
  }

  /** What a streaming drone states of itself; a mission places it better. */
  heard(stream, telemetry) {
    const { latitude_deg: lat, longitude_deg: lon, camera_yaw_deg: camera, body_yaw_deg: body } = telemetry ?? {};
    const placed_ms = Date.now() - (this.drones.get(stream)?.placed_at ?? 0);
    if (placed_ms < PLACED_FOR_MS) return;
    if (lat === undefined || lat === null) { // nobody knows where it is now
      if (placed_ms > FORGOTTEN_MS && this.drones.delete(stream)) this.drawSoon();
      return;
    }
    this.drones.set(stream, { position: [lon, lat], heading_deg: body ?? camera ?? 0 });
    this.drawSoon();
  }

  /** Draw at most once for each picture of the screen, however many frames came. */
  drawSoon() {
    this.drawing ??= requestAnimationFrame(() => {
      this.drawing = null;
      this.draw();
    });
  }

  draw() {
    const { view, data } = this.screen;
    if (!view || this.screen.closed || this.screen.opened?.put) return; // Compare shows ground
    view.put("drone", [...this.drones.values()].flatMap(droneFeatures));
    const trails = [...this.flown.values()].filter(({ trail }) => trail.length > 1);
    view.put("track", [...data.all.track, ...trails.map(({ trail }) => featureOf("LineString", trail))]);
    const { position } = this.drones.values().next().value ?? {};
    const zoom = view.map.getZoom();
    if (this.follows && position && (zoom < WORLD_ZOOM || !view.isCentral(position.slice(0, 2)))) view.go(position.slice(0, 2), zoom < WORLD_ZOOM ? 18 : zoom);
  }

  found(name, feature) {
    if (!feature) return;
    feature.id ??= feature.properties.id;
    this.screen.data.take(name, feature);
    const middle = middleOf(feature.geometry);
    for (const zone of this.screen.zones ?? []) {
      if (zone.properties.purpose !== "alert" || this.alerted.has(feature.id) || !inRing(middle, zone.geometry.coordinates[0])) continue;
      this.alerted.add(feature.id);
      this.alert(zone, feature);
    }
  }

  alert(zone, feature) {
    message(`${zone.properties.name || say("Alert zone")}: ${titleOf(feature)}`, { kind: "alert", todo: words.place(middleOf(feature.geometry)),
      act: button(say("Show"), () => this.showFound(feature)) });
    if (choices.get("sound")) beep();
  }

  /** Its card, beside its place on the map. */
  showFound(feature) {
    if (!["live", "layers"].includes(this.screen.shown)) this.screen.open("live");
    this.screen.data.choose(this.screen.data.find(feature.id) ?? feature);
    this.screen.goTo(feature);
  }

  /** A person was found, by whatever mission: one banner for each mission, which stays until it is closed. */
  person(feature, local, run) {
    const mission = this.of(run);
    // sightings: while a flight goes on, one person may be found twice, and the sentence alone counts people
    mission.people = (mission.people ?? 0) + 1;
    mission.banner?.remove(); // another mission's stays: it is of another flight
    const place = local || !feature.geometry ? say("without a place on Earth") : words.place(middleOf(feature.geometry));
    mission.banner = message(mission.people > 1 ? say("People seen {n} times, the last:", { n: mission.people }) : say("Person found"), { kind: "alert person", todo: place,
      act: local || !feature.geometry ? null : button(say("Show"), () => this.showFound(watched(feature, run))) });
    if (choices.get("sound")) beep();
  }

  ended(type, data, event) {
    this.flown.delete(event.run);
    this.drones.delete(this.droneOf(event.run));
    this.drawSoon();
    if (type === "run.failed") message(say("The mission failed"), { kind: "error", todo: data.error || data.headline || say("“Live” states why."), act: this.screen.shown === "live" ? null : button(say("Live"), () => this.screen.open("live", true)) });
    else if (data.state === "incomplete") message(say("Check this result before you use it"), { kind: "warning", todo: data.headline });
  }

  /** A mission ended well, and what it found is loaded: what is there to be looked at, people first. */
  done({ headline }) {
    const { objects, changes } = this.screen.data.all;
    const people = thereOf(objects).filter(({ properties }) => properties.class === "person").length;
    const open = openOf(objects, changes).length;
    const result = [people ? say("{n} person|{n} people", { n: people }) : null, open ? say("{n} to review", { n: open }) : say("nothing new to review")].filter(Boolean).join(", ");
    message(say("The mission is done: {result}", { result }), { todo: headline, act: open ? button(say("Findings"), () => this.screen.open("findings", true)) : null });
  }

  figures(id) {
    const run = this.flown.get(id);
    const { matched, selected, latency_s: latency_s } = run?.progress ?? {};
    if (!run || (selected === undefined && run.delay_s === undefined)) return "";
    const byGps = run.statuses["gps-only"] ?? 0;
    const rejected = selected === undefined ? 0 : Math.max(0, selected - matched - byGps);
    const delay_s = latency_s ?? run.delay_s;
    return [selected === undefined ? null : say("{matched} of {n} frame matched|{matched} of {n} frames matched", { matched, n: selected }), byGps ? say("{n} placed by GPS", { n: byGps }) : null,
      rejected ? `${say("{n} rejected", { n: rejected })}${Object.keys(run.reasons).length ? ` (${Object.entries(run.reasons).map(([why, count]) => `${count} × ${why}`).join(", ")})` : ""}` : null,
      delay_s === undefined ? null : say("{seconds} s behind", { seconds: delay_s })].filter(Boolean).join(", ");
  }

  close() {
    cancelAnimationFrame(this.drawing);
  }
}

/** An object that a watch reported: it stands on no map, so its id is the mission's own. */
function watched(feature, run) {
  if (!feature?.geometry) return null;
  const id = `${run}:${feature.id ?? feature.properties.id}`;
  return { ...feature, id, properties: { ...feature.properties, id, watched: true } };
}

/** What is drawn of the drone: itself, the ground in its picture, and the lines of sight to that ground's corners. */
function droneFeatures({ position, footprint, heading_deg: heading }) {
  const features = [];
  const ring = footprint?.coordinates?.[0] ?? footprint;
  const add = (part, type, coordinates, more) => features.push(featureOf(type, coordinates, { part, ...more }));
  if (Array.isArray(ring) && ring.length > 3) {
    const closed = String(ring[0]) === String(ring.at(-1)) ? ring : [...ring, ring[0]];
    add("footprint", "Polygon", [closed]);
    if (position) add("view", "MultiLineString", closed.slice(0, 4).map((corner) => [position.slice(0, 2), corner.slice(0, 2)]));
  }
  if (position) add("body", "Point", position.slice(0, 2), { heading_deg: heading ?? 0 });
  return features;
}

let sound = null;

function beep() {
  try {
    sound ??= new AudioContext();
    const tone = sound.createOscillator();
    const loud = sound.createGain();
    loud.gain.value = 0.12;
    tone.frequency.value = 880;
    tone.connect(loud).connect(sound.destination);
    tone.start();
    tone.stop(sound.currentTime + 0.25);
  } catch { /* a browser without sound shows the message alone */ }
}
