"""`airmatrix simulate`: the same seed asks for the same flights, and the summary says what the service recorded."""

import signal
import subprocess
import time
from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from app.client import Client
from app.flight_intents import State
from app.routes.answers import FlightIntentAnswer
from app.times import format_time, now_ms
from tests.cli.conftest import Outcome, Run, numbers
from tests.cli.serving import AIRMATRIX, Server, environment
from tests.cli.town import OCCUPIED, place

START_MS = now_ms() + 7_200_000
START = format_time(START_MS)


def asked_for(intents: list[FlightIntentAnswer]) -> list[tuple[object, ...]]:
    """Return what the flights asked for, without who asked and what was answered."""
    return [
        (intent.reference, intent.aircraft_type, intent.origin, intent.destination, intent.earliest_departure)
        for intent in intents
    ]


def recorded(server: Server, operator: str) -> list[FlightIntentAnswer]:
    """Return all that the service recorded for an operator."""
    with Client(server.url) as client:
        return list(client.flight_intents(operator=operator))


def simulated(airmatrix: Run, server: Server, operator: str, *options: object) -> list[FlightIntentAnswer]:
    """Run a simulation and return what the service recorded of it."""
    arguments = ("simulate", "--url", server.url, "--operator", operator, *options)
    assert airmatrix(*arguments).status == 0
    return recorded(server, operator)


def test_the_same_seed_and_start_ask_for_the_same_flights(airmatrix: Run, town: Server) -> None:
    options = ("--flights", 20, "--window", 60, "--start", START)
    first = asked_for(simulated(airmatrix, town, "first", "--seed", 7, *options))
    again = asked_for(simulated(airmatrix, town, "again", "--seed", 7, *options))
    other = asked_for(simulated(airmatrix, town, "other", "--seed", 8, *options))
    assert len(first) == 20
    assert again == first
    assert not set(map(str, other)) & set(map(str, first))


def test_flights_want_to_depart_within_the_window(airmatrix: Run, town: Server) -> None:
    flights = simulated(airmatrix, town, "window", "--flights", 30, "--window", 10, "--seed", 1, "--start", START)
    wishes = [flight.earliest_departure - START_MS for flight in flights]
    assert all(0 <= wish <= 10_000 for wish in wishes)
    assert len(set(wishes)) == 30


def test_a_window_of_0_seconds_has_all_flights_ask_for_its_start(airmatrix: Run, town: Server) -> None:
    flights = simulated(airmatrix, town, "at-once", "--flights", 5, "--window", 0, "--seed", 1, "--start", START)
    assert {format_time(flight.earliest_departure) for flight in flights} == {START}


def test_only_the_papers_aircraft_take_part(airmatrix: Run, town: Server) -> None:
    flights = simulated(airmatrix, town, "fleet", "--flights", 60, "--window", 600, "--seed", 3, "--start", START)
    assert {flight.aircraft_type for flight in flights} == {
        "dji-mavic-air", "self-built-drone", "dji-phantom-4", "dji-matrice-600-pro",
    }  # fmt: skip


@pytest.mark.parametrize("od", ["uniform", "lowest"])
def test_flights_begin_and_end_at_the_centres_of_blocks(airmatrix: Run, town: Server, od: str) -> None:
    flights = simulated(airmatrix, town, f"centres-{od}", "--flights", 10, "--od", od, "--start", START)
    ends = [end for flight in flights for end in (flight.origin, flight.destination)]
    for end in ends:
        assert (end.lon, end.lat, end.alt_m) == pytest.approx(place(end.block), abs=1e-9)


def test_uniform_flights_begin_and_end_in_free_blocks_of_every_layer(airmatrix: Run, town: Server) -> None:
    flights = simulated(
        airmatrix, town, "uniform", "--flights", 60, "--window", 600, "--od", "uniform", "--start", START
    )
    ends = {end.block for flight in flights for end in (flight.origin, flight.destination)}
    assert not ends & set(OCCUPIED)
    assert {k for _, _, k in ends} == {0, 1, 2}


def test_lowest_flights_begin_and_end_in_the_lowest_free_block_of_a_column(airmatrix: Run, town: Server) -> None:
    flights = simulated(airmatrix, town, "lowest", "--flights", 60, "--window", 600, "--od", "lowest", "--start", START)
    ends = {end.block for flight in flights for end in (flight.origin, flight.destination)}
    above: dict[tuple[int, int], int] = {(4, 4): 2, (0, 9): 1}
    assert all(k == above.get((i, j), 0) for i, j, k in ends)
    assert len(ends) > 40


