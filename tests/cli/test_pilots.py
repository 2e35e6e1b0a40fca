"""Pilots: what they send, when, and what they make of a service that is slow, away or of another opinion.

The service is a stand-in that answers in the client's thread. Its clock runs so fast that flights take little time.
"""

import json
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import httpx
import numpy as np
import pytest

from app.client import Client, ServiceUnreachable, UnexpectedAnswer
from app.commands import pilots as pilots_module
from app.commands.deviations import Deviations, Flown, Kind
from app.commands.pilots import Dispatch, Pilots, Report, ServiceTime
from app.constraints import UNMOVED
from app.flight_intents import State
from app.routes.answers import FlightIntentAnswer
from app.times import ServerClock, format_time, parse_time
from tests.cli.town import GRID, LINK_MS, along_row, place

START_MS = parse_time("2026-11-22T08:00:00Z")
FLIGHT_MS = 9 * LINK_MS
# A flight along a row takes a sixth of a second.
RATE = 100.0
PATIENCE_S = 20.0


@pytest.fixture(autouse=True)
def hurry(monkeypatch: pytest.MonkeyPatch) -> None:
    """Ask more often: the clock runs fast."""
    monkeypatch.setattr(pilots_module, "_POLL_S", 0.1)
    monkeypatch.setattr(pilots_module, "_RECONNECT_S", 0.05)


def intent(
    sequence: int, departs_in_s: float, row: int = 1, state: State = State.ACCEPTED, **changes: Any
) -> FlightIntentAnswer:
    """Return a flight along a row of the town, layer 1, as the service shows it."""
    departure_ms = START_MS + int(departs_in_s * 1000)
    wish = along_row(row, 1, departure_ms).model_dump()
    points = [dict(zip(("lon", "lat", "alt_m"), place((i, row, 1)), strict=True), block=(i, row, 1)) for i in range(10)]
    times = [departure_ms + step * LINK_MS for step in range(10)]
    return FlightIntentAnswer.model_validate(
        wish
        | {
            "id": f"flight-{sequence}", "sequence": sequence, "version": "1", "state": state.value, "submitted": False,
            "origin": points[0], "destination": points[-1], "latest_departure": departure_ms,
            "departure": times[0], "arrival": times[-1], "reservations": [],
            "trajectory": [point | {"arrive": at, "depart": at} for point, at in zip(points, times, strict=True)],
        }
        | changes
    )  # fmt: skip


def taken(positions: list[dict[str, Any]]) -> httpx.Response:
    """Answer that all positions were taken."""
    return httpx.Response(202, json={"accepted": len(positions), "problem_count": 0, "problems": [], "flagged": []})


@dataclass(eq=False)
class StandIn:
    """A service of the town: its flights, its journal, and all that was reported or asked for."""

    intents: list[FlightIntentAnswer]
    rate: float = RATE
    on_telemetry: Callable[[list[dict[str, Any]]], httpx.Response] = taken
    on_request: Callable[[httpx.Request], httpx.Response | None] = lambda _: None
    journal: list[dict[str, Any]] = field(default_factory=list)
    reports: list[list[dict[str, Any]]] = field(default_factory=list)
    asked: list[tuple[str, int]] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.clock = ServerClock(START_MS, self.rate)

    @property
    def revision(self) -> int:
        """The journal's newest revision."""
        return max((entry["revision"] for entry in self.journal), default=0)

    def tell(self, kind: str, *answers: FlightIntentAnswer, is_new_plan: bool = False) -> None:
        """Write to the journal, all in one revision."""
        revision, at = self.revision + 1, format_time(self.clock())
        details = {"cause": {"constraint_id": "closed"}, "reason": None} if is_new_plan or kind == UNMOVED else {}
        self.journal += [
            {"revision": revision, "time": at, "kind": kind, "flight_intent_id": answer.id,
             "sequence": answer.sequence, "track_id": None, "reasons": [], "details": details}
            for answer in answers
        ]  # fmt: skip

    def answer(self, request: httpx.Request) -> httpx.Response:
        """Answer as the service does."""
        other = self.on_request(request)
        if other is not None:
            return other
        path = request.url.path
        known = {f"/v1/flight-intents/{each.id}": each for each in self.intents}
        if path == "/v1/telemetry":
            positions = json.loads(request.content)["positions"]
            self.reports.append(positions)
            return self.on_telemetry(positions)
        if path == "/v1/airspace/alerts":
            now = format_time(self.clock())
            clock = {"now": now, "rate": self.rate, "simulated": True}
            return httpx.Response(200, json={"at": now, "clock": clock, "items": []})
        if path == "/health/ready":
            return httpx.Response(200, json={"mode": "read-write", "revision": self.revision, "waiting": 0})
        if path == "/v1/events":
            after = int(request.url.params["after"])
            items = [entry for entry in self.journal if entry["revision"] > after]
            return httpx.Response(200, json={"items": items, "next_cursor": None, "removed_through": 0})
        if path == "/v1/flight-intents":
            assert parse_time(request.url.params["from"]) >= START_MS
            items = [each.model_dump(mode="json") for each in self.intents]
            return httpx.Response(200, json={"items": items, "next_cursor": None})
        resource, _, action = path.rpartition("/")
        if action in ("activate", "end"):
            self.asked.append((f"{action} {known[resource].id}", self.clock()))
            return httpx.Response(200, json=known[resource].model_dump(mode="json"))
        return httpx.Response(200, json=known[path].model_dump(mode="json"))

    def heard(self, name: str) -> list[dict[str, Any]]:
        """Return what was reported of a flight or track."""
        return [
            position
            for positions in self.reports
            for position in positions
            if name in (position.get("flight_intent_id"), position.get("track_id"))
        ]


