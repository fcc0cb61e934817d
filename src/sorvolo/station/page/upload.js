// Uploads that go on where they were cut off: the tus protocol 1.0.0, creation and resumption, in pieces.

import { Problem, send } from "./api.js";
import { stored } from "./choices.js";
import { message } from "./dom.js";
import { say } from "./languages.js";
import { bytes } from "./words.js";

const VERSION = { "tus-resumable": "1.0.0" };
const PIECE_BYTES = 8 * 1024 * 1024;
const TRIES = 8;
const pause = (ms) => new Promise((done) => setTimeout(done, ms));

/**
 * One file on its way. `send()` is fulfilled with the upload's id; `progress` is fired with the share that is there.
 * Where the browser reloads, the same file goes on at the byte that the station has.
 */
export class Upload extends EventTarget {
  constructor(file) {
    super();
    Object.assign(this, { file, sent: 0, stopped: new AbortController() });
    this.key = `sorvolo-upload ${file.name} ${file.size} ${file.lastModified}`;
  }

  async send() {
    let url = stored.get(this.key);
    let offset = null; // not known
    for (let tries = 0; ;) {
      try {
        if (offset === null && url) offset = await this.offsetAt(url);
        if (offset === null) [url, offset] = [await this.create(), 0];
        this.note(offset);
        if (offset >= this.file.size) return await this.checked(url);
        offset = await this.piece(url, offset);
        tries = 0;
      } catch (problem) {
        tries += 1;
        const isLost = ![0, 409, 423, 500, 502, 503, 504].includes(problem.status);
        if (isLost || tries > TRIES) throw problem;
        offset = null;
        await pause(Math.min(500 * 2 ** tries, 15000));
      }
    }
  }

  /** Wait until the station looked into the file; the upload's id. Throws Problem where it refuses it. */
  async checked(url) {
    for (;;) {
      const { id, state, why, facts } = await (await send(url, { signal: this.stopped.signal })).json();
      if (state === "refused" || state === "ready") stored.set(this.key, null);
      if (state === "refused") throw new Problem(415, say("{name} cannot be used", { name: this.file.name }), why);
      if (state === "ready" && facts?.missing_bytes) {
        message(say("{name} is cut: its last {size} are missing", { name: this.file.name, size: bytes(facts.missing_bytes) }), { kind: "warning", todo: say("What is there is used. Copy the video from the drone again to have all of it.") });
      }
      if (state === "ready") return id;
      await pause(300);
    }
  }

  /** Stop; what is there stays for a later try. */
  stop() {
    this.stopped.abort();
  }

  note(offset) {
    this.sent = offset;
    this.dispatchEvent(new CustomEvent("progress", { detail: this.file.size ? offset / this.file.size : 1 }));
  }

  async create() {
    const metadata = `filename ${base64(this.file.name)}`;
    const answer = await send("/api/uploads", { method: "POST", headers: { ...VERSION, "upload-length": String(this.file.size), "upload-metadata": metadata }, signal: this.stopped.signal });
    const url = answer.headers.get("location");
    if (!url) throw new Problem(500, say("The upload did not begin"), say("The station gave it no address; look at its messages."));
    stored.set(this.key, url);
    return url;
  }

  /** The bytes that the station has; null where it does not know the upload any more. */
  async offsetAt(url) {
    try {
      const answer = await send(url, { method: "HEAD", headers: VERSION, signal: this.stopped.signal });
      return Number(answer.headers.get("upload-offset"));
    } catch (problem) {
      if (![403, 404, 410].includes(problem.status)) throw problem;
      stored.set(this.key, null);
      return null;
    }
  }

  async piece(url, offset) {
    const body = this.file.slice(offset, offset + PIECE_BYTES);
    const answer = await send(url, { method: "PATCH", body, signal: this.stopped.signal, headers: { ...VERSION, "upload-offset": String(offset), "content-type": "application/offset+octet-stream" } });
    return Number(answer.headers.get("upload-offset"));
  }
}

const base64 = (text) => btoa(String.fromCharCode(...new TextEncoder().encode(text)));
