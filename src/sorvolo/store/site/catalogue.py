"""The catalogue: the one truth about a site (docs/formats.md), in SQLite or in PostgreSQL."""

from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import numpy as np
from sqlalchemy import (
    ColumnElement,
    Connection,
    Row,
    Table,
    bindparam,
    delete,
    func,
    insert,
    literal,
    or_,
    select,
    update,
)

from sorvolo.errors import GeometryError, StoreError
from sorvolo.geometry.arrays import Floats, Matrix3
from sorvolo.geometry.camera import Camera
from sorvolo.geometry.geodesy import Geodetic
from sorvolo.geometry.grid import TileIndex
from sorvolo.geometry.pose import Pose
from sorvolo.geometry.units import DAY_NS
from sorvolo.store.exports.plain import plain_json
from sorvolo.store.site import schema
from sorvolo.store.site.catalogue_place import Catalogues, open_database
from sorvolo.store.site.database import Database, SqliteDatabase
from sorvolo.store.site.files import checked_crs, checked_image_path, checked_name, checked_sha256
from sorvolo.survey.flight import Site
from sorvolo.survey.mosaic import Status

# what values that no Sorvolo wrote raise where they are read
_IMPOSSIBLE = (
    TypeError,
    ValueError,
    LookupError,
    AttributeError,
    ArithmeticError,
    GeometryError,
)


@dataclass(frozen=True)
class FlightEntry:
    """A flight of the catalogue: its complete run, or the run that is mapping it for the first time.

    `rank` counts flights in the order they were first mapped; `frames` is the number of frames by status;
    times are ISO 8601 UTC, `finished_utc` "" while mapping.
    """

    id: str
    rank: int
    fingerprint: str
    status: str
    started_utc: str
    finished_utc: str
    method: str
    frames: Mapping[str, int]
    settings: Mapping[str, Any]
    notes: tuple[str, ...]


@dataclass(frozen=True)
class VersionEntry:
    """One state of the map; versions share the tiles in which they agree.

    `flown_ns` is the time of its flight's first frame, UTC; -1 where it was not stored.
    """

    id: int
    parent_id: int
    flight_id: str
    created_utc: str
    tiles: int
    export_crs: str
    run_id: int
    flown_ns: int = -1

    def __post_init__(self) -> None:
        datetime.fromisoformat(self.created_utc)

    @property
    def flown_utc(self) -> str:
        """When its flight's first frame was taken, ISO 8601 UTC to the second; "" where no clock has a date."""
        return self.moment.strftime("%Y-%m-%dT%H:%M:%SZ") if self.flown_ns >= DAY_NS else ""

    @property
    def moment(self) -> datetime:
        """Which moment the map shows: the flight's; where no clock has a date, that at which it was made."""
        if self.flown_ns >= DAY_NS:
            return datetime.fromtimestamp(self.flown_ns / 1e9, UTC)
        return datetime.fromisoformat(self.created_utc)


@dataclass(frozen=True)
class TileDifference:
    """How a version's tiles differ from those it was painted over: new or other ones, their bytes, ones taken away."""

    changed: int
    removed: int
    changed_bytes: int


@dataclass(frozen=True, eq=False)
class StoredKeyframe:
    """A keyframe of a complete run. Its image is undistorted and may be smaller than the frame was.

    `sha256` is that of the image's bytes, `camera` and `site_from_image` (3, 3) are the stored image's; `gains` (3,)
    multiply its RGB
    once the lens's `vignette` (2,) is undone (mosaic.exposure);
    `site_from_camera` is None where the method knows no 6-DoF pose.
    """

    flight_id: str
    index: int
    name: str
    time_ns: int
    status: Status
    image_path: str
    sha256: str
    camera: Camera
    site_from_image: Matrix3
    site_from_camera: Pose | None
    gains: Floats
    sigma_m: float
    residual_px: float
    vignette: Floats = field(default_factory=lambda: np.zeros(2))


