"""A folder of photos as a flight: put in order of time, decoded ahead of the consumer, none lost silently."""

import hashlib
import re
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, replace
from enum import Enum, auto
from itertools import pairwise
from pathlib import Path
from statistics import median_low

import numpy as np

from sorvolo.capture.decoding import LARGEST_FRAME_PX, decode_photo, is_same_shape, other_size
from sorvolo.capture.photo_metadata import (
    APART_M,
    PhotoMetadata,
    PlaceDoubt,
    apart_m,
    doubt_notices,
    read_photo_metadata,
)
from sorvolo.capture.photo_positions import read_positions
from sorvolo.capture.telemetry.cleaning import clean, notice
from sorvolo.errors import InputError
from sorvolo.geometry.arrays import ImageRGB, shrunk
from sorvolo.geometry.units import DAY_NS, SECOND_NS
from sorvolo.survey.flight import (
    TELEMETRY_COLUMNS,
    CameraModel,
    Frame,
    LostFrame,
    Notice,
    Telemetry,
    no_telemetry,
)

_LOOK_AHEAD = 1  # photos decoded while one is worked on; each takes tens of megabytes
# that a camera's clock is off its receiver's by more or less; by choice
_SAME_CLOCK_NS = 600 * SECOND_NS
_SAME_DAY_NS = DAY_NS // 2
_STEP_NS = 1_000_000  # between photos of the same second
# between photos that state no time: their order is kept, a second each by choice
_UNTIMED_STEP_NS = 1_000_000_000
_QUARTER_TURN = 6  # EXIF's number for clockwise
# of a photo's beginning and end, by which a copy of it is recognised; by choice
_EDGE_BYTES = 65_536
_ONE_LENS = 1.05  # ratio of focal lengths up to which photos are of one lens; by choice
_NAMED = 5  # photos of another camera, of those that have no common name
_THERMAL_NAME = re.compile(r"(?:_t|^irx?_.*)$", re.IGNORECASE)  # DJI's and Autel's
_EXIF_UTC = "UTC in the photos' EXIF"
_OF_A_PLACE = {
    "latitude_deg",
    "longitude_deg",
    "ellipsoidal_height_m",
    "orthometric_height_m",
    "horizontal_sigma_m",
    "vertical_sigma_m",
}


class PhotoFault(Enum):
    """Why a photo cannot be used."""

    UNREADABLE = auto()
    DUPLICATE = auto()
    OTHER_SIZE = auto()


@dataclass(frozen=True)
class Photo:
    """One photo in its flight's order. `problem` is why it cannot be used, if known without decoding."""

    path: Path
    time_ns: int
    metadata: PhotoMetadata
    problem: str = ""
    fault: PhotoFault | None = None  # the kind of problem


@dataclass(frozen=True, eq=False)
class Album:
    """The photos of one flight in order of time, all times different, at the size that most of them have.

    `typical` is the metadata of the first photo of that size; `start_ns` is 0 where no photo knows its time.
    """

    photos: tuple[Photo, ...]
    width_px: int
    height_px: int
    typical: PhotoMetadata
    telemetry: Telemetry
    start_ns: int
    start_origin: str
    notices: tuple[Notice, ...]


