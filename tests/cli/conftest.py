"""Commands run in an empty folder and without settings of ours; services run as processes of their own."""

import os
import re
import sqlite3
import sys
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from app.cli import main
from app.client import Client, ProblemAnswer
from app.routes.answers import FlightIntentAnswer
from app.times import now_ms
from tests.cli.serving import Server, serving
from tests.cli.town import along_row, town_airspace

AIRCRAFT_TYPES = """
[[aircraft]]
id = "courier-1"
name = "Courier 1"
mass_kg = 5.0
max_vertical_speed_mps = 4.0
max_horizontal_speed_mps = 20.0
"""


@dataclass(frozen=True)
class Outcome:
    """What a command leaves: its exit status and what it printed."""

    status: int
    out: str
    err: str

    @property
    def rows(self) -> list[list[str]]:
        """The cells of the printed table, row by row, without its head."""
        lines = [line.strip() for line in self.out.splitlines()]
        return [[cell.strip() for cell in line.strip("│").split("│")] for line in lines if line.startswith("│")]

    @property
    def table(self) -> dict[str, str]:
        """The printed table of two columns."""
        return {cells[0]: cells[1] for cells in self.rows}

    def assert_refused(self, *words: str) -> None:
        """Assert exit status 2, one line on stderr that names all `words`, and nothing else."""
        line = self.err.strip()
        assert self.status == 2
        assert self.out == ""
        assert line.startswith("error: ")
        assert "\n" not in line
        for word in words:
            assert word in line

    def assert_misused(self, option: str) -> None:
        """Assert exit status 2 and a usage message that names the option."""
        assert self.status == 2
        assert self.out == ""
        assert "Usage: airmatrix" in self.err
        assert option in self.err
        assert "Traceback" not in self.err


Run = Callable[..., Outcome]


@pytest.fixture
def airmatrix(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path) -> Run:
    """Run `airmatrix` with these arguments in this process and an empty folder."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "300")
    for name in [name for name in os.environ if name.startswith("AIRMATRIX_")]:
        monkeypatch.delenv(name)

    def run(*arguments: object) -> Outcome:
        monkeypatch.setattr(sys, "argv", ["airmatrix", *map(str, arguments)])
        capsys.readouterr()
        status: object = 0
        try:
            main()
        except SystemExit as end:
            status = end.code or 0
        printed = capsys.readouterr()
        assert isinstance(status, int)
        return Outcome(status, printed.out, printed.err)

    return run


@pytest.fixture(scope="session")
def town_file(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The town's airspace file."""
    return town_airspace(tmp_path_factory.mktemp("town"))


@pytest.fixture(scope="session")
def town(town_file: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Server]:
    """A service for the town that logs in JSON, holds no flight on the ground, and knows one aircraft more."""
    folder = tmp_path_factory.mktemp("served")
    types = folder / "aircraft.toml"
    types.write_text(AIRCRAFT_TYPES, encoding="utf-8")
    options = ("--airspace", str(town_file), "--aircraft-types", str(types))
    with serving(folder, *options, AIRMATRIX_LOG_FORMAT="json", AIRMATRIX_GROUND_HOLD_S="0") as server:
        yield server


@dataclass(frozen=True)
class History:
    """A ledger of the town with every kind of intent; `rows` are the accepted flights along the rows 0-3 and 5-8."""

    ledger: Path
    rows: dict[int, FlightIntentAnswer]
    in_flight: FlightIntentAnswer
    rejected_id: str


@pytest.fixture(scope="session")
def history(town_file: Path, tmp_path_factory: pytest.TempPathFactory) -> History:
    """Eight flights abreast, one refused, one cancelled in flight and one cancelled before its departure."""
    folder = tmp_path_factory.mktemp("history")
    with serving(folder, "--airspace", str(town_file)) as server, Client(server.url) as client:
        later = now_ms() + 3_600_000
        rows = {row: client.submit(along_row(row, 0, later)) for row in (0, 1, 2, 3, 5, 6, 7, 8)}
        with pytest.raises(ProblemAnswer, match="departure window") as refusal:
            client.submit(along_row(0, 0, later + 1, later + 1))
        in_flight = client.cancel(client.submit(along_row(0, 2, now_ms())).id)
        client.cancel(client.submit(along_row(1, 2, later)).id)
        ledger = folder / "history.sqlite"
        source, copy = sqlite3.connect(server.ledger), sqlite3.connect(ledger)
        source.backup(copy)
        source.close()
        copy.close()
    return History(ledger, rows, in_flight, str(refusal.value.members["flight_intent_id"]))


@pytest.fixture
def ledger(history: History, tmp_path: Path) -> Path:
    """A copy of that ledger, to tamper with."""
    path = tmp_path / "ledger.sqlite"
    path.write_bytes(history.ledger.read_bytes())
    return path


def numbers(text: str) -> list[float]:
    """Return the numbers in a text."""
    return [float(number) for number in re.findall(r"\d+(?:\.\d+)?", text)]
