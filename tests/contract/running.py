"""A service over the shipped airspace on a socket, for those who know of it only what its OpenAPI document says."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import uvicorn

from app.commands.serve import configuration
from app.main import create_app
from app.settings import Settings
from app.times import ServerClock, parse_time

# Five minutes before what the document's examples ask for.
START = "2026-11-22T07:55:00Z"


@contextmanager
def running(folder: Path, **options: Any) -> Iterator[str]:
    """Serve from a folder, with these settings, as `airmatrix serve` does; yield the address."""
    settings = Settings.model_validate({"ledger": str(folder / "ledger.sqlite"), **options})
    clock = ServerClock(parse_time(START))
    server = uvicorn.Server(configuration(create_app(settings, clock, elapsed_ms=clock.elapsed_ms), settings))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            while not server.started and thread.is_alive():
                thread.join(0.01)
            yield f"http://127.0.0.1:{listener.getsockname()[1]}"
        finally:
            server.should_exit = True
            thread.join()
