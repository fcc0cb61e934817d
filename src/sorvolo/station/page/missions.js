// Missions: started on an upload or a stream, watched, stopped; and what became of earlier ones.

import { get, post } from "./api.js";
import { button, choice, el, field, fill, message, report } from "./dom.js";
import { Upload } from "./upload.js";
import { bytes, clock, duration, time } from "./words.js";

const KINDS = {
  map: ["Map", "A first map, or more of it, from a flight."], compare: ["Compare", "A later flight over the same ground: what changed."],
  watch: ["Watch", "People, cars and small objects in a video, counted and placed."], search: ["Search", "How probable it is that somebody would have been found."],
};
const RUNNING = new Set(["queued", "running"]);

/** The panel's life. */
export function missionsPanel(screen, body) {
  return new Missions(screen, body);
}

class Missions {
  constructor(screen, body) {
    Object.assign(this, { screen, runs: [], uploads: [] });
    this.list = el("div", { class: "runs" });
    this.may = screen.station.status.role === "operate";
    fill(body, this.may ? this.form() : el("p", { class: "note" }, "Your token may look and review, not start missions."), this.uploadList = el("div", {}), el("h3", {}, "Missions here"), this.list);
    const types = ["run.queued", "run.started", "run.finished", "run.failed", "run.stopped", "run.lost"];
    const again = () => this.load();
    const progress = ({ detail }) => {
      const run = this.runs.find((each) => each.id === detail.run);
      if (run) { run.progress = detail.data; this.show(); }
    };
    for (const type of types) screen.station.events.addEventListener(type, again);
    screen.station.events.addEventListener("run.progress", progress);
    this.end = () => {
      for (const type of types) screen.station.events.removeEventListener(type, again);
      screen.station.events.removeEventListener("run.progress", progress);
    };
    this.load();
  }

  form() {
    const isFirst = !this.screen.data.detail.versions?.length;
    this.mission = isFirst ? "map" : "compare";
    this.from = "upload";
    const note = el("p", { class: "note" }, KINDS[this.mission][1]);
    const files = el("input", { type: "file", multiple: true, "aria-label": "Files of the flight" });
    const url = el("input", { type: "url", placeholder: "rtsp://…, udp://…", autocomplete: "off" });
    const ready = el("div", {});
    const input = el("div", {});
    const show = () => {
      fill(input, { upload: [field("Files of the flight", files, "The video and its telemetry (SRT, CSV, GPX …), or all photos."),], stream: field("Stream's address", url, "RTSP, RTMP or MPEG-TS over UDP; the station allows networks that it was told."), ready }[this.from]);
    };
    show();
    this.loadReady(ready);
    const start = el("button", { class: "main" }, "Start");
    const form = el("form", { class: "stack start", on: { submit: async (event) => {
      event.preventDefault();
      start.disabled = true;
      try {
        await this.start({ files: [...files.files], url: url.value.trim(), ready: ready.querySelector("select")?.value });
        files.value = "";
      } catch (problem) { report(problem); } finally { start.disabled = false; }
    } } },
    el("h3", {}, "Start a mission"),
    field("Mission", choice(Object.entries(KINDS).map(([key, [words]]) => [key, words]), this.mission, (mission) => { this.mission = mission; fill(note, KINDS[mission][1]); })), note,
    field("From", choice([["upload", "Files of this device"], ["stream", "A stream's address"], ["ready", "What the station has"]], this.from, (from) => { this.from = from; show(); })),
    input, start);
    return form;
  }

  /** Streams of drones that are on, and flights that lie beside the sites. */
  async loadReady(box) {
    const [streams, inputs] = await Promise.all([get("/api/streams").catch(() => []), get("/api/inputs").catch(() => [])]);
    const rows = (Array.isArray(streams) ? streams : streams.streams ?? []).map((each) => [JSON.stringify({ stream: each.name ?? each.id }), `Stream ${each.name ?? each.id}${each.state ? ` (${each.state})` : ""}`]);
    rows.push(...(Array.isArray(inputs) ? inputs : inputs.inputs ?? []).map((each) => [JSON.stringify({ input: each.id }), `${each.name ?? each.id}${each.bytes ? ` (${bytes(each.bytes)})` : ""}`]));
    fill(box, rows.length ? field("What the station has", choice(rows, rows[0][0], () => {})) : el("p", { class: "hint" }, "No drone streams here now, and no flight lies in the station's folder."));
  }

