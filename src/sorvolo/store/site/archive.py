"""A site on disk, opened to be read or written: what is in it, and how a flight begins to enter."""

import hashlib
import json
import os
import warnings
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from datetime import UTC, date, time
from functools import partial
from pathlib import Path
from typing import Any, Self, TypeVar

from sorvolo.errors import InputError, NotFoundError, SettingsError, SorvoloWarning, StoreError
from sorvolo.findings.importance import ordered
from sorvolo.findings.register import MissionSighting, Register, SearchedDate
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.geometry.grid import SiteGrid
from sorvolo.paths import AnyPath
from sorvolo.store.atomic import atomic_write_bytes, make_folder
from sorvolo.store.exports.change_files import CROPS, finding_feature, object_crops
from sorvolo.store.exports.plain import (
    FeatureList,
    features_name,
    moment_of,
    plain_json,
)
from sorvolo.store.images import image_from_jpeg
from sorvolo.store.nofollow import MOST_BYTES, open_below, read_below, sha256_of
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import change_records
from sorvolo.store.site.catalogue import (
    Catalogue,
    FlightEntry,
    StoredKeyframe,
    TileDifference,
    VersionEntry,
)
from sorvolo.store.site.catalogue_place import Catalogues, is_site
from sorvolo.store.site.change_records import StoredChange, StoredObject, StoredReview
from sorvolo.store.site.files import (
    JOURNAL,
    LIVE_COVERAGE,
    LIVE_PREVIEW,
    STAGED,
    DamagedError,
    HeightFile,
    begin_writing,
    checked_image_path,
    checked_name,
    find_origin,
    is_plain_name,
    refuse_traps,
)
from sorvolo.store.site.flight_writer import FlightWriter
from sorvolo.store.site.journal import RunJournal
from sorvolo.store.site.register import (
    flown_flights,
    present_objects,
    register_flights,
    site_register,
)
from sorvolo.store.site.tiles import GrowingTiles, TileBlobs, TileView
from sorvolo.store.site.upkeep import (
    forget_journals,
    forget_unfinished,
    remove_unused,
    repair,
    stopped_flights,
)
from sorvolo.survey.findings import Verdict
from sorvolo.survey.flight import Notice, Site
from sorvolo.survey.map_objects import MapObject
from sorvolo.survey.objects import PERSON

__all__ = ["Archive", "FlightWriter"]

T = TypeVar("T")
_MEGABYTE = 1_000_000
_MOST_DOCUMENT_BYTES = 256_000_000  # of a report.json: an hour's track takes a hundredth


