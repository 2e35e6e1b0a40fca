"""A service over the shipped airspace on a socket, for those who know of it only what its OpenAPI document says."""

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from app.main import create_app
from app.settings import Settings
from app.times import ServerClock, parse_time
from tests.api.listening import listening

# Five minutes before what the document's examples ask for.
START = "2026-11-22T07:55:00Z"


@contextmanager
def running(folder: Path, **options: Any) -> Iterator[str]:
    """Serve from a folder, with these settings; yield the address."""
    settings = Settings.model_validate({"ledger": str(folder / "ledger.sqlite"), **options})
    clock = ServerClock(parse_time(START))
    with listening(create_app(settings, clock, elapsed_ms=clock.elapsed_ms), settings) as port:
        yield f"http://127.0.0.1:{port}"
