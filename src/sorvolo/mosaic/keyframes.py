"""A flight's keyframes with what links need of them: the latest used in memory, the others on a shelf.

A keyframe of 1024 x 576 px takes about a megabyte, nearly all of it its picture and features; a flight of thousands
needs only those around the one that is being placed.
"""

import io
from collections import OrderedDict
from dataclasses import dataclass

import numpy as np

from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.camera import Camera
from sorvolo.mosaic.shelf import Shelf
from sorvolo.survey.flight import CameraPrior
from sorvolo.survey.mosaic import Features, Keyframe


@dataclass(frozen=True, eq=False)
class _Rest:
    """What is always in memory of a keyframe."""

    camera: Camera
    prior: CameraPrior
    kind: str


class Keyframes:
    """Keyframes and their thumbnails by id, at most `most_bytes` of them in memory where there is a shelf.

    What comes back from the shelf equals what was put there, bit by bit.
    """

    def __init__(self, shelf: Shelf | None = None, most_bytes: int = 1 << 28) -> None:
        self._shelf, self._most_bytes = shelf, most_bytes
        self._rest: dict[int, _Rest] = {}
        self._near: OrderedDict[int, tuple[Keyframe, ImageRGB]] = OrderedDict()
        self._shelved: set[int] = set()
        self._bytes = 0

    def __contains__(self, keyframe_id: int) -> bool:
        return keyframe_id in self._rest

    def add(self, keyframe: Keyframe, thumbnail: ImageRGB) -> None:
        """Keep a keyframe, with a small copy of its picture in colour."""
        self._rest[keyframe.id] = _Rest(keyframe.camera, keyframe.prior, keyframe.features.kind)
        self._take(keyframe, thumbnail)

    def camera(self, keyframe_id: int) -> Camera:
        """The camera of the keyframe's picture, as large as it is registered."""
        return self._rest[keyframe_id].camera

    def keyframe(self, keyframe_id: int) -> Keyframe:
        """The keyframe, from the shelf if it has to be."""
        return self._both(keyframe_id)[0]

    def thumbnail(self, keyframe_id: int) -> ImageRGB:
        """The small copy of the keyframe's picture, from the shelf if it has to be."""
        return self._both(keyframe_id)[1]

    def release(self) -> None:
        """Put all on the shelf: nothing is wanted of them for a while. Without a shelf they stay."""
        while self._shelf is not None and self._near:
            self._shelve_oldest(self._shelf)

    # ---- inside -----------------------------------------------------------------------------------------------

    def _both(self, keyframe_id: int) -> tuple[Keyframe, ImageRGB]:
        found = self._near.get(keyframe_id)
        if found is None:
            assert self._shelf is not None
            rest = self._rest[keyframe_id]
            with np.load(io.BytesIO(self._shelf.get(keyframe_id)), allow_pickle=False) as kept:
                features = Features(rest.kind, kept["points_px"], kept["descriptors"])
                found = (
                    Keyframe(keyframe_id, rest.camera, kept["gray"], features, rest.prior),
                    kept["thumbnail"],
                )
            self._take(*found)
        self._near.move_to_end(keyframe_id)
        return found

    def _take(self, keyframe: Keyframe, thumbnail: ImageRGB) -> None:
        """Into memory; those used longest ago make room."""
        self._near[keyframe.id] = keyframe, thumbnail
        self._bytes += _size(keyframe, thumbnail)
        while self._shelf is not None and self._bytes > self._most_bytes and len(self._near) > 1:
            self._shelve_oldest(self._shelf)

    def _shelve_oldest(self, shelf: Shelf) -> None:
        keyframe_id, (oldest, small) = self._near.popitem(last=False)
        self._bytes -= _size(oldest, small)
        if keyframe_id not in self._shelved:
            shelf.put(keyframe_id, _bytes(oldest, small))
            self._shelved.add(keyframe_id)


def _size(keyframe: Keyframe, thumbnail: ImageRGB) -> int:
    features = keyframe.features
    return (
        keyframe.gray.nbytes
        + features.points_px.nbytes
        + features.descriptors.nbytes
        + thumbnail.nbytes
    )


def _bytes(keyframe: Keyframe, thumbnail: ImageRGB) -> bytes:
    data = io.BytesIO()
    np.savez(
        data,
        gray=keyframe.gray,
        points_px=keyframe.features.points_px,
        descriptors=keyframe.features.descriptors,
        thumbnail=thumbnail,
    )
    return data.getvalue()
