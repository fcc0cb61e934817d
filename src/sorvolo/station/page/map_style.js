// How the map looks: sources and layers, their colours, patterns and order.

import { say } from "./languages.js";

export const KINDS = {
  appeared: [say("appeared"), "#12b886"], disappeared: [say("disappeared"), "#f03e3e"], replaced: [say("replaced"), "#9c6bff"],
  area: [say("ground changed"), "#228be6"], moving: [say("moving"), "#fd9e14"],
};
export const CLASSES = {
  person: [say("people"), "#ff4fa3", "P"], car: [say("cars"), "#22c3e6", "C"], "small object": [say("small objects"), "#ffd43b", "S"],
};
export const OTHER_CLASS = [say("others"), "#e9ecef", "?"];
export const PLACED = { vision: [say("placed by vision"), "#35b98a"], "gps-only": [say("placed by GPS alone"), "#f0a835"] };

/** Chances of 0 to 20 % and so on that somebody would have been seen: cividis, told apart by every eye. */
export const POD_RAMP = ["#00224e", "#444d6b", "#7d7c78", "#bcae6c", "#fee838"];

const DARK = "#10201b";
const EMPTY = { type: "FeatureCollection", features: [] };
const DATA = ["coverage", "pod", "frames", "track", "drawings", "sketch", "changes", "objects", "drone", "chosen"];

const matched = (property, table, other) => ["match", ["get", property], ...Object.entries(table).flatMap(([key, [, colour]]) => [key, colour]), other];

/** Layers by group: what a tick in the panel shows and hides. */
export const GROUPS = {
  mosaic: [say("Map"), true], frames: [say("Footprints of the frames"), false], track: [say("Track"), true],
  objects: [say("Objects"), true], changes: [say("Changes"), true], coverage: [say("Coverage gaps"), false],
  trees: [say("Under the trees"), false], pod: [say("Chance to have seen a person"), false], drone: [say("Drone and field of view"), true], drawings: [say("Drawings and zones"), true],
};

/** What is laid over ground and can be made fainter: its property of opacity, and that at first. */
export const FADED = { mosaic: ["raster-opacity", 1], coverage: ["fill-opacity", 0.75], pod: ["fill-opacity", 0.6] };

/** The style with empty data; `dark` chooses the ground's colour. */
export function mapStyle(dark) {
  const sources = Object.fromEntries(DATA.map((name) => [name, { type: "geojson", data: EMPTY }]));
  return { version: 8, sources, layers: [{ id: "ground", type: "background", paint: { "background-color": groundColour(dark) } }, ...layers()] };
}

export const groundColour = (dark) => (dark ? "#151c1a" : "#e3e8e5");

/** A layer, "source" or "source-part" by its id, that a tick shows and hides; `more`: filter, layout, minzoom. */
const layer = (type) => (id, paint, more = {}) => {
  const source = id.split("-")[0];
  return { id, type, source, paint, ...(source in GROUPS || source === "sketch" ? { group: source === "sketch" ? "drawings" : source } : {}), ...more };
};
const [fill, line, circle, symbol] = ["fill", "line", "circle", "symbol"].map(layer);
const is = (name, value) => ["==", ["get", name], value];
const when = (filter) => ({ filter });
const isPoint = ["==", ["geometry-type"], "Point"];
const stroke = (colour, width, more) => ({ "line-color": colour, "line-width": width, ...more });
const text = (field, more) => ({ "text-field": field, "text-font": ["sans-serif"], ...more });

