// How the map looks: sources and layers, their colours, patterns and order.

export const KINDS = {
  appeared: ["appeared", "#12b886"], disappeared: ["disappeared", "#f03e3e"], replaced: ["replaced", "#9c6bff"],
  area: ["ground changed", "#228be6"], moving: ["moving", "#fd9e14"],
};
export const CLASSES = {
  person: ["people", "#ff4fa3", "P"], car: ["cars", "#22c3e6", "C"], "small object": ["small objects", "#ffd43b", "S"],
};
export const OTHER_CLASS = ["others", "#e9ecef", "?"];
export const PLACED = { vision: ["placed by vision", "#35b98a"], "gps-only": ["placed by GPS alone", "#f0a835"] };

/** Chances of 0 to 20 % and so on that somebody would have been seen: cividis, told apart by every eye. */
export const POD_RAMP = ["#00224e", "#444d6b", "#7d7c78", "#bcae6c", "#fee838"];

const EMPTY = { type: "FeatureCollection", features: [] };
export const DATA = ["coverage", "pod", "frames", "track", "drawings", "sketch", "changes", "objects", "drone", "chosen"];

const matched = (property, table, other) => ["match", ["get", property], ...Object.entries(table).flatMap(([key, [, colour]]) => [key, colour]), other];

/** Layers by group: what a tick in the panel shows and hides. */
export const GROUPS = {
  mosaic: ["Map", true], frames: ["Footprints of the frames", false], track: ["Track", true],
  objects: ["Objects", true], changes: ["Changes", true], coverage: ["Coverage gaps", false],
  pod: ["Chance to have seen a person", false], drone: ["Drone and field of view", true], drawings: ["Drawings and zones", true],
};

/** The style with empty data; `dark` chooses the ground's colour. */
export function mapStyle(dark) {
  const sources = Object.fromEntries(DATA.map((name) => [name, { type: "geojson", data: EMPTY }]));
  return { version: 8, sources, layers: [{ id: "ground", type: "background", paint: { "background-color": groundColour(dark) } }, ...layers()] };
}

export const groundColour = (dark) => (dark ? "#151c1a" : "#e3e8e5");

function layers() {
  return [...groundLayers(), ...flightLayers(), ...drawnLayers(), ...foundLayers(), ...droneLayers()];
}

function groundLayers() {
  return [
    { id: "coverage", group: "coverage", type: "fill", source: "coverage", filter: ["in", ["get", "status"], ["literal", ["not-compared", "hole"]]],
      paint: { "fill-pattern": "hatch", "fill-opacity": 0.75 } },
    { id: "coverage-edge", group: "coverage", type: "line", source: "coverage", filter: ["in", ["get", "status"], ["literal", ["not-compared", "hole"]]],
      paint: { "line-color": "#fff", "line-width": 1.2, "line-dasharray": [3, 2] } },
    { id: "pod", group: "pod", type: "fill", source: "pod", filter: ["==", ["get", "kind"], "pod"],
      paint: { "fill-opacity": 0.6, "fill-color": ["step", ["get", "pod_from"], POD_RAMP[0], ...POD_RAMP.slice(1).flatMap((colour, k) => [(k + 1) / 5 - 0.01, colour])] } },
    { id: "pod-hole-fill", group: "pod", type: "fill", source: "pod", filter: ["==", ["get", "kind"], "hole"], paint: { "fill-opacity": 0 } },
    { id: "pod-hole", group: "pod", type: "line", source: "pod", filter: ["==", ["get", "kind"], "hole"],
      paint: { "line-color": "#fff", "line-width": 1.6, "line-dasharray": [2, 2] } },
  ];
}

function flightLayers() {
  const colour = matched("status", PLACED, "#adb5bd");
  return [
    { id: "frames", group: "frames", type: "line", source: "frames", paint: { "line-color": colour, "line-width": 0.8, "line-opacity": 0.7 } },
    { id: "track-halo", group: "track", type: "line", source: "track", layout: { "line-join": "round" },
      paint: { "line-color": "#08100d", "line-width": 4, "line-opacity": 0.4 } },
    { id: "track", group: "track", type: "line", source: "track", layout: { "line-join": "round" },
      paint: { "line-color": "#fff", "line-width": 1.8, "line-opacity": 0.9 } },
  ];
}

function drawnLayers() {
  const colour = ["match", ["get", "purpose"], "alert", "#ff6b6b", "measure", "#ffffff", "interest", "#4dabf7", "waypoint", "#ffe066", "found", "#ff6b6b", "#ffffff"];
  const isArea = ["==", ["geometry-type"], "Polygon"];
  const isPoint = ["==", ["geometry-type"], "Point"];
  return ["drawings", "sketch"].flatMap((source) => [
    { id: `${source}-fill`, group: "drawings", type: "fill", source, filter: isArea, paint: { "fill-color": colour, "fill-opacity": 0.14 } },
    { id: `${source}-line`, group: "drawings", type: "line", source, filter: ["!", isPoint], paint: { "line-color": colour, "line-width": 2.4, "line-dasharray": [2.5, 1.5] } },
    { id: `${source}-point`, group: "drawings", type: "circle", source, filter: isPoint,
      paint: { "circle-color": colour, "circle-radius": 6, "circle-stroke-color": "#10201b", "circle-stroke-width": 2 } },
    { id: `${source}-name`, group: "drawings", type: "symbol", source, filter: ["has", "name"],
      layout: { "text-field": ["get", "name"], "text-size": 12, "text-font": ["sans-serif"], "text-offset": [0, 1.1], "text-optional": true },
      paint: { "text-color": "#fff", "text-halo-color": "#10201b", "text-halo-width": 1.6 } },
  ]);
}

