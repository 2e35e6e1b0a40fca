"""`airmatrix serve`: the service, in one process or several that share a port and a ledger."""

import gc
import os
import resource
import signal
import socket
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from types import FrameType
from typing import Annotated

import structlog
import typer
import uvicorn
from fastapi import FastAPI

from app import auth, logs, service
from app.connections import Connection
from app.errors import RequestError, StartupError
from app.ledger import parse_location
from app.main import create_app
from app.metrics import forget_process
from app.service import Basis
from app.settings import Settings
from app.times import ServerClock, format_time
from app.workers import Workers
from planner.errors import PlannerError

log = structlog.get_logger()

_GRACE_S = 5
# Of the ledger, its temporary files, and whatever libraries open.
_FILES = 256
_REFUSED, _WRITER_DIED, _INTERRUPTED = 2, 70, 130


def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 for any.  [default: 8000]")] = None,
    ledger: Annotated[str | None, typer.Option(help="Ledger file or URL, created if absent.")] = None,
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
    aircraft_types: Annotated[Path | None, typer.Option(help="TOML file of further aircraft types.")] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, max=64, help="Processes that share the port and the ledger.  [default: 1]")
    ] = None,
    read_only: Annotated[
        bool | None, typer.Option("--read-only", help="Answer reads only, of a ledger that others write.")
    ] = None,
    clock_start: Annotated[
        str | None, typer.Option(help="For demonstrations: set the clock to this time, RFC 3339.")
    ] = None,
    clock_rate: Annotated[
        float | None, typer.Option(help="For demonstrations: seconds of its clock a second.  [default: 1]")
    ] = None,
) -> None:
    """Serve the API. Every option, and every other setting, is also an AIRMATRIX_* variable."""
    settings = Settings.given(
        host=host,
        port=port,
        ledger=ledger,
        airspace=airspace,
        aircraft_types=aircraft_types,
        workers=workers,
        read_only=read_only,
        clock_start=clock_start,
        clock_rate=clock_rate,
    )
    logs.configure(settings)
    auth.check_listening(settings)
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    # Taken before anything is created; who connects early waits until everything is ready.
    with _listen(settings.host, settings.port) as listener:
        basis = service.prepare(settings)
        if settings.allow_unauthenticated and settings.jwks is None:
            log.warning("AIRMATRIX_ALLOW_UNAUTHENTICATED: anybody who reaches this address can plan and cancel flights")
        clock = ServerClock(settings.clock_start, settings.clock_rate)
        if clock.simulated:
            log.warning(
                "SIMULATED CLOCK: no time in answers, ledger or telemetry is real; for demonstrations and tests only",
                clock=format_time(clock()),
                rate=clock.rate,
            )
        announce = partial(_announce, settings, listener)
        if settings.workers == 1:
            _work(basis, clock, listener, announce)
        else:
            _supervise(basis, clock, listener, announce)


def _supervise(basis: Basis, clock: ServerClock, listener: socket.socket, announce: Callable[[], None]) -> None:
    """Run workers until a signal comes."""
    workers = Workers(basis.settings.workers, partial(_worker, basis.settings, basis.fingerprint, clock, listener))
    # In memory, where there is such a place: a full disk must not end a worker that counts something.
    memory = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None  # noqa: S108
    with TemporaryDirectory(prefix="airmatrix-metrics-", dir=memory) as folder:
        # Where the workers add up their metrics.
        os.environ["PROMETHEUS_MULTIPROC_DIR"] = folder
        received = workers.run(on_ready=announce, on_death=forget_process, on_stop=listener.close)
    if received is signal.SIGINT:
        raise typer.Exit(_INTERRUPTED)


def _worker(
    settings: Settings, fingerprint: str, clock: ServerClock, listener: socket.socket, ready: Callable[[], None]
) -> None:
    """Be one of several processes, which must not differ in what they know."""
    logs.configure(settings)
    structlog.configure(processors=[_name_worker, *structlog.get_config()["processors"]])
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    try:
        _work(service.reread_basis(settings, fingerprint), clock, listener, ready)
    except (StartupError, PlannerError, RequestError) as error:
        log.critical("worker cannot start", error=str(error))
        sys.exit(_REFUSED)


def _work(basis: Basis, clock: ServerClock, listener: socket.socket, ready: Callable[[], None]) -> None:
    """Serve in this process until a signal comes, or the writer dies."""
    died = threading.Event()

    def end() -> None:
        died.set()
        os.kill(os.getpid(), signal.SIGTERM)

    # uvicorn ends by raising the signal that stopped it; a clean exit still closes the ledger.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(_WRITER_DIED if died.is_set() else 0))
    with service.started(basis, clock, clock.elapsed_ms, on_death=end) as running:
        config = configuration(create_app(basis.settings, running=running), basis.settings)
        allow_files(basis.settings.max_connections)
        # All that is there by now stays: looking through it for garbage stopped every thread for a tenth of a second,
        # every second or two under load.
        gc.collect()
        gc.freeze()
        ready()
        _Server(config, running.closing).run(sockets=[listener])


def configuration(app: FastAPI, settings: Settings) -> uvicorn.Config:
    """Return how the application is served over sockets."""
    return uvicorn.Config(
        app,
        http=Connection,
        ws="none",
        access_log=False,
        log_config=None,
        # A line for each request that is no HTTP would let strangers fill the disk; the metrics count those.
        log_level="error",
        server_header=False,
        proxy_headers=bool(settings.trusted_proxies),
        forwarded_allow_ips=settings.trusted_proxies,
        timeout_graceful_shutdown=_GRACE_S,
    )


def allow_files(connections: int) -> None:
    """Let this process open as many files as connections need, if the system does: the ledger must find one left."""
    now, most = resource.getrlimit(resource.RLIMIT_NOFILE)
    needed = 2 * connections + _FILES
    if now == resource.RLIM_INFINITY or now >= needed:
        return
    allowed = needed if most == resource.RLIM_INFINITY else min(needed, most)
    if allowed < needed:
        log.warning("fewer files may be open than connections need", allowed=allowed, needed=needed)
    resource.setrlimit(resource.RLIMIT_NOFILE, (allowed, most))


class _Server(uvicorn.Server):
    """Tells streams to end when it is told to: it waits for open answers."""

    def __init__(self, config: uvicorn.Config, closing: threading.Event) -> None:
        super().__init__(config)
        self._closing = closing

    def handle_exit(self, sig: int, frame: FrameType | None) -> None:
        """Begin to shut down."""
        self._closing.set()
        super().handle_exit(sig, frame)


def _announce(settings: Settings, listener: socket.socket) -> None:
    address, port = listener.getsockname()[:2]
    url = f"http://{f'[{address}]' if ':' in address else address}:{port}"
    mode = {"mode": "read-only"} if settings.read_only else {}
    log.info("ready", ledger=str(parse_location(settings.ledger)), workers=settings.workers, **mode)
    log.info("listening", url=url, docs=f"{url}/docs")


def _listen(host: str, port: int) -> socket.socket:
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listener = socket.socket(family, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host.removeprefix("[").removesuffix("]"), port))
        listener.listen()
    except OSError as error:
        listener.close()
        raise StartupError(f"cannot listen on {host}:{port}: {error.strerror}; choose another with --port") from error
    return listener


def _name_worker(
    _logger: object, _method: str, event: structlog.typing.EventDict
) -> structlog.typing.ProcessorReturnValue:
    event["worker"] = os.getpid()
    return event
