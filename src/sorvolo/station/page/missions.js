// The room Live: what was found while it is found, what runs, and what a person can start.

import { get, now, post, Problem, remove } from "./api.js";
import { choices } from "./choices.js";
import { button, choice, dialog, el, field, fill, message, quiet, report } from "./dom.js";
import { badge, picture, titleOf } from "./feature_card.js";
import { say } from "./languages.js";
import { thereOf } from "./sentence.js";
import { cropsOf, newestFirst, peopleFirst } from "./site_data.js";
import { mayNot } from "./sites.js";
import { Upload } from "./upload.js";
import { bytes, clock, dateOf, day, duration, nameOf, percent, time } from "./words.js";
import { zipOfFiles } from "./zip.js";

const KINDS = {
  map: [say("Map"), say("Build or extend the map.")], compare: [say("Compare"), say("Find what changed since the last flight.")],
  watch: [say("Watch"), say("Detect people and vehicles.")], search: [say("Search"), say("Measure with which chance somebody would have been seen: on this site's flights, or on one that is mapped now.")],
};
const STATES = { running: say("running"), finished: say("finished"), incomplete: say("incomplete"), failed: say("failed"), stopped: say("stopped"), lost: say("lost") };
const MOST_ZIP_BYTES = 4e9;
const MOST_FINDS = 24;
const CAMERA = /^(aov=[0-9.]+|focal_px=[0-9.]+|[A-Za-z0-9 .+-]*)$/;

/** Map what a drone sends, and look for people in it: two missions. A site that is written already is watched alone. */
export async function mapAndFind(stream, site, hasMap) {
  const start = (mission) => post("/api/runs", { mission, site, input: { stream }, options: {} });
  const mapped = await start(hasMap ? "compare" : "map").catch((problem) => problem);
  await start("watch");
  if (mapped instanceof Problem) report(new Problem(mapped.status, say("People are looked for, but no map is made"), mapped.detail));
}

export class Missions {
  constructor(screen, body) {
    Object.assign(this, { screen, rows: new Map(), told: "", over: new AbortController() });
    this.list = el("div.runs");
    this.finds = el("ul.strip.finds", { "aria-label": say("Found, people first") });
    this.drones = el("div.stack");
    this.may = screen.station.operates;
    this.starting = this.may ? el("details.starting-form", el("summary", say("Start a mission")), this.form()) : null;
    fill(body, this.finds, this.drones, el("h3", say("Activity")), this.list, this.uploadList = el("div"),
      this.starting ?? mayNot(), this.kept = el("div"));
    if (this.starting && !screen.data.detail.versions.length && !screen.runs.length) this.starting.open = true;
    for (const type of ["stream.state", "station.disk"]) screen.hear(screen.station.events, type, () => this.load(), this.over); // the last: rows state what it means
    this.refresh();
    this.load();
  }

  /** What was found, people first, the newest first. */
  refresh() {
    const found = peopleFirst(thereOf(this.screen.data.all.objects), newestFirst).slice(0, MOST_FINDS);
    const state = JSON.stringify([found, choices.all]);
    if (state === this.told) return;
    this.told = state;
    fill(this.finds, found.map((each) => el("li", button([cropsOf(each).length ? picture(cropsOf(each).at(-1), "") : null,
      el("span.name", badge(each), titleOf(each), el("span.soft", each.properties.first_seen ? ` ${(dateOf(each.properties.first_seen) === dateOf(now()) ? clock : day)(each.properties.first_seen)}` : ""))], () => this.screen.live.showFound(each), { data: { id: each.id } }))));
  }

