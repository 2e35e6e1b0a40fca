"""Conformance monitoring: where aircraft were seen, what was remarked of them, and who has activated a flight."""

import sqlalchemy as sa
from alembic import op

revision = "0003"
down_revision = "0002"

# 64 bits on every database; on SQLite the row's own number.
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

# The flights that may still fly: few, however many the ledger holds.
OPEN = "state IN ('accepted', 'activated', 'nonconforming', 'contingent')"


def upgrade() -> None:
    op.add_column("flight_intents", sa.Column("activated", sa.BigInteger))
    op.create_index(
        "flight_intents_open", "flight_intents", ["arrival"], sqlite_where=sa.text(OPEN), postgresql_where=sa.text(OPEN)
    )
    # Positions taken before this time (ms) may have been removed.
    op.add_column("counters", sa.Column("positions_removed_before", sa.BigInteger, nullable=False, server_default="0"))
    # An entry of a track has intent 0 and no flight intent's id.
    op.add_column("journal", sa.Column("track_id", sa.Text))
    op.add_column("journal", sa.Column("reasons", sa.Text))
    op.create_index("journal_by_intent", "journal", ["intent", "revision"])
    op.create_table(
        "newest_positions",
        *_aircraft(),
        sa.Column("time", sa.BigInteger, nullable=False),
        *_position(),
        sa.Column("implausible", sa.Boolean, nullable=False),
        sa.Column("east_mps", sa.Double),
        sa.Column("north_mps", sa.Double),
        sa.Column("up_mps", sa.Double),
        sqlite_with_rowid=False,
    )
    op.create_index("newest_positions_by_time", "newest_positions", ["time"])
    op.create_table(
        "position_history",
        *_aircraft(),
        sa.Column("time", sa.BigInteger, primary_key=True, autoincrement=False),
        *_position(),
        sqlite_with_rowid=False,
    )
    op.create_index("position_history_by_time", "position_history", ["time"])
    op.create_table(
        "remarks",
        *_aircraft(),
        sa.Column("conformance", sa.Text, nullable=False),
        sa.Column("reasons", sa.Text, nullable=False),
        sa.Column("since", sa.BigInteger, nullable=False),
        sa.Column("raised", sa.BigInteger, nullable=False),
        sqlite_with_rowid=False,
    )


def _aircraft() -> tuple[sa.Column[int], sa.Column[str]]:
    """Return the key of a flight's aircraft, or of a track: intent 0 and its id."""
    return (
        sa.Column("intent", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("track_id", sa.Text, primary_key=True),
    )


def _position() -> tuple[sa.Column[float], sa.Column[float], sa.Column[float], sa.Column[bool]]:
    """Return WGS84 degrees, metres above the ground datum, and whether it flew, where anybody said."""
    return (
        sa.Column("lon", sa.Double, nullable=False),
        sa.Column("lat", sa.Double, nullable=False),
        sa.Column("alt_m", sa.Double, nullable=False),
        sa.Column("airborne", sa.Boolean),
    )