class Catalogue:
    """The open catalogue; `reading` and `changing` give one transaction each, the functions below use them.

    Both raise StoreError for rows that are damaged.
    """

    def __init__(self, database: Database, site: Path) -> None:
        """Raises StoreError when it is damaged, no catalogue, of a format that is not known, or out of reach; for a
        writer, also when another process writes.
        """
        self._database = database
        self.fold_log, self.change_mark, self.close = (
            database.fold_log,
            database.change_mark,
            database.close,
        )
        try:
            database.check()
            with self.reading() as connection:
                version = schema.format_of(connection)
            if version != schema.FORMAT:
                raise StoreError(
                    f"the site {site} has format version {version}, this Sorvolo works with "
                    f"version {schema.FORMAT}; use the Sorvolo that made it, or map into a new folder"
                )
        except BaseException:
            database.close()
            raise

    @classmethod
    def open(cls, folder: Path, *, write: bool, catalogues: Catalogues | None = None) -> Self:
        """The catalogue of a site folder, wherever it lies. Raises as the constructor."""
        return cls(open_database(folder, write=write, catalogues=catalogues), folder)

    @classmethod
    def at(cls, path: Path, *, write: bool, place: str = "") -> Self:
        """A catalogue in a file of SQLite's, which messages call `place`. Raises as the constructor."""
        database = SqliteDatabase(path, write=write)
        database.place = place or database.place
        return cls(database, path.parent)

    @contextmanager
    def reading(self) -> Iterator[Connection]:
        """A transaction that sees one state of the catalogue."""
        with self._naming_damage(), self._database.reading() as connection:
            yield connection

    @contextmanager
    def changing(self) -> Iterator[Connection]:
        """A transaction, durable when it ends."""
        with self._naming_damage(), self._database.changing() as connection:
            yield connection

    @contextmanager
    def _naming_damage(self) -> Iterator[None]:
        try:
            yield
        except UnicodeEncodeError:  # what is to be written, not what was read
            raise
        except _IMPOSSIBLE as error:
            raise StoreError(
                f"{self._database.place} is damaged: {error}; restore it from a copy of the site, or map into a new "
                "folder"
            ) from error