def fly(
    service: StandIn,
    deviations: Deviations = Deviations(1),  # noqa: B008 -- frozen
    until: Callable[[Pilots], bool] = lambda pilots: pilots.unfinished == 0,
    operator: str | None = None,
    interval_s: float = 1.0,
) -> Report:
    """Fly what a service has until nothing is left, or what else is asked for; fail if that takes long."""
    give_up = time.monotonic() + PATIENCE_S

    def is_over(pilots: Pilots) -> bool:
        assert time.monotonic() < give_up
        return until(pilots)

    with Client("http://town", transport=httpx.MockTransport(service.answer)) as client:
        clock = ServiceTime(client)
        pilots = Pilots(client, clock, GRID, Dispatch(client, clock, GRID, deviations, operator), interval_s)
        pilots.fly(lambda: is_over(pilots))
    return pilots.report


def times(positions: list[dict[str, Any]]) -> list[int]:
    """Return when they were taken, in ms after the start."""
    return [parse_time(position["time"]) - START_MS for position in positions]


def test_a_flight_is_reported_on_its_pad_on_its_way_and_once_on_the_ground() -> None:
    service = StandIn([intent(1, 15)], rate=20)
    report = fly(service)
    heard = service.heard("flight-1")
    at = times(heard)
    assert at == sorted(set(at))
    assert all(time_ms % 1000 == 0 for time_ms in at)
    assert 5_000 <= at[0] < 15_000
    departs, arrives = 15_000, 15_000 + FLIGHT_MS
    assert [position["airborne"] for position in heard] == [departs <= time_ms < arrives for time_ms in at]
    assert at[-2] < arrives <= at[-1]
    for time_ms, position in zip(at, heard, strict=True):
        x, y = GRID.project(position["lon"], position["lat"])
        flown = np.clip((time_ms - departs) / LINK_MS, 0, 9)
        assert float(x) - GRID.origin_x_m == pytest.approx(10 + 20 * flown, abs=0.01)
        assert float(y) - GRID.origin_y_m == pytest.approx(30, abs=0.01)
        assert position["alt_m"] == 60
    assert (report.accepted, report.arrived, report.most_in_air, report.in_air) == (len(heard), 1, 1, 0)
    assert len(report.latency_ms) == len(service.reports)


def test_a_flight_is_activated_before_it_departs_and_never_ended_by_hand() -> None:
    service = StandIn([intent(1, 15), intent(2, 30, row=2)], rate=20)
    fly(service)
    (first, first_ms), (second, second_ms) = service.asked
    assert (first, second) == ("activate flight-1", "activate flight-2")
    assert START_MS + 5_000 <= first_ms <= START_MS + 15_000
    assert START_MS + 20_000 <= second_ms <= START_MS + 30_000


