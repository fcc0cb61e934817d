"""The folder of a watch: a line for each detection as it is made, places and tracks as GeoJSON, crops of tracks."""

import json
import os
import shutil
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from math import isfinite
from pathlib import Path, PurePath
from typing import Any, Self

import numpy as np

from sorvolo.errors import InputError, StoreError, UnavailableError
from sorvolo.geometry.arrays import BoxesPx, Floats, ImageRGB, Labels, TimesNs
from sorvolo.store.atomic import (
    TEMPORARY_PREFIX,
    atomic_path,
    atomic_write_bytes,
    make_folder,
    remove_leftovers,
    take_lock,
    writing,
)
from sorvolo.store.exports.places import Placemark, longitude_latitude, place_deg
from sorvolo.store.exports.plain import (
    NO_PLACE_FILES,
    feature,
    feature_collection,
    features_name,
    frame_number,
    json_bytes,
    plain_json,
    rounded,
    time_words,
    utc_text,
)
from sorvolo.store.images import jpeg_from_image
from sorvolo.survey.flight import Frame, Site
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections, Sighting, Track

MARK = "watch.json"
"""The file that marks a folder as a watch's, with its source."""

LINES, CROPS = "detections.jsonl", "objects"
DETECTIONS, TRACKS = "detections", "tracks"
"""Collections: .geojson, or .json where nothing places the flight (`features_path`)."""
TRACKS_KML, TRACKS_GPX = "tracks.kml", "tracks.gpx"
ANNOTATED_VIDEO, ANNOTATED_PICTURES, LABELS = "annotated.mp4", "annotated", "labels"

SEARCHED = "searched.geojson"
"""The outlines of the flown ground by what became of it: looked at, too coarse, skipped."""

JOURNAL, REPORT = "run.journal", "report.json"
"""How far a watch is, until it is complete; what it found."""

_LOCK = "watch.lock"
"""Held by the one process that writes into the folder, while it does."""

_OURS = (
    JOURNAL,
    LINES,
    *(
        features_name(name, is_local=is_local)
        for name in (DETECTIONS, TRACKS)
        for is_local in (False, True)
    ),
    TRACKS_KML,
    TRACKS_GPX,
    CROPS,
    ANNOTATED_VIDEO,
    ANNOTATED_PICTURES,
    LABELS,
    REPORT,
    "report.html",
    SEARCHED,
    *(f"under_trees.{ending}" for ending in ("html", "tif", "geojson", "json")),
)
_MADE_BY = "sorvolo watch"
_OF_FIRST_PICTURE = (
    "Nothing places the flight on Earth: coordinates are pixels of the first picture of each segment, x to the right "
    "and y down. " + NO_PLACE_FILES
)


@contextmanager
def claimed_folder(
    folder: Path, source: str, fingerprint: str, *, replaces: bool = True, goes_on: bool = False
) -> Iterator[None]:
    """Make the folder, or empty it of an earlier watch of the very same source, and mark it; nobody else writes into
    it until the end of the block.

    Other files in it stay, and all of a watch that `goes_on`. Raises StoreError for a folder with anything but such a
    watch; without `replaces` (a live stream is never the same twice) for one with any watch that does not go on;
    UnavailableError while another process writes it.
    """
    _refuse_others(folder, source, fingerprint, may_be_there=replaces or goes_on)
    make_folder(folder)
    with _held(folder):
        with writing(folder):
            if goes_on and not replaces:
                # Keep the annotated video of a watch that was killed beside the one that is about
                # to begin.
                cut_off = folder / f"{TEMPORARY_PREFIX}{ANNOTATED_VIDEO}"
                if cut_off.is_file():
                    numbers = (folder / f"annotated-{number}.mp4" for number in range(1, 10_000))
                    cut_off.rename(next(each for each in numbers if not each.exists()))
            remove_leftovers([folder, *(folder / name for name in _OURS)])  # only folders hold any
            for name in () if goes_on else _OURS:
                if (folder / name).is_dir():
                    shutil.rmtree(folder / name)
                else:
                    (folder / name).unlink(missing_ok=True)
        mark = {"made_by": _MADE_BY, "source": source, "fingerprint": fingerprint}
        atomic_write_bytes(folder / MARK, json_bytes(mark))
        yield


