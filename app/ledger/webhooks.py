"""Webhooks in the ledger: subscriptions, the events that wait to be delivered, and the lease of who delivers."""

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy import (
    BigInteger,
    Column,
    ColumnElement,
    Connection,
    Integer,
    Row,
    Table,
    Text,
    and_,
    delete,
    false,
    func,
    insert,
    or_,
    select,
    update,
)

from app.ledger import queries
from app.ledger.queries import JournalEntry
from app.ledger.tables import counters, flight_intents, journal, metadata

webhooks = Table(
    "webhooks",
    metadata,
    Column("number", BigInteger, primary_key=True),
    Column("id", Text),
    Column("operator", Text),
    Column("url", Text),
    Column("secret", Text),
    Column("kinds", Text),
    Column("created", BigInteger),
    Column("read_through", BigInteger),
    Column("missed_through", BigInteger),
    Column("given_up", BigInteger),
    Column("last_delivery", BigInteger),
    Column("last_error", Text),
    Column("failing_since", BigInteger),
)

# `next_try` is null while an earlier event of the same flight intent waits.
webhook_events = Table(
    "webhook_events",
    metadata,
    Column("webhook", BigInteger, primary_key=True),
    Column("intent", BigInteger, primary_key=True),
    Column("revision", BigInteger, primary_key=True),
    Column("place", Integer, primary_key=True),
    Column("attempts", Integer),
    Column("next_try", BigInteger),
    Column("last_error", Text),
)

webhook_desk = Table(
    "webhook_desk",
    metadata,
    Column("only", Integer, primary_key=True),
    Column("newest", BigInteger),
    Column("holder", Text),
    Column("until", BigInteger),
)


@dataclass(frozen=True)
class Webhook:
    """A subscription: where events of these kinds of an operator's flight intents go, and how that goes.

    Events up to the revision `read_through` have been delivered, given up, or wait; those up to `missed_through` may
    have been removed before they could be read. `failing_since_ms` is None where no delivery has to be repeated.
    """

    id: str
    operator: str
    url: str
    secret: str
    kinds: tuple[str, ...]
    created_ms: int
    read_through: int
    number: int = 0
    missed_through: int | None = None
    given_up: int = 0
    last_delivery_ms: int | None = None
    last_error: str | None = None
    failing_since_ms: int | None = None


@dataclass(frozen=True)
class Line:
    """What a journal entry is about: its kind, the flight intent, and whose that is, where it is known."""

    revision: int
    place: int
    kind: str
    sequence: int
    operator: str | None


@dataclass(frozen=True)
class Waiting:
    """An event that waits to be delivered to a webhook, and how often that was tried."""

    webhook: int
    sequence: int
    revision: int
    place: int
    attempts: int


Lease = tuple[str, int]


@dataclass(frozen=True)
class Desk:
    """Which process delivers and until when by its own clock (ms; 0: it does no more), the journal's newest revision
    and up to which it was removed.
    """

    holder: str
    until_ms: int
    revision: int
    removed_through: int

    @property
    def lease(self) -> "Lease":
        """Who has it until when."""
        return self.holder, self.until_ms


