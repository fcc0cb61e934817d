"""What searching a thermal frame in several sizes changes: benchmarks/pyramid_thermal.py DATA

Decision 0084. The validation frames of HIT-UAV, searched by `thermal` at every one of SIZES as if their scale were not
known (one is shown at 1.5 then). AP50 and AP of people and cars at each size alone, and by pyramids of some of them.
Writes results/pyramid_thermal.json.
"""

import argparse
import json
import time
from pathlib import Path

from detection_data import hituav
from fit_second_look import PERSON
from provenance import commit, machine
from pyramid import CAR, Searched, accuracy, only, pyramid_of
from sorvolo.detection.light import rgb_from_picture
from sorvolo.detection.models import find_model
from sorvolo.detection.session import Session
from sorvolo.store.exports.plain import plain_json
from train_default_model import reader

RESULTS = Path(__file__).parent / "results" / "pyramid_thermal.json"
SIZES = (0.75, 1.0, 1.5, 2.0, 3.0)
PYRAMIDS = ((1.0, 1.5), (1.5, 2.0), (1.0, 1.5, 2.0), (0.75, 1.0, 1.5, 2.0), SIZES)
KNOWN_PX, OCTAVES = (24, 32, 44), (1.0, 2.0)
CLASSES = {"person": PERSON, "car": CAR}


def main() -> None:
    """Search, put together, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path, help="the folder of the labelled sets")
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    session, read = Session(find_model("thermal"), "cpu", 1), reader()
    frames: list[Searched] = []
    for each in hituav(wishes.data)["val"].pictures:
        frame = rgb_from_picture(read(each.path))
        frames.append(
            Searched("hituav", each, {size: session.see(frame, size) for size in SIZES}, {})
        )
        print(len(frames), flush=True)
    alone = {
        str(size): {
            name: accuracy(frames, [only(each.seen[size], label) for each in frames], label)
            for name, label in CLASSES.items()
        }
        for size in SIZES
    }
    pyramids = [
        {"sizes": sizes, "known_px": known_px, "octaves": octaves}
        | {
            name: accuracy(
                frames,
                [pyramid_of(sizes, each.seen, label, known_px, octaves) for each in frames],
                label,
            )
            for name, label in CLASSES.items()
        }
        for sizes in PYRAMIDS
        for known_px in KNOWN_PX
        for octaves in OCTAVES
    ]
    wishes.results.write_text(
        json.dumps(
            plain_json(
                {
                    "benchmark": "pyramid_thermal",
                    "machine": machine(),
                    "commit": commit(),
                    "date": time.strftime("%Y-%m-%d"),
                    "version": session.info.version,
                    "frames": len(frames),
                    "alone": alone,
                    "pyramids": pyramids,
                }
            ),
            indent=1,
        )
        + "\n"
    )


if __name__ == "__main__":
    main()
