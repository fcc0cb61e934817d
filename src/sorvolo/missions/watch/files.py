"""What a watch writes while it runs: lines, crops, annotated frames and labels, in a thread beside the detector."""

import queue
import threading
import time
from bisect import bisect
from collections import OrderedDict
from collections.abc import Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from sorvolo.geometry.arrays import Floats, ImageRGB
from sorvolo.missions.watch.announced import SightingKey, sighting_key
from sorvolo.missions.watch.settings import WatchOutputs
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.annotated import AnnotatedVideo, annotated, write_annotated
from sorvolo.store.exports.detection_files import (
    ANNOTATED_PICTURES,
    ANNOTATED_VIDEO,
    CROPS,
    LABELS,
    TRACKS,
    TRACKS_GPX,
    TRACKS_KML,
    DetectionLines,
    crop_around,
    detection_row,
    picture_of_detections,
    track_placemarks,
    tracks_collection,
    write_coco,
    write_crop,
    write_yolo,
    written_crop,
)
from sorvolo.store.exports.places import gpx_bytes, kml_bytes
from sorvolo.store.exports.plain import features_name, geojson_bytes
from sorvolo.store.images import jpeg_from_image
from sorvolo.survey.flight import Frame, Site
from sorvolo.survey.labels import LabelledPicture, LabelledSet
from sorvolo.survey.objects import Detections, Sighting, Track
from sorvolo.tracking.followed import without_doubles

_MOST_WAITING = 4  # frames; a disk that is slower than the detector slows the watch, it does not fill the memory
_TRACKS_EVERY_S = 5.0  # the file is whole each time and grows; by choice
_LABELS_EVERY_NS = 1_000_000_000  # frames nearer in time show the same again
_CROPS_BYTES = 96_000_000  # of the tracks' best sightings, where there are very many tracks


@dataclass(frozen=True, eq=False)
class SeenFrame:
    """One searched frame: what was seen, where, and by which track it was taken (0: by none)."""

    frame: Frame
    time_ns: int
    detections: Detections
    sightings: Sequence[Sighting | None]  # one for each detection
    track_ids: Sequence[int]  # one for each detection
    confirmed: frozenset[int]
    headline: str
    segment: int  # of a flight that is followed in the picture, 0 on the ground


