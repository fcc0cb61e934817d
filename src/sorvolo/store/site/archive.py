"""A site on disk, opened to be read or written: what is in it, and how a flight begins to enter."""

import warnings
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

from sqlalchemy import Connection

from sorvolo.errors import InputError, NotFoundError, SettingsError, SorvoloWarning, StoreError
from sorvolo.geometry.arrays import ImageRGB
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import change_records, object_records
from sorvolo.store.site.catalogue import FlightEntry, StoredKeyframe, TileDifference, VersionEntry
from sorvolo.store.site.catalogue_place import Catalogues
from sorvolo.store.site.change_records import StoredChange, StoredReview
from sorvolo.store.site.files import SiteFolder
from sorvolo.store.site.flight_writer import FlightWriter
from sorvolo.store.site.journal import RunJournal
from sorvolo.store.site.names import is_plain_name
from sorvolo.store.site.object_records import StoredObject, StoredSearch
from sorvolo.store.site.tiles import GrowingTiles, TileView
from sorvolo.store.site.upkeep import (
    forget_journals,
    forget_unfinished,
    remove_unused,
    repair,
    stopped_flights,
)
from sorvolo.survey.findings import Verdict
from sorvolo.survey.flight import Site

__all__ = ["Archive", "FlightWriter"]

_MEGABYTE = 1_000_000


class Archive(SiteFolder):
    """One site on disk; a context manager. Made by `open`.

    The catalogue is the truth. Tiles and keyframe images are files that it names; everything else is derived
    from them and replaced whole, so that the folder can be read at any moment, whatever was killed when.
    """

    _writer: FlightWriter | None = None

    @classmethod
    def open(cls, folder: Path, *, write: bool, catalogues: Catalogues | None = None) -> Self:
        """Open a site folder, to read it (while another process writes it, too) or as its only writer.

        Writing creates the folder, removes what a killed run left and repairs derived files. A new catalogue goes, and
        one that lies elsewhere is looked for, where `catalogues` has it; None: where the environment has it. Raises
        StoreError when the folder is no site, is being written by another process, cannot be written, is
        damaged, holds a link, or has another format version; then nothing in it was changed.
        """
        archive = super().open(Path(folder), write=write, catalogues=catalogues)
        try:
            if write:
                forget_unfinished(archive)
                repair(archive)
        except BaseException:
            archive.close()
            raise
        return archive

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

    def flights(self) -> list[FlightEntry]:
        """Every flight by rank. A complete run stays listed until the run that replaces it commits."""
        return self.catalogue_rows(records.list_flights)

    def change_mark(self) -> tuple[int, int]:
        """Another one after each change that others made to the catalogue; what is read after it is no older."""
        return self.catalogue.change_mark()

    @property
    def exported_version(self) -> int:
        """The version that mosaic.tif and the other files of the map show; 0 for none."""
        return self.catalogue_rows(records.derived_version)

    def version_at(self, moment: datetime) -> VersionEntry:
        """The newest version of flights flown by a moment, taken as UTC when it names no time zone.

        A flight whose clock has no date counts from when its map was made. Raises InputError when there was no map yet.
        """
        utc = moment.replace(tzinfo=UTC) if moment.tzinfo is None else moment.astimezone(UTC)
        complete = [entry for entry in self.versions() if entry.complete]
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
        return self.catalogue_rows(change_records.load_changes, flight_id)

    def reviews(self) -> list[StoredReview]:
        """All reviews of changes, oldest first, also of changes that were replaced since."""
        return self.catalogue_rows(change_records.load_reviews)

    @property
    def is_searched(self) -> bool:
        """Whether any flight's frames were searched for objects."""
        return bool(self.searches())

    def objects(self, flight_id: str | None = None) -> list[StoredObject]:
        """The objects that complete runs found, by flight rank and number; of one flight."""
        return self.catalogue_rows(object_records.load_objects, flight_id)

    def searches(self) -> list[StoredSearch]:
        """Which ground each complete run searched for objects, by flight rank."""
        return self.catalogue_rows(object_records.load_searches)

    def newest_objects(self, flights: Collection[str] | None = None) -> list[StoredObject]:
        """What stands on the site by the newest look at each piece of ground; as far as these flights know."""
        with self.catalogue.reading() as connection:
            found, searches = (
                object_records.load_objects(connection),
                object_records.load_searches(connection),
            )
        return object_records.newest_objects(
            [each for each in found if flights is None or each.flight_id in flights],
            [each for each in searches if flights is None or each.flight_id in flights],
        )

    def review(self, change_ids: str | Iterable[str], verdict: Verdict, note: str = "") -> None:
        """Record a person's verdict on one change, or on several; the flights' change files follow.

        A later review replaces an earlier one. Raises InputError, and stores nothing, when an id is unknown.
        """
        wanted = {change_ids} if isinstance(change_ids, str) else set(change_ids)
        self._change_reviews(
            wanted,
            lambda connection, found: change_records.put_reviews(connection, found, verdict, note),
        )

    def withdraw_review(self, change_ids: Iterable[str]) -> None:
        """Withdraw the reviews of changes. Raises InputError, and changes nothing, when an id is unknown."""
        self._change_reviews(set(change_ids), change_records.drop_reviews)

    def _change_reviews(
        self, wanted: Collection[str], change: Callable[[Connection, Sequence[StoredChange]], None]
    ) -> None:
        self._require_writable()
        with self.catalogue.changing() as connection:
            found = [each for each in change_records.load_changes(connection) if each.id in wanted]
            unknown = sorted(set(wanted) - {each.id for each in found})
            if unknown:
                raise InputError(
                    f"{self.folder} has no change {', '.join(unknown)}; `sorvolo review {self.folder}` lists them"
                )
            change(connection, found)
            records.owe_documents(connection, {each.flight_id for each in found})
        repair(self)

    def keyframes(self, flight_id: str | None = None) -> list[StoredKeyframe]:
        """Keyframes of complete runs, by flight rank and index; of one flight when its id is given."""
        return self.catalogue_rows(records.load_keyframes, flight_id)

    def image(self, keyframe: StoredKeyframe) -> ImageRGB:
        """A keyframe's undistorted image; raises StoreError when its flight was mapped again meanwhile."""
        return self.stored_image(keyframe.flight_id, keyframe.image_path)

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
        with self.catalogue.changing() as connection:
            run_id, version_id = records.begin_run(
                connection,
                flight_id,
                fingerprint,
                str(settings.get("method", "")),
                plain_json(settings),
            )
            base = records.tile_hashes(connection, version_id)
        self.blobs.cache_bytes = min(self.blobs.cache_bytes, tiles_mb * _MEGABYTE)
        tiles = GrowingTiles(self.blobs, base, grid.tile_px, tiles_mb * _MEGABYTE)
        self._writer = FlightWriter(
            self, flight_id, run_id, version_id, tiles, images_mb * _MEGABYTE
        )
        return self._writer

    def _require_writable(self) -> None:
        if not self.is_writable:
            raise StoreError(f"{self.folder} was opened to be read; open it with write=True")


def _warn(text: str) -> None:
    warnings.warn(text, SorvoloWarning, stacklevel=3)
