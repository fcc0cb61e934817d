// Numbers, times and places in words, in the units that this browser's user chose.

import { choices } from "./choices.js";
import { locale, numeral, say } from "./languages.js";
import { mgrs, utm } from "./places.js";

const FOOT_M = 0.3048;
const MILE_M = 1609.344;
const ACRE_M2 = 4046.8564224;

const isNumber = (value) => typeof value === "number" && Number.isFinite(value);

function rounded(value, digits) {
  return numeral(value, digits);
}

export function length(m) {
  if (!isNumber(m)) return "–";
  if (choices.get("units") === "imperial") {
    return Math.abs(m) < MILE_M / 2 ? `${rounded(m / FOOT_M, m < 3 ? 1 : 0)} ft` : `${rounded(m / MILE_M, 2)} mi`;
  }
  return Math.abs(m) < 1000 ? `${rounded(m, Math.abs(m) < 10 ? 2 : 1)} m` : `${rounded(m / 1000, 2)} km`;
}

export function area(m2) {
  if (!isNumber(m2)) return "–";
  if (choices.get("units") === "imperial") {
    return m2 < ACRE_M2 / 4 ? `${rounded(m2 / FOOT_M ** 2, 0)} ft²` : `${rounded(m2 / ACRE_M2, 2)} acres`;
  }
  return m2 < 10000 ? `${rounded(m2, m2 < 10 ? 2 : m2 < 100 ? 1 : 0)} m²` : `${rounded(m2 / 10000, 2)} ha`;
}

export function speed(m_s) {
  if (!isNumber(m_s)) return "–";
  return choices.get("units") === "imperial" ? `${rounded(m_s / MILE_M * 3600, 1)} mph` : `${rounded(m_s, 1)} m/s`;
}

export const percent = (share) => (isNumber(share) ? `${Math.round(share * 100)} %` : "–");

export const number = (value, digits = 1) => (isNumber(value) ? rounded(value, digits) : "–");

export function bytes(count) {
  if (!isNumber(count)) return "–";
  const units = ["B", "kB", "MB", "GB", "TB"];
  const power = Math.min(units.length - 1, Math.floor(Math.log10(Math.max(1, count)) / 3));
  return `${rounded(count / 1000 ** power, power ? 1 : 0)} ${units[power]}`;
}

/** Seconds as 1:05 or 1:02:03. */
export function duration(seconds) {
  if (!isNumber(seconds)) return "–";
  const whole = Math.max(0, Math.round(seconds));
  const two = (value) => String(value).padStart(2, "0");
  const hours = Math.floor(whole / 3600);
  return `${hours ? `${hours}:${two(Math.floor(whole / 60) % 60)}` : Math.floor(whole / 60)}:${two(whole % 60)}`;
}

function said(iso, how, zone = " UTC", unknown = "–") {
  const at = new Date(iso);
  const isUtc = choices.get("clock") === "utc";
  if (!iso || Number.isNaN(at.getTime())) return unknown;
  return at.toLocaleString(locale, { ...how, timeZone: isUtc ? "UTC" : undefined }) + (isUtc ? zone : "");
}

export const time = (iso) => said(iso, { dateStyle: "medium", timeStyle: "short" });
export const clock = (iso) => said(iso, { timeStyle: "medium" });
/** Its date as 2026-05-01, to be compared; "" where it is not known. */
export const dateOf = (iso) => (iso ? new Date(iso).toLocaleDateString("sv-SE", { timeZone: choices.get("clock") === "utc" ? "UTC" : undefined }) : "");
export const day = (iso) => said(iso, { dateStyle: "medium" }, "", say("undated"));

const metres = (value, digits) => String(Math.round(value)).padStart(digits, "0");

/** Degrees, minutes and seconds to a third of a metre. */
function sexagesimal([lon, lat]) {
  const part = (value, [plus, minus]) => {
    const hundredths = Math.round(Math.abs(value) * 360000);
    const seconds = (hundredths % 6000) / 100;
    return `${Math.floor(hundredths / 360000)}°${String(Math.floor(hundredths / 6000) % 60).padStart(2, "0")}'${seconds.toFixed(2).padStart(5, "0")}"${value < 0 ? minus : plus}`;
  };
  return `${part(lat, "NS")} ${part(lon, "EW")}`;
}

/** A place [lon, lat] in one system: "latlon", "dms", "utm" or "mgrs"; beyond the last two's ends in degrees. */
export function placeIn(kind, [lon, lat]) {
  const degrees = `${lat.toFixed(6)}, ${lon.toFixed(6)}`;
  if (kind === "dms") return sexagesimal([lon, lat]);
  if (kind === "mgrs") return mgrs(lon, lat) ?? degrees;
  const found = kind === "utm" && utm(lon, lat);
  return found ? `${found.zone}${found.band} ${metres(found.east_m, 6)} ${metres(found.north_m, 7)}` : degrees;
}

/** A place as the user wants it. */
export const place = (at, { local = false } = {}) => (local ? say("no place on Earth (a site without GPS)") : placeIn(choices.get("coordinates"), at));

/** The station's own words in the reader's language: verdicts, classes, why ground was seen badly. What it does not know stays. */
export const VERDICTS = { confirmed: say("confirmed"), rejected: say("rejected"), disputed: say("disputed"), unsure: say("not sure"), none: say("no verdict") };
const CLASS_NAMES = { person: say("person"), car: say("car"), "small object": say("small object") };
const REASONS = {
  "not seen": say("not seen"), "under trees": say("under trees"), "too coarse": say("too coarse"), "motion blur": say("motion blur"), dark: say("dark"), "rough ground": say("rough ground"),
  "too few views": say("too few views"), "seen aslant": say("seen aslant"), "rarely found anywhere": say("rarely found anywhere"), "under a roof": say("under a roof"), "not measured": say("not measured"),
};
export const className = (name) => CLASS_NAMES[name] ?? name;
export const reason = (name) => REASONS[name] ?? name;

/** Who did something; the station calls who needs no token "this machine". */
export const nameOf = (who) => (who === "this machine" ? say("this machine") : who);

export function changeWords({ kind, class_before: was, class_after: is }) {
  const [before, after] = [was, is].map((each) => (each ? className(each) : ""));
  if (kind === "replaced" && before && after) return say("{before} replaced by {after}", { before, after });
  const what = (kind === "disappeared" ? before : after) || say("unknown object");
  switch (kind) {
    case "appeared": return say("{what} appeared", { what });
    case "disappeared": return say("{what} disappeared", { what });
    case "moving": return say("{what} moving", { what });
    case "replaced": return say("{what} replaced", { what });
    default: return kind === "area" ? say("ground changed") : kind;
  }
}
