"""The ledger: airspace, counters, flight intents, reservations, journal, idempotency keys."""

import sqlalchemy as sa
from alembic import op

revision = "0001"
down_revision = None

# 64 bits on every database; on SQLite the row's own number.
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

# Holds of a block are disjoint, so only the one with the greatest enter before NEW.exit can overlap it: O(log n),
# and right for holds of any length.
OVERLAP = """
CREATE TRIGGER reservations_no_overlap_on_{event} BEFORE {event} ON reservations
WHEN EXISTS (
    SELECT 1 FROM (
        SELECT "exit" FROM reservations
        WHERE block = NEW.block AND enter < NEW."exit" {other_than_old}
        ORDER BY enter DESC LIMIT 1
    ) AS newest WHERE newest."exit" > NEW.enter
)
BEGIN SELECT RAISE(ABORT, 'reservations_no_overlap'); END
"""

# Also against INSERT OR REPLACE, which fires no DELETE trigger.
IN_ORDER = """
CREATE TRIGGER journal_in_order BEFORE INSERT ON journal
WHEN NEW.revision <= (SELECT MAX(revision) FROM journal)
BEGIN SELECT RAISE(ABORT, 'journal_in_order'); END
"""

APPEND_ONLY = """
CREATE TRIGGER journal_append_only_on_{event} BEFORE {event} ON journal
BEGIN SELECT RAISE(ABORT, 'journal_append_only'); END
"""

# PostgreSQL can refuse an overlap by itself. The extension brings `block WITH =` to GiST indices.
EXCLUSION = (
    "CREATE EXTENSION IF NOT EXISTS btree_gist",
    """
    ALTER TABLE reservations ADD CONSTRAINT reservations_no_overlap
    EXCLUDE USING gist (block WITH =, int8range(enter, "exit") WITH &&)
    """,
)
FUNCTIONS = (
    """
    CREATE FUNCTION journal_in_order() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN
        IF NEW.revision <= (SELECT max(revision) FROM journal) THEN
            RAISE EXCEPTION 'journal_in_order' USING ERRCODE = 'integrity_constraint_violation';
        END IF;
        RETURN NEW;
    END $$
    """,
    """
    CREATE FUNCTION journal_append_only() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN
        RAISE EXCEPTION 'journal_append_only' USING ERRCODE = 'integrity_constraint_violation';
    END $$
    """,
    "CREATE TRIGGER journal_in_order BEFORE INSERT ON journal FOR EACH ROW EXECUTE FUNCTION journal_in_order()",
    """
    CREATE TRIGGER journal_append_only BEFORE UPDATE OR DELETE ON journal
    FOR EACH ROW EXECUTE FUNCTION journal_append_only()
    """,
    """
    CREATE TRIGGER journal_append_only_as_a_whole BEFORE TRUNCATE ON journal
    FOR EACH STATEMENT EXECUTE FUNCTION journal_append_only()
    """,
)


