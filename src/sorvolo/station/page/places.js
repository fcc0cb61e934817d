// Places and sizes on the ground: UTM, MGRS, distances and areas on the WGS84 ellipsoid.

const A = 6378137;
const F = 1 / 298.257223563;
const E2 = F * (2 - F);
const N = F / (2 - F);
const RAD = Math.PI / 180;
// Krueger's series in the third flattening n, to n^4 (Karney 2011, eq. 35): errors below a micrometre in a zone
const RADIUS = (A / (1 + N)) * (1 + N ** 2 / 4 + N ** 4 / 64);
const ALPHA = [
  N / 2 - (2 / 3) * N ** 2 + (5 / 16) * N ** 3 + (41 / 180) * N ** 4,
  (13 / 48) * N ** 2 - (3 / 5) * N ** 3 + (557 / 1440) * N ** 4,
  (61 / 240) * N ** 3 - (103 / 140) * N ** 4,
  (49561 / 161280) * N ** 4,
];
const BANDS = "CDEFGHJKLMNPQRSTUVWX";

/** The UTM zone of a place, with Norway's and Svalbard's exceptions. */
export function utmZone(lon, lat) {
  if (lat >= 56 && lat < 64 && lon >= 3 && lon < 12) return 32;
  if (lat >= 72 && lat <= 84 && lon >= 0 && lon < 42) return lon < 9 ? 31 : lon < 21 ? 33 : lon < 33 ? 35 : 37;
  return Math.min(60, Math.floor((((lon + 180) % 360) + 360) % 360 / 6) + 1);
}

/** {zone, band, east_m, north_m} of a place; null beyond 80 south and 84 north, where UTM ends. */
export function utm(lon, lat) {
  if (!(lat >= -80 && lat < 84)) return null;
  const zone = utmZone(lon, lat);
  const dlon = (lon - (zone * 6 - 183)) * RAD;
  const e = Math.sqrt(E2);
  const s = Math.sin(lat * RAD);
  const t = Math.sinh(Math.atanh(s) - e * Math.atanh(e * s));
  const xi = Math.atan2(t, Math.cos(dlon));
  const eta = Math.asinh(Math.sin(dlon) / Math.hypot(t, Math.cos(dlon)));
  let x = eta;
  let y = xi;
  ALPHA.forEach((each, k) => {
    const j = 2 * (k + 1);
    x += each * Math.cos(j * xi) * Math.sinh(j * eta);
    y += each * Math.sin(j * xi) * Math.cosh(j * eta);
  });
  const band = BANDS[Math.min(19, Math.floor((lat + 80) / 8))];
  return { zone, band, east_m: 500000 + 0.9996 * RADIUS * x, north_m: (lat < 0 ? 1e7 : 0) + 0.9996 * RADIUS * y };
}

/** The MGRS reference of a place to one metre, as 33T TG 92645 41872; null beyond UTM. */
export function mgrs(lon, lat) {
  const found = utm(lon, lat);
  if (!found) return null;
  const { zone, band, east_m, north_m } = found;
  const columns = ["STUVWXYZ", "ABCDEFGH", "JKLMNPQR"][zone % 3];
  const rows = "ABCDEFGHJKLMNPQRSTUV";
  const column = columns[Math.floor(east_m / 1e5) - 1];
  const row = rows[(Math.floor(north_m / 1e5) + (zone % 2 ? 0 : 5)) % 20];
  const digits = (value) => String(Math.floor(value) % 100000).padStart(5, "0");
  return `${zone}${band} ${column}${row} ${digits(east_m)} ${digits(north_m)}`;
}

/** Metres of a degree of longitude and of latitude at a latitude. */
export function metresOfDegree(lat) {
  const w = 1 - E2 * Math.sin(lat * RAD) ** 2;
  return [RAD * (A / Math.sqrt(w)) * Math.cos(lat * RAD), RAD * (A * (1 - E2)) / w ** 1.5];
}

