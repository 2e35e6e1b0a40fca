"""The README's tour: serve, simulate, verify, stop, start again."""

import re
import socket
import time
from pathlib import Path
from urllib.parse import urlsplit

import pytest

from tests.cli.conftest import Outcome, Run, numbers
from tests.cli.serving import Server, serving

VIOLATIONS = ("overlaps", "separation violations", "building violations", "containment violations")


def assert_keeps_the_promise(verified: Outcome, flights: int) -> None:
    """Nothing is violated, and no two flights came nearer than a block in both directions."""
    assert verified.status == 0
    assert verified.table["judged"].startswith(f"{flights} flights, ")
    assert [verified.table[kind] for kind in VIOLATIONS] == ["0", "0", "0", "0"]
    horizontal_m, vertical_m, *_ = numbers(verified.table["closest approach"])
    assert horizontal_m >= 20 or vertical_m >= 40
    nearest_building_m, *_ = numbers(verified.table["closest building"])
    assert nearest_building_m >= 10
    assert "violation:" not in verified.err


def accepted_of(simulated: Outcome, flights: int) -> int:
    """Return how many flights were accepted; all others were refused with a reason."""
    assert simulated.status == 0
    assert re.match(rf"{flights} in \d+\.\d\d s, one after another$", simulated.table["flight intents"])
    accepted = int(simulated.table["accepted"])
    refused = sum(int(count) for label, count in simulated.table.items() if label.startswith("refused: "))
    assert accepted + refused == flights
    return accepted


def keep_alive_connection(server: Server) -> socket.socket:
    """Return a connection that has had one answer and stays open."""
    address = urlsplit(server.url)
    connection = socket.create_connection((address.hostname, address.port), timeout=5)
    connection.sendall(b"GET /health/live HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
    assert connection.recv(4096).startswith(b"HTTP/1.1 200")
    return connection


@pytest.mark.compiled
def test_three_hundred_flights_stay_apart_also_after_a_restart(airmatrix: Run, tmp_path: Path) -> None:
    with serving(tmp_path) as server:
        assert server.ledger.exists()
        began = time.monotonic()
        simulated = airmatrix("simulate", "--flights", 300, "--window", 300, "--seed", 1, "--url", server.url)
        assert time.monotonic() - began < 10
        first = accepted_of(simulated, 300)
        assert_keeps_the_promise(airmatrix("verify"), first)
    assert_keeps_the_promise(airmatrix("verify"), first)
    with serving(tmp_path) as server:
        more = ("--flights", 100, "--window", 300, "--seed", 2)
        second = accepted_of(airmatrix("simulate", *more, "--url", server.url), 100)
        assert_keeps_the_promise(airmatrix("verify"), first + second)


def test_a_stopped_server_ends_at_once_with_status_0_although_a_client_keeps_its_connection(
    tmp_path: Path, town_file: Path
) -> None:
    with serving(tmp_path, "--airspace", str(town_file)) as server, keep_alive_connection(server):
        began = time.monotonic()
        status = server.stop()
        assert time.monotonic() - began < 3
    assert "Traceback" not in server.log.read_text()
    assert status == 0


def test_a_stopped_server_leaves_one_whole_ledger_file(tmp_path: Path, town_file: Path) -> None:
    with serving(tmp_path, "--airspace", str(town_file)) as server:
        server.stop()
    assert sorted(path.name for path in tmp_path.iterdir()) == ["airmatrix.sqlite", "serve.log"]
