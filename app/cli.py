"""The `airmatrix` command."""

import sys
import traceback
from importlib.metadata import version
from pathlib import Path
from typing import Annotated

import orjson
import typer
from pydantic import ValidationError

from app.client import ClientError
from app.commands.airspace import airspace_app
from app.commands.db import db_app
from app.commands.demo import demo
from app.commands.experiment import experiment_app
from app.commands.fly import fly
from app.commands.load import load
from app.commands.plan import plan
from app.commands.serve import serve
from app.commands.simulate import simulate
from app.commands.size_blocks import size_blocks
from app.commands.terminal import remark, write
from app.commands.token import print_token
from app.commands.verify import verify
from app.errors import RequestError, StartupError
from app.main import create_app
from app.settings import Settings
from planner.errors import PlannerError

_UNEXPECTED = 70

cli = typer.Typer(
    no_args_is_help=True, pretty_exceptions_enable=False, help="Strategic deconfliction for urban air mobility."
)
cli.add_typer(airspace_app, name="airspace")
cli.add_typer(db_app, name="db")
cli.add_typer(experiment_app, name="experiment")
cli.command()(serve)
cli.command()(demo)
cli.command()(plan)
cli.command()(simulate)
cli.command()(load)
cli.command()(fly)
cli.command()(size_blocks)
cli.command()(verify)
cli.command("token")(print_token)


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
def openapi(out: Annotated[Path, typer.Option(help="The file to write.")]) -> None:
    """Write the OpenAPI document."""
    document = create_app(Settings()).openapi()
    write(out, orjson.dumps(document, option=orjson.OPT_INDENT_2) + b"\n")


@cli.command("version")
def print_version() -> None:
    """Print the version."""
    typer.echo(version("airmatrix"))


def _fail(message: str) -> None:
    remark("error", "red", message)
    sys.exit(2)
