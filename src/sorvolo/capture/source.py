"""Inputs as flights: what a mission receives for each video, folder of photos or set of photos."""

import hashlib
import operator
import os
import re
import threading
from collections.abc import Callable, Container, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from types import MappingProxyType
from typing import Any, Protocol

import numpy as np

from sorvolo.build import added
from sorvolo.capture.calibration import camera_from_option, guess_camera, stated_camera
from sorvolo.capture.decoding import PHOTO_SUFFIXES
from sorvolo.capture.live.addresses import (
    ADDRESS_FORMS,
    FollowedPath,
    StreamAddress,
    is_live_address,
    live_address,
    shown_address,
)
from sorvolo.capture.live.growing_folder import GrowingFolder, open_growing_folder
from sorvolo.capture.live.klv_telemetry import FileMetadata, camera_of, read_klv_file
from sorvolo.capture.live.links import LINK_FORMS, is_link
from sorvolo.capture.live.reconnect import LiveSettings
from sorvolo.capture.live.stream import LiveStream, open_stream
from sorvolo.capture.photo_metadata import PhotoMetadata
from sorvolo.capture.photo_positions import is_position_file
from sorvolo.capture.photos import Album, PhotoSource, read_album
from sorvolo.capture.recordings import ChapteredVideo, RecordedVideo, recordings
from sorvolo.capture.telemetry import (
    find_telemetry_beside,
    is_telemetry,
    logs_beside,
    read_telemetry,
    unusable_files_beside,
)
from sorvolo.capture.telemetry.cleaning import notice
from sorvolo.capture.telemetry.gpmf import read_gpmf_file
from sorvolo.capture.video import VIDEO_SUFFIXES, VideoInfo, VideoSource, read_video_info
from sorvolo.capture.video_stream import ONE_FILE
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.camera import Camera
from sorvolo.paths import AnyPath
from sorvolo.survey.flight import CameraModel, Frame, LostFrame, Notice, Telemetry, no_telemetry

_HEAD_BYTES = 262_144  # of a file, by which a flight is recognised again; by choice
_SITE_MARKS = ("site.db", "site-catalogue.json")  # in a folder whose pictures are a map, no photos

LiveSource = LiveStream | GrowingFolder
"""The sources that grow while they are read: their telemetry does, and frames come when they come."""

BetterCamera = Callable[[CameraModel], CameraModel]
"""The camera to use in place of the one that an input or a person gives."""