def test_a_flight_in_the_air_that_is_activated_already_goes_on() -> None:
    service = StandIn([intent(1, -5, state=State.ACTIVATED)])
    fly(service)
    assert service.asked == []
    assert service.heard("flight-1")[0]["airborne"] is True


def test_what_is_over_or_was_refused_is_not_flown() -> None:
    refused = intent(2, 15, state=State.REJECTED, trajectory=[], departure=None, arrival=None)
    service = StandIn([intent(1, 15, state=State.ENDED), refused, intent(3, 15, state=State.CANCELLED)])
    fly(service)
    assert (service.reports, service.asked) == ([], [])


def test_all_aircraft_of_a_tick_go_in_one_request() -> None:
    service = StandIn([intent(number, 15, row=number) for number in range(1, 9)])
    report = fly(service)
    assert max(len(positions) for positions in service.reports) == 8
    assert report.most_at_once == 8
    for positions in service.reports:
        assert len({position["time"] for position in positions}) == 1
        assert len({position["flight_intent_id"] for position in positions}) == len(positions)


def test_more_aircraft_than_a_request_takes_go_in_several(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pilots_module, "_BATCH", 3)
    service = StandIn([intent(number, 15, row=number) for number in range(1, 9)])
    assert fly(service).arrived == 8
    sizes = [len(positions) for positions in service.reports]
    assert [3, 3, 2] in [sizes[index : index + 3] for index in range(len(sizes))]
    assert max(sizes) == 3


def test_a_flight_that_is_accepted_meanwhile_is_flown_too() -> None:
    first, second = intent(1, 12), intent(2, 60, row=2)
    service = StandIn([first])

    def until(pilots: Pilots) -> bool:
        if not service.journal and service.reports:
            service.intents.append(second)
            service.tell(State.ACCEPTED, second)
        return pilots.report.arrived == 2

    fly(service, until=until)
    assert len(service.heard("flight-2")) > 5


def test_a_flight_that_is_cancelled_before_it_departs_stays_where_it_is() -> None:
    service = StandIn([intent(1, 60), intent(2, 70, row=2)])
    service_intents = list(service.intents)

    def until(pilots: Pilots) -> bool:
        if not service.journal:
            service.tell(State.CANCELLED, service_intents[0])
        return pilots.unfinished == 0

    assert fly(service, until=until).arrived == 1
    assert service.heard("flight-1") == []
    assert [what for what, _ in service.asked] == ["activate flight-2"]


def test_a_flight_that_is_cancelled_in_the_air_flies_to_its_end() -> None:
    service = StandIn([intent(1, -1, state=State.ACTIVATED)])
    service.tell(State.ACCEPTED, service.intents[0])

    def until(pilots: Pilots) -> bool:
        if len(service.journal) == 1:
            service.tell(State.CANCELLED, service.intents[0])
        return pilots.unfinished == 0

    assert fly(service, until=until).arrived == 1
    assert service.heard("flight-1")[-1]["airborne"] is False


def test_a_flight_that_is_moved_is_activated_and_flown_as_it_is_planned_now() -> None:
    moved = intent(1, 120)
    service = StandIn([intent(1, 60)])

    def until(pilots: Pilots) -> bool:
        if not service.journal:
            service.intents[:] = [moved]
            service.tell(State.ACCEPTED, moved, is_new_plan=True)
        return pilots.unfinished == 0

    assert fly(service, until=until).arrived == 1
    heard = service.heard("flight-1")
    assert times(heard)[0] >= 110_000
    assert {time_ms for time_ms, position in zip(times(heard), heard, strict=True) if position["airborne"]} <= set(
        range(120_000, 120_000 + FLIGHT_MS)
    )
    (activated,) = service.asked
    assert activated[1] >= START_MS + 110_000


