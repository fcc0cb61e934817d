// The data of one site in the page: features as loaded and as live events change them, filters, what is chosen.

import { features, get, kept, siteUrl } from "./api.js";
import { tab } from "./choices.js";
import { ALL, passing } from "./filters.js";
import { votes } from "./votes.js";

const NAMES = ["objects", "changes", "frames", "track", "coverage", "pod"];

/** Fires `data` (detail: the names that changed), `filters`, `chosen`. `detail` is the site as the station states it. */
export class SiteData extends EventTarget {
  constructor(detail) {
    super();
    this.detail = detail;
    this.id = detail.id;
    this.all = Object.fromEntries(NAMES.map((name) => [name, []]));
    this.kept = `sorvolo-filters-${detail.id}`;
    this.filters = { ...ALL, ...JSON.parse(tab.get(this.kept)) };
    this.chosen = null;
    this.turns = {}; // of loading, by name: an answer that a later one has overtaken is not shown
    this.isOld = false; // something of it was kept by the service worker, and not the station's answer
    this.versions = null; // [from, to] of a comparison that narrows the changes
  }

  async load(names = NAMES) {
    const before = kept.answers;
    await Promise.all(names.map(async (name) => {
      const mine = this.turns[name] = (this.turns[name] ?? 0) + 1;
      const stated = (await this.ask(name)).filter(({ properties }) => properties.class !== "thing"); // that is among the changes
      if (mine !== this.turns[name]) return;
      for (const { properties } of stated) if (properties.review === "none") properties.review = null; // withdrawn: open again
      const watched = this.all[name].filter((each) => each.properties.watched && !stated.some((other) => isOf(other, each.id)));
      this.all[name] = [...stated, ...watched]; // what a running watch has just found is not in its file yet
    }));
    this.isOld ||= kept.answers > before;
    this.expect();
    this.changed(names);
  }

  ask(name) {
    return features(this.id, name === "objects" ? "findings" : name);
  }

  async loadDetail() {
    this.detail = await get(siteUrl(this.id));
    this.changed(["detail"]);
  }

  changed(names) {
    if (this.chosen) this.chosen = this.find(this.chosen.id) ?? this.chosen;
    this.dispatchEvent(new CustomEvent("data", { detail: names }));
  }

  /** The objects or changes that the filters let through. */
  shown(name) {
    let list = this.all[name];
    if (name === "changes" && this.versions) {
      const [low, high] = [Math.min(...this.versions), Math.max(...this.versions)];
      list = list.filter(({ properties: { version } }) => version === undefined || version === null || (version > low && version <= high));
    }
    if (name === "objects") { // of the versions that are compared, else of the newest look at each place
      const dates = (this.detail.versions ?? []).filter(({ n }) => this.versions?.includes(n)).map(({ flight }) => flight);
      list = list.filter(({ properties: { flights, gone } }) => !flights || (this.versions ? flights.some((each) => dates.includes(each)) : !gone));
    }
    return name === "objects" || name === "changes" ? passing(list, this.filters) : list;
  }

  /** What came or left by the searches of two dates alone, where no comparison of pictures shows a change; of the versions that are compared. */
  untold() {
    const [low, high] = this.versions ? [Math.min(...this.versions), Math.max(...this.versions)] : [0, Infinity];
    const flights = (this.detail.versions ?? []).filter(({ n }) => n > low && n <= high).map(({ flight }) => flight);
    return passing(this.all.objects, this.filters).flatMap((each) => Object.entries(each.properties.untold ?? {}).filter(([flight]) => flights.includes(flight)).map(([, kind]) => (
      { ...each, properties: { ...each.properties, kind, [kind === "appeared" ? "class_after" : "class_before"]: each.properties.class, untold: {} } })));
  }

  filter(change) {
    this.filters = { ...this.filters, ...change };
    tab.set(this.kept, JSON.stringify(this.filters)); // for a reload
    this.dispatchEvent(new Event("filters"));
  }

  /** Another screen is shown: a later one begins without filters. */
  close() {
    tab.set(this.kept, null);
  }

  find(id) {
    return this.all.changes.find((each) => each.id === id) ?? this.all.objects.find((each) => isOf(each, id)) ?? null;
  }

  choose(feature) {
    this.chosen = feature;
    this.dispatchEvent(new Event("chosen"));
  }

  /** Put a feature in, in the place of an older one of the same id. */
  take(name, feature) {
    const list = this.all[name];
    const at = list.findIndex((each) => each.id === feature.id);
    if (at < 0) list.push(feature);
    else list[at] = { ...list[at], ...feature, properties: { ...list[at].properties, ...feature.properties } };
    this.changed([name]);
  }

  drop(name, id) {
    this.all[name] = this.all[name].filter((each) => each.id !== id);
    this.changed([name]);
  }

  /** Show the votes that wait to be sent over what the station states. */
  expect() {
    for (const { site, kind, id, verdict, note } of votes.mine) {
      const found = site === this.id && this.all[kind === "change" ? "changes" : "objects"].find((each) => isOf(each, id));
      if (!found) continue;
      if (verdict) found.properties.review = verdict === "none" ? null : verdict;
      Object.assign(found.properties, { note, waiting: true });
    }
  }

  /** A vote came, ours or another's: how all stand. What a running watch found has another id in the station's list. */
  async judge({ kind, id, verdict, state, note, revision, who, at }) {
    const name = kind === "change" ? "changes" : "objects";
    const found = this.all[name].find((each) => isOf(each, id));
    if (!found) return this.load([name]).catch(() => {});
    if ((found.properties.revision ?? 0) > revision) return;
    Object.assign(found.properties, { review: verdict === "none" ? null : verdict, note, revision, review_state: state, reviewer: who, reviewed_at: at, waiting: false });
    this.expect();
    this.changed([name]);
  }
}

/** Whether a feature has an id, or a sighting of it. */
const isOf = (feature, id) => feature.id === id || (feature.properties.sightings ?? []).includes(id);

/** Whether a feature is a change; else it is an object. */
export const isChange = (feature) => feature.properties.kind !== undefined;

export function grouped(list, keyOf) {
  const groups = new Map();
  for (const each of list) groups.set(keyOf(each), [...(groups.get(keyOf(each)) ?? []), each]);
  return groups;
}

const isPerson = ({ properties }) => properties.class === "person";

/** Features in an order, people before all else. */
export const peopleFirst = (list, order) => [...list].sort((one, other) => isPerson(other) - isPerson(one) || order(one, other));

export const newestFirst = (one, other) => String(other.properties.first_seen ?? "").localeCompare(one.properties.first_seen ?? "");

/** The addresses of a feature's pictures: none while the mission that announced it runs. */
export const cropsOf = (feature) => feature.properties.crops ?? [];
