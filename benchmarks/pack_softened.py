"""Cars on sharp photos, into the packaged model: python benchmarks/pack_softened.py JUDGE

JUDGE is the folder that train_judge.py wrote. Into default.onnx of version 11 go, and nothing else changes (decision
0086): the softening of the picture that the aerial network sees (`training/daylight.py`, `Softened`), the judge of cars
that does not go by sharpness, its calibration, a threshold, and from how many pixels on cars are found well. A model
that pack_daylight_model.py packs anew is softened already, and refused. pack_int8_model.py makes default-int8 of it.
"""

import argparse
import hashlib
import json
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np
import onnx
import torch
from onnx import helper, numpy_helper

from pack_default_model import HOME
from pack_second_look import with_fields
from sorvolo.lab.training.daylight import DaylightSettings, Softened

VERSION = "12"
SCALED = "/aerial/backbone/Div_output_0"
CAR_PX = (
    40,
    110,
)  # length of a car that is found well; of 30 px fewer are, shown larger more (site_objects.py)
CAR_THRESHOLD = 0.76  # train_judge.py's 0.72 would report twice as many concrete parts on caliterra as version 11 did
TRAINING = (
    "; from version 12 on the aerial network sees a softened picture, and the judge learnt from tiles in several "
    "sharpnesses (decision 0086)"
)


def main() -> None:
    """Change the file and its card."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("judge", type=Path)
    parser.add_argument("--home", type=Path, default=HOME)
    wishes = parser.parse_args()
    learnt = json.loads((wishes.judge / "daylight.json").read_text())
    judge = torch.load(wishes.judge / "judge.pt", weights_only=True)
    path = wishes.home / "default.onnx"
    card, model = json.loads(path.with_suffix(".json").read_text()), onnx.load(path)
    if any(each.name == "softened.bell" for each in model.graph.initializer):
        raise SystemExit(f"{path} has its picture softened already")
    known = card["calibration_of_networks"]
    soften(model.graph)
    judge_anew(model.graph, judge, known["car"], learnt["car"])
    onnx.checker.check_model(model)
    fields: dict[str, Any] = {
        "version": VERSION,
        "created": f"{datetime.now(UTC):%Y-%m-%d}",
        "thresholds": card["thresholds"] | {"car": CAR_THRESHOLD},
        "best_px": card["best_px"] | {"car": list(CAR_PX)},
    }
    path.write_bytes(with_fields(model.SerializeToString(), fields))
    card |= fields | {
        "sha256": hashlib.sha256(path.read_bytes()).hexdigest(),
        "bytes": path.stat().st_size,
    }
    card["training"] += TRAINING
    known |= {"car": learnt["car"], "looks": learnt["looks"], "bare_looks": learnt["bare_looks"]}
    known["reliability"] |= {"car": learnt["reliability"]["car"]}
    path.with_suffix(".json").write_text(json.dumps(card, indent=1) + "\n")


def soften(graph: onnx.GraphProto) -> None:
    """Have the aerial network see the picture softened; what is scaled before or after is the same."""
    softened = Softened(DaylightSettings().softened_px)
    reach = softened.reach
    graph.initializer.append(
        numpy_helper.from_array(softened.get_buffer("bell").numpy(), "softened.bell")
    )
    pads = np.array([0, 0, reach, reach, 0, 0, reach, reach], np.int64)
    graph.initializer.append(numpy_helper.from_array(pads, "softened.pads"))
    place = next(k for k, each in enumerate(graph.node) if SCALED in each.output)
    for each in graph.node:
        if SCALED in each.input:
            each.input[list(each.input).index(SCALED)] = "/softened"
    pad = helper.make_node(
        "Pad", [SCALED, "softened.pads"], ["/softened/padded"], "/softened/Pad", mode="edge"
    )
    side = 2 * reach + 1
    conv = helper.make_node(
        "Conv",
        ["/softened/padded", "softened.bell"],
        ["/softened"],
        "/softened/Conv",
        group=3,
        kernel_shape=[side, side],
    )
    graph.node.insert(place + 1, pad)
    graph.node.insert(place + 2, conv)


def judge_anew(
    graph: onnx.GraphProto,
    judge: dict[str, torch.Tensor],
    before: dict[str, float],
    car: dict[str, float],
) -> None:
    """Other weights for the judge, and how its opinions of cars become scores."""
    for each in graph.initializer:
        if each.name.startswith("judge."):
            values = judge[each.name.removeprefix("judge.")].numpy()
            if tuple(each.dims) != values.shape:
                raise SystemExit(
                    f"{each.name} has the shape {tuple(each.dims)}, the judge has {values.shape}"
                )
            each.CopyFrom(numpy_helper.from_array(values, each.name))
    for key in ("slope", "shift"):
        found = [
            part
            for each in graph.node
            if each.op_type == "Constant"
            for part in each.attribute
            if part.name == "value"
            and list(part.t.dims) == []
            and float(numpy_helper.to_array(part.t)) == float(np.float32(before[key]))
        ]
        if len(found) != 1:
            raise SystemExit(
                f"{len(found)} constants are the cars' {key} {before[key]}, one was expected"
            )
        found[0].t.CopyFrom(
            numpy_helper.from_array(np.array(car[key], np.float32), found[0].t.name)
        )


if __name__ == "__main__":
    main()
