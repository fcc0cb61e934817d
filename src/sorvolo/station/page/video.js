// The drone's video with boxes on the picture they belong to: WebCodecs where the page is secure, MediaSource otherwise.

import { get, socketTo } from "./api.js";
import { choices } from "./choices.js";
import { button, cross, el, fill, quiet, tick } from "./dom.js";
import { say } from "./languages.js";
import { CLASSES, OTHER_CLASS } from "./map_style.js";
import { PictureMotion } from "./picture_motion.js";
import { isWithin, shareIn } from "./places.js";
import * as words from "./words.js";

const { number, percent } = words;

const BOXES_WITHIN_US = 250000; // boxes further from a picture than this were not seen in it
const OFF = { ended: say("ended"), "no signal": say("no signal") };
const KEPT_BOXES = 300;
const CLOCKS_AGREE_S = 0.5;
const OLD_BOXES_US = 4000000; // a slow detector's last boxes are shown for so long
const MOST_HELD_S = 4;
const MOST_UNDECODED = 15; // pictures, half a second: a decoder with more before it goes on at the next key frame
const STAMP_BYTES = 8;
const STATE_MS = 1000;
const QUIET_S = 3; // without a picture of a drone that sends: stated
const DEAD_S = 10; // the connection looks open and is dead, as after a sleep: made anew

const MARKED_S = 0.1; // of a recording, before and after a frame whose place on the ground is known
const NEAR_DEG = 0.02; // of a site's ground: a drone there is shown with it

/** The videos beside a site's map: one for each drone that flies there. `play(view)` shows a recorded flight at a second. */
export class VideoWall {
  constructor(screen) {
    Object.assign(this, { screen, panes: new Map(), closed: new Set(), here: [] });
    this.opener = button(say("Video"), () => { this.closed.clear(); this.look(); }, { class: "video-open", icon: "video" });
    this.opener.hidden = true;
    screen.stage.append(this.opener);
    screen.hear(screen.station.events, "stream.state", ({ detail: { data: { stream, is_connected: isOn, flights } } }) => {
      if (isOn) return void this.look();
      this.panes.get(stream)?.off(flights?.at(-1)?.is_over ? "ended" : "no signal");
      this.here = this.here.filter((each) => each !== stream);
      screen.live.drones.delete(stream);
      screen.live.drawSoon();
    });
    this.look();
  }

  async look() {
    let streams;
    try {
      streams = await get("/api/streams");
    } catch { return; } // the connection's own sign shows it
    if (this.screen.closed) return;
    const on = streams.filter((each) => each.is_connected);
    this.here = on.filter((each) => this.isHere(each)).map(({ stream }) => stream);
    for (const each of on) if (this.isHere(each) && !this.panes.has(each.stream) && !this.closed.has(each.stream)) this.open(each.stream);
    this.opener.hidden = !on.some((each) => this.closed.has(each.stream));
  }

  /** Whether a mission of the site follows a drone, or it flies there, or nobody knows where it is. */
  isHere({ stream, telemetry }) {
    const { runs, data: { detail: { bounds_wgs84: bounds } } } = this.screen;
    if (runs.some((each) => each.state === "running" && each.input?.stream === stream)) return true;
    const { latitude_deg: lat, longitude_deg: lon } = telemetry ?? {};
    if (lat === undefined || lat === null || !bounds) return true;
    return isWithin([lon, lat], bounds, NEAR_DEG);
  }

  open(stream) {
    const pane = new DroneVideo(stream, { heard: (telemetry) => this.screen.live.heard(stream, telemetry), leave: () => this.leave(stream) });
    pane.pane.querySelector("header").prepend(quiet("⤢", () => { this.screen.wall.classList.toggle("large"); this.fit(); }, { "aria-label": say("Larger or smaller") }));
    this.add(stream, pane);
  }

  add(name, pane) {
    this.panes.set(name, pane);
    this.screen.wall.append(pane.pane);
    this.fit();
  }

  take(name) {
    this.panes.get(name)?.close();
    this.panes.delete(name);
    this.fit();
  }

  leave(stream) {
    this.closed.add(stream);
    this.opener.hidden = false;
    this.take(stream);
  }

