// Requests to the station: JSON in and out, every failure a Problem in words.

import { say } from "./languages.js";

/** What the station, or the network, answered instead: RFC 9457 fields, `status` 0 where nothing came back. */
export class Problem extends Error {
  constructor(status, title, detail, more = {}) {
    super(detail || title);
    Object.assign(this, { name: "Problem", status, title, detail, more, words: `${title}. ${detail}` });
  }
}

const UNREACHABLE = say("Check that the station runs and that this device is in its network. The page tries again by itself.");
const NOT_DONE = say("This may not be done. Check that the station runs and that this device is in its network, then do it again.");

/** Who wants to know that a token is needed. */
export const session = new EventTarget();

/** How many answers were not the station's own but kept by the service worker. */
export const kept = { answers: 0 };

const CLOCKS_AGREE_MS = 5000;
let ahead_ms = 0; // the station's clock, of this device's, which may be days off

/** The time now by the station's clock, ms. */
export const now = () => Date.now() + ahead_ms;

/** Send a request; give the JSON of the answer (null for none). Throws Problem. */
export async function ask(method, path, body, { signal, headers = {} } = {}) {
  const init = { method, signal, headers: { accept: "application/json", ...headers } };
  if (body !== undefined) {
    init.body = JSON.stringify(body);
    init.headers["content-type"] = "application/json";
  }
  const answer = await send(path, init);
  return answer.status === 204 ? null : answer.json();
}

/** Send a request; give the answer itself. Throws Problem. */
export async function send(path, init) {
  let answer;
  try {
    answer = await fetch(path, { credentials: "same-origin", ...init });
  } catch (error) {
    if (error.name === "AbortError") throw error;
    throw new Problem(0, say("The station does not answer"), init?.method && init.method !== "GET" ? NOT_DONE : UNREACHABLE);
  }
  const stated_ms = Date.parse(answer.headers.get("date"));
  if (answer.headers.has("x-kept")) kept.answers += 1;
  else if (Math.abs(stated_ms - now()) > CLOCKS_AGREE_MS) ahead_ms = stated_ms - Date.now();
  if (answer.ok) return answer;
  const problem = await answer.json().catch(() => ({}));
  if (answer.status === 401) session.dispatchEvent(new Event("needed"));
  throw new Problem(answer.status, problem.title || say("The station answered {status}", { status: String(answer.status) }),
    problem.detail || say("Try again; if it stays so, look at the station's own messages."), problem);
}

export const get = (path, options) => ask("GET", path, undefined, options);
export const post = (path, body = {}) => ask("POST", path, body);
export const put = (path, body) => ask("PUT", path, body);
export const remove = (path) => ask("DELETE", path);

/** The API's address of a site, or of something below it. */
export function siteUrl(site, ...rest) {
  return ["/api/sites", encodeURIComponent(site), ...rest].join("/");
}

/** The page's address of a room of a site. */
export const roomUrl = (site, room = "live") => `#/site/${encodeURIComponent(site)}/${room}`;

export function socketTo(path) {
  const url = new URL(path, location.href);
  url.protocol = url.protocol.replace("http", "ws");
  return new WebSocket(url);
}

/** All features of a collection, page after page, at most `most`. A collection that the site has not gives none. */
export async function features(site, collection, query = {}, most = 20000) {
  const found = [];
  const size = 1000;
  for (let offset = 0; offset < most; offset += size) {
    const parameters = new URLSearchParams({ ...query, limit: size, offset });
    let page;
    try {
      page = await get(`${siteUrl(site, "collections", collection, "items")}?${parameters}`);
    } catch (problem) {
      if (problem.status === 404) return found;
      throw problem;
    }
    found.push(...page.features);
    if (page.features.length < size) break;
  }
  return found;
}
