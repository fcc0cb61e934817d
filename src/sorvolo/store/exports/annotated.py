"""Pictures with what was found drawn in, and a video of them."""

from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path
from typing import Self

import av
import cv2
import numpy as np

from sorvolo.geometry.arrays import BoxesPx, ImageRGB, Mask, shrunk
from sorvolo.store.atomic import (
    TEMPORARY_PREFIX,
    atomic_write_bytes,
    make_folder,
    sync_file,
    writing,
)
from sorvolo.store.images import jpeg_from_image

_COLOURS = (
    (255, 196, 0),
    (0, 200, 255),
    (255, 90, 160),
    (120, 230, 80),
    (190, 140, 255),
    (255, 140, 60),
)
_VIDEO_SIDE_PX = 1920  # of the longer side: larger videos help no one on a screen and take long
_TICKS_PER_S = 90_000  # MPEG's clock

_Bar = tuple[int, int, int, int]  # left, top, right, bottom edge of a bar with words


def annotated(
    image: ImageRGB,
    boxes_px: BoxesPx,
    labels: Sequence[int],
    words: Sequence[str],
    counted: Sequence[bool],
    headline: str = "",
) -> ImageRGB:
    """A copy of the picture (H, W, 3) with boxes (N, 4), each in its class's colour with its words above or below.

    Boxes that are `counted` (of confirmed tracks) are drawn strong, the others thin. The headline stands top left.
    """
    drawn = image.copy()
    size = max(image.shape[:2]) / 1280
    strong, thin, letters = max(2, round(2 * size)), max(1, round(size)), max(0.4, 0.5 * size)
    # the strong ones last, and all words after all boxes, so that nothing hides them
    order = sorted(range(len(boxes_px)), key=lambda each: counted[each])
    edges = [tuple(round(float(edge)) for edge in box) for box in boxes_px]
    colours = [_COLOURS[label % len(_COLOURS)] for label in labels]
    for row in order:
        thickness = strong if counted[row] else thin
        cv2.rectangle(drawn, edges[row][:2], edges[row][2:], colours[row], thickness, cv2.LINE_AA)
    written: list[_Bar] = []
    if headline:
        written.append(_write(drawn, headline, [(0, 0)], 1.2 * letters, (255, 255, 255), written))
    for row in (each for each in order if words[each]):
        left, top, right, bottom = edges[row]
        above, below = top - strong - 6, bottom + strong + round(30 * letters)
        corners = [(left, above), (left, below), (right + strong + 2, bottom)]
        written.append(_write(drawn, words[row], corners, letters, colours[row], written))
    return drawn


def with_outlines(image: ImageRGB, mask: Mask) -> ImageRGB:
    """A copy of the picture (H, W, 3) with the mask's regions outlined; a mask of another size is brought to it."""
    drawn = image.copy()
    height, width = image.shape[:2]
    shape = cv2.resize(mask.astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST)
    regions, _ = cv2.findContours(shape, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)
    strong = max(2, round(2 * max(width, height) / 1280))
    cv2.drawContours(drawn, regions, -1, (255, 255, 255), 2 * strong)
    cv2.drawContours(drawn, regions, -1, _COLOURS[2], strong)
    return drawn


def write_annotated(folder: Path, name: str, picture: ImageRGB) -> None:
    """Write an annotated picture `<name>.jpg` into the folder, which is made. Raises StoreError on a full disk."""
    make_folder(folder)
    atomic_write_bytes(folder / f"{name}.jpg", jpeg_from_image(picture), durable=False)


class AnnotatedVideo:
    """An H.264 video that takes pictures at their own times; its file appears when it is closed.

    It is written in fragments, so that what a killed run left (a name beginning with `.tmp-`) can be played all the
    same. Pictures of more than 1920 px are made smaller. Raises StoreError on a full disk.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._temporary = path.with_name(f"{TEMPORARY_PREFIX}{path.name}")
        self._container: av.container.OutputContainer | None = None
        self._stream: av.VideoStream | None = None
        self._first_ns, self._last_tick = 0, -1

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, picture: ImageRGB, time_ns: int) -> None:
        """Append one picture; times rise."""
        with writing(self._path):
            if self._container is None or self._stream is None:
                self._begin(picture, time_ns)
            assert self._container is not None and self._stream is not None
            size = (self._stream.width, self._stream.height)
            if picture.shape[1::-1] != size:
                picture = shrunk(picture, size)
            frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
            tick = max(
                (time_ns - self._first_ns) * _TICKS_PER_S // 1_000_000_000, self._last_tick + 1
            )
            frame.pts, frame.time_base = tick, Fraction(1, _TICKS_PER_S)
            self._last_tick = tick
            self._container.mux(self._stream.encode(frame))

    def close(self) -> None:
        """Put the video in its place; nothing where no picture came."""
        container, self._container = self._container, None
        if container is None or self._stream is None:
            return
        with writing(self._path):
            container.mux(self._stream.encode())
            container.close()
            sync_file(self._temporary)
            self._temporary.replace(self._path)

    def _begin(self, picture: ImageRGB, time_ns: int) -> None:
        height, width = picture.shape[:2]
        scale = min(1.0, _VIDEO_SIDE_PX / max(height, width))
        self._container = av.open(
            str(self._temporary),
            "w",
            format="mp4",
            container_options={"movflags": "+frag_keyframe+empty_moov+default_base_moof"},
        )
        stream = self._container.add_stream("libx264", rate=30)
        stream.width, stream.height = (
            max(2, round(side * scale) // 2 * 2) for side in (width, height)
        )
        stream.pix_fmt = "yuv420p"
        stream.codec_context.time_base = Fraction(1, _TICKS_PER_S)
        stream.options = {"crf": "23", "preset": "veryfast", "g": "60", "bf": "0"}
        self._stream, self._first_ns = stream, time_ns


def _write(
    picture: ImageRGB,
    words: str,
    corners: Sequence[tuple[int, int]],
    size: float,
    colour: tuple[int, int, int],
    written: Sequence[_Bar],
) -> _Bar:
    """Words on a dark bar within the picture, at the first of the lower left corners where they hide none written.

    OpenCV's letters are ASCII.
    """
    plain = words.encode("ascii", "replace").decode()
    (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, size, 1)
    bars = []
    for corner in corners:
        x = max(0, min(corner[0], picture.shape[1] - width - 2))
        y = max(height + 2, min(corner[1], picture.shape[0] - below))
        bars.append((x, y - height - 2, x + width + 2, y + below))
    bar = next(
        (each for each in bars if not any(boxes_meet(each, other) for other in written)), bars[0]
    )
    cv2.rectangle(picture, bar[:2], bar[2:], (20, 20, 20), cv2.FILLED)
    place = (bar[0] + 1, bar[3] - below)
    cv2.putText(picture, plain, place, cv2.FONT_HERSHEY_SIMPLEX, size, colour, 1, cv2.LINE_AA)
    return bar


def boxes_meet(one: Sequence[float], other: Sequence[float]) -> bool:
    """Whether two boxes, left, top, right, bottom, have ground in common."""
    return one[0] < other[2] and other[0] < one[2] and one[1] < other[3] and other[1] < one[3]
