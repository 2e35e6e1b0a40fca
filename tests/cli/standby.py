"""A hot standby of a private PostgreSQL server: it follows the server, and answers reads only."""

import shutil
import socket
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from urllib.parse import urlsplit

from tests.postgres import Cluster, _as_owner, _guarded, _owner, _programs


@contextmanager
def standby(primary: Cluster) -> Iterator[int]:
    """Run a standby and yield its port; user, password and databases are the primary's."""
    with TemporaryDirectory(prefix="airmatrix-standby-", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        shutil.chown(folder, *_owner())
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = int(probe.getsockname()[1])
        data = f"--pgdata={folder / 'data'}"
        source = f"--dbname={primary.url('postgres')}"
        _run(folder, "pg_basebackup", data, source, "--write-recovery-conf", "--checkpoint=fast", "--no-sync")
        with (folder / "data" / "postgresql.conf").open("a") as file:
            file.write(f"port = {port}\n")
        with _guarded(folder):
            _run(folder, "pg_ctl", "start", "--wait", "--silent", data, f"--log={folder / 'log'}")
            yield port


def on_port(location: str, port: int) -> str:
    """Return the location of the same database on another port."""
    parts = urlsplit(location)
    return parts._replace(netloc=parts.netloc.replace(f":{parts.port}", f":{port}")).geturl()


def _run(folder: Path, program: str, *arguments: str) -> None:
    # Into a file: a pipe would stay open as long as the server, which inherits it.
    with (folder / "said").open("w") as said:
        subprocess.run(
            [_programs() / program, *arguments], check=True, cwd=folder, stdout=said, stderr=said, **_as_owner()
        )
