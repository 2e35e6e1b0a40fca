"""Webhooks in the ledger: what is read from the journal waits in order, and one process at a time delivers."""

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from typing import Any, TypeVar

import pytest

from app.ledger import Ledger, create_or_upgrade, open_ledger
from app.ledger.webhooks import Line, Waiting, Webhook, WebhookRows
from tests.ledger.district import STREET
from tests.ledger.locations import Ledgers, database
from tests.ledger.test_migrations import migrated_to

T = TypeVar("T")

NOW = 1_000_000
ACME = Webhook("one", "acme-air", "https://acme.example/", "secret", ("intent",), NOW, read_through=0)
ENTRY = "INSERT INTO journal (revision, place, time, kind, intent, flight_intent_id) VALUES (?, ?, ?, ?, ?, '')"


@pytest.fixture
def opened(ledger: str) -> Iterator[Ledger]:
    with closing(open_ledger(ledger, STREET.airspace, claim=True)) as opened:
        yield opened


def write(ledger: Ledger, work: Callable[[WebhookRows], T]) -> T:
    with ledger.transaction() as transaction, transaction.webhooks() as rows:
        return work(rows)


def read(ledger: Ledger, work: Callable[[WebhookRows], T]) -> T:
    with ledger.webhooks() as rows:
        return work(rows)


def add(ledger: Ledger, webhook: Webhook = ACME) -> Webhook:
    return write(ledger, lambda rows: rows.add(webhook))


def take(ledger: Ledger, webhook: Webhook, *events: tuple[int, int, int], through: int) -> None:
    """Let events wait that are given by revision, place and flight intent."""
    lines = [Line(revision, place, "accepted", sequence, "acme-air") for revision, place, sequence in events]
    write(ledger, lambda rows: rows.take(webhook, lines, through, NOW))


def due(ledger: Ledger, webhook: Webhook, now: int = NOW) -> list[tuple[int, int, int]]:
    """Return what is due by revision, place and flight intent."""
    events = read(ledger, lambda rows: rows.due(webhook.number, now, 10))
    return sorted((event.revision, event.place, event.sequence) for event in events)


def test_a_webhook_reads_as_it_was_written_and_no_number_comes_again(opened: Ledger) -> None:
    first, second = add(opened), add(opened, replace(ACME, id="two", operator="zeta"))
    assert read(opened, lambda rows: rows.find("one")) == first
    assert read(opened, lambda rows: rows.page()) == [first, second]
    assert read(opened, lambda rows: rows.page(operator="zeta")) == [second]
    assert read(opened, lambda rows: rows.page(after=first.number, limit=1)) == [second]
    take(opened, second, (1, 0, 7), through=1)
    write(opened, lambda rows: rows.remove(second))
    assert read(opened, lambda rows: rows.due_webhooks(NOW)) == []
    assert read(opened, lambda rows: rows.find("two")) is None
    assert add(opened, replace(ACME, id="three")).number == 3


def test_only_the_first_event_of_a_flight_intent_is_due(opened: Ledger) -> None:
    webhook = add(opened)
    take(opened, webhook, (1, 0, 7), (1, 1, 8), (2, 0, 7), through=2)
    take(opened, webhook, (3, 0, 8), through=3)
    # What was read is not taken again.
    take(opened, webhook, (3, 0, 8), through=3)
    assert read(opened, lambda rows: rows.waiting([webhook.number])) == {webhook.number: 4}
    assert due(opened, webhook) == [(1, 0, 7), (1, 1, 8)]
    write(opened, lambda rows: rows.delivered(Waiting(webhook.number, 7, 1, 0, 0), NOW))
    assert due(opened, webhook) == [(1, 1, 8), (2, 0, 7)]
    write(opened, lambda rows: rows.given_up(Waiting(webhook.number, 8, 1, 1, 0), "answered 500", NOW))
    assert due(opened, webhook) == [(2, 0, 7), (3, 0, 8)]
    found = read(opened, lambda rows: rows.find("one"))
    assert found is not None
    assert (found.given_up, found.last_error, found.last_delivery_ms) == (1, "answered 500", NOW)