class WebhookRows:
    """The rows of webhooks, read and written by way of one connection. What is written needs the write lock."""

    def __init__(self, connection: Connection) -> None:
        self._connection = connection

    def page(self, *, operator: str | None = None, after: int = 0, limit: int | None = None) -> list[Webhook]:
        """Return the webhooks of one operator or of all, by number."""
        query = select(webhooks).where(webhooks.c.number > after).order_by(webhooks.c.number).limit(limit)
        if operator is not None:
            query = query.where(webhooks.c.operator == operator)
        return [_webhook(row) for row in self._connection.execute(query)]

    def find(self, webhook_id: str) -> Webhook | None:
        """Return a webhook, None if there is none."""
        row = self._connection.execute(select(webhooks).where(webhooks.c.id == webhook_id)).one_or_none()
        return None if row is None else _webhook(row)

    def count(self, operator: str) -> int:
        """Return how many webhooks an operator has."""
        query = select(func.count()).select_from(webhooks).where(webhooks.c.operator == operator)
        return int(self._connection.execute(query).scalar_one())

    def add(self, webhook: Webhook) -> Webhook:
        """Write a webhook under the next number, and return it with that."""
        self._connection.execute(update(webhook_desk).values(newest=webhook_desk.c.newest + 1))
        number = self._connection.execute(select(webhook_desk.c.newest)).scalar_one()
        row = {
            "number": number,
            "id": webhook.id,
            "operator": webhook.operator,
            "url": webhook.url,
            "secret": webhook.secret,
            "kinds": json.dumps(webhook.kinds),
            "created": webhook.created_ms,
            "read_through": webhook.read_through,
        }
        self._connection.execute(insert(webhooks).values(row))
        return replace(webhook, number=number)

    def remove(self, webhook: Webhook) -> None:
        """Remove a webhook, and what waits for it."""
        self._connection.execute(delete(webhook_events).where(webhook_events.c.webhook == webhook.number))
        self._connection.execute(delete(webhooks).where(webhooks.c.number == webhook.number))

    def desk(self) -> Desk:
        """Return who delivers, and how far the journal goes."""
        row = self._connection.execute(
            select(webhook_desk.c.holder, webhook_desk.c.until, counters.c.revision, counters.c.journal_removed).where(
                webhook_desk.c.only == counters.c.only
            )
        ).one()
        return Desk(row.holder, row.until, row.revision, row.journal_removed)

    def hold_desk(self, holder: str, until_ms: int, over: Lease | None = None) -> bool:
        """Take the desk or keep it, and tell whether that was possible: it is the holder's, or was left, or nobody has
        renewed a lease that is `over`.
        """
        desk = webhook_desk.c
        is_over = false() if over is None else and_(desk.holder == over[0], desk.until == over[1])
        is_free = or_(desk.holder == holder, desk.until == 0, is_over)
        taken = update(webhook_desk).where(is_free).values(holder=holder, until=until_ms)
        return self._connection.execute(taken).rowcount == 1

    def leave_desk(self, holder: str) -> None:
        """Let another process deliver from now on."""
        self._connection.execute(update(webhook_desk).where(webhook_desk.c.holder == holder).values(until=0))

    def lines(self, after: int, limit: int) -> list[Line]:
        """Return what the journal has after a revision, oldest first: up to `limit` entries and, of the last revision,
        all.
        """
        entry = journal.c
        # An outer join: nobody but the journal may lead the search, however many flights there are.
        lines = (
            select(entry.revision, entry.place, entry.kind, entry.intent, flight_intents.c.operator)
            .outerjoin(flight_intents, flight_intents.c.sequence == entry.intent)
            .order_by(entry.revision, entry.place)
        )
        rows = list(self._connection.execute(lines.where(entry.revision > after).limit(limit)))
        if len(rows) == limit:
            last = rows[-1]
            rows += self._connection.execute(lines.where(entry.revision == last.revision, entry.place > last.place))
        return [Line(*row) for row in rows]

    def take(self, webhook: Webhook, lines: Sequence[Line], through: int, now_ms: int) -> None:
        """Let events of the journal wait for delivery, which is read through a revision with that; a second time this
        does nothing.
        """
        own = webhooks.c
        moved = update(webhooks).where(own.number == webhook.number, own.read_through < through)
        if not self._connection.execute(moved.values(read_through=through)).rowcount:
            return
        event = webhook_events.c
        query = select(event.intent).where(
            event.webhook == webhook.number, event.intent.in_({line.sequence for line in lines})
        )
        behind = set(self._connection.execute(query.distinct()).scalars())
        rows = []
        for line in lines:
            rows.append(
                {
                    "webhook": webhook.number,
                    "intent": line.sequence,
                    "revision": line.revision,
                    "place": line.place,
                    "attempts": 0,
                    "next_try": None if line.sequence in behind else now_ms,
                }
            )
            behind.add(line.sequence)
        if rows:
            self._connection.execute(insert(webhook_events), rows)

    def read_on(self, reached: Mapping[int, int]) -> None:
        """Take down through which revisions the journal was read for some webhooks, and had nothing for them."""
        for number, through in reached.items():
            own = webhooks.c
            moved = update(webhooks).where(own.number == number, own.read_through < through)
            self._connection.execute(moved.values(read_through=through))

    def miss(self, numbers: Iterable[int], through: int) -> None:
        """Take down that the journal was removed through a revision before it was read for some webhooks."""
        moved = update(webhooks).where(webhooks.c.number.in_(list(numbers)), webhooks.c.read_through < through)
        self._connection.execute(moved.values(read_through=through, missed_through=through))

    def waiting(self, numbers: Iterable[int]) -> dict[int, int]:
        """Return how many events wait for some webhooks, those without any left out."""
        event = webhook_events.c
        query = (
            select(event.webhook, func.count().label("waiting"))
            .where(event.webhook.in_(list(numbers)))
            .group_by(event.webhook)
        )
        return {row.webhook: row.waiting for row in self._connection.execute(query)}

    def due_webhooks(self, now_ms: int) -> list[int]:
        """Return the numbers of the webhooks to which something is to be delivered by now."""
        query = select(webhook_events.c.webhook).where(webhook_events.c.next_try <= now_ms).distinct()
        return sorted(self._connection.execute(query).scalars())

    def due(self, number: int, now_ms: int, limit: int) -> list[Waiting]:
        """Return up to `limit` events that are to be delivered to a webhook by now, no two of one flight intent."""
        event = webhook_events.c
        query = select(event.webhook, event.intent, event.revision, event.place, event.attempts)
        query = query.where(event.webhook == number, event.next_try <= now_ms)
        return [Waiting(*row) for row in self._connection.execute(query.order_by(event.next_try).limit(limit))]

    def event(self, waiting: Waiting) -> tuple[JournalEntry, str | None] | None:
        """Return the journal's entry of an event and the operator's reference; None where retention has removed it."""
        entries = queries.journal_after(self._connection, waiting.revision - 1, 1)
        here = (waiting.revision, waiting.place)
        entry = next((entry for entry in entries if (entry.revision, entry.place) == here), None)
        if entry is None:
            return None
        reference = select(flight_intents.c.reference).where(flight_intents.c.sequence == waiting.sequence)
        return entry, self._connection.execute(reference).scalar_one_or_none()

    def delivered(self, waiting: Waiting, now_ms: int) -> bool:
        """Take down that an event was delivered: the next of its flight intent is due.

        Tells whether the webhook was failing and is not any more.
        """
        self._finish(waiting, now_ms)
        own = webhooks.c.number == waiting.webhook
        self._connection.execute(update(webhooks).where(own).values(last_delivery=now_ms))
        is_over = and_(webhooks.c.failing_since.is_not(None), ~_is_failing(waiting.webhook))
        return bool(self._connection.execute(update(webhooks).where(own, is_over).values(failing_since=None)).rowcount)

    def failed(self, waiting: Waiting, error: str, next_try_ms: int, now_ms: int) -> bool:
        """Take down that an event could not be delivered, and when that is to be tried again.

        Tells whether the webhook was not failing before.
        """
        tried = update(webhook_events).where(_is(waiting))
        self._connection.execute(tried.values(attempts=waiting.attempts + 1, next_try=next_try_ms, last_error=error))
        own = webhooks.c.number == waiting.webhook
        self._connection.execute(update(webhooks).where(own).values(last_error=error))
        begins = update(webhooks).where(own, webhooks.c.failing_since.is_(None))
        return bool(self._connection.execute(begins.values(failing_since=now_ms)).rowcount)

    def given_up(self, waiting: Waiting, error: str, now_ms: int) -> None:
        """Take down that an event will not be delivered: the next of its flight intent is due."""
        self._finish(waiting, now_ms)
        own = update(webhooks).where(webhooks.c.number == waiting.webhook)
        since = func.coalesce(webhooks.c.failing_since, now_ms)
        given_up = webhooks.c.given_up + 1
        self._connection.execute(own.values(given_up=given_up, last_error=error, failing_since=since))

    def lost(self, waiting: Waiting, now_ms: int) -> None:
        """Take down that an event was removed from the journal while it waited."""
        self._finish(waiting, now_ms)
        own = webhooks.c
        is_later = or_(own.missed_through.is_(None), own.missed_through < waiting.revision)
        later = update(webhooks).where(own.number == waiting.webhook, is_later)
        self._connection.execute(later.values(missed_through=waiting.revision))

    def _finish(self, waiting: Waiting, now_ms: int) -> None:
        self._connection.execute(delete(webhook_events).where(_is(waiting)))
        event = webhook_events.c
        of_intent = and_(event.webhook == waiting.webhook, event.intent == waiting.sequence)
        query = select(event.revision, event.place).where(of_intent).order_by(event.revision, event.place).limit(1)
        following = self._connection.execute(query).one_or_none()
        if following is not None:
            this = and_(of_intent, event.revision == following.revision, event.place == following.place)
            self._connection.execute(
                update(webhook_events).where(this, event.next_try.is_(None)).values(next_try=now_ms)
            )


def _is(waiting: Waiting) -> ColumnElement[bool]:
    event = webhook_events.c
    return and_(
        event.webhook == waiting.webhook,
        event.intent == waiting.sequence,
        event.revision == waiting.revision,
        event.place == waiting.place,
    )


def _is_failing(number: int) -> ColumnElement[bool]:
    """Return the condition that something has to be delivered again; only the first of a flight intent can be that."""
    event = webhook_events.c
    # Bounded below, which every time is, so that databases look among the first only.
    tried = and_(event.webhook == number, event.next_try > 0, event.attempts > 0)
    return select(event.webhook).where(tried).exists()


def _webhook(row: Row[Any]) -> Webhook:
    return Webhook(
        id=row.id,
        operator=row.operator,
        url=row.url,
        secret=row.secret,
        kinds=tuple(json.loads(row.kinds)),
        created_ms=row.created,
        read_through=row.read_through,
        number=row.number,
        missed_through=row.missed_through,
        given_up=row.given_up,
        last_delivery_ms=row.last_delivery,
        last_error=row.last_error,
        failing_since_ms=row.failing_since,
    )
