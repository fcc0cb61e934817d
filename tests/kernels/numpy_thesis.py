"""The kernels of the thesis's change detection in NumPy: the specification of the compiled ones.

Windows of even size reach one pixel further up and left than down and right; outside of the picture it is mirrored at
its rim pixels, which are not repeated.
"""

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Bytes = NDArray[np.uint8]

GRAY_WEIGHTS = np.array([3735, 19235, 9798])  # of blue, green and red, in 2^15ths (ITU-R BT.601)


def equalising_tables(image: Bytes, known: Bytes | None, threads: int) -> Bytes:
    """For each channel of an image (h, w, 3) the 256 values that make its histogram flat, (3, 256).

    Only pixels count where `known` (h, w) is not 0. The least value that occurs becomes 0, the greatest 255, and each
    between them the rounded share of pixels up to it; a channel with one value only keeps it.
    """
    del threads
    pixels = image.reshape(-1, 3) if known is None else image[known != 0]
    tables = np.empty((3, 256), np.uint8)
    for channel in range(3):
        counts = np.bincount(pixels[:, channel], minlength=256)
        least = counts[int(np.argmax(counts > 0))]
        rest = counts.sum() - least
        above_least = np.maximum(np.cumsum(counts) - least, 0)
        tables[channel] = (510 * above_least + rest) // (2 * rest) if rest > 0 else np.arange(256)
    return tables


def averaged(
    image: Bytes, tables: Bytes, width: int, height: int, threads: int
) -> tuple[Bytes, Bytes]:
    """An image (h, w, 3) through its tables and averaged over a window: planes (3, h, w) and their gray (h, w)."""
    del threads
    equalised = looked_up(image, tables).transpose(2, 0, 1)
    area = width * height
    planes = np.stack(
        [(_window_sums(plane, width, height) + area // 2) // area for plane in equalised]
    )
    return planes.astype(np.uint8), gray_of(planes.transpose(1, 2, 0))


def texture_changes(
    reference: Bytes, query: Bytes, asked: Bytes, width: int, height: int, most: int, threads: int
) -> Bytes:
    """Where two images (3, h, w) have local binary patterns that differ in more than `most` bits: 255, else 0.

    Looked at only where `asked` (h, w) is not 0. Equation 3.20: a bit is 0 for a neighbour less than the centre.
    """
    del threads
    y, x = np.nonzero(asked)
    differing = np.zeros(len(y), np.int64)
    for reference_plane, query_plane in zip(reference, query):
        around_reference = _mirrored(reference_plane, width, height)
        around_query = _mirrored(query_plane, width, height)
        for dy in range(height):
            for dx in range(width):
                bits_of_reference = around_reference[y + dy, x + dx] >= reference_plane[y, x]
                bits_of_query = around_query[y + dy, x + dx] >= query_plane[y, x]
                differing += bits_of_reference != bits_of_query
    changes = np.zeros(asked.shape, np.uint8)
    changes[y, x] = np.where(differing > most, 255, 0)
    return changes


def without_isolations(
    mask: Bytes, width: int, height: int, most_black: int, threads: int
) -> Bytes:
    """Equation 3.21: 0 where the window around a pixel has more than `most_black` black ones, else 255."""
    del threads
    black = _window_sums((mask == 0).astype(np.uint8), width, height)
    return np.where(black > most_black, np.uint8(0), np.uint8(255))


def region_boxes(mask: Bytes) -> NDArray[np.int64]:
    """The boxes (N, 4) x, y, width, height of a mask's 8-connected regions, in the order of their first pixels."""
    labels, _ = ndimage.label(mask, structure=np.ones((3, 3)))
    boxes = [
        (columns.start, rows.start, columns.stop - columns.start, rows.stop - rows.start)
        for rows, columns in ndimage.find_objects(labels)
    ]
    return np.array(boxes, np.int64).reshape(-1, 4)


def gray_histograms(
    image: Bytes, tables: Bytes, boxes: NDArray[np.int64], known: Bytes | None
) -> NDArray[np.int64]:
    """How often each gray of an image (h, w, 3), put through its tables, occurs in each box: (N, 256).

    Only pixels count where `known` (h, w) is not 0.
    """
    gray = gray_of(looked_up(image, tables))
    counted = np.ones(gray.shape, bool) if known is None else known != 0
    places = [(slice(y, y + height), slice(x, x + width)) for x, y, width, height in boxes]
    counts = [np.bincount(gray[place][counted[place]], minlength=256) for place in places]
    return np.array(counts, np.int64).reshape(-1, 256)


def looked_up(image: Bytes, tables: Bytes) -> Bytes:
    """An image (h, w, 3) with each channel's values replaced by those of its table."""
    return np.stack([tables[channel][image[..., channel]] for channel in range(3)], axis=-1)


def gray_of(image: NDArray[np.integer]) -> Bytes:
    """The gray (h, w) of a BGR image (h, w, 3)."""
    return ((image.astype(np.int64) @ GRAY_WEIGHTS + 16384) >> 15).astype(np.uint8)


def _mirrored(plane: Bytes, width: int, height: int) -> Bytes:
    """A plane (h, w) with as much around it as the window reaches over its rim."""
    above, left = height // 2, width // 2
    return np.pad(plane, ((above, height - 1 - above), (left, width - 1 - left)), mode="reflect")


def _window_sums(plane: Bytes, width: int, height: int) -> NDArray[np.int64]:
    """The sum over the window around each pixel of a plane (h, w)."""
    around = np.pad(_mirrored(plane, width, height), ((1, 0), (1, 0)))
    sums = around.cumsum(axis=0, dtype=np.int64).cumsum(axis=1)
    return (
        sums[height:, width:]
        - sums[:-height, width:]
        - sums[height:, :-width]
        + sums[:-height, :-width]
    )