  /** The map has the room that the videos leave. */
  fit() {
    const { wall, view, live, data: { detail: { bounds_wgs84: bounds } } } = this.screen;
    const before = view?.map.getContainer().clientHeight;
    wall.hidden = !this.panes.size;
    view?.map.resize();
    if (bounds && live?.follows && !live.drones.size && view?.map.getContainer().clientHeight < before) view.go(bounds, 0, true); // a phone's: nobody has moved it

  }

  /** Play the recorded flight of a place's view. */
  /** `place` is marked while that very picture is shown. */
  play(view, place) {
    if (!view.video_url) return;
    const name = view.flight;
    this.take(name);
    const player = el("video", { src: view.video_url, controls: true, playsinline: true, ".muted": true });
    player.addEventListener("loadedmetadata", () => { player.currentTime = view.video_s; }, { once: true });
    const mark = el("span.at", { hidden: true });
    const put = () => {
      const ring = this.screen.data.all.frames.find(({ id }) => id === view.frame_id)?.geometry?.coordinates[0];
      mark.hidden = !ring || Math.abs(player.currentTime - view.video_s) > MARKED_S;
      if (!mark.hidden) [mark.style.left, mark.style.top] = shareIn(ring, place).map((each) => `${100 * each}%`);
    };
    const over = new AbortController();
    for (const type of ["seeked", "timeupdate"]) player.addEventListener(type, put);
    this.screen.hear(this.screen.data, "data", put, over); // frames come last
    const pane = el("aside.video", { "aria-label": say("Recording of {name}", { name }) }, el("header", el("b", name), el("span.delay", say("recorded")),
      cross(say("Close the video"), () => this.take(name))), el("div.picture", player, mark));
    this.add(name, { pane, close: () => { over.abort(); pane.remove(); }, off() {} });
  }

  close() {
    for (const each of this.panes.values()) each.close();
  }
}

/** A drone's moving picture with what is detected in it: `pane` is its element; `heard(telemetry)` gets what it states, null once that is old. */
export class DroneVideo {
  constructor(stream, { heard = () => {}, leave = null } = {}) {
    Object.assign(this, { url: `/api/streams/${encodeURIComponent(stream)}`, told: heard, boxes: [], motion: new PictureMotion(), socket: null, late_s: 0 });
    this.canvas = el("canvas", { width: 640, height: 360 });
    this.overlay = el("canvas.boxes", { width: 640, height: 360, "aria-hidden": true });
    this.player = el("video", { ".muted": true, playsinline: true, hidden: true });
    this.delay = el("span.delay");
    this.pane = el("aside.video", { "aria-label": say("Live video of {name}", { name: stream }) },
      el("header", el("b", stream), this.delay, leave ? cross(say("Close the video"), leave) : null),
      el("div.picture", this.canvas, this.player, this.overlay),
      el("footer", tick(say("Sync video to detections"), choices.get("holdForBoxes"), (on) => choices.set("holdForBoxes", on), { title: say("Show each picture when its boxes are known") }), this.seen = el("span.soft")));
    this.connect();
  }

  /** No pictures come, and why. */
  off(why) {
    fill(this.delay, OFF[why]);
    this.pane.dataset.off = why;
  }

  connect() {
    this.drop();
    this.fmp4 = !("VideoDecoder" in window);
    const socket = this.socket = socketTo(`${this.url}/video${this.fmp4 ? "?mode=fmp4" : ""}`);
    socket.binaryType = "arraybuffer";
    this.heard_at = performance.now();
    this.cameAlive = false; // pictures came by this connection
    this.show = this.fmp4 ? new SegmentPlayer(this.player, (pts_us) => this.shown(pts_us), (pts_us) => { this.newest = { pts_us, at: performance.now() }; }) : new FramePlayer(this.canvas, (pts_us) => this.shown(pts_us), () => this.hold_s());
    this.canvas.hidden = this.fmp4;
    this.player.hidden = !this.fmp4;
    this.poll = setInterval(() => this.ask(), STATE_MS);
    socket.addEventListener("message", ({ data }) => (typeof data === "string" ? this.report(JSON.parse(data)) : this.packet(data)));
    socket.addEventListener("close", () => {
      if (socket !== this.socket) return;
      this.off("no signal");
      this.timer = setTimeout(() => this.connect(), 3000);
    });
  }