function layers() {
  const gap = when(["in", ["get", "status"], ["literal", ["not-compared", "hole"]]]);
  const purpose = ["match", ["get", "purpose"], "alert", "#ff6b6b", "interest", "#4dabf7", "waypoint", "#ffe066", "found", "#ff6b6b", "#ffffff"];
  const kind = matched("kind", KINDS, "#fff");
  const unlessRejected = (rejected, other) => ["case", is("review", "rejected"), rejected, other];
  const ifConfirmed = (confirmed, other) => ["case", is("review", "confirmed"), confirmed, other];
  const letter = ["match", ["get", "class"], ...Object.entries(CLASSES).flatMap(([key, [, , each]]) => [key, each]), OTHER_CLASS[2]];
  const round = { layout: { "line-join": "round" } };
  return [
    fill("coverage", { "fill-pattern": "hatch", "fill-opacity": 0.75 }, gap),
    line("coverage-edge", stroke("#fff", 1.2, { "line-dasharray": [3, 2] }), gap),
    fill("pod", { "fill-opacity": 0.6, "fill-color": ["step", ["get", "pod_from"], POD_RAMP[0], ...POD_RAMP.slice(1).flatMap((colour, k) => [(k + 1) / 5 - 0.01, colour])] }, when(is("kind", "pod"))),
    fill("pod-hole-fill", { "fill-opacity": 0 }, when(is("kind", "hole"))),
    line("pod-hole", stroke("#fff", 1.6, { "line-dasharray": [2, 2] }), when(is("kind", "hole"))),
    line("frames", stroke(matched("status", PLACED, "#adb5bd"), 0.8, { "line-opacity": 0.7 })),
    line("track-halo", stroke("#08100d", 4, { "line-opacity": 0.4 }), round),
    line("track", stroke("#fff", 1.8, { "line-opacity": 0.9 }), round),
    ...["drawings", "sketch"].flatMap((source) => [
      fill(`${source}-fill`, { "fill-color": purpose, "fill-opacity": 0.14 }, when(["==", ["geometry-type"], "Polygon"])),
      line(`${source}-line`, stroke(purpose, 2.4, { "line-dasharray": [2.5, 1.5] }), when(["!", isPoint])),
      circle(`${source}-point`, { "circle-color": purpose, "circle-radius": 6, "circle-stroke-color": DARK, "circle-stroke-width": 2 }, when(isPoint)),
      symbol(`${source}-name`, { "text-color": "#fff", "text-halo-color": DARK, "text-halo-width": 1.6 },
        { filter: ["has", "name"], layout: text(["get", "name"], { "text-size": 12, "text-offset": [0, 1.1], "text-optional": true }) }),
    ]),
    fill("changes-fill", { "fill-color": kind, "fill-opacity": unlessRejected(0.05, 0.18) }),
    line("changes-halo", stroke("#fff", 4.5, { "line-opacity": unlessRejected(0.2, 0.7) })),
    line("changes-line", stroke(kind, 2.4, { "line-opacity": unlessRejected(0.4, 1) })),
    circle("objects", { "circle-radius": ["interpolate", ["linear"], ["zoom"], 16, 4, 20, 9], "circle-color": matched("class", CLASSES, OTHER_CLASS[1]),
      "circle-opacity": unlessRejected(0.35, 1), "circle-stroke-color": ifConfirmed("#ffffff", DARK), "circle-stroke-width": ifConfirmed(3, 1.6) }),
    symbol("objects-letter", { "text-color": DARK }, { minzoom: 18, layout: text(letter, { "text-size": 11, "text-allow-overlap": true }) }),
    line("chosen-line", stroke("#fff", 4), when(["!", isPoint])),
    circle("chosen-ring", { "circle-radius": 16, "circle-color": "transparent", "circle-stroke-color": "#fff", "circle-stroke-width": 3 }, when(isPoint)),
    fill("drone-footprint", { "fill-color": "#fff", "fill-opacity": 0.12 }, when(is("part", "footprint"))),
    line("drone-footprint-edge", stroke("#fff", 1.6), when(is("part", "footprint"))),
    line("drone-view", stroke("#ffe066", 1.2, { "line-dasharray": [3, 2] }), when(is("part", "view"))),
    symbol("drone-body", {}, { filter: is("part", "body"),
      layout: { "icon-image": "drone", "icon-rotate": ["get", "heading_deg"], "icon-rotation-alignment": "map", "icon-allow-overlap": true } }),
  ];
}

/** The pictures that layers name: a hatch for ground that was not compared, and the drone. */
export function pictures() {
  return {
    hatch: drawn(12, (pen, side) => {
      pen.fillStyle = "rgba(14, 22, 19, 0.42)";
      pen.fillRect(0, 0, side, side);
      Object.assign(pen, { strokeStyle: "rgba(255, 255, 255, 0.55)", lineWidth: 1.6 });
      for (const shift of [-side, 0, side]) pen.stroke(new Path2D(`M${shift} ${side}l${side} ${-side}`));
    }),
    drone: drawn(44, (pen, side) => {
      const shape = new Path2D("M0-17 12 14 0 7-12 14Z");
      pen.translate(side / 2, side / 2);
      Object.assign(pen, { fillStyle: "#ffe066", strokeStyle: DARK, lineWidth: 3, lineJoin: "round" });
      pen.stroke(shape);
      pen.fill(shape);
    }),
  };
}

function drawn(side, draw) {
  const pen = Object.assign(document.createElement("canvas"), { width: side, height: side }).getContext("2d");
  draw(pen, side);
  return pen.getImageData(0, 0, side, side);
}
