"""A judge of what is reported as people, on NanoDet's and EfficientNet-Lite0's features (decisions 0075 and 0082).

python benchmarks/train_opinion.py DATA OUT --nanodet NANODET.json --lite0 LITE0 --scenes DIR

NANODET.json and LITE0 as in pack_opinion.py, DIR as in train_people.py. The packaged model searches pictures like those
that its head for people learnt from (other draws), without a second look; some right and some false reports of each are
cut out. Both networks' features of a cut-out, pooled over its middle, go into a small network, which learns what to add
to the report's own log-odds. The networks themselves stay as COCO and ImageNet taught them. The flights `fixed_wing`
and `brighton_beach`, aerial cars (people are in them, unlabelled) and all that detection_data.py holds out stay out.

Writes OUT/cutouts-N.npz, read again where they are there, and OUT/judge.npz, which pack_opinion.py takes.
"""

import argparse
import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import onnxruntime
import torch
from torch import nn

from fit_second_look import POSITIONS, balanced, bounded_odds, judged_reports
from own_scale import own_scale
from pack_opinion import CELL_PX, LOOK_PX, Looking, looking
from people_samples import Source, sources
from provenance import commit
from rendered_people import read_scenes
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import cut_out, in_position
from sorvolo.detection.session import Session
from sorvolo.lab.training.onnx_export import OPSET
from train_people import Samples, simulated

SAMPLES = (*range(10000, 14000), *range(20000, 24000))  # numbers of the draws, by choice
LEAST, SIDE_PX, SEED = 0.15, 512, 7177
RIGHT, WORST, OTHERS = (
    4,
    3,
    2,
)  # reports kept of a picture: right ones; false ones, the surest, and by chance
LEFT_OUT, BARE = (
    "aerial_cars",
    ("caliterra", "painted"),
)  # not used; used without rendered people, too
PART = 1000  # samples in a file
ROWS, COLUMNS = 4, 8  # cells of a sheet
HIDDEN, NETWORKS, ROUNDS, BATCH, RATE, DECAY = 48, 3, 20, 128, 2e-3, 0.03
DROPPED = 0.2, 0.3  # of the features, and of the hidden values
MOST_TAKEN = 1500  # right reports, and false ones, of a source that are learnt from
MOST_OF_A_SET = 600  # right reports, and false ones, of a source count as so many at most


@dataclass(frozen=True, eq=False)
class Cutouts:
    """Reports cut out, (N, cell, cell, 3), with their scores, whether they are right, and from which source."""

    pictures: np.ndarray
    scores: np.ndarray
    right: np.ndarray
    places: np.ndarray