def find_watched(folder: Path) -> str | None:
    """The fingerprint of the source whose watch the folder holds, complete or not; None where it holds none."""
    mark = _mark_of(folder)
    return None if mark is None else str(mark.get("fingerprint"))


class DetectionLines:
    """`detections.jsonl`, a JSON object a line; all that was appended can be read, even after a kill."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / LINES
        with writing(self._path):
            self._file = self._path.open("wb")

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def append(self, rows: Iterable[Mapping[str, Any]]) -> None:
        """Write rows and hand them to the operating system. Raises StoreError on a full disk."""
        lines = [
            json.dumps(plain_json(row), ensure_ascii=False, allow_nan=False) + "\n" for row in rows
        ]
        if lines:
            with writing(self._path):
                self._file.write("".join(lines).encode())
                self._file.flush()


def detection_row(
    frame: Frame,
    time_ns: int,
    name: str,
    score: float,
    box_px: Sequence[float],
    sighting: Sighting | None,
    track_id: int | None,
    site: Site,
) -> dict[str, Any]:
    """One detection for `detections.jsonl` (docs/formats.md); without a sighting it has no place on the ground."""
    row: dict[str, Any] = {
        "frame": frame_number(frame.name),
        "time": utc_text(time_ns),
        "class": name,
        "score": rounded(score, 4),
        "box_px": [rounded(edge, 1) for edge in box_px],
        "track": track_id,
    }
    if sighting is not None:
        row |= _place(sighting.position_m, site)
        row |= {
            "sigma_m": rounded(sighting.sigma_m, 3),
            "size_m": [rounded(side, 3) for side in sighting.size_m],
        }
    return row


def write_detections(folder: Path, site: Site) -> int:
    """Make `detections.geojson` of the lines written so far, for a local site `detections.json`; how many there are.

    One point for each detection, without geometry where it has no place on the ground. For a local site coordinates
    are pixels of the first frame and "crs" is null.
    """
    head = _collection(DETECTIONS, [], site)
    del head["features"]
    kind = {} if site.is_local else {"type": "Feature"}
    count = 0
    with (
        (folder / LINES).open(encoding="utf-8") as lines,
        atomic_path(folder / features_name(DETECTIONS, is_local=site.is_local)) as path,
        path.open("w", encoding="utf-8") as file,
    ):
        file.write(json.dumps(head, ensure_ascii=False)[:-1] + ', "features": [\n')
        for line in lines:
            row = json.loads(line)
            each = {**kind, "geometry": _point(row), "properties": row}
            file.write((",\n" if count else "") + json.dumps(each, ensure_ascii=False))
            count += 1
        file.write("\n]}\n")
    return count


def track_properties(track: Track, site: Site) -> dict[str, Any]:
    """What is reported of a track: its properties in the list of tracks, the body of an alert."""
    east, north = track.velocity_m_s
    return {
        "id": track.id,
        "class": track.label,
        "score": rounded(track.score, 4),
        **_place(track.position_m, site),
        "sigma_m": rounded(track.sigma_m, 3),
        "size_m": [rounded(side, 3) for side in track.size_m],
        "first_seen": utc_text(track.first_seen_ns),
        "last_seen": utc_text(track.last_seen_ns),
        "views": track.views,
        "passes": track.passes,
        "moving": track.moving,
        "velocity_m_s": [rounded(east, 3), rounded(north, 3)] if track.moving else None,
        "class_scores": {name: rounded(share, 4) for name, share in track.class_scores.items()},
        "best_frame": frame_number(track.best.frame_name),
        "best_box_px": [rounded(float(edge), 1) for edge in track.best.box_px],
    }


def tracks_collection(
    tracks: Iterable[Track], site: Site, crops: Mapping[int, str]
) -> dict[str, Any]:
    """Confirmed tracks as a GeoJSON FeatureCollection: a point each, its path as a property (docs/formats.md).

    `crops` are the crops' file names by track. For a local site it is plain JSON: coordinates are pixels of the first
    frame and "crs" is null.
    """
    features = []
    for track in tracks:
        properties = track_properties(track, site)
        shown = {
            **properties,
            "crop": crops.get(track.id),
            "path": _path(track.path_m, track.path_ns, site),
        }
        features.append(feature(_point(properties), shown, id=track.id))
    return _collection(TRACKS, features, site)


def track_placemarks(tracks: Iterable[Track], site: Site) -> list[Placemark]:
    """Confirmed tracks as placemarks, each where it was last; the site must have a place on Earth."""
    placemarks = []
    for each in tracks:
        words = (
            f"score {each.score:.2f} (0 to 1), {each.views} views, last seen {time_words(each.last_seen_ns)}\n"
            f"position accuracy {each.sigma_m:.1f} m (1 sigma)"
            + ("\nmoving" if each.moving else "")
        )
        placemarks.append(
            Placemark(
                f"{each.label} {each.id}",
                words,
                *place_deg(each.position_m, site),
                each.last_seen_ns,
            )
        )
    return placemarks


def crop_around(image: ImageRGB, box_px: Iterable[float]) -> ImageRGB:
    """The part of the picture around a box (BoxesPx), wider by 0.6 of its longer side, at least 24 px a side."""
    left, top, right, bottom = (float(edge) for edge in box_px)
    reach_px = max(1.1 * max(right - left, bottom - top), 12.0)
    x, y = (left + right) / 2, (top + bottom) / 2
    height, width = image.shape[:2]
    columns = slice(int(max(0, np.floor(x - reach_px))), int(min(width, np.ceil(x + reach_px))))
    rows = slice(int(max(0, np.floor(y - reach_px))), int(min(height, np.ceil(y + reach_px))))
    return image[rows, columns].copy()


def write_crop(folder: Path, track_id: int, crop: ImageRGB) -> str:
    """Write a track's crop; its file's name within the folder."""
    name = f"{CROPS}/{track_id}.jpg"
    make_folder(folder / CROPS)
    atomic_write_bytes(folder / name, jpeg_from_image(crop), durable=False)
    return name


def written_crop(folder: Path, track_id: int) -> str | None:
    """The file name of a track's crop that is there already, within the folder; None where there is none."""
    name = f"{CROPS}/{track_id}.jpg"
    return name if (folder / name).is_file() else None