def test_what_failed_is_due_at_its_time_and_the_webhook_fails_until_then(opened: Ledger) -> None:
    webhook = add(opened)
    take(opened, webhook, (1, 0, 7), (2, 0, 8), through=2)
    first, other = Waiting(webhook.number, 7, 1, 0, 0), Waiting(webhook.number, 8, 2, 0, 0)
    assert write(opened, lambda rows: rows.failed(first, "answered 404", NOW, NOW))
    assert not write(opened, lambda rows: rows.failed(first, "answered 500", NOW + 1_000, NOW + 1))
    assert due(opened, webhook, NOW + 999) == [(2, 0, 8)]
    assert not write(opened, lambda rows: rows.delivered(other, NOW + 1))
    (found,) = read(opened, lambda rows: rows.page())
    assert (found.failing_since_ms, found.last_error) == (NOW, "answered 500")
    (again,) = read(opened, lambda rows: rows.due(webhook.number, NOW + 1_000, 10))
    assert again.attempts == 1
    assert write(opened, lambda rows: rows.delivered(again, NOW + 1_000))
    (found,) = read(opened, lambda rows: rows.page())
    assert (found.failing_since_ms, found.last_delivery_ms) == (None, NOW + 1_000)


@pytest.mark.parametrize(
    ("holder", "over", "held"),
    [
        ("a", None, True),
        ("b", None, False),
        ("b", ("a", NOW - 1), False),
        ("b", ("c", NOW), False),
        ("b", ("a", NOW), True),
    ],
    ids=["kept", "taken", "renewed since", "taken since", "run out"],
)
def test_one_holder_has_the_desk_until_its_lease_is_over(
    opened: Ledger, holder: str, over: tuple[str, int] | None, held: bool
) -> None:
    assert write(opened, lambda rows: rows.hold_desk("a", NOW))
    assert write(opened, lambda rows: rows.hold_desk(holder, NOW + 1, over)) is held
    desk = read(opened, lambda rows: rows.desk())
    assert desk.lease == ((holder, NOW + 1) if held else ("a", NOW))


def test_a_desk_that_was_left_is_free(opened: Ledger) -> None:
    write(opened, lambda rows: rows.hold_desk("a", NOW))
    write(opened, lambda rows: rows.leave_desk("b"))
    assert not write(opened, lambda rows: rows.hold_desk("b", NOW))
    write(opened, lambda rows: rows.leave_desk("a"))
    assert write(opened, lambda rows: rows.hold_desk("b", NOW))


def test_the_journal_is_read_in_whole_revisions(opened: Ledger, ledger: str) -> None:
    entries: list[tuple[Any, ...]] = [(1, 0, NOW, "accepted", 7), (2, 0, NOW, "accepted", 8), (2, 1, NOW, "lost", 7)]
    with database(ledger) as connection:
        for entry in entries:
            connection.execute(ENTRY, entry)
    assert [(line.revision, line.place) for line in read(opened, lambda rows: rows.lines(0, 1))] == [(1, 0)]
    both = read(opened, lambda rows: rows.lines(1, 1))
    assert both == [Line(2, 0, "accepted", 8, None), Line(2, 1, "lost", 7, None)]
    found = read(opened, lambda rows: rows.event(Waiting(1, 7, 2, 1, 0)))
    assert found is not None
    assert (found[0].kind, found[1]) == ("lost", None)
    assert read(opened, lambda rows: rows.event(Waiting(1, 7, 1, 1, 0))) is None


def test_what_was_removed_from_the_journal_is_missed(opened: Ledger) -> None:
    webhook = add(opened)
    write(opened, lambda rows: rows.miss([webhook.number], 5))
    take(opened, webhook, (6, 0, 7), (9, 0, 8), through=9)
    write(opened, lambda rows: rows.lost(Waiting(webhook.number, 7, 6, 0, 0), NOW))
    (found,) = read(opened, lambda rows: rows.page())
    assert (found.read_through, found.missed_through) == (9, 6)
    write(opened, lambda rows: rows.miss([webhook.number], 8))
    write(opened, lambda rows: rows.read_on({webhook.number: 7}))
    assert read(opened, lambda rows: rows.page()) == [found]


def test_a_ledger_of_the_fourth_version_has_no_webhooks(ledgers: Ledgers) -> None:
    location = migrated_to("0004", ledgers.vacant())
    create_or_upgrade(location)
    with database(location) as connection:
        assert connection.rows("SELECT * FROM webhooks") == []
        assert connection.rows("SELECT newest, holder, until FROM webhook_desk") == [(0, "", 0)]
