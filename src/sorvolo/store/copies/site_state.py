"""What a copy takes of a site at one moment: its catalogue and files; and what it has that another lacks."""

import hashlib
import json
import re
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import Connection, select

from sorvolo.errors import StoreError
from sorvolo.store.atomic import TEMPORARY_PREFIX
from sorvolo.store.site import catalogue as records
from sorvolo.store.site import schema
from sorvolo.store.site.catalogue import Catalogue
from sorvolo.store.site.files import JOURNAL, STAGED, DamagedError, HeightFile
from sorvolo.store.site.names import is_plain_name, is_sha256

_MAP_FILES = frozenset(
    {
        "mosaic.tif",
        "preview.png",
        "mosaic.kmz",
        "objects.geojson",
        "objects.json",
        "objects.kml",
        "objects.gpx",
    }
)
_MOST_PARTS = 6  # of a file's path: flights/<flight>/staged/<run>/changes/<file>
_HOW_FAR_WRITTEN = {
    "site": {"derived_version"},
    "runs": {"files_written"},
    "documents": {"content"},
}
_LASTING = frozenset(HeightFile)  # files of a flight that nothing in the catalogue could make again
_TILE = re.compile(r"tiles/[0-9a-f]{2}/([0-9a-f]{64})\.png")
_KEYFRAME = re.compile(r"flights/[^/]+/keyframes/[0-9]{1,18}/[0-9]{6,18}\.jpg")


@dataclass(frozen=True)
class SiteFile:
    """A file of a site: its path in the site folder, its size, and its SHA-256 ("" while nobody has read it).

    `stamp` is when it was last written, ns, for files in a folder; 0 elsewhere.
    """

    path: str
    size: int
    sha256: str = ""
    stamp: int = 0

    @property
    def is_lasting(self) -> bool:
        """Whether the file never changes: a tile or a keyframe. Another content has another path."""
        return _TILE.fullmatch(self.path) is not None or _KEYFRAME.fullmatch(self.path) is not None


@dataclass(frozen=True)
class CatalogueState:
    """What a catalogue holds that a copy must not lose.

    `identity` names the site wherever its copies lie; `digest` all that the catalogue holds, whoever wrote it where.
    `versions` are the complete versions of the map (id, run, when made), `reviews` when each change was judged.
    """

    identity: str
    name: str
    digest: str
    versions: frozenset[tuple[int, int, str]]
    reviews: Mapping[str, str]

    @property
    def newest(self) -> int:
        """The newest version's number."""
        return max((each[0] for each in self.versions), default=0)


@dataclass(frozen=True, eq=False)
class SiteState:
    """A site as it is at one moment: a catalogue without unfinished runs in a file of its own, and its files by path.

    `left_out` are files in the site's folder that do not belong to the site.
    """

    held: CatalogueState
    catalogue: Path
    files: Mapping[str, SiteFile]
    left_out: tuple[str, ...] = ()


def find_state(catalogue: Catalogue) -> CatalogueState | None:
    """What a catalogue holds; None where no flight was ever mapped."""
    with catalogue.reading() as connection:
        row = connection.execute(select(schema.site)).mappings().one_or_none()
        if row is None or records.newest_version(connection) == 0:
            return None
        versions = connection.execute(
            select(schema.versions).where(schema.versions.c.complete.is_(True))
        )
        reviews = connection.execute(select(schema.reviews.c.change_id, schema.reviews.c.at_utc))
        fixed = [
            row[name]
            for name in ("created_utc", "latitude_deg", "longitude_deg", "crs", "m_per_px")
        ]
        return CatalogueState(
            hashlib.sha256(json.dumps(fixed).encode()).hexdigest()[:32],
            row["name"],
            _digest(connection),
            frozenset((each.id, each.run_id, each.created_utc) for each in versions),
            {each.change_id: each.at_utc for each in reviews},
        )


