"""PostgreSQL for tests and measurements: a private server that is gone afterwards, or one that exists.

    with cluster(durable=True) as server:
        location = server.database()

`AIRMATRIX_TEST_POSTGRES=postgresql://user:password@host/database` names a server to use in the suite instead; databases
are then made and dropped there, so its user must be allowed to.
"""

import os
import pwd
import secrets
import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal
from urllib.parse import urlsplit

import psycopg
from psycopg import sql

VARIABLE = "AIRMATRIX_TEST_POSTGRES"
_PROGRAMS = ("initdb", "pg_ctl", "postgres")
_ATTEMPTS = 3

# A crash of the machine may lose everything, which is gone soon anyway.
_FORGETFUL = {"fsync": "off", "full_page_writes": "off"}

# Waits until its standard input ends, however we ended, then leaves nothing of the server behind.
_GUARDIAN = 'read -r _; "$0" stop --silent --mode=immediate --pgdata="$1/data"; rm -rf "$1"'

Mode = Literal["fast", "immediate"]


class NoPostgres(Exception):
    """There is no PostgreSQL to be had; the text says how to get it."""


class Server:
    """A server, reached by the URL of a database that is always there."""

    def __init__(self, url: str) -> None:
        self._url = url
        self._made: set[str] = set()

    def url(self, database: str) -> str:
        """Return the URL of a database."""
        return urlsplit(self._url)._replace(path=f"/{database}").geturl()

    def connect(self) -> psycopg.Connection[Any]:
        """Return a connection outside of all ledgers, which commits every statement by itself."""
        return psycopg.connect(self._url, autocommit=True)

    def database(self, template: str | None = None) -> str:
        """Make a database and return its URL: an empty one, or a copy of one that nobody is connected to."""
        name = f"airmatrix_{secrets.token_hex(8)}"
        source = "template0" if template is None else _database_of(template)
        with self.connect() as connection:
            connection.execute(
                sql.SQL("CREATE DATABASE {} TEMPLATE {}").format(sql.Identifier(name), sql.Identifier(source))
            )
        self._made.add(name)
        return self.url(name)

    def drop(self, url: str) -> None:
        """Drop a database that `database` made, whoever is connected to it."""
        name = _database_of(url)
        self._made.remove(name)
        with self.connect() as connection:
            connection.execute(sql.SQL("DROP DATABASE {} WITH (FORCE)").format(sql.Identifier(name)))

    def drop_all(self) -> None:
        """Drop every database that `database` made."""
        for name in sorted(self._made):
            self.drop(self.url(name))


class Cluster(Server):
    """A private server on a free port of the loopback interface, its files in a folder of its own."""

    def __init__(self, folder: Path, *, durable: bool) -> None:
        self._folder = folder
        self._programs = _programs()
        password = secrets.token_hex(16)
        self._initialise(password, {} if durable else _FORGETFUL)
        super().__init__(f"postgresql://airmatrix:{password}@127.0.0.1:{self._take_port()}/postgres")

    def start(self) -> None:
        """Start it, and wait until it takes connections."""
        self._control("start", f"--log={self._folder / 'log'}")

    def stop(self, mode: Mode = "fast") -> None:
        """Stop it; `immediate` is as good as a crash."""
        self._control("stop", f"--mode={mode}")

    def restart(self, mode: Mode = "fast") -> None:
        """Stop it and start it again."""
        self._control("restart", f"--mode={mode}", f"--log={self._folder / 'log'}")

    def _initialise(self, password: str, settings: dict[str, str]) -> None:
        words = self._folder / "password"
        words.write_text(password)
        shutil.chown(words, *_owner())
        self._run(
            "initdb", f"--pgdata={self._folder / 'data'}", "--username=airmatrix", f"--pwfile={words}",
            "--auth=scram-sha-256", "--encoding=UTF8", "--locale=C", "--no-sync",
        )  # fmt: skip
        self._set(listen_addresses="127.0.0.1", unix_socket_directories="", max_connections="400", **settings)

    def _take_port(self) -> int:
        """Start on a free port and return it; some other program may be faster to take one."""
        for attempt in range(_ATTEMPTS):
            with socket.socket() as probe:
                probe.bind(("127.0.0.1", 0))
                port = int(probe.getsockname()[1])
            self._set(port=str(port))
            try:
                self.start()
            except NoPostgres:
                if attempt == _ATTEMPTS - 1:
                    raise
            else:
                break
        return port

    def _set(self, **settings: str) -> None:
        """Write settings for the next start; the last of a name holds."""
        with (self._folder / "data" / "postgresql.conf").open("a") as file:
            file.writelines(f"{name} = '{value}'\n" for name, value in settings.items())

    def _control(self, *arguments: str) -> None:
        self._run("pg_ctl", *arguments, "--wait", "--silent", f"--pgdata={self._folder / 'data'}")

    def _run(self, program: str, *arguments: str) -> None:
        # Into a file: a pipe would stay open as long as the server, which inherits it.
        said = self._folder / "said"
        with said.open("w") as file:
            command: list[str | Path] = [self._programs / program, *arguments]
            done = subprocess.run(command, check=False, cwd=self._folder, stdout=file, stderr=file, **_as_owner())
        if done.returncode != 0:
            log = self._folder / "log"
            raise NoPostgres(f"{program}: {said.read_text()}{log.read_text() if log.exists() else ''}")