def test_the_summary_says_what_the_service_recorded(airmatrix: Run, town: Server) -> None:
    run = airmatrix(
        "simulate", "--url", town.url, "--operator", "summary", "--start", START,
        "--flights", 150, "--window", 0, "--od", "lowest",
    )  # fmt: skip
    intents = recorded(town, "summary")
    accepted = [intent for intent in intents if intent.state == "accepted"]
    reasons = Counter(intent.refusal.reason for intent in intents if intent.refusal is not None)
    assert len(intents) == 150
    assert len(reasons) > 0
    assert int(run.table["accepted"]) == len(accepted)
    refused = {label.removeprefix("refused: "): int(value) for label, value in run.table.items() if ": " in label}
    assert refused == dict(reasons)
    for label, values in (
        ("delay", [intent.delay_s or 0.0 for intent in accepted]),
        ("ground hold", [intent.ground_hold_s or 0.0 for intent in accepted]),
        ("hover", [intent.hover_s or 0.0 for intent in accepted]),
    ):
        mean_s, flights, sum_s, max_s = numbers(run.table[label])
        assert mean_s == pytest.approx(np.mean(values), abs=0.000_501)
        assert flights == np.count_nonzero(values)
        assert sum_s == pytest.approx(sum(values), abs=0.0501)
        assert max_s == pytest.approx(max(values), abs=0.0501)


def test_latencies_are_summed_up_in_order(airmatrix: Run, town: Server) -> None:
    run = airmatrix("simulate", "--url", town.url, "--operator", "latency", "--start", START, "--flights", 20)
    median, _, p95, _, p99, longest = numbers(run.table["latency"])
    assert 0 < median <= p95 <= p99 <= longest


def test_an_interrupted_simulation_sums_up_what_it_did(airmatrix: Run, town: Server, town_file: Path) -> None:
    arguments = ["simulate", "--url", town.url, "--operator", "interrupted", "--start", START, "--window", "86400"]
    process = subprocess.Popen(
        [AIRMATRIX, *arguments, "--flights", "3000"],
        env=environment(), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    with Client(town.url) as client:
        # Two: the answer to the first has arrived by then.
        while len(list(client.flight_intents(operator="interrupted"))) < 2:
            time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=10)
    summary = Outcome(process.returncode, out, err)
    assert summary.status == 130, err
    assert "interrupted: what was accepted stays reserved" in err
    assert "Traceback" not in err
    # The request that the interruption hit may have been recorded all the same.
    counted = int(numbers(summary.table["flight intents"])[0])
    assert len(recorded(town, "interrupted")) - counted in (0, 1)
    verified = airmatrix("verify", "--ledger", town.ledger, "--airspace", town_file)
    assert verified.status == 0, verified.err


def test_a_service_that_does_not_answer_is_named(airmatrix: Run) -> None:
    airmatrix("simulate", "--url", "http://127.0.0.1:9").assert_refused("no answer from http://127.0.0.1:9")


@pytest.mark.parametrize("url", ["", "nonsense", "ftp://127.0.0.1", "http://127.0.0.1:99999", "http://127.0.0.1:x"])
def test_an_address_that_is_none_is_refused(airmatrix: Run, url: str) -> None:
    airmatrix("simulate", "--url", url).assert_refused()


@pytest.mark.parametrize(
    ("option", "value"),
    [("--flights", "0"), ("--flights", "100001"), ("--window", "-1"), ("--window", "nan"), ("--seed", "-1"),
     ("--od", "anywhere"), ("--start", "tomorrow"), ("--start", "2030-01-01T00:00:00")],
)  # fmt: skip
def test_an_option_outside_its_bounds_is_refused(airmatrix: Run, option: str, value: str) -> None:
    airmatrix("simulate", option, value).assert_misused(option)


@pytest.mark.parametrize("window", ["inf", "1e300"])
def test_an_endless_window_is_refused(airmatrix: Run, town: Server, window: str) -> None:
    outcome = airmatrix("simulate", "--url", town.url, "--window", window)
    assert outcome.status == 2
    assert "window" in outcome.err


def test_an_operator_without_a_name_is_refused(airmatrix: Run, town: Server) -> None:
    airmatrix("simulate", "--url", town.url, "--operator", "").assert_refused("operator")


def test_departures_in_the_past_are_counted_under_the_reason_that_the_service_gives(
    airmatrix: Run, town: Server
) -> None:
    past = ("--start", "2020-01-01T00:00:00Z", "--flights", 5)
    outcome = airmatrix("simulate", "--url", town.url, "--operator", "late", *past)
    assert outcome.status == 0
    assert (outcome.table["accepted"], outcome.table["refused: departure-in-the-past"]) == ("0", "5")
    assert recorded(town, "late") == []


def test_a_refusal_half_way_still_says_how_many_flights_were_accepted(airmatrix: Run, town: Server) -> None:
    beyond_the_horizon = ("--window", 60 * 86_400, "--seed", 1, "--flights", 20)
    outcome = airmatrix("simulate", "--url", town.url, "--operator", "far", "--start", START, *beyond_the_horizon)
    accepted = [intent for intent in recorded(town, "far") if intent.state == State.ACCEPTED]
    assert len(accepted) > 0
    assert outcome.table["accepted"] == str(len(accepted))