def named_files(
    catalogue: Catalogue,
) -> tuple[dict[str, str], dict[str, str], set[tuple[str, str]]]:
    """The tiles and keyframes, and the other files, by path, with their SHA-256; flights with runs whose staged files
    are still to be placed."""
    with catalogue.reading() as connection:
        lasting = {tile_path(each): each for each in records.used_hashes(connection)}
        lasting |= {
            each.image_path: each.sha256 for each in records.load_keyframes(connection, None)
        }
        owed = {(each.flight_id, str(each.run_id)) for each in records.owed_files(connection)}
        others = records.file_hashes(connection)
    return lasting, others, owed


def missing_from(held: CatalogueState, files: Mapping[str, SiteFile], other: SiteState) -> str:
    """What a site holds and another state of it has not, in words; "" where the other could replace it without loss."""
    if versions := sorted(each[0] for each in held.versions - other.held.versions):
        return f"version {', '.join(map(str, versions))} of the map"
    later = sorted(
        each for each, at_utc in held.reviews.items() if at_utc > other.held.reviews.get(each, "")
    )
    if later:
        return f"the review of change {', '.join(later[:5])}"
    lasting = sorted(
        path for path in files if path.rpartition("/")[2] in _LASTING and path not in other.files
    )
    return ", ".join(lasting[:5])


def is_site_path(path: str) -> bool:
    """Whether a site has a file of this path: one of the map's, or one below `flights/<flight>/`; tiles apart."""
    parts = path.split("/")
    if len(parts) == 1:
        return path in _MAP_FILES
    if not 3 <= len(parts) <= _MOST_PARTS or parts[0] != "flights" or parts[2] == JOURNAL:
        return False
    return all(is_plain_name(part) for part in parts[1:]) and not parts[-1].startswith(
        TEMPORARY_PREFIX
    )


def checked_path(path: object) -> str:
    """A path from an untrusted list, checked; raises StoreError for one outside the site."""
    if isinstance(path, str) and (is_site_path(path) or tile_of(path)):
        return path
    raise StoreError(
        f"the copy names a file {str(path)[:80]!r}, and no site has one; it is damaged or was made to do harm: do not "
        "use it"
    )


def tile_path(sha256: str) -> str:
    """Where a tile lies in the site folder."""
    return f"tiles/{sha256[:2]}/{sha256}.png"


def tile_of(path: str) -> str:
    """The SHA-256 that a tile's path states; "" for any other file's."""
    found = _TILE.fullmatch(path)
    return found[1] if found and path == tile_path(found[1]) and is_sha256(found[1]) else ""


def refuse_damaged(file: SiteFile, sha256: str) -> None:
    """Raise DamagedError where a file's bytes are known and have another SHA-256."""
    if file.sha256 and file.sha256 != sha256:
        raise DamagedError(file.path)


def is_left_out(path: str, lasting: Collection[str], owed: set[tuple[str, str]]) -> bool:
    """Whether a copy leaves a file below `flights` out on purpose: what only an unfinished run needs."""
    parts = path.split("/")
    if parts[0] != "flights" or len(parts) < 3:
        return False
    if parts[2] == STAGED:
        return len(parts) < 4 or (parts[1], parts[3]) not in owed
    if parts[2] == "keyframes":
        return path not in lasting
    return parts[2] == JOURNAL or parts[-1].startswith(TEMPORARY_PREFIX)


def _digest(connection: Connection) -> str:
    """A hash of everything in the catalogue except the progress of derived files, and what these are."""
    digest = hashlib.sha256()
    for table in schema.metadata.sorted_tables:
        if table in (schema.leftovers, schema.files):
            continue
        digest.update(table.name.encode())
        skipped = _HOW_FAR_WRITTEN.get(table.name, set())
        query = select(table).order_by(*table.primary_key.columns)
        for row in schema.checked_rows(connection, table, query):
            values = [value for name, value in row._mapping.items() if name not in skipped]
            digest.update(json.dumps(values, sort_keys=True, default=repr).encode())
    return digest.hexdigest()
