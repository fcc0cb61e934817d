"""How reports are looked at again, into the packaged models: benchmarks/pack_second_look.py WEIGHTS [--measured FILE]

WEIGHTS is what fit_second_look.py wrote; no weight of the networks changes, only the metadata of default.onnx and
default-int8.onnx and their cards. Its threshold is of the networks' own scale, in which the files then report: what
their scores mean is fitted and packed anew (pack_calibration.py). With --measured, results of second_look.py, made with
these very networks, go into the cards.
"""

import argparse
import hashlib
import json
from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from types import MappingProxyType
from typing import Any

import onnx

from pack_default_model import HOME
from sorvolo.detection.contract import METADATA_KEY

MODELS = ("default", "default-int8")
KEYS = ("looks_px", "positions", "own", "again", "shift", "least", "enlarged", "by")
FIGURES = "before and after the second look (benchmarks/second_look.py)"


def main() -> None:
    """Rewrite both files and their cards."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("weights", type=Path)
    parser.add_argument("--version", default="10")
    parser.add_argument("--measured", type=Path, help="results of second_look.py")
    parser.add_argument("--home", type=Path, default=HOME)
    wishes = parser.parse_args()
    fit = json.loads(wishes.weights.read_text())["person"]
    fields: dict[str, Any] = {
        "version": wishes.version,
        "created": f"{datetime.now(UTC):%Y-%m-%d}",
        "second_look": {"person": {key: fit[key] for key in KEYS}},
    }
    for name in MODELS:
        path = wishes.home / f"{name}.onnx"
        card = json.loads(path.with_suffix(".json").read_text())
        own = card.pop("thresholds_own", card["thresholds"])
        fields |= {"format": 1, "calibration": {}, "thresholds": own | {"person": fit["threshold"]}}
        path.write_bytes(with_fields(path.read_bytes(), fields))
        card |= fields
        if name != "default":
            card["of"] = f"default, version {wishes.version}"
        card |= {
            "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
            "bytes": path.stat().st_size,
        }
        card["second_look_fit"] = {"threshold_own": fit["threshold"]} | {
            key: fit[key] for key in ("reports", "photos", "right_and_false")
        }
        if wishes.measured is not None:
            sets = json.loads(wishes.measured.read_text())["sets"]
            card["second_look_measured"] = {"what": FIGURES} | {
                each: people_of(row) for each, row in sets.items() if "person" in row
            }
        path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")


def people_of(row: dict[str, Any]) -> dict[str, Any]:
    """A set's figures of people, without the course of their curve."""
    people = {
        key: {name: share for name, share in value.items() if name != "found_from_score_on"}
        if isinstance(value, dict)
        else value
        for key, value in row["person"].items()
    }
    return {key: row[key] for key in ("photos", "pictures", "times_scored") if key in row} | {
        "person": people
    }


def repack(
    path: Path, fields: dict[str, Any], of_card: Mapping[str, Any] = MappingProxyType({})
) -> None:
    """Set fields of a packed model, its `version` among them, in the file and its card, which has those of `of_card`
    besides."""
    path.write_bytes(with_fields(path.read_bytes(), fields))
    before, version = json.loads(path.with_suffix(".json").read_text()), fields["version"]
    card = before | fields | of_card
    if (
        "measured" in before and before["version"] != version
    ):  # figures stay those of the version that gave them
        card.setdefault("measured_by", f"version {before['version']}, whose networks are the same")
    if "of" in card:
        card["of"] = f"default, version {version}"
    card |= {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "bytes": path.stat().st_size}
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")


def with_fields(model: bytes, fields: dict[str, Any]) -> bytes:
    """The model with some of its metadata's fields set, all else the same."""
    file = onnx.load_model_from_string(model)
    metadata = {each.key: each.value for each in file.metadata_props}
    metadata[METADATA_KEY] = json.dumps(json.loads(metadata[METADATA_KEY]) | fields)
    onnx.helper.set_model_props(file, metadata)
    return file.SerializeToString()


if __name__ == "__main__":
    main()