def _refuse_others(folder: Path, source: str, fingerprint: str, *, may_be_there: bool) -> None:
    """Raise StoreError for a folder with anything but a watch of this source, which `may_be_there`."""
    if folder.exists() and not folder.is_dir():
        raise StoreError(f"{folder} is a file; choose another folder (--out)")
    if not folder.is_dir() or all(each.name == _LOCK for each in folder.iterdir()):
        return
    earlier = _mark_of(folder)
    if earlier is None:
        raise StoreError(
            f"{folder} is not empty and holds no earlier watch; choose another (--out)"
        )
    if not may_be_there or (earlier.get("source"), earlier.get("fingerprint")) != (
        source,
        fingerprint,
    ):
        raise StoreError(
            f"{folder} holds a watch of {earlier.get('source')}, which stays; choose another folder (--out)"
        )


@contextmanager
def _held(folder: Path) -> Iterator[None]:
    """Keep others from writing into the folder. Raises UnavailableError while another process does."""
    path = folder / _LOCK
    while True:
        with writing(path):
            lock = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o644)
        if not take_lock(lock):
            os.close(lock)
            raise UnavailableError(
                f"another process writes its watch into {folder}; wait until it has ended, or give another folder"
            )
        if path.exists() and os.path.samestat(os.fstat(lock), path.stat()):
            break  # else its former holder removed it meanwhile
        os.close(lock)
    try:
        yield
    finally:
        path.unlink(missing_ok=True)
        os.close(lock)


