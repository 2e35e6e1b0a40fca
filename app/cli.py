"""The `airmatrix` command."""

import signal
import socket
import sys
import traceback
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import orjson
import structlog
import typer
import uvicorn
from pydantic import ValidationError

from app import auth, logs, service
from app.client import ClientError
from app.commands.airspace import airspace_app
from app.commands.experiment import experiment_app
from app.commands.plan import plan
from app.commands.simulate import simulate
from app.commands.size_blocks import size_blocks
from app.commands.terminal import remark, write
from app.commands.verify import verify
from app.errors import LedgerMissing, RequestError, StartupError
from app.ledger import create_or_upgrade
from app.ledger.engine import sqlite_path
from app.main import create_app
from app.settings import Settings
from app.times import now_ms
from planner.errors import PlannerError

log = structlog.get_logger()

_GRACE_S = 5
_UNEXPECTED = 70

cli = typer.Typer(
    no_args_is_help=True, pretty_exceptions_enable=False, help="Strategic deconfliction for urban air mobility."
)
db_app = typer.Typer(help="Look after the ledger.", no_args_is_help=True)
cli.add_typer(airspace_app, name="airspace")
cli.add_typer(db_app, name="db")
cli.add_typer(experiment_app, name="experiment")
cli.command()(plan)
cli.command()(simulate)
cli.command()(size_blocks)
cli.command()(verify)


def main() -> None:
    """Run a command; what it refuses is one line on stderr and exit status 2."""
    try:
        cli(prog_name="airmatrix")
    except (StartupError, PlannerError, RequestError, ClientError) as error:
        _fail(str(error))
    except ValidationError as error:
        _fail("; ".join(f"{'.'.join(map(str, item['loc']))}: {item['msg']}" for item in error.errors()))
    except Exception:
        # Not 1: that is how `verify` says that it found a violation.
        traceback.print_exc()
        sys.exit(_UNEXPECTED)


@cli.command()
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.  [default: 127.0.0.1]")] = None,
    port: Annotated[int | None, typer.Option(help="Port; 0 for any.  [default: 8000]")] = None,
    ledger: Annotated[str | None, typer.Option(help="Ledger file or URL, created if absent.")] = None,
    airspace: Annotated[Path | None, typer.Option(help="Airspace file. Default: the shipped one.")] = None,
    aircraft_types: Annotated[Path | None, typer.Option(help="TOML file of further aircraft types.")] = None,
    workers: Annotated[int, typer.Option(min=1, max=1, help="Processes; this version runs one.")] = 1,  # noqa: ARG001
) -> None:
    """Serve the API. Every option, and every other setting, is also an AIRMATRIX_* variable."""
    settings = Settings.given(host=host, port=port, ledger=ledger, airspace=airspace, aircraft_types=aircraft_types)
    logs.configure(settings)
    auth.check_listening(settings)
    # uvicorn ends by raising the signal that stopped it; a clean exit still closes the ledger.
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(0))
    # Taken before anything is created; who connects early waits until everything is ready.
    listener = _listen(settings.host, settings.port)
    with listener, service.running(settings, now_ms) as running:
        if settings.allow_unauthenticated:
            log.warning("AIRMATRIX_ALLOW_UNAUTHENTICATED: anybody who reaches this address can plan and cancel flights")
        config = uvicorn.Config(
            create_app(settings, running=running),
            access_log=False,
            log_config=None,
            timeout_graceful_shutdown=_GRACE_S,
        )
        address, bound = listener.getsockname()[:2]
        url = f"http://{f'[{address}]' if ':' in address else address}:{bound}"
        log.info("listening", url=url, docs=f"{url}/docs")
        uvicorn.Server(config).run(sockets=[listener])


@cli.command()
def openapi(out: Annotated[Path, typer.Option(help="The file to write.")]) -> None:
    """Write the OpenAPI document."""
    document = create_app(Settings()).openapi()
    write(out, orjson.dumps(document, option=orjson.OPT_INDENT_2) + b"\n")


@cli.command("version")
def print_version() -> None:
    """Print the version."""
    typer.echo(version("airmatrix"))


@db_app.command()
def upgrade(ledger: Annotated[str | None, typer.Option(help="Ledger file or URL.")] = None) -> None:
    """Bring a ledger to the newest schema."""
    location = Settings.given(ledger=ledger).ledger
    path = sqlite_path(location)
    if not path.exists() or path.stat().st_size == 0:
        raise LedgerMissing(f"there is no ledger at {location}; `airmatrix serve` creates one")
    typer.echo(f"{location} has schema {create_or_upgrade(location)}")


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


def _fail(message: str) -> None:
    remark("error", "red", message)
    sys.exit(2)
