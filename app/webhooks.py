"""Webhooks: what operators subscribe to, where it may be sent, and how a delivery shows whom it is from."""

import hashlib
import hmac
import ipaddress
import secrets
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import httpx
import orjson
from anyio import to_thread
from uuid_utils import uuid7

from app.addresses import is_loopback
from app.constraints import UNMOVED
from app.errors import TooManyWebhooks, UnknownWebhook, WebhookRefused
from app.flight_intents import State
from app.ledger import JournalEntry, Ledger, Transaction
from app.ledger.webhooks import Webhook
from app.settings import Settings
from app.times import format_time
from app.writer import Writer

INTENT, CONFORMANCE = KINDS = ("intent", "conformance")
MOST_WEBHOOKS = 10

_STATES = frozenset(state.value for state in State)
_SECRET_BYTES = 32
_FIRST_RETRY_MS, _LONGEST_RETRY_MS = 1_000, 600_000
# IPv6: what is routed at all, and what carries an IPv4 address that is asked for by name.
_GLOBAL_UNICAST = ipaddress.IPv6Network("2000::/3")
_NAT64 = ipaddress.IPv6Network("64:ff9b::/96")
# Nobody's servers, although some of it is routed (RFC 6890): protocols' own, relays of 6to4, and 6to4; documentation.
_NO_HOSTS = [
    ipaddress.ip_network(block) for block in ("192.0.0.0/24", "192.88.99.0/24", "2001::/23", "2002::/16", "3fff::/20")
]


@dataclass(frozen=True)
class Destinations:
    """Where deliveries may go: over https to public addresses; over http, if at all, to this machine's loopback.

    With `loopback`, to loopback too; with `private`, over https to whatever this machine can reach. What is not public
    behind a service's wall is nobody's to knock at from outside, by way of a webhook (server-side request forgery).
    """

    loopback: bool
    private: bool

    @classmethod
    def of(cls, settings: Settings) -> "Destinations":
        """Return what settings allow: loopback only where nobody but this machine's users asks for it."""
        is_local = settings.jwks is None and not settings.allow_unauthenticated
        return cls(loopback=is_local, private=settings.webhook_allow_private)

    def check(self, text: str) -> httpx.URL:
        """Return an address that deliveries may be sent to, as far as that shows before its host is resolved.

        Raises
        ------
        WebhookRefused
        """
        try:
            url = httpx.URL(text)
            # Decoded only now; it may be no name (IDNA, RFC 5891).
            host = url.host
        except (httpx.InvalidURL, UnicodeError) as error:
            raise WebhookRefused(f"the url cannot be parsed: {error}") from None
        has_port = url.port is None or 0 < url.port < 65536
        if not host or url.userinfo or url.fragment or not has_port:
            raise WebhookRefused("the url must be that of a host, without user, password or fragment")
        is_local = self.loopback and is_loopback(host)
        if url.scheme != "https" and not (url.scheme == "http" and is_local):
            raise WebhookRefused(
                "the url must begin with https://"
                + (", or with http:// for this machine's loopback" if self.loopback else "")
            )
        is_literal = _address(host) is not None
        is_permitted = self.permits(url, host) if is_literal else is_local or self.private
        if not is_permitted and (is_literal or is_loopback(host)):
            raise WebhookRefused(f"{host} is not a public address")
        return url

    def permits(self, url: httpx.URL, address: str) -> bool:
        """Tell whether a delivery to a url may go to this address, which its host has."""
        parsed = _address(address)
        if parsed is None or parsed.is_multicast or parsed.is_unspecified:
            return False
        if parsed.is_loopback and self.loopback:
            return True
        return url.scheme == "https" and (self.private or _is_public(parsed))


def _address(text: str) -> ipaddress.IPv4Address | ipaddress.IPv6Address | None:
    """Return a literal address, of IPv4 also where it is written as one of IPv6; None for a name."""
    try:
        address = ipaddress.ip_address(text)
    except ValueError:
        return None
    if isinstance(address, ipaddress.IPv6Address):
        if address.ipv4_mapped is not None:
            return address.ipv4_mapped
        if address in _NAT64:
            return ipaddress.IPv4Address(int(address) & 0xFFFFFFFF)
    return address


