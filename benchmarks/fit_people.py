"""How a head of `train_people.py` becomes probabilities: benchmarks/fit_people.py DATA OUT --nanodet FILE --scenes DIR

OUT holds people.pt. Its opinions and NanoDet's support become scores by a logistic regression on pictures that it did
not learn from: TinyPerson's validation videos, and rendered people (DIR: scenes of another seed) on the ground of the
flight `fixed_wing`, bare and with rendered things on it. Writes OUT/people.json. What is reported is decided after the
second look (fit_second_look.py); FIRST_LOOK only sets beside which scores the aerial network's candidates stand.
"""

import argparse
import json
from collections.abc import Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
import torch

from detection_data import tinyperson
from people_samples import Source, ground, shown
from rendered_people import Scene, read_scenes
from sorvolo.lab.training.daylight import Calibration, Daylight
from sorvolo.lab.training.nanodet import NanoDetHead
from sorvolo.lab.training.samples import Share
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES
from train_default_model import reader
from train_judge import LEAST_SCORE, PERSON, Truth, fitted, odds, reliability, tiles, untrained

RENDERED, SIDE_PX, SEED = 60, 640, 5
FIRST_LOOK = 0.75
LOOKS = {"tinyperson": (1.5, 3.0), "fixed_wing": (0.7, 1.3)}


@dataclass(frozen=True, eq=False)
class Opinions:
    """A look's people: `rows` (N, 3) of opinion, support, whether it is one."""

    rows: np.ndarray


def main() -> None:
    """Look, fit, write."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("data", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--nanodet", type=Path, required=True)
    parser.add_argument("--scenes", type=Path, required=True)
    parser.add_argument("--aerial", default="default")
    wishes = parser.parse_args()
    torch.set_num_threads(1)
    model = untrained(wishes.nanodet, wishes.aerial)
    model.people = people_head(wishes.out / "people.pt")
    found = list(looks(wishes.data, model, read_scenes(wishes.scenes)))
    (wishes.out / "people.json").write_text(json.dumps(calibrated(found), indent=1) + "\n")


def people_head(path: Path) -> NanoDetHead:
    """The head that was learnt, its weights as float16 holds them, as NanoDet's own."""
    head = NanoDetHead(1, deeper=True).eval()
    head.load_state_dict(
        {name: each.half().float() for name, each in torch.load(path, weights_only=True).items()}
    )
    return head


def looks(data: Path, model: Daylight, scenes: list[Scene]) -> Iterator[Opinions]:
    """All looks at development pictures."""
    rng, read = np.random.default_rng(SEED), reader()
    bare = ground(data, "fixed_wing")
    for labelled in (tinyperson(data)["val"], bare.only(bare.pictures[::2])):
        for picture in labelled.pictures:
            whole = read(picture.path)
            for scale in LOOKS[labelled.name]:
                for planes, truth in tiles(labelled, picture, whole, scale, rng):
                    yield opinions(model, planes, truth)
    things = [nobody(each) for each in scenes]
    for number in range(2 * RENDERED):
        source = Source(Share(bare, 1.0, (0.5, 2.0)), 1.0)
        made = shown(source, things if number % 2 else scenes, read, SIDE_PX, rng)
        none = np.zeros(len(made.boxes), np.int64)
        picture = LabelledPicture("", SIDE_PX, SIDE_PX, "rendered", made.boxes, none, made.ignored)
        labelled = LabelledSet("rendered", CLASSES, (picture,), frozenset())
        planes = torch.from_numpy(made.image.transpose(2, 0, 1).copy())[None]
        yield opinions(model, planes, Truth(labelled, picture, made.boxes, made.ignored))


def nobody(scene: Scene) -> Scene:
    """The scene's things alone."""
    things = tuple(each for each, is_person in zip(scene.sprites, scene.is_person) if not is_person)
    return replace(scene, sprites=things, is_person=(False,) * len(things))


@torch.no_grad()
def opinions(model: Daylight, planes: torch.Tensor, truth: Truth) -> Opinions:
    """What the head finds in a picture (1, 3, H, W)."""
    levels = model.coco.backbone(planes)
    boxes, opinion, supporting = model.people_of(
        levels, model.coco.head(levels), (planes.shape[2], planes.shape[3])
    )
    right, known = truth.of(boxes.numpy())
    kept = known[:, PERSON] & (opinion.numpy() >= odds(np.array(LEAST_SCORE)))
    return Opinions(np.stack([opinion.numpy(), supporting.numpy(), right[:, PERSON]], 1)[kept])


def calibrated(found: list[Opinions]) -> dict[str, object]:
    """The regression, and how reliable scores are."""
    rows = np.concatenate([each.rows for each in found])
    fit = fitted(rows[:, :2], rows[:, 2])
    return {
        "person": asdict(Calibration(float(fit[0]), float(fit[2]), float(fit[1]))),
        "threshold": FIRST_LOOK,
        "looks": len(found),
        "reliability": reliability(rows[:, :2] @ fit[:2] + fit[2], rows[:, 2]),
    }


if __name__ == "__main__":
    main()
