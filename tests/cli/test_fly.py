"""`airmatrix fly` against a service: what it makes the service see, what it prints, what it refuses."""

import signal
import subprocess
import threading
import time
from array import array
from collections import Counter, defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from app.block_status import Status
from app.client import Client
from app.commands.fly import summary
from app.commands.pilots import Report
from app.flight_intents import State
from app.routes.answers import FlightIntentAnswer
from app.times import now_ms
from tests.cli.conftest import Run, numbers
from tests.cli.serving import AIRMATRIX, Server, environment, serving
from tests.cli.town import along_row

pytestmark = pytest.mark.compiled

# Seconds of the service's clock a second: its freshness of 5 s is a whole second here.
RATE = 5
# With it, each of the first six flights deviates in another way: these, by sequence number.
SEED = 523
FATES = {1: "late", 2: "layer", 3: "drift", 4: "hover", 5: "intruder", 6: "lost"}
PATIENCE_S = 60.0


@contextmanager
def fast(folder: Path, airspace: Path, **variables: str) -> Iterator[Server]:
    """Serve the town by a clock that runs fast."""
    with serving(folder, "--airspace", str(airspace), "--clock-rate", str(RATE), **variables) as server:
        yield server


def submit(client: Client, *rows: int) -> list[FlightIntentAnswer]:
    """Submit flights along rows of layer 1 that depart in 15 s of the service's time."""
    departs_ms = client.alerts().clock.now + 15_000
    return [client.submit(along_row(row, 1, departs_ms)) for row in rows]


@dataclass(eq=False)
class Watch:
    """What the service has said of each flight or track, and of the blocks they were in, while somebody watched."""

    reasons: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    of_blocks: dict[str, set[str]] = field(default_factory=lambda: defaultdict(set))
    statuses: set[Status] = field(default_factory=set)

    def look(self, client: Client) -> None:
        """Note what the service says now."""
        for flight in client.flights().items:
            self.reasons[str(flight.flight_intent_id or flight.track_id)].update(flight.reasons)
        status = client.status()
        for block in status.blocks:
            self.statuses.add(block.status)
            for name in (*block.flight_intents, *block.track_ids):
                self.of_blocks[name].update(block.reasons)


@contextmanager
def watching(url: str) -> Iterator[Watch]:
    """Watch a service while the block runs."""
    watch, over = Watch(), threading.Event()

    def look() -> None:
        with Client(url) as client:
            while not over.is_set():
                watch.look(client)

    watcher = threading.Thread(target=look)
    watcher.start()
    try:
        yield watch
    finally:
        over.set()
        watcher.join()


def test_each_kind_of_deviation_is_seen_as_what_it_is(airmatrix: Run, town_file: Path, tmp_path: Path) -> None:
    with fast(tmp_path, town_file) as server, Client(server.url) as client:
        flights = {flight.sequence: flight.id for flight in submit(client, 1, 2, 3, 5, 6, 7)}
        with watching(server.url) as watch:
            outcome = airmatrix("fly", "--url", server.url, "--deviations", 6, "--seed", SEED, "--until-idle")
    assert outcome.status == 0, outcome.err
    seen = {FATES[sequence]: watch.reasons[id_] for sequence, id_ in flights.items()}
    expected = {"late": "late", "layer": "wrong_layer", "drift": "off_track", "hover": "late", "lost": "lost"}
    assert {kind: reason for kind, reason in expected.items() if reason in seen[kind]} == expected
    assert watch.reasons["intruder-5"] >= {"no_flight_intent"}
    assert watch.of_blocks["intruder-5"] & {"unplanned_use", "reserved_by_another"}
    assert {label: text for label, text in outcome.table.items() if label.startswith("deviating")} == {
        f"deviating: {kind}": "1" for kind in FATES.values()
    }
    assert outcome.table["aircraft"].startswith("6 arrived")


