"""`airmatrix serve`: what it needs to start, what it says, and what it leaves alone."""

import json
import signal
import socket
import sqlite3
import subprocess
import time
from collections.abc import Sequence
from contextlib import ExitStack, closing
from pathlib import Path

import httpx
import pytest

from app import auth
from app.client import Client
from app.errors import UnsafeListening
from app.settings import Settings
from tests.cli.conftest import Outcome, Run
from tests.cli.serving import AIRMATRIX, Server, environment, serving, started
from tests.ledger.locations import HEAD

# Only ever refused.
EVERYWHERE = "0.0.0.0"  # noqa: S104


def serve(folder: Path, *options: object, program: Sequence[str | Path] = (AIRMATRIX,), **variables: str) -> Outcome:
    """Run a service that is expected to refuse to start, in a process of its own."""
    done = subprocess.run(
        [*program, "serve", *map(str, options)],
        cwd=folder, env=environment(**variables), capture_output=True, text=True, timeout=60, check=False,
    )  # fmt: skip
    refusal = [line for line in done.stderr.splitlines() if " [info " not in line]
    return Outcome(done.returncode, done.stdout, "\n".join(refusal))


def names(folder: Path) -> list[str]:
    """Return the names of all files in a folder."""
    return sorted(path.name for path in folder.iterdir())


def foreign_database(path: Path) -> bytes:
    """Make a database that is no ledger, and return its bytes."""
    with closing(sqlite3.connect(path)) as connection, connection:
        connection.execute("CREATE TABLE recipes (name TEXT)")
    return path.read_bytes()


