"""In which sizes pictures of unknown scale are searched, into the packaged models: benchmarks/pack_pyramid.py

The last step of packing (decision 0084); no weight of the networks changes, only the metadata of default.onnx,
default-int8.onnx and thermal.onnx and their cards. benchmarks/pyramid.py and benchmarks/pyramid_thermal.py give the
figures that SIZES were chosen by. A thermal frame is shown one and a half times as large as it is, and so at each of
its sizes.
"""

import argparse
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pack_default_model import HOME
from pack_second_look import repack

DAYLIGHT: dict[str, Any] = {
    "times": [0.5, 0.75, 1.5, 2.0, 3.0],
    "known_px": 32,
    "octaves": 1.0,
    "shift": 0.6,
}
CLOSER = {"person": {"closer": [4.0]}}  # decision 0089
THERMAL = {"times": [0.667, 1.333], "known_px": 44, "octaves": 1.0, "shift": 0.6}
MODELS = {
    "default": ("13", DAYLIGHT, CLOSER),
    "default-int8": ("13", DAYLIGHT, CLOSER),
    "thermal": ("4", THERMAL, {}),
}
CLASSES = ("person", "car")


def main() -> None:
    """Rewrite the files and their cards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--home", type=Path, default=HOME)
    wishes = parser.parse_args()
    for name, (version, sizes, more) in MODELS.items():
        fields: dict[str, Any] = {
            "version": version,
            "created": f"{datetime.now(UTC):%Y-%m-%d}",
            "pyramid": {each: sizes | more.get(each, {}) for each in CLASSES},
        }
        repack(wishes.home / f"{name}.onnx", fields)


if __name__ == "__main__":
    main()