def _mark_of(folder: Path) -> dict[str, Any] | None:
    """What the folder's mark holds; None where it has none of ours."""
    try:
        mark = json.loads((folder / MARK).read_text(encoding="utf-8"))
    except (OSError, ValueError):
        return None
    return mark if isinstance(mark, dict) and mark.get("made_by") == _MADE_BY else None


def _collection(name: str, features: Sequence[Mapping[str, Any]], site: Site) -> dict[str, Any]:
    return feature_collection(name, features, is_local=site.is_local, note=_OF_FIRST_PICTURE)


def _place(position_m: Floats, site: Site) -> dict[str, Any]:
    if site.is_local:
        return {"x_px": rounded(position_m[0], 2), "y_px": rounded(position_m[1], 2)}
    longitude, latitude = place_deg(position_m, site)
    return {
        "latitude": rounded(latitude, 8),
        "longitude": rounded(longitude, 8),
        "east_m": rounded(position_m[0], 3),
        "north_m": rounded(position_m[1], 3),
    }


def _point(row: Mapping[str, Any]) -> dict[str, Any] | None:
    keys = ("longitude", "latitude") if "longitude" in row else ("x_px", "y_px")
    coordinates = [row.get(key) for key in keys]
    return None if None in coordinates else {"type": "Point", "coordinates": coordinates}


def _path(path_m: Floats, path_ns: TimesNs, site: Site) -> dict[str, Any]:
    points = np.asarray(path_m, dtype=np.float64).reshape(-1, 2)
    if not site.is_local:
        points = np.column_stack(longitude_latitude(points, site))
    return {
        "coordinates": [[round(float(x), 8), round(float(y), 8)] for x, y in points],
        "times": [utc_text(int(time_ns)) for time_ns in path_ns],
    }


def picture_of_detections(
    path: str,
    width_px: int,
    height_px: int,
    group: str,
    detections: Detections,
) -> LabelledPicture:
    """What a detector saw in a picture, as labels to correct and to learn from; scores are not kept."""
    no_regions = np.zeros((0, 4), np.float32)
    return LabelledPicture(
        path,
        width_px,
        height_px,
        group,
        detections.boxes_px,
        np.asarray(detections.labels, np.int64),
        no_regions,
    )


def coco_document(
    labelled: LabelledSet, folder: Path, scores: Sequence[Floats] | None = None
) -> dict[str, Any]:
    """The set as a COCO document for a file in `folder`, to which file names are relative.

    Ids count from 1, categories in the order of the classes. A picture's group is its `flight`, `m_per_px` is added
    where known. An ignored region is a crowd (`iscrowd` 1) of every class. `scores`, an array for each picture, makes
    each box's `score`.
    """
    images: list[dict[str, Any]] = []
    annotations: list[dict[str, Any]] = []
    for index, picture in enumerate(labelled.pictures):
        image: dict[str, Any] = {
            "id": index + 1,
            "file_name": _relative(picture.path, folder),
            "width": picture.width_px,
            "height": picture.height_px,
            "flight": picture.group,
        }
        if isfinite(picture.m_per_px):
            image["m_per_px"] = round(picture.m_per_px, 6)
        images.append(image)
        for row, (box, label) in enumerate(zip(picture.boxes_px, picture.labels)):
            annotation = _annotation(box, int(label), index + 1, 0)
            if scores is not None:
                annotation["score"] = round(float(scores[index][row]), 4)
            annotations.append(annotation)
        for label in range(len(labelled.classes)):
            annotations += [_annotation(box, label, index + 1, 1) for box in picture.ignored_px]
    return {
        "info": {"description": labelled.name},
        "categories": [
            {"id": number, "name": name} for number, name in enumerate(labelled.classes, start=1)
        ],
        "images": images,
        "annotations": [{"id": number, **row} for number, row in enumerate(annotations, start=1)],
    }