def upgrade() -> None:
    on_postgresql = op.get_bind().dialect.name == "postgresql"
    op.create_table(
        "airspace",
        sa.Column(
            "only",
            sa.Integer,
            sa.CheckConstraint('"only" = 1', name="airspace_only_one"),
            primary_key=True,
            autoincrement=False,
        ),
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        sa.Column("fingerprint", sa.Text, nullable=False),
    )
    op.create_table(
        "counters",
        sa.Column(
            "only",
            sa.Integer,
            sa.CheckConstraint('"only" = 1', name="counters_only_one"),
            primary_key=True,
            autoincrement=False,
        ),
        sa.Column("sequence", sa.BigInteger, nullable=False),
        sa.Column("revision", sa.BigInteger, nullable=False),
        # Bounds how long before a time a flight in the air at that time can have departed.
        sa.Column("longest_flight", sa.BigInteger, nullable=False),
    )
    op.execute("INSERT INTO counters VALUES (1, 0, 0, 0)")
    op.create_table(
        "flight_intents",
        sa.Column("sequence", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("version", sa.BigInteger, nullable=False),
        sa.Column("state", sa.Text, nullable=False),
        sa.Column("operator", sa.Text, nullable=False),
        sa.Column("reference", sa.Text),
        sa.Column("aircraft_type", sa.Text, nullable=False),
        sa.Column("priority", sa.Integer, nullable=False),
        sa.Column("origin", sa.Text, nullable=False),
        sa.Column("destination", sa.Text, nullable=False),
        sa.Column("origin_block", sa.BigInteger, nullable=False),
        sa.Column("destination_block", sa.BigInteger, nullable=False),
        sa.Column("earliest_departure", sa.BigInteger, nullable=False),
        sa.Column("latest_departure", sa.BigInteger, nullable=False),
        sa.Column("received", sa.BigInteger, nullable=False),
        sa.Column("departure", sa.BigInteger),
        sa.Column("arrival", sa.BigInteger),
        sa.Column("unconstrained", sa.BigInteger),
        sa.Column("trajectory", sa.Text),
        sa.Column("refusal", sa.Text),
        sa.CheckConstraint("earliest_departure <= latest_departure", name="flight_intents_departure_window"),
        sa.CheckConstraint("(refusal IS NULL) <> (trajectory IS NULL)", name="flight_intents_plan_or_refusal"),
        sa.UniqueConstraint("id", name="flight_intents_id"),
    )
    op.create_index("flight_intents_by_operator", "flight_intents", ["operator", "sequence"])
    op.create_index("flight_intents_by_time", "flight_intents", ["departure", "arrival"])
    # On PostgreSQL the exclusion constraint is a key already, and another index would cost a fifth of all writing.
    op.create_table(
        "reservations",
        sa.Column("block", sa.BigInteger, nullable=False, primary_key=not on_postgresql, autoincrement=False),
        sa.Column("enter", sa.BigInteger, nullable=False, primary_key=not on_postgresql, autoincrement=False),
        sa.Column("exit", sa.BigInteger, nullable=False),
        sa.Column(
            "intent",
            NUMBER,
            sa.ForeignKey("flight_intents.sequence", name="reservations_intent"),
            nullable=False,
        ),
        sa.CheckConstraint('enter < "exit"', name="reservations_not_empty"),
        sqlite_with_rowid=False,
    )
    op.create_index(
        "reservations_by_intent", "reservations", ["intent"] if on_postgresql else ["intent", "enter", "exit"]
    )
    op.create_table(
        "journal",
        sa.Column("revision", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("time", sa.BigInteger, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("intent", NUMBER, sa.ForeignKey("flight_intents.sequence", name="journal_intent"), nullable=False),
        sa.Column("released", sa.Text),
    )
    op.create_table(
        "idempotency_keys",
        sa.Column("operator", sa.Text, primary_key=True),
        sa.Column("key", sa.Text, primary_key=True),
        sa.Column("body_digest", sa.Text, nullable=False),
        sa.Column(
            "intent",
            NUMBER,
            sa.ForeignKey("flight_intents.sequence", name="idempotency_keys_intent"),
            nullable=False,
        ),
        sa.Column("answer", sa.Text, nullable=False),
        sa.Column("created", sa.BigInteger, nullable=False),
    )
    op.create_index("idempotency_keys_by_age", "idempotency_keys", ["created"])
    if on_postgresql:
        # What tells a ledger from any other database.
        op.execute("COMMENT ON TABLE counters IS 'AirMatrix ledger'")
        for statement in (*EXCLUSION, *FUNCTIONS):
            op.execute(statement)
        return
    op.execute(OVERLAP.format(event="INSERT", other_than_old=""))
    op.execute(OVERLAP.format(event="UPDATE", other_than_old="AND NOT (block = OLD.block AND enter = OLD.enter)"))
    op.execute(IN_ORDER)
    for event in ("UPDATE", "DELETE"):
        op.execute(APPEND_ONLY.format(event=event))