  /** Where the drone is, by its own telemetry; whether its flight is over, or the connection to it dead. */
  async ask() {
    const quiet_s = (performance.now() - this.heard_at) / 1000;
    if (quiet_s > QUIET_S && !this.pane.dataset.off) fill(this.delay, say("no picture for {seconds} s", { seconds: Math.round(quiet_s) }));
    try {
      const asked_us = Date.now() * 1000;
      const state = await get(this.url);
      if (!this.socket) return; // closed meanwhile
      this.ahead_us = (asked_us + Date.now() * 1000) / 2 - state.time_us;
      if (state.is_connected) {
        if (state.samples !== this.samples) Object.assign(this, { samples: state.samples, sampled_at: performance.now() });
        this.told(performance.now() - this.sampled_at < 1000 * DEAD_S ? state.telemetry : null);
        if (quiet_s > DEAD_S && this.cameAlive) this.connect();
      } else if (state.flights.at(-1)?.is_over) this.off("ended");
    } catch { /* the connection's own sign shows it */ }
  }

  report(words) {
    if (words.type === "format") {
      this.format = words;
      if (words.epoch_us !== undefined) this.epoch_us = words.epoch_us;
      Object.assign(this, { boxes: [], motion: new PictureMotion() }); // another flight's have other times
      this.show.begin(words);
    } else if (words.type === "boxes") this.take(words);
    else if (words.type === "motion") this.motion.take(words);
  }

  packet(data) {
    const pts_us = this.fmp4 ? null : Number(new DataView(data).getBigInt64(0));
    if (pts_us !== null) this.newest = { pts_us, at: performance.now() };
    delete this.pane.dataset.off;
    this.cameAlive = true;
    this.heard_at = performance.now();
    this.show.take(this.fmp4 ? new Uint8Array(data) : new Uint8Array(data, STAMP_BYTES), pts_us);
  }

  /** How long pictures wait for their boxes: as late as boxes came lately. */
  hold_s() {
    return choices.get("holdForBoxes") ? Math.min(this.late_s, MOST_HELD_S) : 0;
  }

  /** Boxes of a picture; with `classes`, those of some, known before the others. */
  take(data) {
    if (!data.classes) this.boxes = this.boxes.filter((each) => each.pts_us !== data.pts_us);
    this.boxes.push(data);
    this.boxes.sort((one, other) => one.pts_us - other.pts_us);
    this.boxes.splice(0, this.boxes.length - KEPT_BOXES);
    if (this.newest) {
      const late = (this.newest.pts_us - data.pts_us) / 1e6 + (performance.now() - this.newest.at) / 1000;
      if (late > 0 && late < 10) this.late_s = Math.max(late, this.late_s * 0.98);
    }
    if (this.now_us !== undefined) this.drawBoxes(this.now_us);
  }

  shown(pts_us) {
    this.now_us = pts_us;
    this.drawBoxes(pts_us);
    const here_s = this.newest ? (this.newest.pts_us - pts_us) / 1e6 + (performance.now() - this.newest.at) / 1000 : null;
    // by the station's clock: this device's own may be wrong
    const whole_s = this.epoch_us !== undefined && this.ahead_us !== undefined ? (Date.now() * 1000 - this.ahead_us - this.epoch_us - pts_us) / 1e6 : null;
    // a picture that left the drone after it came here: the two clocks disagree
    const behind_s = whole_s === null || whole_s < (here_s ?? 0) - CLOCKS_AGREE_S ? here_s : whole_s;
    if (behind_s !== null) fill(this.delay, say("{seconds} s delay", { seconds: Math.max(0, behind_s) }));
  }

