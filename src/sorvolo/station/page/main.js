// The page's beginning: who is logged in, which screen, the connection to the station.

import { get, post, remove, session, Problem } from "./api.js";
import { applyTheme, choices } from "./choices.js";
import { button, choice, dialog, el, field, fill, message, quiet, report, tick } from "./dom.js";
import { Events } from "./events.js";
import { LANGUAGES, say } from "./languages.js";
import { grouped } from "./site_data.js";
import { showSites } from "./sites.js";
import { unsent, votes } from "./votes.js";
import { bytes, nameOf, VERDICTS } from "./words.js";

const main = document.getElementById("main");
const title = document.getElementById("title");
const linkState = document.getElementById("link-state");
const rooms = document.getElementById("rooms");
const known = document.getElementById("sentence");
const frame = { main, title, rooms, known };

/** What all screens share. */
export const station = {
  status: null, events: null,
  get operates() { return this.status.role === "operate"; },
  get reviews() { return this.status.role !== "view"; },
};

const LINKS = { live: say("Connected"), waiting: say("Connecting"), lost: say("No connection") };
const ROLES = { view: say("view"), review: say("review"), operate: say("operate") };
let screen = null;
let turn = 0;

const siteScreen = () => import("./site.js");

/** What index.html says before there is a script. */
function speak() {
  const found = (name) => document.querySelector(name);
  found(".skip").textContent = say("To the content");
  found("#settings-button .sr").textContent = say("Settings");
  found(".starting").textContent = say("Connecting to the station…");
  found(".brand").ariaLabel = say("Sorvolo: all sites");
  rooms.ariaLabel = say("Rooms");
  known.ariaLabel = say("What is known");
  found("#messages").ariaLabel = say("Messages");
}

async function begin() {
  speak();
  if (location.hash.startsWith("#/site/")) siteScreen(); // beside the first question to the station
  applyTheme();
  document.getElementById("settings-button").addEventListener("click", showSettings);
  choices.addEventListener("change", (event) => { if (event.detail === "theme") applyTheme(); });
  session.addEventListener("needed", () => { if (!declined) showLogin(); });
  addEventListener("hashchange", () => route());
  if (isSecureContext) navigator.serviceWorker?.register("/page/sw.js", { scope: "/" }).catch(() => {}); // without it the page needs the station
  await enter();
}

async function enter() {
  try {
    station.status = await get("/api/status");
  } catch (problem) {
    if (problem.status === 401) return;
    blank(problem.title, problem.detail);
    setTimeout(enter, 3000);
    return;
  }
  votes.who = station.status.name;
  votes.send();
  if (!station.events) listen();
  await route();
}

const blank = (heading, words, ...more) => fill(main, el("div.starting", el("h1", heading), el("p", words), more));

function listen() {
  station.events = new Events(station.status.last_event ?? 0);
  const show = () => {
    const state = station.events.state;
    linkState.className = state;
    const length = votes.waiting.length + unsent.all.length;
    const waiting = say("{n} waiting", { n: length });
    fill(linkState, LINKS[state], length ? [" · ", [...byOthers().values()].length ? button(waiting, showWaiting, { class: "link" }) : waiting] : "");
    if (state !== "live") return;
    for (const each of document.querySelectorAll(".message.away")) each.remove();
    votes.send();
  };
  show();
  votes.addEventListener("change", show);
  votes.addEventListener("refused", ({ detail: { vote, problem } }) => message(say("This verdict was not taken: {why}", { why: problem.title }), { kind: "error",
    todo: `${vote.site}, ${vote.id}: ${[VERDICTS[vote.verdict], vote.note].filter(Boolean).join(", ")}. ${problem.detail}`, act: screen?.refused?.(vote) ?? null }));
  station.events.addEventListener("state", show);
  station.events.addEventListener("reload", () => route());
  station.events.addEventListener("station.disk", ({ detail: { data } }) => disk(data));
}