def _is_public(address: ipaddress.IPv4Address | ipaddress.IPv6Address) -> bool:
    if isinstance(address, ipaddress.IPv6Address) and address not in _GLOBAL_UNICAST:
        return False
    return address.is_global and not any(address in network for network in _NO_HOSTS)


def kind_of(journal_kind: str) -> str:
    """Return to which kind of subscription an event of a flight intent belongs."""
    return INTENT if journal_kind in _STATES or journal_kind == UNMOVED else CONFORMANCE


def delivery_id(webhook: Webhook, entry: JournalEntry) -> str:
    """Return what names an event to a webhook: the same however often it is sent."""
    return f"{webhook.id}:{entry.revision}:{entry.place}"


def body(webhook: Webhook, entry: JournalEntry, reference: str | None, now_ms: int) -> bytes:
    """Return the body of a delivery: the event as `/v1/events` has it, and the operator's own name for the flight."""
    return orjson.dumps(
        {
            "id": delivery_id(webhook, entry),
            "event": {
                "revision": entry.revision,
                "time": format_time(entry.time_ms),
                "kind": entry.kind,
                "flight_intent_id": entry.intent_id,
                "sequence": entry.sequence,
                "track_id": entry.track_id,
                "reasons": entry.reasons,
                "details": entry.details,
                "reference": reference,
            },
            "sent": format_time(now_ms),
        }
    )


def signature(secret: str, time_s: int, content: bytes) -> str:
    """Return the header that proves a delivery's origin and age: HMAC-SHA256 (RFC 2104) over time and body."""
    signed = hmac.new(secret.encode(), f"{time_s}.".encode() + content, hashlib.sha256).hexdigest()
    return f"t={time_s},v1={signed}"


def retry_after_ms(attempts: int, chance: float) -> int:
    """Return how long to wait after so many attempts: from 1 s on twice as long each time, up to 10 min.

    `chance` within [0, 1) takes up to half of that off, so that not all come back at once.
    """
    longest_ms = min(_LONGEST_RETRY_MS, _FIRST_RETRY_MS << min(attempts, 20))
    return max(_FIRST_RETRY_MS, int(longest_ms * (1 - chance / 2)))


class Webhooks:
    """Adds and removes subscriptions."""

    def __init__(self, ledger: Ledger, writer: Writer, destinations: Destinations) -> None:
        self._ledger = ledger
        self._writer = writer
        self._destinations = destinations

    async def subscribe(self, operator: str, url: str, kinds: Sequence[str], secret: str | None) -> Webhook:
        """Record a subscription to what happens from now on; a secret is made where none is given.

        Raises
        ------
        WebhookRefused, TooManyWebhooks, QueueFull, LedgerUnavailable, OutcomeUnknown
        """
        self._destinations.check(url)
        webhook_id = str(uuid7())
        key = secrets.token_urlsafe(_SECRET_BYTES) if secret is None else secret

        def run(transaction: Transaction, now: int) -> Webhook:
            webhook = Webhook(webhook_id, operator, url, key, tuple(sorted(kinds)), now, transaction.revision)
            with transaction.webhooks() as rows:
                if rows.count(operator) >= MOST_WEBHOOKS:
                    raise TooManyWebhooks(f"operator {operator!r} has {MOST_WEBHOOKS} webhooks; remove one first")
                return rows.add(webhook)

        return await self._writer.perform(run, lambda: self._find(webhook_id))

    async def unsubscribe(self, webhook_id: str, may_change: Callable[[str], bool]) -> Webhook:
        """Remove a webhook with all that waits for it, and return it; what is on its way still arrives.

        Raises
        ------
        UnknownWebhook, QueueFull, LedgerUnavailable, OutcomeUnknown
        """
        unknown = UnknownWebhook(f"there is no webhook {webhook_id}")
        # What is nobody's, or somebody else's, is none of the writer's work.
        known = await to_thread.run_sync(self._find, webhook_id)
        if known is None or not may_change(known.operator):
            raise unknown

        def run(transaction: Transaction, _: int) -> Webhook:
            with transaction.webhooks() as rows:
                webhook = rows.find(webhook_id)
                if webhook is None:
                    raise unknown
                rows.remove(webhook)
                return webhook

        return await self._writer.perform(run, lambda: known if self._find(webhook_id) is None else None)

    def _find(self, webhook_id: str) -> Webhook | None:
        with self._ledger.webhooks() as rows:
            return rows.find(webhook_id)