class PhotoSource:
    """A flight's photos as frames; fulfils `capture.source.Source`."""

    kind = "photos"
    frame_rate_hz = ground_elevation_m = float("nan")

    def __init__(
        self,
        name: str,
        fingerprint: str,
        album: Album,
        camera: CameraModel,
        telemetry: Telemetry,
        notices: Sequence[Notice] = (),
    ) -> None:
        self.name, self.fingerprint, self.album = name, fingerprint, album
        self.camera, self.telemetry = camera, telemetry
        self.inputs = tuple(photo.path.name for photo in album.photos)
        self.frame_count = len(album.photos)
        self.start_ns, self.start_origin = album.start_ns, album.start_origin
        self._notices = (*album.notices, *notices)
        self._corrupt: set[int] = set()

    def notices(self) -> tuple[Notice, ...]:
        """What was found so far; complete when `frames` is exhausted."""
        found = notice(
            "corrupt_photo", len(self._corrupt), "damaged photos that could not be decoded: {}"
        )
        return (*self._notices, *found)

    def frames(self, wanted: Callable[[int, int], bool]) -> Iterator[Frame | LostFrame]:
        """Decode the wanted photos in order, one ahead of the consumer in a thread of its own: they are large.

        `wanted(index, time_ns)` is asked before a photo is decoded, hence one photo ahead as well.
        """
        pool = ThreadPoolExecutor(max_workers=1, thread_name_prefix="photos")
        pending: deque[Future[Frame | LostFrame]] = deque()
        try:
            for index, photo in enumerate(self.album.photos):
                if wanted(index, photo.time_ns):
                    pending.append(pool.submit(self._decode, index, photo))
                if len(pending) > _LOOK_AHEAD:
                    yield self._counted(pending.popleft().result())
            while pending:
                yield self._counted(pending.popleft().result())
        finally:
            pool.shutdown(cancel_futures=True)

    def _counted(self, frame: Frame | LostFrame) -> Frame | LostFrame:
        if isinstance(frame, LostFrame) and not self.album.photos[frame.index].problem:
            self._corrupt.add(frame.index)
        return frame

    def _decode(self, index: int, photo: Photo) -> Frame | LostFrame:
        if photo.problem:
            return LostFrame(index, photo.path.name, photo.time_ns, photo.problem)
        try:
            image = decode_photo(photo.path.read_bytes(), photo.path.name, photo.metadata.reduction)
            fitted = _fit(
                image, photo.metadata.orientation, self.album.width_px, self.album.height_px
            )
        except (InputError, OSError) as error:
            return LostFrame(index, photo.path.name, photo.time_ns, f"corrupt: {error}")
        return Frame(index, photo.path.name, photo.time_ns, fitted)


def read_picture(path: Path, *, reduces: bool = False) -> ImageRGB:
    """A picture's pixels as its EXIF orientation wants them shown, 8 bits, RGB.

    `reduces`: the largest JPEGs come at half their size, as a flight's frames do. Raises InputError when the picture is
    missing, damaged or too large.
    """
    metadata = read_photo_metadata(path)
    image = decode_photo(path.read_bytes(), path.name, metadata.reduction if reduces else 1)
    return np.ascontiguousarray(_turn(image, metadata.orientation))


