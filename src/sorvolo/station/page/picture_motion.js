// How a video's picture moves, by the steps that a watch measures: boxes of one picture carried to another.

const KEPT_STEPS = 120; // twelve seconds
const AHEAD_US = 1000000; // further beyond the last step than this, nobody knows how the camera moves
const STILL = [1, 0, 0, 0, 1, 0, 0, 0, 1];

/** The steps of one stream; `take` adds one. Times are the pictures' own, us; matrices 3x3, row by row. */
export class PictureMotion {
  constructor() {
    this.steps = [];
  }

  take({ from_us, pts_us, to_from }) {
    if (this.steps.length && from_us < this.steps.at(-1).pts_us) this.steps = []; // the stream began anew
    this.steps.push({ from_us, pts_us, to_from });
    this.steps.splice(0, this.steps.length - KEPT_STEPS);
  }

  /** Where the ground of one picture lies in another; null where the way between them is not known. */
  between(from_us, to_us) {
    if (to_us < from_us) {
      const back = this.between(to_us, from_us);
      return back && inverse(back);
    }
    let whole = STILL;
    for (let now_us = from_us; now_us < to_us;) {
      const step = this.stepAt(now_us);
      if (!step) return null;
      const until_us = Math.min(step.pts_us, to_us);
      whole = product(product(partOf(step, until_us), inverse(partOf(step, now_us))), whole);
      now_us = until_us;
    }
    return whole;
  }

  /** The step in which a moment lies; for a while after the last one, the last one going on. */
  stepAt(moment_us) {
    const last = this.steps.at(-1);
    if (!last || moment_us < last.pts_us) return this.steps.find((each) => each.from_us <= moment_us && moment_us < each.pts_us);
    if (moment_us - last.pts_us > AHEAD_US) return undefined;
    const length_us = last.pts_us - last.from_us;
    const from_us = moment_us - ((moment_us - last.from_us) % length_us);
    return { from_us, pts_us: from_us + length_us, to_from: last.to_from };
  }

  /** A picture's boxes where another picture shows them; null where that is not known. */
  carried({ pts_us, boxes, frame_size_px: [width, height] }, to_us) {
    const to_from = this.between(pts_us, to_us);
    if (!to_from) return null;
    return boxes.map((box) => carriedBox(box, to_from))
      .filter(({ xywh_px: [x, y, w, h] }) => x + w / 2 > 0 && y + h / 2 > 0 && x + w / 2 < width && y + h / 2 < height);
  }
}

/** A box where its ground has gone, as large as its ground appears there. */
function carriedBox(box, to_from) {
  const [x, y, w, h] = box.xywh_px;
  const middle = [x + w / 2, y + h / 2];
  const [to_x, to_y] = moved(to_from, middle);
  const right = moved(to_from, [middle[0] + 1, middle[1]]), below = moved(to_from, [middle[0], middle[1] + 1]);
  const scale = Math.sqrt(Math.abs((right[0] - to_x) * (below[1] - to_y) - (right[1] - to_y) * (below[0] - to_x)));
  return { ...box, xywh_px: [to_x - (w * scale) / 2, to_y - (h * scale) / 2, w * scale, h * scale] };
}

/** From a step's first picture to a moment within it: the camera moves evenly meanwhile. */
function partOf({ from_us, pts_us, to_from }, moment_us) {
  const share = (moment_us - from_us) / (pts_us - from_us);
  return STILL.map((still, index) => still + (to_from[index] - still) * share);
}

function moved(matrix, [x, y]) {
  const [u, v, w] = [0, 3, 6].map((row) => matrix[row] * x + matrix[row + 1] * y + matrix[row + 2]);
  return [u / w, v / w];
}

function product(outer, inner) {
  return STILL.map((_, index) => {
    const row = 3 * Math.floor(index / 3), column = index % 3;
    return outer[row] * inner[column] + outer[row + 1] * inner[column + 3] + outer[row + 2] * inner[column + 6];
  });
}

function inverse([a, b, c, d, e, f, g, h, i]) {
  const [p, q, r] = [e * i - f * h, f * g - d * i, d * h - e * g];
  const size = a * p + b * q + c * r;
  return [p, c * h - b * i, b * f - c * e, q, a * i - c * g, c * d - a * f, r, b * g - a * h, a * e - b * d].map((each) => each / size);
}
