"""A judge of what is reported as people, and who draws their boxes anew (decisions 0075, 0082 and 0083).

python benchmarks/train_opinion.py DATA OUT --nanodet NANODET.json --lite0 LITE0 --scenes DIR

NANODET.json and LITE0 as in pack_opinion.py, DIR as in train_people.py. The packaged model searches pictures like those
that its head for people learnt from (other draws), without a second look; some of what it reports near people and some
of what else it reports is cut out. Both networks' features of a cut-out go into two small networks. One learns where
the person's box is. The other, on features pooled over the middle, learns what to add to the report's own log-odds;
right is a report whose new box is. NanoDet and EfficientNet-Lite0 stay as COCO and ImageNet taught them. The
flights `fixed_wing` and `brighton_beach`, aerial cars (people are in them, unlabelled) and all that detection_data.py
holds out stay out.

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

from fit_second_look import POSITIONS, balanced, bounded_odds
from pack_opinion import CELL_PX, LOOK_PX, PLACER, STRIDES, Looking, Placer, looking, pooled
from people_samples import Source, sources
from provenance import commit
from rendered_people import read_scenes
from sorvolo.detection.contract import POSITIONS as ALL_POSITIONS
from sorvolo.detection.detector import Detector
from sorvolo.detection.models import find_model
from sorvolo.detection.second_look import box_back, box_in_position, cut_out, in_position
from sorvolo.detection.session import Session
from sorvolo.geometry.box_overlap import cover_matrix, iou_matrix
from sorvolo.training.onnx_export import OPSET
from train_judge import RIGHT_IOU, UNSURE_IOU
from train_people import Samples, simulated

SAMPLES = (*range(10000, 14000), *range(20000, 24000))  # numbers of the draws, by choice
LEAST, SIDE_PX, SEED = 0.15, 512, 7177
NEAR, WORST, OTHERS = 5, 3, 2  # reports kept of a picture: near people; of others the surest, and some by chance
NEAR_IOU = 0.15  # a report that overlaps a person so much is near; a box is learnt from it
MOVED, GROWN, STRETCHED = 0.12, 0.15, 0.1  # spreads by which a box near a person is moved for one cut-out more
LEFT_OUT, BARE = "aerial_cars", ("caliterra", "painted")  # not used; used without rendered people, too
PART = 1000  # samples in a file
ROWS, COLUMNS = 4, 8  # cells of a sheet
HIDDEN, NETWORKS, ROUNDS, BATCH, RATE, DECAY = 48, 3, 20, 128, 2e-3, 0.03
DROPPED = 0.2, 0.3  # of the features, and of the hidden values
PLACER_ROUNDS, PLACER_BATCH, PLACER_RATE, EDGES = 12, 64, 1.5e-3, 2.0  # EDGES: how much more they count than overlap
MOST_PLACED, MOST_TAKEN = 4000, 1500  # cut-outs of a source near people, and away from them, that are learnt from
MOST_OF_A_SET = 600  # right reports, and false ones, of a source count as so many at most


@dataclass(frozen=True, eq=False)
class Cutouts:
    """Reports cut out, (N, cell, cell, 3), with their scores, their sources, and the nearest person's box (N, 4) px.

    Boxes lie in the cut-outs; NaN where nobody is near.
    """

    pictures: np.ndarray
    scores: np.ndarray
    people: np.ndarray
    places: np.ndarray


def main() -> None:
    """Cut out what is missing, learn, write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--nanodet", type=Path, required=True)
    parser.add_argument("--lite0", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    wishes.out.mkdir(parents=True, exist_ok=True)
    cutouts = together(list(parts(wishes)))
    looks = Looks(looking(wishes.nanodet, wishes.lite0))
    draws = placed(looks, some(cutouts, (True,), MOST_PLACED))
    chosen = some(cutouts, (True, False), MOST_TAKEN)
    features, boxes = zip(*(looked(looks, draws, chosen, number) for number in range(POSITIONS)))
    overlaps = ious(np.mean(boxes, axis=0), chosen.people)
    known = ~((overlaps > UNSURE_IOU) & (overlaps < RIGHT_IOU))
    right, places, scores = overlaps[known] >= RIGHT_IOU, chosen.places[known], chosen.scores[known]
    counts = {
        place: [int(np.count_nonzero((places == place) & (right == kind))) for kind in (True, False)]
        for place in sorted(set(places.tolist()))
    }
    print("right and false:", counts, flush=True)
    shown = np.stack(features, 1)[known]
    networks = [learnt(shown, scores, right, places, seed) for seed in range(NETWORKS)]
    about = {"commit": commit(), "samples": len(SAMPLES), "right_and_false": counts, "networks": NETWORKS}
    drawn = {
        PLACER + name: each.numpy() if name.startswith("scale") else each.half().float().numpy()
        for name, each in draws.state_dict().items()
    }
    np.savez(wishes.out / "judge.npz", **folded(networks, shown), **drawn, about=json.dumps(about))


def parts(wishes: argparse.Namespace) -> Iterator[Cutouts]:
    """The cut-outs of PART samples at a time."""
    cutter: Cutter | None = None
    for first in range(0, len(SAMPLES), PART):
        path = wishes.out / f"cutouts-{first}.npz"
        if not path.is_file():
            cutter = cutter or Cutter(wishes)
            cut = together([cutter.cut(number) for number in SAMPLES[first : first + PART]])
            np.savez(path, pictures=cut.pictures, scores=cut.scores, people=cut.people, places=cut.places)
            print(path.name, len(cut.scores), flush=True)
        with np.load(path) as file:
            yield Cutouts(file["pictures"], file["scores"], file["people"], file["places"])


class Cutter:
    """Draws pictures, searches them, and cuts out what is reported."""

    def __init__(self, wishes: argparse.Namespace) -> None:
        made = simulated(wishes.out / "simulated")
        plan = [each for each in sources(wishes.data, made, lambda labelled: labelled) if _name(each) != LEFT_OUT]
        self._plan = plan + [replace(each, pasted=0.0) for each in plan if _name(each) in BARE]
        self._samples = Samples(self._plan, read_scenes(wishes.scenes), SIDE_PX, SEED)
        session = Session(find_model("default"), "cpu", 1)
        session.info = replace(session.info, second_look={})
        self._detector = Detector(session)

    def cut(self, number: int) -> Cutouts:
        """Some of what is reported of one picture."""
        shown, source = self._samples.made(number), self._samples.source(number)
        image = np.ascontiguousarray(shown.image)
        found = self._detector.detect(image, tiles="auto", classes=("person",), least_score=LEAST)
        boxes = found.boxes_px.astype(float)
        shows = cover_matrix(boxes, shown.ignored).max(1, initial=0) <= 0.5
        overlaps = iou_matrix(boxes, shown.boxes)
        is_near = overlaps.max(1, initial=0) > NEAR_IOU
        rng = np.random.default_rng((5, number % 10000))
        false = np.flatnonzero(shows & ~is_near)
        cuts: list[tuple[int, np.ndarray, np.ndarray]] = []
        for row in rng.permutation(np.flatnonzero(shows & is_near))[:NEAR]:
            person = shown.boxes[overlaps[row].argmax()]
            cuts += [(row, boxes[row], person), (row, _moved(boxes[row], rng), person)]
        for row in (*false[:WORST], *rng.permutation(false[WORST:])[:OTHERS]):
            cuts.append((row, boxes[row], np.full(4, np.nan)))
        pictures, people = [], []
        for _, box_px, person in cuts:
            picture, edges_px = cut_out(image, box_px, LOOK_PX)
            scale = (edges_px[2:] - edges_px[:2]) / (box_px[2:] - box_px[:2])
            pictures.append(picture)
            people.append(edges_px + (person - box_px) * np.tile(scale, 2))
        return Cutouts(
            np.array(pictures, np.uint8).reshape(-1, CELL_PX, CELL_PX, 3), found.scores[[row for row, _, _ in cuts]],
            np.array(people).reshape(-1, 4), np.full(len(cuts), _name(self._plan[source])),
        )


def _moved(box_px: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The box of another look at the same, less well placed."""
    size = box_px[2:] - box_px[:2]
    middle = (box_px[:2] + box_px[2:]) / 2 + rng.normal(0, MOVED, 2) * size
    half = size / 2 * np.exp(rng.normal(0, GROWN) + rng.normal(0, STRETCHED, 2))
    return np.concatenate([middle - half, middle + half])


def _name(source: Source) -> str:
    return source.share.labelled.name


def together(cuts: Sequence[Cutouts]) -> Cutouts:
    """All of them."""
    return Cutouts(
        np.concatenate([each.pictures for each in cuts]), np.concatenate([each.scores for each in cuts]),
        np.concatenate([each.people for each in cuts]), np.concatenate([each.places for each in cuts]),
    )


def some(cutouts: Cutouts, kinds: Sequence[bool], most: int) -> Cutouts:
    """At most so many of each source, drawn by chance: of those near people (True), of the others (False)."""
    rng, taken, is_near = np.random.default_rng(SEED), [], np.isfinite(cutouts.people[:, 0])
    for place in sorted(set(cutouts.places.tolist())):
        for kind in kinds:
            own = np.flatnonzero((cutouts.places == place) & (is_near == kind))
            taken += rng.permutation(own)[:most].tolist()
    rows = np.sort(taken)
    return Cutouts(cutouts.pictures[rows], cutouts.scores[rows], cutouts.people[rows], cutouts.places[rows])


class Looks:
    """The features of cut-outs, as the packed model sees them: side by side on sheets."""

    def __init__(self, network: Looking) -> None:
        options, buffer = onnxruntime.SessionOptions(), io.BytesIO()
        options.intra_op_num_threads = 1
        sheet = torch.zeros(1, 3, ROWS * CELL_PX, COLUMNS * CELL_PX, dtype=torch.uint8)
        torch.onnx.export(
            network, (sheet,), buffer, input_names=["image"], output_names=[f"stride_{each}" for each in STRIDES],
            opset_version=OPSET, dynamo=False,
        )
        self._session = onnxruntime.InferenceSession(buffer.getvalue(), options, providers=["CPUExecutionProvider"])

    def levels(self, pictures: np.ndarray) -> Iterator[tuple[np.ndarray, list[torch.Tensor]]]:
        """Rows of the cut-outs, and their features (rows, D, side, side) of each stride, a sheet at a time.

        Neighbours on a sheet are drawn by chance: a network sees beyond a cell's edge.
        """
        order = np.random.default_rng(1).permutation(len(pictures))
        for start in range(0, len(order), ROWS * COLUMNS):
            rows = order[start : start + ROWS * COLUMNS]
            cells = np.full((ROWS * COLUMNS, CELL_PX, CELL_PX, 3), 114, np.uint8)
            cells[: len(rows)] = pictures[rows]
            grid = cells.reshape(ROWS, COLUMNS, CELL_PX, CELL_PX, 3).transpose(4, 0, 2, 1, 3)
            found = self._session.run(None, {"image": grid.reshape(1, 3, ROWS * CELL_PX, COLUMNS * CELL_PX)})
            yield rows, [torch.from_numpy(_cells(each)[: len(rows)]) for each in found]


def _cells(level: np.ndarray) -> np.ndarray:
    """A sheet's features (1, D, H, W) cell by cell, (cells, D, side, side)."""
    side = level.shape[2] // ROWS
    apart = level[0].reshape(level.shape[1], ROWS, side, COLUMNS, side).transpose(1, 3, 0, 2, 4)
    return np.ascontiguousarray(apart.reshape(-1, level.shape[1], side, side))


def placed(looks: Looks, cutouts: Cutouts) -> Placer:
    """Who draws the boxes of those near people, learnt from each cut-out in one position drawn by chance."""
    torch.manual_seed(SEED)
    drawn = np.random.default_rng(SEED).integers(0, len(ALL_POSITIONS), len(cutouts.scores))
    pictures = np.stack([in_position(each, number) for each, number in zip(cutouts.pictures, drawn)])
    boxes_px = np.stack([box_in_position(each, number, CELL_PX) for each, number in zip(cutouts.people, drawn)])
    people = torch.tensor(boxes_px, dtype=torch.float32)
    features: list[torch.Tensor] = []
    for rows, levels in looks.levels(pictures):
        features = features or [torch.empty((len(pictures), *each.shape[1:]), dtype=torch.float16) for each in levels]
        for whole, part in zip(features, levels):
            whole[rows] = part.half()
    scales = [_scale(each) for each in features]
    network = Placer(scales).train()
    counts = torch.tensor(balanced(cutouts.places, np.ones(len(people), bool), MOST_OF_A_SET), dtype=torch.float32)
    steps = PLACER_ROUNDS * -(-len(people) // PLACER_BATCH)
    optimiser = torch.optim.AdamW(network.parameters(), PLACER_RATE, weight_decay=DECAY)
    rates = torch.optim.lr_scheduler.OneCycleLR(optimiser, PLACER_RATE, total_steps=steps)
    for turn in range(PLACER_ROUNDS):
        met = []
        for rows in torch.randperm(len(people)).split(PLACER_BATCH):
            boxes = network([each[rows].float() for each in features])[:, :, 0, 0]
            overlaps, losses = place_loss(boxes, people[rows])
            optimiser.zero_grad()
            (losses * counts[rows]).mean().backward()
            optimiser.step()
            rates.step()
            met.append(float(overlaps.detach().mean()))
        print(f"boxes, round {turn}: overlap {np.mean(met):.3f}", flush=True)
    return network.eval()


def _scale(features: torch.Tensor) -> np.ndarray:
    """(2, D) means and spreads of a level's features (N, D, side, side), of a tenth of them."""
    some_of = features[::10].float()
    return torch.stack([some_of.mean((0, 2, 3)), some_of.std((0, 2, 3)) + 1e-2]).numpy()


def place_loss(boxes: torch.Tensor, people: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    """(N,) overlaps of boxes (N, 4) px with people's, and losses: generalised IoU (Rezatofighi 2019) and edges."""
    near, far = torch.maximum(boxes[:, :2], people[:, :2]), torch.minimum(boxes[:, 2:], people[:, 2:])
    shared = (far - near).clamp(min=0).prod(1)
    union = (boxes[:, 2:] - boxes[:, :2]).clamp(min=1e-3).prod(1) + (people[:, 2:] - people[:, :2]).prod(1) - shared
    around = torch.maximum(boxes[:, 2:], people[:, 2:]) - torch.minimum(boxes[:, :2], people[:, :2])
    hull = around.prod(1)
    edges = nn.functional.smooth_l1_loss(boxes / LOOK_PX, people / LOOK_PX, beta=0.1, reduction="none").mean(1)
    return shared / union, 1 - shared / union + (hull - union) / hull + EDGES * edges


def ious(boxes: np.ndarray, people: np.ndarray) -> np.ndarray:
    """(N,) overlap of each box (N, 4) with its person's (N, 4); 0 where that is NaN."""
    near, far = np.maximum(boxes[:, :2], people[:, :2]), np.minimum(boxes[:, 2:], people[:, 2:])
    shared = np.clip(far - near, 0, None).prod(1)
    union = (boxes[:, 2:] - boxes[:, :2]).prod(1) + (people[:, 2:] - people[:, :2]).prod(1) - shared
    return np.nan_to_num(shared / union)


@torch.inference_mode()
def looked(looks: Looks, draws: Placer, cutouts: Cutouts, number: int) -> tuple[np.ndarray, np.ndarray]:
    """Cut-outs in one position: features (N, D) float16, and boxes (N, 4) px in the cut-outs as they were."""
    pictures = np.stack([in_position(each, number) for each in cutouts.pictures])
    features, boxes = None, np.zeros((len(pictures), 4))
    for rows, levels in looks.levels(pictures):
        own = pooled(levels)[:, :, 0, 0].numpy().astype(np.float16)
        features = np.zeros((len(pictures), own.shape[1]), np.float16) if features is None else features
        features[rows] = own
        boxes[rows] = draws(levels)[:, :, 0, 0].numpy()
    return features, np.stack([box_back(each, number, CELL_PX) for each in boxes])


def learnt(
    features: np.ndarray, scores: np.ndarray, right: np.ndarray, places: np.ndarray, seed: int
) -> nn.Sequential:
    """A network for features (N, turns, D): what it adds to a report's own log-odds, times a number that it learns."""
    torch.manual_seed(seed)
    mean, spread = scaled(features)
    inputs, is_right = torch.tensor((features - mean) / spread), torch.tensor(right, dtype=torch.float32)
    own = torch.tensor(bounded_odds(scores), dtype=torch.float32)
    counts = torch.tensor(balanced(places, right, MOST_OF_A_SET), dtype=torch.float32)
    network = nn.Sequential(
        nn.Dropout(DROPPED[0]), nn.Linear(inputs.shape[2], HIDDEN), nn.ReLU(), nn.Dropout(DROPPED[1]),
        nn.Linear(HIDDEN, 1),
    )
    share = nn.Parameter(torch.tensor(0.5))
    optimiser = torch.optim.AdamW([*network.parameters(), share], RATE, weight_decay=DECAY)
    steps = ROUNDS * -(-len(is_right) // BATCH)
    rates = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps)
    for _ in range(ROUNDS):
        for rows in torch.randperm(len(is_right)).split(BATCH):
            turn = int(torch.randint(inputs.shape[1], ()))
            odds = network(inputs[rows, turn])[:, 0] + share * own[rows]
            losses = nn.functional.binary_cross_entropy_with_logits(odds, is_right[rows], reduction="none")
            optimiser.zero_grad()
            (losses * counts[rows]).mean().backward()
            optimiser.step()
            rates.step()
    print(f"network {seed}: {float(share.detach()):.2f} of a report's own log-odds", flush=True)
    return network.eval()


def scaled(features: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """(D,) the features' means and spreads, float32."""
    rows = features.reshape(-1, features.shape[-1])
    return rows.mean(0, dtype=np.float32), rows.astype(np.float32).std(0) + np.float32(1e-3)


def folded(networks: Sequence[nn.Sequential], features: np.ndarray) -> dict[str, np.ndarray]:
    """The mean of the networks as one, for features as they are: its two layers, float32."""
    mean, spread = scaled(features)
    firsts = [each[1].weight.detach().numpy() / spread for each in networks]
    biases = [each[1].bias.detach().numpy() - first @ mean for each, first in zip(networks, firsts)]
    lasts = [each[4].weight.detach().numpy()[0] / len(networks) for each in networks]
    return {
        "first": np.concatenate(firsts), "first_bias": np.concatenate(biases), "last": np.concatenate(lasts),
        "last_bias": np.float32([np.mean([each[4].bias.item() for each in networks])]),
    }


if __name__ == "__main__":
    main()
