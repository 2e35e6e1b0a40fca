"""What the service refuses, as two trees.

RequestError                 answered as a problem; `app.problems` maps every one
├── UnknownAircraftType      no profile of that id
├── DepartureInThePast       the whole departure window has passed
├── BeyondHorizon            departure later than plans are made
├── PriorityNotSupported     priorities other than 0
├── UnknownFlightIntent      no intent of that id
├── UnknownBlock             no block of those indices
├── IllegalTransition        the intent's state does not allow it
├── IdempotencyKeyReused     the key came with another body before
├── PositionRefused          a position of a telemetry report
│   ├── UnknownFlight        of no flight intent that there is
│   ├── PositionInTheFuture  taken later than now
│   ├── PositionTooOld       taken longer ago than positions are kept
│   ├── PositionOutOfOrder   not newer than what is known
│   ├── PositionNotFinite    not a number, or infinite
│   ├── PositionRemote       nowhere near the airspace
│   └── InvalidPosition      not a position
├── TooManyPositions         more positions than a report may have
├── InvalidCursor            not a cursor of this list
├── BodyTooLarge             more bytes than allowed
├── MalformedRequest         not JSON, or not HTTP as it should be
├── HostNotAllowed           a Host header that is not loopback, while there is no authentication
├── QueueFull                more requests are waiting than allowed; nothing was taken
├── LedgerUnavailable        the ledger failed; nothing was recorded
├── OutcomeUnknown           the commit was lost, and the ledger cannot be asked what became of it
├── ReadOnlyServer           this process only reads
└── NotReady                 this process cannot serve at present
StartupError                 the service or a command cannot start; the CLI prints it and exits with 2
├── LedgerMissing            no ledger at that place
├── ForeignLedger            a file that is no AirMatrix ledger
├── LedgerOutdated           a ledger of another schema version
├── LedgerDamaged            a row that no version of this program has written
├── AirspaceMismatch         a ledger of another airspace
└── UnsafeListening          listening beyond loopback without authentication
"""


class RequestError(Exception):
    """A request that is refused for a reason its sender can act on."""


class UnknownAircraftType(RequestError):
    """No aircraft profile has this id."""


class DepartureInThePast(RequestError):
    """The latest departure has passed."""


class BeyondHorizon(RequestError):
    """The departure lies further ahead than plans are made."""


class PriorityNotSupported(RequestError):
    """Only priority 0 exists."""


class UnknownFlightIntent(RequestError):
    """No flight intent has this id."""


class UnknownBlock(RequestError):
    """The airspace has no such block."""


class IllegalTransition(RequestError):
    """The flight intent's state does not allow this."""


class IdempotencyKeyReused(RequestError):
    """An Idempotency-Key came again with another body."""


class PositionRefused(RequestError):
    """One position of a report is refused; the others are not."""


class UnknownFlight(PositionRefused):
    """The position names no flight intent that there is."""


class PositionInTheFuture(PositionRefused):
    """The position was taken later than now."""


class PositionTooOld(PositionRefused):
    """The position is older than positions are kept."""


class PositionOutOfOrder(PositionRefused):
    """A newer position of the aircraft is known."""


class PositionNotFinite(PositionRefused):
    """A coordinate is not a number, or infinite."""


class PositionRemote(PositionRefused):
    """The position lies nowhere near the airspace."""


class InvalidPosition(PositionRefused):
    """Not a position."""


class TooManyPositions(RequestError):
    """The report has more positions than it may."""


class InvalidCursor(RequestError):
    """The cursor does not come from this list."""


class BodyTooLarge(RequestError):
    """The body has more bytes than allowed."""


class MalformedRequest(RequestError):
    """The request cannot be parsed."""


class HostNotAllowed(RequestError):
    """Without authentication only loopback Host headers are answered."""


class QueueFull(RequestError):
    """Too many requests are waiting for the writer; nothing was taken."""


class LedgerUnavailable(RequestError):
    """The ledger could not be written or read; nothing was recorded."""


class OutcomeUnknown(RequestError):
    """The connection was lost during COMMIT and the ledger cannot be read: it is not known what was recorded."""


class ReadOnlyServer(RequestError):
    """This process has no writer."""


class NotReady(RequestError):
    """The process cannot serve at present; `waiting` requests wait, `revision` is the ledger's where it is known."""

    def __init__(self, reason: str, waiting: int = 0, revision: int | None = None) -> None:
        super().__init__(reason)
        self.reason = reason
        self.waiting = waiting
        self.revision = revision


class StartupError(Exception):
    """The service or a command cannot start."""


class LedgerMissing(StartupError):
    """There is no ledger at that place."""


class ForeignLedger(StartupError):
    """The file is not an AirMatrix ledger."""


class LedgerOutdated(StartupError):
    """The ledger's schema is of another version."""


class LedgerDamaged(StartupError):
    """A row of the ledger makes no sense."""


class AirspaceMismatch(StartupError):
    """The ledger belongs to another airspace."""


class UnsafeListening(StartupError):
    """Without authentication the service listens on loopback only."""
