"""What a run cannot hold in memory, in files beside the site's that nobody else sees and no kill leaves behind."""

import tempfile
from collections.abc import Hashable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import IO, BinaryIO, Self

import numpy as np

from sorvolo.store.atomic import writing
from sorvolo.survey.flight import Frame


class SpillFile:
    """Bytes by key, written once each, in a file without a name inside `folder`; made when first needed.

    Raises StoreError when the disk is full.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._file: BinaryIO | None = None
        self._places: dict[Hashable, tuple[int, int]] = {}
        self._end = 0

    def put(self, key: Hashable, data: bytes) -> None:
        """Keep these bytes under a key that has none yet."""
        with writing(self._folder):
            if self._file is None:
                self._file = tempfile.TemporaryFile(dir=self._folder)  # noqa: SIM115 (lives as long as the run)
            self._file.seek(self._end)
            self._file.write(data)
            self._file.flush()
        self._places[key] = self._end, len(data)
        self._end += len(data)

    def get(self, key: Hashable) -> bytes:
        """The bytes kept under this key; raises KeyError where there are none."""
        at, length = self._places[key]
        assert self._file is not None
        self._file.seek(at)
        return self._file.read(length)

    def close(self) -> None:
        """Give the space back."""
        if self._file is not None:
            self._file.close()
            self._file = None


@dataclass(frozen=True, eq=False)
class FrameOnDisk:
    """A frame whose picture waits in a file without a name; `taken`, once, gives the file's space back."""

    unseen: Frame
    shape: tuple[int, ...]
    file: IO[bytes]

    @classmethod
    def of(cls, frame: Frame, folder: Path) -> Self:
        """Write a frame's picture into `folder`. Raises StoreError when the disk is full."""
        file = tempfile.TemporaryFile(dir=folder)  # noqa: SIM115 (lives until the frame is taken)
        with writing(folder):
            file.write(np.ascontiguousarray(frame.image).data)
            file.flush()
        size_px = (frame.image.shape[0], frame.image.shape[1])
        unseen = Frame.unseen(frame.index, frame.name, frame.time_ns, size_px)
        return cls(unseen, frame.image.shape, file)

    def taken(self) -> Frame:
        """The frame as it was; its file is gone."""
        with self.file as file:
            file.seek(0)
            return replace(
                self.unseen, image=np.frombuffer(file.read(), np.uint8).reshape(self.shape)
            )
