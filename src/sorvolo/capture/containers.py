"""The outer structure of video files: how a cut file is recognised."""

from pathlib import Path
from typing import BinaryIO

_TS_PACKET_BYTES = 188  # ISO/IEC 13818-1
_MOST_BOXES = 100_000  # at the top of an MP4; a fragmented one has two a fragment; by choice
_EBML_UNKNOWN_SIZES = frozenset((1 << 7 * length) - 1 for length in range(1, 9))


def ends_early(path: Path, container: str) -> bool:
    """Whether the file's own structure reaches beyond its end; False for containers without such a structure.

    `container` is FFmpeg's name: mpegts, mov (also MP4) or matroska (also WebM).
    """
    size = path.stat().st_size
    if container == "mpegts":
        with path.open("rb") as file:
            return file.read(1) == b"\x47" and size % _TS_PACKET_BYTES != 0
    if container == "mov":
        return any(end > size for end in top_boxes(path).values())
    if container == "matroska":
        return _matroska_end(path) > size
    return False


def top_boxes(path: Path) -> dict[str, int]:
    """The boxes at the top of an MP4 or MOV file by name, each with the offset where its last one ends."""
    boxes: dict[str, int] = {}
    size, start = path.stat().st_size, 0
    with path.open("rb") as file:
        for _ in range(_MOST_BOXES):
            if start + 8 > size:
                break
            file.seek(start)
            head = file.read(16)
            length = int.from_bytes(head[:4], "big")
            if length == 1:
                length = int.from_bytes(head[8:16], "big")
            elif length == 0:  # to the end of the file
                length = size - start
            if length < 8:
                break
            start += length
            boxes[head[4:8].decode("latin-1")] = start
    return boxes


def _matroska_end(path: Path) -> int:
    """Where the first Matroska segment ends by its own header, bytes; 0 if unknown."""
    with path.open("rb") as file:
        for _ in range(2):  # the EBML header, then the segment
            identity = file.read(4)
            length = _ebml_length(file)
            if identity == b"\x18\x53\x80\x67":
                return 0 if length in _EBML_UNKNOWN_SIZES else file.tell() + length
            file.seek(length, 1)
    return 0


def _ebml_length(file: BinaryIO) -> int:
    first = file.read(1)
    if not first or not first[0]:
        return 0
    extra = 8 - first[0].bit_length()
    return int.from_bytes(bytes([first[0] & ((1 << (7 - extra)) - 1)]) + file.read(extra), "big")
