"""Where a ledger is: a SQLite file or a PostgreSQL database."""

from dataclasses import dataclass
from pathlib import Path

from sqlalchemy import URL, make_url
from sqlalchemy.exc import ArgumentError

from app.errors import StartupError

_POSTGRESQL = ("postgresql", "postgres")
_FORMS = "give a file path, a sqlite:/// URL or a postgresql:// URL"


@dataclass(frozen=True)
class Location:
    """A place that a ledger can be; as text it shows no password."""

    url: URL

    @property
    def is_sqlite(self) -> bool:
        """Whether the ledger is a SQLite file."""
        return self.url.get_backend_name() == "sqlite"

    @property
    def path(self) -> Path:
        """The file of a SQLite ledger."""
        assert self.is_sqlite
        return Path(self.url.database or "")

    def __str__(self) -> str:
        if self.is_sqlite:
            return str(self.path)
        url = self.url.set(drivername="postgresql")
        # libpq takes one there, too.
        hidden = {"password": "***"} if "password" in url.query else {}
        return url.update_query_dict(hidden).render_as_string()


def parse_location(text: str) -> Location:
    """Return the place that a path, a ``sqlite:///`` or a ``postgresql://`` URL names; `StartupError` for any other."""
    if text.startswith("sqlite:///"):
        return Location(URL.create("sqlite", database=text.removeprefix("sqlite:///")))
    if "://" not in text:
        return Location(URL.create("sqlite", database=text))
    scheme = text.split("://")[0]
    if scheme not in _POSTGRESQL:
        raise StartupError(f"ledgers on {scheme} are not supported; {_FORMS}")
    try:
        url = make_url(text)
    except (ArgumentError, ValueError) as error:
        raise StartupError(f"the ledger's {scheme}:// URL cannot be read; {_FORMS}") from error
    location = Location(url.set(drivername="postgresql+psycopg"))
    if not url.database:
        raise StartupError(f"the ledger's URL {location} names no database; add /NAME to it")
    return location
