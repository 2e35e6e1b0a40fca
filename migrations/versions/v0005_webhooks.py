"""Webhooks: who subscribes to what, which events wait to be delivered, and which process delivers."""

import sqlalchemy as sa
from alembic import op

revision = "0005"
down_revision = "0004"

# 64 bits on every database; on SQLite the row's own number.
NUMBER = sa.BigInteger().with_variant(sa.Integer(), "sqlite")

# The first that waits of each flight intent; those behind it have no time for a try yet.
FIRST = "next_try IS NOT NULL"


def upgrade() -> None:
    op.create_table(
        "webhooks",
        sa.Column("number", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("id", sa.Text, nullable=False),
        sa.Column("operator", sa.Text, nullable=False),
        sa.Column("url", sa.Text, nullable=False),
        sa.Column("secret", sa.Text, nullable=False),
        # A JSON list.
        sa.Column("kinds", sa.Text, nullable=False),
        sa.Column("created", sa.BigInteger, nullable=False),
        # Up to this revision the journal has been read; up to the other it was removed before that.
        sa.Column("read_through", sa.BigInteger, nullable=False),
        sa.Column("missed_through", sa.BigInteger),
        sa.Column("given_up", sa.BigInteger, nullable=False, server_default="0"),
        sa.Column("last_delivery", sa.BigInteger),
        sa.Column("last_error", sa.Text),
        sa.Column("failing_since", sa.BigInteger),
        sa.UniqueConstraint("id", name="webhooks_id"),
    )
    op.create_table(
        "webhook_events",
        sa.Column("webhook", NUMBER, primary_key=True, autoincrement=False),
        sa.Column("intent", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("revision", sa.BigInteger, primary_key=True, autoincrement=False),
        sa.Column("place", sa.Integer, primary_key=True, autoincrement=False),
        sa.Column("attempts", sa.Integer, nullable=False, server_default="0"),
        sa.Column("next_try", sa.BigInteger),
        sa.Column("last_error", sa.Text),
        sqlite_with_rowid=False,
    )
    op.create_index(
        "webhook_events_first",
        "webhook_events",
        ["webhook", "next_try"],
        sqlite_where=sa.text(FIRST),
        postgresql_where=sa.text(FIRST),
    )
    desk = op.create_table(
        "webhook_desk",
        sa.Column("only", sa.Integer, primary_key=True, autoincrement=False),
        # The number that was given last: numbers of removed webhooks are not given again.
        sa.Column("newest", sa.BigInteger, nullable=False),
        # Who delivers, and until when nobody else may.
        sa.Column("holder", sa.Text, nullable=False),
        sa.Column("until", sa.BigInteger, nullable=False),
        sa.CheckConstraint('"only" = 1', name="webhook_desk_only_one"),
    )
    op.bulk_insert(desk, [{"only": 1, "newest": 0, "holder": "", "until": 0}])
