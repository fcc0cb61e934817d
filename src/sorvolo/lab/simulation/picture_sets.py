"""Make a folder of single simulated pictures with their boxes: what a detector learns from and is measured on."""

import time
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from sorvolo.lab.simulation.flight_files import read_orthophoto, write_json
from sorvolo.lab.simulation.folder import (
    PICTURES_MARK,
    simulation_description,
    simulation_folder,
)
from sorvolo.lab.simulation.ground import orthophoto_ground
from sorvolo.lab.simulation.pictures import PictureSettings, SimulatedPicture, simulate_picture
from sorvolo.lab.simulation.truth import coco_categories
from sorvolo.paths import AnyPath, as_path
from sorvolo.store.ahead import in_order
from sorvolo.store.atomic import atomic_write_bytes, writing
from sorvolo.store.images import jpeg_from_image

_MOST_THREADS = 8  # each holds a picture that is drawn, of tens of megabytes


@dataclass(frozen=True)
class PicturesProgress:
    """How far it is: pictures written, boxes in them (those to be ignored left out), seconds."""

    pictures_done: int
    pictures_total: int
    boxes: int
    seconds: float


def simulate_pictures(
    folder: AnyPath,
    settings: PictureSettings,
    ground_file: AnyPath | None = None,
    ground_m_per_px: float | None = None,
) -> Iterator[PicturesProgress]:
    """Write `images/*.jpg` and `boxes.json` (COCO) to `folder`, which appears whole or not at all.

    Each picture is a site of its own; its `flight` in the COCO file names it. `ground_file` is the orthophoto of
    settings whose ground is "orthophoto". Raises SettingsError for a folder that holds anything but an earlier
    simulation, InputError for an unreadable orthophoto and StoreError for a full disk.
    """
    folder = Path(folder)
    ground_file = as_path(ground_file)
    started = time.monotonic()
    ground = (
        None
        if ground_file is None
        else orthophoto_ground(*read_orthophoto(ground_file, ground_m_per_px))
    )
    info = simulation_description(asdict(settings))
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    counted = 0
    with simulation_folder(folder, PICTURES_MARK, {"info": info}) as partial:
        with writing(folder):
            (partial / "images").mkdir()
        pictures = in_order(
            lambda index: simulate_picture(settings, index, ground),
            range(settings.pictures),
            most_threads=_MOST_THREADS,
        )
        for picture in pictures:
            row = _image_row(picture, settings.seed)
            atomic_write_bytes(
                partial / row["file_name"], jpeg_from_image(picture.image), durable=False
            )
            images.append(row)
            annotations += [box | {"id": len(annotations) + box["id"]} for box in picture.boxes]
            counted += sum(1 - box["iscrowd"] for box in picture.boxes)
            yield PicturesProgress(
                len(images), settings.pictures, counted, time.monotonic() - started
            )
        write_json(
            partial / PICTURES_MARK,
            {
                "info": info,
                "categories": coco_categories(),
                "images": images,
                "annotations": annotations,
            },
        )


def _image_row(picture: SimulatedPicture, seed: int) -> dict[str, Any]:
    height_px, width_px = picture.image.shape[:2]
    name = f"site{seed}-{picture.index + 1:06d}"
    return {
        "id": picture.index + 1,
        "file_name": f"images/{name}.jpg",
        "width": width_px,
        "height": height_px,
        "flight": name,
        "m_per_px": round(picture.m_per_px, 5),
        "height_above_ground_m": round(float(picture.site_from_camera.translation_m[2]), 2),
        "ground": picture.ground,
        "thermal": picture.is_thermal,
    }
