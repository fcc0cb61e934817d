"""How large a flight's frames are shown to the detector where no telemetry knows their scale: chosen from the scene."""

from collections.abc import Callable, Sequence

import cv2
import numpy as np

from sorvolo.detection.contract import ModelInfo
from sorvolo.detection.tiling import scale_for
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.survey.objects import Detections
from sorvolo.tracking.sizes import SceneScale

Look = Callable[[ImageRGB], Detections]
"""Something that searches a picture (H, W, 3) as it is."""


# When and how the middle of a frame is looked at enlarged.
_SIZE_PX = (480, 640)  # of the middle, height and width: it costs as much as nine times its pixels
_TIMES = (1.0, 2.0, 3.0)  # as large as it is
_FIRST_AGAIN = 30  # frames until it is done again, ...
_GROWTH = 3  # ... then so many times as many, and so on: drones climb


class SceneMagnifier:
    """The ground that a pixel covers, frame by frame, from what the frames show. `m_per_px` and `see` change it.

    Things that are too small in a frame as it is are found in its enlarged middle; their size is the scale.
    """

    def __init__(self, info: ModelInfo, wanted: Sequence[str]) -> None:
        self._info, self._wanted = info, tuple(wanted)
        self._scale = SceneScale()
        self._frames, self._next = 0, 0

    def m_per_px(self, picture: ImageRGB, look: Look) -> float | None:
        """Of the next frame (H, W, 3); None where the scene does not show it, or shows only people large enough."""
        if self._frames == self._next:
            height, width = (min(side, most) for side, most in zip(picture.shape[:2], _SIZE_PX))
            top, left = (picture.shape[0] - height) // 2, (picture.shape[1] - width) // 2
            middle = np.ascontiguousarray(picture[top : top + height, left : left + width])
            for times in _TIMES:
                size = round(width * times), round(height * times)
                shown = (
                    middle
                    if times == 1
                    else cv2.resize(middle, size, interpolation=cv2.INTER_LINEAR)
                )
                seen = look(np.asarray(shown, np.uint8))
                boxes_px = seen.boxes_px / np.float32(times) + np.array(
                    [left, top, left, top], np.float32
                )
                self._scale.see(
                    Detections(boxes_px, seen.scores, seen.labels, seen.classes),
                    picture.shape[:2],
                    (left, top, left + width, top + height),
                )
            self._next = max(_FIRST_AGAIN, self._next * _GROWTH)
        self._frames += 1
        m_per_px = self._scale.m_per_px()
        if m_per_px is None or self._scale.fit is not None:
            return m_per_px
        return m_per_px if scale_for(self._info, m_per_px, self._wanted) > 1 else None

    def see(self, found: Detections, picture: ImageRGB) -> None:
        """Take in what was detected in the whole frame."""
        self._scale.see(found, picture.shape[:2])