/** What waits in this browser of people who are not logged in now, by person. */
const byOthers = () => grouped([...votes.waiting, ...unsent.all].filter(({ who }) => who !== votes.who), ({ who }) => who);

/** Whose votes and drawings wait here, and what can be done with them. */
function showWaiting() {
  const list = el("ul.plain");
  const show = () => fill(list, [...byOthers()].map(([who, theirs]) => el("li", el("p", say("{n} verdict or drawing by {name}|{n} verdicts and drawings by {name}", { n: theirs.length, name: nameOf(who) })),
    button(say("Discard for good"), () => {
      votes.keep(votes.waiting.filter((each) => each.who !== who));
      unsent.keep(unsent.all.filter((each) => each.who !== who));
      votes.changed();
      show();
      if (!list.children.length) box.close();
    }))));
  show();
  const box = dialog(say("Waiting in this browser"), list, el("p.note", say("They are sent once their author is logged in here.")), station.status.name === "this machine" ? null : button(say("Log in as somebody else"), logOut));
}

/** The station's disk fell below its floor of free space, or has room again. */
function disk({ is_low: isLow, free_gb: free, floor_gb: floor }) {
  document.querySelector(".message.disk")?.remove();
  if (!isLow) return void message(say("The station's disk has room again"), { todo: say("Streams and uploads go on by themselves.") });
  return void message(say("The station's disk is full"), { kind: "error disk",
    todo: say("{free} GB are free, and {floor} GB must stay so. No upload, mission or stream is taken in until there is room: delete uploads, recordings or flights.", { free, floor }) });
}

async function route() {
  turn += 1;
  declined = false;
  const mine = turn;
  const [path, query] = location.hash.split("?");
  const [, kind, id, view] = path.split("/").map(decodeURIComponent);
  const at = (new URLSearchParams(query).get("at") ?? "").split(",").map(Number); // a link to a place
  screen?.close?.();
  screen = null;
  for (const each of document.querySelectorAll("dialog")) if (each !== loginBox) each.close();
  for (const each of [rooms, title, known]) fill(each);
  delete known.dataset.loaded;
  document.body.dataset.screen = kind === "site" && id ? "site" : "sites";
  try {
    let made;
    if (kind === "site" && id) {
      const { showSite } = await siteScreen();
      made = await showSite(frame, station, id, view || "live", at.length === 2 && at.every(Number.isFinite) ? at : null);
    } else if (kind === "api") {
      made = await (await import("./api_page.js")).showApi(main, title);
    } else {
      made = await showSites(frame, station);
    }
    if (mine === turn) screen = made;
    else made?.close?.();
  } catch (problem) {
    if (mine !== turn) return;
    if (!(problem instanceof Problem)) throw problem;
    if (problem.status === 401) return;
    const isAwaited = problem.status === 404 && kind === "site";
    blank(isAwaited ? say("There is no site {name}", { name: id }) : problem.title, isAwaited ? "" : problem.detail, isAwaited ? el("p", say("Once a first mission has put something on its map, it is shown here.")) : null,
      el("p", el("a", { href: "#/" }, say("All sites")), " ", button(say("Try again"), () => route())));
    if (isAwaited) screen = whenMade(id, route);
  }
}

/** Call back once something of a site that is not there is on its map: its first mission may just have begun. */
function whenMade(id, then) {
  const over = new AbortController();
  for (const type of ["map.tiles", "site.changed"]) station.events.addEventListener(type, ({ detail }) => { if (detail.site === id) then(); }, over);
  return { close: () => over.abort() };
}

let loginBox = null;
let declined = false; // by Escape: answers that come late do not ask again, another screen does

