"""A PostgreSQL server of the tests' own, in a temporary folder, as a user without rights; gone with the tests."""

import os
import pwd
import shutil
import socket
import subprocess
import tempfile
from pathlib import Path

_SETTINGS = {  # nothing here outlives the tests
    "listen_addresses": "127.0.0.1",
    "unix_socket_directories": "",
    "fsync": "off",
    "full_page_writes": "off",
    "shared_buffers": "16MB",
    "max_connections": "60",
    "log_min_messages": "error",
}
_HBA = """host all guarded 127.0.0.1/32 scram-sha-256
host all kept_out 127.0.0.1/32 reject
host all all 127.0.0.1/32 trust
"""


def program(name: str) -> str | None:
    """Debian keeps the server's programs out of the path."""
    found = shutil.which(name)
    beside = sorted(
        Path("/usr/lib/postgresql").glob(f"*/bin/{name}"), key=lambda path: int(path.parts[-3])
    )
    return str(beside[-1]) if beside else found


class PostgresServer:
    """A server on a port of its own; may be stopped and started again.

    The user "guarded" needs a password, "kept_out" is let in nowhere.
    """

    def __init__(self, language: str = "C", locales: Path | None = None) -> None:
        """Its messages are in `language`, one of the locales in the folder `locales`."""
        self._language, self._locales = language, locales
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        self.folder = Path(tempfile.mkdtemp(prefix="sorvolo-postgres-"))
        self._user = None
        if os.getuid() == 0:
            self._user = "postgres" if _is_known("postgres") else "nobody"
            shutil.chown(self.folder, self._user)
        initdb = [
            program("initdb"),
            "-D",
            str(self._data),
            "-U",
            "sorvolo",
            "-A",
            "trust",
            "-E",
            "UTF8",
            "-N",
        ]
        self._run([*initdb, "--locale=C"])
        (self._data / "pg_hba.conf").write_text(_HBA)
        self.start()

    @property
    def url(self) -> str:
        return f"postgresql://sorvolo@127.0.0.1:{self.port}/postgres"

    @property
    def _data(self) -> Path:
        return self.folder / "data"

    def start(self, *, only_reads: bool = False) -> None:
        """Start it; with `only_reads` as a standby, which takes no changes."""
        standby = self._data / "standby.signal"
        standby.touch() if only_reads else standby.unlink(missing_ok=True)
        settings = _SETTINGS | {"port": str(self.port), "lc_messages": self._language}
        options = " ".join(f"-c {name}='{value}'" for name, value in settings.items())
        self._run(
            [
                program("pg_ctl"),
                "-D",
                str(self._data),
                "-w",
                "-t",
                "60",
                "-l",
                str(self.folder / "log"),
                "-o",
                options,
                "start",
            ]
        )

    def stop(self) -> None:
        """As good as a crash: connections are cut."""
        self._run([program("pg_ctl"), "-D", str(self._data), "-w", "-m", "immediate", "stop"])

    def remove(self) -> None:
        self.stop()
        shutil.rmtree(self.folder)

    def sql(self, *statements: str, database: str = "postgres") -> list[tuple[object, ...]]:
        """Run statements, each in a transaction of its own; the rows of the last one."""
        import psycopg  # an extra, as the server is

        with psycopg.connect(
            self.url.replace("/postgres", f"/{database}"), autocommit=True
        ) as connection:
            for each in statements:
                cursor = connection.execute(each)
            return cursor.fetchall() if cursor.description else []

    def _run(self, command: list[str | None]) -> None:
        # a language and a home of its own: neither the tester's language nor files are to matter
        environment = {"PATH": os.environ["PATH"], "LANG": "C", "HOME": str(self.folder)}
        if self._locales is not None:
            environment["LOCPATH"] = str(self._locales)
        with open(self.folder / "output", "w+") as output:  # no pipe: the server would keep it open
            done = subprocess.run(
                [str(each) for each in command],
                user=self._user,
                cwd=self.folder,
                env=environment,
                stdout=output,
                stderr=output,
                timeout=120,
            )
            output.seek(0)
            assert done.returncode == 0, output.read()


def _is_known(user: str) -> bool:
    try:
        pwd.getpwnam(user)
    except KeyError:
        return False
    return True
