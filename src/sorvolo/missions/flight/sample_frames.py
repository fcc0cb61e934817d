"""A few pictures of a flight, spread over it."""

from collections.abc import Iterator
from itertools import chain, islice

import cv2
import numpy as np

from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.video import VideoSource
from sorvolo.errors import InputError
from sorvolo.mosaic.selection import evenly, every, has_texture
from sorvolo.survey.flight import Frame

_SAMPLES = 5  # frames of a flight; by choice
_THUMBNAIL_PX = (64, 36)
_LIKE = 0.5  # correlation of two thumbnails of a hovering drone, at least; by choice
_LIVE_STEP_S = 0.5  # between the frames of a live flight


def sample_frames(source: Source) -> list[Frame]:
    """A few frames spread over the flight; of a live one the next few, half a second apart, which ends it."""
    if isinstance(source, VideoSource):
        return source.sample_frames(_SAMPLES)
    if isinstance(source, LiveSource):
        coming = islice(
            source.frames(every(_LIVE_STEP_S if source.kind == "video" else 0.0)), _SAMPLES
        )
        return [frame for frame in coming if isinstance(frame, Frame)]
    return list(_spread_photos(source))


def pictures_move(source: Source) -> bool:
    """Whether a few pictures of a recorded flight show other ground, one after the other; it takes a second."""
    frames = [] if isinstance(source, LiveSource) else sample_frames(source)
    small = np.array([cv2.resize(each.image, _THUMBNAIL_PX).ravel() for each in frames], float)
    return len(small) > 1 and bool(np.diag(np.corrcoef(small), 1).min() < _LIKE)


def _spread_photos(source: Source) -> Iterator[Frame]:
    chosen = set(evenly(source.frame_count, _SAMPLES))
    return (
        frame
        for frame in source.frames(lambda index, _: index in chosen)
        if isinstance(frame, Frame)
    )


def refuse_without_texture(source: Source) -> None:
    """Raise InputError for a recorded flight whose sample frames all show one gray, or noise alone."""
    if isinstance(source, LiveSource):
        return
    seen, spread = 0, _spread_photos(source)
    if isinstance(source, VideoSource):  # one at first: that is nearly always enough
        spread = chain.from_iterable(map(source.sample_frames, (1, _SAMPLES)))
    for frame in spread:
        if has_texture(frame.image):
            return
        seen += 1
    if not seen:
        return  # nothing can be read there: its frames are reported as lost
    raise InputError(
        f"{source.name}: its pictures show no texture ({seen} all over the flight are of one gray, or noise "
        "alone); is the lens covered? `sorvolo inspect` shows what the flight holds"
    )
