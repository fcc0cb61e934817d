// An optional base map below the mosaic: a PMTiles file, raster or in Protomaps' vector schema; no network is needed.

import * as maplibre from "./vendor/maplibre-gl.mjs";
import { isDark } from "./choices.js";
import { button, el, message, quiet } from "./dom.js";
import { say } from "./languages.js";

const VECTOR = 1; // the tile type in a PMTiles header

let library = null;

/** The PMTiles library, loaded when first needed. */
async function pmtiles() {
  library ??= new Promise((done, failed) => {
    const script = el("script", { src: "/page/vendor/pmtiles.js" });
    script.addEventListener("load", () => {
      const protocol = new window.pmtiles.Protocol();
      maplibre.addProtocol("pmtiles", protocol.tile);
      done({ protocol, ...window.pmtiles });
    });
    script.addEventListener("error", () => { library = null; failed(new Error("the PMTiles library did not load")); });
    document.head.append(script);
  });
  return library;
}

/** A control to choose a file of this device, or the station's own where it has one. */
export function chooseBaseMap(screen) {
  const input = el("input", { type: "file", accept: ".pmtiles", "aria-label": say("Base map file (PMTiles)") });
  input.addEventListener("change", async () => {
    if (!input.files.length) return;
    const { PMTiles, FileSource } = await pmtiles();
    await showBaseMap(screen, new PMTiles(new FileSource(input.files[0])));
  });
  const own = screen.station.status.base_map_url;
  return el("div.stack", input, own ? button(say("The station's base map"), () => showStationMap(screen)) : null, quiet(say("No base map"), () => { if (screen.view) takeOut(screen.view.map); }));
}

export async function showStationMap(screen) {
  const own = screen.station.status.base_map_url;
  if (!own) return;
  const { PMTiles } = await pmtiles();
  await showBaseMap(screen, new PMTiles(new URL(own, location.href).href));
}

async function showBaseMap(screen, archive) {
  if (!screen.view) return;
  const { map } = screen.view;
  try {
    const header = await archive.getHeader();
    const { protocol } = await pmtiles();
    protocol.add(archive);
    takeOut(map);
    const url = `pmtiles://${archive.source.getKey()}`;
    const isVector = header.tileType === VECTOR;
    map.addSource("base", isVector ? { type: "vector", url } : { type: "raster", url, tileSize: 256 });
    const first = map.getStyle().layers.find((each) => each.id !== "ground")?.id;
    for (const layer of isVector ? vectorLayers(isDark()) : [{ id: "base-raster", type: "raster" }]) map.addLayer({ ...layer, source: "base" }, first);
    if (!screen.data.detail.bounds_wgs84) map.jumpTo({ center: [header.centerLon, header.centerLat], zoom: header.centerZoom });
  } catch (error) {
    message(say("This base map cannot be read"), { kind: "error", todo: say("A PMTiles file (version 3) was needed: {why}", { why: error.message }) });
  }
}

function takeOut(map) {
  for (const { id } of map.getStyle().layers) if (id.startsWith("base-")) map.removeLayer(id);
  if (map.getSource("base")) map.removeSource("base");
}

/** Protomaps' layers, drawn quietly: the mosaic and what was found are to stand out. */
function vectorLayers(dark) {
  const [land, green, water, road, house, edge] = dark
    ? ["#1b2422", "#1e2d25", "#16303f", "#3a4744", "#26312e", "#5c6b67"]
    : ["#eef0ee", "#dcebdc", "#bcd9e8", "#ffffff", "#dcdcd6", "#8a9a95"];
  const area = (id, layer, colour, filter) => ({ id: `base-${id}`, type: "fill", "source-layer": layer, paint: { "fill-color": colour }, ...(filter && { filter }) });
  return [
    area("earth", "earth", land), area("landcover", "landcover", green), area("landuse", "landuse", green,
      ["in", ["get", "kind"], ["literal", ["forest", "wood", "park", "grass", "meadow", "nature_reserve", "farmland"]]]),
    area("water", "water", water), area("houses", "buildings", house),
    { id: "base-roads", type: "line", "source-layer": "roads", paint: { "line-color": road, "line-width": ["interpolate", ["exponential", 1.6], ["zoom"], 10, 0.5, 18, 8] } },
    { id: "base-borders", type: "line", "source-layer": "boundaries", paint: { "line-color": edge, "line-dasharray": [3, 2] } },
  ];
}
