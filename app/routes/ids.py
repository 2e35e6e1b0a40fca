"""Ids in paths."""

from uuid import UUID

from app.errors import RequestError


def existing(text: str, unknown: type[RequestError], what: str) -> str:
    """Return an id as it came; what is no UUID is the id of nothing, and no database's business.

    Raises
    ------
    RequestError
        It is no UUID: the kind that `unknown` names.
    """
    try:
        UUID(text)
    except ValueError:
        raise unknown(f"there is no {what} {text}") from None
    return text
