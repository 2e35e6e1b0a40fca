"""RFC 3339 at the edge, int64 milliseconds since the Unix epoch inside."""

import re
import time
from datetime import UTC, datetime, timedelta, timezone
from typing import Annotated, Any

import numpy as np
from pydantic import BeforeValidator, PlainSerializer, WithJsonSchema

from planner.airmatrix import IntArray

_RFC3339 = re.compile(
    r"(\d{4})-(\d\d)-(\d\d)[Tt ](\d\d):(\d\d):(\d\d)(?:\.(\d{1,30}))?(?:([Zz])|([+-])(\d\d):(\d\d))?", re.ASCII
)
_EPOCH = datetime(1970, 1, 1, tzinfo=UTC)

# The last millisecond that RFC 3339 can name.
LATEST_MS = 253_402_300_799_999


def now_ms() -> int:
    """Return the system clock."""
    return time.time_ns() // 1_000_000


def monotonic_ms() -> int:
    """Return the time since some moment; it never jumps."""
    return time.monotonic_ns() // 1_000_000


class ServerClock:
    """The time of a service, in ms: the system's clock, or one that is set to a start and runs at a rate from there.

    Its zero is taken once, when it is made. Processes that are handed one clock show one time, for a machine has one
    monotonic clock; a process that is started later too.
    """

    def __init__(self, start_ms: int | None = None, rate: float = 1.0) -> None:
        self.rate = rate
        self.simulated = start_ms is not None or rate != 1
        self._start_ms = now_ms() if start_ms is None else start_ms
        self._zero_ns = time.monotonic_ns()

    def __call__(self) -> int:
        """Return the time."""
        return self.now()

    def now(self) -> int:
        """Return the time."""
        return self._start_ms + self.elapsed_ms() if self.simulated else now_ms()

    def elapsed_ms(self) -> int:
        """Return how much of the service's time has passed since the clock was made; it never jumps."""
        return int((time.monotonic_ns() - self._zero_ns) * self.rate) // 1_000_000


def parse_time(text: Any) -> int:
    """Return an RFC 3339 time with any offset in ms, finer fractions rounded up; `ValueError` says what is wrong."""
    if isinstance(text, int) and not isinstance(text, bool):
        raise ValueError("expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z, not a number")
    match = _RFC3339.fullmatch(text) if isinstance(text, str) else None
    if match is None:
        raise ValueError("expected an RFC 3339 time such as 2026-11-22T08:00:00.000Z")
    *date, fraction, zulu, sign, hours, minutes = match.groups()
    if not zulu and not sign:
        raise ValueError("the time has no offset; end it with Z or an offset such as +05:00")
    if sign and (int(hours) > 23 or int(minutes) > 59):
        raise ValueError("the time's offset must lie within 23:59")
    offset = timedelta(hours=int(hours), minutes=int(minutes)) if sign else timedelta()
    zone = timezone(-offset if sign == "-" else offset)
    try:
        moment = datetime(*(int(part) for part in date), tzinfo=zone)  # type: ignore[arg-type,misc]
    except ValueError as error:
        raise ValueError(f"not a date and time: {error}") from error
    fraction = fraction or ""
    milliseconds = int(fraction[:3].ljust(3, "0")) + bool(fraction[3:].strip("0"))
    time_ms = (moment - _EPOCH) // timedelta(milliseconds=1) + milliseconds
    if not 0 <= time_ms <= LATEST_MS:
        raise ValueError("times must lie between the years 1970 and 9999, in UTC")
    return time_ms


def format_times(times_ms: IntArray) -> list[str]:
    """Return times as RFC 3339 UTC with milliseconds and Z."""
    texts: list[str] = np.datetime_as_string(times_ms.astype("datetime64[ms]"), unit="ms", timezone="UTC").tolist()
    return texts


def format_time(time_ms: int) -> str:
    """Return one time as RFC 3339 UTC with milliseconds and Z."""
    return f"{(_EPOCH + timedelta(milliseconds=time_ms)).isoformat(timespec='milliseconds')[:23]}Z"


_SERIALIZED = PlainSerializer(format_time, return_type=str)
_SCHEMA = WithJsonSchema({"type": "string", "format": "date-time", "examples": ["2026-11-22T08:00:00.000Z"]})

# A time in a request: only RFC 3339 will do.
Timestamp = Annotated[int, BeforeValidator(parse_time), _SERIALIZED, _SCHEMA]

# A time in an answer: made from ms by the service, read from RFC 3339 by clients.
Moment = Annotated[
    int, BeforeValidator(lambda value: value if isinstance(value, int) else parse_time(value)), _SERIALIZED, _SCHEMA
]
