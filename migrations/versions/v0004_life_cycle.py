"""Change, priority, constraints: several journal entries may be one revision, and closed airspace is kept."""

import sqlalchemy as sa
from alembic import op

revision = "0004"
down_revision = "0003"

# 64 bits on every database; on SQLite the row's own number.
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

COPY = """
INSERT INTO journal_of_4 (revision, place, time, kind, intent, flight_intent_id, released, track_id, reasons)
SELECT revision, 0, time, kind, intent, flight_intent_id, released, track_id, reasons
FROM journal ORDER BY revision
"""

SQLITE = (
    # Also against INSERT OR REPLACE, which fires no DELETE trigger.
    """
    CREATE TRIGGER journal_in_order BEFORE INSERT ON journal
    WHEN EXISTS (
        SELECT 1 FROM (SELECT revision, place FROM journal ORDER BY revision DESC, place DESC LIMIT 1) AS newest
        WHERE (NEW.revision, NEW.place) <= (newest.revision, newest.place)
    )
    BEGIN SELECT RAISE(ABORT, 'journal_in_order'); END
    """,
    """
    CREATE TRIGGER journal_append_only_on_UPDATE BEFORE UPDATE ON journal
    BEGIN SELECT RAISE(ABORT, 'journal_append_only'); END
    """,
    """
    CREATE TRIGGER journal_append_only_on_DELETE BEFORE DELETE ON journal
    WHEN OLD.revision > (SELECT journal_removed FROM counters)
    BEGIN SELECT RAISE(ABORT, 'journal_append_only'); END
    """,
)

POSTGRESQL = (
    "ALTER INDEX journal_of_4_pkey RENAME TO journal_pkey",
    """
    CREATE OR REPLACE FUNCTION journal_in_order() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN
        IF EXISTS (
            SELECT 1 FROM (SELECT revision, place FROM journal ORDER BY revision DESC, place DESC LIMIT 1) AS newest
            WHERE (NEW.revision, NEW.place) <= (newest.revision, newest.place)
        ) THEN
            RAISE EXCEPTION 'journal_in_order' USING ERRCODE = 'integrity_constraint_violation';
        END IF;
        RETURN NEW;
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

OPEN = "state IN ('accepted', 'activated', 'nonconforming', 'contingent')"
# Whom a flight of higher priority may move, unless they have been activated.
MOVABLE = "state = 'accepted'"


def upgrade() -> None:
    # No open flight has a lower priority: whose is this low displaces nobody.
    op.add_column("counters", sa.Column("lowest_priority", sa.BigInteger, nullable=False, server_default="0"))
    # Whether the trajectory is the operator's own.
    op.add_column("flight_intents", sa.Column("submitted", sa.Boolean, nullable=False, server_default=sa.false()))
    op.create_index(
        "flight_intents_movable",
        "flight_intents",
        ["priority", "departure"],
        sqlite_where=sa.text(MOVABLE),
        postgresql_where=sa.text(MOVABLE),
    )
    # How many flights an operator has that are not over, however many it has had.
    op.create_index(
        "flight_intents_open_by_operator",
        "flight_intents",
        ["operator"],
        sqlite_where=sa.text(OPEN),
        postgresql_where=sa.text(OPEN),
    )
    op.create_table(
        "journal_of_4",
        sa.Column("revision", NUMBER, primary_key=True, autoincrement=False),
        # Among the entries of one revision.
        sa.Column("place", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("time", sa.BigInteger, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("intent", sa.BigInteger, nullable=False),
        sa.Column("flight_intent_id", sa.Text, nullable=False),
        sa.Column("released", sa.Text),
        sa.Column("track_id", sa.Text),
        sa.Column("reasons", sa.Text),
        sa.Column("details", sa.Text),
        sqlite_with_rowid=False,
    )
    op.execute(COPY)
    op.drop_table("journal")
    op.rename_table("journal_of_4", "journal")
    op.create_index("journal_by_intent", "journal", ["intent", "revision"])
    for statement in POSTGRESQL if op.get_bind().dialect.name == "postgresql" else SQLITE:
        op.execute(statement)
    op.create_table(
        "constraints",
        sa.Column("number", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("name", sa.Text, nullable=False),
        # GeoJSON, and the blocks that it closes as a JSON list of flat indices.
        sa.Column("polygon", sa.Text, nullable=False),
        sa.Column("blocks", sa.Text, nullable=False),
        sa.Column("base_m", sa.Double, nullable=False),
        sa.Column("top_m", sa.Double),
        sa.Column("begins", sa.BigInteger, nullable=False),
        sa.Column("ends", sa.BigInteger),
        sa.Column("created", sa.BigInteger, nullable=False),
        sa.Column("removed", sa.BigInteger),
        sa.CheckConstraint("ends IS NULL OR begins < ends", name="constraints_not_empty"),
        sa.UniqueConstraint("id", name="constraints_id"),
    )
