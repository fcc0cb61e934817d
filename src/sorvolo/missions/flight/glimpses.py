"""A few pictures of a flight, spread over it."""

from itertools import islice

from sorvolo.capture.source import LiveSource, Source
from sorvolo.capture.video import VideoSource
from sorvolo.mosaic.selection import evenly, every
from sorvolo.survey.flight import Frame

_GLIMPSES = 5
_LIVE_STEP_S = 0.5  # between the frames of a live flight


def glimpses_of(source: Source) -> list[Frame]:
    """A few frames spread over the flight; of a live one the next few, half a second apart, which ends it."""
    if isinstance(source, VideoSource):
        return source.glimpses(_GLIMPSES)
    if isinstance(source, LiveSource):
        coming = islice(source.frames(every(_LIVE_STEP_S if source.kind == "video" else 0.0)), _GLIMPSES)
        return [frame for frame in coming if isinstance(frame, Frame)]
    chosen = set(evenly(source.frame_count, _GLIMPSES))
    return [frame for frame in source.frames(lambda index, _: index in chosen) if isinstance(frame, Frame)]