  drawBoxes(pts_us) {
    const looks = this.looksFor(pts_us);
    const pen = this.overlay.getContext("2d");
    const [width, height] = looks.at(-1)?.frame_size_px ?? [this.format?.width ?? 640, this.format?.height ?? 360];
    if (this.overlay.width !== width || this.overlay.height !== height) Object.assign(this.overlay, { width, height });
    pen.clearRect(0, 0, width, height);
    const size = Math.max(12, width / 50);
    pen.font = `600 ${size}px system-ui, sans-serif`;
    pen.lineWidth = Math.max(2, width / 400);
    let count = 0, oldest = null;
    for (const look of looks) {
      const isOwn = Math.abs(look.pts_us - pts_us) < BOXES_WITHIN_US;
      const carried = this.motion.carried(look, pts_us); // they follow the picture, where its motion is known
      const boxes = carried ?? look.boxes;
      pen.globalAlpha = isOwn || carried ? 1 : 0.45;
      pen.setLineDash(isOwn ? [] : [size / 2, size / 3]);
      for (const box of boxes) drawBox(pen, box, size);
      if (boxes.length && !oldest) oldest = { isOwn, carried, ago_s: (pts_us - look.pts_us) / 1e6 };
      count += boxes.length;
    }
    fill(this.seen, count ? `${say("{n} detection|{n} detections", { n: count })}${oldest.isOwn ? "" : `, ${oldest.carried ? say("dashed: seen {seconds} s ago", { seconds: number(oldest.ago_s) }) : say("faint: seen {seconds} s ago", { seconds: number(oldest.ago_s) })}`}` : "");
  }

  /** The looks that show most of a picture, the older first: the nearest whole one, and where cars of a later one are known already, those. */
  looksFor(pts_us) {
    const nearest = (looks) => {
      const away_us = (each) => Math.abs(each.pts_us - pts_us);
      const best = looks.length ? looks.reduce((one, other) => (away_us(other) < away_us(one) ? other : one)) : null;
      return best && away_us(best) < (best.pts_us < pts_us ? OLD_BOXES_US : BOXES_WITHIN_US) ? best : null;
    };
    const best = nearest(this.boxes);
    if (!best?.classes) return best ? [best] : [];
    const whole = nearest(this.boxes.filter((each) => !each.classes));
    return whole ? [{ ...whole, boxes: whole.boxes.filter((box) => !best.classes.includes(box.class)) }, best] : [best];
  }

  drop() {
    clearTimeout(this.timer);
    clearInterval(this.poll);
    const { socket, show } = this;
    Object.assign(this, { socket: null, show: null, newest: null, now_us: undefined });
    socket?.close();
    show?.close();
  }

  close() {
    this.drop();
    this.pane.remove();
  }
}

function drawBox(pen, { class: name, score, xywh_px: [x, y, w, h] }, size) {
  const [, colour] = CLASSES[name] ?? OTHER_CLASS;
  pen.strokeStyle = "#10201b";
  pen.strokeRect(x - 1, y - 1, w + 2, h + 2);
  pen.strokeStyle = colour;
  pen.strokeRect(x, y, w, h);
  const text = `${words.className(name)} ${percent(score)}`;
  const top = Math.max(0, y - size * 1.25); // at the picture's upper edge in the box
  pen.fillStyle = colour;
  pen.fillRect(x, top, pen.measureText(text).width + size * 0.6, size * 1.25);
  pen.fillStyle = "#10201b";
  pen.fillText(text, x + size * 0.3, top + size * 0.95);
}

/** Access units (Annex B) decoded by WebCodecs and drawn when due. */
export class FramePlayer {
  constructor(canvas, shown, hold_s) {
    Object.assign(this, { canvas, shown, hold_s, waiting: [], pen: canvas.getContext("2d") });
  }

  begin({ codec, width, height }) {
    ended(this.decoder);
    Object.assign(this.canvas, { width, height });
    this.needsKey = true;
    this.config = { codec, optimizeForLatency: true };
    this.decoder = new VideoDecoder({ output: (frame) => this.draw(frame), error: () => this.recover() });
    this.decoder.configure(this.config);
  }

  /** Damaged data stops a decoder for good: begin anew at the next key frame. */
  recover() {
    if (this.closed) return;
    this.begin({ codec: this.config.codec, width: this.canvas.width, height: this.canvas.height });
  }

  take(data, pts_us) {
    this.waiting.push({ data, pts_us, due: performance.now() + this.hold_s() * 1000 });
    this.feed();
  }

