"""Where aircraft were seen, and what was remarked of them: rows of the ledger, and the picture they make."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
import orjson
from sqlalchemy import Connection, Row, and_, delete, func, insert, or_, select, text, tuple_

from app.flight_intents import HeldReservations, State
from app.ledger.queries import BOUND_AT_ONCE, in_the_air
from app.ledger.rows import joined_held, to_held
from app.ledger.tables import (
    counters,
    flight_intents,
    journal,
    newest_positions,
    position_history,
    remarks,
    reservations,
)
from app.surveillance import Aircraft, AirPicture, Flight, Path, Reach, Remark, Sighting, Velocity
from planner.airmatrix import AirMatrix

# As the indices of these flights say it: SQLite compares conditions by their text.
IS_OPEN = text("flight_intents.state IN ('accepted', 'activated', 'nonconforming', 'contingent')")
IS_OVER = text("flight_intents.state IN ('cancelled', 'ended')")

# Both databases understand this.
_UPSERT = text(
    "INSERT INTO newest_positions"
    " (intent, track_id, time, lon, lat, alt_m, airborne, implausible, east_mps, north_mps, up_mps)"
    " VALUES"
    " (:intent, :track_id, :time, :lon, :lat, :alt_m, :airborne, :implausible, :east_mps, :north_mps, :up_mps)"
    " ON CONFLICT (intent, track_id) DO UPDATE SET"
    " time = excluded.time, lon = excluded.lon, lat = excluded.lat, alt_m = excluded.alt_m,"
    " airborne = excluded.airborne, implausible = excluded.implausible,"
    " east_mps = excluded.east_mps, north_mps = excluded.north_mps, up_mps = excluded.up_mps"
)
# A second position of one moment comes only after the clock was set back.
_HISTORY = text(
    "INSERT INTO position_history (intent, track_id, time, lon, lat, alt_m, airborne)"
    " VALUES (:intent, :track_id, :time, :lon, :lat, :alt_m, :airborne)"
    " ON CONFLICT (intent, track_id, time) DO UPDATE SET"
    " lon = excluded.lon, lat = excluded.lat, alt_m = excluded.alt_m, airborne = excluded.airborne"
)
_HISTORY_COLUMNS = tuple(column.name for column in position_history.c)


def newest(connection: Connection, aircraft: Iterable[Aircraft]) -> dict[Aircraft, Sighting]:
    """Return the newest positions of some aircraft, without their blocks."""
    wanted_aircraft = set(aircraft)
    sequences = sorted(each.sequence for each in wanted_aircraft if not each.track_id)
    tracks = sorted(each.track_id for each in wanted_aircraft if each.track_id)
    position = newest_positions.c
    found: dict[Aircraft, Sighting] = {}
    for start in range(0, max(len(sequences), len(tracks)), BOUND_AT_ONCE):
        part = slice(start, start + BOUND_AT_ONCE)
        wanted = or_(
            and_(position.intent.in_(sequences[part]), position.track_id == ""),
            and_(position.intent == 0, position.track_id.in_(tracks[part])),
        )
        rows = connection.execute(select(newest_positions).where(wanted))
        found.update((Aircraft(row.intent, row.track_id), _sighting(row)) for row in rows)
    return found


def store(connection: Connection, reports: Sequence[tuple[Aircraft, Sighting]]) -> None:
    """Write positions, each newer than those before it of the same aircraft."""
    if not reports:
        return
    rows = [_row(aircraft, sighting) for aircraft, sighting in reports]
    connection.execute(_UPSERT, list({(row["intent"], row["track_id"]): row for row in rows}.values()))
    connection.execute(_HISTORY, [{name: row[name] for name in _HISTORY_COLUMNS} for row in rows])


def remove(connection: Connection, before_ms: int, limit: int) -> int:
    """Remove up to `limit` positions from before a time, and the tracks that were not seen since; return how many."""
    history, position = position_history.c, newest_positions.c
    old = select(history.time).where(history.time < before_ms).order_by(history.time).limit(limit)
    times = list(connection.execute(old).scalars())
    if not times:
        gone = position.intent == 0, position.time < before_ms
        return connection.execute(delete(newest_positions).where(*gone)).rowcount
    # Whole milliseconds: of the last one there may be a few more than the limit.
    return connection.execute(delete(position_history).where(history.time <= times[-1])).rowcount


def remove_of(connection: Connection, sequences: Sequence[int]) -> None:
    """Remove all that is known of where flights were."""
    for table in (newest_positions, position_history, remarks):
        connection.execute(delete(table).where(table.c.intent.in_(sequences)))


def remark(connection: Connection, changed: Mapping[Aircraft, Remark | None]) -> None:
    """Replace what was recorded of some aircraft; None: there is nothing to remark any more."""
    if not changed:
        return
    key = tuple_(remarks.c.intent, remarks.c.track_id)
    connection.execute(delete(remarks).where(key.in_([tuple(aircraft) for aircraft in changed])))
    rows = [
        {
            "intent": aircraft.sequence,
            "track_id": aircraft.track_id,
            "conformance": new.conformance,
            "reasons": json.dumps(new.reasons),
            "since": new.since_ms,
            "raised": new.raised_ms,
        }
        for aircraft, new in changed.items()
        if new is not None
    ]
    if rows:
        connection.execute(insert(remarks), rows)


def remarked(connection: Connection, aircraft: Iterable[Aircraft] | None = None) -> dict[Aircraft, Remark]:
    """Return what is recorded of aircraft that do not simply conform: of all, or of some."""
    query = select(remarks)
    if aircraft is not None:
        query = query.where(tuple_(remarks.c.intent, remarks.c.track_id).in_([tuple(each) for each in aircraft]))
    return {
        Aircraft(row.intent, row.track_id): Remark(
            row.conformance, tuple(json.loads(row.reasons)), row.since, row.raised
        )
        for row in connection.execute(query)
    }


def air_picture(
    connection: Connection,
    grid: AirMatrix,
    at_ms: int,
    reach: Reach,
    *,
    is_past: bool,
    is_forecast: bool,
) -> AirPicture:
    """Return what is known of the air at a time; flights that are due and unseen only where it is the present."""
    since_ms, track_since_ms = at_ms - reach.before_ms, at_ms - reach.track_ms
    held = _held(connection, since_ms, at_ms + reach.after_ms + 1)
    wanted = set(held.sequence.tolist())
    if is_forecast:
        return AirPicture(at_ms, held, _flights(connection, wanted), is_forecast=True)
    if is_past and since_ms < _kept_since(connection):
        # Nobody knows any more who was seen: only what was reserved can be said, and nobody is missed.
        return AirPicture(at_ms, held, _as_of(connection, _flights(connection, wanted), at_ms), is_forecast=True)
    if is_past:
        sightings = _seen_until(connection, at_ms, since_ms, track_since_ms)
        wanted.update(aircraft.sequence for aircraft in sightings if not aircraft.track_id)
        missing = [Aircraft(sequence) for sequence in wanted if Aircraft(sequence) not in sightings]
        sightings |= _last_seen(connection, missing, at_ms)
    else:
        sightings = _seen_since(connection, since_ms, track_since_ms)
        wanted.update(aircraft.sequence for aircraft in sightings if not aircraft.track_id)
        wanted.update(_due(connection, at_ms, at_ms + reach.due_ms))
        missing = [Aircraft(sequence) for sequence in wanted if Aircraft(sequence) not in sightings]
        sightings |= newest(connection, missing)
    flights = _flights(connection, wanted)
    if is_past:
        flights = _as_of(connection, flights, at_ms)
    return AirPicture(at_ms, held, flights, _located(sightings, grid), remarked(connection))


def _kept_since(connection: Connection) -> int:
    """Return the time from which on positions are kept."""
    return int(connection.execute(select(counters.c.positions_removed_before)).scalar_one())


def _held(connection: Connection, from_ms: int, to_ms: int) -> HeldReservations:
    query = select(reservations).where(
        reservations.c.enter < to_ms, reservations.c.exit > from_ms, in_the_air(from_ms, to_ms)
    )
    return to_held(connection.execute(query))


def unseen(connection: Connection, before_ms: int, limit: int) -> list[tuple[int, str]]:
    """Return sequences and ids of up to `limit` flights that should have arrived before a time and were never seen."""
    flight = flight_intents.c
    seen = select(newest_positions.c.intent).where(newest_positions.c.intent == flight.sequence).exists()
    query = select(flight.sequence, flight.id).where(IS_OPEN, flight.arrival < before_ms, ~seen)
    return [(row.sequence, row.id) for row in connection.execute(query.order_by(flight.arrival).limit(limit))]


def held_in(connection: Connection, blocks: Sequence[int], from_ms: int, to_ms: int) -> HeldReservations:
    """Return the reservations of some blocks that overlap [from, to), by block and enter."""
    held = reservations.c
    # A reservation is no longer than the longest flight: nothing older is looked at.
    longest_ms = select(counters.c.longest_flight).scalar_subquery()
    overlaps = and_(held.enter >= from_ms - longest_ms - 1, held.enter < to_ms, held.exit > from_ms)
    query = select(reservations).where(overlaps, in_the_air(from_ms, to_ms)).order_by(held.block, held.enter)
    parts = [
        to_held(connection.execute(query.where(held.block.in_(blocks[start : start + BOUND_AT_ONCE]))))
        for start in range(0, len(blocks), BOUND_AT_ONCE)
    ]
    return parts[0] if len(parts) == 1 else joined_held(parts)


def _due(connection: Connection, at_ms: int, due_before_ms: int) -> list[int]:
    """Return the open flights that fly now or are due to; of those that should have arrived, the ones ever seen."""
    flight = flight_intents.c
    # Bounded above too: all that is planned for later stands in the same index.
    latest_ms = due_before_ms + select(counters.c.longest_flight).scalar_subquery()
    flying = select(flight.sequence).where(
        IS_OPEN, flight.arrival >= at_ms, flight.arrival < latest_ms, flight.departure < due_before_ms
    )
    seen = select(newest_positions.c.intent).where(newest_positions.c.intent == flight.sequence).exists()
    overdue = select(flight.sequence).where(IS_OPEN, flight.arrival < at_ms, seen)
    return [*connection.execute(flying).scalars(), *connection.execute(overdue).scalars()]


def _seen_since(connection: Connection, since_ms: int, track_since_ms: int) -> dict[Aircraft, Sighting]:
    position = newest_positions.c
    wanted = or_(position.time >= since_ms, and_(position.intent == 0, position.time >= track_since_ms))
    rows = connection.execute(select(newest_positions).where(position.time >= min(since_ms, track_since_ms), wanted))
    return {Aircraft(row.intent, row.track_id): _sighting(row) for row in rows}


def _seen_until(connection: Connection, at_ms: int, since_ms: int, track_since_ms: int) -> dict[Aircraft, Sighting]:
    position = position_history.c
    wanted = or_(position.time >= since_ms, and_(position.intent == 0, position.time >= track_since_ms))
    rows = connection.execute(
        select(position_history)
        .where(position.time >= min(since_ms, track_since_ms), position.time <= at_ms, wanted)
        .order_by(position.time)
    )
    return {Aircraft(row.intent, row.track_id): _past_sighting(row) for row in rows}


def _last_seen(connection: Connection, aircraft: Sequence[Aircraft], at_ms: int) -> dict[Aircraft, Sighting]:
    position = position_history.c
    found: dict[Aircraft, Sighting] = {}
    for start in range(0, len(aircraft), BOUND_AT_ONCE):
        sequences = [each.sequence for each in aircraft[start : start + BOUND_AT_ONCE]]
        last = (
            select(position.intent, func.max(position.time).label("time"))
            .where(position.intent.in_(sequences), position.track_id == "", position.time <= at_ms)
            .group_by(position.intent)
            .subquery()
        )
        rows = connection.execute(
            select(position_history).join(
                last, and_(position.intent == last.c.intent, position.track_id == "", position.time == last.c.time)
            )
        )
        found.update((Aircraft(row.intent), _past_sighting(row)) for row in rows)
    return found


def _flights(connection: Connection, sequences: Iterable[int]) -> dict[int, Flight]:
    flight = flight_intents.c
    columns = (
        flight.sequence, flight.id, flight.version, flight.state, flight.operator, flight.reference,
        flight.aircraft_type, flight.activated, flight.trajectory,
    )  # fmt: skip
    unique = sorted(sequences)
    found = {}
    for start in range(0, len(unique), BOUND_AT_ONCE):
        part = flight.sequence.in_(unique[start : start + BOUND_AT_ONCE])
        for sequence, id_, version, state, operator, reference, aircraft_type, activated, path in connection.execute(
            select(*columns).where(part)
        ):
            found[sequence] = Flight(
                sequence, id_, version, State(state), operator, reference, aircraft_type, activated,
                None if path is None else _path(path),
            )  # fmt: skip
    return found


def _as_of(connection: Connection, flights: Mapping[int, Flight], at_ms: int) -> dict[int, Flight]:
    """Return flights in the states that they had at a time, as far as the journal reaches back."""
    entry = journal.c
    past: dict[int, Flight] = dict(flights)
    sequences = sorted(flights)
    states = [state.value for state in State]
    for start in range(0, len(sequences), BOUND_AT_ONCE):
        rows = connection.execute(
            select(entry.intent, entry.kind, entry.time)
            .where(entry.intent.in_(sequences[start : start + BOUND_AT_ONCE]), entry.kind.in_(states))
            .where(entry.time <= at_ms)
            .order_by(entry.revision)
        )
        for row in rows:
            flight = past[row.intent]
            is_activated = flight.activated_ms is not None and flight.activated_ms <= at_ms
            past[row.intent] = replace(
                flight, state=State(row.kind), activated_ms=flight.activated_ms if is_activated else None
            )
    return past


@lru_cache(maxsize=8192)
def _path(trajectory: str) -> Path:
    """Return a trajectory's text as a path; the same flights are looked at every second."""
    block, arrive_ms, depart_ms = zip(*orjson.loads(trajectory), strict=True)
    return Path(block, arrive_ms, depart_ms)


