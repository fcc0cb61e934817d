"""Folders of masks, one a frame: ours, a simulation's, or those of a dataset; nonzero is change."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np

from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Mask
from sorvolo.lab.evaluation.change_metrics import Counts, frame_counts, pixel_counts

MASK_ENDINGS = set(
    [".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".pbm", ".ppm", ".gif"]
)
"""The files that are masks, in small letters."""

_LOSSY = {".jpg", ".jpeg", ".webp"}
_UNKNOWN = 128  # in masks that `compare --masks` writes (docs/formats.md)


def read_mask(path: Path, *, may_be_unknown: bool) -> tuple[Mask, Mask]:
    """Where a mask marks change, and where it marks that nothing is known, (height, width) each.

    A pixel is changed when any of its colours is nonzero; in lossy formats, from 128 on. With `may_be_unknown`, 128 is
    unknown in a mask that holds 0, 128 and 255 only. Raises InputError for a file that is no picture.
    """
    data = np.frombuffer(path.read_bytes(), np.uint8)
    picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    if picture is None:
        raise InputError(f"{path}: cannot be read as a picture; make this mask anew")
    values = np.asarray(picture)
    if values.ndim == 3:  # alpha is no part of the change
        values = values[..., :3].max(axis=2) if values.shape[2] != 2 else values[..., 0]
    if path.suffix.lower() in _LOSSY:
        changed: Mask = values >= 128
        return changed, np.zeros(values.shape, bool)
    unknown = values == _UNKNOWN
    if not (may_be_unknown and unknown.any() and np.isin(values, (0, _UNKNOWN, 255)).all()):
        unknown = np.zeros(values.shape, bool)
    return (values > 0) & ~unknown, unknown


@dataclass(frozen=True)
class MaskScores:
    """Found masks against true ones: counts of pixels and of frames, and the masks that only one side has."""

    pixels: Counts
    frames: Counts
    compared: int
    only_found: int
    only_true: int
    least_px: int


@dataclass(frozen=True)
class ComparedMask:
    """One found mask, by its name without ending, against the truth: its pixels, and the frame as a whole."""

    name: str
    path: Path
    pixels: Counts
    frame: Counts


def compare_mask_folders(found: Path, truth: Path, least_px: int = 1) -> MaskScores:
    """Compare the masks that both folders have, together; as `compared_masks`."""
    mine, true = _masks(found), _masks(truth)
    pixels, frames, compared = Counts(), Counts(), 0
    for each in compared_masks(found, truth, least_px):
        pixels, frames, compared = pixels + each.pixels, frames + each.frame, compared + 1
    return MaskScores(
        pixels, frames, compared, len(mine) - compared, len(true) - compared, least_px
    )


def compared_masks(found: Path, truth: Path, least_px: int = 1) -> Iterator[ComparedMask]:
    """Compare the masks that both folders have, paired by their names without ending, numbers by their value.

    A pixel is changed when any of its colours is nonzero; in lossy formats, from 128 on. A found mask that holds 0, 128
    and 255 only is one of ours: there 128 is unknown. Raises InputError for folders without masks or without a common
    name, for masks of different size and for files that are no pictures.
    """
    mine, true = _masks(found), _masks(truth)
    common = sorted(set(mine) & set(true))
    if not common:
        raise InputError(
            f"no mask in {found} has the name of one in {truth} ({_some(mine)}; {_some(true)}); give masks of the same "
            "frames, named alike"
        )
    for name in common:
        changed, unknown = read_mask(mine[name], may_be_unknown=True)
        there, _ = read_mask(true[name], may_be_unknown=False)
        if changed.shape != there.shape:
            sizes = " and ".join(f"{mask.shape[1]}x{mask.shape[0]}" for mask in (changed, there))
            raise InputError(
                f"{mine[name]} and {true[name]} differ in size: {sizes} pixels; give masks of the same pictures"
            )
        yield ComparedMask(
            name,
            mine[name],
            pixel_counts(changed, there, unknown),
            frame_counts(changed, there, unknown, least_px),
        )


def frames_against_times(
    found: Path, is_changed: Callable[[int], bool | None]
) -> Iterator[ComparedMask]:
    """Judge masks of a video's frames where it is only known which frames show a change; None: not judged.

    Masks are named by the numbers of their frames; others are passed over. Pixels are counted where nothing changed.
    Raises InputError as `compared_masks`.
    """
    for name, path in _masks(found).items():
        if not name.isdecimal():
            continue
        there = is_changed(int(name))
        changed, unknown = read_mask(path, may_be_unknown=True)
        pixels, frame = Counts(), Counts(unknown=1)
        if there is not None:
            truth = np.full(changed.shape, there)
            frame = frame_counts(changed, truth, unknown)
            pixels = Counts() if there else pixel_counts(changed, truth, unknown)
        yield ComparedMask(name, path, pixels, frame)


def has_masks(folder: Path) -> bool:
    """Whether the folder holds any picture."""
    return folder.is_dir() and any(path.suffix.lower() in MASK_ENDINGS for path in folder.iterdir())


def _masks(folder: Path) -> dict[str, Path]:
    if not folder.is_dir():
        raise InputError(f"{folder}: no such folder; give a folder of masks, one picture a frame")
    found: dict[str, Path] = {}
    for path in sorted(folder.iterdir()):
        if path.suffix.lower() not in MASK_ENDINGS:
            continue
        name = str(int(path.stem)) if path.stem.isdecimal() else path.stem
        if name in found:
            raise InputError(f"{found[name]} and {path} are masks of one frame; leave one of them")
        found[name] = path
    if not found:
        raise InputError(f"{folder}: no masks in it; give a folder of masks, one picture a frame")
    return found


def _some(masks: dict[str, Path]) -> str:
    names = [path.name for path in list(masks.values())[:2]]
    return f"{', '.join(names)}{' ...' if len(masks) > 2 else ''}"