class WatchFiles:
    """The folder of one watch while it grows. A context manager; leaving it closes every file."""

    def __init__(self, folder: Path, outputs: WatchOutputs, site: Site) -> None:
        self.folder = folder
        self._outputs, self._site = outputs, site
        self._crops: OrderedDict[SightingKey, ImageRGB] = OrderedDict()
        self._best: dict[int, Sighting] = {}
        self.crop_names: dict[int, str] = {}
        self.segments: dict[int, int] = {}  # by track
        self._shown_s = time.monotonic()
        self._labelled: list[tuple[LabelledPicture, Floats]] = []
        self._classes: tuple[str, ...] = ()
        self._labelled_ns: list[int] = []  # rising
        self._queue: queue.Queue[SeenFrame | None] = queue.Queue(_MOST_WAITING)
        self._error: BaseException | None = None
        self._stack = ExitStack()
        self._lines = self._stack.enter_context(DetectionLines(folder))
        self._video = (
            self._stack.enter_context(AnnotatedVideo(folder / ANNOTATED_VIDEO))
            if outputs.save == "video"
            else None
        )
        self.seconds = 0.0
        self._thread = threading.Thread(target=self._run, name="watch files", daemon=True)
        self._thread.start()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def add(self, seen: SeenFrame) -> None:
        """Write one frame's part soon; of one whose picture is gone, what does without it.

        Raises what went wrong with an earlier one (StoreError on a full disk).
        """
        self._raise_earlier()
        self.segments |= dict.fromkeys(seen.track_ids, seen.segment)
        for sighting in seen.sightings if seen.frame.image.size else ():
            if sighting is not None:
                self._keep_crop(sighting, crop_around(seen.frame.image, sighting.box_px))
        self._queue.put(seen)

    def crop_of(self, track: Track) -> str | None:
        """Write the crop of the track's best view if that is new; its file's name within the folder.

        Where the view's picture is gone, the crop is the one that was written when it was there.
        """
        if self._best.get(track.id) is not track.best:
            crop = self._crops.get(sighting_key(track.best))
            name = (
                written_crop(self.folder, track.id)
                if crop is None
                else write_crop(self.folder, track.id, crop)
            )
            if name is not None:
                self.crop_names[track.id] = name
                self._best[track.id] = track.best
        return self.crop_names.get(track.id)

    def keep_crops_of(self, tracks: Iterable[Track]) -> None:
        """Of the crops in memory keep those of all these tracks' best views; no other can become a track's best."""
        best = {sighting_key(track.best) for track in tracks}
        self._crops = OrderedDict((key, crop) for key, crop in self._crops.items() if key in best)

    def forget(self, track_ids: Iterable[int]) -> None:
        """The crops of tracks that turned out to be others belong to nothing any more; `clear` removes them."""
        for each in track_ids:
            self.crop_names.pop(each, None)

    def clear(self) -> None:
        """Remove the crops of no track, a killed watch's too; not earlier: who received an alert may still look at them."""
        kept = set(self.crop_names.values())
        for path in (self.folder / CROPS).glob("*.jpg"):
            if f"{CROPS}/{path.name}" not in kept:
                path.unlink(missing_ok=True)

    def show(self, tracks: Iterable[Track]) -> None:
        """Bring the list of tracks up to date, unless that was done within the last seconds."""
        if time.monotonic() - self._shown_s >= _TRACKS_EVERY_S:
            self._shown_s = time.monotonic()
            self.write_tracks(tracks)

    def write_tracks(self, tracks: Iterable[Track]) -> list[dict[str, Any]]:
        """Replace `tracks.geojson`, .kml and .gpx, for a local site `tracks.json`: readers see the old or the new one.

        Returns each track's properties there.
        """
        tracks = list(tracks)
        collection = tracks_collection(tracks, self._site, self.crop_names)
        rows = [each["properties"] for each in collection["features"]]
        if self._site.is_local:
            for row in rows:
                row["segment"] = self.segments[row["id"]]
        name = features_name(TRACKS, is_local=self._site.is_local)
        atomic_write_bytes(self.folder / name, geojson_bytes(collection), durable=False)
        if not self._site.is_local:
            placemarks = track_placemarks(tracks, self._site)
            atomic_write_bytes(
                self.folder / TRACKS_KML, kml_bytes("tracks", placemarks), durable=False
            )
            atomic_write_bytes(
                self.folder / TRACKS_GPX, gpx_bytes("tracks", placemarks), durable=False
            )
        return rows

    def close(self) -> None:
        """Write what waits and close the files. Raises what went wrong with it."""
        if self._thread.is_alive():
            self._queue.put(None)
            self._thread.join()
        self._stack.close()
        self._raise_earlier()
        self._write_labels()

    # ---- in the thread ----------------------------------------------------------------------------------------

    def _run(self) -> None:
        while (seen := self._queue.get()) is not None:
            if self._error is not None:
                continue  # the queue is emptied, so that nobody waits for it
            started_s = time.monotonic()
            try:
                self._write(seen)
            except Exception as error:  # raised by the next `add`, or by `close`
                self._error = error
            self.seconds += time.monotonic() - started_s

    def _write(self, seen: SeenFrame) -> None:
        self._lines.append(_rows(seen, self._site))
        has_picture = seen.frame.image.size > 0
        if self._video is not None and has_picture:
            self._video.add(_drawn(seen), seen.time_ns)
        elif self._outputs.save == "pictures" and has_picture and len(seen.detections):
            write_annotated(self.folder / ANNOTATED_PICTURES, _file_name(seen.frame), _drawn(seen))
        # times come in any order: a live flight's rest is searched after its newest frames
        at = bisect(self._labelled_ns, seen.time_ns)
        near = self._labelled_ns[max(at - 1, 0) : at + 1]
        is_due = all(abs(each - seen.time_ns) >= _LABELS_EVERY_NS for each in near)
        if self._outputs.labels and is_due and self._label(seen):
            self._labelled_ns.insert(at, seen.time_ns)

    def _label(self, seen: SeenFrame) -> bool:
        """Keep a frame as a picture, and what was seen in it for the files of labels; whether its picture is there."""
        images = self.folder / LABELS / "images"
        name = f"{self._site.name}_{_file_name(seen.frame)}.jpg"
        if seen.frame.image.size:
            make_folder(images)
            atomic_write_bytes(images / name, jpeg_from_image(seen.frame.image), durable=False)
        elif not (images / name).is_file():
            return False
        height, width = seen.frame.image.shape[:2]
        picture = picture_of_detections(
            f"images/{name}", width, height, self._site.name, seen.detections
        )
        self._labelled.append((picture, seen.detections.scores))
        self._classes = seen.detections.classes
        return True

    def _write_labels(self) -> None:
        if not self._labelled:
            return
        listed = {Path(picture.path).name for picture, _ in self._labelled}
        for path in (self.folder / LABELS / "images").iterdir():
            if path.name not in listed:  # of a live flight that was searched again
                path.unlink()
        found = LabelledSet(
            self._site.name, self._classes, tuple(picture for picture, _ in self._labelled)
        )
        if "coco" in self._outputs.labels:
            write_coco(
                self.folder / LABELS / "coco.json", found, [scores for _, scores in self._labelled]
            )
        if "yolo" in self._outputs.labels:
            write_yolo(self.folder / LABELS, found)
        self._labelled = []

    # ---- inside -----------------------------------------------------------------------------------------------

    def _raise_earlier(self) -> None:
        if self._error is not None:
            error, self._error = self._error, None
            raise error

    def _keep_crop(self, sighting: Sighting, crop: ImageRGB) -> None:
        self._crops[sighting_key(sighting)] = crop
        held = sum(each.nbytes for each in self._crops.values())
        while held > _CROPS_BYTES and len(self._crops) > 1:
            _, dropped = self._crops.popitem(last=False)
            held -= dropped.nbytes


def _file_name(frame: Frame) -> str:
    """The frame's name without ending; a video's frames are numbered, and sort by it."""
    stem = Path(frame.name).stem
    return f"{int(stem):06d}" if stem.isdecimal() else stem


def _rows(seen: SeenFrame, site: Site) -> list[dict[str, Any]]:
    found = seen.detections
    segment = {"segment": seen.segment} if site.is_local else {}
    return [
        detection_row(
            seen.frame,
            seen.time_ns,
            found.names[row],
            float(found.scores[row]),
            found.boxes_px[row].tolist(),
            seen.sightings[row],
            seen.track_ids[row] or None,
            site,
        )
        | segment
        for row in range(len(found))
    ]


def _drawn(seen: SeenFrame) -> ImageRGB:
    """The frame with a box for each object, the surest of those that show it."""
    found, rows = without_doubles(seen.detections)
    track_ids = [seen.track_ids[row] for row in rows]
    counted = [track_id in seen.confirmed for track_id in track_ids]
    words = [
        f"{name} {track_id} {score:.2f}" if is_counted else ""
        for name, track_id, score, is_counted in zip(found.names, track_ids, found.scores, counted)
    ]
    return annotated(
        seen.frame.image, found.boxes_px, found.labels.tolist(), words, counted, seen.headline
    )