def test_a_flight_that_is_displaced_stays_where_it_is_until_it_is_planned_again() -> None:
    first, second = intent(1, 60), intent(2, 80, row=2)
    service = StandIn([first, second])
    again = intent(1, 200)

    def until(pilots: Pilots) -> bool:
        if not service.journal:
            service.intents[:] = [intent(1, 60, state=State.DISPLACED, trajectory=[]), second]
            service.tell(State.DISPLACED, first, is_new_plan=True)
        if len(service.journal) == 1 and pilots.report.arrived == 1 and pilots.unfinished == 0:
            assert service.heard("flight-1") == []
            service.intents[0] = again
            service.tell(State.ACCEPTED, again, is_new_plan=True)
        return pilots.report.arrived == 2

    fly(service, until=until)
    assert times(service.heard("flight-1"))[0] >= 190_000
    assert [what for what, _ in service.asked] == ["activate flight-2", "activate flight-1"]


def test_a_flight_in_the_air_goes_where_it_is_sent_now() -> None:
    detour = intent(1, -1, row=3, state=State.ACTIVATED)
    service = StandIn([intent(1, -1, state=State.ACTIVATED)], rate=20)

    def until(pilots: Pilots) -> bool:
        if not service.journal and service.reports:
            service.intents[:] = [detour]
            service.tell(State.ACTIVATED, detour, is_new_plan=True)
        return pilots.unfinished == 0

    assert fly(service, until=until).arrived == 1
    heard = service.heard("flight-1")
    y = [float(GRID.project(position["lon"], position["lat"])[1]) - GRID.origin_y_m for position in heard]
    assert y[0] == pytest.approx(30, abs=0.01)
    assert y[-1] == pytest.approx(70, abs=0.01)
    assert service.asked == []


def test_a_flight_that_cannot_make_way_flies_on_and_is_not_asked_for() -> None:
    asked: list[str] = []
    service = StandIn(
        [intent(1, -1, state=State.ACTIVATED)], rate=20, on_request=lambda request: asked.append(request.url.path)
    )

    def until(pilots: Pilots) -> bool:
        if not service.journal and service.reports:
            service.tell(UNMOVED, service.intents[0])
        return pilots.unfinished == 0

    assert fly(service, until=until).arrived == 1
    assert "/v1/events" in asked
    assert "/v1/flight-intents/flight-1" not in asked


def test_of_events_of_one_revision_none_is_missed_where_reading_fails_among_them() -> None:
    first, second = intent(1, 200), intent(2, 200, row=2)
    failures = iter(range(1))

    def refuse(request: httpx.Request) -> httpx.Response | None:
        if request.url.path.endswith("/flight-2") and next(failures, None) is not None:
            return httpx.Response(503, json={"type": "/problems/queue-full", "title": "Busy"})
        return None

    service = StandIn([], on_request=refuse)

    def until(pilots: Pilots) -> bool:
        if not service.journal:
            service.intents += [first, second]
            service.tell(State.ACCEPTED, first, second)
        return pilots.report.arrived == 2

    assert fly(service, until=until).refused == {"queue-full": 1}


def test_of_one_operator_only_its_own_flights_are_flown() -> None:
    mine, other = intent(1, 60, operator="medlift"), intent(2, 60, row=2)
    asked_for = []

    def listen(request: httpx.Request) -> None:
        asked_for.append(request.url.params.get("operator"))

    service = StandIn([], on_request=listen)

    def until(pilots: Pilots) -> bool:
        if not service.journal:
            service.intents += [mine, other]
            service.tell(State.ACCEPTED, mine)
            service.tell(State.ACCEPTED, other)
        return pilots.report.arrived == 1 and pilots.unfinished == 0

    fly(service, until=until, operator="medlift")
    assert "medlift" in asked_for
    assert service.heard("flight-2") == []


def test_a_late_flight_waits_on_its_pad_and_is_activated_when_it_goes() -> None:
    service = StandIn([intent(1, 12)], rate=50)
    report = fly(service, Deviations(1, (Kind.LATE,), first=1))
    heard = service.heard("flight-1")
    at, airborne = times(heard), [position["airborne"] for position in heard]
    departs = at[airborne.index(True)]
    assert 20_000 <= departs <= 43_000
    assert at[0] < 12_000
    (activated,) = service.asked
    assert activated[1] - START_MS >= 10_000
    assert report.deviating == {"late": 1}


