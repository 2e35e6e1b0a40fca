"""What the service refuses, as two trees.

RequestError                 answered as a problem; `app.problems` maps every one
├── UnknownAircraftType      no profile of that id
├── DepartureInThePast       the whole departure window has passed
├── BeyondHorizon            departure later than plans are made
├── UnknownFlightIntent      no intent of that id
├── ItemRefused              an item of a batch, for which the whole batch is refused
│   └── ItemNotAllowed       for its sender may not ask for it
├── BatchNotPlanned          a batch for which there was not enough time
├── UnknownBlock             no block of those indices
├── UnknownConstraint        no constraint of that id
├── TooManyConstraints       as many constraints are in force, or to come, as there may be
├── UnknownWebhook           no webhook of that id
├── WebhookRefused           deliveries do not go to this address
├── TooManyWebhooks          the operator has as many as it may
├── IllegalTransition        the intent's state does not allow it
├── NotChangeable            something that this change cannot change
├── PreconditionRequired     a change without the version that it is about
├── PreconditionFailed       the intent has changed since
├── IdempotencyKeyReused     the key came with another body before
├── PositionRefused          a position of a telemetry report
│   ├── UnknownFlight        of no flight intent that there is
│   ├── PositionInTheFuture  taken later than now
│   ├── PositionTooOld       taken longer ago than positions are kept
│   ├── PositionOutOfOrder   not newer than what is known
│   ├── PositionNotFinite    not a number, or infinite
│   ├── PositionRemote       nowhere near the airspace
│   ├── PositionNotAllowed   of a flight or a track, and the token's scopes are not for those
│   └── InvalidPosition      not a position
├── TooManyPositions         more positions than a report may have
├── InvalidCursor            not a cursor of this list
├── BodyTooLarge             more bytes than allowed
├── MalformedRequest         not JSON, or not HTTP as it should be
├── HeadTooLarge             a longer head, or more headers, than allowed
├── RequestTimedOut          a request whose bytes do not come
├── TooManyConnections       more connections are open than allowed
├── TooManyStreams           more streams are open than allowed
├── Unauthenticated          no token, or none that holds
├── InsufficientScope        a token without the scope that this needs
├── OperatorMismatch         another operator's name than the token's
├── PriorityNotAllowed       a higher priority than the token allows
├── TooManyRequests          more requests a second than an operator may make
├── TooManyOpenIntents       more flights that are not over than an operator may have
├── HostNotAllowed           a Host header that is not loopback, while there is no authentication
├── CrossSiteRequest         another site's page asks for a change, while there is no authentication
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

from collections.abc import Sequence


class RequestError(Exception):
    """A request that is refused for a reason its sender can act on."""


class UnknownAircraftType(RequestError):
    """No aircraft profile has this id."""


class DepartureInThePast(RequestError):
    """The latest departure has passed."""


class BeyondHorizon(RequestError):
    """The departure lies further ahead than plans are made."""


class UnknownFlightIntent(RequestError):
    """No flight intent has this id."""


class ItemRefused(RequestError):
    """The item of a batch at `index` is refused for a `cause`, and with it the whole batch."""

    def __init__(self, index: int, cause: Exception) -> None:
        super().__init__(f"flight_intents[{index}]: {cause}")
        self.index = index
        self.cause = cause


class ItemNotAllowed(ItemRefused):
    """The sender of a batch may not ask for one of its items."""


class BatchNotPlanned(RequestError):
    """There was not enough time to plan the batch; nothing was recorded."""


class UnknownBlock(RequestError):
    """The airspace has no such block."""


class UnknownConstraint(RequestError):
    """No constraint has this id."""


class TooManyConstraints(RequestError):
    """As many constraints are in force, or to come, as there may be."""


class UnknownWebhook(RequestError):
    """No webhook has this id."""


class WebhookRefused(RequestError):
    """Deliveries do not go to this address."""


class TooManyWebhooks(RequestError):
    """The operator has as many webhooks as it may have."""


class IllegalTransition(RequestError):
    """The flight intent's state does not allow this."""


class NotChangeable(RequestError):
    """Something that cannot be changed in this intent, or not any more."""


class PreconditionRequired(RequestError):
    """A change has to say which version it is about."""


class PreconditionFailed(RequestError):
    """The intent has another version by now."""


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


class PositionNotAllowed(PositionRefused):
    """The token is for flights and the position of a track, or the other way round."""


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


class UnsupportedMediaType(RequestError):
    """The body does not say that it is JSON."""


class HeadTooLarge(RequestError):
    """The request's head is longer, or has more headers, than allowed."""


class RequestTimedOut(RequestError):
    """The request did not arrive in time; its connection is closed."""


class TooManyConnections(RequestError):
    """This process has as many connections as it may; this one is closed."""


class TooManyStreams(RequestError):
    """This process has as many open streams as it may."""


class Unauthenticated(RequestError):
    """There is no token, or it `is_invalid`."""

    def __init__(self, reason: str, *, is_invalid: bool = False) -> None:
        super().__init__(reason)
        self.is_invalid = is_invalid


class InsufficientScope(RequestError):
    """The token has none of the scopes that are `needed`."""

    def __init__(self, reason: str, needed: Sequence[str] = ()) -> None:
        super().__init__(reason)
        self.needed = needed


class OperatorMismatch(RequestError):
    """The request names another operator than the token, which may not speak for that one."""


class PriorityNotAllowed(RequestError):
    """The token does not allow so high a priority."""


class TooManyRequests(RequestError):
    """The operator has to wait."""

    def __init__(self, reason: str, retry_after_s: int = 1) -> None:
        super().__init__(reason)
        self.retry_after_s = retry_after_s


class TooManyOpenIntents(RequestError):
    """The operator has as many flight intents as it may have that are not over."""


class HostNotAllowed(RequestError):
    """Without authentication only loopback Host headers are answered."""


class CrossSiteRequest(RequestError):
    """A browser asks for a change on behalf of another site's page."""


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
