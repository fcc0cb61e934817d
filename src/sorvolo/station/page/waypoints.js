// Waypoints over ground that deserves another look: holes of a measured search, ground that no comparison reached.

import { area_m2, boundsOf, distance_m, featureOf, metresOfDegree, polygonsOf } from "./places.js";

const LEAST_M2 = 20; // smaller holes are not worth a flight
const FEWEST_M = 25; // between waypoints: about the width of a frame's ground from 30 m
const MOST = 60;

/** Waypoints as features, a route from the largest hole on; strips of points where a hole is wider than a frame. */
export function waypointsFor(data) {
  const searched = data.all.pod.filter((each) => each.properties.kind === "hole"); // it knows better than flights where nobody looked
  const holes = data.all.pod.length ? searched : data.all.coverage.filter(({ properties: { status, gap } }) => status === "hole" || (status === "not-compared" && ["view-rejected", "one-view", "blurred"].includes(gap)));
  const rings = holes.flatMap((each) => polygonsOf(each.geometry).map(([outer]) => outer));
  const large = rings.map((ring) => [ring, area_m2(ring.slice(0, -1))]).filter(([, m2]) => m2 >= LEAST_M2).sort((one, other) => other[1] - one[1]);
  const waiting = large.flatMap(([ring]) => pointsOver(ring)).slice(0, MOST);
  const route = waiting.splice(0, 1);
  while (waiting.length) { // one route: always on to the nearest
    const nearest = waiting.reduce((best, each, k) => (distance_m(route.at(-1), each) < distance_m(route.at(-1), waiting[best]) ? k : best), 0);
    route.push(...waiting.splice(nearest, 1));
  }
  return route.map((place, k) => ({ id: `planned-${k + 1}`, ...featureOf("Point", place, { purpose: "waypoint", planned: true, name: `W${k + 1}` }) }));
}

function pointsOver(ring) {
  const [west, south, east, north] = boundsOf([{ coordinates: ring }]);
  const [x, y] = metresOfDegree((south + north) / 2);
  const columns = Math.max(1, Math.round((east - west) * x / FEWEST_M));
  const rows = Math.max(1, Math.round((north - south) * y / FEWEST_M));
  const points = [];
  for (let row = 0; row < rows; row++) {
    for (let k = 0; k < columns; k++) {
      const column = row % 2 ? columns - 1 - k : k; // there and back, as a drone flies
      points.push([west + (east - west) * (column + 0.5) / columns, south + (north - south) * (row + 0.5) / rows]);
    }
  }
  return points;
}
