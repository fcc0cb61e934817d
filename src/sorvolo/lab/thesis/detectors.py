"""Section 4.3, Table 4.6: both proposal networks trained on the dataset's labelled frames, and measured on others."""

import shutil
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sorvolo.capture.photos import read_picture
from sorvolo.capture.source import open_sources
from sorvolo.capture.video import read_video_info
from sorvolo.detection.detector import Detector
from sorvolo.errors import InputError
from sorvolo.lab.datasets.parsed import read_text
from sorvolo.lab.datasets.umcd import read_umcd_metadata
from sorvolo.lab.evaluation.detector import EvaluationSettings, evaluate_detector, read_sets
from sorvolo.lab.thesis.settings import FIGURE_PX
from sorvolo.lab.thesis.umcd_folder import UmcdVideo
from sorvolo.lab.training.settings import TrainSettings
from sorvolo.mosaic.selection import every
from sorvolo.store.atomic import atomic_write_bytes, make_folder, writing
from sorvolo.store.exports.annotated import annotated
from sorvolo.store.images import jpeg_from_image
from sorvolo.survey.flight import Frame
from sorvolo.survey.labels import LabelledSet

HELD_OUT = 0.2
"""The share of the frames that is tested on, of whole videos where there are enough (thesis: 818 of 4,088 frames)."""

_EXAMPLES = 4  # pictures of a figure
_DRAWS = 200  # resamplings: the tables show no intervals


@dataclass(frozen=True)
class Labels:
    """A labelled set: the thesis's name for it, where it lies, and its form as `read_dataset` names it.

    `test` is where the publisher put what is tested on; None: a share is held out.
    """

    name: str
    place: Path
    form: str
    test: Path | None = None

    @property
    def split(self) -> str:
        """What is tested on, in words."""
        if self.test is not None:
            return f"the publisher's test folder ({self.test.name})"
        return f"{HELD_OUT:.0%} held out"


def okutama_labels(place: Path) -> Labels:
    """Okutama-Action with its own train and test folders, where `place` has one of each (TrainSet..., TestSet...)."""
    folders = sorted(each for each in place.iterdir() if each.is_dir()) if place.is_dir() else []
    train, test = (
        [each for each in folders if each.name.lower().startswith(name)]
        for name in ("train", "test")
    )
    if len(train) == len(test) == 1:
        return Labels("Okutama Action", train[0], "okutama", test[0])
    return Labels("Okutama Action", place, "okutama")


def extract_frames(
    videos: Sequence[UmcdVideo],
    folder: Path,
    views_per_second: float,
    placed: Mapping[str, str],
) -> str:
    """Write the videos' frames and metadata as `read_dataset` takes them (a folder for each video); whose places.

    Of a video whose metadata has `Box:` lines the frames with places and those that clearly show nothing are taken.
    UMCD's own metadata has no places (docs/datasets.md): then `placed` has, by the video's key, a text with those of
    a comparison. Raises InputError where neither has places.
    """
    with writing(folder):
        shutil.rmtree(folder, ignore_errors=True)
        folder.mkdir(parents=True)
    own = {each.key: read_text(each.metadata) for each in videos if each.metadata is not None}
    for texts, whose in ((own, ""), (placed, "; places by the comparison of both flights")):
        if sum(
            _extract(each, texts[each.key], folder, views_per_second)
            for each in videos
            if each.key in texts
        ):
            return whose
    raise InputError(
        "neither a metadata file nor a comparison of two flights gives the places of objects in the frames, so nothing "
        "can be learnt; add lines 'Box: FRAME LEFT TOP WIDTH HEIGHT' to the objects (docs/datasets.md)"
    )


def train_network(labels: Labels, out: Path, settings: TrainSettings) -> str:
    """Train one network of Table 4.6 on what is not held out; the file of the model, which is left in `out`.

    Raises InputError as `train_detector`, and where torch is not installed; SettingsError for a device.
    """
    try:
        from sorvolo.lab.training.detector import MODEL, train_detector
        from sorvolo.lab.training.sets import DataOptions
    except ModuleNotFoundError as error:
        raise InputError(
            f"training needs packages that are not installed ({error.name}): pip install 'sorvolo[training]'"
        ) from error
    with writing(out):
        shutil.rmtree(out, ignore_errors=True)
    options = DataOptions(val=str(labels.test or HELD_OUT), form=labels.form)
    for _ in train_detector([labels.place], out, settings, options):
        pass
    return str(out / MODEL)


def held_out(labels: Labels, seed: int) -> LabelledSet:
    """The pictures that a training with this seed is tested on. Raises InputError where they cannot be used."""
    share = HELD_OUT if labels.test is None else 0.0
    place = labels.test or labels.place
    (labelled,) = read_sets([place], form=labels.form, held_out=share, seed=seed)
    return labelled


def measure_model(model: str, labelled: LabelledSet) -> dict[str, Any]:
    """The thesis's mAP (eqs 4.3, 4.4) and COCO's AP of a model on labelled pictures, and of each class."""
    measured = evaluate_detector(
        [[model]], [labelled], EvaluationSettings(tiles=None, draws=_DRAWS)
    )
    (scores,) = measured.sets
    return {
        "set": labelled.name,
        "pictures": scores.pictures,
        "videos": scores.groups,
        "thesis_map": scores.intervals["thesis_map"].value,
        "ap50": scores.coco.ap50,
        "ap": scores.coco.ap,
        "labels": {row.label: row.labels for row in scores.classes},
        "recall": {row.label: row.reported.recall for row in scores.classes},
        "remarks": [*scores.remarks, *measured.notices],
    }


def example_pictures(model: str, labelled: LabelledSet) -> list[bytes]:
    """Figure 4.6: frames with the most labelled objects and what the model reports in them, one of each video first."""
    detector = Detector.load(model, stand_in=False)
    shown: dict[str, Any] = {}
    for picture in sorted(labelled.pictures, key=lambda each: -len(each.labels)):
        shown.setdefault(picture.group, picture)
    found = []
    for picture in list(shown.values())[:_EXAMPLES]:
        image = read_picture(Path(picture.path))
        detections = detector.detect(image, m_per_px=picture.m_per_px)
        found.append(
            jpeg_from_image(
                annotated(
                    image,
                    detections.boxes_px,
                    detections.labels.tolist(),
                    [f"{a} {b:.2f}" for a, b in zip(detections.names, detections.scores)],
                    [True] * len(detections),
                ),
                FIGURE_PX,
            )
        )
    return found


def _extract(video: UmcdVideo, text: str, folder: Path, views_per_second: float) -> int:
    """How many frames of a video were written; none where its metadata's text has no places."""
    place = folder / video.key.replace("/", "-")
    listed = place.with_name(f"{place.name}.txt")
    atomic_write_bytes(listed, text.encode(), durable=False)
    stated = read_umcd_metadata(listed)
    if not stated.boxed:
        listed.unlink()
        return 0
    make_folder(place)
    rate_hz = stated.fps or read_video_info(video.video).frame_rate_hz
    steady = every(1 / views_per_second)
    (source,) = open_sources([video.video])
    count = 0
    for each in source.frames(
        lambda index, time_ns: (
            index in stated.boxed
            or (steady(index, time_ns) and stated.shows_object(index / rate_hz) is False)
        )
    ):
        if isinstance(each, Frame):
            atomic_write_bytes(
                place / f"{each.index:06d}.jpg", jpeg_from_image(each.image), durable=False
            )
            count += 1
    return count