def read_album(
    paths: Sequence[Path], positions: Sequence[Path] = (), *, strict: bool = False
) -> Album:
    """Read every photo's metadata and put the photos in order of time; takes milliseconds a photo.

    Where several lenses, or a thermal and a daylight camera, took them, the photos of the one with the most are the album.
    `positions` are files that place photos by name or number (`read_positions`), which goes before the photos' own; of
    a photo in several the first counts. `strict`: one that cannot be used is an error, no notice. Raises InputError
    when none of the files is a readable picture.
    """
    found = [
        _read(path) for path in sorted(paths, key=lambda path: (_natural(path.stem), path.name))
    ]
    if all(photo.problem for photo in found):
        raise InputError(
            f"none of the {len(found)} pictures can be read; the first: {found[0].problem.removeprefix('corrupt: ')}"
        )
    found, camera_notices = _of_one_camera(found)
    found, place_notices = _placed(found, positions, strict=strict)
    # Sort photos, given by name, by strictly increasing times; and name where the times come
    # from.
    times_ns, start_origin, time_notices = _best_times(found)
    known = [time_ns for time_ns in times_ns if time_ns]
    if known:
        # a photo without a time stands behind its neighbour by name
        previous = known[0]
        for index, time_ns in enumerate(times_ns):
            previous = times_ns[index] = time_ns or previous
    else:
        times_ns = [index * _UNTIMED_STEP_NS for index in range(len(found))]
    ordered = sorted(zip(times_ns, range(len(found))))
    timed: list[Photo] = []
    for time_ns, index in ordered:
        earliest = timed[-1].time_ns + _STEP_NS if timed else time_ns
        timed.append(replace(found[index], time_ns=max(time_ns, earliest)))
    distinct = _mark_duplicates(timed)
    # Width and height that most usable photos have as shown; of equally many the larger.
    sizes = Counter(photo.metadata.used_size_px for photo in distinct if not photo.problem)
    width_px, height_px = max(sizes, key=lambda size: (sizes[size], size[0] * size[1], size))
    photos = [_check_size(photo, width_px, height_px) for photo in distinct]
    typical = next(
        photo.metadata
        for photo in photos
        if not photo.problem and photo.metadata.used_size_px == (width_px, height_px)
    )
    telemetry, gps_notices = _telemetry_of(photos)
    used = [photo.metadata for photo in photos if not photo.problem]
    cameras = {(metadata.make, metadata.model) for metadata in used}
    focal_mm = {metadata.focal_length_mm for metadata in used if metadata.focal_length_mm > 0}
    return Album(
        tuple(photos),
        width_px,
        height_px,
        typical,
        telemetry,
        0 if start_origin.startswith("unknown") else photos[0].time_ns,
        start_origin,
        (
            *camera_notices,
            *place_notices,
            *time_notices,
            *gps_notices,
            *notice(
                "days_apart",
                sum(now.time_ns - then.time_ns > _SAME_DAY_NS for then, now in pairwise(timed)),
                "breaks of more than 12 hours between photos: {}; if these are two flights, or a clock was reset, map each "
                "part from a folder of its own",
            ),
            *notice(
                "duplicate_photo",
                sum(photo.fault is PhotoFault.DUPLICATE for photo in photos),
                "photos that are exact copies of others, not used twice: {}",
            ),
            *notice(
                "unreadable_photo",
                sum(not photo.metadata.width_px for photo in photos),
                "files named like pictures that cannot be read: {}",
            ),
            *_size_notices(photos, used, (width_px, height_px)),
            *notice(
                "unreadable_metadata",
                sum(bool(metadata.unreadable) for metadata in used),
                "photos with damaged EXIF or XMP, which is not used: {}",
            ),
            *notice(
                "mixed_cameras",
                len(cameras) if len(cameras) > 1 else 0,
                "different cameras, mapped as if they were one: {}",
            ),
            *notice(
                "zoom",
                len(focal_mm) if len(focal_mm) > 1 else 0,
                "different focal lengths, mapped as if they were one: {}",
            ),
        ),
    )


def _read(path: Path) -> Photo:
    try:
        return Photo(path, 0, read_photo_metadata(path))
    except InputError as error:
        return Photo(path, 0, PhotoMetadata(0, 0), f"corrupt: {error}", PhotoFault.UNREADABLE)


def _of_one_camera(photos: Sequence[Photo]) -> tuple[list[Photo], list[Notice]]:
    """The photos of the lens and light that took most of them, and notices of each other group with what maps it."""
    groups = _by_light_and_lens(photos)
    if len(groups) < 2:
        return list(photos), []
    most = max(groups, key=len)  # the first of equals
    notices = []
    for group in groups:
        if group is most:
            continue
        names = [photo.path.name for photo in group]
        metadata = group[0].metadata
        light = "thermal" if _is_thermal(group[0]) else "daylight"
        focal_mm = metadata.focal_length_mm
        lens = f", focal length {focal_mm:g} mm" if focal_mm > 0 else ""
        shown = ", ".join(names[:_NAMED]) + (" ..." if names[_NAMED:] else "")
        words = f"photos of another camera than most, left out ({light}{lens}): {{}} ({shown}); "
        notices += notice("other_camera", len(group), words + _way_to_map(group, photos))
    left_out = {photo.path for group in groups if group is not most for photo in group}
    return [photo for photo in photos if photo.path not in left_out], notices