  form() {
    this.mission = this.screen.data.detail.versions?.length ? "compare" : "map";
    this.from = this.flown = "upload";
    const note = el("p.note", KINDS[this.mission][1]);
    const files = this.files = el("input", { type: "file", multiple: true, "aria-label": say("Files of the flight") });
    const url = el("input", { type: "text", inputmode: "url", placeholder: "rtsp://…, udp://…", autocomplete: "off" });
    const camera = el("input", { type: "text", maxlength: 80, placeholder: say("found by itself") });
    const ready = el("div");
    const input = el("div");
    const from = el("div");
    const origins = [["ready", say("Drone streams and files")], ["upload", say("Upload")], ["stream", say("Camera URL")]];
    const show = () => {
      this.from = this.mission === "search" ? this.searched ?? "site" : this.flown;
      const take = (value) => { this[this.mission === "search" ? "searched" : "flown"] = value; show(); };
      fill(from, field(say("From"), choice(this.mission === "search" ? [["site", say("The flights of this site")], ...origins] : origins, this.from, take)));
      fill(input, { upload: field(say("Files of the flight"), files, say("The video, and its telemetry (SRT, CSV, GPX …) if it is not inside; or all photos.")),
        stream: field(say("Camera URL"), url, say("RTSP, RTMP or MPEG-TS over UDP, from networks that the station allows. The station opens the camera once; its video appears beside the map.")), ready, site: null }[this.from]);
    };
    const start = el("button.main", say("Start"));
    const form = el("form.stack.start", { on: { submit: async (event) => {
      event.preventDefault();
      start.disabled = true;
      try {
        await this.start({ files: [...files.files], url: url.value.trim(), camera: camera.value.trim(), ...chosen(ready) });
        files.value = "";
      } catch (problem) {
        if (problem.name !== "AbortError") this.complain(problem.words ?? problem.message);
      } finally { start.disabled = false; }
    } } },
    field(say("Mission"), choice(Object.entries(KINDS).map(([key, [words]]) => [key, words]), this.mission, (mission) => { this.mission = mission; fill(note, KINDS[mission][1]); show(); })), note,
    from, input, el("details", el("summary", say("Camera")), field(say("Camera"), camera, say("A model such as “DJI Mavic 2 Pro”, or aov=78; only where the flight's files do not name it."))), this.fault = el("p.error", { role: "alert" }), start);
    this.showInput = show;
    show();
    this.loadReady(ready);
    return form;
  }

  /** Files that were dropped on the page: they are what is flown. */
  take(files) {
    if (!this.starting) return;
    this.starting.open = true;
    this.flown = "upload";
    this.showInput();
    this.files.files = files;
  }

  /** Why a mission does not start, beside its button. */
  complain(words) {
    fill(this.fault, words);
  }

  /** Streams of drones, and flights that lie beside the sites. */
  async loadReady(box) {
    const [streams, inputs] = await Promise.all([get("/api/streams"), get("/api/inputs")]);
    const rows = streams.filter((each) => each.flights.length).map((each) => [JSON.stringify({ stream: each.stream }), `${say("Stream {name}", { name: each.stream })}${each.is_connected ? ` (${say("on")})` : ""}`]);
    const texts = inputs.filter((each) => each.kind.startsWith("telemetry"));
    rows.push(...inputs.filter((each) => !texts.includes(each)).map((each) => [JSON.stringify({ input: each.id }), `${each.name} (${bytes(each.megabytes * 1e6)})`]));
    if (!rows.length) return fill(box, el("p.hint", say("No drone sent a stream yet, and no flight lies in the station's folder.")));
    return fill(box, field(say("Stream or file"), choice(rows, rows[0][0], () => {}, { name: "input" })),
      texts.length ? field(say("Telemetry"), choice([["", say("found by itself")], ...texts.map((each) => [each.id, each.name])], "", () => {}, { name: "telemetry" })) : null);
  }

  async start(wish) {
    this.complain("");
    if (!CAMERA.test(wish.camera)) return void this.complain(say("Give the camera's model in letters A to Z, digits, dots, + and -, or aov=78 or focal_px=2900"));
    const options = wish.camera ? { camera: wish.camera } : {};
    const input = this.from === "site" ? null : await this.input(wish, options);
    if (input === undefined) return undefined;
    await post("/api/runs", { mission: this.mission, site: this.screen.data.id, options, ...(input && { input }) });
    message(say("{mission} started", { mission: KINDS[this.mission][0] }));
    return this.load();
  }