  async start({ files, url, ready }) {
    let input;
    if (this.from === "upload") {
      if (!files.length) return message("Choose the files of the flight first");
      input = { upload: await this.upload(files) };
    } else if (this.from === "stream") {
      if (!url) return message("Give the stream's address first");
      input = { stream_url: url };
    } else {
      if (!ready) return message("The station has no flight or stream; choose files of this device");
      input = JSON.parse(ready);
    }
    const run = await post("/api/runs", { mission: this.mission, site: this.screen.data.id, input, options: {} });
    message(`${KINDS[this.mission][0]} started`, { todo: run.id ? `Mission ${run.id}` : "" });
    return this.load();
  }

  /** Send all files; gives the id of the one upload, or of each where there are several. */
  async upload(files) {
    const ids = [];
    const group = files.length > 1 ? crypto.randomUUID?.() ?? String(Date.now()) : "";
    for (const file of files) {
      const upload = new Upload(file, { kind: kindOf(file.name), group });
      const bar = el("progress", { max: 1, value: 0, "aria-label": file.name });
      const row = el("div", { class: "upload" }, el("span", {}, `${file.name} (${bytes(file.size)})`), bar, button("Stop", () => upload.stop(), { class: "quiet" }));
      this.uploadList.append(row);
      upload.addEventListener("progress", ({ detail }) => { bar.value = detail; });
      try {
        ids.push(await upload.send());
      } finally { row.remove(); }
    }
    return ids.length === 1 ? ids[0] : ids;
  }

  async load() {
    try {
      const runs = await get("/api/runs");
      this.runs = (Array.isArray(runs) ? runs : runs.runs ?? []).filter((each) => !each.site || each.site === this.screen.data.id);
      this.show();
    } catch (problem) {
      fill(this.list, el("p", { class: "hint" }, problem.detail));
    }
  }

  show() {
    fill(this.list, this.runs.length ? this.runs.map((run) => this.row(run)) : el("p", { class: "hint" }, "None yet."));
  }

  row(run) {
    const running = RUNNING.has(run.state);
    const share = run.progress?.share ?? (run.progress?.total ? run.progress.frames / run.progress.total : null);
    return el("article", { class: `run ${run.state}` },
      el("header", {}, el("b", {}, KINDS[run.mission]?.[0] ?? run.mission), el("span", { class: "state" }, run.state), el("span", { class: "soft" }, run.started_at ? time(run.started_at) : "")),
      running ? el("progress", { ...(share === null ? {} : { value: share, max: 1 }), "aria-label": "Progress" }) : null,
      run.progress?.text || run.progress?.words ? el("p", {}, run.progress.text ?? run.progress.words) : running && run.progress?.frames ? el("p", {}, `${run.progress.frames} frames`) : null,
      run.headline ? el("p", {}, run.headline) : null,
      run.error ? el("p", { class: "error" }, run.error) : null,
      run.started_at && run.finished_at ? el("p", { class: "soft" }, `until ${clock(run.finished_at)}, ${duration((new Date(run.finished_at) - new Date(run.started_at)) / 1000)}`) : null,
      running && this.may ? button("Stop", () => this.stop(run), { class: "quiet" }) : null);
  }

  async stop(run) {
    await post(`/api/runs/${encodeURIComponent(run.id)}/stop`);
    await this.load();
  }

  close() {
    this.end();
  }
}

/** What a file is to the station, by its name's ending. */
export function kindOf(name) {
  const ending = name.toLowerCase().split(".").at(-1);
  if (["mp4", "mov", "mkv", "ts", "avi", "m4v"].includes(ending)) return "video";
  if (["jpg", "jpeg", "tif", "tiff", "dng", "heic", "png"].includes(ending)) return "photo";
  if (ending === "zip") return "archive";
  return "telemetry";
}