def test_a_port_in_use_is_refused_and_nothing_is_made(tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        refused = serve(tmp_path, "--port", port)
    refused.assert_refused(f"cannot listen on 127.0.0.1:{port}: Address already in use", "--port")
    assert names(tmp_path) == []


def test_of_two_services_started_at_once_on_one_port_one_serves_and_the_other_is_refused(
    tmp_path: Path, town_file: Path
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    options = ("--port", str(port), "--airspace", str(town_file))
    with ExitStack() as stack:
        both = [
            stack.enter_context(started(tmp_path, *options, "--ledger", f"{name}.sqlite", log=f"{name}.log"))
            for name in ("one", "two")
        ]
        logs = [tmp_path / "one.log", tmp_path / "two.log"]
        until = time.monotonic() + 90
        while all(process.poll() is None for process in both) and time.monotonic() < until:
            if all("listening" in log.read_text() for log in logs):
                until = min(until, time.monotonic() + 2)
            time.sleep(0.05)
        assert sorted(process.poll() is None for process in both) == [False, True]
        (loser,) = (index for index, process in enumerate(both) if process.poll() is not None)
        assert both[loser].returncode == 2
        assert f"error: cannot listen on 127.0.0.1:{port}" in logs[loser].read_text()


def test_listening_beyond_loopback_is_refused_without_authentication(tmp_path: Path) -> None:
    refused = serve(tmp_path, "--host", EVERYWHERE, "--port", 0)
    refused.assert_refused(
        f"refusing to listen on {EVERYWHERE}", "no authentication", "AIRMATRIX_ALLOW_UNAUTHENTICATED=true"
    )
    assert names(tmp_path) == []


def test_listening_beyond_loopback_is_allowed_where_it_is_asked_for() -> None:
    with pytest.raises(UnsafeListening, match="refusing to listen on"):
        auth.check_listening(Settings(host=EVERYWHERE))
    auth.check_listening(Settings(host=EVERYWHERE, allow_unauthenticated=True))


def test_serving_without_authentication_is_loud_and_answers_every_host(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file), AIRMATRIX_ALLOW_UNAUTHENTICATED="true") as server:
        version = httpx.get(f"{server.url}/version", headers={"Host": "airmatrix.example"})
        assert version.status_code == 200
        assert version.json()["allow_unauthenticated"] is True
        assert version.json()["authentication"] == "none"
        (warning,) = (line for line in server.log.read_text().splitlines() if "[warning" in line)
        assert "AIRMATRIX_ALLOW_UNAUTHENTICATED" in warning


def test_a_foreign_host_is_not_answered_by_default(town: Server) -> None:
    foreign = httpx.get(f"{town.url}/version", headers={"Host": "airmatrix.example"})
    assert foreign.status_code == 421
    own = httpx.get(f"{town.url}/version")
    assert own.json()["allow_unauthenticated"] is False
    assert "ALLOW_UNAUTHENTICATED" not in town.log.read_text()


def test_a_built_airspace_and_a_users_aircraft_are_served(town: Server) -> None:
    with Client(town.url) as client:
        airspace = client.airspace()
        aircraft = {item.id: item for item in client.aircraft_types()}
    assert (airspace.id, airspace.name, airspace.dimensions) == ("town", "town", (10, 10, 3))
    assert airspace.statically_occupied == [2, 1, 0]
    assert set(aircraft) == {
        "dji-mavic-air", "self-built-drone", "dji-phantom-4", "dji-matrice-600-pro", "dji-inspire-2", "courier-1",
    }  # fmt: skip
    assert aircraft["courier-1"].link_speeds_mps.horizontal == 20.0
    assert aircraft["courier-1"].planned_link_speeds_mps.vertical == pytest.approx(2.4)


def test_json_logs_are_one_object_a_line_and_name_flight_intents(airmatrix: Run, town: Server) -> None:
    assert airmatrix("simulate", "--url", town.url, "--operator", "logged", "--flights", 3).status == 0
    with Client(town.url) as client:
        recorded = {intent.id for intent in client.flight_intents(operator="logged")}
    lines = [json.loads(line) for line in town.log.read_text().splitlines()]
    assert all(isinstance(line, dict) and {"event", "level", "timestamp"} <= line.keys() for line in lines)
    assert {line["flight_intent"] for line in lines if line.get("operator") == "logged"} == recorded
    assert len(recorded) == 3


def test_a_foreign_database_is_refused_and_left_as_it_was(tmp_path: Path) -> None:
    before = foreign_database(tmp_path / "recipes.sqlite")
    refused = serve(tmp_path, "--port", 0, "--ledger", "recipes.sqlite")
    refused.assert_refused("recipes.sqlite is a SQLite database, but not an AirMatrix ledger")
    assert (tmp_path / "recipes.sqlite").read_bytes() == before
    assert names(tmp_path) == ["recipes.sqlite"]


def test_a_ledger_of_another_airspace_is_refused(tmp_path: Path, ledger: Path) -> None:
    refused = serve(tmp_path, "--port", 0, "--ledger", ledger)
    refused.assert_refused("belongs to airspace 'town'", "not to 'astana-2km'", "or another ledger")


def test_a_ledger_in_a_folder_that_does_not_exist_is_refused(tmp_path: Path) -> None:
    refused = serve(tmp_path, "--port", 0, "--ledger", "nowhere/ledger.sqlite")
    refused.assert_refused("cannot create ledger nowhere/ledger.sqlite", "there is no folder nowhere")
    assert names(tmp_path) == []


def test_an_airspace_file_that_is_none_is_refused_before_a_ledger_is_made(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("not an airspace")
    serve(tmp_path, "--port", 0, "--airspace", "notes.txt").assert_refused("notes.txt")
    assert names(tmp_path) == ["notes.txt"]


def test_settings_may_come_from_the_environment_and_options_win(tmp_path: Path, town_file: Path) -> None:
    elsewhere = {"AIRMATRIX_AIRSPACE": str(town_file), "AIRMATRIX_LEDGER": "other.sqlite", "AIRMATRIX_PORT": "1"}
    with serving(tmp_path, "--ledger", "own.sqlite", **elsewhere) as server, Client(server.url) as client:
        assert client.airspace().id == "town"
        assert (tmp_path / "own.sqlite").exists()
        assert not (tmp_path / "other.sqlite").exists()


@pytest.mark.parametrize(
    ("variable", "value"),
    [
        ("AIRMATRIX_PORT", "70000"),
        ("AIRMATRIX_PORT", "http"),
        ("AIRMATRIX_SEARCH", "fastest"),
        ("AIRMATRIX_HOVER_LIMIT_S", "0"),
        ("AIRMATRIX_HOVER_LIMIT_S", "inf"),
        ("AIRMATRIX_GROUND_HOLD_S", "-1"),
        ("AIRMATRIX_GROUND_HOLD_S", "nan"),
        ("AIRMATRIX_GROUND_HOLD_S", "inf"),
        ("AIRMATRIX_HORIZON_DAYS", "61"),
        ("AIRMATRIX_IDEMPOTENCY_HOURS", "inf"),
        ("AIRMATRIX_QUEUE_LIMIT", "0"),
        ("AIRMATRIX_MAX_BODY_BYTES", "64kB"),
        ("AIRMATRIX_ALLOW_UNAUTHENTICATED", "perhaps"),
        ("AIRMATRIX_LOG_FORMAT", "xml"),
        ("AIRMATRIX_LOG_LEVEL", "verbose"),
    ],
)
def test_a_malformed_setting_is_refused_by_name(
    airmatrix: Run, monkeypatch: pytest.MonkeyPatch, variable: str, value: str
) -> None:
    monkeypatch.setenv(variable, value)
    airmatrix("airspace", "show").assert_refused(variable.removeprefix("AIRMATRIX_").lower())


def test_an_interrupted_server_ends_at_once_without_a_traceback(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file)) as server:
        began = time.monotonic()
        status = server.stop(signal.SIGINT)
        assert time.monotonic() - began < 3
    log = server.log.read_text()
    assert "Traceback" not in log
    assert "Aborted" not in log
    assert status == 130


def test_a_killed_server_starts_again_with_what_it_had_answered(
    airmatrix: Run, tmp_path: Path, town_file: Path
) -> None:
    with serving(tmp_path, "--airspace", str(town_file)) as server:
        assert airmatrix("simulate", "--url", server.url, "--flights", 5).status == 0
        with Client(server.url) as client:
            before = list(client.flight_intents())
        server.stop(signal.SIGKILL)
    with serving(tmp_path, "--airspace", str(town_file)) as server, Client(server.url) as client:
        assert list(client.flight_intents()) == before


def contents(ledger: Path) -> list[str]:
    """Return all that a ledger holds, as SQL."""
    with closing(sqlite3.connect(ledger)) as connection:
        return list(connection.iterdump())


def test_a_ledger_can_be_brought_to_the_newest_schema_again_and_again(airmatrix: Run, ledger: Path) -> None:
    before = contents(ledger)
    for _ in range(2):
        outcome = airmatrix("db", "upgrade", "--ledger", ledger)
        assert (outcome.status, outcome.out, outcome.err) == (0, f"{ledger} has schema {HEAD}\n", "")
        assert contents(ledger) == before


def test_a_missing_ledger_is_not_made_by_an_upgrade(airmatrix: Run, tmp_path: Path) -> None:
    airmatrix("db", "upgrade").assert_refused("there is no ledger at airmatrix.sqlite", "airmatrix serve")
    assert names(tmp_path) == []


def test_a_file_that_is_no_ledger_is_not_upgraded(airmatrix: Run, tmp_path: Path) -> None:
    diary = "Dear diary, nothing happened today."
    (tmp_path / "diary.txt").write_text(diary)
    airmatrix("db", "upgrade", "--ledger", "diary.txt").assert_refused("diary.txt is not an AirMatrix ledger")
    assert (tmp_path / "diary.txt").read_text() == diary
    assert names(tmp_path) == ["diary.txt"]


def test_a_foreign_database_is_not_upgraded(airmatrix: Run, tmp_path: Path) -> None:
    before = foreign_database(tmp_path / "recipes.sqlite")
    airmatrix("db", "upgrade", "--ledger", "recipes.sqlite").assert_refused("not an AirMatrix ledger")
    assert (tmp_path / "recipes.sqlite").read_bytes() == before


def test_the_openapi_document_is_written_as_the_service_answers_it(
    airmatrix: Run, tmp_path: Path, town: Server
) -> None:
    assert airmatrix("openapi", "--out", "openapi.json").status == 0
    assert json.loads((tmp_path / "openapi.json").read_text()) == httpx.get(f"{town.url}/openapi.json").json()


@pytest.mark.parametrize("out", ["nowhere/openapi.json", "."])
def test_an_openapi_document_that_cannot_be_written_is_refused(airmatrix: Run, out: str) -> None:
    airmatrix("openapi", "--out", out).assert_refused(f"cannot write {out}")


def test_the_version_is_printed(airmatrix: Run, town: Server) -> None:
    outcome = airmatrix("version")
    assert outcome.status == 0
    assert outcome.out.strip() == httpx.get(f"{town.url}/version").json()["airmatrix"]


def test_an_unknown_command_is_refused(airmatrix: Run) -> None:
    airmatrix("levitate").assert_misused("levitate")
