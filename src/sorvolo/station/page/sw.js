// The page without its station: what was loaded is kept, so that a reload in the field shows the last that was known.

const KEPT = "sorvolo-page";
const MOST_KEPT = 4000;
const WAIT_MS = 4000; // for the station, before what is kept is shown
const AWAY_MS = 10000;

self.addEventListener("install", () => self.skipWaiting());
self.addEventListener("activate", (event) => event.waitUntil(self.clients.claim()));
self.addEventListener("message", ({ data }) => { if (data === "forget") caches.delete(KEPT); });

self.addEventListener("fetch", (event) => {
  const { request } = event;
  const { origin, pathname } = new URL(request.url);
  const isKept = pathname === "/" || pathname.startsWith("/page/") || /^\/api\/(status|sites|streams$|runs$)/.test(pathname);
  if (request.method !== "GET" || origin !== location.origin || request.headers.has("range") || !isKept || /^\/api\/.*\/(video|exports)/.test(pathname)) return;
  event.respondWith(answer(request));
});

let awayUntil = 0; // the station did not answer lately: what is kept is shown at once

async function answer(request) {
  const kept = await caches.open(KEPT);
  const found = await kept.match(request);
  const known = found && new URL(request.url).pathname.startsWith("/api/") ? marked(found) : found;
  const asked = fetch(request).then((response) => {
    awayUntil = 0;
    if (response.status === 401) forget(kept);
    if (response.status === 200) kept.put(request, response.clone()).then(() => trim(kept)).catch(() => {}); // a full disk keeps nothing
    return response;
  });
  if (!known) return asked;
  asked.catch(() => {});
  if (Date.now() < awayUntil) return known;
  const away = () => { awayUntil = Date.now() + AWAY_MS; return known; };
  return Promise.race([asked.catch(away), new Promise((done) => setTimeout(done, WAIT_MS)).then(() => "late")]).then((first) => (first === "late" ? away() : first));
}

/** What is kept, marked as such: the page states that it may be old. */
const marked = (response) => new Response(response.body, { status: response.status, headers: [...response.headers, ["x-kept", "1"]] });

/** Who is not logged in is shown nothing of the sites. */
async function forget(kept) {
  for (const each of await kept.keys()) if (new URL(each.url).pathname.startsWith("/api/")) await kept.delete(each);
}

async function trim(kept) {
  if (Math.random() > 0.005) return;
  const keys = await kept.keys();
  for (const each of keys.slice(0, Math.max(0, keys.length - MOST_KEPT))) await kept.delete(each);
}