class Archive:
    """One site on disk; a context manager. Made by `open`.

    The catalogue is the truth. Tiles and keyframe images are files that it names; everything else is derived
    from them and replaced whole, so that the folder can be read at any moment, whatever was killed when. It has the
    SHA-256 of each, which is looked at when the file is read. Names that come out of it are checked before they
    become paths.
    """

    def __init__(self, folder: Path, catalogue: Catalogue, lock: int | None) -> None:
        self.folder, self.catalogue = folder, catalogue
        self._origin = find_origin(folder)
        self.blobs = TileBlobs(folder / "tiles", self._origin)
        self._lock = lock
        self._writer: FlightWriter | None = None
        self.notices: list[Notice] = []
        """Of pictures that were left out, as they are damaged."""
        self._sound: set[tuple[str, int, int]] = (
            set()
        )  # files, by size and time, whose bytes were looked at

    @classmethod
    def open(
        cls,
        folder: AnyPath,
        *,
        write: bool,
        makes: bool = True,
        catalogues: Catalogues | None = None,
    ) -> Self:
        """Open a site folder, to read it (while another process writes it, too) or as its only writer.

        Writing creates the folder (where it `makes` one), removes what a killed run left and repairs derived files. A new catalogue goes, and
        one that lies elsewhere is looked for, where `catalogues` has it; None: where the environment has it. Raises
        StoreError when the folder is no site, is being written by another process, cannot be written, is
        damaged, holds a link, or has another format version; then nothing in it was changed.
        """
        folder = Path(folder)
        if not (write and makes) and not is_site(folder):
            raise NotFoundError(f"no site at {folder}; `sorvolo map` makes one")
        if not write:
            # those are read link by link
            refuse_traps(folder, skipped=frozenset({"tiles", "keyframes"}))
            return cls(folder, Catalogue.open(folder, write=False, catalogues=catalogues), None)
        lock = begin_writing(folder, catalogues)
        try:
            catalogue = Catalogue.open(folder, write=True, catalogues=catalogues)
        except BaseException:
            os.close(lock)
            raise
        archive = cls(folder, catalogue, lock)
        try:
            forget_unfinished(archive)
            repair(archive)
        except BaseException:
            archive.close()
            raise
        return archive

    def close(self) -> None:
        """Let go of the catalogue and of the right to write."""
        self.catalogue.close()
        if self._lock is not None:
            os.close(self._lock)
            self._lock = None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @property
    def has_site(self) -> bool:
        """Whether `create_site` was ever called on this folder."""
        return self.find_site() is not None

    @property
    def created_utc(self) -> str:
        """When the site was created, to the millisecond: no other site of its name has the same; "" before."""
        return self.catalogue_rows(records.created_utc)

    def create_site(self, site: Site) -> None:
        """Fix the site for ever; raises StoreError when the folder has one."""
        self._require_writable()
        if self.has_site:
            raise StoreError(
                f"{self.folder} holds the site {self.site().name!r}; choose another folder"
            )
        with self.catalogue.changing() as connection:
            records.add_site(connection, site)

    def rename(self, name: str) -> None:
        """Give the site another name; its folder stays. Raises StoreError while there is none."""
        self._require_writable()
        self.site()
        with self.catalogue.changing() as connection:
            records.rename_site(connection, name)

    def flights(self) -> list[FlightEntry]:
        """Every flight by rank. A complete run stays listed until the run that replaces it commits."""
        return self.catalogue_rows(records.list_flights)

    @property
    def complete_flights(self) -> list[FlightEntry]:
        """Those whose newest run is complete, by rank."""
        return [each for each in self.flights() if each.status == "complete"]

    def change_mark(self) -> tuple[int, int]:
        """Another one after each change that others made to the catalogue; what is read after it is no older."""
        return self.catalogue.change_mark()

    @property
    def exported_version(self) -> int:
        """The version that mosaic.tif and the other files of the map show; 0 for none."""
        return self.catalogue_rows(records.derived_version)

    def version_at(self, moment: date | str) -> VersionEntry:
        """The newest version of flights flown by a moment, or by the end of a date, as such or in ISO 8601; taken as UTC
        when it names no time zone.

        A flight whose clock has no date counts from when its map was made. Raises InputError when there was no map yet, SettingsError for no time.
        """
        utc = moment_of(str(moment), time.max).astimezone(UTC)
        complete = self.versions()
        known = [entry for entry in complete if entry.moment <= utc]
        if not known:
            earliest = min((entry.moment for entry in complete), default=None)
            first = (
                ", and has none now"
                if earliest is None
                else (f"; its first version shows {earliest.isoformat(timespec='seconds')}")
            )
            raise InputError(
                f"{self.folder} had no map at {utc.isoformat(timespec='seconds')}{first}"
            )
        return known[-1]

    def tile_difference(self, version: VersionEntry) -> TileDifference:
        """What a version's map has that the one it was painted over has not."""
        with self.catalogue.reading() as connection:
            changed, removed = records.tile_changes(connection, version)
        return TileDifference(len(changed), removed, self.blobs.size_bytes(changed))

    def comparisons(self) -> dict[int, Mapping[str, int]]:
        """The versions that comparisons made: how many changes of each kind each found."""
        return self.catalogue_rows(change_records.compared_versions)

    def changes(self, flight_id: str | None = None) -> list[StoredChange]:
        """The changes that complete runs found, by flight rank and number, with their verdicts; of one flight."""
        return self.catalogue_rows(change_records.load_changes, self._known(flight_id))

    def reviews(self) -> list[StoredReview]:
        """All reviews of changes, oldest first, also of changes that were replaced since."""
        return self.catalogue_rows(change_records.load_reviews)

    def objects(self, flight_id: str | None = None) -> list[StoredObject]:
        """The objects that complete runs found, by flight rank and number; of one flight. What a comparison alone saw
        is none once a person rejected that change."""
        rejected = {each.id for each in self.changes(flight_id) if each.verdict is Verdict.REJECTED}
        found = self.catalogue_rows(change_records.load_objects, flight_id)
        return [each for each in found if each.thing.id not in rejected]

    def keep_under_trees(self, flight_id: str, found: Sequence[MapObject]) -> None:
        """Keep what a look below the crowns of a mapped flight found, in place of an earlier look's; the lists follow."""
        self._require_writable()
        with self.catalogue.changing() as connection:
            change_records.put_under_trees(connection, flight_id, found)
            register_flights(connection, {flight_id})
            records.owe_documents(connection, {flight_id})
        crops = f"flights/{flight_id}/{CROPS}"
        make_folder(self.folder / crops)
        with self.replacing(crops):
            for name, data in object_crops(found).items():
                atomic_write_bytes(self.folder / crops / name, data)
        repair(self)

    def searches(self) -> list[SearchedDate]:
        """Which ground each complete run searched for objects, by flight rank."""
        return self.catalogue_rows(change_records.load_searches)

    def register(
        self,
        others: Sequence[MissionSighting] = (),
        their_looks: Sequence[SearchedDate] = (),
        flights: Collection[str] | None = None,
    ) -> Register:
        """What all missions of these flights found, each thing one finding; with what others saw and looked at, which
        the site does not keep."""
        return self.catalogue_rows(site_register, flights, others, their_looks)

    def findings(self, flight_id: str | None = None, label: str = "") -> FeatureList:
        """Each thing on the ground that any mission found, once, as a point; of one flight, what that saw; of a class,
        what any of these sightings has for one.

        `gone` names the flight that looked there and did not find it, null where it still stands.
        """
        site, flight_id = self.site(), self._known(flight_id)
        found = [
            each
            for each in ordered(self.register().findings)
            if any(
                flight_id in (None, seen.date) and label in ("", seen.label)
                for seen in each.sightings
            )
        ]
        return FeatureList((finding_feature(each, site) for each in found), is_local=site.is_local)

    def new_people(self, flight_id: str) -> list[Any]:
        """The findings that are people whom no flight before this one had found."""
        return [
            each
            for each in self.findings(flight_id, PERSON)
            if each["properties"]["flights"][0] == flight_id
        ]

    def _known(self, flight_id: str | None) -> str | None:
        """The flight, None for all. Raises NotFoundError for one that the site has not."""
        names = [] if flight_id is None else [each.id for each in self.flights()]
        if flight_id is not None and flight_id not in names:
            raise NotFoundError(
                f"{self.folder} has no flight {flight_id!r}, only {', '.join(names) or 'none'}"
            )
        return flight_id

    def flown(self) -> list[tuple[str, int, int, int]]:
        """Each flight's name, rank, and the times of its first and last frame, by rank; none of flights without."""
        return self.catalogue_rows(flown_flights)

    def newest_objects(self, flights: Collection[str] | None = None) -> list[StoredObject]:
        """What stands on the site by the newest look at each piece of ground; as far as these flights know."""
        return self.catalogue_rows(present_objects, flights)

    def review(
        self, change_ids: str | Iterable[str], verdict: Verdict | None, note: str = ""
    ) -> None:
        """Record a person's verdict on one change, or on several; None withdraws it. The flights' files follow.

        A later review replaces an earlier one. Raises InputError, and stores nothing, when an id is unknown.
        """
        wanted = {change_ids} if isinstance(change_ids, str) else set(change_ids)
        self._require_writable()
        with self.catalogue.changing() as connection:
            found = change_records.load_changes(connection, among=wanted)
            unknown = sorted(wanted - {each.id for each in found})
            if unknown:
                raise InputError(
                    f"{self.folder} has no change {', '.join(unknown)}; `sorvolo review {self.folder}` lists them"
                )
            change_records.put_reviews(connection, found, verdict, note)
            rejected = Verdict.REJECTED
            if otherwise := {
                each.flight_id
                for each in found
                if (each.verdict is rejected) != (verdict is rejected)
            }:
                register_flights(connection, otherwise)
            records.owe_documents(connection, {each.flight_id for each in found})
        repair(self)

    def keyframes(self, flight_id: str | None = None) -> list[StoredKeyframe]:
        """Keyframes of complete runs, by flight rank and index; of one flight when its id is given."""
        return self.catalogue_rows(records.load_keyframes, self._known(flight_id))

    def sound_keyframes(self, flight_id: str | None = None) -> list[StoredKeyframe]:
        """`keyframes` less those whose images are damaged or gone: `notices` and a warning count them.

        In a working copy, images that are not here are fetched, and looked at, when asked for.
        """

        def fault(keyframe: StoredKeyframe) -> str:
            is_sound = self._is_as_written(keyframe.image_path, keyframe.sha256)
            return {True: "", False: "damaged", None: "gone" if self._origin is None else ""}[
                is_sound
            ]

        stored = self.keyframes(flight_id)
        with ThreadPoolExecutor() as pool:
            faults = list(pool.map(fault, stored))
        unsound: dict[tuple[str, str], list[int]] = {}
        for keyframe, found in zip(stored, faults):
            if found:
                unsound.setdefault((keyframe.flight_id, found), []).append(keyframe.index)
        for (flight, found), frames in unsound.items():
            numbers = ", ".join(map(str, frames))
            what = f"key frame {numbers} of {flight} is"
            if len(frames) > 1:
                what = f"{len(frames):,} key frames of {flight} ({numbers}) are"
            notice = Notice("damaged_keyframes", len(frames), f"{what} {found}: left out")
            if notice not in self.notices:
                self.notices.append(notice)
                _warn(notice.text)
        return [keyframe for keyframe, found in zip(stored, faults) if not found]

    def image(self, keyframe: StoredKeyframe) -> ImageRGB:
        """A keyframe's undistorted image; raises StoreError when it is damaged, or its flight was mapped again."""
        return self.stored_image(keyframe.flight_id, keyframe.image_path, keyframe.sha256)

    def tiles(self, version: int | None = None) -> TileView:
        """The tiles of a version, of the newest complete one by default, read when asked for; {} if none.

        Raises StoreError for a version that does not exist.
        """
        if version is not None and version not in {entry.id for entry in self.versions()}:
            raise NotFoundError(
                f"{self.folder} has no version {version} of its map; `versions` lists them"
            )
        newest = self.catalogue_rows(records.newest_version)
        return self.version_tiles(newest if version is None else version)

    @property
    def is_growing(self) -> bool:
        """Whether a version of the map is being made."""
        return self.catalogue_rows(partial(records.newest_version, complete=False)) > 0

    def live_tiles(self) -> TileView:
        """The tiles of the map that is being made, as of its last flush; else of the newest complete one."""
        with self.catalogue.reading() as connection:
            version = records.newest_version(connection, complete=False) or records.newest_version(
                connection
            )
        return self.version_tiles(version)

    def journal(
        self, flight_id: str, key: str, program: str = "", *, anew: bool = False
    ) -> RunJournal:
        """The journal of a run that is about to begin, with what a killed one of this `key` left in it.

        `key` is the same for the same run over the same map, `program` the version of Sorvolo. Journals of other runs
        are deleted, and their pictures: a warning names each. `anew`: so is what a killed run left.
        """
        self._require_writable()
        path = self.journal_path(flight_id)
        newest = self.catalogue_rows(records.newest_version)
        journal = RunJournal(path, key, newest, program)
        if not anew and (why_not := journal.why_not):
            _warn(
                f"{flight_id}: a run that was stopped cannot continue: {why_not}; it starts again"
            )
        self._forget_stopped(path if journal.is_begun and not anew else None, but=flight_id)
        remove_unused(self)
        return journal

    def stopped_run(self, key: str, program: str) -> RunJournal | None:
        """What a killed run of this `key` left, of whatever flight; None where there is none. See `journal`."""
        newest = self.catalogue_rows(records.newest_version)
        for flight_id in stopped_flights(self):
            journal = RunJournal(self.journal_path(flight_id), key, newest, program)
            if journal.is_begun:
                return journal
        return None

    def _forget_stopped(self, kept: Path | None, *, but: str) -> None:
        """Forget the runs that were stopped, all but `kept`, with a warning for those of other flights than `but`."""
        for each in stopped_flights(self):
            if each != but:
                _warn(
                    f"a run of {each} was stopped before it was complete, and cannot continue: the map changes now"
                )
        forget_journals(self, kept)

    def begin_flight(
        self,
        flight_id: str,
        fingerprint: str,
        settings: Mapping[str, Any],
        *,
        tiles_mb: int = 64,
        images_mb: int = 256,
        journal: RunJournal | None = None,
    ) -> FlightWriter:
        """Start to map a flight; a flight mapped before keeps its rank, and stays readable until the commit.

        `settings["method"]`, if any, is listed with the flight. `journal` is the run's, which ends with it. Tiles
        and images are kept in memory up to `tiles_mb` and `images_mb`. Raises SettingsError for an id that is no folder
        name, StoreError when there is no site or another flight is being mapped.
        """
        self._require_writable()
        if self._writer is not None and self._writer.is_open:
            raise StoreError(
                f"a flight is being mapped into {self.folder} already; finish it first"
            )
        if not is_plain_name(flight_id):
            raise SettingsError(
                f"{flight_id!r} cannot name a flight's folder; choose letters and digits"
            )
        grid = self.site_grid().grid
        if journal is None:
            self._forget_stopped(None, but=flight_id)
        plain = plain_json(settings)
        with self.catalogue.changing() as connection:
            run_id, version_id = records.begin_run(
                connection, flight_id, fingerprint, str(settings.get("method", "")), plain
            )
            base = records.tile_hashes(connection, version_id)
        self.blobs.cache.most_bytes = min(self.blobs.cache.most_bytes, tiles_mb * _MEGABYTE)
        tiles = GrowingTiles(self.blobs, base, grid.tile_px, tiles_mb * _MEGABYTE)
        self._writer = FlightWriter(
            self, flight_id, run_id, version_id, tiles, images_mb * _MEGABYTE
        )
        return self._writer

    @property
    def mosaic_path(self) -> Path:
        """The map as a Cloud Optimized GeoTIFF."""
        return self.folder / "mosaic.tif"

    @property
    def live_preview_path(self) -> Path:
        """A small PNG of the growing map."""
        return self.folder / LIVE_PREVIEW

    @property
    def live_coverage_path(self) -> Path:
        """The ground that a flight which is being mapped has seen by now."""
        return self.folder / LIVE_COVERAGE

    def flight_folder(self, flight_id: str) -> Path:
        """Where a flight's files lie; raises StoreError for an id that is no plain name."""
        return self.folder / "flights" / checked_name(flight_id, "flight")

    def flight_folders(self) -> list[Path]:
        """The folders of all flights that have one, whether the catalogue knows them or not."""
        return [
            path
            for path in (self.folder / "flights").glob("*")
            if path.is_dir() and not path.is_symlink()
        ]

    def height_path(self, flight_id: str, file: HeightFile) -> Path:
        """Where a file of a flight's heights lies, whether it is there or not."""
        return self.flight_folder(flight_id) / file

    def journal_path(self, flight_id: str) -> Path:
        """Where a run notes how far it is, until it is committed."""
        return self.flight_folder(flight_id) / JOURNAL

    def staged_folder(self, flight_id: str, run_id: int) -> Path:
        """Where a run collects pictures until it is committed."""
        return self.flight_folder(flight_id) / STAGED / str(int(run_id))

    def stored_image(self, flight_id: str, image_path: str, sha256: str, step: int = 1) -> ImageRGB:
        """A stored keyframe, at a `step`-th (1, 2, 4, 8) of its size.

        Raises StoreError when it is gone, damaged, or no keyframe of this flight.
        """
        name = checked_image_path(image_path, flight_id)
        if self._origin is not None and not (self.folder / name).exists():
            self._origin.fetch(name)
        try:
            data = read_below(self.folder, name)
        except FileNotFoundError as error:
            raise StoreError(
                f"the keyframe {self.folder / name} is gone; if its flight was mapped again meanwhile, list the "
                "keyframes anew"
            ) from error
        if hashlib.sha256(data).hexdigest() != sha256:
            raise self._damaged(name)
        return image_from_jpeg(data, str(self.folder / name), step=step)

    def read_file(self, name: str, most_bytes: int = MOST_BYTES) -> bytes:
        """A file below the folder, as it was written.

        Raises FileNotFoundError when there is none, StoreError when it is damaged, too large, or behind a link.
        """
        for _ in range(3):  # a writer may replace it
            sha256 = self.catalogue_rows(records.file_hash, name)
            data = read_below(self.folder, name, most_bytes)
            if sha256 in ("", hashlib.sha256(data).hexdigest()):
                return data
        raise self._damaged(name)

    def is_sound(self, name: str) -> bool:
        """Whether a file below the folder is as it was written, as far as this is known; True where there is none."""
        for _ in range(3):
            sha256 = self.catalogue_rows(records.file_hash, name)
            if not sha256 or self._is_as_written(name, sha256) is not False:
                return True
        return False

    def require_sound(self, name: str) -> None:
        """Raise StoreError for a file below the folder that is not as it was written."""
        if not self.is_sound(name):
            raise self._damaged(name)

    def _is_as_written(self, name: str, sha256: str) -> bool | None:
        """Whether a file has this SHA-256; None where it is gone. A file that has not changed is not read again."""
        try:
            with open_below(self.folder, name) as file:
                about = os.fstat(file.fileno())
                mark = sha256, about.st_size, about.st_mtime_ns
                if mark not in self._sound and sha256_of(file) == sha256:
                    self._sound.add(mark)
                return mark in self._sound
        except FileNotFoundError:
            return None

    def _damaged(self, name: str) -> DamagedError:
        return DamagedError(
            f"{self.folder / name} is damaged: its bytes are not those that were written; restore it from a copy of "
            "the site, or make it again"
        )

    @contextmanager
    def replacing(self, *paths: str) -> Iterator[None]:
        """Note the SHA-256 of the files at these paths, and in folders there, which the block writes or removes.

        Meanwhile they are not known.
        """
        with self.catalogue.changing() as connection:
            records.forget_files(connection, paths)
        yield
        hashes = {}
        for path in paths:
            for file in (self.folder / path, *(self.folder / path).glob("*")):
                if file.is_file():
                    with file.open("rb") as opened:
                        name = file.relative_to(self.folder).as_posix()
                        hashes[name] = sha256_of(opened)
        with self.catalogue.changing() as connection:
            records.note_files(connection, hashes)

    def report(self, flight_id: str) -> Mapping[str, Any]:
        """A flight's report.json; empty when somebody took it away or broke it, of which a warning tells.

        Raises NotFoundError for a flight that the site has not.
        """
        self._known(flight_id)
        return self._document(f"flights/{checked_name(flight_id, 'flight')}/report.json")

    def features(self, folder: str, name: str, *, is_local: bool | None = None) -> FeatureList:
        """The features of a GeoJSON file in a folder of the site; none when somebody took it away or broke it."""
        is_local = self.site().is_local if is_local is None else is_local
        file = "/".join(filter(None, (folder, features_name(name, is_local=is_local))))
        features = self._document(file).get("features")
        found = features if isinstance(features, list) else []
        return FeatureList((each for each in found if isinstance(each, dict)), is_local=is_local)

    def _document(self, name: str) -> Mapping[str, Any]:
        """A JSON object in a file; empty when it is missing, damaged or broken."""
        try:
            content = json.loads(self.read_file(name, _MOST_DOCUMENT_BYTES))
        except FileNotFoundError:
            return {}
        except (OSError, ValueError, RecursionError, DamagedError) as error:
            _warn(f"{name} is left out: {error}")
            return {}
        return content if isinstance(content, dict) else {}

    def catalogue_rows(self, query: Callable[..., T], *arguments: object) -> T:
        """What a query finds in one transaction."""
        with self.catalogue.reading() as connection:
            return query(connection, *arguments)

    def find_site(self) -> Site | None:
        """The site; None while there is none."""
        return self.catalogue_rows(records.load_site)

    def site(self) -> Site:
        """The site; raises StoreError while there is none."""
        site = self.find_site()
        if site is None:
            raise StoreError(f"{self.folder} has no site yet; map a flight into it first")
        return site

    def site_grid(self) -> SiteGrid:
        """The pixel grid of the site's tiles; raises StoreError while there is no site."""
        site = self.site()
        return SiteGrid.at(site.origin, site.m_per_px, site.crs)

    def versions(self) -> list[VersionEntry]:
        """Every state of the map, oldest first; not one that is being made."""
        return self.catalogue_rows(records.list_versions)

    def version_tiles(self, version_id: int) -> TileView:
        """The tiles of a version, read when asked for; none for a version that does not exist."""

        def hashes() -> Mapping[Any, str]:
            return self.catalogue_rows(records.tile_hashes, version_id)

        return TileView(self.blobs, hashes(), hashes)

    def _require_writable(self) -> None:
        if self._lock is None:
            raise StoreError(f"{self.folder} was opened to be read; open it with write=True")


def _warn(text: str) -> None:
    warnings.warn(text, SorvoloWarning, stacklevel=3)