def _by_light_and_lens(photos: Sequence[Photo]) -> list[list[Photo]]:
    """The readable photos of each light and focal length, daylight and wide ones first.

    Lengths are compared as for 35 mm film where all photos of a light state these, else within a camera's model. Those
    that state none are with the first group of their light.
    """
    groups: list[list[Photo]] = []
    for is_thermal in (False, True):
        lit = [each for each in photos if not each.problem and _is_thermal(each) is is_thermal]
        stated = [each for each in lit if each.metadata.focal_length_mm > 0]
        of_film = [each for each in lit if each.metadata.focal_length_35mm > 0]
        is_by_film = len(of_film) == len({each.path for each in (*stated, *of_film)})

        def lens(photo: Photo, by_film: bool = is_by_film) -> tuple[str, float]:
            metadata = photo.metadata
            if by_film:
                return "", metadata.focal_length_35mm
            return metadata.model, metadata.focal_length_mm

        of_light: list[list[Photo]] = []
        for photo in sorted(of_film if is_by_film else stated, key=lens):
            last = lens(of_light[-1][-1]) if of_light else ("", 0.0)
            is_same = last[0] == lens(photo)[0] and lens(photo)[1] <= _ONE_LENS * last[1]
            if is_same:
                of_light[-1].append(photo)
            else:
                of_light.append([photo])
        grouped = {photo.path for group in of_light for photo in group}
        unstated = [photo for photo in lit if photo.path not in grouped]
        if unstated and of_light:
            max(of_light, key=len).extend(unstated)
        elif unstated:
            of_light.append(unstated)
        groups += of_light
    return groups


def _is_thermal(photo: Photo) -> bool:
    return photo.metadata.is_thermal or _THERMAL_NAME.search(photo.path.stem) is not None


def _way_to_map(group: Sequence[Photo], photos: Sequence[Photo]) -> str:
    """What maps a group of photos alone: a pattern of names where one takes these and no other photo."""
    first = group[0].path
    before, _, after = first.name.rpartition("_")
    patterns = [f"*_{after}", f"{first.name.partition('_')[0]}_*"] if before else []
    wanted = {photo.path.name for photo in group}
    for pattern in patterns:
        if {each.path.name for each in photos if each.path.match(pattern)} == wanted:
            return f"`sorvolo map {first.parent / pattern}` maps them, in a site of their own"
    return (
        "move them to a folder of their own, and give that to `sorvolo map` with a site of its own"
    )


def _placed(
    photos: Sequence[Photo], files: Sequence[Path], *, strict: bool
) -> tuple[list[Photo], list[Notice]]:
    """The photos with the positions of files in place of their own, and how many each file places."""
    notices: list[Notice] = []
    placed: dict[str, dict[str, float]] = {}
    by_name = {photo.path.name: photo.metadata for photo in photos}
    for path in files:
        try:
            left = {name: each for name, each in by_name.items() if name not in placed}
            stated, words = read_positions(path, left)
        except InputError as error:
            if strict:
                raise
            notices.append(Notice("unusable_telemetry", 1, f"not used: {error}"))
            continue
        far = sum(
            "latitude_deg" in by_name[name].columns
            and apart_m(by_name[name].columns, columns) > APART_M
            for name, columns in stated.items()
        )
        text = f"photos placed by {path.name}: {{}} of {len(photos)}{words}"
        contradicted = (
            f"photos whose own position is more than 10 m from {path.name}'s, which is taken: {{}}"
        )
        notices += notice("positions_from_file", len(stated), text)
        notices += notice(PlaceDoubt.CONTRADICTED, far, contradicted)
        placed |= stated
    return [
        replace(photo, metadata=_replaced(photo.metadata, placed[photo.path.name]))
        if photo.path.name in placed
        else photo
        for photo in photos
    ], notices


def _replaced(metadata: PhotoMetadata, place: Mapping[str, float]) -> PhotoMetadata:
    """A photo's metadata with another place; its angles and its height above take-off stay its own."""
    own = {name: value for name, value in metadata.columns.items() if name not in _OF_A_PLACE}
    stated = {name: value for name, value in place.items() if np.isfinite(value)}
    return replace(metadata, columns=stated | own, place_doubt=None)


def _natural(name: str) -> list[tuple[int, int, str]]:
    """A sort key under which IMG_2 comes before IMG_10."""
    return [
        (0, int(part), "") if part.isdecimal() else (1, 0, part)
        for part in re.split(r"(\d+)", name.lower())
        if part
    ]


