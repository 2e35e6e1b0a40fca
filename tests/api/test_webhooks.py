"""Webhooks: who may subscribe to what, and how events come to their receivers whatever fails on the way."""

import asyncio
import hashlib
import ssl
from collections import Counter
from collections.abc import Awaitable, Callable, Iterator
from contextlib import suppress
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any
from uuid import uuid4

import httpx
import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from structlog.testing import capture_logs

from app import webhook_delivery
from app.errors import LedgerUnavailable, WebhookRefused
from app.ledger import Transaction
from app.main import create_app
from app.routes.webhooks import WebhookPage
from app.settings import Settings
from app.times import format_time
from app.webhook_delivery import Deliverer, DeliveryFailed, Post
from app.webhooks import Destinations, retry_after_ms
from tests.api.bodies import SUBMIT, problem
from tests.api.receiving import Event, Receiver, receiving
from tests.api.serving import Client, served, settings_for
from tests.api.test_constraints import area, close
from tests.api.tokens import as_, issuer, write_keys
from tests.api.watching import activated, look, see, submit
from tests.ledger.district import DEPARTURE_MS, LANES, START_MS
from tests.ledger.locations import Ledgers, SqliteLedgers, write_lock
from tests.ledger.process import FakeClock, until

WEBHOOKS = "/v1/webhooks"
SECRET = "sixteen-characters-or-more"  # noqa: S105
LOCAL, PUBLIC, PRIVATE = Destinations(True, False), Destinations(False, False), Destinations(False, True)
DESK_S, DAY_S = 20, 86_400


@pytest.fixture
def ledgers(tmp_path: Path) -> Ledgers:
    """Keep to one kind of database: `tests/ledger` has what is to be said of both."""
    return SqliteLedgers(tmp_path)


@pytest.fixture
def receiver() -> Iterator[Receiver]:
    with receiving() as receiver:
        yield receiver


@pytest.fixture
def still(lanes: Client) -> Client:
    """Return a client of a service that delivers nothing by itself."""
    assert lanes.service.writing is not None
    lanes.service.writing.deliverer.stop()
    return lanes


def delivering_by(client: Client, post: Post, *, clock: Callable[[], int] | None = None, **options: Any) -> Deliverer:
    """Return what delivers when it is asked to, by the service's clock or one that jumps."""
    service = client.service

    def elapsed_ms() -> int:
        # As that of a machine, it has a zero of its own.
        return service.clock() - START_MS // 2

    return Deliverer(service.ledger, service.writer, clock or service.clock, post, elapsed_ms=elapsed_ms, **options)


def deliverer(client: Client, patience_s: float = 5.0) -> Deliverer:
    """Return what delivers when it is asked to, and takes the longest time between retries."""
    return delivering_by(client, Post(LOCAL, patience_s), observe=client.service.metrics.webhook, chance=lambda: 0.0)


def deliver(*deliverers: Deliverer, ignoring: tuple[type[Exception], ...] = ()) -> None:
    """Deliver until nothing more is due."""

    async def settle(one: Deliverer) -> None:
        with suppress(*ignoring):
            for _ in range(100):
                under_way = await one.look()
                if not under_way:
                    return
                await asyncio.wait(under_way)
            pytest.fail("this never ends")

    async def all_of_them() -> None:
        await asyncio.gather(*map(settle, deliverers))

    asyncio.run(all_of_them())


def subscribe(client: Client, url: str, *kinds: str, **members: Any) -> dict[str, Any]:
    body = {"operator": "acme-air", "url": url, "secret": SECRET, "kinds": kinds or ("intent",), **members}
    response = client.post(WEBHOOKS, json=body)
    assert response.status_code == 201, response.text
    answer: dict[str, Any] = response.json()
    return answer


def the_webhook(client: Client) -> dict[str, Any]:
    """Return the only webhook as it is listed."""
    (item,) = client.get(WEBHOOKS).json()["items"]
    WebhookPage.model_validate({"items": [item], "next_cursor": None})
    return dict(item)


def attempts(client: Client) -> dict[str, float]:
    """Return how many attempts there were of each outcome."""
    lines = client.get("/metrics").text.splitlines()
    counted = [line.split() for line in lines if line.startswith("airmatrix_webhook_deliveries_total")]
    return {name.split('"')[1]: float(count) for name, count in counted if float(count)}


