"""Opaque cursors of lists that are ordered by a number."""

import base64
import binascii

from app.errors import InvalidCursor

LIMIT = 500


def encode(number: int) -> str:
    """Return the cursor behind a number."""
    return base64.urlsafe_b64encode(f"after:{number}".encode()).decode().rstrip("=")


def decode(cursor: str | None) -> int:
    """Return the number behind a cursor, 0 for none; raises `InvalidCursor`."""
    if cursor is None:
        return 0
    try:
        text = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4)).decode("ascii")
        prefix, _, number = text.partition(":")
        if prefix == "after" and number.isdecimal() and len(number) < 19:
            return int(number)
    except (binascii.Error, ValueError):
        pass
    raise InvalidCursor("the cursor does not come from this list; pass `next_cursor` as it came")
