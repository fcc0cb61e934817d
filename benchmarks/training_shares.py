"""What the aerial networks learn from, and how often each: labelled sets, simulated pictures, photos as ground."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from detection_data import SMALL, aerial_cars, hituav, in_order, mannequin, tinyperson
from sorvolo.lab.datasets import read_dataset
from sorvolo.lab.simulate.pictures import simulate_pictures
from sorvolo.lab.simulation.pictures import PictureSettings
from sorvolo.lab.training.samples import Share
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import CLASSES

SIMULATED_SEED, SIMULATED_PICTURES = 1, 1800
SIMULATED = "boxes.json"
STEEP_DEG = 75.0  # from so many degrees below the horizon a picture has no up and down


def training_shares(data: Path, simulated: Path) -> list[Share]:
    """What is learnt from, and how often each."""
    made = _made(simulated)
    return [
        *frames_of_heat(data),
        Share(tinyperson(data)["train"], 1.8, (1.0, 2.8), pastes=SMALL, aslant=True),
        Share(mannequin(data)["train"], 0.2, (0.3, 1.2), pastes=SMALL),
        Share(aerial_cars(data)["train"], 1.4, (0.25, 1.2), pastes=SMALL),
        Share(made, 3.0, (0.6, 1.6)),
        Share(_ground(data), 0.4, (0.12, 0.5), pastes=SMALL),
    ]


def thermal_shares(data: Path, simulated: Path) -> list[Share]:
    """What the thermal model learns from; simulated frames show what HIT-UAV does not: other poses, small things."""
    made = _made(simulated)
    is_thermal = {
        row["file_name"]: row["thermal"]
        for row in json.loads((simulated / SIMULATED).read_text())["images"]
    }
    heat = made.only(
        [each for each in made.pictures if is_thermal[f"images/{Path(each.path).name}"]]
    )
    return [*frames_of_heat(data), Share(heat, 0.6, (0.8, 1.8))]


def frames_of_heat(data: Path) -> list[Share]:
    """HIT-UAV's frames: those from aslant have an up and a down."""
    thermal = hituav(data)["train"]
    return [
        Share(
            _from(thermal, lambda angle_deg: angle_deg < STEEP_DEG),
            3.2,
            (1.0, 2.3),
            thermal=True,
            aslant=True,
        ),
        Share(
            _from(thermal, lambda angle_deg: angle_deg >= STEEP_DEG), 1.4, (1.0, 2.3), thermal=True
        ),
    ]


def _made(simulated: Path) -> LabelledSet:
    """The simulated pictures, made at the first time."""
    if not (simulated / SIMULATED).is_file():
        settings = PictureSettings(
            pictures=SIMULATED_PICTURES, seed=SIMULATED_SEED, thermal_share=0.2
        )
        for _ in simulate_pictures(simulated, settings):
            pass
    return replace(in_order(read_dataset(simulated)), name="simulated")


def _from(labelled: LabelledSet, fits: Callable[[float], bool]) -> LabelledSet:
    """HIT-UAV's frames taken at angles below the horizon that `fits`; their names give them, night_height_angle_."""
    return labelled.only(
        [each for each in labelled.pictures if fits(float(Path(each.path).stem.split("_")[2]))]
    )


def _ground(data: Path) -> LabelledSet:
    """Photos without labels as ground for small objects: whether people or cars are in them is not known."""
    pictures = []
    folder = data.parent / "flights"
    paths = sorted(
        [*folder.glob("brighton_beach/**/*.JPG"), *folder.glob("caliterra/**/*.[jJ][pP]*")]
    )
    for path in paths:
        height, width = cv2.imdecode(np.fromfile(path, np.uint8), cv2.IMREAD_REDUCED_COLOR_8).shape[
            :2
        ]
        none = np.zeros((0, 4), np.float32)
        pictures.append(
            LabelledPicture(
                str(path), width * 8, height * 8, path.parent.name, none, np.zeros(0), none
            )
        )
    return LabelledSet("ground", CLASSES, tuple(pictures), frozenset(CLASSES[:2]))