  feed() {
    clearTimeout(this.timer);
    while (this.waiting.length && this.waiting[0].due <= performance.now() + 1) {
      const { data, pts_us } = this.waiting.shift();
      const isKey = hasKey(data);
      if (!this.decoder || this.decoder.state !== "configured" || (this.needsKey && !isKey)) continue;
      if (isKey && this.decoder.decodeQueueSize > MOST_UNDECODED) { // a device too slow for this video: near live, with gaps
        this.decoder.reset();
        this.decoder.configure(this.config);
      }
      this.needsKey = false;
      this.decoder.decode(new EncodedVideoChunk({ type: isKey ? "key" : "delta", timestamp: pts_us, data }));
    }
    if (this.waiting.length) this.timer = setTimeout(() => this.feed(), this.waiting[0].due - performance.now());
  }

  draw(frame) {
    if (this.canvas.width !== frame.displayWidth) Object.assign(this.canvas, { width: frame.displayWidth, height: frame.displayHeight });
    this.pen.drawImage(frame, 0, 0);
    const pts_us = frame.timestamp;
    frame.close();
    this.shown(pts_us);
  }

  close() {
    this.closed = true;
    clearTimeout(this.timer);
    ended(this.decoder);
  }
}

/** Close a decoder; one that met damaged data is closed already. */
function ended(decoder) {
  if (decoder && decoder.state !== "closed") decoder.close();
}

/** Whether an access unit holds a picture that depends on no other: H.264 NAL type 5, or H.265 types 16 to 21. */
export function hasKey(data) {
  for (let at = 0; at + 3 < data.length; at++) {
    if (data[at] !== 0 || data[at + 1] !== 0 || data[at + 2] !== 1) continue;
    const head = data[at + 3];
    const h264 = head & 31;
    if (h264 === 5 && (head & 128) === 0) return true;
    const h265 = (head >> 1) & 63;
    if (h265 >= 16 && h265 <= 21 && data[at + 4] === 1 && h264 !== 1) return true;
    if (h264 === 1) return false;
  }
  return false;
}

/** Fragmented MP4 played by MediaSource, kept near its newest second. */
class SegmentPlayer {
  constructor(player, shown, appended) {
    Object.assign(this, { player, shown, appended, queue: [] });
  }

  begin({ codec }) {
    if (this.player.src) URL.revokeObjectURL(this.player.src);
    const source = new MediaSource();
    Object.assign(this, { source, buffer: null, queue: [] });
    this.player.src = URL.createObjectURL(source);
    source.addEventListener("sourceopen", () => {
      if (source !== this.source) return;
      this.buffer = source.addSourceBuffer(`video/mp4; codecs="${codec}"`);
      this.buffer.addEventListener("updateend", () => {
        const held = this.buffer.buffered;
        if (held.length) this.appended(held.end(held.length - 1) * 1e6);
        this.feed();
      });
      this.feed();
    }, { once: true });
    this.player.play().catch(() => {});
    const follow = (_, { mediaTime }) => {
      if (this.closed || source !== this.source) return;
      this.shown(mediaTime * 1e6);
      this.player.requestVideoFrameCallback?.(follow);
    };
    this.player.requestVideoFrameCallback?.(follow);
  }

  take(data) {
    this.queue.push(data);
    this.feed();
  }

  feed() {
    if (!this.buffer || this.buffer.updating || !this.queue.length) return this.catchUp();
    try {
      this.buffer.appendBuffer(this.queue.shift());
    } catch { this.queue = []; }
  }

  catchUp() {
    const { player } = this;
    const held = player.buffered;
    if (!held.length) return;
    const end = held.end(held.length - 1);
    const isHeld = [...Array(held.length).keys()].some((k) => held.start(k) <= player.currentTime && player.currentTime <= held.end(k));
    if (end - player.currentTime > 1 || !isHeld) player.currentTime = Math.max(held.start(held.length - 1), end - 0.1); // in a gap it would stay
    if (this.buffer && !this.buffer.updating && player.currentTime - held.start(0) > 30) this.buffer.remove(0, player.currentTime - 10);
  }

  close() {
    this.closed = true;
    if (this.player.src) URL.revokeObjectURL(this.player.src);
    this.player.removeAttribute("src");
    this.player.load();
  }
}
