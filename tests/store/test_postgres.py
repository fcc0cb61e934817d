"""A catalogue in PostgreSQL: nothing is lost or doubled, whatever server, role, password or network do."""

import json
import shutil
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from fake_flights import SITE, frame, image, map_flight, tile
from sqlalchemy.exc import OperationalError

from postgres_server import PostgresServer
from sorvolo.cli.main import main
from sorvolo.errors import SettingsError, StoreError, UnavailableError
from sorvolo.store.copies.folder import FolderEnd
from sorvolo.store.copies.transfer import copy
from sorvolo.store.site import database as postgres_module
from sorvolo.store.site import schema
from sorvolo.store.site.archive import Archive
from sorvolo.store.site.catalogue_place import (
    CATALOGUE,
    POINTER,
    VARIABLE,
    Catalogues,
    chosen_catalogues,
    parsed_url,
)
from sorvolo.store.site.database import ConnectionLostError, PostgresDatabase
from sorvolo.store.site.journal import Entry

PASSWORD = "c0rrect-horse"


@pytest.fixture
def site(postgres: PostgresServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A site with one flight, its catalogue in PostgreSQL."""
    monkeypatch.setenv(VARIABLE, postgres.url)
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=2)
    return tmp_path / "site"


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(postgres_module, "_PATIENCE_S", 0.5)


def schema_of(site: Path) -> str:
    return json.loads((site / POINTER).read_text())["schema"]


def content(site: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in site.rglob("*") if path.is_file()}


def test_the_folder_names_the_schema_and_no_secret(
    postgres: PostgresServer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(
        VARIABLE, postgres.url.replace("sorvolo@", f"sorvolo:{PASSWORD}@")
    )  # this user needs none
    with Archive.open(tmp_path / "Feld 3", write=True) as archive:
        archive.create_site(SITE)
    pointer = json.loads((tmp_path / "Feld 3" / POINTER).read_text())
    assert pointer["url"] == postgres.url.replace("sorvolo@", "")
    assert (
        pointer["schema"].startswith("sorvolo_feld_3_")
        and not (tmp_path / "Feld 3" / "site.db").exists()
    )


def test_a_folder_connects_nowhere_that_its_user_did_not_name(
    site: Path, monkeypatch: pytest.MonkeyPatch, postgres: PostgresServer
) -> None:
    monkeypatch.setattr(
        postgres_module, "create_engine", lambda *_, **__: pytest.fail("it would connect")
    )
    for trusted in ("", "sqlite", "postgresql://a.example/x postgresql://b.example/y"):
        monkeypatch.setenv(VARIABLE, trusted)
        with pytest.raises(
            StoreError, match=rf"{VARIABLE}=postgresql://127\.0\.0\.1:{postgres.port}/postgres"
        ):
            Archive.open(site, write=False)


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{}",
        '{"url": "sqlite", "schema": "a"}',
        '{"url": 3, "schema": 4}',
        "[" * 9999,
        '{"url": "postgresql://127.0.0.1/x", "schema": "a; DROP SCHEMA public"}',
    ],
)
def test_a_pointer_that_is_none_is_refused_and_left_alone(tmp_path: Path, content: str) -> None:
    (tmp_path / POINTER).write_text(content)
    for write in (True, False):
        with pytest.raises(StoreError, match="does not name a catalogue"):
            Archive.open(tmp_path, write=write)
    assert (tmp_path / POINTER).read_text() == content


@pytest.mark.parametrize(
    "words", ["postgresql://host", "mysql://host/db", "field", "postgresql://host:port/db"]
)
def test_an_address_that_is_none_is_refused(words: str) -> None:
    with pytest.raises(SettingsError, match="postgresql://USER@HOST/DATABASE"):
        parsed_url(words)


def test_a_site_keeps_its_catalogue_where_it_is(
    site: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, postgres: PostgresServer
) -> None:
    with pytest.raises(SettingsError, match="lies in PostgreSQL already"):
        chosen_catalogues(site, "sqlite")
    with pytest.raises(SettingsError, match="leave the password out"):
        chosen_catalogues(tmp_path / "new", f"postgresql://me:{PASSWORD}@host/db")
    monkeypatch.setenv(VARIABLE, "sqlite")
    with Archive.open(tmp_path / "file", write=True):
        pass
    monkeypatch.setenv(VARIABLE, postgres.url)
    with (
        Archive.open(tmp_path / "file", write=True),
        pytest.raises(SettingsError, match="in its folder already"),
    ):
        chosen_catalogues(tmp_path / "file", postgres.url)


def test_what_one_command_chooses_holds_for_no_other(
    postgres: PostgresServer, tmp_path: Path
) -> None:
    chosen = Catalogues.of_environment().choosing(postgres.url)
    for name, catalogues, file in (("chosen", chosen, POINTER), ("plain", None, CATALOGUE)):
        with Archive.open(tmp_path / name, write=True, catalogues=catalogues):
            pass
        assert (tmp_path / name / file).is_file()
    with Archive.open(tmp_path / "chosen", write=False, catalogues=chosen) as archive:
        assert not archive.has_site
    with pytest.raises(StoreError, match=f"set {VARIABLE}="):
        Archive.open(tmp_path / "chosen", write=False)


def test_a_lost_schema_costs_no_file(site: Path, postgres: PostgresServer) -> None:
    """As a database that was restored without it: pictures that no catalogue names are not thrown away."""
    name, before = schema_of(site), content(site)
    postgres.sql(f"ALTER SCHEMA {name} RENAME TO {name}_x")
    for write in (True, False):
        with pytest.raises(StoreError, match=f"no schema {name}"):
            Archive.open(site, write=write)
    postgres.sql(f"CREATE SCHEMA {name}")
    with pytest.raises(StoreError, match=r"damaged or not a Sorvolo catalogue"):
        Archive.open(site, write=True)
    assert content(site) == before
    postgres.sql(f"DROP SCHEMA {name}", f"ALTER SCHEMA {name}_x RENAME TO {name}")
    with Archive.open(site, write=True) as archive:
        assert len(archive.keyframes()) == 2


def test_a_later_format_is_refused(site: Path, postgres: PostgresServer) -> None:
    postgres.sql(f"UPDATE {schema_of(site)}.numbers SET last = 77 WHERE name = 'format'")
    for write in (True, False):
        with pytest.raises(StoreError, match=rf"version 77,.* version {schema.FORMAT};"):
            Archive.open(site, write=write)


def test_another_machine_s_writer_is_noticed(site: Path, tmp_path: Path, impatient: None) -> None:
    """Of which the folder's lock knows nothing: the advisory lock does."""
    other = tmp_path / "other machine"
    shutil.copytree(site, other)
    with Archive.open(site, write=True):
        with pytest.raises(StoreError, match="another process is mapping"):
            Archive.open(other, write=True)
        with Archive.open(other, write=False) as reader:
            assert len(reader.flights()) == 1
    with Archive.open(other, write=True):
        pass


def test_a_killed_writer_s_lock_is_free_soon(site: Path) -> None:
    program = (
        "import os, sys; from pathlib import Path; from sorvolo.store.site.archive import Archive\n"
        "archive = Archive.open(Path(sys.argv[1]), write=True)\n"
        "archive.begin_flight('b', '', {}).flush()\n"
        "os.kill(os.getpid(), 9)\n"
    )
    assert subprocess.run([sys.executable, "-c", program, str(site)]).returncode == -9
    with Archive.open(site, write=True) as archive:
        assert [each.id for each in archive.flights()] == ["a"]
        assert map_flight(archive, "b", 60, count=1) == 2  # the number of the killed one


def test_a_server_that_restarts_between_two_steps_is_waited_for(
    site: Path, postgres: PostgresServer
) -> None:
    with Archive.open(site, write=True) as archive, archive.begin_flight("b", "", {}) as writer:
        path = writer.save_image(0, image(0))
        writer.tiles[3, 3] = tile(9)
        postgres.stop()
        again = threading.Timer(1.0, postgres.start)
        again.start()
        writer.flush()
        again.join()
        writer.commit([frame(0)], {0: path}, {}, "")
        assert len(archive.live_tiles()) == 3
    with Archive.open(site, write=False) as reader:
        assert [each.id for each in reader.flights()] == ["a", "b"]


def test_a_server_that_is_gone_ends_a_flight_as_a_kill_does(
    site: Path, postgres: PostgresServer, impatient: None
) -> None:
    with Archive.open(site, write=True) as archive:
        journal = archive.journal("b", "key")
        journal.append(Entry("frame", {}))
        with (
            pytest.raises(
                ConnectionLostError, match=r"run the same command again.*continues where it was"
            ),
            archive.begin_flight("b", "", {}, journal=journal) as writer,
        ):
            writer.save_image(0, image(0))
            postgres.stop()
            try:
                writer.flush()
            finally:
                postgres.start()
    with Archive.open(site, write=True) as archive:  # for the run that goes on
        assert archive.journal("b", "key").is_begun and list(
            site.glob("flights/b/keyframes/*/*.jpg")
        )
        assert [each.id for each in archive.flights()] == ["a"] and len(archive.tiles()) == 2
        assert map_flight(archive, "b", 60, count=1) == 2


def test_a_connection_cut_within_a_transaction_undoes_it_whole(
    site: Path, postgres: PostgresServer
) -> None:
    cut = (
        "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'sorvolo' AND pid <> "
        "pg_backend_pid()"
    )
    with Archive.open(site, write=True) as archive:
        catalogue = archive.catalogue
        with pytest.raises(ConnectionLostError), catalogue.changing() as connection:
            connection.execute(schema.site.update().values(derived_version=7))
            postgres.sql(cut)
            connection.execute(schema.site.update().values(derived_version=8))
        assert archive.exported_version not in (7, 8)
        with catalogue.changing() as connection:  # locked again
            connection.execute(schema.site.update().values(derived_version=8))
        assert archive.exported_version == 8


def test_a_writer_that_lost_its_lock_to_another_stops(
    site: Path, tmp_path: Path, postgres: PostgresServer
) -> None:
    other = tmp_path / "other machine"
    shutil.copytree(site, other)
    with Archive.open(site, write=True) as archive:
        postgres.sql(
            "SELECT pg_terminate_backend(pid) FROM pg_stat_activity WHERE application_name = 'sorvolo'"
        )
        with Archive.open(other, write=True):
            pass
        with pytest.raises(StoreError, match="another process wrote"):
            archive.begin_flight("b", "", {})


def test_a_wrong_password_is_named_and_never_shown(
    site: Path,
    tmp_path: Path,
    postgres: PostgresServer,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    postgres.sql("DROP ROLE IF EXISTS guarded", f"CREATE ROLE guarded LOGIN PASSWORD '{PASSWORD}'")
    name = schema_of(site)
    postgres.sql(
        f"GRANT USAGE ON SCHEMA {name} TO guarded",
        f"GRANT SELECT ON ALL TABLES IN SCHEMA {name} TO guarded",
    )
    url = f"postgresql://guarded@127.0.0.1:{postgres.port}/postgres"
    monkeypatch.setenv("PGPASSFILE", str(tmp_path / "none"))
    for wrong in (url.replace("guarded@", "guarded:wr0ng-horse@"), url):
        monkeypatch.setenv(VARIABLE, wrong)
        assert main(["--debug", "history", str(site)]) == 1
        printed = "".join(capsys.readouterr())
        assert (
            "~/.pgpass or PGPASSWORD" in printed.splitlines()[-1] and "wr0ng-horse" not in printed
        )
    monkeypatch.setenv(VARIABLE, url)
    monkeypatch.setenv("PGPASSWORD", PASSWORD)
    with Archive.open(site, write=False) as reader:
        assert len(reader.keyframes()) == 2
    # this role may read
    before = content(site)
    with pytest.raises(
        StoreError, match=r"cannot be written or read by guarded \(permission denied"
    ):
        Archive.open(site, write=True)
    with pytest.raises(StoreError, match="permission denied"):
        Archive.open(site.parent / "new", write=True)
    assert content(site) == before and not (site.parent / "new" / POINTER).exists()


def test_a_full_server_is_named(site: Path, postgres: PostgresServer) -> None:
    """As the server reports it: a trigger raises the error of a full disk."""
    name = schema_of(site)
    postgres.sql(
        f"CREATE FUNCTION {name}.full_disk() RETURNS trigger LANGUAGE plpgsql AS "
        "$$ BEGIN RAISE EXCEPTION 'could not extend file: No space left on device' USING ERRCODE = '53100'; END $$",
        f"CREATE TRIGGER full_disk BEFORE INSERT ON {name}.keyframes EXECUTE FUNCTION {name}.full_disk()",
    )
    with (
        Archive.open(site, write=True) as archive,
        pytest.raises(StoreError, match=r"disk full.*on the server"),
    ):
        map_flight(archive, "b", 60, count=1)
    postgres.sql(f"DROP TRIGGER full_disk ON {name}.keyframes")
    with Archive.open(site, write=True) as archive:
        assert [each.id for each in archive.flights()] == ["a"]
        map_flight(archive, "b", 60, count=1)


def test_a_standby_is_read_and_named_when_it_is_to_be_written(
    site: Path, postgres: PostgresServer
) -> None:
    postgres.stop()
    postgres.start(only_reads=True)
    try:
        with Archive.open(site, write=False) as reader:
            assert [each.id for each in reader.flights()] == ["a"]
        words = r"takes no changes \(cannot execute .* in a read-only transaction\): a standby, or set to read only"
        with pytest.raises(StoreError, match=words), Archive.open(site, write=True) as archive:
            map_flight(archive, "b", 60, count=1)
        with pytest.raises(StoreError, match=words):
            Archive.open(site.parent / "new", write=True)
        assert not (site.parent / "new" / POINTER).exists()
    finally:
        postgres.stop()
        postgres.start()
    with Archive.open(site, write=True) as archive:
        assert map_flight(archive, "b", 60, count=1) == 2


def test_a_database_set_to_read_only_is_read_and_never_written(
    site: Path, postgres: PostgresServer
) -> None:
    """As hosts set a database whose disk is full: any session could undo it, and would fill the rest."""
    postgres.sql("ALTER DATABASE postgres SET default_transaction_read_only = on")
    before = content(site)
    try:
        with Archive.open(site, write=False) as reader:
            assert [each.id for each in reader.flights()] == ["a"]
        with (
            pytest.raises(StoreError, match="as hosts do when a disk is full"),
            Archive.open(site, write=True) as archive,
        ):
            map_flight(archive, "b", 60, count=1)
        assert content(site) == before
    finally:
        postgres.sql("ALTER DATABASE postgres RESET ALL", database="template1")
    with Archive.open(site, write=True) as archive:
        assert map_flight(archive, "b", 60, count=1) == 2


@pytest.fixture
def small_database(postgres: PostgresServer) -> Iterator[tuple[str, Path]]:
    """The address of a database on a file system of 24 MB, and that one's folder."""
    place = postgres.folder / "small"
    place.mkdir()
    mounted = (
        shutil.which("mount")
        and not subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=24m", "tmpfs", str(place)], capture_output=True
        ).returncode
    )
    if not mounted:
        place.rmdir()
        pytest.skip("this user may not mount a small file system")
    shutil.chown(place, postgres.folder.owner())
    postgres.sql(
        f"CREATE TABLESPACE small LOCATION '{place}'", "CREATE DATABASE small TABLESPACE small"
    )
    yield postgres.url.replace("/postgres", "/small"), place
    postgres.sql("DROP DATABASE small WITH (FORCE)", "DROP TABLESPACE small")
    subprocess.run(["umount", "-l", str(place)], check=True)
    place.rmdir()


def test_a_disk_of_the_server_that_fills_costs_one_flight(
    small_database: tuple[str, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    url, disk = small_database
    monkeypatch.setenv(VARIABLE, url)
    filler = disk / "filler"
    with Archive.open(tmp_path / "site", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=2)
        with open(filler, "wb", buffering=0) as file, suppress(OSError):
            while file.write(bytes(4096)):
                pass
        with pytest.raises(
            StoreError, match=r"disk full: .*No space left on device.*on the server"
        ):
            for number in range(200):  # what the pages that are there still hold is written
                map_flight(archive, f"b{number}", 60, count=1)
        kept = [each.id for each in archive.flights()]
        filler.unlink()
        map_flight(archive, "c", 90, count=1)
        assert [each.id for each in archive.flights()] == [*kept, "c"]


def test_a_server_so_full_that_nobody_can_connect_is_named_as_full() -> None:
    url = parsed_url("postgresql://sorvolo@127.0.0.1/small")
    assert url is not None
    error = PostgresDatabase(url, "sorvolo_x", write=True)._fault(
        OperationalError("", {}, Exception("FATAL:  could not write init file"))
    )
    assert str(error).startswith("disk full: could not write postgresql://127.0.0.1/small")


@pytest.mark.parametrize(
    ("user", "database", "more", "words"),
    [
        (
            "nobody_x",
            "postgres",
            "",
            r'refused nobody_x .*"nobody_x" does not exist\); name another user',
        ),
        (
            "plain",
            "closed",
            "",
            r'permission denied for database "closed" .*ask for a role that may connect',
        ),
        ("plain", "postgres", "sslmode=require", "does not support SSL.*correct sslmode"),
        (
            "kept_out",
            "postgres",
            "",
            "pg_hba.conf.*have the server's administrator let this user and computer in",
        ),
        (
            "plain",
            "survey_x",
            "",
            r'"survey_x" does not exist.*make the database, or correct the address',
        ),
        ("guarded:wrong", "postgres", "", "password authentication failed.*give the password in"),
        ("guarded", "postgres", "", "no password supplied.*give the password in"),
    ],
)
def test_who_is_not_let_in_is_an_error_and_not_waited_for(
    user: str,
    database: str,
    more: str,
    words: str,
    tmp_path: Path,
    postgres: PostgresServer,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    _make_roles(postgres)
    monkeypatch.setenv(
        VARIABLE, f"postgresql://{user}@127.0.0.1:{postgres.port}/{database}?{more}".rstrip("?")
    )
    with pytest.raises(StoreError, match=words) as caught:
        Archive.open(tmp_path / "site", write=True)
    assert not isinstance(caught.value, UnavailableError)


def _make_roles(server: PostgresServer) -> None:
    for role in ("plain", "kept_out", "guarded"):
        if not server.sql(f"SELECT 1 FROM pg_roles WHERE rolname = '{role}'"):
            server.sql(f"CREATE ROLE {role} LOGIN PASSWORD '{PASSWORD}'")
    if not server.sql("SELECT 1 FROM pg_database WHERE datname = 'closed'"):
        server.sql("CREATE DATABASE closed", "REVOKE CONNECT ON DATABASE closed FROM PUBLIC")


def test_a_setting_in_the_address_that_the_server_refuses_is_named(
    tmp_path: Path, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, f"{postgres.url}?options=-cwork_mem=much")
    with pytest.raises(StoreError, match=r'"work_mem".*; correct the address') as caught:
        Archive.open(tmp_path / "site", write=True)
    assert not isinstance(caught.value, UnavailableError)


@pytest.mark.parametrize(
    ("more", "words"),
    [
        ("sslmod=require", 'invalid connection option "sslmod"'),
        ("sslmode=must", 'invalid sslmode value: "must"'),
    ],
)
def test_an_option_of_an_address_that_nobody_knows_is_named(
    more: str, words: str, tmp_path: Path, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, f"{postgres.url}?{more}")
    with pytest.raises(StoreError, match=f"{words}; correct the address") as caught:
        Archive.open(tmp_path / "site", write=True)
    assert not isinstance(caught.value, UnavailableError)


@pytest.fixture
def silent() -> Iterator[int]:
    """The port of a server that takes connections and never answers."""
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        yield listener.getsockname()[1]


def test_a_server_that_is_not_there_or_never_answers_is_named(
    tmp_path: Path, silent: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        nobody = free.getsockname()[1]
    for port in (nobody, silent):
        monkeypatch.setenv(VARIABLE, f"postgresql://me@127.0.0.1:{port}/survey?connect_timeout=2")
        with pytest.raises(
            ConnectionLostError, match=rf"no connection to postgresql://127\.0\.0\.1:{port}/survey"
        ):
            Archive.open(tmp_path / "site", write=True)
    assert not (tmp_path / "site" / POINTER).exists()


def test_a_database_that_is_not_there_or_of_another_kind_is_named(
    tmp_path: Path, postgres: PostgresServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv(VARIABLE, postgres.url.replace("/postgres", "/survey_x"))
    with pytest.raises(StoreError, match=r'"survey_x" does not exist.*make the database'):
        Archive.open(tmp_path / "site", write=True)
    postgres.sql("CREATE DATABASE latin ENCODING 'LATIN1' TEMPLATE template0 LOCALE 'C'")
    monkeypatch.setenv(VARIABLE, postgres.url.replace("/postgres", "/latin"))
    with pytest.raises(StoreError, match="encoding LATIN1, UTF8 was needed"):
        Archive.open(tmp_path / "site", write=True)
    monkeypatch.setenv(VARIABLE, postgres.url)
    monkeypatch.setattr(postgres_module, "OLDEST_SERVER", 99)
    with pytest.raises(StoreError, match=r"is PostgreSQL \d+, 99 or later was needed"):
        Archive.open(tmp_path / "site", write=True)


def copied(source: Path, target: Path, scratch: Path) -> None:
    scratch.mkdir(exist_ok=True)
    for _ in copy(FolderEnd(source), FolderEnd(target), scratch):
        pass


def test_a_site_of_today_moves_into_the_database(
    postgres: PostgresServer,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    with Archive.open(tmp_path / "old", write=True) as archive:
        archive.create_site(SITE)
        map_flight(archive, "a", 20, count=2, compared=True)
    words = [
        "site",
        "copy",
        str(tmp_path / "old"),
        str(tmp_path / "new"),
        "--catalogue",
        postgres.url,
    ]
    assert main(words) == 0 and main(words) == 0, capsys.readouterr().err
    assert (tmp_path / "new" / POINTER).is_file() and not (tmp_path / "new" / "site.db").exists()
    with pytest.raises(
        StoreError, match=f"set {VARIABLE}="
    ):  # --catalogue was for that command alone
        Archive.open(tmp_path / "new", write=False)
    monkeypatch.setenv(VARIABLE, postgres.url)
    with (
        Archive.open(tmp_path / "old", write=False) as old,
        Archive.open(tmp_path / "new", write=True) as new,
    ):
        assert new.flights() == old.flights() and len(new.changes()) == len(old.changes()) == 2
        assert map_flight(new, "b", 60, count=1) == 2
    assert (
        main(
            ["site", "copy", str(tmp_path / "old"), "s3://bucket/new", "--catalogue", postgres.url]
        )
        == 1
    )


def test_a_copy_s_catalogue_is_a_file_and_may_be_copied_back(site: Path, tmp_path: Path) -> None:
    with Archive.open(site, write=True) as archive:
        map_flight(archive, "b", 60, count=1, compared=True)
    copied(site, tmp_path / "copy", tmp_path / "scratch")
    assert (tmp_path / "copy" / "site.db").is_file() and not (tmp_path / "copy" / POINTER).exists()
    with (
        Archive.open(site, write=False) as archive,
        Archive.open(tmp_path / "copy", write=True) as copy_of,
    ):
        assert copy_of.flights() == archive.flights() and copy_of.versions() == archive.versions()
        assert (
            [each.id for each in copy_of.changes()] == [each.id for each in archive.changes()] != []
        )
        assert map_flight(copy_of, "c", 70, count=1) == 3
    copied(tmp_path / "copy", site, tmp_path / "again")
    with Archive.open(site, write=True) as archive:
        assert [each.id for each in archive.flights()] == ["a", "b", "c"]
        assert map_flight(archive, "d", 80, count=1) == 4
