"""People and cars on the orthophotos of a real building site: python benchmarks/site_objects.py FLIGHTS MODEL ...

FLIGHTS is the folder with `building_site`, five orthophotos of 14.6 cm a pixel, sharp as photos are. Each is searched
as a map's photos from straight above are, at the scale of its ground. Of two car parks all cars were drawn by eye for
`real_dates.json` (18 on 2023-09-26, aslant in strong shadows; 35 on 2024-03-01): how many of them does each model find
at its threshold, and with half of that score? All reports are counted; with --out FOLDER the crops of each date and
class are drawn there, and how many are right was counted by eye: --right MODEL:DATE:CLASS=COUNT.

Nothing was learnt from these pictures; the softening and the scale of decision 0086 were chosen on the drawn cars.
Writes results/site_objects.json.
"""

import argparse
import json
import time
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from false_alarms import crop, possible, sheet
from provenance import commit, machine, note_scoring
from real_dates import M_PER_PX, TAKEN
from sorvolo.detection.detector import Detector
from sorvolo.survey.objects import Detections

HERE = Path(__file__).parent
RESULTS = HERE / "results" / "site_objects.json"
SHOWN = ("person", "car")
CAR_PARKS = {
    "2023-09-26": ("2023-09-26/2023-10-14", "lot car"),
    "2024-03-01": ("2024-02-24/2024-03-01", "parked car"),
}
BESIDE_PX, LONGEST_PX = (
    9.0,
    58.0,
)  # a report's middle from a drawn car's; longer boxes are of more than one car


def main() -> None:
    """Search, count, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("flights", type=Path)
    parser.add_argument("models", nargs="+")
    parser.add_argument("--right", nargs="*", default=[])
    parser.add_argument("--out", type=Path)
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    right = {key: int(count) for key, count in (each.split("=") for each in wishes.right)}
    models: dict[str, Any] = {}
    for model in wishes.models:
        detector, name = Detector.load(model, provider="cpu", threads=1), Path(model).stem
        models[name] = {
            "version": detector.info.version,
            "dates": {
                date: of_date(detector, date, wishes.flights, wishes.out and wishes.out / name)
                for date in TAKEN
            },
        }
        for date, row in models[name]["dates"].items():
            for label in SHOWN:
                row[label] |= (
                    {"right_by_eye": right[key]}
                    if (key := f"{name}:{date}:{label}") in right
                    else {}
                )
        print(name, json.dumps(models[name]), flush=True)
    wishes.results.write_text(
        json.dumps(
            {
                "benchmark": "site_objects",
                "machine": machine(),
                "commit": commit(),
                "date": time.strftime("%Y-%m-%d"),
                **note_scoring("site_objects, building_site"),
                "models": models,
            },
            indent=1,
        )
        + "\n"
    )


def of_date(detector: Detector, date: str, flights: Path, out: Path | None) -> dict[str, Any]:
    """Reports on one orthophoto, and which drawn cars they are."""
    shown = cv2.imread(str(flights / "building_site" / f"{date}.jpg"), cv2.IMREAD_COLOR)
    thresholds = detector.info.turned or detector.info.thresholds
    half = min(thresholds[label] for label in SHOWN) / 2
    seen = detector.detect(
        np.ascontiguousarray(shown[..., ::-1]),
        tiles="auto",
        m_per_px=M_PER_PX,
        classes=SHOWN,
        from_above=True,
        least_score=half,
    )
    reported = possible(seen, shown, M_PER_PX, thresholds)
    reported = reported.only(reported.scores >= [thresholds[name] for name in reported.names])
    row: dict[str, Any] = {}
    for label in SHOWN:
        at = [k for k, name in enumerate(reported.names) if name == label]
        row[label] = {"threshold": thresholds[label], "reports": len(at)}
        if out is not None and len(at):
            out.mkdir(parents=True, exist_ok=True)
            crops = [crop(shown, reported.boxes_px[k], f"{reported.scores[k]:.2f}") for k in at]
            cv2.imwrite(str(out / f"{date}-{label}.png"), sheet(crops))
    if date in CAR_PARKS:
        cars_px = cars_of(date)
        row["car_park"] = {
            "cars": len(cars_px),
            "found": int(np.count_nonzero(best_scores(reported, cars_px))),
            "with_half_the_score": int(
                np.count_nonzero(best_scores(seen, cars_px) >= thresholds["car"] / 2)
            ),
        }
    return row


def cars_of(date: str) -> np.ndarray:
    """(N, 2) the middles of a car park's cars, in pixels of its date."""
    pair, begins = CAR_PARKS[date]
    truth = json.loads((HERE / "real_dates.json").read_text())
    changes = truth["changes"] if pair == truth["changes_of"] else truth["others"][pair]["changes"]
    middles = np.array(
        [np.mean(each["px"], axis=0) for name, each in changes.items() if name.startswith(begins)]
    )
    if pair.startswith(date):
        return middles
    b_to_a = np.array(truth["pairs"][pair]["b_to_a"])
    return np.asarray((middles - b_to_a[:, 2]) @ np.linalg.inv(b_to_a[:, :2]).T)


def best_scores(seen: Detections, cars_px: np.ndarray) -> np.ndarray:
    """(N,) the best score of a report of a car at each of these places, 0 where there is none."""
    is_car = np.array([name == "car" for name in seen.names], bool)
    boxes, scores = seen.boxes_px[is_car], seen.scores[is_car]
    kept = (boxes[:, 2:] - boxes[:, :2]).max(axis=1, initial=0) < LONGEST_PX
    middles, scores = ((boxes[:, :2] + boxes[:, 2:]) / 2)[kept], scores[kept]
    near = (np.abs(middles[None] - cars_px[:, None]) <= BESIDE_PX).all(axis=2)
    return np.asarray(np.where(near, scores[None], 0.0).max(axis=1, initial=0.0))


if __name__ == "__main__":
    main()