@contextmanager
def cluster(*, durable: bool = False) -> Iterator[Cluster]:
    """Run a private server. It survives neither Ctrl-C nor the death of this process.

    Unless it is `durable`, what it has committed does not survive a crash of the machine, and tests are faster.

    Raises
    ------
    NoPostgres
        PostgreSQL is not installed, or cannot run here.
    """
    _programs()
    with TemporaryDirectory(prefix="airmatrix-postgres-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        shutil.chown(folder, *_owner())
        with _guarded(folder):
            yield Cluster(folder, durable=durable)


@contextmanager
def server() -> Iterator[Server]:
    """Yield the server that `AIRMATRIX_TEST_POSTGRES` names, or a private one; raises `NoPostgres`."""
    url = os.environ.get(VARIABLE)
    if url is None:
        with cluster() as private:
            yield private
        return
    existing = Server(url)
    try:
        existing.connect().close()
    except psycopg.OperationalError as error:
        raise NoPostgres(f"{VARIABLE} names a server that cannot be reached: {error}") from error
    try:
        yield existing
    finally:
        existing.drop_all()


@contextmanager
def _guarded(folder: Path) -> Iterator[None]:
    """Let a process of its own session, which Ctrl-C does not reach, clear up when we end, in whatever way."""
    guardian = subprocess.Popen(
        ["/bin/sh", "-c", _GUARDIAN, _programs() / "pg_ctl", folder],
        cwd="/", stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True,
        **_as_owner(),
    )  # fmt: skip
    try:
        yield
    finally:
        guardian.communicate(b"\n")


def _programs() -> Path:
    """Return the folder of PostgreSQL's programs, the newest where there are several versions."""
    found = [Path(path).resolve().parent for path in [shutil.which("initdb")] if path is not None]
    found += sorted(Path("/usr/lib/postgresql").glob("*/bin"), key=lambda path: float(path.parent.name), reverse=True)
    for folder in found:
        if all((folder / program).exists() for program in _PROGRAMS):
            return folder
    raise NoPostgres(
        f"PostgreSQL is not installed: `apt-get install postgresql`, or let {VARIABLE} name a server to make "
        "databases on, as postgresql://user:password@host/database"
    )


def _owner() -> tuple[int, int]:
    """Return the user and the group that the server runs as: PostgreSQL refuses to run as root."""
    if os.geteuid() != 0:
        return os.geteuid(), os.getegid()
    try:
        account = pwd.getpwnam("postgres")
    except KeyError:
        raise NoPostgres("PostgreSQL does not run as root, and there is no user `postgres` to run it") from None
    return account.pw_uid, account.pw_gid


def _as_owner() -> dict[str, Any]:
    """Return how to start a process as the server's user."""
    user, group = _owner()
    return {"user": user, "group": group, "extra_groups": []} if os.geteuid() == 0 else {}


def _database_of(url: str) -> str:
    return urlsplit(url).path.removeprefix("/")