def _best_times(photos: Sequence[Photo]) -> tuple[list[int], str, list[Notice]]:
    """Each photo's UTC, 0 where unknown; where the times come from; and notices."""
    utc_ns = [photo.metadata.utc_ns for photo in photos]
    local_ns = [photo.metadata.local_ns for photo in photos]
    untimed = notice(
        "photo_without_time",
        sum(not (utc or local) for utc, local in zip(utc_ns, local_ns)),
        "photos without a time, placed by their names: {}",
    )
    if any(utc and local for utc, local in zip(utc_ns, local_ns)):
        # the photos' UTC, and how many were moved by a day: some receivers change their
        # date late, not at midnight UTC
        offsets_ns = [
            utc - local if utc and local else None for utc, local in zip(utc_ns, local_ns)
        ]
        # of two dates the right one is nearer to the camera's clock, which is off by its time zone alone
        usual_ns = min((each for each in offsets_ns if each is not None), key=abs)
        mended = []
        for utc, offset_ns in zip(utc_ns, offsets_ns):
            off_ns = 0 if offset_ns is None else offset_ns - usual_ns
            is_a_day = abs(abs(off_ns) - DAY_NS) < _SAME_CLOCK_NS
            mended.append(utc - DAY_NS * (1 if off_ns > 0 else -1) if is_a_day else utc)
        utc_ns, moved = mended, sum(new != old for new, old in zip(mended, utc_ns))
        times_ns, origin = _times_of_two_clocks(utc_ns, local_ns)
        words = "photos whose GPS date is a day off by the camera's clock, set right: {}"
        return times_ns, origin, [*notice("gps_date", moved, words), *untimed]
    if any(utc_ns):
        return utc_ns, _EXIF_UTC, untimed
    if any(local_ns):
        origin = "EXIF time of the camera's clock, its time zone unknown and taken as UTC"
        zone = notice(
            "time_zone_unknown",
            sum(map(bool, local_ns)),
            "photos with the camera's clock but no time zone, taken as UTC: {}",
        )
        return local_ns, origin, [*zone, *untimed]
    return (
        utc_ns,
        "unknown: no photo has a time; they are taken to be one second apart, by name",
        untimed,
    )


def _times_of_two_clocks(utc_ns: list[int], local_ns: list[int]) -> tuple[list[int], str]:
    """UTC of photos that mostly carry it and the camera's own clock as well.

    EXIF's GPS time is that of the receiver's fix: where it stands still from photo to photo and the camera's
    clock does not, the clock is used, set by the median of its difference to the GPS.
    """
    both = list(zip(utc_ns, local_ns))
    offset_ns = median_low([utc - local for utc, local in both if utc and local])
    stands_still = any(
        utc == next_utc != 0 and 0 != local != next_local != 0
        for (utc, local), (next_utc, next_local) in pairwise(both)
    )
    times_ns = [
        local + offset_ns if local and (stands_still or not utc) else utc for utc, local in both
    ]
    return (
        times_ns,
        "the camera's clock, set by the photos' GPS time" if stands_still else _EXIF_UTC,
    )


def _mark_duplicates(photos: Sequence[Photo]) -> list[Photo]:
    """Mark photos whose bytes equal an earlier one's; only files of equal size and ends are read in full."""
    sizes = Counter(photo.path.stat().st_size for photo in photos)
    ends: Counter[tuple[int, bytes]] = Counter()
    keys: dict[Path, tuple[int, bytes]] = {}
    for photo in photos:
        size = photo.path.stat().st_size
        if sizes[size] > 1 and not photo.problem:
            keys[photo.path] = (size, _digest_of_ends(photo.path, size))
            ends[keys[photo.path]] += 1
    first_of: dict[bytes, str] = {}
    marked: list[Photo] = []
    for photo in photos:
        if ends[keys.get(photo.path, (0, b""))] > 1:
            digest = hashlib.sha256(photo.path.read_bytes()).digest()
            original = first_of.setdefault(digest, photo.path.name)
            if original != photo.path.name:
                photo = replace(
                    photo, problem=f"duplicate of {original}", fault=PhotoFault.DUPLICATE
                )
        marked.append(photo)
    return marked


