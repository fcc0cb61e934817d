"""Cars on sharp photos, into the packaged models: python benchmarks/pack_softened.py JUDGE [--compared DATA]

JUDGE is the folder that train_judge.py wrote. Into default.onnx and default-int8.onnx go, and nothing else changes
(decision 0086): the softening of the picture that the aerial network sees (`training/daylight.py`, `Softened`), the
judge of cars that does not go by sharpness, its calibration, a threshold, and from how many pixels on cars are found
well. A model that was packed anew by pack_daylight_model.py has all of this but the last two. With --compared nothing
changes but the card of default-int8: how it does beside default, as pack_int8_model.py measures it.
"""

import argparse
import hashlib
import json
import tempfile
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

from pack_default_model import HOME
from pack_int8_model import compared, not_learnt
from pack_second_look import with_fields
from provenance import note_scoring
from sorvolo.training.daylight import Softened

VERSION = "12"
MODELS = ("default", "default-int8")
SCALED, STEM = "/aerial/backbone/Div_output_0", "/aerial/backbone/_conv_stem/Conv"
CAR_PX = (40, 110)  # length of a car that is found well; of 30 px fewer are, shown larger more (site_objects.py)
CAR_THRESHOLD = 0.76  # train_judge.py's 0.72 would report twice as many concrete parts on caliterra as version 11 did
TRAINING = (
    "; from version 12 on the aerial network sees a softened picture, and the judge learnt from tiles in several "
    "sharpnesses (decision 0086)"
)


def main() -> None:
    """Change both files and their cards."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("judge", type=Path, nargs="?")
    parser.add_argument("--compared", type=Path, metavar="DATA")
    parser.add_argument("--home", type=Path, default=HOME)
    wishes = parser.parse_args()
    if wishes.compared is not None:
        compare(wishes.compared, wishes.home)
        return
    learnt = json.loads((wishes.judge / "daylight.json").read_text())
    judge = torch.load(wishes.judge / "judge.pt", weights_only=True)
    before = json.loads((wishes.home / "default.json").read_text())["calibration"]["car"]
    cards: dict[str, dict[str, Any]] = {}
    for name in MODELS:
        path = wishes.home / f"{name}.onnx"
        card = json.loads(path.with_suffix(".json").read_text())
        if int(str(card.get("version") or card["of"].split()[-1])) >= int(VERSION):
            raise SystemExit(f"{path} is version {VERSION} already")
        model = onnx.load(path)
        soften(model.graph)
        judge_anew(model.graph, judge, before, learnt["car"])
        onnx.checker.check_model(model)
        fields: dict[str, Any] = {
            "version": VERSION, "created": f"{datetime.now(UTC):%Y-%m-%d}",
            "thresholds": card["thresholds"] | {"car": CAR_THRESHOLD},
        }
        stated = json.loads(next(each.value for each in model.metadata_props if each.key == "sorvolo"))
        fields["best_px"] = stated["best_px"] | {"car": list(CAR_PX)}
        path.write_bytes(with_fields(model.SerializeToString(), fields))
        card |= fields | {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "bytes": path.stat().st_size}
        if "of" in card:
            card["of"] = f"default, version {VERSION}"
        cards[name] = card
    cards["default"]["training"] += TRAINING
    known = cards["default"]["calibration"]
    known |= {"car": learnt["car"], "looks": learnt["looks"], "bare_looks": learnt["bare_looks"]}
    known["reliability"] |= {"car": learnt["reliability"]["car"]}
    for name, card in cards.items():
        (wishes.home / f"{name}.json").write_text(json.dumps(card, indent=1) + "\n")


def compare(data: Path, home: Path) -> None:
    """Into the card of default-int8: AP of both models on pictures that neither learnt from."""
    card = json.loads((home / "default-int8.json").read_text())
    with tempfile.TemporaryDirectory() as folder:
        for labelled in not_learnt(data, Path(folder)):
            rows = compared(labelled, home / "default.onnx", home / "default-int8.onnx")
            card["against_float32"][labelled.name] = rows
            print(labelled.name, rows, flush=True)
    lost = max(
        row["float32_AP"] - row["int8_AP"] for rows in card["against_float32"].values() for row in rows.values()
    )
    card |= note_scoring("pack_int8_model, pictures not learnt from")
    card["remark"] = f"for CPUs with eight-bit instructions; loses {100 * lost:.1f} points of AP at most"
    (home / "default-int8.json").write_text(json.dumps(card, indent=1) + "\n")


def soften(graph: onnx.GraphProto) -> None:
    """Have the aerial network see the picture softened; what is scaled before or after is the same."""
    softened = Softened()
    reach = softened.reach
    graph.initializer.append(numpy_helper.from_array(softened.get_buffer("bell").numpy(), "softened.bell"))
    pads = np.array([0, 0, reach, reach, 0, 0, reach, reach], np.int64)
    graph.initializer.append(numpy_helper.from_array(pads, "softened.pads"))
    place = next(k for k, each in enumerate(graph.node) if SCALED in each.output)
    for each in graph.node:
        if SCALED in each.input:
            each.input[list(each.input).index(SCALED)] = "/softened"
    pad = helper.make_node("Pad", [SCALED, "softened.pads"], ["/softened/padded"], "/softened/Pad", mode="edge")
    side = 2 * reach + 1
    conv = helper.make_node(
        "Conv", ["/softened/padded", "softened.bell"], ["/softened"], "/softened/Conv", group=3,
        kernel_shape=[side, side],
    )
    graph.node.insert(place + 1, pad)
    graph.node.insert(place + 2, conv)


def judge_anew(
    graph: onnx.GraphProto, judge: dict[str, torch.Tensor], before: dict[str, float], car: dict[str, float]
) -> None:
    """Other weights for the judge, and how its opinions of cars become scores."""
    for each in graph.initializer:
        if each.name.startswith("judge."):
            values = judge[each.name.removeprefix("judge.")].numpy()
            if tuple(each.dims) != values.shape:
                raise SystemExit(f"{each.name} has the shape {tuple(each.dims)}, the judge has {values.shape}")
            each.CopyFrom(numpy_helper.from_array(values, each.name))
    for key in ("slope", "shift"):
        found = [
            part for each in graph.node if each.op_type == "Constant" for part in each.attribute
            if part.name == "value" and list(part.t.dims) == []
            and float(numpy_helper.to_array(part.t)) == float(np.float32(before[key]))
        ]
        if len(found) != 1:
            raise SystemExit(f"{len(found)} constants are the cars' {key} {before[key]}, one was expected")
        found[0].t.CopyFrom(numpy_helper.from_array(np.array(car[key], np.float32), found[0].t.name))


if __name__ == "__main__":
    main()