class Source(Protocol):
    """One flight's frames and telemetry, wherever they come from."""

    @property
    def name(self) -> str:
        """The flight's name, safe as a folder's."""

    @property
    def kind(self) -> str:
        """What the frames come from: "video" or "photos"."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """File names, for the report."""

    @property
    def fingerprint(self) -> str:
        """The same for the same flight, though it grows or its telemetry is mended; another for another of its name."""

    @property
    def camera(self) -> CameraModel:
        """The camera of the frames as delivered."""

    @property
    def telemetry(self) -> Telemetry:
        """The flight's telemetry; `no_telemetry()` when there is none."""

    @property
    def frame_count(self) -> int:
        """How many frames to expect; an estimate for videos."""

    @property
    def frame_rate_hz(self) -> float:
        """Frames a second; NaN for photos."""

    @property
    def start_ns(self) -> int:
        """UTC of the first frame as the input states it; 0 if unknown."""

    @property
    def start_origin(self) -> str:
        """Where `start_ns` comes from, in words."""

    @property
    def ground_elevation_m(self) -> float:
        """The ground's height in the telemetry's own height reference, where the input states it; else NaN."""

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far and survived; complete when `frames` is exhausted. Telemetry has its own."""

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """The frames, in order, for which `wanted(index, time_ns)`, asked before the costly part, is true."""


def open_sources(
    inputs: Sequence[Path | str],
    telemetry: Path | str | None = None,
    camera: Path | str | None = None,
    known: Mapping[str, str] = MappingProxyType({}),
    *,
    live: LiveSettings = LiveSettings(),
    until: threading.Event | None = None,
    better_camera: BetterCamera | None = None,
) -> list[Source]:
    """Each video, each folder of photos, all photos given one by one together, and each live source, as a flight.

    Live sources are addresses (rtsp://, rtmp://, udp://, tcp:// ...), `webcam:0`, and `follow:PATH` for a video or a
    folder of photos that is being written; they are read from now on, with the settings `live`, until they end or
    `until` is set. `telemetry` belongs to the only flight. Without it, a video's is looked for inside and beside it;
    photos' is in them or beside them (positions by photo, the only log); beside a live source it is a link to a
    receiver (serial:, tcp://, udp://, follow:LOG). `camera` is a calibration file or what else `--camera` takes
    (capture.calibration). `known` are the site's flights, name to fingerprint: another flight of the same name (cards
    are numbered anew) gets a name of its own. `better_camera` gives the camera to use instead of the one of the input
    or of `camera`.
    Raises InputError for what cannot be read, naming the file and what to do.
    """
    flights_of = {each: _given(each) for each in inputs}
    given = [flight for flight in flights_of.values() if flight is not None]
    inputs = [each for each, flight in flights_of.items() if flight is None]
    if not inputs and not given:
        raise InputError(
            "no input; give a video file, a folder of photos, photos, or a live stream's address"
        )
    if given and not (telemetry is None and camera is None):
        raise InputError(
            f"{given[0].name}: --telemetry or --camera was given for frames that have their own; give them to `frames`"
        )
    demand_inputs(inputs)
    addresses = [live_address(text) for text in map(str, inputs) if is_live_address(text)]
    recorded = [Path(each) for each in inputs if not is_live_address(str(each))]
    videos, albums = _sort_inputs(recorded)
    # each flight's name; with the folder before it where two are the same: cards are
    # numbered anew
    places = [*(each.chapters[0].resolve() for each in videos), *(album.place for album in albums)]
    names = [safe_name(place.name if place.is_dir() else place.stem) for place in places]
    names = [
        safe_name(f"{place.parent.name}_{name}") if names.count(name) > 1 else name
        for name, place in zip(names, places)
    ]
    if twice := [name for name in names if names.count(name) > 1]:
        raise InputError(
            f"two flights would be named {twice[0]}; rename one, or map them one by one"
        )
    # Raises InputError where telemetry was given for more than one flight.
    flights = len(names) + len(addresses) + len(given)
    if telemetry is not None and flights > 1:
        raise InputError(
            f"one telemetry file for {flights} flights; map the flights one by one, or put each telemetry file beside "
            "its video under the same name"
        )
    log = _telemetry_file(telemetry, is_live=bool(addresses))
    sources: list[VideoSource | PhotoSource | LiveSource | GivenFrames] = [
        *given,
        *(_open_recording(each, name, log, camera) for each, name in zip(videos, names)),
        *(
            _open_photos(album, name, log, camera)
            for album, name in zip(albums, names[len(videos) :])
        ),
        *(
            _open_live(address, telemetry, camera, live, until or threading.Event())
            for address in addresses
        ),
    ]
    # names that are safe as folders and no other flight has, by their fingerprints
    taken = dict(known)
    for each in sources:
        each.name = _free_name(safe_name(each.name), each.fingerprint, taken)
        taken[each.name] = each.fingerprint
    if better_camera is not None:
        for each in sources:
            each.camera = better_camera(each.camera)
    return list(sources)


def _given(one: Any) -> "GivenFrames | None":
    """The flight that an input is, or that a package reads from its address "NAME:REST"."""
    if isinstance(one, GivenFrames):
        return one
    name, colon, rest = str(one).partition(":")
    if not colon or Path(str(one)).exists():
        return None
    load = added("sources").get(name)
    return load()(rest) if load else None


class GivenFrames:
    """A flight of pictures that a program gives; fulfils `Source`. Made by `frames`."""

    kind = "video"
    inputs = ()
    start_origin = "the given frames' times"
    ground_elevation_m = float("nan")

    def __init__(
        self,
        name: str,
        pictures: Sequence[tuple[int, ImageRGB]],
        camera: CameraModel,
        telemetry: Telemetry,
    ) -> None:
        self.name, self._pictures = name, pictures
        self.camera, self.telemetry = camera, telemetry
        self.frame_count, self.start_ns = len(pictures), pictures[0][0]
        last_ns = pictures[-1][0]
        self.frame_rate_hz = 1e9 * (len(pictures) - 1) / max(1, last_ns - self.start_ns)
        digest = hashlib.sha256()
        for time_ns, image in pictures:
            digest.update(time_ns.to_bytes(8, "little", signed=True) + image.tobytes())
        self.fingerprint = digest.hexdigest()

    def notices(self) -> tuple[Notice, ...]:
        """None: whatever was lost, was lost before."""
        return ()

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """See `Source.frames`."""
        for index, (time_ns, image) in enumerate(self._pictures):
            if wanted(index, time_ns):
                yield Frame(index, str(index), time_ns, image)


def frames(
    pictures: Iterable[tuple[int, ImageRGB]],
    *,
    camera: AnyPath | CameraModel | None = None,
    telemetry: AnyPath | Telemetry | None = None,
    name: str = "frames",
) -> GivenFrames:
    """A flight of pictures in memory, to be given in place of a file: each with its time, UTC in nanoseconds.

    Pictures are RGB uint8 (H, W, 3) of one size, in order of time; all are kept until the flight is done with. `camera`
    is what `map_flights` takes, or a CameraModel; `telemetry` a file, or a Telemetry. Raises InputError.

    Example: `map_flights(frames([(time_ns, image), ...], camera="aov=78.8", telemetry="log.csv"), "site")`
    """
    try:
        kept = [
            (operator.index(time_ns), np.ascontiguousarray(image)) for time_ns, image in pictures
        ]
    except (TypeError, ValueError) as error:  # seconds among them, which would be cut to whole ones
        raise InputError(
            f"{name}: {error}; give pairs of a time, whole nanoseconds, and a picture"
        ) from error
    sizes = {image.shape for _, image in kept}
    if any(each.dtype != np.uint8 for _, each in kept) or {(*s[:2], 3) for s in sizes} != sizes:
        raise InputError(f"{name}: the frames are no RGB pictures: give uint8 (height, width, 3)")
    if len(kept) < 2 or len(sizes) > 1:
        raise InputError(
            f"{name}: {len(kept)} frames of {len(sizes)} sizes; give two or more, of one size"
        )
    if any(after[0] <= before[0] for before, after in pairwise(kept)):
        raise InputError(f"{name}: the frames' times do not increase; give each its own, in order")
    height, width = kept[0][1].shape[:2]
    if not isinstance(camera, CameraModel):
        camera = (
            _unknown_camera(width, height)
            if camera is None
            else camera_from_option(os.fspath(camera), width, height)
        )
    if telemetry is None:
        telemetry = no_telemetry()
    elif not isinstance(telemetry, Telemetry):
        telemetry = read_telemetry(Path(telemetry))
    return GivenFrames(name, kept, camera, telemetry)


def demand_inputs(inputs: Iterable[Any]) -> None:
    """Raise InputError for an input that is neither there, nor a live source's address, nor a package's or a program's."""
    for given in (each for each in inputs if not isinstance(each, GivenFrames)):
        if not isinstance(given, str | os.PathLike):
            raise InputError(
                f"a {type(given).__name__} is no input; give a path, an address or `sorvolo.frames`"
            )
        text = str(given)
        is_there = text and (Path(text).is_file() or Path(text).is_dir())
        if not (is_there or is_live_address(text) or text.partition(":")[0] in added("sources")):
            raise InputError(_nothing_at(text))


@contextmanager
def opened_sources(
    inputs: Sequence[Path | str],
    telemetry: Path | str | None = None,
    camera: Path | str | None = None,
    known: Mapping[str, str] = MappingProxyType({}),
    *,
    live: LiveSettings = LiveSettings(),
    until: threading.Event | None = None,
    better_camera: BetterCamera | None = None,
) -> Iterator[list[Source]]:
    """The same as `open_sources`; live sources are closed at the end, however it comes."""
    sources = open_sources(
        inputs, telemetry, camera, known, live=live, until=until, better_camera=better_camera
    )
    try:
        yield sources
    finally:
        for each in sources:
            if isinstance(each, LiveSource):
                each.close()


def safe_name(text: str) -> str:
    """The text with all but letters, digits, dot, dash and underscore replaced, never empty nor hidden."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", text).strip("._") or "flight"


@dataclass(frozen=True)
class _AlbumInput:
    """The photos of one flight; `place`, a folder or photo, names it; `others` are the folder's other files."""

    place: Path
    photos: Sequence[Path]
    others: Sequence[Path] = ()


def _sort_inputs(inputs: Sequence[Path]) -> tuple[list[RecordedVideo], list[_AlbumInput]]:
    """The recordings and the albums among the inputs."""
    found: list[RecordedVideo] = []
    videos: list[Path] = []
    albums: list[_AlbumInput] = []
    single: list[Path] = []
    for path in dict.fromkeys(inputs):
        if path.is_dir():
            films, album = _flights_in(path)
            found += recordings(films)
            albums += album
        else:
            (single if path.suffix.lower() in PHOTO_SUFFIXES else videos).append(path)
    found += recordings(videos, with_siblings=True)
    if single:
        place = single[0].resolve() if len(single) == 1 else single[0].resolve().parent
        albums.append(_AlbumInput(place, single))
    pictures = [*(path for each in found for path in each.chapters)]
    pictures += [path for each in albums for path in each.photos]
    for path in pictures:
        if path.name != path.name.encode(errors="ignore").decode():
            raise InputError(
                f"{str(path)!a}: a name that is not UTF-8, as from an old disk or zip; rename it"
            )
    return found, albums


def _flights_in(folder: Path) -> tuple[list[Path], list[_AlbumInput]]:
    """A folder's photos as one album, or, where it has none, its videos."""
    if mark := next((name for name in _SITE_MARKS if (folder / name).is_file()), None):
        raise InputError(
            f"{folder}: a site folder (it has {mark}), no flight; give the flight's video or photos (map and "
            "compare take the site as --site)"
        )
    files = [each for each in sorted(folder.iterdir()) if each.is_file() and each.name[0] != "."]
    if photos := _of_kind(files, PHOTO_SUFFIXES):
        others = [each for each in files if each not in set(photos)]
        return [], [_AlbumInput(folder.resolve(), photos, others)]
    if films := _of_kind(files, VIDEO_SUFFIXES):
        return films, []
    raise InputError(_nothing_in(folder, len(files)))


def _of_kind(files: Iterable[Path], suffixes: Container[str]) -> list[Path]:
    return [each for each in files if each.suffix.lower() in suffixes]


def _nothing_at(text: str) -> str:
    """What to do about an input that is neither there nor a live source's address."""
    if is_link(text):
        return f"{text}: a receiver gives telemetry, but no pictures; give it as --telemetry beside a live source"
    if re.match("[a-z][a-z0-9+.-]+:", text, re.IGNORECASE):
        return f"{shown_address(text)}: no such file, and no address that is known; give {ADDRESS_FORMS}"
    return (
        f"no such file or folder: {text or '(nothing)'}; a video, a folder of photos, photos, or a live source was needed "
        f"({ADDRESS_FORMS})"
    )


def _nothing_in(folder: Path, files: int) -> str:
    folders = sorted(
        each.name for each in folder.iterdir() if each.is_dir() and each.name[0] != "."
    )
    hint = (
        f"it has folders: name the one with the pictures ({', '.join(folders[:5])})"
        if folders
        else ("name the folder that has them, or a video file")
    )
    wanted = ", ".join(sorted(PHOTO_SUFFIXES))
    return (
        f"{folder} holds no pictures or videos among {files} files ({wanted} are pictures); {hint}"
    )


def _free_name(name: str, fingerprint: str, taken: Mapping[str, str]) -> str:
    """The name, or the name and a number where another flight has it."""
    candidates = [name, *(f"{name}-{number}" for number in range(2, len(taken) + 3))]
    return next(each for each in candidates if taken.get(each, fingerprint) == fingerprint)


def _open_recording(
    recording: RecordedVideo, name: str, telemetry: Path | None, camera: Path | str | None
) -> VideoSource:
    same = [*recording.chapters, *recording.copies]
    opened = [_open_video(path, name, telemetry, camera, same) for path in recording.chapters]
    source = first = opened[0]
    first.note(*recording.notices)
    if len(opened) > 1:
        source = ChapteredVideo(name, opened, has_own_logs=telemetry is None)
        source.ground_elevation_m = first.ground_elevation_m
    source.start_doubt = recording.start_doubt
    return source


def _open_video(
    path: Path,
    name: str,
    telemetry: Path | None,
    camera: Path | str | None,
    same_flight: Sequence[Path],
) -> VideoSource:
    try:
        info = read_video_info(path)
    except InputError as error:
        if is_telemetry(path):
            raise InputError(
                f"{path}: a telemetry file, no video or photo; give the flight's video or photos, and this file as "
                "--telemetry"
            ) from error
        raise
    inside = _metadata_inside(path, info.container)
    found, notices = _video_telemetry(path, telemetry, inside, same_flight)
    stated = (
        None
        if inside is None or inside.lens is None
        else camera_of(inside.lens, info.width_px, info.height_px)
    )
    camera = camera or _camera_beside(path.parent)
    if camera is None:
        model = stated or _video_camera(info)
    else:
        model = camera_from_option(str(camera), info.width_px, info.height_px)
    if info.has_dji_track and not found.has_fixes:
        words = (
            f"{path.name} holds DJI's telemetry track (djmd), which is not read; switch on the drone's video subtitles "
            "(.SRT), or give the flight's log as --telemetry"
        )
        notices = [*notices, Notice("unread_track", 1, words)]
    source = VideoSource(name, _fingerprint(path), info, model, found, notices)
    if inside is not None and found is inside.telemetry:
        source.ground_elevation_m = inside.ground_elevation_m
    return source


def _camera_beside(folder: Path) -> Path | None:
    """The calibration that lies with a flight, `camera.xml` in its folder."""
    path = folder / "camera.xml"
    return path if path.is_file() else None


def _metadata_inside(path: Path, container: str) -> FileMetadata | None:
    """The telemetry within the video: MISB ST 0601 in MPEG-TS, GoPro's GPMF in MP4; None where there is none."""
    if container == "mpegts":
        return read_klv_file(path)
    telemetry = read_gpmf_file(path) if container == "mov" else None
    return None if telemetry is None else FileMetadata(telemetry, None, float("nan"))


def _telemetry_file(telemetry: Path | str | None, *, is_live: bool) -> Path | None:
    """The log that was named; None where none was, or a link beside a live source."""
    if telemetry is None:
        return None
    if is_link(str(telemetry)) != is_live:
        raise InputError(
            f"--telemetry {telemetry}: a live source takes its telemetry from a receiver that is on: give {LINK_FORMS}"
            if is_live
            else f"--telemetry {telemetry}: a recorded flight's telemetry is a file"
        )
    return None if is_live else Path(telemetry)


def _open_live(
    address: StreamAddress | FollowedPath,
    telemetry: Path | str | None,
    camera: Path | str | None,
    settings: LiveSettings,
    until: threading.Event,
) -> LiveSource:
    def chosen(width_px: int, height_px: int) -> CameraModel | None:
        return None if camera is None else camera_from_option(str(camera), width_px, height_px)

    link = None if telemetry is None else str(telemetry)
    if isinstance(address, StreamAddress):
        return open_stream(address, link, chosen, _unknown_camera, settings, until)
    if address.path.is_dir():
        if link is not None:
            raise InputError(f"--telemetry {link}: photos carry their own fixes; leave it out")
        return open_growing_folder(address.path, chosen, _guess, settings, until)
    followed = StreamAddress(str(address.path), address.path.name, None, ONE_FILE)
    return open_stream(followed, link, chosen, _unknown_camera, settings, until, address.path)


def _unknown_camera(width_px: int, height_px: int) -> CameraModel:
    return _guess(width_px, height_px, PhotoMetadata(0, 0))


def _open_photos(
    source: _AlbumInput, name: str, telemetry: Path | None, camera: Path | str | None
) -> PhotoSource:
    folder = source.place if source.place.is_dir() else source.place.parent
    if telemetry is None:
        beside = [each for each in sorted(folder.iterdir()) if is_position_file(each)]
        positions, log = sorted(beside, key=lambda each: each.suffix.lower() == ".mrk"), None
    else:
        positions, log = ([telemetry], None) if is_position_file(telemetry) else ([], telemetry)
    album = read_album(source.photos, positions, strict=telemetry is not None)
    found, notices = _photo_telemetry(folder, album, log)
    if found is not album.telemetry:  # a log needs no positions in the photos
        kept = [each for each in album.notices if each.code != "photo_without_gps"]
        album = replace(album, notices=tuple(kept))
    camera = camera or _camera_beside(folder)
    if camera is None:
        model = _guess(album.width_px, album.height_px, album.typical)
    else:
        model = camera_from_option(str(camera), album.width_px, album.height_px)
    known = {*positions, *logs_beside(folder)}
    ignored = [each.name for each in source.others if folder / each.name not in known]
    notices += notice(
        "ignored_file",
        len(ignored),
        f"files in the folder that are no photos, ignored: {{}} ({', '.join(ignored[:5])})",
    )
    fingerprint = _fingerprint(min(photo.path for photo in album.photos))
    return PhotoSource(name, fingerprint, album, model, found, notices)


def _photo_telemetry(
    folder: Path, album: Album, telemetry: Path | None
) -> tuple[Telemetry, list[Notice]]:
    """The telemetry that was named, else the photos' own, else that of the only log in their folder; and notices of logs
    that are not used, each with what to do."""
    if telemetry is not None:
        return read_telemetry(telemetry), []
    logs = logs_beside(folder)
    beside = find_telemetry_beside(folder)
    if album.telemetry.has_fixes:
        why = "the photos have positions of their own"
    elif beside is None:
        why = "it is not clear which is the flight's"
    elif not album.start_ns:
        why = "the photos state no time, by which they would be found in it"
    else:
        try:
            found = read_telemetry(beside)
            words = f"the photos are placed by {beside.name}, the only log in their folder"
            return found, [Notice("log_in_folder", 1, words)]
        except InputError as error:
            return album.telemetry, [Notice("unusable_telemetry", 1, f"not used: {error}")]
    return album.telemetry, _unused(logs, why)


def _unused(logs: Sequence[Path], why: str) -> list[Notice]:
    names = ", ".join(each.name for each in logs[:5])
    text = f"logs beside the pictures that are not used ({why}): {names}; give one as --telemetry to use it"
    return notice("unused_telemetry", len(logs), text)


def _video_telemetry(
    video: Path,
    telemetry: Path | None,
    inside: FileMetadata | None,
    same_flight: Sequence[Path],
) -> tuple[Telemetry, list[Notice]]:
    """The telemetry, and notices of files that cannot be used; only a file that was asked for must be readable."""
    if telemetry is not None:
        return read_telemetry(telemetry), []
    if inside is not None and inside.telemetry.has_fixes:
        beside = find_telemetry_beside(video, same_flight)
        why = "the telemetry inside the video is"
        return inside.telemetry, [] if beside is None else _unused([beside], why)
    notices = [_not_used(each) for each in unusable_files_beside(video)]
    beside = find_telemetry_beside(video, same_flight)
    if beside is None:
        why = "it is not clear which is the flight's"
        return no_telemetry(), [*notices, *_unused(logs_beside(video), why)]
    more = [each for each in logs_beside(video) if each != beside]
    notices += _unused(more, f"{beside.name} is")
    try:
        return read_telemetry(beside), notices
    except InputError as error:
        text = f"the telemetry file beside the video cannot be used: {error}"
        return no_telemetry(), [*notices, Notice("unusable_telemetry", 1, text)]


def _not_used(beside: Path) -> Notice:
    """A file named as the video's telemetry that is none."""
    if beside.stat().st_size == 0:
        text = f"{beside.name} beside the video is empty (0 bytes) and not used; copy it from the drone again"
        return Notice("empty_telemetry", 1, text)
    try:
        beside.open("rb").close()
    except OSError as error:
        text = f"{beside.name} beside the video cannot be read and is not used: {error.strerror}"
        return Notice("unusable_telemetry", 1, text)
    text = f"{beside.name} beside the video is of no known telemetry format and not used"
    return Notice("unknown_telemetry", 1, text)


def _video_camera(info: VideoInfo) -> CameraModel:
    # pixels that are not square: the guess is made for the picture as shown
    shown_width_px = max(1, round(info.width_px * info.pixel_aspect))
    words = PhotoMetadata(0, 0, make=info.make, model=info.model)
    model = _guess(shown_width_px, info.height_px, words)
    return CameraModel(
        model.camera.resized(info.width_px, info.height_px), model.origin, model.focal_sigma
    )


def _guess(width_px: int, height_px: int, words: PhotoMetadata) -> CameraModel:
    """The lens that a photo states, else the guess; sensors lie, so for pictures that stand it is made lying."""
    if (
        width_px >= height_px
        and (stated := stated_camera(words.lens, width_px, height_px)) is not None
    ):
        return stated
    model = guess_camera(
        max(width_px, height_px),
        min(width_px, height_px),
        make=words.make,
        model=words.model,
        focal_length_mm=words.focal_length_mm,
        focal_length_35mm=words.focal_length_35mm,
        focal_plane_px_per_mm=words.focal_plane_px_per_mm,
        full_width_px=words.full_width_px,
    )
    lying = model.camera
    if width_px >= height_px:
        return model
    k1, k2, p1, p2, k3 = lying.distortion
    standing = Camera(
        width_px,
        height_px,
        lying.fy_px,
        lying.fx_px,
        lying.cy_px,
        lying.cx_px,
        np.array([k1, k2, p2, p1, k3]),
    )
    return CameraModel(standing, model.origin, model.focal_sigma)


def _fingerprint(first: Path) -> str:
    """How the flight's first file begins: pictures that differ, or the times in a video's header."""
    with first.open("rb") as file:
        return hashlib.sha256(file.read(_HEAD_BYTES)).hexdigest()