function foundLayers() {
  const kind = matched("kind", KINDS, "#fff");
  const rejected = ["==", ["get", "review"], "rejected"];
  const kindOfClass = ["match", ["get", "class"], ...Object.entries(CLASSES).flatMap(([key, [, , letter]]) => [key, letter]), OTHER_CLASS[2]];
  return [
    { id: "changes-fill", group: "changes", type: "fill", source: "changes", paint: { "fill-color": kind, "fill-opacity": ["case", rejected, 0.05, 0.18] } },
    { id: "changes-halo", group: "changes", type: "line", source: "changes", paint: { "line-color": "#fff", "line-width": 4.5, "line-opacity": ["case", rejected, 0.2, 0.7] } },
    { id: "changes-line", group: "changes", type: "line", source: "changes", paint: { "line-color": kind, "line-width": 2.4, "line-opacity": ["case", rejected, 0.4, 1] } },
    { id: "objects", group: "objects", type: "circle", source: "objects",
      paint: { "circle-radius": ["interpolate", ["linear"], ["zoom"], 16, 4, 20, 9], "circle-color": matched("class", CLASSES, OTHER_CLASS[1]),
        "circle-opacity": ["case", rejected, 0.35, 1], "circle-stroke-color": ["case", ["==", ["get", "review"], "confirmed"], "#ffffff", "#10201b"],
        "circle-stroke-width": ["case", ["==", ["get", "review"], "confirmed"], 3, 1.6] } },
    { id: "objects-letter", group: "objects", type: "symbol", source: "objects", minzoom: 18,
      layout: { "text-field": kindOfClass, "text-size": 11, "text-font": ["sans-serif"], "text-allow-overlap": true },
      paint: { "text-color": "#10201b" } },
    { id: "chosen-line", type: "line", source: "chosen", filter: ["!=", ["geometry-type"], "Point"], paint: { "line-color": "#fff", "line-width": 4 } },
    { id: "chosen-ring", type: "circle", source: "chosen", filter: ["==", ["geometry-type"], "Point"],
      paint: { "circle-radius": 16, "circle-color": "transparent", "circle-stroke-color": "#fff", "circle-stroke-width": 3 } },
  ];
}

function droneLayers() {
  const is = (part) => ["==", ["get", "part"], part];
  return [
    { id: "drone-footprint", group: "drone", type: "fill", source: "drone", filter: is("footprint"), paint: { "fill-color": "#fff", "fill-opacity": 0.12 } },
    { id: "drone-footprint-edge", group: "drone", type: "line", source: "drone", filter: is("footprint"), paint: { "line-color": "#fff", "line-width": 1.6 } },
    { id: "drone-view", group: "drone", type: "line", source: "drone", filter: is("view"), paint: { "line-color": "#ffe066", "line-width": 1.2, "line-dasharray": [3, 2] } },
    { id: "drone-body", group: "drone", type: "symbol", source: "drone", filter: is("body"),
      layout: { "icon-image": "drone", "icon-rotate": ["get", "heading_deg"], "icon-rotation-alignment": "map", "icon-allow-overlap": true } },
  ];
}

/** The pictures that layers name: a hatch for ground that was not compared, and the drone. */
export function pictures() {
  return { hatch: hatch(), drone: drone() };
}

function canvas(side) {
  const made = document.createElement("canvas");
  made.width = made.height = side;
  return [made.getContext("2d"), side];
}

function hatch() {
  const [pen, side] = canvas(12);
  pen.fillStyle = "rgba(14, 22, 19, 0.42)";
  pen.fillRect(0, 0, side, side);
  pen.strokeStyle = "rgba(255, 255, 255, 0.55)";
  pen.lineWidth = 1.6;
  for (const shift of [-side, 0, side]) {
    pen.beginPath();
    pen.moveTo(shift, side);
    pen.lineTo(shift + side, 0);
    pen.stroke();
  }
  return pen.getImageData(0, 0, side, side);
}

function drone() {
  const [pen, side] = canvas(44);
  pen.translate(side / 2, side / 2);
  pen.beginPath();
  pen.moveTo(0, -17);
  pen.lineTo(12, 14);
  pen.lineTo(0, 7);
  pen.lineTo(-12, 14);
  pen.closePath();
  pen.fillStyle = "#ffe066";
  pen.strokeStyle = "#10201b";
  pen.lineWidth = 3;
  pen.lineJoin = "round";
  pen.stroke();
  pen.fill();
  return pen.getImageData(0, 0, side, side);
}
