"""Whether the disk has room for a flight, before the work begins."""

import shutil
import warnings
from dataclasses import dataclass
from pathlib import Path

from sorvolo.errors import SorvoloWarning, StoreError
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.survey.wording import counted


@dataclass(frozen=True)
class DiskSettings:
    """What a flight needs on the disk, measured on simulated flights and photos of meadows and beaches."""

    picture_bytes_per_px: float = 0.45  # of a key frame's JPEG
    map_bytes_per_px: float = 2.0  # of a key frame, for tiles, mosaic.tif, preview and KMZ at 70 % overlap
    journal_bytes: float = 1.5e6  # of a key frame while the flight is mapped, with what does not stay in memory
    surely: float = 0.5  # share of the need without which it cannot end well
    enough: float = 1.5  # times the need with which it will


def check_room(
    setup: FlightSetup, folder: Path, m_per_px: float | None, settings: DiskSettings = DiskSettings()
) -> None:
    """Announce a disk that is too full for a flight's map: pictures no finer than `m_per_px` (None: than their own).

    Raises StoreError where it is far too full, and warns where it may be, with the figures.
    """
    camera, count = setup.source.camera.camera, setup.plan.expected
    shrink = 1.0
    if m_per_px is not None and setup.usual_height_m > 0:
        shrink = min(1.0, setup.usual_height_m / camera.fx_px / m_per_px)
    pixels = camera.width_px * camera.height_px * shrink**2
    need = count * (pixels * (settings.picture_bytes_per_px + settings.map_bytes_per_px) + settings.journal_bytes)
    free = shutil.disk_usage(_existing(folder)).free
    text = (
        f"the disk of {folder} has {_words(free)} free, and the map of {setup.source.name} needs about {_words(need)} "
        f"({counted(count, 'frame')} of {camera.width_px} x {camera.height_px} px)"
    )
    if free < settings.surely * need:
        raise StoreError(f"{text}: free some space, choose another disk, or a coarser map (--gsd)")
    if free < settings.enough * need:
        warnings.warn(f"{text}: it may become full", SorvoloWarning, stacklevel=2)


def _existing(folder: Path) -> Path:
    """The folder, or the nearest above it that is there."""
    return next(each for each in (folder.absolute(), *folder.absolute().parents) if each.exists())


def _words(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
