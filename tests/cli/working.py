"""What workers do in tests that need no service. A module of its own, for each worker imports it anew.

Each leaves a file named by its process id in a folder.
"""

import os
import signal
import sys
import time
from collections.abc import Callable
from pathlib import Path

LONG_S = 60.0


def works(folder: Path, ready: Callable[[], None]) -> None:
    """Start and go on, unless interrupted."""
    _leave_trace(folder)
    ready()
    try:
        time.sleep(LONG_S)
    except KeyboardInterrupt:
        (folder / "interrupted").touch()


def cannot_start(folder: Path, _ready: Callable[[], None]) -> None:
    """Die before being ready."""
    _leave_trace(folder)
    sys.exit(2)


def freezes(folder: Path, ready: Callable[[], None]) -> None:
    """Freeze a while after being ready; who comes after the first does not."""
    if _leave_trace(folder) == 0:
        ready()
        time.sleep(0.5)
        os.kill(os.getpid(), signal.SIGSTOP)
    works(folder, ready)


def dies_and_starts_badly(folder: Path, ready: Callable[[], None]) -> None:
    """Die after being ready; then die before it; then end the service."""
    before = _leave_trace(folder)
    if before == 1:
        sys.exit(3)
    ready()
    if before == 0:
        time.sleep(0.5)
        sys.exit(4)
    os.kill(os.getppid(), signal.SIGTERM)
    time.sleep(LONG_S)


def does_not_stop(folder: Path, ready: Callable[[], None]) -> None:
    """Ignore that it shall end."""
    signal.signal(signal.SIGTERM, signal.SIG_IGN)
    works(folder, ready)


def _leave_trace(folder: Path) -> int:
    """Return how many were there before."""
    before = len(list(folder.iterdir()))
    (folder / str(os.getpid())).touch()
    return before