def hmac_of(key: bytes, message: bytes) -> str:
    """Return HMAC-SHA256 as RFC 2104 defines it."""
    padded = key.ljust(64, b"\0")
    inner = hashlib.sha256(bytes(byte ^ 0x36 for byte in padded) + message).digest()
    return hashlib.sha256(bytes(byte ^ 0x5C for byte in padded) + inner).hexdigest()


# Delivery


def test_an_event_arrives_signed_and_by_itself(lanes: Client, receiver: Receiver) -> None:
    webhook = subscribe(lanes, receiver.url)
    flight = submit(lanes, reference="ORD-7781")
    asyncio.run(until(lambda: the_webhook(lanes)["last_delivery"] is not None))
    (delivery,) = receiver.deliveries
    (event,) = lanes.get("/v1/events").json()["items"]
    assert event["flight_intent_id"] == flight
    name, sent = f"{webhook['id']}:1:0", format_time(START_MS)
    assert delivery.parsed == {"id": name, "event": {**event, "reference": "ORD-7781"}, "sent": sent}
    assert delivery.headers["AirMatrix-Delivery"] == name
    signed = f"{START_MS // 1000}.".encode() + delivery.content
    assert delivery.headers["AirMatrix-Signature"] == f"t={START_MS // 1000},v1={hmac_of(SECRET.encode(), signed)}"
    assert the_webhook(lanes)["pending"] == 0
    assert attempts(lanes) == {"delivered": 1}


def test_a_webhook_is_told_what_it_asked_for_from_then_on_and_nothing_of_others(
    still: Client, receiver: Receiver, clock: FakeClock
) -> None:
    submit(still)
    subscribe(still, receiver.url, "conformance")
    flight = activated(still, "V", "F")
    other = submit(still, earliest_ms=DEPARTURE_MS + 600_000, operator="zeta")
    clock.now_ms = DEPARTURE_MS
    see(still, flight, 0.5, 1.5)
    see(still, "radar-1", 3.5, 1.5)
    see(still, other, 4.5, 1.5)
    look(still)
    deliver(deliverer(still))
    assert [(delivery.event["flight_intent_id"], delivery.event["kind"]) for delivery in receiver.deliveries] == [
        (flight, "deviating")
    ]


def test_an_operator_is_told_that_a_flight_cannot_make_way_for_a_constraint(still: Client, receiver: Receiver) -> None:
    flight = activated(still, "V", "F")
    subscribe(still, receiver.url, "intent")
    made = close(still, area(2.1, -1, 4.9, 9))
    deliver(deliverer(still))
    (delivery,) = receiver.deliveries
    assert made["unmoved"] == [flight]
    assert (delivery.event["flight_intent_id"], delivery.event["kind"]) == (flight, "unmoved")
    assert delivery.event["details"] == {"cause": {"constraint_id": made["id"]}}


@pytest.mark.parametrize("status", [500, 302, None])
def test_what_is_not_taken_is_sent_again_later_and_later(
    still: Client, receiver: Receiver, clock: FakeClock, status: int | None
) -> None:
    subscribe(still, receiver.url)
    submit(still)
    receiver.verdict = lambda _: status
    mail = deliverer(still, patience_s=5.0 if status else 0.05)
    for wait_ms in (2_000, 4_000, 8_000):
        deliver(mail)
        tried = len(receiver.deliveries)
        clock.advance(ms=wait_ms - 1)
        deliver(mail)
        assert len(receiver.deliveries) == tried
        clock.advance(ms=1)
    webhook = the_webhook(still)
    assert (webhook["pending"], webhook["last_delivery"]) == (1, None)
    assert webhook["last_error"] == ("no answer within 0.05 s" if status is None else f"answered {status}")
    assert webhook["failing_since"] == webhook["created"]
    receiver.verdict = lambda _: 200
    successor = deliverer(still)
    deliver(successor)
    clock.advance(seconds=DESK_S)
    deliver(successor)
    assert len({delivery.parsed["id"] for delivery in receiver.deliveries}) == 1
    webhook = the_webhook(still)
    assert (webhook["pending"], webhook["failing_since"], webhook["given_up"]) == (0, None, 0)
    assert attempts(still) == {"failed": 3, "delivered": 1}


