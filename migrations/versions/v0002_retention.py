"""Retention: what has passed may be removed. The journal stands by itself, and its oldest entries may go."""

import sqlalchemy as sa
from alembic import op

revision = "0002"
down_revision = "0001"

# 64 bits on every database; on SQLite the row's own number.
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

COPY = """
INSERT INTO journal_of_2 (revision, time, kind, intent, flight_intent_id, released)
SELECT revision, time, kind, intent, id, released
FROM journal JOIN flight_intents ON flight_intents.sequence = journal.intent
ORDER BY revision
"""

SQLITE = (
    # Also against INSERT OR REPLACE, which fires no DELETE trigger.
    """
    CREATE TRIGGER journal_in_order BEFORE INSERT ON journal
    WHEN NEW.revision <= (SELECT MAX(revision) FROM journal)
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
    "ALTER INDEX journal_of_2_pkey RENAME TO journal_pkey",
    """
    CREATE OR REPLACE FUNCTION journal_append_only() RETURNS trigger LANGUAGE plpgsql AS $$
    BEGIN
        IF TG_OP = 'DELETE' AND OLD.revision <= (SELECT journal_removed FROM counters) THEN
            RETURN OLD;
        END IF;
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
    # Flights that ended before this time (ms) may have been removed; journal entries up to this revision are.
    for column in ("removed_before", "journal_removed"):
        op.add_column("counters", sa.Column(column, sa.BigInteger, nullable=False, server_default="0"))
    op.create_index(
        "flight_intents_by_end", "flight_intents", [sa.text("coalesce(arrival, latest_departure)"), "sequence"]
    )
    op.create_index("idempotency_keys_by_intent", "idempotency_keys", ["intent"])
    # Without a foreign key: an entry may outlive its intent.
    op.create_table(
        "journal_of_2",
        sa.Column("revision", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("time", sa.BigInteger, nullable=False),
        sa.Column("kind", sa.Text, nullable=False),
        sa.Column("intent", sa.BigInteger, nullable=False),
        sa.Column("flight_intent_id", sa.Text, nullable=False),
        sa.Column("released", sa.Text),
    )
    op.execute(COPY)
    op.drop_table("journal")
    op.rename_table("journal_of_2", "journal")
    for statement in POSTGRESQL if op.get_bind().dialect.name == "postgresql" else SQLITE:
        op.execute(statement)
