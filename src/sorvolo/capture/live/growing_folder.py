"""A folder into which photos come while the drone flies."""

import hashlib
import threading
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator
from math import nan
from pathlib import Path

from sorvolo.capture.decoding import PHOTO_SUFFIXES, is_same_shape, other_size
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.segments import FlightSoFar
from sorvolo.capture.live.telemetry_log import TelemetryLog
from sorvolo.capture.photo_metadata import (
    PhotoMetadata,
    PlaceDoubt,
    doubt_notices,
    read_photo_metadata,
)
from sorvolo.capture.photos import read_picture
from sorvolo.capture.sync import FIX_DELAY_S, PHOTO_TIE
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import Floats, TimesNs, shrunk
from sorvolo.survey.flight import CameraModel, Frame, LostFrame, Notice, Telemetry

_POLL_S = 0.25  # photos are seconds apart; by choice
_ENDS = (b"\xff\xd9", b"IEND")  # of a JPEG, of a PNG
_TAIL_BYTES = 32  # of a file, which hold the mark of its end and what a camera appends; by choice


class GrowingFolder:
    """A flight's photos as they are copied in; fulfils `capture.source.Source`. Made by `open_growing_folder`.

    A photo is taken once its size has stood still between two looks and its end is there, or nothing was added for
    `silent_s`; in the order of names among those that came together. None is skipped. The flight has ended when
    nothing came for `give_up_s`, or when `until` is set.
    """

    kind = "photos"
    is_live = True
    is_reread = is_stream = False
    skipped = 0
    frame_rate_hz = ground_elevation_m = nan
    telemetry_tie, telemetry_sigma_s = PHOTO_TIE, FIX_DELAY_S

    def __init__(self, folder: Path, settings: LiveSettings, until: threading.Event) -> None:
        self._folder, self._settings, self._until = folder, settings, until
        self._closing = threading.Event()
        self._sizes: dict[Path, int] = {}
        self._seen: set[Path] = set()
        self._ready: deque[Path] = deque()
        self._log = TelemetryLog("exif", folder.name)
        self._heard_s = time.monotonic()
        self._count = self._corrupt = self._untimed = 0
        self._doubts: Counter[PlaceDoubt | None] = Counter()
        self._last_ns = -1
        self._first = folder
        self.size_px = (0, 0)
        self.name, self.fingerprint = folder.name, ""
        self.inputs: tuple[str, ...] = (str(folder),)
        self.start_ns, self.start_origin = 0, "the first photo's EXIF, else when it came"
        self.camera: CameraModel = None  # type: ignore[assignment]  # set by `open_growing_folder`
        self.gaps_s: tuple[float, ...] = ()

    @property
    def frame_count(self) -> int:
        """How many photos came so far."""
        return self._count

    @property
    def telemetry(self) -> Telemetry:
        """The positions of the photos so far."""
        return self._log.telemetry()

    @property
    def latest_telemetry(self) -> Telemetry:
        """The same: each photo carries its own."""
        return self.telemetry

    @property
    def telemetry_version(self) -> int:
        """Grows with every sample."""
        return self._log.version

    @property
    def silent_s(self) -> float:
        """How long ago the last photo came."""
        return time.monotonic() - self._heard_s

    @property
    def is_behind(self) -> bool:
        """Whether the next photo is there already, for whoever looks at them is slower than they come."""
        return bool(self._ready)

    def wait_for_first_fixes(self) -> None:
        """The first photo, which was waited for, has its own."""

    def wait_for_telemetry(self, time_ns: int) -> None:
        """Each photo carries its own fix."""

    def samples(self, since: int) -> tuple[TimesNs, Floats]:
        """Positions after the first this many, as `FlightSoFar` has them."""
        return self._log.samples(since)

    def continue_from(self, so_far: FlightSoFar) -> None:
        """Go on with a flight that an earlier process read: its photos are not taken again."""
        self._seen |= {self._folder / name for name in so_far.names}
        self._ready = deque(each for each in self._ready if each.name not in so_far.names)
        self._log.precede(so_far.times_ns, so_far.samples)
        self._count, self._last_ns, self._first = so_far.next_index, so_far.last_ns, self._folder
        self.name, self.fingerprint, self.camera = so_far.name, so_far.fingerprint, so_far.camera
        self.start_ns = so_far.start_ns

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far and survived."""
        return (
            *notice("corrupt_photo", self._corrupt, "damaged photos that could not be decoded: {}"),
            *notice(
                "photo_without_time",
                self._untimed,
                "photos without a time, timed by when they came: {}",
            ),
            *doubt_notices(self._doubts),
        )

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """The wanted photos as they come, numbered from 0; see `Source.frames`."""
        for _, each in self.arrivals(wanted):
            yield each

    def arrivals(
        self, wanted: Callable[[int, int], bool]
    ) -> Iterator[tuple[float, Frame | LostFrame]]:
        """The same as `frames`, each with when it was whole (monotonic clock)."""
        self._heard_s = time.monotonic()
        while not self._is_ended:
            if not self._ready:
                self._look()
            if self._ready:
                self._heard_s = time.monotonic()
                if (taken := self._take(self._ready.popleft(), wanted)) is not None:
                    yield self._heard_s, taken
                continue
            if self.silent_s > self._settings.give_up_s:
                return
            self._closing.wait(_POLL_S)

    def close(self) -> None:
        """End the flight."""
        self._closing.set()

    def first(self) -> tuple[Path, PhotoMetadata]:
        """Wait for the first photo that can be read; `frames` gives it as well, but its place is known from now on.

        Raises InputError when none comes in `first_s`.
        """
        end_s = time.monotonic() + self._settings.first_s
        while time.monotonic() < end_s and not self._is_ended:
            self._look()
            for path in self._ready:
                try:
                    metadata = read_photo_metadata(path)
                except InputError:
                    continue
                self._first = path
                self.start_ns = _time_ns(metadata)
                self._last_ns = self.start_ns - 1
                self._note_place(self.start_ns, metadata)
                self.size_px = metadata.used_size_px
                return path, metadata
            self._closing.wait(_POLL_S)
        raise InputError(
            f"{self._folder}: no photo came within {self._settings.first_s:.0f} s; is it the folder that the photos "
            "are copied into?"
        )

    @property
    def _is_ended(self) -> bool:
        return self._until.is_set() or self._closing.is_set()

    def _look(self) -> None:
        """Note the photos that are whole by now."""
        for path in sorted(self._folder.iterdir()):
            if (
                path.suffix.lower() not in PHOTO_SUFFIXES
                or path.name[0] == "."
                or path in self._seen
            ):
                continue
            state = path.stat()
            size, age_s = state.st_size, time.time() - state.st_mtime
            is_still = size > 0 and self._sizes.get(path) == size
            if is_still and (age_s > self._settings.silent_s or _has_its_end(path)):
                self._seen.add(path)
                self._ready.append(path)
            self._sizes[path] = size

    def _take(self, path: Path, wanted: Callable[[int, int], bool]) -> Frame | LostFrame | None:
        index, self._count = self._count, self._count + 1
        try:
            metadata = read_photo_metadata(path)
        except InputError as error:
            self._corrupt += 1
            self._last_ns += 1
            return LostFrame(index, path.name, self._last_ns, f"corrupt: {error}")
        self._untimed += not (metadata.utc_ns or metadata.local_ns)
        is_first = path == self._first
        time_ns = self._last_ns = max(
            self.start_ns if is_first else _time_ns(metadata), self._last_ns + 1
        )
        if not is_first:
            self._note_place(time_ns, metadata)
        if not wanted(index, time_ns):
            return None
        try:
            image = read_picture(path, reduces=True)
        except (InputError, OSError) as error:
            self._corrupt += 1
            return LostFrame(index, path.name, time_ns, f"corrupt: {error}")
        own_px = image.shape[1], image.shape[0]
        if own_px != self.size_px:
            if not is_same_shape(own_px, self.size_px):
                return LostFrame(index, path.name, time_ns, other_size(own_px, self.size_px))
            image = shrunk(image, self.size_px)
        return Frame(index, path.name, time_ns, image)

    def _note_place(self, time_ns: int, metadata: PhotoMetadata) -> None:
        self._doubts[metadata.place_doubt] += 1
        if metadata.columns:
            self._log.add(time_ns, metadata.columns)


def _time_ns(metadata: PhotoMetadata) -> int:
    return metadata.utc_ns or metadata.local_ns or time.time_ns()


def _has_its_end(path: Path) -> bool:
    with path.open("rb") as file:
        file.seek(max(0, path.stat().st_size - _TAIL_BYTES))
        tail = file.read()
    return any(end in tail for end in _ENDS)


def open_growing_folder(
    folder: Path,
    camera: Callable[[int, int], CameraModel | None],
    guess: Callable[[int, int, PhotoMetadata], CameraModel],
    settings: LiveSettings,
    until: threading.Event,
) -> GrowingFolder:
    """The flight whose photos come into the folder; those that are there already are its first.

    `camera(width, height)` is the camera that was asked for, None where none was: then `guess` makes one of the first
    photo's words. Raises InputError when no photo comes.
    """
    source = GrowingFolder(folder.resolve(), settings, until)
    path, metadata = source.first()
    source.fingerprint = hashlib.sha256(path.read_bytes()).hexdigest()
    source.camera = camera(*source.size_px) or guess(*source.size_px, metadata)
    return source
