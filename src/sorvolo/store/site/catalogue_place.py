"""Where a site's catalogue lies: in the file `site.db` of its folder, or in a PostgreSQL database."""

import json
import os
import re
import secrets
from pathlib import Path

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from sorvolo.errors import SettingsError, StoreError
from sorvolo.store.atomic import atomic_write_bytes
from sorvolo.store.exports.plain import json_bytes
from sorvolo.store.nofollow import read_below
from sorvolo.store.site.database import Database, Layout
from sorvolo.store.site.sqlite_database import CATALOGUE_LAYOUT, SqliteDatabase

CATALOGUE = "site.db"
POINTER = "site-catalogue.json"
"""Stands in the folder of a site whose catalogue lies elsewhere: the schema's name, and where it was made."""

VARIABLE = "SORVOLO_CATALOGUE"
"""The environment's databases, separated by spaces, the first the one for new sites ("sqlite": their folders).

They are the only servers that a site folder can have us connect to.
"""

_SCHEMES = ("postgresql", "postgres", "postgresql+psycopg")
_NAME = re.compile(r"[a-z_][a-z0-9_]{0,62}")
_MOST_BYTES = 100_000


def catalogue_file(folder: Path) -> Path | None:
    """The file that makes a folder a site, `site.db` or the pointer; None where it is no site."""
    return next((folder / name for name in (CATALOGUE, POINTER) if (folder / name).is_file()), None)


def is_site(folder: Path) -> bool:
    """Whether the folder holds a site, wherever its catalogue lies."""
    return catalogue_file(folder) is not None


def open_database(folder: Path, *, write: bool) -> Database:
    """The database of a site. Raises StoreError where the pointer is broken or names a server that nobody trusts."""
    if (folder / CATALOGUE).exists() or not (folder / POINTER).exists():
        return SqliteDatabase(folder / CATALOGUE, write=write)
    return pointed_database(folder, POINTER, write=write)


def create_database(folder: Path) -> None:
    """Make the catalogue of a new site where the environment wants it: in the folder, or in PostgreSQL."""
    url = parsed_url(next(iter(os.environ.get(VARIABLE, "").split()), ""))
    if url is None:
        SqliteDatabase(folder / CATALOGUE, write=True).create()
    else:
        create_pointed(folder, POINTER, url, f"sorvolo_{folder.resolve().name}")


def choose_catalogue(folder: Path, words: str) -> None:
    """Let the catalogue of a new site lie there: "sqlite" or a URL without a password. Trusts it as `trust` does.

    Raises SettingsError for anything else, and for a site whose catalogue lies elsewhere.
    """
    url = parsed_url(words)
    file = catalogue_file(folder)
    if file is not None and file.name != (CATALOGUE if url is None else POINTER):
        lies = "in its folder" if file.name == CATALOGUE else "in PostgreSQL"
        raise SettingsError(f"the catalogue of {folder} lies {lies} already; --catalogue is for a new site")
    trust(words)


def trust(words: str) -> None:
    """Let this process, and those it starts, connect there, and make new catalogues there; "" changes nothing.

    Raises SettingsError for what is no address, and for one with a password.
    """
    url = parsed_url(words)
    if url is not None and url.password:
        raise SettingsError(
            "--catalogue: leave the password out, others can read a command; put it into ~/.pgpass or PGPASSWORD"
        )
    if words:
        os.environ[VARIABLE] = " ".join([words, os.environ.get(VARIABLE, "")])


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


def trusted_urls() -> list[URL]:
    """The PostgreSQL databases of the environment."""
    found = [parsed_url(each) for each in os.environ.get(VARIABLE, "").split()]
    return [each for each in found if each is not None]


def create_pointed(folder: Path, pointer: str, url: URL, name: str, layout: Layout = CATALOGUE_LAYOUT) -> None:
    """Make a schema of a new name, then the folder's pointer to it: a kill in between leaves an empty schema."""
    from sorvolo.store.site.postgres_database import PostgresDatabase, shown_url

    plain = re.sub(r"[^a-z0-9]+", "_", name.lower())[:40].strip("_")
    schema = f"{plain}_{secrets.token_hex(6)}"
    database = PostgresDatabase(url, schema, write=True, layout=layout)
    try:
        database.create()
    finally:
        database.close()
    atomic_write_bytes(folder / pointer, json_bytes({"url": shown_url(url), "schema": schema}))


def pointed_database(
    folder: Path, pointer: str, *, write: bool, layout: Layout = CATALOGUE_LAYOUT
) -> Database:
    """The database that a folder's pointer names. Raises StoreError for a broken pointer, or a server nobody trusts."""
    from sorvolo.store.site.postgres_database import PostgresDatabase

    url, schema = _read_pointer(folder, pointer)
    return PostgresDatabase(_trusted(url, folder), schema, write=write, layout=layout)


def _read_pointer(folder: Path, pointer: str) -> tuple[URL, str]:
    try:
        content = json.loads(read_below(folder, pointer, _MOST_BYTES))
        url, schema = parsed_url(content["url"]), content["schema"]
        if url is None or not _NAME.fullmatch(schema):
            raise ValueError("no address of a database")
    except (OSError, ValueError, TypeError, KeyError, AttributeError, RecursionError, SettingsError) as error:
        raise StoreError(
            f"{folder / pointer} does not name a catalogue (schema and url were needed); restore it from a copy"
        ) from error
    return url, schema


def _trusted(url: URL, folder: Path) -> URL:
    """The environment's URL of the same database; its only one where the server has moved.

    A folder that a stranger made must not have us connect, with the user's password, wherever it likes.
    """
    from sorvolo.store.site.postgres_database import shown_url

    urls = trusted_urls()
    same = [each for each in urls if shown_url(each) == shown_url(url)]
    if same or len(urls) == 1:
        return (same or urls)[0]
    raise StoreError(
        f"the catalogue of {folder} lies in PostgreSQL, at {shown_url(url)}; if you trust that server, set "
        f"{VARIABLE}={shown_url(url)} (with USER@ before the host where your name there is another)"
    )