def test_events_of_a_flight_intent_wait_for_the_one_before_and_others_go_on(
    still: Client, receiver: Receiver, clock: FakeClock
) -> None:
    subscribe(still, receiver.url)
    poison, other = submit(still), submit(still, "V", "F")
    receiver.verdict = lambda event: 500 if event["flight_intent_id"] == poison else 200
    mail = deliverer(still)
    for flight in (poison, other):
        still.post(f"{SUBMIT}/{flight}/activate")
    deliver(mail)
    assert sorted(receiver.told) == [(1, "accepted"), (2, "accepted"), (2, "activated")]
    still.post(f"{SUBMIT}/{other}/end")
    deliver(mail)
    assert receiver.told[3:] == [(2, "ended")]
    assert the_webhook(still)["pending"] == 2
    receiver.verdict = lambda _: 200
    clock.advance(seconds=2)
    deliver(mail)
    assert receiver.told[4:] == [(1, "accepted"), (1, "activated")]


def test_what_fails_for_a_day_is_given_up_and_the_next_gets_its_try(
    still: Client, receiver: Receiver, clock: FakeClock
) -> None:
    subscribe(still, receiver.url)
    flight = submit(still)
    receiver.verdict = lambda event: 500 if event["kind"] == "accepted" else 200
    mail = deliverer(still)
    deliver(mail)
    still.post(f"{SUBMIT}/{flight}/activate")
    clock.advance(seconds=DAY_S - 1)
    deliver(mail)
    assert receiver.kinds == ["accepted", "accepted"]
    clock.advance(seconds=601)
    deliver(mail)
    assert receiver.kinds == ["accepted", "accepted", "accepted", "activated"]
    webhook = the_webhook(still)
    assert (webhook["pending"], webhook["given_up"], webhook["last_error"]) == (0, 1, "answered 500")
    assert attempts(still) == {"failed": 2, "given_up": 1, "delivered": 1}


def test_that_deliveries_fail_is_logged_when_it_begins_and_when_it_ends(
    still: Client, receiver: Receiver, clock: FakeClock
) -> None:
    webhook = subscribe(still, receiver.url)
    submit(still)
    submit(still, "V", "F")
    mail = deliverer(still)
    with capture_logs() as logged:
        for status in (500, 500, 200):
            receiver.verdict = lambda _, status=status: status  # type: ignore[misc]
            deliver(mail)
            clock.advance(seconds=4)
    told = [(entry["event"], entry["webhook"], entry["log_level"]) for entry in logged if "webhook" in entry]
    assert told == [
        ("webhook deliveries fail", webhook["id"], "warning"),
        ("webhook deliveries work again", webhook["id"], "warning"),
    ]
    assert attempts(still) == {"failed": 4, "delivered": 2}


class SlowPost(Post):
    """Keeps the order in which events come to hosts; each takes as long as `take` says."""

    def __init__(self, take: Callable[[str], Awaitable[object]]) -> None:
        super().__init__(LOCAL)
        self.hosts: list[str] = []
        self._take = take

    async def __call__(self, text: str, content: bytes, headers: dict[str, str]) -> None:
        del content, headers
        host = httpx.URL(text).host
        self.hosts.append(host)
        await self._take(host)


def test_receivers_that_hang_take_no_more_than_their_operators_lanes(still: Client) -> None:
    for operator in ("slow", "slower"):
        for number in range(8):
            subscribe(still, f"https://{operator}.example/{number}", operator=operator)
    subscribe(still, "https://quick.example/", operator="quick")
    for number in range(4):
        for operator, lane, end in (("slow", "W", "E"), ("slower", "V", "F")):
            submit(still, lane, end, operator=operator, earliest_ms=DEPARTURE_MS + number * 600_000)
    submit(still, operator="quick", earliest_ms=DEPARTURE_MS + 3_600_000)
    told = asyncio.Event()

    async def take(host: str) -> None:
        if host != "quick.example":
            await asyncio.Event().wait()
        told.set()

    post = SlowPost(take)
    mail = delivering_by(still, post)

    async def deliver_once() -> None:
        under_way = await mail.look()
        await asyncio.wait_for(told.wait(), 10)
        for lane in under_way:
            lane.cancel()

    asyncio.run(deliver_once())
    assert Counter(post.hosts) == {"slow.example": 16, "slower.example": 16, "quick.example": 1}