def utc_now() -> str:
    """The time, ISO 8601 UTC to the millisecond."""
    return datetime.now(UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


def load_site(connection: Connection) -> Site | None:
    """The site, None before it was created."""
    row = next(schema.checked_rows(connection, schema.site, select(schema.site)), None)
    if row is None:
        return None
    origin = Geodetic(row.latitude_deg, row.longitude_deg, row.height_m)
    if not 0 < row.m_per_px < np.inf:
        raise ValueError(f"the site has {row.m_per_px} metres a pixel")
    return Site(
        row.name, origin, checked_crs(row.crs), row.m_per_px, row.is_local, row.height_reference
    )


def created_utc(connection: Connection) -> str:
    """When the site was created, ISO 8601 UTC to the millisecond; "" before."""
    found: str | None = connection.execute(select(schema.site.c.created_utc)).scalar_one_or_none()
    return found or ""


def add_site(connection: Connection, site: Site) -> None:
    """Write the site's one row."""
    place = asdict(site.origin)
    facts = {
        name: getattr(site, name)
        for name in ("name", "height_reference", "crs", "m_per_px", "is_local")
    }
    row = {"id": 1, **place, **facts, "created_utc": utc_now(), "derived_version": 0}
    schema.add_rows(connection, schema.site, [row])


def rename_site(connection: Connection, name: str) -> None:
    """Give the site another name."""
    row = {**connection.execute(select(schema.site)).one()._mapping, "name": name}
    connection.execute(update(schema.site).values(name=name, seal=schema.seal_of(schema.site, row)))


def list_flights(connection: Connection) -> list[FlightEntry]:
    """Every flight by rank; a complete run hides the run that is about to replace it."""
    rows = connection.execute(
        select(schema.flights.c.rank, schema.runs)
        .join(schema.runs, schema.runs.c.flight_id == schema.flights.c.id)
        # "mapping" before "complete": the last one stays
        .order_by(schema.flights.c.rank, schema.runs.c.status.desc())
    )
    return list(
        {
            row.flight_id: FlightEntry(
                **{
                    **_named(row, FlightEntry, "id", "notes"),
                    "id": row.flight_id,
                    "notes": tuple(row.notes),
                }
            )
            for row in rows
        }.values()
    )


def _named(row: Row[Any], record: Any, *without: str) -> dict[str, Any]:
    """The columns of a row that a record has fields for, by their common names."""
    names = {each.name for each in fields(record)} - set(without)
    return {name: value for name, value in row._mapping.items() if name in names}


def list_versions(connection: Connection) -> list[VersionEntry]:
    """Every version, oldest first; not one that is being made."""
    tiles = func.count(schema.version_tiles.c.sha256)
    flown = schema.checked_rows(connection, schema.flown, select(schema.flown))
    flown_ns = {row.version_id: row.first_ns for row in flown}
    rows = connection.execute(
        select(schema.versions, tiles.label("tiles"))
        .outerjoin(schema.version_tiles, schema.version_tiles.c.version_id == schema.versions.c.id)
        .where(schema.versions.c.complete.is_(True))
        .group_by(schema.versions.c.id)
        .order_by(schema.versions.c.id)
    )
    return [
        VersionEntry(
            **{
                **_named(row, VersionEntry),
                "flight_id": checked_name(row.flight_id, "flight"),
                "export_crs": checked_crs(row.export_crs),
                "flown_ns": flown_ns.get(row.id, -1),
            }
        )
        for row in rows
    ]


def newest_version(connection: Connection, *, complete: bool = True) -> int:
    """The id of the newest complete (or incomplete) version; 0 when there is none."""
    newest = select(func.max(schema.versions.c.id)).where(schema.versions.c.complete == complete)
    return connection.execute(newest).scalar() or 0


def tile_hashes(connection: Connection, version_id: int) -> dict[TileIndex, str]:
    """SHA-256 of every tile of a version; empty for a version that does not exist."""
    tiles = schema.version_tiles
    rows = schema.checked_rows(
        connection, tiles, select(tiles).where(tiles.c.version_id == version_id)
    )
    return {(row.tile_column, row.tile_row): row.sha256 for row in rows}


def tiles_alike(connection: Connection, version_id: int, other_id: int) -> set[TileIndex]:
    """The places at which two versions have the same tile."""
    one, two = tile_hashes(connection, version_id), tile_hashes(connection, other_id)
    return {index for index, sha256 in one.items() if two.get(index) == sha256}


def tile_changes(connection: Connection, version: VersionEntry) -> tuple[list[str], int]:
    """SHA-256 of each tile that differs from the parent's at its place, and the number that only the parent has."""
    now, then = tile_hashes(connection, version.id), tile_hashes(connection, version.parent_id)
    return [sha256 for index, sha256 in now.items() if then.get(index) != sha256], len(
        then.keys() - now.keys()
    )


def used_hashes(connection: Connection, among: Collection[str] | None = None) -> set[str]:
    """The SHA-256 of every tile that some version has, of those `among` when given."""
    query = select(schema.version_tiles.c.sha256).distinct()
    parts = schema.within(query, schema.version_tiles.c.sha256, among)
    return {sha256 for part in parts for sha256 in connection.execute(part).scalars()}


def begin_run(
    connection: Connection,
    flight_id: str,
    fingerprint: str,
    method: str,
    settings: Mapping[str, Any],
) -> tuple[int, int]:
    """Start a run and its incomplete version over the right earlier one; return both ids."""
    known = connection.execute(
        select(schema.flights.c.rank).where(schema.flights.c.id == flight_id)
    ).scalar()
    if known is None:
        last = connection.execute(select(func.max(schema.flights.c.rank))).scalar()
        connection.execute(
            insert(schema.flights).values(id=flight_id, rank=0 if last is None else last + 1)
        )
    run_id = _inserted(
        connection,
        schema.runs,
        {
            "flight_id": flight_id,
            "fingerprint": fingerprint,
            "status": "mapping",
            "started_utc": utc_now(),
            "finished_utc": "",
            "method": method,
            "settings": dict(settings),
            "frames": {},
            "notes": [],
            "files_written": False,
        },
    )
    newest = next(reversed(list_versions(connection)), None)
    base_id = (
        0 if newest is None else newest.parent_id if newest.flight_id == flight_id else newest.id
    )
    version_id = _inserted(
        connection,
        schema.versions,
        {
            "parent_id": base_id,
            "flight_id": flight_id,
            "run_id": run_id,
            "created_utc": utc_now(),
            "complete": False,
            "export_crs": "",
        },
    )
    tiles = schema.version_tiles
    _, *columns = tiles.c
    base = select(literal(version_id), *columns).where(tiles.c.version_id == base_id)
    connection.execute(insert(tiles).from_select(tiles.c.keys(), base))
    return run_id, version_id


def change_tiles(
    connection: Connection, version_id: int, changed: Mapping[TileIndex, str | None]
) -> None:
    """Give tiles of a version other content; None removes one."""
    tiles = schema.version_tiles
    if changed:
        connection.execute(
            delete(tiles).where(
                tiles.c.version_id == version_id,
                tiles.c.tile_column == bindparam("column"),
                tiles.c.tile_row == bindparam("row"),
            ),
            [{"column": column, "row": row} for column, row in changed],
        )
    painted = [
        {"version_id": version_id, "tile_column": column, "tile_row": row, "sha256": sha256}
        for (column, row), sha256 in changed.items()
        if sha256 is not None
    ]
    schema.add_rows(connection, tiles, painted)


def complete_run(
    connection: Connection,
    run_id: int,
    version_id: int,
    keyframes: Sequence[StoredKeyframe],
    documents: Mapping[str, bytes],
    frames: Mapping[str, int],
    notes: Sequence[str],
    export_crs: str,
    flown_ns: tuple[int, int] | None,
) -> None:
    """Switch a flight from its former run to this one, and the map to this version."""
    this_run = schema.runs.c.id == run_id
    flight_id = connection.execute(select(schema.runs.c.flight_id).where(this_run)).scalar_one()
    former = (schema.runs.c.flight_id == flight_id, schema.runs.c.id != run_id)
    gone = {
        name
        for table in (schema.documents, schema.leftovers)
        for name in connection.execute(
            select(table.c.name)
            .join(schema.runs, schema.runs.c.id == table.c.run_id)
            .where(*former)
        ).scalars()
    } - documents.keys()
    connection.execute(delete(schema.runs).where(*former))
    if gone:
        connection.execute(
            insert(schema.leftovers), [{"run_id": run_id, "name": name} for name in sorted(gone)]
        )
    connection.execute(
        update(schema.runs)
        .where(this_run)
        .values(status="complete", finished_utc=utc_now(), frames=dict(frames), notes=list(notes))
    )
    connection.execute(
        update(schema.versions)
        .where(schema.versions.c.id == version_id)
        .values(complete=True, created_utc=utc_now(), export_crs=export_crs)
    )
    if flown_ns is not None:
        first_ns, last_ns = flown_ns
        row = {"version_id": version_id, "first_ns": first_ns, "last_ns": last_ns}
        schema.add_rows(connection, schema.flown, [row])
    schema.add_rows(
        connection, schema.keyframes, [_row_of(keyframe, run_id) for keyframe in keyframes]
    )
    if documents:
        connection.execute(
            insert(schema.documents),
            [
                {"run_id": run_id, "name": name, "content": content}
                for name, content in documents.items()
            ],
        )


def drop_unfinished(connection: Connection) -> None:
    """Forget every run that was not committed, with its version, and flights that have no other.

    A site is forgotten as well when no flight was ever committed to it: its place, its ground sampling distance and
    its height are those of a run that was stopped, perhaps before it began, and need not suit the next one.
    """
    _drop(connection, schema.versions, schema.versions.c.complete.is_(False))
    _drop(connection, schema.runs, schema.runs.c.status == "mapping")
    if newest_version(connection) == 0:
        connection.execute(delete(schema.site))
    connection.execute(
        delete(schema.flights).where(
            schema.flights.c.id.not_in(select(schema.runs.c.flight_id)),
            schema.flights.c.id.not_in(select(schema.versions.c.flight_id)),
        )
    )


def _drop(connection: Connection, table: Table, unfinished: ColumnElement[bool]) -> None:
    """Delete these rows, the newest; their numbers, which nothing names any more, are given again: a run that was
    killed and the one that goes on end with the same."""
    first = connection.execute(select(func.min(table.c.id)).where(unfinished)).scalar()
    if first is not None:
        connection.execute(delete(table).where(unfinished))
        known = update(schema.numbers).where(schema.numbers.c.name == table.name)
        connection.execute(known.values(last=first - 1))


def owe_documents(connection: Connection, flight_ids: Collection[str]) -> None:
    """Let the next repair write the files of these flights again."""
    connection.execute(
        update(schema.runs)
        .where(schema.runs.c.flight_id.in_(list(flight_ids)))
        .values(files_written=False)
    )


def run_ids(connection: Connection) -> dict[str, set[int]]:
    """The runs of each flight."""
    runs: dict[str, set[int]] = {}
    for row in connection.execute(select(schema.runs.c.flight_id, schema.runs.c.id)):
        runs.setdefault(row.flight_id, set()).add(row.id)
    return runs


def load_keyframes(connection: Connection, flight_id: str | None) -> list[StoredKeyframe]:
    """Keyframes of complete runs by flight rank and index, of one flight when its id is given."""
    query = schema.of_complete_runs(schema.keyframes, flight_id)
    rows = schema.checked_rows(
        connection, schema.keyframes, query.order_by(schema.keyframes.c.frame_index)
    )
    return [
        StoredKeyframe(
            row.flight_id,
            row.frame_index,
            row.name,
            row.time_ns,
            Status(row.status),
            checked_image_path(row.image_path, row.flight_id),
            checked_sha256(row.sha256),
            Camera(**row.camera),
            np.array(row.site_from_image, np.float64).reshape(3, 3),
            Pose(row.rotation, row.translation_m) if row.rotation else None,
            np.array(row.gains, np.float64),
            np.nan if row.sigma_m is None else row.sigma_m,
            np.nan if row.residual_px is None else row.residual_px,
            np.array(row.vignette, np.float64),
        )
        for row in rows
    ]


def file_hashes(connection: Connection) -> dict[str, str]:
    """SHA-256 of the site's files, keyframes and tiles apart, by path."""
    return {row.path: row.sha256 for row in connection.execute(select(schema.files))}


def file_hash(connection: Connection, path: str) -> str:
    """SHA-256 of one of the site's files; "" where it is not known."""
    query = select(schema.files.c.sha256).where(schema.files.c.path == path)
    return connection.execute(query).scalar_one_or_none() or ""


def forget_files(connection: Connection, paths: Collection[str]) -> None:
    """Forget the SHA-256 of these files, and of all in these folders."""
    path = schema.files.c.path
    inside = (path.startswith(f"{each}/", autoescape=True) for each in paths)
    connection.execute(delete(schema.files).where(or_(path.in_(paths), *inside)))


def note_files(connection: Connection, hashes: Mapping[str, str]) -> None:
    """Note the SHA-256 of files, by path, that have none."""
    if hashes:
        rows = [{"path": path, "sha256": sha256} for path, sha256 in hashes.items()]
        connection.execute(insert(schema.files), rows)


@dataclass(frozen=True)
class OwedFiles:
    """What a complete run owes its flight's folder: text files by name (empty: already there), names to remove."""

    flight_id: str
    run_id: int
    documents: Mapping[str, bytes]
    leftovers: tuple[str, ...]


def owed_files(connection: Connection) -> list[OwedFiles]:
    """The files of each complete run that were not all written."""
    runs = connection.execute(
        select(schema.runs.c.flight_id, schema.runs.c.id).where(
            schema.runs.c.status == "complete", schema.runs.c.files_written.is_(False)
        )
    ).all()
    documents, leftovers = schema.documents, schema.leftovers
    return [
        OwedFiles(
            flight_id,
            run_id,
            {
                row.name: row.content
                for row in connection.execute(select(documents).where(documents.c.run_id == run_id))
            },
            tuple(
                connection.execute(
                    select(leftovers.c.name).where(leftovers.c.run_id == run_id)
                ).scalars()
            ),
        )
        for flight_id, run_id in runs
    ]


def mark_written(connection: Connection, run_ids: Sequence[int], derived_version: int) -> None:
    """Note that these runs' files, and the map's files for this version, are on the disk: documents are emptied."""
    connection.execute(
        update(schema.runs).where(schema.runs.c.id.in_(run_ids)).values(files_written=True)
    )
    connection.execute(
        update(schema.documents).where(schema.documents.c.run_id.in_(run_ids)).values(content=b"")
    )
    connection.execute(delete(schema.leftovers).where(schema.leftovers.c.run_id.in_(run_ids)))
    connection.execute(update(schema.site).values(derived_version=derived_version))


def derived_version(connection: Connection) -> int:
    """The version that the map's derived files show; 0 for none."""
    return connection.execute(select(schema.site.c.derived_version)).scalar() or 0


def _inserted(connection: Connection, table: Table, values: Mapping[str, Any]) -> int:
    """The number of the row, which no row of the table had before."""
    known = update(schema.numbers).where(schema.numbers.c.name == table.name)
    connection.execute(known.values(last=schema.numbers.c.last + 1))
    given = select(schema.numbers.c.last).where(schema.numbers.c.name == table.name)
    number = int(connection.execute(given).scalar_one())
    connection.execute(insert(table).values(id=number, **values))
    return number


def _row_of(keyframe: StoredKeyframe, run_id: int) -> dict[str, Any]:
    camera, pose = asdict(keyframe.camera), keyframe.site_from_camera
    del camera["distortion"]
    alike = ("name", "time_ns", "status", "image_path", "sha256", "site_from_image", "gains")
    return {
        **plain_json(
            {
                name: getattr(keyframe, name)
                for name in (*alike, "vignette", "sigma_m", "residual_px")
            }
        ),
        "run_id": run_id,
        "frame_index": keyframe.index,
        "camera": camera,
        "rotation": [] if pose is None else pose.rotation.tolist(),
        "translation_m": [] if pose is None else pose.translation_m.tolist(),
    }