def test_flights_that_deviate_in_nothing_are_green_from_activation_to_end(
    airmatrix: Run, town_file: Path, tmp_path: Path
) -> None:
    # A machine that is busy for a second must not make anybody lost or late.
    patient = {"AIRMATRIX_FRESHNESS_S": "600", "AIRMATRIX_TOLERANCE_S": "10"}
    with fast(tmp_path, town_file, **patient) as server, Client(server.url) as client:
        ids = [flight.id for flight in submit(client, 1, 3)]
        with watching(server.url) as watch:
            outcome = airmatrix("fly", "--url", server.url, "--until-idle")
        assert outcome.status == 0, outcome.err
        until = time.monotonic() + PATIENCE_S
        while not all(client.flight_intent(id_).state == State.ENDED for id_ in ids):
            assert time.monotonic() < until
            time.sleep(0.1)
        history = [(event.kind, event.flight_intent_id) for event in client.events().items]
    assert [[kind for kind, id_ in history if id_ == each] for each in ids] == [["accepted", "activated", "ended"]] * 2
    assert watch.statuses == {Status.GREEN}
    assert {id_: watch.reasons[id_] for id_ in ids} == {id_: set() for id_ in ids}
    assert outcome.out.splitlines()[0].strip() == f"flown at {RATE} s a second"
    assert outcome.table["aircraft"] == "2 arrived, at most 2 in the air at a time"
    assert numbers(outcome.table["positions accepted"])[0] >= 30
    assert "latency" in outcome.table
    assert not [label for label in outcome.table if ":" in label or label == "unanswered"]


def test_flying_ends_with_its_duration(airmatrix: Run, town: Server) -> None:
    outcome = airmatrix("fly", "--url", town.url, "--duration", 0.5, "--operator", "nobody")
    assert outcome.status == 0, outcome.err
    assert outcome.table["aircraft"] == "0 arrived, at most 0 in the air at a time"
    assert "latency" not in outcome.table


def test_interrupted_it_sums_up_and_says_that_it_was(town: Server) -> None:
    with Client(town.url) as client:
        flight = client.submit(along_row(6, 2, now_ms() + 6_000, operator="medlift"))
        process = subprocess.Popen(
            [AIRMATRIX, "fly", "--url", town.url, "--operator", "medlift"],
            env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        )  # fmt: skip
        try:
            until = time.monotonic() + PATIENCE_S
            while not any(item.position and item.flight_intent_id == flight.id for item in client.flights().items):
                assert time.monotonic() < until
                time.sleep(0.05)
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=PATIENCE_S)
        finally:
            process.kill()
            process.wait()
    assert process.returncode == 130
    assert err.strip() == "interrupted: aircraft that are still in the air are heard of no more"
    assert "positions accepted" in out


def test_a_service_that_does_not_answer_is_named(airmatrix: Run) -> None:
    airmatrix("fly", "--url", "http://127.0.0.1:9").assert_refused("no answer from http://127.0.0.1:9")


@pytest.mark.parametrize("text", ["-1", "1.5", "101%", "nan", "inf", "", "some", "10 %%", "9999999999"])
def test_deviations_that_are_neither_a_number_nor_a_share_are_refused(airmatrix: Run, text: str) -> None:
    airmatrix("fly", f"--deviations={text}").assert_misused("--deviations")


def test_a_kind_that_does_not_exist_is_refused_by_name(airmatrix: Run) -> None:
    refused = airmatrix("fly", "--kinds", "late,drunk")
    refused.assert_misused("--kinds")
    assert "'drunk' is none of late, drift, layer, hover, lost, intruder" in refused.err


@pytest.mark.parametrize(
    ("option", "value"),
    [("--seed", "-1"), ("--interval", "0"), ("--interval", "nan"), ("--duration", "0"), ("--duration", "inf")],
)
def test_an_option_outside_its_bounds_is_refused(airmatrix: Run, option: str, value: str) -> None:
    airmatrix("fly", option, value).assert_misused(option)


def test_the_live_line_says_how_it_goes() -> None:
    report = Report(
        accepted=500, in_air=3, arrived=2, skipped=4, latency_ms=array("d", [90, 10, 20]), seconds=10.0,
        refused=Counter({"position-out-of-order": 7}), deviating=Counter({"late": 1, "drift": 2}),
        unanswered=Counter({"no answer": 1}),
    )  # fmt: skip
    assert summary(report) == (
        "3 in the air · 2 arrived · 50 positions/s · 20 ms · deviating: 2 drift, 1 late · "
        "refused: 7 position-out-of-order · 4 ticks skipped: the service is slow · 1 requests unanswered"
    )
    assert summary(Report()) == "0 in the air · 0 arrived · 0 positions/s"