def _digest_of_ends(path: Path, size: int) -> bytes:
    with path.open("rb") as file:
        head = file.read(_EDGE_BYTES)
        file.seek(max(0, size - _EDGE_BYTES))
        return hashlib.sha256(head + file.read(_EDGE_BYTES)).digest()


def _check_size(photo: Photo, width_px: int, height_px: int) -> Photo:
    own_px, flight_px = photo.metadata.used_size_px, (width_px, height_px)
    if photo.problem or own_px[::-1] == flight_px or is_same_shape(own_px, flight_px):
        return photo
    return replace(photo, problem=other_size(own_px, flight_px), fault=PhotoFault.OTHER_SIZE)


def _fit(image: ImageRGB, orientation: int, width_px: int, height_px: int) -> ImageRGB:
    """Apply the EXIF orientation, then turn or resample to the flight's size, which is known to fit."""
    size_px = (width_px, height_px)
    shown = _turn(image, orientation)
    if shown.shape[1::-1] == (height_px, width_px) != size_px:
        # a camera that looks straight down cannot feel what is up: its orientation tag may be wrong
        shown = image if image.shape[1::-1] == size_px else _turn(shown, _QUARTER_TURN)
    if shown.shape[1::-1] != size_px:
        return shrunk(shown, size_px)
    return np.ascontiguousarray(shown, dtype=np.uint8)


def _turn(image: ImageRGB, orientation: int) -> ImageRGB:
    """The picture as EXIF's orientation 1-8 wants it shown."""
    if orientation >= 5:
        image = image.transpose(1, 0, 2)
    if orientation in (2, 3, 6, 7):
        image = image[:, ::-1]
    if orientation in (3, 4, 7, 8):
        image = image[::-1]
    return image


def _telemetry_of(photos: Sequence[Photo]) -> tuple[Telemetry, list[Notice]]:
    """One sample a photo that states its place or attitude, and is no duplicate, at exactly the photo's time."""
    readable = [
        photo
        for photo in photos
        if photo.metadata.width_px and photo.fault is not PhotoFault.DUPLICATE
    ]
    placed = sum("latitude_deg" in photo.metadata.columns for photo in readable)
    doubts = Counter(photo.metadata.place_doubt for photo in readable)
    missing = [
        *notice(
            "photo_without_gps",
            len(readable) - placed - doubts[PlaceDoubt.VOID],
            "photos without a GPS position: {}",
        ),
        *doubt_notices(doubts),
    ]
    if not placed:
        return no_telemetry(), missing
    sampled = [photo for photo in readable if photo.metadata.columns]
    columns = {
        name: [photo.metadata.columns.get(name, np.nan) for photo in sampled]
        for name in TELEMETRY_COLUMNS
    }
    cleaned = clean(
        "exif", sampled[0].path.parent.name, [photo.time_ns for photo in sampled], columns
    )
    if not cleaned.has_fixes:
        return no_telemetry(), [*missing, *cleaned.notices]
    return replace(cleaned, notices=(*missing, *cleaned.notices), is_per_photo=True), []


def _size_notices(
    photos: Sequence[Photo], used: Sequence[PhotoMetadata], size_px: tuple[int, int]
) -> list[Notice]:
    other = [metadata.used_size_px for metadata in used if metadata.used_size_px != size_px]
    turned = other.count(size_px[::-1])
    shown = f"{size_px[0]}x{size_px[1]}"
    return [
        *notice(
            "other_size",
            sum(photo.fault is PhotoFault.OTHER_SIZE for photo in photos),
            f"photos of another shape than the flight's {shown}, not used (map another camera's photos as a flight "
            "of their own): {}",
        ),
        *notice("rotated_photo", turned, "photos that lay across the others, turned by 90 deg: {}"),
        *notice(
            "resized_photo",
            len(other) - turned,
            f"photos of another size, resampled to {shown}: {{}}",
        ),
        *notice(
            "reduced_photo",
            sum(metadata.reduction > 1 for metadata in used),
            f"photos of more than {LARGEST_FRAME_PX // 1_000_000} megapixels, used at half their size: {{}}",
        ),
    ]
