// The line above every room: what is known, as a result. It never states that nobody is there.

import { say } from "./languages.js";
import { area_m2, polygonsOf } from "./places.js";
import { day, duration, percent } from "./words.js";

const ACTS = { map: say("Mapping"), compare: say("Comparing"), watch: say("Looking for people and vehicles"), search: say("Measuring the search"), demo: say("Making the demo") };
const BAD_ENDS = { failed: say("The last mission failed"), incomplete: say("The last mission is incomplete"), lost: say("The last mission broke off"), stopped: say("The last mission was stopped") };
const LINKS = { late: say("The station answers late"), waiting: say("Connecting"), lost: say("No connection") };

/** A polygon's area without its holes, m2. */
function polygonArea_m2([outer, ...inner]) {
  return inner.reduce((sum, each) => sum - area_m2(each), area_m2(outer));
}

const featureArea_m2 = ({ geometry }) => polygonsOf(geometry).reduce((sum, each) => sum + polygonArea_m2(each), 0);

/** How much of the ground of a measured search was looked at (a share), and with which chance somebody on all of it would
 * have been seen: null without a measured search. */
export function lookedAt(pod) {
  const ofPeople = pod.filter(({ properties }) => (properties.class ?? "person") === "person"); // a search may be for cars
  const seen = ofPeople.filter(({ properties: { kind } }) => kind === "pod");
  const sum = (list, weight) => list.reduce((total, each) => total + featureArea_m2(each) * weight(each.properties), 0);
  const seen_m2 = sum(seen, () => 1);
  const whole_m2 = seen_m2 + sum(ofPeople.filter(({ properties: { reason } }) => reason === "not seen"), () => 1);
  if (!(whole_m2 > 0)) return null;
  return { share: seen_m2 / whole_m2, from: sum(seen, (each) => each.pod_from) / whole_m2, to: sum(seen, (each) => each.pod_to) / whole_m2 };
}

/** Of what was found, what is there by the newest look at each place and by all verdicts. */
export const thereOf = (objects) => objects.filter(({ properties: { review, gone } }) => review !== "rejected" && !gone);

export const openOf = (...lists) => lists.flat().filter(({ properties: { review, gone } }) => !review && !gone);

/**
 * The parts of the sentence: {words, act, kind}. `link` is "live", "late" (kept answers are shown), "waiting" or "lost"; `loaded` "yes", "no" or "failed";
 * `runs` the site's missions, newest first; `drones` the names of those that send from here; objects, changes and pod are ALL features, whatever a filter hides; `now` by the station's clock, ms.
 */
export function sentence({ link, loaded, runs, objects, changes, pod, versions, drones = [], votes = 0, isLow = false, isFull = false, now = 0 }) {
  const parts = [];
  const tell = (words, act = null, kind = "") => parts.push({ words, act, kind });
  if (link !== "live") tell(say("{link}: this may be old", { link: LINKS[link] }), null, "warning");
  if (votes) tell(say("{n} verdict waits to be sent|{n} verdicts wait to be sent", { n: votes }), null, "warning");
  if (isLow || isFull) tell(isFull ? say("The station's disk is full") : say("The disk is nearly full"), null, "warning");
  if (loaded !== "yes") {
    tell(loaded === "failed" ? say("What is known here could not be loaded") : say("Loading what is known"), null, loaded === "failed" ? "warning" : "");
    return parts;
  }
  const running = runs.filter(({ state }) => state === "running");
  const told = new Set(); // two missions on one flight are one flight
  for (const run of running.toReversed()) {
    const { input, mission, started_at: began } = run;
    const hasLanded = runs.some((each) => each.progress?.landed && each.input?.stream === input?.stream && each.started_at >= began);
    const name = hasLanded ? (running.some((each) => each.mission === "watch") ? say("Landed, searching the rest") : say("Landed, finishing the map")) : input?.stream || input?.stream_url ? say("Flying") : ACTS[mission];
    if (!told.has(name)) tell(hasLanded ? name : `${name} ${duration((now - new Date(began)) / 1000)}`, "live");
    told.add(name);
  }
  const videoOf = ({ input }) => input?.stream ?? input?.stream_url;
  const unsearched = [...new Set([...drones, ...running.map(videoOf).filter(Boolean)])].filter((each) => !running.some((run) => videoOf(run) === each && looksForPeople(run)));
  if (unsearched.length) tell(say("the video of {names} is not searched for people", { names: unsearched.join(", ") }), "live", "warning");
  if (!running.length) {
    const newest = versions.at(-1);
    tell(newest ? say("Map of {date}", { date: day(newest.flown_at ?? newest.made_at) }) : say("No map yet"), "live");
    const ending = BAD_ENDS[runs[0]?.state];
    if (ending) tell(ending, "live", "warning");
  }
  tell(...found(objects, pod, running, runs));
  const looked = lookedAt(pod);
  tell(looked ? say("{share} of the ground looked at (a person on it: {from}–{to})", { share: percent(looked.share), from: Math.round(looked.from * 100), to: percent(looked.to) }) : say("the chance to have seen a person is not measured"), "coverage");
  const open = openOf(objects, changes).length;
  const changed = changes.length + objects.reduce((sum, { properties }) => sum + Object.keys(properties.untold ?? {}).length, 0);
  if (changed) tell(say("{n} change|{n} changes", { n: changed }), "compare");
  if (open) tell(say("{n} to review", { n: open }), "review");
  return parts;
}

/** Whether a mission surely looks for people: a model of one's own may not know them. */
const looksForPeople = ({ options }) => /^(default|thermal)/.test(options?.model ?? "default") && (!options?.classes?.length || options.classes.includes("person"));

/** Whether the newest flight was flown into the map by a mission that does not look for people, after the last one that did. */
function isNewer(runs, looks) {
  const flown = runs.find(({ mission, state }) => ["map", "compare"].includes(mission) && state === "finished");
  return Boolean(flown && !looksForPeople(flown) && looks.length && looks.every((each) => each.ended_at && each.ended_at < flown.started_at));
}

/** People first, then all else; where there is no person, why that says little. */
function found(objects, pod, running, runs) {
  const there = thereOf(objects);
  const number = (name) => there.filter(({ properties }) => properties.class === name).length;
  const [people, cars] = [number("person"), number("car")];
  const others = there.length - people - cars;
  const more = [cars ? say("{n} car|{n} cars", { n: cars }) : null, others ? say("{n} other object|{n} other objects", { n: others }) : null].filter(Boolean);
  if (people) return [[say("{n} person|{n} people", { n: people }), ...more].join(", "), "review", "found"];
  const seen = (property) => objects.filter(({ properties }) => properties.class === "person" && property(properties)).length;
  const [rejected, gone] = [seen(({ review }) => review === "rejected"), seen(({ gone: isGone, review }) => isGone && review !== "rejected")];
  const looks = runs.filter((run) => ["watch", "search"].includes(run.mission) && run.state === "finished" && looksForPeople(run));
  const wasLooked = lookedAt(pod) || looks.length;
  const why = rejected || gone
    ? [gone ? say("{n} person on an earlier date only|{n} people on an earlier date only", { n: gone }) : null, rejected ? say("{n} person found and rejected in review|{n} people found and rejected in review", { n: rejected }) : null].filter(Boolean).join(", ")
    : running.some(looksForPeople) ? say("no person found so far") : wasLooked ? (isNewer(runs, looks) ? say("no person found in what was looked at before the newest flight") : say("no person found in what was looked at")) : say("no search for people is on record");
  return [[...more, why].join(", "), "review"];
}