def test_an_aircraft_that_is_lost_for_good_is_ended_by_its_operator() -> None:
    deviations = Deviations(seed_where(for_good=True), (Kind.LOST,), first=1)
    service = StandIn([intent(1, 12)], rate=50)
    report = fly(service, deviations, until=lambda _: len(service.asked) == 2)
    assert [what for what, _ in service.asked] == ["activate flight-1", "end flight-1"]
    assert service.asked[1][1] >= START_MS + 12_000 + FLIGHT_MS
    assert {position["airborne"] for position in service.heard("flight-1")} == {True, False}
    assert times(service.heard("flight-1"))[-1] < 12_000 + FLIGHT_MS
    assert report.deviating == {"lost": 1}


def test_an_aircraft_that_is_heard_again_only_after_it_landed_says_so() -> None:
    deviations = Deviations(seed_where(for_good=False), (Kind.LOST,), first=1)
    service = StandIn([intent(1, 12)], rate=50)
    assert fly(service, deviations).arrived == 1
    heard = service.heard("flight-1")
    assert heard[-1]["airborne"] is False
    assert times(heard)[-1] - times(heard)[-2] >= 15_000
    assert [what for what, _ in service.asked] == ["activate flight-1"]


def flown(dispatch: Dispatch) -> Flown:
    """Return what becomes of the flight that was found first."""
    _, aircraft = dispatch.found.get()
    assert aircraft is not None
    return aircraft.flown


def seed_where(*, for_good: bool) -> int:
    """Return a seed with which flight 1 is lost for good, or is not."""
    with Client("http://town", transport=httpx.MockTransport(StandIn([intent(1, 12)]).answer)) as client:
        for seed in range(50):
            dispatch = Dispatch(client, ServiceTime(client), GRID, Deviations(seed, (Kind.LOST,), first=1), None)
            if (flown(dispatch).silent_until_ms is None) == for_good:
                return seed
    raise AssertionError("no such seed")


def test_an_intruder_is_a_track_that_comes_in_the_air_and_lands_somewhere() -> None:
    service = StandIn([intent(7, 12)], rate=50)
    fly(service, Deviations(1, (Kind.INTRUDER,), first=1))
    heard = service.heard("intruder-7")
    assert [position["airborne"] for position in heard] == [True] * (len(heard) - 1) + [False]
    assert not any("flight_intent_id" in position for position in heard)
    assert service.heard("flight-7")[-1]["airborne"] is False


def test_refusals_and_flags_are_counted_by_what_they_are() -> None:
    def answer(_: list[dict[str, Any]]) -> httpx.Response:
        problem = {"index": 0, "type": "/problems/position-out-of-order", "title": "", "status": 409, "detail": ""}
        flag = {"index": 0, "flag": "implausible-jump", "detail": ""}
        return httpx.Response(202, json={"accepted": 0, "problem_count": 1, "problems": [problem], "flagged": [flag]})

    service = StandIn([intent(1, 12)], on_telemetry=answer)
    report = fly(service)
    reports = len(service.reports)
    assert report.refused == {"position-out-of-order": reports}
    assert report.flagged == {"implausible-jump": reports}
    assert report.accepted == 0


def test_a_request_that_is_refused_counts_for_all_its_positions_and_a_landing_is_told_again() -> None:
    refused: list[int] = []

    def answer(positions: list[dict[str, Any]]) -> httpx.Response:
        if (
            not all(position["airborne"] for position in positions)
            and times(positions)[0] > 12_000
            and len(refused) < 3
        ):
            refused.append(len(positions))
            return httpx.Response(503, json={"type": "/problems/queue-full", "title": "Busy"})
        return taken(positions)

    service = StandIn([intent(1, 12), intent(2, 12, row=2)], on_telemetry=answer)
    report = fly(service)
    assert report.refused == {"queue-full": 6}
    assert report.arrived == 2
    assert refused == [2, 2, 2]


def test_an_activation_that_is_refused_is_counted_and_the_aircraft_flies_all_the_same() -> None:
    def refuse(request: httpx.Request) -> httpx.Response | None:
        if not request.url.path.endswith("/activate"):
            return None
        return httpx.Response(409, json={"type": "/problems/illegal-transition", "title": "No"})

    service = StandIn([intent(1, 12)], on_request=refuse)
    report = fly(service)
    assert report.refused == {"activate or end: illegal-transition": 1}
    assert report.arrived == 1


