"""A detector for tests of searches: what a picture has that the site's own frames have not."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType

import cv2
import numpy as np

from sorvolo.detection.contract import ModelInfo
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.store.site.archive import Archive
from sorvolo.survey.objects import CLASSES, Detections


class Comparing:
    """Detects what a picture has that the site's own frames have not, or nothing at all."""

    classes = CLASSES
    provider = "comparison"
    notices = others = ()
    info = ModelInfo(
        "comparing",
        CLASSES,
        MappingProxyType(dict.fromkeys(CLASSES, 0.3)),
        MappingProxyType(dict.fromkeys(CLASSES, (4.0, 400.0))),
        version="1",
        licence="CC0-1.0",
        trained_on="nothing",
    )

    def __init__(self, site: Path, *, sees: bool = True) -> None:
        with Archive.open(site, write=False) as archive:
            self._frames = [archive.image(each) for each in archive.keyframes()]
        self._sees = sees

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
        is_part: bool = False,
    ) -> Detections:
        """Boxes around what differs from the frame that is most like the picture; cars are the large ones."""
        apart = [int(cv2.norm(each, image, cv2.NORM_L1)) for each in self._frames]
        same = self._frames[int(np.argmin(apart))]
        grey = np.abs(image.astype(np.int16) - same).max(axis=2)
        mask = cv2.dilate((grey > 25).astype(np.uint8), np.ones((5, 5), np.uint8))
        _, _, stats, _ = cv2.connectedComponentsWithStats(mask)
        boxes = [row[:4] for row in stats[1:] if row[4] > 12] if self._sees else []
        rows = np.array([[x, y, x + w, y + h] for x, y, w, h in boxes], np.float32).reshape(-1, 4)
        large = (rows[:, 2:] - rows[:, :2]).max(axis=1, initial=0) * (m_per_px or 0) > 3.0
        return Detections(rows, np.full(len(rows), 0.95), np.where(large, 1, 0), CLASSES)
