"""A detector fed with a simulation's truth: it knows the picture again, misses some objects and invents others."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sorvolo.capture.source import open_sources
from sorvolo.detection.contract import ModelInfo
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.flight import Frame
from sorvolo.survey.objects import CLASSES, Detections, no_detections


class TruthDetector:
    """What a good detector would find in a simulated flight's frames.

    `misses` is the share of objects not seen in a frame, `false_alarms` the mean number of boxes around nothing;
    edges err by `jitter` of the box's sides. The same frame always gets the same answer.
    """

    classes = CLASSES
    provider = "the truth"
    notices = ()
    night: ModelInfo | None = None
    """A model that looks at all pictures in its place."""

    @property
    def others(self) -> tuple[tuple[ModelInfo, int], ...]:
        """`night`, as often as pictures were asked about."""
        return () if self.night is None or not self.asked else ((self.night, self.asked),)

    def __init__(
        self,
        simulated: Path,
        flight: str = "flight1",
        *,
        misses: float = 0.15,
        false_alarms: float = 0.1,
        jitter: float = 0.05,
        seed: int = 1,
    ) -> None:
        self._misses, self._false_alarms, self._jitter, self._seed = (
            misses,
            false_alarms,
            jitter,
            seed,
        )
        truth = json.loads((simulated / "truth" / flight / "boxes.json").read_text())
        by_frame: dict[int, list[Any]] = {image["id"]: [] for image in truth["images"]}
        for each in truth["annotations"]:
            if each["visibility"] > 0.5:
                by_frame[each["image_id"]].append(each)
        (source,) = open_sources([_input_of(simulated / flight, flight)])
        self._frames = {
            _digest(frame.image): (frame.index, by_frame[frame.index])
            for frame in source.frames(lambda *_: True)
            if isinstance(frame, Frame) and frame.index in by_frame
        }
        self.info = ModelInfo(
            "truth",
            CLASSES,
            dict.fromkeys(CLASSES, 0.3),
            dict.fromkeys(CLASSES, (4.0, 400.0)),
            version="1",
            licence="CC0-1.0",
            trained_on="nothing",
        )
        self.asked = 0

    def rest(self) -> None:
        """There is nothing to give back."""

    def thresholds_for(
        self,
        picture: ImageRGB,
        *,
        from_above: bool = False,
        m_per_px: float | None = None,
    ) -> Mapping[str, float]:
        """The same for all pictures."""
        return self.info.thresholds

    def detect(
        self,
        image: ImageRGB,
        *,
        tiles: object = None,
        m_per_px: float | None = None,
        least_score: float | None = None,
        classes: Sequence[str] | None = None,
        from_above: bool = False,
        overlapping: bool = False,
        early: object = None,
        is_part: bool = False,
    ) -> Detections:
        """The boxes of a frame of the flight; KeyError for any other picture, nothing in one without tiles: a part."""
        if tiles is None:
            return no_detections(CLASSES)
        self.asked += 1
        index, objects = self._frames[_digest(image)]
        random = np.random.default_rng([self._seed, index])
        boxes, labels, scores = [], [], []
        for each in objects:
            left, top, width, height = each["bbox"]
            errors = random.normal(0, self._jitter, 4) * [width, height, width, height]
            is_missed, score = random.random() < self._misses, random.uniform(0.45, 0.98)
            if not is_missed:
                boxes.append(np.array([left, top, left + width, top + height]) + errors)
                labels.append(each["category_id"] - 1)
                scores.append(score)
        rows, columns = image.shape[:2]
        for _ in range(random.poisson(self._false_alarms)):
            x, y, side = (
                random.uniform(0, columns - 30),
                random.uniform(0, rows - 30),
                random.uniform(10, 30),
            )
            boxes.append(np.array([x, y, x + side, y + side]))
            labels.append(int(random.integers(len(CLASSES))))
            scores.append(random.uniform(0.3, 0.7))
        found = Detections(
            np.clip(np.array(boxes).reshape(-1, 4), 0, [columns, rows, columns, rows]),
            np.array(scores),
            np.array(labels, np.int64),
            CLASSES,
        )
        wanted = set(classes or CLASSES)
        keep = [
            name in wanted and score >= (least_score or 0.3)
            for name, score in zip(found.names, found.scores)
        ]
        found = found.only(np.array(keep, bool))
        return found.only(np.argsort(-found.scores))


class Knowing(TruthDetector):
    """The truth's detector; what it does not know, such as a picture made from frames, shows nothing."""

    def detect(
        self,
        image: ImageRGB,
        *,
        tiles: object = None,
        m_per_px: float | None = None,
        least_score: float | None = None,
        classes: Sequence[str] | None = None,
        from_above: bool = False,
        overlapping: bool = False,
        early: object = None,
        is_part: bool = False,
    ) -> Detections:
        """See `TruthDetector.detect`."""
        try:
            return super().detect(
                image, tiles=tiles, m_per_px=m_per_px, least_score=least_score, classes=classes
            )
        except KeyError:
            return no_detections(self.classes)


def _digest(image: ImageRGB) -> bytes:
    return hashlib.blake2b(np.ascontiguousarray(image).tobytes(), digest_size=16).digest()


def _input_of(folder: Path, flight: str) -> Path:
    video = folder / f"{flight}.mp4"
    return video if video.exists() else folder / "photos"