/** Metres between two [lon, lat], to 1e-5 of it over what a flight covers. */
export function distance_m([lon1, lat1], [lon2, lat2]) {
  const [x, y] = metresOfDegree((lat1 + lat2) / 2);
  return Math.hypot((lon2 - lon1) * x, (lat2 - lat1) * y);
}

export function length_m(line) {
  return line.slice(1).reduce((sum, each, k) => sum + distance_m(line[k], each), 0);
}

/** Square metres in a ring of [lon, lat], closed or not. */
export function area_m2(ring) {
  const lat = ring.reduce((sum, each) => sum + each[1], 0) / ring.length;
  const [x, y] = metresOfDegree(lat);
  let twice = 0;
  ring.forEach(([lon1, lat1], k) => {
    const [lon2, lat2] = ring[(k + 1) % ring.length];
    twice += ((lon1 - ring[0][0]) * (lat2 - ring[0][1]) - (lon2 - ring[0][0]) * (lat1 - ring[0][1])) * x * y;
  });
  return Math.abs(twice) / 2;
}

/** Where a [lon, lat] is in a picture whose corners on the ground are a ring, the top left first: shares of width and height. */
export function shareIn(ring, [lon, lat]) {
  const [[x0, y0], [x1, y1], [x2, y2], [x3, y3]] = ring.map(([x, y]) => [x - lon, y - lat]);
  const [sx, sy] = [x0 - x1 + x2 - x3, y0 - y1 + y2 - y3];
  const all = (x1 - x2) * (y3 - y2) - (x3 - x2) * (y1 - y2);
  const [g, h] = [(sx * (y3 - y2) - (x3 - x2) * sy) / all, ((x1 - x2) * sy - sx * (y1 - y2)) / all];
  const [a, b, d, e] = [x1 - x0 + g * x1, x3 - x0 + h * x3, y1 - y0 + g * y1, y3 - y0 + h * y3];
  return [(b * y0 - e * x0) / (a * e - b * d), (d * x0 - a * y0) / (a * e - b * d)];
}

export const polygonsOf = ({ type, coordinates }) => (type === "MultiPolygon" ? coordinates : [coordinates]);

export function inRing([x, y], ring) {
  let inside = false;
  for (let i = 0, j = ring.length - 1; i < ring.length; j = i++) {
    const [xi, yi] = ring[i];
    const [xj, yj] = ring[j];
    if (yi > y !== yj > y && x < ((xj - xi) * (y - yi)) / (yj - yi) + xi) inside = !inside;
  }
  return inside;
}

/** Column and row of a place among the tiles of a zoom, Web Mercator. */
export const tileColumn = (lon, z) => (lon + 180) / 360 * 2 ** z;
export const tileRow = (lat, z) => (1 - Math.asinh(Math.tan(lat * RAD)) / Math.PI) / 2 * 2 ** z;

/** Whether a [lon, lat] lies in [west, south, east, north], or within so many degrees of it. */
export const isWithin = ([lon, lat], [west, south, east, north], near_deg = 0) =>
  lon >= west - near_deg && lon <= east + near_deg && lat >= south - near_deg && lat <= north + near_deg;

export const featureOf = (type, coordinates, properties = {}) => ({ type: "Feature", properties, geometry: { type, coordinates } });

/** A [lon, lat] in the middle of a geometry's box. */
export function middleOf(geometry) {
  const box = boundsOf([geometry]);
  return box && [(box[0] + box[2]) / 2, (box[1] + box[3]) / 2];
}

/** [west, south, east, north] of geometries; null of none. */
export function boundsOf(geometries) {
  const box = [Infinity, Infinity, -Infinity, -Infinity];
  const walk = (part) => {
    if (typeof part[0] !== "number") return part.forEach(walk);
    box[0] = Math.min(box[0], part[0]);
    box[1] = Math.min(box[1], part[1]);
    box[2] = Math.max(box[2], part[0]);
    box[3] = Math.max(box[3], part[1]);
  };
  for (const each of geometries) if (each?.coordinates?.length) walk(each.coordinates);
  return box[0] === Infinity ? null : box;
}