def test_an_activation_for_which_the_service_is_too_busy_is_asked_for_again() -> None:
    failures = iter(range(2))

    def refuse(request: httpx.Request) -> httpx.Response | None:
        if request.url.path.endswith("/activate") and next(failures, None) is not None:
            return httpx.Response(503, json={"type": "/problems/queue-full", "title": "Busy"})
        return None

    service = StandIn([intent(1, 30)], on_request=refuse)
    report = fly(service)
    assert [what for what, _ in service.asked] == ["activate flight-1"]
    assert report.refused == {"queue-full": 2}


def test_a_long_interval_keeps_nobody_waiting_for_the_end() -> None:
    service = StandIn([intent(1, 60)], rate=1)
    looks = []

    def until(pilots: Pilots) -> bool:
        looks.append(pilots.unfinished)
        return len(looks) == 3

    fly(service, until=until, interval_s=3600)
    assert looks == [1, 1, 1]
    assert service.reports == []


def test_a_slow_service_makes_ticks_be_skipped_and_nothing_queue() -> None:
    sending = threading.Lock()

    def answer(positions: list[dict[str, Any]]) -> httpx.Response:
        assert sending.acquire(blocking=False)
        time.sleep(0.05)
        sending.release()
        return taken(positions)

    # Fifty milliseconds are five of its seconds.
    service = StandIn([intent(1, 12)], on_telemetry=answer)
    report = fly(service)
    at = times(service.heard("flight-1"))
    assert min(np.diff(at)) >= 5_000
    assert report.skipped >= 4 * (len(at) - 1)
    assert report.arrived == 1


def test_a_service_that_does_not_answer_for_a_while_is_asked_again() -> None:
    failures = iter(range(2))

    def hang_up(request: httpx.Request) -> None:
        if request.url.path == "/v1/telemetry" and next(failures, None) is not None:
            raise httpx.ConnectError("Connection refused", request=request)

    service = StandIn([intent(1, 12)], on_request=hang_up)
    report = fly(service)
    assert report.unanswered == {"no answer from http://town: Connection refused": 2}
    assert report.arrived == 1


def test_the_dispatch_goes_on_after_the_journal_could_not_be_read() -> None:
    first, failures = intent(1, 60), iter(range(1))

    def hang_up(request: httpx.Request) -> None:
        if request.url.path == "/v1/events" and next(failures, None) is not None:
            raise httpx.ReadTimeout("timed out", request=request)

    service = StandIn([first], on_request=hang_up)
    assert fly(service).arrived == 1
    assert len(service.asked) == 1


def test_something_that_is_no_airmatrix_ends_it() -> None:
    service = StandIn([intent(1, 12)], on_telemetry=lambda _: httpx.Response(200, text="hello"))
    with pytest.raises(UnexpectedAnswer):
        fly(service)
    journal = StandIn(
        [intent(1, 12)], on_request=lambda request: httpx.Response(200) if "events" in request.url.path else None
    )
    with pytest.raises(UnexpectedAnswer):
        fly(journal)


def test_a_service_that_is_not_there_at_the_start_is_an_error() -> None:
    def hang_up(request: httpx.Request) -> None:
        raise httpx.ConnectError("Connection refused", request=request)

    with pytest.raises(ServiceUnreachable):
        fly(StandIn([], on_request=hang_up))


def test_a_clock_that_is_set_back_starts_the_ticks_anew() -> None:
    service = StandIn([intent(1, -1, state=State.ACTIVATED)])

    def until(pilots: Pilots) -> bool:
        if len(service.reports) == 3:
            service.clock = ServerClock(START_MS - 3_600_000, RATE)
            pilots._clock.read()
        return len(service.reports) >= 6

    fly(service, until=until)
    assert times(service.heard("flight-1"))[-1] < 0


def test_the_clock_is_never_ahead_of_the_services() -> None:
    service = StandIn([])
    with Client("http://town", transport=httpx.MockTransport(service.answer)) as client:
        clock = ServiceTime(client)
        for _ in range(100):
            assert clock.now() <= service.clock()
        clock.read()
        assert clock.now() <= service.clock()
    assert clock.rate == RATE