def main() -> None:
    """Cut out what is missing, learn, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--nanodet", type=Path, required=True)
    parser.add_argument("--lite0", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    wishes.out.mkdir(parents=True, exist_ok=True)
    cutouts = some(together(list(parts(wishes))))
    counts = {
        place: [
            int(np.count_nonzero((cutouts.places == place) & (cutouts.right == kind)))
            for kind in (True, False)
        ]
        for place in sorted(set(cutouts.places.tolist()))
    }
    print("right and false:", counts, flush=True)
    looks = Looks(looking(wishes.nanodet, wishes.lite0))
    shown = (
        np.stack([in_position(each, number) for each in cutouts.pictures])
        for number in range(POSITIONS)
    )
    pooled = np.stack([looks.pooled(each) for each in shown], 1)
    networks = [learnt(pooled, cutouts, seed) for seed in range(NETWORKS)]
    about = {
        "commit": commit(),
        "samples": len(SAMPLES),
        "right_and_false": counts,
        "networks": NETWORKS,
    }
    np.savez(wishes.out / "judge.npz", **folded(networks, pooled), about=json.dumps(about))


def parts(wishes: argparse.Namespace) -> Iterator[Cutouts]:
    """The cut-outs of PART samples at a time."""
    cutter: Cutter | None = None
    for first in range(0, len(SAMPLES), PART):
        path = wishes.out / f"cutouts-{first}.npz"
        if not path.is_file():
            cutter = cutter or Cutter(wishes)
            cut = together([cutter.cut(number) for number in SAMPLES[first : first + PART]])
            np.savez(
                path, pictures=cut.pictures, scores=cut.scores, right=cut.right, places=cut.places
            )
            print(path.name, len(cut.scores), flush=True)
        with np.load(path) as file:
            yield Cutouts(file["pictures"], file["scores"], file["right"], file["places"])


class Cutter:
    """Draws pictures, searches them, and cuts out what is reported."""

    def __init__(self, wishes: argparse.Namespace) -> None:
        made = simulated(wishes.out / "simulated")
        plan = [
            each
            for each in sources(wishes.data, made, lambda labelled: labelled)
            if _name(each) != LEFT_OUT
        ]
        self._plan = plan + [replace(each, pasted=0.0) for each in plan if _name(each) in BARE]
        self._samples = Samples(self._plan, read_scenes(wishes.scenes), SIDE_PX, SEED)
        session = Session(find_model("default"), "cpu", 1)
        session.info = own_scale(session.info, second_look={}, pyramid={})
        self._detector = Detector(session)

    def cut(self, number: int) -> Cutouts:
        """Some of what is reported of one picture."""
        shown, source = self._samples.made(number), self._samples.source(number)
        image = np.ascontiguousarray(shown.image)
        found = self._detector.detect(image, tiles="auto", classes=("person",), least_score=LEAST)
        rows, right = judged_reports(found.boxes_px, shown.boxes, shown.ignored)
        rng = np.random.default_rng((5, number % 10000))
        false = rows[~right[rows]]
        chosen = [
            *rng.permutation(rows[right[rows]])[:RIGHT],
            *false[:WORST],
            *rng.permutation(false[WORST:])[:OTHERS],
        ]
        pictures = [cut_out(image, found.boxes_px[row].astype(float), LOOK_PX)[0] for row in chosen]
        return Cutouts(
            np.array(pictures, np.uint8).reshape(-1, CELL_PX, CELL_PX, 3),
            found.scores[chosen],
            right[np.array(chosen, int)],
            np.full(len(chosen), _name(self._plan[source])),
        )


def _name(source: Source) -> str:
    return source.share.labelled.name


def together(cuts: Sequence[Cutouts]) -> Cutouts:
    """All of them."""
    return Cutouts(
        np.concatenate([each.pictures for each in cuts]),
        np.concatenate([each.scores for each in cuts]),
        np.concatenate([each.right for each in cuts]),
        np.concatenate([each.places for each in cuts]),
    )


def some(cutouts: Cutouts) -> Cutouts:
    """At most MOST_TAKEN right ones and false ones of each source, drawn by chance."""
    rng, taken = np.random.default_rng(SEED), []
    for place in sorted(set(cutouts.places.tolist())):
        for kind in (True, False):
            own = np.flatnonzero((cutouts.places == place) & (cutouts.right == kind))
            taken += rng.permutation(own)[:MOST_TAKEN].tolist()
    rows = np.sort(taken)
    return Cutouts(
        cutouts.pictures[rows], cutouts.scores[rows], cutouts.right[rows], cutouts.places[rows]
    )


class Looks:
    """The features of cut-outs, as the packed model sees them: side by side on sheets."""

    def __init__(self, network: Looking) -> None:
        options, buffer = onnxruntime.SessionOptions(), io.BytesIO()
        options.intra_op_num_threads = 1
        sheet = torch.zeros(1, 3, ROWS * CELL_PX, COLUMNS * CELL_PX, dtype=torch.uint8)
        torch.onnx.export(
            network,
            (sheet,),
            buffer,
            input_names=["image"],
            output_names=["pooled"],
            opset_version=OPSET,
            dynamo=False,
        )
        self._session = onnxruntime.InferenceSession(
            buffer.getvalue(), options, providers=["CPUExecutionProvider"]
        )

    def pooled(self, pictures: np.ndarray) -> np.ndarray:
        """(N, D) float16. Neighbours on a sheet are drawn by chance: a network sees beyond a cell's edge."""
        order = np.random.default_rng(1).permutation(len(pictures))
        rows = []
        for start in range(0, len(order), ROWS * COLUMNS):
            own = pictures[order[start : start + ROWS * COLUMNS]]
            cells = np.full((ROWS * COLUMNS, CELL_PX, CELL_PX, 3), 114, np.uint8)
            cells[: len(own)] = own
            grid = cells.reshape(ROWS, COLUMNS, CELL_PX, CELL_PX, 3).transpose(4, 0, 2, 1, 3)
            (found,) = self._session.run(
                ["pooled"], {"image": grid.reshape(1, 3, ROWS * CELL_PX, COLUMNS * CELL_PX)}
            )
            rows.append(found[0].reshape(found.shape[1], -1).T[: len(own)].astype(np.float16))
        pooled = np.concatenate(rows)
        return pooled[np.argsort(order)]