def _row(aircraft: Aircraft, sighting: Sighting) -> dict[str, Any]:
    east, north, up = sighting.velocity or (None, None, None)
    return {
        "intent": aircraft.sequence,
        "track_id": aircraft.track_id,
        "time": sighting.time_ms,
        "lon": sighting.lon,
        "lat": sighting.lat,
        "alt_m": sighting.alt_m,
        "airborne": sighting.airborne,
        "implausible": sighting.is_implausible,
        "east_mps": east,
        "north_mps": north,
        "up_mps": up,
    }


def _sighting(row: Row[Any]) -> Sighting:
    velocity = None if row.east_mps is None else Velocity(row.east_mps, row.north_mps, row.up_mps)
    return Sighting(row.time, row.lon, row.lat, row.alt_m, row.airborne, velocity, row.implausible)


def _past_sighting(row: Row[Any]) -> Sighting:
    return Sighting(row.time, row.lon, row.lat, row.alt_m, row.airborne)


def _located(sightings: Mapping[Aircraft, Sighting], grid: AirMatrix) -> dict[Aircraft, Sighting]:
    """Return sightings with the blocks that they lie in."""
    if not sightings:
        return {}
    positions = np.array([(seen.lon, seen.lat, seen.alt_m) for seen in sightings.values()])
    blocks = grid.blocks_at(*positions.T).tolist()
    return {
        aircraft: Sighting(
            seen.time_ms, seen.lon, seen.lat, seen.alt_m, seen.airborne, seen.velocity, seen.is_implausible,
            None if block < 0 else block,
        )
        for (aircraft, seen), block in zip(sightings.items(), blocks, strict=True)
    }  # fmt: skip
