"""The ledger's tables as queries see them; `migrations` creates them, with their guards."""

from sqlalchemy import BigInteger, Boolean, Column, Double, Integer, MetaData, Table, Text

metadata = MetaData()

airspace = Table(
    "airspace",
    metadata,
    Column("only", Integer, primary_key=True),
    Column("id", Text),
    Column("name", Text),
    Column("fingerprint", Text),
)

counters = Table(
    "counters",
    metadata,
    Column("only", Integer, primary_key=True),
    Column("sequence", BigInteger),
    Column("revision", BigInteger),
    Column("longest_flight", BigInteger),
    Column("removed_before", BigInteger),
    Column("journal_removed", BigInteger),
    Column("positions_removed_before", BigInteger),
    Column("lowest_priority", BigInteger),
)

# Times are ms since the epoch; `origin` and `destination` JSON objects of lon, lat, alt_m; `trajectory` a JSON list of
# [block, arrive, depart]; `refusal` a JSON object. Exactly one of these two is null.
flight_intents = Table(
    "flight_intents",
    metadata,
    Column("sequence", BigInteger, primary_key=True),
    Column("id", Text),
    Column("version", BigInteger),
    Column("state", Text),
    Column("operator", Text),
    Column("reference", Text),
    Column("aircraft_type", Text),
    Column("priority", Integer),
    Column("origin", Text),
    Column("destination", Text),
    Column("origin_block", BigInteger),
    Column("destination_block", BigInteger),
    Column("earliest_departure", BigInteger),
    Column("latest_departure", BigInteger),
    Column("received", BigInteger),
    Column("departure", BigInteger),
    Column("arrival", BigInteger),
    Column("unconstrained", BigInteger),
    Column("trajectory", Text),
    Column("submitted", Boolean),
    Column("refusal", Text),
    Column("activated", BigInteger),
)

reservations = Table(
    "reservations",
    metadata,
    Column("block", BigInteger, primary_key=True),
    Column("enter", BigInteger, primary_key=True),
    Column("exit", BigInteger),
    Column("intent", BigInteger),
)

# `place` orders the entries of one revision. `released`: a JSON list of [block, enter, exit] that a change took away,
# null where it took none. What is of a track or of a constraint has intent 0 and no flight intent's id. `reasons`: a
# JSON list, `details` a JSON object.
journal = Table(
    "journal",
    metadata,
    Column("revision", BigInteger, primary_key=True),
    Column("place", Integer, primary_key=True),
    Column("time", BigInteger),
    Column("kind", Text),
    Column("intent", BigInteger),
    Column("flight_intent_id", Text),
    Column("released", Text),
    Column("track_id", Text),
    Column("reasons", Text),
    Column("details", Text),
)

idempotency_keys = Table(
    "idempotency_keys",
    metadata,
    Column("operator", Text, primary_key=True),
    Column("key", Text, primary_key=True),
    Column("body_digest", Text),
    Column("intent", BigInteger),
    Column("answer", Text),
    Column("created", BigInteger),
)

# The key of these three: a flight intent's sequence number and no track, or 0 and a track.
newest_positions = Table(
    "newest_positions",
    metadata,
    Column("intent", BigInteger, primary_key=True),
    Column("track_id", Text, primary_key=True),
    Column("time", BigInteger),
    Column("lon", Double),
    Column("lat", Double),
    Column("alt_m", Double),
    Column("airborne", Boolean),
    Column("implausible", Boolean),
    Column("east_mps", Double),
    Column("north_mps", Double),
    Column("up_mps", Double),
)

position_history = Table(
    "position_history",
    metadata,
    Column("intent", BigInteger, primary_key=True),
    Column("track_id", Text, primary_key=True),
    Column("time", BigInteger, primary_key=True),
    Column("lon", Double),
    Column("lat", Double),
    Column("alt_m", Double),
    Column("airborne", Boolean),
)

# What was last recorded of who does not simply conform. `reasons`: a JSON list.
remarks = Table(
    "remarks",
    metadata,
    Column("intent", BigInteger, primary_key=True),
    Column("track_id", Text, primary_key=True),
    Column("conformance", Text),
    Column("reasons", Text),
    Column("since", BigInteger),
    Column("raised", BigInteger),
)

# `polygon`: GeoJSON; `blocks`: a JSON list of flat indices. A constraint that was removed stays, for the past.
constraints = Table(
    "constraints",
    metadata,
    Column("number", BigInteger, primary_key=True),
    Column("id", Text),
    Column("name", Text),
    Column("polygon", Text),
    Column("blocks", Text),
    Column("base_m", Double),
    Column("top_m", Double),
    Column("begins", BigInteger),
    Column("ends", BigInteger),
    Column("created", BigInteger),
    Column("removed", BigInteger),
)