def test_where_lanes_are_short_they_go_round(still: Client, clock: FakeClock, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(webhook_delivery, "_MOST_LANES", 1)
    for operator, flights in (("slow", 3), ("quick", 1)):
        subscribe(still, f"https://{operator}.example/", operator=operator)
        for number in range(flights):
            lane, end = ("W", "E") if operator == "slow" else ("V", "F")
            submit(still, lane, end, operator=operator, earliest_ms=DEPARTURE_MS + number * 600_000)

    async def take(host: str) -> None:
        clock.advance(seconds=4 if host == "slow.example" else 0)

    post = SlowPost(take)
    deliver(delivering_by(still, post))
    assert post.hosts == ["slow.example", "quick.example", "slow.example", "slow.example"]


def test_after_a_crash_only_what_was_on_its_way_comes_again(
    still: Client, on_lanes: Settings, receiver: Receiver, clock: FakeClock
) -> None:
    subscribe(still, receiver.url)
    flight = activated(still)
    still.post(f"{SUBMIT}/{flight}/end")
    receiver.verdict = lambda event: None if event["kind"] == "ended" else 200
    killed, successor = deliverer(still), deliverer(still)

    async def until_it_dies() -> None:
        await killed.look()
        await until(lambda: "ended" in receiver.kinds)

    asyncio.run(until_it_dies())
    assert receiver.kinds == ["accepted", "activated", "ended"]
    receiver.verdict = lambda _: 200
    # The desk is the dead one's for a while; to see that takes no lock.
    with write_lock(on_lanes.ledger):
        deliver(successor)
    assert len(receiver.deliveries) == 3
    clock.advance(seconds=DESK_S)
    deliver(successor)
    assert receiver.kinds[3:] == ["ended"]
    deliver(deliverer(still), successor)
    assert len(receiver.deliveries) == 4


def test_two_processes_deliver_each_event_once(
    still: Client, on_lanes: Settings, clock: FakeClock, receiver: Receiver
) -> None:
    with served(create_app(on_lanes, clock, elapsed_ms=clock)) as other:
        assert other.service.writing is not None
        other.service.writing.deliverer.stop()
        subscribe(still, receiver.url)
        pair = [deliverer(still), deliverer(other)]
        flights = [submit(client, lane, end) for client in (still, other) for lane, end in (("W", "E"), ("V", "F"))]
        deliver(*pair)
        for flight in flights:
            other.post(f"{SUBMIT}/{flight}/activate")
            deliver(*reversed(pair))
        clock.advance(seconds=DESK_S)
        for flight in flights:
            still.post(f"{SUBMIT}/{flight}/end")
        deliver(*pair)
    assert sorted(receiver.told) == [(n, kind) for n in (1, 2, 3, 4) for kind in ("accepted", "activated", "ended")]


@pytest.mark.parametrize("ahead_ms", [-3_600_000, -30_000, -100, 100, 30_000, 3_600_000])
def test_two_processes_whose_clocks_differ_deliver_each_event_once(
    still: Client, on_lanes: Settings, clock: FakeClock, receiver: Receiver, ahead_ms: int
) -> None:
    with served(create_app(on_lanes, lambda: clock() + ahead_ms, elapsed_ms=clock)) as other:
        assert other.service.writing is not None
        other.service.writing.deliverer.stop()
        subscribe(still, receiver.url)
        first, second = deliverer(still), deliverer(other)
        flight = submit(still)
        deliver(second, first)
        # What the first sends takes a while, and it has renewed its lease before it ends.
        for step in ("activate", "end"):
            clock.advance(seconds=DESK_S / 2 + 1)
            still.post(f"{SUBMIT}/{flight}/{step}")
            deliver(first, second)
        holders = {mail for mail in (first, second) if mail._is_ours()}
        assert len(holders) == 1
        # Where it dies, the other one takes over.
        (dead,) = holders
        successor = second if dead is first else first
        submit(still, earliest_ms=DEPARTURE_MS + 600_000)
        deliver(successor)
        assert len(receiver.deliveries) == 3
        clock.advance(seconds=DESK_S)
        deliver(successor)
    assert receiver.kinds == ["accepted", "activated", "ended", "accepted"]


def test_who_has_the_desk_keeps_it_for_as_long_as_its_lease_lasts(
    still: Client, clock: FakeClock, receiver: Receiver
) -> None:
    subscribe(still, receiver.url)
    holder, other = deliverer(still), deliverer(still)
    flight = submit(still)
    deliver(holder)
    deliver(other)
    still.post(f"{SUBMIT}/{flight}/activate")
    clock.advance(seconds=DESK_S - 1)
    deliver(other)
    assert receiver.kinds == ["accepted"]
    clock.advance(seconds=1)
    deliver(other)
    assert receiver.kinds == ["accepted", "activated"]


@pytest.mark.parametrize("jump_s", [-3_600, 3_600])
def test_a_clock_that_jumps_neither_takes_the_desk_nor_keeps_it(
    still: Client, clock: FakeClock, receiver: Receiver, jump_s: int
) -> None:
    jumped = FakeClock(0)

    def jumping() -> int:
        return clock() + jumped()

    subscribe(still, receiver.url)
    holder, other = (delivering_by(still, Post(LOCAL), clock=jumping) for _ in range(2))
    flight = submit(still)
    deliver(holder)
    deliver(other)
    still.post(f"{SUBMIT}/{flight}/activate")
    jumped.advance(seconds=jump_s)
    deliver(other)
    assert (holder._is_ours(), other._is_ours()) == (True, False)
    clock.advance(seconds=DESK_S)
    deliver(other)
    assert (holder._is_ours(), other._is_ours()) == (False, True)


def test_a_process_that_stops_leaves_the_desk_to_the_next(lanes: Client, receiver: Receiver) -> None:
    subscribe(lanes, receiver.url)
    receiver.verdict = lambda _: None
    submit(lanes)
    asyncio.run(until(lambda: bool(receiver.deliveries)))
    assert lanes.service.writing is not None
    lanes.service.writing.deliverer.stop()
    lanes.service.writer.enqueue(lambda *_: None, lambda: None).future.result()
    receiver.verdict = lambda _: 200
    deliver(deliverer(lanes))
    assert receiver.kinds == ["accepted", "accepted"]


def test_nobody_waits_for_a_receiver_that_hangs(lanes: Client, receiver: Receiver) -> None:
    answered: list[str] = []
    receiver.verdict = lambda _: None
    for url in (receiver.url, f"{receiver.url}&again=1"):
        subscribe(lanes, url)
    flight = submit(lanes)
    asyncio.run(until(lambda: len(receiver.deliveries) == 2))
    for step in ("activate", "end"):
        answered.append(lanes.post(f"{SUBMIT}/{flight}/{step}").json()["state"])
        answered.append(lanes.get(WEBHOOKS).json()["items"][0]["last_error"])
    # Had anybody waited, one of these would tell of a failure.
    assert answered == ["activated", None, "ended", None]
    assert lanes.service.writer.waiting == 0


def test_what_cannot_be_recorded_is_not_sent_over_and_over(still: Client, receiver: Receiver) -> None:
    subscribe(still, receiver.url)
    submit(still)
    mail = deliverer(still)

    def take_and_break(_: Event) -> int:
        still.service.writer.stop()
        return 200

    receiver.verdict = take_and_break
    deliver(mail, ignoring=(LedgerUnavailable,))
    deliver(mail, ignoring=(LedgerUnavailable,))
    assert len(receiver.deliveries) == 1


def test_what_retention_has_removed_is_said_to_be_missed(still: Client, clock: FakeClock, receiver: Receiver) -> None:
    webhook = subscribe(still, receiver.url)
    flight = submit(still)
    mail = deliverer(still)
    receiver.verdict = lambda _: 500
    deliver(mail)
    still.post(f"{SUBMIT}/{flight}/activate")
    still.post(f"{SUBMIT}/{flight}/end")

    def remove(transaction: Transaction, now: int) -> int:
        return transaction.remove_journal(now + 1, 2)

    assert still.service.writer.enqueue(remove, lambda: None).future.result() == 2
    receiver.verdict = lambda _: 200
    deliver(mail)
    clock.advance(seconds=2)
    deliver(mail)
    submit(still)
    deliver(mail)
    assert receiver.told == [(1, "accepted"), (1, "ended"), (2, "accepted")]
    listed = the_webhook(still)
    assert (listed["id"], listed["missed_through"], listed["pending"]) == (webhook["id"], 2, 0)


def test_a_webhook_without_events_keeps_up_with_the_journal(still: Client, receiver: Receiver) -> None:
    subscribe(still, receiver.url, operator="zeta")
    submit(still)
    mail = deliverer(still)
    deliver(mail)
    deliver(mail)
    with still.service.ledger.webhooks() as rows:
        (webhook,) = rows.page()
    assert (webhook.read_through, webhook.missed_through) == (1, None)


# Where deliveries go


@pytest.mark.parametrize(
    ("url", "destinations"),
    [
        ("http://receiver.example/", LOCAL),
        ("http://93.184.216.34/", LOCAL),
        ("ftp://receiver.example/", LOCAL),
        ("//receiver.example/", LOCAL),
        ("https:///path", LOCAL),
        ("https://user@receiver.example/", LOCAL),
        ("https://receiver.example/#here", LOCAL),
        ("https://receiver.example:0/", LOCAL),
        ("https://receiver.example:x/", LOCAL),
        ("https://10.0.0.1/", LOCAL),
        ("http://127.0.0.1/", PUBLIC),
        ("https://127.0.0.1/", PUBLIC),
        ("https://localhost/", PUBLIC),
        ("https://[::1]/", PUBLIC),
        ("https://[::ffff:127.0.0.1]/", PUBLIC),
        ("https://[64:ff9b::7f00:1]/", PUBLIC),
        ("https://[2002:7f00:1::]/", PUBLIC),
        ("https://[3fff::1]/", PUBLIC),
        ("https://[3fff:fff::1]/", PUBLIC),
        ("https://[2001:1::1]/", PUBLIC),
        ("https://192.0.0.9/", PUBLIC),
        ("https://192.0.0.10/", PUBLIC),
        ("https://192.88.99.1/", PUBLIC),
        ("https://[::ffff:192.88.99.1]/", PUBLIC),
        ("https://xn--/", LOCAL),
        ("https://xn--a/", LOCAL),
        ("https://[fe80::1]/", PUBLIC),
        ("https://[fd00::1]/", PUBLIC),
        ("https://169.254.169.254/", PUBLIC),
        ("https://100.64.0.1/", PUBLIC),
        ("https://0.0.0.0/", PUBLIC),
        ("https://0.0.0.0/", PRIVATE),
        ("https://224.0.0.1/", PRIVATE),
        ("http://10.0.0.1/", PRIVATE),
    ],
)
def test_some_addresses_are_refused_at_once(url: str, destinations: Destinations) -> None:
    with pytest.raises(WebhookRefused):
        destinations.check(url)


@pytest.mark.parametrize(
    ("url", "destinations"),
    [
        ("https://receiver.example:8443/path?query=1", PUBLIC),
        ("https://93.184.216.34/", PUBLIC),
        ("https://[2606:2800:220:1::1]/", PUBLIC),
        ("https://[64:ff9b::5db8:d822]/", PUBLIC),
        ("http://localhost:9000/", LOCAL),
        ("http://[::1]:9000/", LOCAL),
        ("https://127.0.0.1/", LOCAL),
        ("https://10.0.0.1/", PRIVATE),
        ("https://localhost/", PRIVATE),
    ],
)
def test_others_are_not(url: str, destinations: Destinations) -> None:
    assert str(destinations.check(url)) == url


@pytest.mark.parametrize("host", ["2130706433", "0x7f.1", "127.1"])
def test_a_name_that_leads_to_a_private_address_is_found_out_on_delivery(host: str, receiver: Receiver) -> None:
    port = httpx.URL(receiver.url).port
    with pytest.raises(DeliveryFailed, match="has no address, or one that nothing may be sent to"):
        asyncio.run(Post(PUBLIC)(f"https://{host}:{port}/", b"{}", {}))


def test_nobody_finds_out_which_names_there_are_behind_the_service() -> None:
    said = set()
    # The one leads to this machine, the other (RFC 6761) nowhere.
    for host in ("127.1", "nobody.invalid"):
        with pytest.raises(DeliveryFailed) as failure:
            asyncio.run(Post(PUBLIC)(f"https://{host}/", b"{}", {}))
        said.add(str(failure.value).replace(host, "host"))
    assert len(said) == 1


def test_loopback_is_for_services_without_authentication_that_only_listen_there() -> None:
    assert Destinations.of(Settings()) == LOCAL
    assert Destinations.of(Settings(allow_unauthenticated=True)) == PUBLIC
    assert Destinations.of(Settings(jwks="keys.json", webhook_allow_private=True)) == PRIVATE


@pytest.fixture
def certificate(tmp_path: Path) -> Path:
    """Return a file with a key and a certificate of localhost, signed by itself."""
    key = ec.generate_private_key(ec.SECP256R1())
    name = x509.Name([x509.NameAttribute(x509.NameOID.COMMON_NAME, "localhost")])
    now = datetime.now(UTC)
    made = (
        x509.CertificateBuilder()
        .subject_name(name)
        .issuer_name(name)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(now - timedelta(hours=1))
        .not_valid_after(now + timedelta(hours=1))
        .add_extension(x509.SubjectAlternativeName([x509.DNSName("localhost")]), critical=False)
        .add_extension(x509.BasicConstraints(ca=True, path_length=None), critical=True)
        .sign(key, hashes.SHA256())
    )
    plain = serialization.NoEncryption()
    path = tmp_path / "localhost.pem"
    path.write_bytes(
        key.private_bytes(serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, plain)
        + made.public_bytes(serialization.Encoding.PEM)
    )
    return path


def test_the_certificate_is_that_of_the_name_although_the_connection_goes_to_an_address(
    certificate: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    shown = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    shown.load_cert_chain(certificate)
    content = b'{"event": {"kind": "accepted"}}'
    with receiving(shown) as receiver:
        with pytest.raises(DeliveryFailed, match="certificate verify failed"):
            asyncio.run(Post(LOCAL)(receiver.url, content, {}))
        monkeypatch.setenv("SSL_CERT_FILE", str(certificate))
        with pytest.raises(DeliveryFailed, match="certificate verify failed"):
            asyncio.run(Post(LOCAL)(receiver.url.replace("localhost", "127.0.0.1"), content, {}))
        assert receiver.kinds == []
        asyncio.run(Post(LOCAL)(receiver.url, content, {}))
        assert receiver.kinds == ["accepted"]
        assert receiver.deliveries[0].headers["Host"] == httpx.URL(receiver.url).netloc.decode()


@pytest.mark.parametrize(("attempts", "shortest_s", "longest_s"), [(1, 1, 2), (2, 2, 4), (9, 256, 512), (99, 300, 600)])
def test_the_time_between_attempts_doubles_up_to_ten_minutes(attempts: int, shortest_s: int, longest_s: int) -> None:
    assert retry_after_ms(attempts, 0.0) == longest_s * 1000
    assert retry_after_ms(attempts, 0.999_999) == pytest.approx(shortest_s * 1000, rel=0.001)


# Subscriptions


def test_a_secret_is_made_where_none_is_given_and_shown_only_once(still: Client) -> None:
    made = subscribe(still, "https://receiver.example/", "intent", "conformance", "intent", secret=None)
    assert len(made["secret"]) >= 43
    assert made["kinds"] == ["conformance", "intent"]
    listed = the_webhook(still)
    assert listed == {name: value for name, value in made.items() if name != "secret"}
    assert made["secret"] not in still.get(WEBHOOKS).text


def test_a_malformed_subscription_is_refused(still: Client) -> None:
    wrong: list[dict[str, Any]] = [
        {"operator": None},
        {"url": "https://receiver.example/ "},
        {"url": "https://receiver.example/" + "x" * 2000},
        {"kinds": []},
        {"kinds": ["everything"]},
        {"secret": "too-short"},
        {"secret": "not printable\n\n\n\n\n"},
        {"colour": "red"},
    ]
    for members in wrong:
        body = {"operator": "acme-air", "url": "https://receiver.example/", "kinds": ["intent"], **members}
        (error,) = problem(still.post(WEBHOOKS, json=body), 422, "validation-error")["errors"]
        assert set(members) & set(error["loc"]), error


def test_a_private_address_is_no_place_to_subscribe_from(still: Client) -> None:
    body = {"operator": "acme-air", "url": "https://192.168.0.1/", "kinds": ["intent"]}
    assert problem(still.post(WEBHOOKS, json=body), 422, "webhook-refused")["detail"] == (
        "192.168.0.1 is not a public address"
    )


def test_an_operator_has_ten_webhooks_at_most_and_lists_are_paged(still: Client) -> None:
    ids = [subscribe(still, f"https://receiver.example/{n}")["id"] for n in range(10)]
    body = {"operator": "acme-air", "url": "https://receiver.example/", "kinds": ["intent"]}
    problem(still.post(WEBHOOKS, json=body), 409, "too-many-webhooks")
    other = subscribe(still, "https://receiver.example/", operator="zeta")["id"]
    first = still.get(WEBHOOKS, params={"limit": 6}).json()
    second = still.get(WEBHOOKS, params={"limit": 6, "cursor": first["next_cursor"]}).json()
    assert [item["id"] for item in first["items"] + second["items"]] == [*ids, other]
    assert second["next_cursor"] is None
    assert [item["id"] for item in still.get(WEBHOOKS, params={"operator": "zeta"}).json()["items"]] == [other]
    assert still.delete(f"{WEBHOOKS}/{ids[0]}").json()["id"] == ids[0]
    assert still.post(WEBHOOKS, json=body).status_code == 201


def test_nothing_goes_to_a_webhook_that_was_removed(still: Client, receiver: Receiver) -> None:
    webhook = subscribe(still, receiver.url)
    submit(still)
    assert still.delete(f"{WEBHOOKS}/{webhook['id']}").status_code == 200
    deliver(deliverer(still))
    assert receiver.deliveries == []
    problem(still.delete(f"{WEBHOOKS}/{webhook['id']}"), 404, "unknown-webhook")
    assert still.get(WEBHOOKS).json() == {"items": [], "next_cursor": None}


def test_to_remove_what_there_is_not_is_no_work_for_the_writer(still: Client) -> None:
    subscribe(still, "https://receiver.example/")
    still.service.writer.stop()
    for nobody in (uuid4(), "%00", "one"):
        problem(still.delete(f"{WEBHOOKS}/{nobody}"), 404, "unknown-webhook")


def test_with_authentication_a_webhook_is_its_operator_s(ledger: str, tmp_path: Path, clock: FakeClock) -> None:
    guarded = settings_for(LANES, ledger, tmp_path, jwks=str(write_keys(tmp_path, issuer())))
    body = {"url": "https://receiver.example/", "kinds": ["intent"]}
    with served(create_app(guarded, clock, elapsed_ms=clock)) as api:
        made = api.post(WEBHOOKS, json=body, **as_("acme-air")).json()
        assert made["operator"] == "acme-air"
        problem(api.post(WEBHOOKS, json={**body, "operator": "zeta"}, **as_("acme-air")), 403, "operator-mismatch")
        problem(
            api.post(WEBHOOKS, json={**body, "url": "http://127.0.0.1:9/"}, **as_("acme-air")), 422, "webhook-refused"
        )
        assert [item["id"] for item in api.get(WEBHOOKS, **as_("acme-air")).json()["items"]] == [made["id"]]
        assert api.get(WEBHOOKS, **as_("zeta")).json()["items"] == []
        problem(api.get(WEBHOOKS, params={"operator": "acme-air"}, **as_("zeta")), 403, "operator-mismatch")
        problem(api.delete(f"{WEBHOOKS}/{made['id']}", **as_("zeta")), 404, "unknown-webhook")
        assert api.delete(f"{WEBHOOKS}/{made['id']}", **as_("acme-air")).status_code == 200
