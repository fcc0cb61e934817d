"""What models report of real flights that hardly show anyone: python benchmarks/false_alarms.py FLIGHTS MODEL ...

FLIGHTS is the folder with `brighton_beach` (18 photos, no part of it was learnt as bare ground, cars are parked
there) and `caliterra` (from its 47th photo on; the ground up to there taught the judge what is no car, so that its
figures are too good; one white car and some machines). Photos are shown at half size (--scale), as they would be at
half the resolution, and counted at each model's own thresholds. As in a map, photos are shown at the scale of their
ground (M_PER_PX, roughly known), models that ask for it look twice, and boxes of a size on the ground that their
class cannot have, or whose length there leaves less than the threshold, do not count; with --plain each photo is shown
as it is, once, and every box counts. With --out FOLDER, each report's crop is drawn there; how many of them are right
was counted by eye, and is given with --right MODEL:FLIGHT:CLASS=COUNT.

Writes results/false_alarms.json: reports a photo, and false ones where --right is given.
"""

import argparse
import json
import time
from collections.abc import Mapping
from pathlib import Path

import cv2
import numpy as np

from mosaic_methods import commit, machine
from provenance import note_scoring
from sorvolo.detection.detector import Detector
from sorvolo.survey.objects import Detections
from sorvolo.tracking.sizes import (
    TOO_SHORT_CUT_PX,
    cut_edges,
    impossible_size,
    length_log_odds,
    with_log_odds,
)

RESULTS = Path(__file__).parent / "results" / "false_alarms.json"
FIRST = {"brighton_beach": "", "caliterra": "IMG_9400.jpg"}
M_PER_PX = {"brighton_beach": 0.034, "caliterra": 0.07}  # of a photo at half size
SCALE_SIGMA = 0.1  # by which that may be off, relative
SHOWN = ("person", "car")
SCALE, CROP_PX, IN_A_ROW = 0.5, 120, 10


def main() -> None:
    """Look, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flights", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--right", nargs="*", default=[])
    parser.add_argument(
        "--scale", type=float, default=SCALE, help="at which photos are shown, 1 for as they are"
    )
    parser.add_argument("--plain", action="store_true", help="as it is, once, every box")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    right = {key: int(count) for key, count in (each.split("=") for each in wishes.right)}
    found = {}
    for model in wishes.models:
        detector = Detector.load(model, provider="cpu", threads=1)
        name = Path(model).stem
        out = wishes.out and wishes.out / name
        found[name] = {
            flight: looked(
                detector, wishes.flights / flight, out, wishes.scale, is_plain=wishes.plain
            )
            for flight in FIRST
        }
        for flight, rows in found[name].items():
            for label in SHOWN:
                if (count := right.get(f"{name}:{flight}:{label}")) is not None:
                    rows[label]["right_by_eye"] = count
                    rows[label]["false_a_photo"] = round(
                        (rows[label]["reports"] - count) / rows["photos"], 3
                    )
        print(name, json.dumps(found[name]), flush=True)
    document = {
        "benchmark": "false_alarms",
        "machine": machine(),
        "commit": commit(),
        "scale": wishes.scale,
        "plain": wishes.plain,
        **note_scoring("false_alarms, brighton_beach and caliterra"),
        "date": time.strftime("%Y-%m-%d"),
        "models": found,
    }
    wishes.results.write_text(json.dumps(document, indent=1) + "\n")


def looked(
    detector: Detector, folder: Path, out: Path | None, scale: float, *, is_plain: bool
) -> dict:
    """Reports of each class over a flight's photos."""
    paths = [each for each in sorted(folder.iterdir()) if each.suffix.lower() == ".jpg"]
    paths = [each for each in paths if each.name >= FIRST[folder.name]]
    scores: dict[str, list[float]] = {label: [] for label in SHOWN}
    crops: dict[str, list[np.ndarray]] = {label: [] for label in SHOWN}
    for path in paths:
        whole = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_COLOR)
        shown = cv2.resize(whole, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
        picture = np.ascontiguousarray(shown[..., ::-1])
        if is_plain:
            seen = detector.detect(picture, tiles="auto", classes=SHOWN)
        else:
            m_per_px = M_PER_PX[folder.name] * SCALE / scale
            seen = detector.detect(
                picture, tiles="auto", m_per_px=m_per_px, classes=SHOWN, from_above=True
            )
            seen = possible(seen, shown, m_per_px, detector.info.turned or detector.info.thresholds)
        for box, score, label in zip(seen.boxes_px, seen.scores, seen.names):
            scores[label].append(float(score))
            crops[label].append(crop(shown, box, f"{score:.2f} {path.stem[-4:]}"))
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        for label, each in crops.items():
            if each:
                cv2.imwrite(str(out / f"{folder.name}-{label}.png"), sheet(each))
    thresholds = (
        detector.info.thresholds if is_plain else detector.info.turned or detector.info.thresholds
    )
    return {"photos": len(paths)} | {
        label: {
            "threshold": thresholds[label],
            "reports": len(each),
            "a_photo": round(len(each) / len(paths), 3),
            "highest": round(max(each, default=0.0), 3),
        }
        for label, each in scores.items()
    }


def possible(
    seen: Detections, shown: np.ndarray, m_per_px: float, thresholds: Mapping[str, float]
) -> Detections:
    """Without boxes of a size that their class cannot have, or hardly has, as maps and watches leave them out."""
    cut = cut_edges(seen.boxes_px, shown.shape[1], shown.shape[0], TOO_SHORT_CUT_PX)
    sides_m = (seen.boxes_px[:, 2:] - seen.boxes_px[:, :2]).astype(float) * m_per_px
    likely = [
        is_cut
        or with_log_odds(score, length_log_odds(name, length_m, SCALE_SIGMA)) >= thresholds[name]
        for name, score, length_m, is_cut in zip(
            seen.names, seen.scores.tolist(), sides_m.max(axis=1), cut.any(axis=1)
        )
    ]
    return seen.only(~impossible_size(seen.names, sides_m, cut) & np.array(likely, bool))


def crop(picture: np.ndarray, box: np.ndarray, text: str) -> np.ndarray:
    """A report with its surroundings."""
    reach = max(20, int(max(box[2:] - box[:2])))
    x, y = (int(each) for each in (box[:2] + box[2:]) / 2)
    wide = cv2.copyMakeBorder(picture, reach, reach, reach, reach, cv2.BORDER_CONSTANT)
    cut = cv2.resize(wide[y : y + 2 * reach, x : x + 2 * reach], (CROP_PX, CROP_PX))
    return cv2.putText(cut, text, (2, 12), cv2.FONT_HERSHEY_SIMPLEX, 0.42, (0, 255, 255), 1)


def sheet(crops: list[np.ndarray]) -> np.ndarray:
    """All of them, ten in a row."""
    empty = np.zeros_like(crops[0])
    crops = crops + [empty] * (-len(crops) % IN_A_ROW)
    return np.vstack(
        [np.hstack(crops[row : row + IN_A_ROW]) for row in range(0, len(crops), IN_A_ROW)]
    )


if __name__ == "__main__":
    main()