  /** What the mission flies; undefined where a person has to choose first. Puts telemetry into the options. */
  async input(wish, options) {
    if (this.from === "stream") return wish.url ? { stream_url: wish.url } : void this.complain(say("Give the stream's address first"));
    if (this.from === "ready") {
      if (wish.telemetry) options.telemetry = { input: wish.telemetry };
      return wish.input ? JSON.parse(wish.input) : void this.complain(say("The station has no flight or stream; choose files of this device"));
    }
    const [videos, photos, archives, texts] = ["video", "photo", "archive", "text"].map((kind) => wish.files.filter(({ name }) => kindOf(name) === kind));
    const flights = [...videos, ...archives, ...(photos.length ? [photos] : [])];
    if (flights.length !== 1) return void this.complain(flights.length ? say("Choose one flight: one video, or photos") : say("Choose the files of the flight first"));
    if (texts.length > 1) return void this.complain(say("Choose one telemetry file"));
    if (texts.length) options.telemetry = { upload: await this.upload(texts[0]) };
    return { upload: await this.upload(Array.isArray(flights[0]) ? await photosAsOne(photos) : flights[0]) };
  }

  async upload(file) {
    const upload = new Upload(file);
    const bar = el("progress", { max: 1, value: 0, "aria-label": file.name });
    const share = el("span.soft");
    const row = el("div.upload", el("span", `${file.name} (${bytes(file.size)}) `), share, bar, quiet(say("Stop"), () => upload.stop()));
    this.uploadList.append(row);
    upload.addEventListener("progress", ({ detail }) => { bar.value = detail; fill(share, percent(detail)); });
    try {
      return await upload.send();
    } finally { row.remove(); }
  }

  async load() {
    try {
      await this.screen.loadRuns();
      const streams = await get("/api/streams");
      this.showDrones(streams.filter((each) => each.is_connected));
      await this.showKept(streams);
    } catch (problem) {
      fill(this.list, el("p.hint", problem.detail));
    }
  }

  /** A button for each drone that sends and that no mission here follows. */
  showDrones(streams) {
    const { data, runs } = this.screen;
    const isFollowed = ({ stream }) => runs.some((each) => each.state === "running" && each.input?.stream === stream);
    fill(this.drones, this.may ? streams.filter((each) => !isFollowed(each)).map(({ stream }) => button(`${say("Map and find people")}: ${stream}`, async (event) => {
      event.currentTarget.disabled = true;
      try { await mapAndFind(stream, data.id, data.detail.versions.length > 0); } catch (problem) { report(problem); }
      await this.load();
    }, { class: "main" })) : null);
  }

  running() {
    const { runs } = this.screen;
    const is = (running) => runs.filter(({ state }) => (state === "running") === running);
    const rows = [...is(true), ...is(false)].map((run) => this.rowOf(run));
    const { children } = this.list;
    if (!rows.length) fill(this.list, el("p.hint", say("No mission yet.")));
    else if (rows.length !== children.length || rows.some((each, k) => each !== children[k])) fill(this.list, rows);
  }

  /** A mission's row: the same element while its progress alone changes, so that its buttons stay under the finger. */
  rowOf(run) {
    const { progress, ...fixed } = run;
    const state = JSON.stringify([fixed, choices.all]);
    const there = this.rows.get(run.id);
    if (there?.state !== state) {
      const moving = el("div");
      this.rows.set(run.id, { state, moving, row: this.row(run, moving) });
    }
    const { moving, row } = this.rows.get(run.id);
    if (run.state === "running") fill(moving, this.moving(run));
    return row;
  }

  moving(run) {
    const { frames, frames_expected: expected, searched, to_search: wanted, landed } = run.progress ?? {};
    return [el("progress", { ...(expected ? { value: Math.min(frames, expected), max: expected } : {}), "aria-label": say("Progress") }),
      wanted ? el("p", landed ? `${say("landed, searching the rest")}: ` : "", say("{searched} of {wanted} pictures searched", { searched, wanted })) : null,
      frames ? el("p", expected ? say("frame {number} of {all}", { number: frames, all: expected }) : say("{n} frame|{n} frames", { n: frames })) : null,
      el("p.soft.figures", this.screen.live.figures(run.id))];
  }

