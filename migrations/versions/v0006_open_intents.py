"""The limit of open intents counts flights that are over for their operators too, while they hold something."""

import sqlalchemy as sa
from alembic import op

revision = "0006"
down_revision = "0005"

OVER = "state IN ('cancelled', 'ended')"


def upgrade() -> None:
    # Few of the flights that are over should be in the air now, however many an operator has had.
    op.create_index(
        "flight_intents_over_by_operator",
        "flight_intents",
        ["operator", "arrival", "departure"],
        sqlite_where=sa.text(OVER),
        postgresql_where=sa.text(OVER),
    )
