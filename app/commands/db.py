"""`airmatrix db`: look after the ledger."""

import signal
import sys
from pathlib import Path
from typing import Annotated

import typer

from app.commands.terminal import progress_bar
from app.ledger import check_exists, create_or_upgrade, parse_location
from app.ledger.backup import back_up
from app.settings import Settings

db_app = typer.Typer(help="Look after the ledger.", no_args_is_help=True)


@db_app.command()
def upgrade(ledger: Annotated[str | None, typer.Option(help="Ledger file or URL.")] = None) -> None:
    """Bring a ledger to the newest schema."""
    settings = Settings.given(ledger=ledger)
    check_exists(settings.ledger)
    typer.echo(f"{parse_location(settings.ledger)} has schema {create_or_upgrade(settings.ledger)}")


@db_app.command()
def backup(
    out: Annotated[Path, typer.Option(help="The file to write.")],
    ledger: Annotated[str | None, typer.Option(help="Ledger file or URL.")] = None,
    force: Annotated[bool, typer.Option("--force", help="Replace the file if there is one.")] = False,
) -> None:
    """Copy a ledger as of one moment, while it is served and written.

    From SQLite the copy is a ledger itself: `airmatrix serve --ledger FILE`. From PostgreSQL it is made by `pg_dump`;
    `createdb` and `pg_restore` bring it back.
    """
    settings = Settings.given(ledger=ledger)
    # So that nothing half done is left behind.
    before = signal.signal(signal.SIGTERM, lambda *_: sys.exit(128 + signal.SIGTERM))
    try:
        with progress_bar("copying", 1.0) as advance_to:
            size = back_up(settings.ledger, out, replace=force, advance=advance_to)
    finally:
        signal.signal(signal.SIGTERM, before)
    typer.echo(f"{out} is a copy of {parse_location(settings.ledger)}: {size:,} bytes")