function showLogin() {
  if (loginBox?.isConnected) return;
  const input = el("input", { type: "password", autocomplete: "current-password", required: true, maxlength: 200 });
  const note = el("p.note", { role: "alert" });
  const form = el("form.stack",
    el("p", say("This station is shared: it needs a token to know who you are. Who runs it makes one with {command}.", { command: el("code", "sorvolo token") })),
    field(say("Token"), input), note, el("button.main", say("Log in")));
  form.addEventListener("submit", async (event) => {
    event.preventDefault();
    try {
      await post("/api/session", { token: input.value.trim() });
      isLoggedIn = true;
      loginBox.close();
      await enter();
    } catch (problem) {
      fill(note, problem.detail);
      input.select();
    }
  });
  let isLoggedIn = false;
  loginBox = dialog(say("Log in"), form);
  loginBox.addEventListener("close", () => { // by Escape: the way in stays
    if (isLoggedIn) return;
    declined = true;
    screen?.close?.();
    screen = null;
    for (const each of [rooms, title, known, document.getElementById("messages")]) fill(each); // nothing of the sites stays
    blank(say("You are not logged in"), say("This station shows its sites to those who have a token."), button(say("Log in"), showLogin, { class: "main" }));
  });
  input.focus();
}

function showSettings() {
  const set = (name) => (value) => choices.set(name, value);
  const who = station.status;
  dialog(say("Settings"),
    el("div.stack",
      field(say("Language"), choice([["auto", say("As the browser")], ...Object.entries(LANGUAGES)], choices.get("language"), (value) => { choices.set("language", value); location.reload(); })),
      field(say("Units"), choice([["metric", say("Metres, hectares")], ["imperial", say("Feet, acres")]], choices.get("units"), set("units"))),
      field(say("Coordinates"), choice([["latlon", say("Latitude, longitude")], ["utm", "UTM"], ["mgrs", "MGRS"]],
        choices.get("coordinates"), set("coordinates"))),
      field(say("Times"), choice([["local", say("This device's time zone")], ["utc", "UTC"]], choices.get("clock"), set("clock"))),
      field(say("Colours"), choice([["auto", say("As the device")], ["light", say("Light")], ["dark", say("Dark")]], choices.get("theme"), set("theme"))),
      tick(say("Sound when something appears in an alert zone"), choices.get("sound"), set("sound")),
      el("h3", say("Keys")),
      el("dl.keys", [
        ["1 2 3", say("Live, Findings, Compare")], ["4 5 6", say("layers, measure, memory of a place")], ["F", say("follow the drone")], ["J / K", say("next and previous finding")], ["C, Y / R / ? / U", say("confirm, reject, not sure, withdraw")],
        ["N", say("note")], ["M", say("show on the map")], ["B", say("blink before and after")], ["O", say("hide what was found, in Compare")], ["← →", say("from change to change, in Compare")], ["Esc", say("end drawing, close")],
      ].map(([key, words]) => [el("dt", key), el("dd", words)])),
      who ? el("details", el("summary", say("Diagnostics")), el("p.note.diagnostics", say("memory {memory}, disk left {disk}, connection: {connection}", { memory: bytes((who.memory_mb ?? NaN) * 1e6), disk: bytes(who.disk_free_gb * 1e9), connection: LINKS[station.events?.state] }))) : null,
      el("p.note", el("a", { href: "#/api" }, say("Addresses for programs (API)"))),
      who ? el("p.note", say("Sorvolo {version}. Logged in as {name} ({role}).", { version: who.version, name: nameOf(who.name || "this machine"), role: ROLES[who.role] }), " ",
        who.name && who.name !== "this machine" ? quiet(say("Log out"), logOut) : null) : null));
}

async function logOut() {
  try {
    await remove("/api/session");
    navigator.serviceWorker?.controller?.postMessage("forget");
    location.reload();
  } catch (problem) {
    report(problem);
  }
}

addEventListener("unhandledrejection", (event) => {
  const problem = event.reason;
  if (problem instanceof Problem) {
    event.preventDefault();
    if (problem.status !== 401) report(problem);
  } else if (problem?.name === "AbortError") event.preventDefault();
  else message(say("Something on this page went wrong"), { kind: "error", todo: say("Reload it; if it comes back, report it with what you did.") });
});

begin();
