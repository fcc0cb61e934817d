"""Whether the disk has room for a flight: before the work begins, and while a live flight goes on."""

import shutil
import warnings
from pathlib import Path

from sorvolo.capture.source import LiveSource
from sorvolo.errors import SorvoloWarning, StoreError
from sorvolo.missions.flight.setup import FlightSetup
from sorvolo.store.site.archive import Archive
from sorvolo.survey.wording import counted

# Measured on simulated flights and photos of meadows and beaches
_PICTURE_BYTES_PER_PX = 0.45  # of a key frame's JPEG
_MAP_BYTES_PER_PX = 2.0  # of a key frame, for tiles, mosaic.tif, preview and KMZ at 70 % overlap
_JOURNAL_BYTES = 1.5e6  # of a key frame while the flight is mapped, with what leaves memory
_SURELY = 0.5  # share of the need without which it cannot end well
_ENOUGH = 1.5  # times the need with which it will
_AHEAD = 60  # frames of a live flight that are still to fit: a few minutes


def check_room(
    setup: FlightSetup,
    archive: Archive,
    m_per_px: float | None,
    *,
    keeps_pictures: bool = True,
) -> None:
    """Announce a disk that is too full for a flight's map: pictures no finer than `m_per_px` (None: than their own).

    A comparison (not `keeps_pictures`) needs room for the new version of the map alone, as large as if all its ground
    were new. Raises StoreError where the disk is far too full, and warns where it may be, with the figures.
    """
    camera, count = setup.source.camera.camera, setup.plan.expected
    kept, painted = _frame_bytes(setup, m_per_px)
    need = count * (painted + (kept if keeps_pictures else 0.0))
    mosaic = archive.mosaic_path
    if mosaic.is_file():  # the old one stays until the new one is whole
        need += mosaic.stat().st_size
    free = _free(archive.folder)
    what = "the map of" if keeps_pictures else "the new version of the map after comparing"
    flown = (
        ""
        if isinstance(setup.source, LiveSource) or not keeps_pictures
        else (f" ({counted(count, 'frame')} of {camera.width_px} x {camera.height_px} px)")
    )
    text = (
        f"the disk of {archive.folder} has {_words(free)} free, and {what} {setup.source.name} needs about "
        f"{_words(need)}{flown}"
    )
    if free < _SURELY * need:
        coarser = (
            ", or a coarser map (--gsd)"
            if keeps_pictures
            else ", or do not update the map (--no-update)"
        )
        raise StoreError(f"{text}: free some space, choose another disk{coarser}")
    if free < _ENOUGH * need:
        warnings.warn(f"{text}: it may become full", SorvoloWarning, stacklevel=2)


class LiveRoom:
    """Announces, once, that a disk becomes full while a live flight, whose length nobody knows, goes on."""

    def __init__(
        self,
        setup: FlightSetup,
        folder: Path,
        m_per_px: float | None,
    ) -> None:
        self._name, self._folder = setup.source.name, folder
        self._kept, self._painted = _frame_bytes(setup, m_per_px)
        self._is_announced = not isinstance(setup.source, LiveSource)

    def look(self, frames: int) -> None:
        """Warn where few more frames fit: those taken so far, so many, are still to be painted in full."""
        if self._is_announced:
            return
        free = _free(self._folder)
        more = max(0, int((free - frames * self._painted) / (self._kept + self._painted)))
        if more < _AHEAD:
            self._is_announced = True
            text = (
                f"the disk of {self._folder} has {_words(free)} free: about {counted(more, 'more frame')} of "
                f"{self._name} will fit; free some space, or end the flight's map (Ctrl-C)"
            )
            warnings.warn(text, SorvoloWarning, stacklevel=2)


def _frame_bytes(setup: FlightSetup, m_per_px: float | None) -> tuple[float, float]:
    """What a key frame takes while the flight is mapped, and what its ground takes in the map's files."""
    camera, shrink = setup.source.camera.camera, 1.0
    if m_per_px is not None and setup.usual_height_m > 0:
        shrink = min(1.0, setup.usual_height_m / camera.fx_px / m_per_px)
    pixels = camera.width_px * camera.height_px * shrink**2
    return (
        pixels * _PICTURE_BYTES_PER_PX + _JOURNAL_BYTES,
        pixels * _MAP_BYTES_PER_PX,
    )


def _free(folder: Path) -> int:
    there = folder.absolute()
    return shutil.disk_usage(next(each for each in (there, *there.parents) if each.exists())).free


def _words(size: float) -> str:
    return f"{size / 1e9:.1f} GB" if size >= 1e9 else f"{size / 1e6:.0f} MB"
