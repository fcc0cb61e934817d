"""A few pictures of a flight, and how sharp and rich in texture they are."""

from itertools import islice

import cv2
import numpy as np

from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.video import VideoSource
from sorvolo.mosaic.selection import every
from sorvolo.registration.features import gray_from_rgb, sharpness
from sorvolo.survey.flight import Frame

_GLIMPSES = 5
_SIDE_PX = 960
_LIVE_STEP_S = 0.5  # between the frames of a live flight


def glimpses_of(source: Source) -> list[Frame]:
    """A few frames spread over the flight; of a live one the next few, half a second apart, which ends it."""
    if isinstance(source, VideoSource):
        return source.glimpses(_GLIMPSES)
    if isinstance(source, LiveSource):
        coming = islice(source.frames(every(_LIVE_STEP_S if source.kind == "video" else 0.0)), _GLIMPSES)
        return [frame for frame in coming if isinstance(frame, Frame)]
    count = min(_GLIMPSES, source.frame_count)
    chosen = {round(index) for index in np.linspace(0, source.frame_count - 1, count)}
    return [frame for frame in source.frames(lambda index, _: index in chosen) if isinstance(frame, Frame)]


def sharpness_and_texture(frame: Frame) -> tuple[float, float]:
    """registration.features.sharpness at 960 px, and the spread of gray about its surroundings, in levels."""
    gray = gray_from_rgb(frame.image)
    scale = min(1.0, _SIDE_PX / max(gray.shape))
    small = cv2.resize(gray, None, fx=scale, fy=scale, interpolation=cv2.INTER_AREA)
    smooth = cv2.GaussianBlur(small, (0, 0), 1.0).astype(np.float64)  # without the sensor's noise
    detail = smooth - cv2.boxFilter(small, cv2.CV_64F, (31, 31))
    return sharpness(np.asarray(small, np.uint8)), float(detail.std())
