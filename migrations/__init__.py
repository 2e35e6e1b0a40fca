"""Alembic migrations of the ledger; the guard against double booking lives here too."""