  /** What the station keeps of streams and uploads, with its size; taken away by whoever may start missions. */
  async showKept(streams) {
    const uploads = this.may ? await get("/api/uploads") : [];
    const rows = [
      ...streams.filter((each) => each.flight_count).map((each) => [say("Stream {name}", { name: each.stream }), `${say("{n} flight|{n} flights", { n: each.flight_count })}, ${bytes(each.bytes)}`, `/api/streams/${encodeURIComponent(each.stream)}`]),
      ...uploads.map((each) => [each.name, `${say("upload")}, ${bytes(each.offset)}`, `/api/uploads/${encodeURIComponent(each.id)}`]),
    ];
    fill(this.kept, rows.length ? el("details", el("summary", say("Recordings and uploads of the station")), el("ul.files", rows.map(([name, size, path]) => el("li", el("b", name), " ", el("span.soft", size),
      this.may ? quiet(say("Delete"), () => this.remove(path, `${name} (${size})`), { "aria-label": say("Delete {name}", { name }) }) : null)))) : null);
  }

  /** Take away for good what a person confirms. */
  remove(path, words) {
    const box = dialog(say("Delete for good?"), el("p", words), el("p.note", say("Maps that were made of it stay.")),
      button(say("Delete"), async () => {
        box.close();
        try { await remove(path); } catch (problem) { report(problem); }
        await this.load();
      }, { class: "main" }));
  }

  row(run, moving) {
    const running = run.state === "running";
    return el("article", { class: `run ${run.state}` },
      el("header", el("b", KINDS[run.mission]?.[0] ?? (run.mission === "demo" ? say("Demo") : run.mission)), el("span.state", run.stop_asked && running ? say("stopping") : STATES[run.state] ?? run.state), el("span.soft", `${time(run.started_at)}${run.who ? `, ${nameOf(run.who)}` : ""}`)),
      run.input?.name || run.input?.stream || run.input?.stream_url ? el("p.soft", run.input.name ?? run.input.stream ?? run.input.stream_url) : null,
      moving,
      run.notice ? el("p.error", { role: "status" }, run.notice) : null,
      run.headline ? el("p", run.headline) : null,
      run.error ? el("p.error", run.error) : null,
      run.ended_at ? el("p.soft", say("took {time}", { time: duration((new Date(run.ended_at) - new Date(run.started_at)) / 1000) })) : null,
      running && this.may ? quiet(run.stop_asked ? say("Stop at once") : say("Stop"), () => this.stop(run)) : null,
      !running && this.may ? quiet(say("Delete"), () => this.remove(`/api/runs/${encodeURIComponent(run.id)}`, [say("The record of this mission"), run.mission === "watch" ? say("what it found") : "", run.input?.stream_url ? say("the recording of its camera") : ""].filter(Boolean).join(", "))) : null);
  }

  async stop(run) {
    await post(`/api/runs/${encodeURIComponent(run.id)}/stop`);
    await this.load();
  }

  close() {
    this.over.abort();
  }
}

/** What a file is to the station, by its name's ending. */
const kindOf = (name) => [["video", /\.(mp4|mov|mkv|ts|m4v)$/i], ["photo", /\.(jpe?g|tiff?|dng|heic)$/i], ["archive", /\.zip$/i]].find(([, ending]) => ending.test(name))?.[0] ?? "text";

/** Photos as one zip file, always the same of the same photos, so that an upload goes on where it was cut. */
async function photosAsOne(photos) {
  const list = [...photos].sort((one, other) => one.name.localeCompare(other.name));
  const size = list.reduce((sum, each) => sum + each.size, 0);
  if (size > MOST_ZIP_BYTES || list.length > 65000) throw new Problem(413, say("Too many photos for one upload"), say("More than 4 GB were chosen: pack them as a .zip (64 bit) and choose that, or copy the folder to the station."));
  const name = `${list[0].name.replace(/\.[^.]*$/, "")}-${list.length}-photos.zip`;
  return new File([await zipOfFiles(list)], name, { lastModified: Math.max(...list.map((each) => each.lastModified)) });
}

function chosen(box) {
  return Object.fromEntries([...box.querySelectorAll("select")].map((each) => [each.name, each.value]));
}
