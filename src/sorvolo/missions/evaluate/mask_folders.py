"""Folders of masks, one a frame: ours, a simulation's, or those of a dataset; nonzero is change."""

from dataclasses import dataclass
from pathlib import Path

from sorvolo.change.metrics import Counts, frame_counts, pixel_counts
from sorvolo.errors import InputError
from sorvolo.store.mask_pictures import MASK_ENDINGS, read_mask


@dataclass(frozen=True)
class MaskScores:
    """Found masks against true ones: counts of pixels and of frames, and the masks that only one side has."""

    pixels: Counts
    frames: Counts
    compared: int
    only_found: int
    only_true: int
    least_px: int


def compare_mask_folders(found: Path, truth: Path, least_px: int = 1) -> MaskScores:
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
    pixels, frames = Counts(), Counts()
    for name in common:
        changed, unknown = read_mask(mine[name], may_be_unknown=True)
        there, _ = read_mask(true[name], may_be_unknown=False)
        if changed.shape != there.shape:
            sizes = " and ".join(f"{mask.shape[1]}x{mask.shape[0]}" for mask in (changed, there))
            raise InputError(
                f"{mine[name]} and {true[name]} differ in size: {sizes} pixels; give masks of the same pictures"
            )
        pixels += pixel_counts(changed, there, unknown)
        frames += frame_counts(changed, there, unknown, least_px)
    return MaskScores(pixels, frames, len(common), len(mine) - len(common), len(true) - len(common), least_px)


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