def write_coco(path: Path, labelled: LabelledSet, scores: Sequence[Floats] | None = None) -> None:
    """Write `coco_document` to the file `path`, whole or not at all. Raises StoreError on a full disk."""
    make_folder(path.parent)
    atomic_write_bytes(path, json_bytes(coco_document(labelled, path.parent, scores)))


def write_yolo(folder: Path, labelled: LabelledSet) -> int:
    """Write `labels/*.txt`, `classes.txt` and `data.yaml` to `folder`; the number of ignored regions, which YOLO
    cannot express and which are left out.

    Pictures are expected in `folder/images`, where those that lie there already keep their sub-folders; others are
    to be copied there under their own names. A picture without boxes gets an empty file. Raises InputError when two
    pictures would have the same label file, StoreError on a full disk.
    """
    texts: dict[PurePath, str] = {}
    for picture in labelled.pictures:
        place = _place_in_images(picture, folder).with_suffix(".txt")
        if place in texts:
            raise InputError(
                f"two pictures are named {place.stem}, as YOLO's label files cannot be; rename one: {picture.path}"
            )
        texts[place] = yolo_text(
            picture.boxes_px, picture.labels, picture.width_px, picture.height_px
        )
    for place, text in texts.items():
        path = folder / "labels" / place
        make_folder(path.parent)
        atomic_write_bytes(path, text.encode(), durable=False)
    # the two places where tools look for YOLO's class names
    make_folder(folder)
    plain = "".join(f"{name}\n" for name in labelled.classes)
    atomic_write_bytes(folder / "classes.txt", plain.encode(), durable=False)
    quoted = [
        name.replace("'", "''") for name in labelled.classes
    ]  # as YAML's scalars in single quotes
    numbered = [f"  {number}: '{name}'" for number, name in enumerate(quoted)]
    lines = ["path: .", "train: images", "val: images", "names:", *numbered]
    atomic_write_bytes(folder / "data.yaml", ("\n".join(lines) + "\n").encode(), durable=False)
    return sum(len(picture.ignored_px) for picture in labelled.pictures)


def yolo_text(boxes_px: BoxesPx, labels: Labels, width_px: int, height_px: int) -> str:
    """A line for each box, (N, 4): class number, centre x and y, width and height as shares of the picture's."""
    edges = np.asarray(boxes_px, np.float64).reshape(-1, 4) / np.array([width_px, height_px] * 2)
    centres, sides = (edges[:, :2] + edges[:, 2:]) / 2, edges[:, 2:] - edges[:, :2]
    return "".join(
        f"{int(label)} {x:.7f} {y:.7f} {width:.7f} {height:.7f}\n"
        for label, (x, y), (width, height) in zip(labels, centres, sides)
    )


def _annotation(
    box_px: Iterable[float], label: int, image_id: int, is_crowd: int
) -> dict[str, Any]:
    left, top, right, bottom = (float(edge) for edge in box_px)
    width, height = right - left, bottom - top
    return {
        "image_id": image_id,
        "category_id": label + 1,
        "area": round(width * height, 2),
        "iscrowd": is_crowd,
        "bbox": [round(left, 3), round(top, 3), round(width, 3), round(height, 3)],
    }


def _relative(path: str, folder: Path) -> str:
    """The picture's path from the folder, with "/" between; a relative path is taken as from there already."""
    if not Path(path).is_absolute():
        return Path(path).as_posix()
    try:
        return Path(os.path.relpath(path, folder.resolve())).as_posix()
    except ValueError:  # another drive
        return Path(path).as_posix()


def _place_in_images(picture: LabelledPicture, folder: Path) -> PurePath:
    path = Path(picture.path)
    for images in (folder / "images", (folder / "images").resolve(), Path("images")):
        if path.is_relative_to(images):
            return path.relative_to(images)
    return PurePath(path.name)