def learnt(pooled: np.ndarray, cutouts: Cutouts, seed: int) -> nn.Sequential:
    """A network for features (N, turns, D): what it adds to a report's own log-odds, times a number that it learns."""
    torch.manual_seed(seed)
    mean, spread = scaled(pooled)
    inputs, right = (
        torch.tensor((pooled - mean) / spread),
        torch.tensor(cutouts.right, dtype=torch.float32),
    )
    own = torch.tensor(bounded_odds(cutouts.scores), dtype=torch.float32)
    counts = torch.tensor(
        balanced(cutouts.places, cutouts.right, MOST_OF_A_SET), dtype=torch.float32
    )
    network = nn.Sequential(
        nn.Dropout(DROPPED[0]),
        nn.Linear(inputs.shape[2], HIDDEN),
        nn.ReLU(),
        nn.Dropout(DROPPED[1]),
        nn.Linear(HIDDEN, 1),
    )
    share = nn.Parameter(torch.tensor(0.5))
    optimiser = torch.optim.AdamW([*network.parameters(), share], RATE, weight_decay=DECAY)
    steps = ROUNDS * -(-len(right) // BATCH)
    rates = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(ROUNDS):
        for rows in torch.randperm(len(right)).split(BATCH):
            turn = int(torch.randint(inputs.shape[1], ()))
            odds = network(inputs[rows, turn])[:, 0] + share * own[rows]
            losses = nn.functional.binary_cross_entropy_with_logits(
                odds, right[rows], reduction="none"
            )
            optimiser.zero_grad()
            (losses * counts[rows]).mean().backward()
            optimiser.step()
            rates.step()
    print(f"network {seed}: {float(share.detach()):.2f} of a report's own log-odds", flush=True)
    return network.eval()


def scaled(pooled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(D,) the features' means and spreads, float32."""
    rows = pooled.reshape(-1, pooled.shape[-1])
    return rows.mean(0, dtype=np.float32), rows.astype(np.float32).std(0) + np.float32(1e-3)


def folded(networks: Sequence[nn.Sequential], pooled: np.ndarray) -> dict[str, np.ndarray]:
    """The mean of the networks as one, for features as they are: its two layers, float32."""
    mean, spread = scaled(pooled)
    firsts = [each[1].weight.detach().numpy() / spread for each in networks]
    biases = [each[1].bias.detach().numpy() - first @ mean for each, first in zip(networks, firsts)]
    lasts = [each[4].weight.detach().numpy()[0] / len(networks) for each in networks]
    return {
        "first": np.concatenate(firsts),
        "first_bias": np.concatenate(biases),
        "last": np.concatenate(lasts),
        "last_bias": np.float32([np.mean([each[4].bias.item() for each in networks])]),
    }


if __name__ == "__main__":
    main()
