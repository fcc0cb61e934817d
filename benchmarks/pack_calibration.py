"""What the packaged models' scores mean, into their files: benchmarks/pack_calibration.py [--results FILE]

The last step of packing (decision 0091); no weight of the networks changes, only the metadata of default.onnx,
default-int8.onnx and thermal.onnx and their cards. Slopes and shifts are those that `score_calibration.py --fit` left
in its result file. Thresholds are scaled alike, so that the same is reported as before: the cards keep those of the
networks' own scale (`thresholds_own`; of a file without a calibration its thresholds are).
"""

import argparse
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pack_default_model import HOME
from pack_second_look import repack
from score_calibration import RESULTS
from sorvolo.detection.calibration import platt_scaled
from sorvolo.detection.contract import FORMAT, Calibration

MODELS = {
    "default": ("14", "default"),
    "default-int8": ("14", "default"),
    "thermal": ("5", "thermal"),
}


def main() -> None:
    """Rewrite the files and their cards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--home", type=Path, default=HOME)
    parser.add_argument("--results", type=Path, default=RESULTS)
    wishes = parser.parse_args()
    fits = json.loads(wishes.results.read_text())
    for name, (version, source) in MODELS.items():
        fit = fits[source]["classes"]
        path = wishes.home / f"{name}.onnx"
        card = json.loads(path.with_suffix(".json").read_text())
        own = card.get("thresholds_own", card["thresholds"])
        calibration = {
            label: {key: each[key] for key in ("slope", "shift")} for label, each in fit.items()
        }
        fields: dict[str, Any] = {
            "format": FORMAT,
            "version": version,
            "created": f"{datetime.now(UTC):%Y-%m-%d}",
            "calibration": calibration,
            "thresholds": own
            | {label: scaled(own[label], each) for label, each in calibration.items()},
        }
        repack(path, fields, {"thresholds_own": own})
        print(name, fields["thresholds"], calibration)


def scaled(own: float, how: dict[str, float]) -> float:
    """A threshold of the networks' own scale, in that of the calibrated scores, to two digits."""
    return round(float(platt_scaled(own, Calibration(**how))), 2)


if __name__ == "__main__":
    main()
