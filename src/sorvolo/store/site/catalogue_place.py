"""Where a site's catalogue lies: in the file `site.db` of its folder, or in a PostgreSQL database."""

import json
import os
import re
import secrets
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from sorvolo.errors import SettingsError, StoreError
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.plain import json_bytes
from sorvolo.store.nofollow import read_below
from sorvolo.store.site.database import (
    CATALOGUE_LAYOUT,
    Database,
    DatabaseLayout,
    PostgresDatabase,
    SqliteDatabase,
    shown_url,
)

CATALOGUE = "site.db"
POINTER = "site-catalogue.json"
"""Stands in the folder of a site whose catalogue lies elsewhere: the schema's name, and where it was made."""

VARIABLE = "SORVOLO_CATALOGUE"
"""The environment's databases, separated by spaces, the first the one for new sites ("sqlite": their folders).

With those of `--catalogue` they are the only servers that a site folder can have us connect to. Read here alone, and
never written: what a command chooses is passed on as `Catalogues`.
"""

_SCHEMES = ("postgresql", "postgres", "postgresql+psycopg")
_NAME = re.compile(r"[a-z_][a-z0-9_]{0,62}")
_MOST_BYTES = 100_000  # of a pointer's few lines


@dataclass(frozen=True)
class Catalogues:
    """Which databases this user's sites may lie in, and where the catalogue of a new site goes."""

    trusted: tuple[URL, ...] = ()  # PostgreSQL databases
    new: URL | None = None  # None: a file in the site's folder

    @classmethod
    def of_environment(cls) -> Self:
        """As the user has set `SORVOLO_CATALOGUE`. Raises SettingsError for what is no address."""
        found = [parsed_url(each) for each in os.environ.get(VARIABLE, "").split()]
        return cls(tuple(each for each in found if each is not None), next(iter(found), None))

    def choosing(self, words: str) -> "Catalogues":
        """The same with new catalogues at an address, "sqlite" or a URL, which is trusted; "" changes nothing.

        Raises SettingsError for what is no address, and for one with a password.
        """
        if not words:
            return self
        url = parsed_url(words)
        if url is None:
            return Catalogues(self.trusted)
        if url.password:
            raise SettingsError(
                "--catalogue: leave the password out, others can read a command; put it into ~/.pgpass or PGPASSWORD"
            )
        return Catalogues((url, *self.trusted), url)

    def find_trusted(self, url: URL) -> URL | None:
        """The trusted URL of the same database; the only one where the server has moved; None for a stranger's."""
        same = [each for each in self.trusted if shown_url(each) == shown_url(url)]
        return next(iter(same or (self.trusted if len(self.trusted) == 1 else ())), None)


def catalogue_file(folder: Path) -> Path | None:
    """The file that makes a folder a site, `site.db` or the pointer; None where it is no site."""
    return next((folder / name for name in (CATALOGUE, POINTER) if (folder / name).is_file()), None)


def is_site(folder: Path) -> bool:
    """Whether the folder holds a site, wherever its catalogue lies."""
    return catalogue_file(folder) is not None


def open_database(folder: Path, *, write: bool, catalogues: Catalogues | None = None) -> Database:
    """The database of a site. Raises StoreError where the pointer is broken or names a server that is not trusted."""
    if (folder / CATALOGUE).exists() or not (folder / POINTER).exists():
        return SqliteDatabase(folder / CATALOGUE, write=write)
    return pointed_database(folder, POINTER, write=write, catalogues=catalogues)


def create_database(folder: Path, catalogues: Catalogues | None = None) -> None:
    """Make the catalogue of a new site where new ones go: in the folder, or in PostgreSQL."""
    url = (catalogues or Catalogues.of_environment()).new
    if url is None:
        SqliteDatabase(folder / CATALOGUE, write=True).create()
    else:
        create_pointed(folder, POINTER, url, f"sorvolo_{folder.resolve().name}")


def chosen_catalogues(folder: Path, words: str) -> Catalogues:
    """Those of the environment, with a new site's catalogue at an address that its user chose; "" is no choice.

    Raises SettingsError as `Catalogues.choosing`, and for a site whose catalogue lies elsewhere already.
    """
    chosen = Catalogues.of_environment().choosing(words)
    file = catalogue_file(folder)
    if words and file is not None and file.name != (CATALOGUE if chosen.new is None else POINTER):
        lies = "in its folder" if file.name == CATALOGUE else "in PostgreSQL"
        raise SettingsError(
            f"the catalogue of {folder} lies {lies} already; --catalogue is for a new site"
        )
    return chosen


def parsed_url(words: str) -> URL | None:
    """A URL as a user writes it; None for "sqlite". Raises SettingsError, which never repeats a password."""
    if words in ("", "sqlite", "sqlite://"):
        return None
    try:
        url = make_url(words)
    except (ArgumentError, ValueError):
        url = None
    if url is None or url.drivername not in _SCHEMES or not url.database:
        found = words.partition("://")[0][:20] if "://" in words else "no address"
        raise SettingsError(
            f"a catalogue's address, {found!r}: give postgresql://USER@HOST/DATABASE, or sqlite for a file in the "
            f"site folder (--catalogue, {VARIABLE})"
        )
    return url.set(drivername="postgresql+psycopg")


def create_pointed(
    folder: Path, pointer: str, url: URL, name: str, layout: DatabaseLayout = CATALOGUE_LAYOUT
) -> None:
    """Make a schema of a new name, then the folder's pointer to it: a kill in between leaves an empty schema."""
    plain = re.sub(r"[^a-z0-9]+", "_", name.lower())[:40].strip("_")
    schema = f"{plain}_{secrets.token_hex(6)}"
    database = PostgresDatabase(url, schema, write=True, layout=layout)
    try:
        database.create()
    finally:
        database.close()
    atomic_write_bytes(folder / pointer, json_bytes({"url": shown_url(url), "schema": schema}))


def pointed_database(
    folder: Path,
    pointer: str,
    *,
    write: bool,
    layout: DatabaseLayout = CATALOGUE_LAYOUT,
    catalogues: Catalogues | None = None,
) -> Database:
    """The database that a folder's pointer names, if it is one of `catalogues` (None: of the environment).

    A folder that a stranger made must not have us connect, with the user's password, wherever it likes: raises
    StoreError for a server that is not trusted, as for a broken pointer.
    """
    named, schema = _read_pointer(folder, pointer)
    url = (catalogues or Catalogues.of_environment()).find_trusted(named)
    if url is None:
        raise StoreError(
            f"the catalogue of {folder} lies in PostgreSQL, at {shown_url(named)}; if you trust that server, set "
            f"{VARIABLE}={shown_url(named)} (with USER@ before the host where your name there is another)"
        )
    return PostgresDatabase(url, schema, write=write, layout=layout)


def _read_pointer(folder: Path, pointer: str) -> tuple[URL, str]:
    try:
        content = json.loads(read_below(folder, pointer, _MOST_BYTES))
        url, schema = parsed_url(content["url"]), content["schema"]
        if url is None or not _NAME.fullmatch(schema):
            raise ValueError("no address of a database")
    except (
        OSError,
        ValueError,
        TypeError,
        KeyError,
        AttributeError,
        RecursionError,
        SettingsError,
    ) as error:
        raise StoreError(
            f"{folder / pointer} does not name a catalogue (schema and url were needed); restore it from a copy"
        ) from error
    return url, schema
