"""Delivers events to webhooks, in a thread of its own: the journal is the queue, and the writer never waits for it.

What the journal has for a webhook is first put down as waiting, together with how far the journal was read. Then the
first that waits of each flight intent is sent, some of them at once; each is crossed out before the next is looked for.
Of several processes that share a ledger only the one that has the desk does so; the others see that it is taken.
"""

import asyncio
import random
import socket
import threading
from collections import Counter, defaultdict
from collections.abc import Callable, Sequence
from concurrent.futures import Future
from contextlib import suppress
from functools import cached_property
from importlib.metadata import version
from ssl import SSLContext

import httpx
import structlog
from uuid_utils import uuid4

from app.errors import LedgerUnavailable, OutcomeUnknown, QueueFull, WebhookRefused
from app.ledger import Ledger, Transaction
from app.ledger.webhooks import Desk, Lease, Line, Waiting, Webhook, WebhookRows
from app.times import monotonic_ms
from app.webhooks import Destinations, body, delivery_id, kind_of, retry_after_ms, signature
from app.writer import Request, Writer

log = structlog.get_logger()

DELIVERED, FAILED, GIVEN_UP, LOST = OUTCOMES = ("delivered", "failed", "given_up", "lost")

# How often the journal is looked at, also after a failure, and how long a receiver may take.
_EVERY_S, _AFTER_FAILURE_S, _PATIENCE_S = 0.25, 1.0, 5.0
# Events older than this are given up when they fail once more.
_GIVE_UP_MS = 86_400_000
# The desk is held for so long from every record on; clocks differ and jump, so others let that pass after they have
# seen a record, and nobody asks what time it is. Nothing is sent that might not be answered before it ends.
_DESK_MS, _MARGIN_MS = 20_000, 7_000
# How many journal entries are read at once. Where so many events wait, the rest stays in the journal.
_LINES, _MOST_WAITING = 256, 10_000
# That nothing was for somebody is recorded only so often.
_RECORD_READ_MS = 60_000
# How many events are on their way at once to one webhook; to one that fails; to all of an operator; and to all.
_LANES, _LANES_IF_FAILING, _LANES_OF_OPERATOR, _MOST_LANES = 4, 1, 16, 64
# For how long a lane is kept while others wait for one.
_TURN_MS = 1_000
# Until the thread has let go of what it does.
_STOP_S = 1.0

Work = Callable[[WebhookRows, int], None]


class DeliveryFailed(Exception):
    """A receiver has not taken an event; the message says why, and is shown to the operator."""


class Post:
    """Sends by HTTP: once, to an address that was checked, without following redirects, for a while at most."""

    def __init__(self, destinations: Destinations, patience_s: float = _PATIENCE_S) -> None:
        self._destinations = destinations
        self._patience_s = patience_s

    @cached_property
    def _name(self) -> str:
        return f"AirMatrix/{version('airmatrix')}"

    @cached_property
    def _certificates(self) -> SSLContext:
        # Reading them takes long enough to do it once, and not at every start.
        return httpx.create_ssl_context()

    async def __call__(self, text: str, content: bytes, headers: dict[str, str]) -> None:
        """Send a body to a url, and return when its receiver has answered 2xx.

        Raises
        ------
        DeliveryFailed
        """
        try:
            async with asyncio.timeout(self._patience_s):
                status = await self._status(text, content, headers)
        except TimeoutError:
            raise DeliveryFailed(f"no answer within {self._patience_s:g} s") from None
        except (httpx.HTTPError, httpx.InvalidURL, WebhookRefused, OSError) as error:
            raise DeliveryFailed(f"{type(error).__name__}: {error}"[:200]) from None
        if not 200 <= status < 300:
            raise DeliveryFailed(f"answered {status}")

    async def _status(self, text: str, content: bytes, headers: dict[str, str]) -> int:
        url = self._destinations.check(text)
        host = url.raw_host.decode()
        addresses = await _addresses(host, url.port or (443 if url.scheme == "https" else 80))
        if not addresses or not all(self._destinations.permits(url, address) for address in addresses):
            # Not which, nor whether there is one: names of the network behind this machine are not the operator's to
            # look up.
            raise DeliveryFailed(f"{host} has no address, or one that nothing may be sent to")
        # To the very address that was looked at: a second look-up might say something else (DNS rebinding). A proxy
        # would look it up again.
        request = {**headers, "Host": url.netloc.decode(), "User-Agent": self._name}
        async with httpx.AsyncClient(verify=self._certificates, trust_env=False, timeout=None) as client:  # noqa: S113
            *others, last = addresses
            for address in others:
                with suppress(httpx.ConnectError):
                    return await _exchange(client, url, address, host, content, request)
            return await _exchange(client, url, last, host, content, request)


async def _exchange(
    client: httpx.AsyncClient, url: httpx.URL, address: str, host: str, content: bytes, headers: dict[str, str]
) -> int:
    """Post to an address in a host's name; whatever follows the head of the answer is left unread."""
    pinned, named = url.copy_with(host=address), {"sni_hostname": host}
    async with client.stream("POST", pinned, content=content, headers=headers, extensions=named) as response:
        return response.status_code


async def _addresses(host: str, port: int) -> Sequence[str]:
    """Return a host's addresses, none if it cannot be resolved.

    In a thread that nobody has to wait for: a resolver may hang longer than we.
    """
    found: Future[list[str]] = Future()

    def look_up() -> None:
        found.set_running_or_notify_cancel()
        try:
            answers = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)
            found.set_result(list(dict.fromkeys(str(answer[4][0]) for answer in answers)))
        except (OSError, UnicodeError):
            found.set_result([])

    threading.Thread(target=look_up, name="webhook-resolver", daemon=True).start()
    return await asyncio.wrap_future(found)


class Deliverer:
    """Delivers what the journal has for webhooks: between `start` and `stop` by itself, or one `look` after another.

    `post` sends, `chance` spreads retries, `observe` is told the outcome of each attempt. `clock` says what time it is,
    and may be wrong; `elapsed_ms` how much has passed, and never jumps.
    """

    def __init__(
        self,
        ledger: Ledger,
        writer: Writer,
        clock: Callable[[], int],
        post: Post,
        observe: Callable[[str], None] = lambda _: None,
        *,
        elapsed_ms: Callable[[], int] = monotonic_ms,
        chance: Callable[[], float] = random.random,
    ) -> None:
        self._ledger = ledger
        self._writer = writer
        self._clock = clock
        self._elapsed_ms = elapsed_ms
        self._post = post
        self._observe = observe
        self._chance = chance
        self._holder = str(uuid4())
        # Until when the desk is surely ours, as far as recorded; the lease that was seen last, and since when: by the
        # time that has passed, not by the clock.
        self._held_until_ms = 0
        self._lease: Lease | None = None
        self._lease_since_ms = 0
        # Through which revisions the journal was read where nothing was found since.
        self._read_through: dict[int, int] = {}
        self._recorded_ms = 0
        # By webhook: of which flight intents an event is on its way, and what is under way.
        self._sending: defaultdict[int, set[int]] = defaultdict(set)
        self._lanes: dict[asyncio.Task[None], Webhook] = {}
        # The webhook that was given a lane last, and whether some could be given none, or not all that they want.
        self._last = 0
        self._is_short = False
        self._loop: asyncio.AbstractEventLoop | None = None
        self._main: asyncio.Task[None] | None = None
        self._thread: threading.Thread | None = None

    def start(self) -> None:
        """Begin to deliver."""
        self._loop = asyncio.new_event_loop()
        self._main = self._loop.create_task(self._run())
        self._thread = threading.Thread(target=self._work, name="webhook-delivery", daemon=True)
        self._thread.start()

    def stop(self) -> None:
        """End it at once: what is on its way is sent again later, by whoever delivers then."""
        if self._thread is not None and self._loop is not None and self._main is not None:
            with suppress(RuntimeError):  # It has ended by itself.
                self._loop.call_soon_threadsafe(self._main.cancel)
            self._thread.join(_STOP_S)

    def _work(self) -> None:
        assert self._loop is not None
        assert self._main is not None
        with suppress(asyncio.CancelledError):
            self._loop.run_until_complete(self._main)
        self._loop.close()

    async def _run(self) -> None:
        try:
            while True:
                pause_s = _EVERY_S
                try:
                    await self.look()
                except Exception as error:
                    _complain(error)
                    pause_s = _AFTER_FAILURE_S
                await asyncio.sleep(pause_s)
        finally:
            lanes = list(self._lanes)
            for lane in lanes:
                lane.cancel()
            await asyncio.gather(*lanes, return_exceptions=True)
            if self._is_ours():
                with suppress(LedgerUnavailable, QueueFull):
                    self._writer.enqueue(self._leave, lambda: None)

    async def look(self) -> Sequence["asyncio.Task[None]"]:
        """Take what is new in the journal, begin to send what is due, and return what is under way.

        Raises
        ------
        LedgerUnavailable, OutcomeUnknown
        """
        now = self._clock()
        with self._ledger.webhooks() as rows:
            webhooks = rows.page()
            desk, due = (rows.desk(), rows.due_webhooks(now)) if webhooks else (None, [])
        if desk is None:
            return []
        if desk.lease != self._lease:
            self._lease, self._lease_since_ms = desk.lease, self._elapsed_ms()
        newest = desk.revision
        # After a failover that lost commits, revisions are not what they were.
        self._read_through = {
            webhook.number: max(webhook.read_through, min(newest, self._read_through.get(webhook.number, 0)))
            for webhook in webhooks
        }
        behind = [webhook for webhook in webhooks if self._read_through[webhook.number] < newest]
        unrecorded = [webhook for webhook in webhooks if self._read_through[webhook.number] > webhook.read_through]
        records = bool(unrecorded) and abs(now - self._recorded_ms) >= _RECORD_READ_MS
        if not (behind or due or records) or not await self._has_desk(desk):
            return list(self._lanes)
        if records:
            reached = {webhook.number: self._read_through[webhook.number] for webhook in unrecorded}
            await self._record(lambda rows, _: rows.read_on(reached))
            self._recorded_ms = now
        if behind:
            await self._take(behind, desk)
            with self._ledger.webhooks() as rows:
                due = rows.due_webhooks(now)
        self._send({webhook.number: webhook for webhook in webhooks}, due)
        return list(self._lanes)

    def _is_ours(self) -> bool:
        """Tell whether the desk will be ours until something that is sent now is answered."""
        return self._held_until_ms - self._elapsed_ms() > _MARGIN_MS

    async def _has_desk(self, desk: Desk) -> bool:
        """Tell whether this process has the desk, after trying to take or to keep it where that is needed."""
        if desk.holder != self._holder and desk.until_ms > 0 and self._over() is None:
            self._held_until_ms = 0
            return False
        if desk.holder == self._holder and self._held_until_ms - self._elapsed_ms() > _DESK_MS / 2:
            return True
        return await self._record(lambda *_: None)

    def _over(self) -> Lease | None:
        """Return the lease that was seen last if it has not been renewed in its time."""
        return self._lease if self._elapsed_ms() - self._lease_since_ms >= _DESK_MS else None

    async def _record(self, work: Work) -> bool:
        """Have something written down, if the desk is ours or free; then it is ours for a while from now on."""
        over = self._over()

        def run(transaction: Transaction, now: int) -> int:
            with transaction.webhooks() as rows:
                if not rows.hold_desk(self._holder, now + _DESK_MS, over):
                    return 0
                work(rows, now)
                return self._elapsed_ms() + _DESK_MS

        try:
            request = await self._enqueue(run)
            # Shielded: what was delivered is recorded even if this process stops meanwhile.
            self._held_until_ms = await asyncio.shield(asyncio.wrap_future(request.future))
        except (LedgerUnavailable, OutcomeUnknown):
            # Nothing more is sent before something can be recorded again.
            self._held_until_ms = 0
            raise
        return self._held_until_ms > 0

    async def _enqueue(self, run: Callable[[Transaction, int], int]) -> Request[int]:
        while True:
            try:
                return self._writer.enqueue(run, lambda: None)
            except QueueFull:
                # Clients come first; what was delivered is recorded later rather than delivered again.
                await asyncio.sleep(_EVERY_S)

    def _leave(self, transaction: Transaction, _: int) -> None:
        with transaction.webhooks() as rows:
            rows.leave_desk(self._holder)

    async def _take(self, behind: Sequence[Webhook], desk: Desk) -> None:
        """Read on in the journal for webhooks, and put down as waiting what is for them."""
        with self._ledger.webhooks() as rows:
            waiting = rows.waiting(webhook.number for webhook in behind)
        together: defaultdict[int, list[Webhook]] = defaultdict(list)
        for webhook in behind:
            if waiting.get(webhook.number, 0) < _MOST_WAITING:
                together[self._read_through[webhook.number]].append(webhook)
        for read_through, group in together.items():
            if read_through < desk.removed_through:
                await self._miss(group, desk.removed_through)
                continue
            with self._ledger.webhooks() as rows:
                revision = rows.desk().revision
                lines = rows.lines(read_through, _LINES)
            through = revision if len(lines) < _LINES else lines[-1].revision
            for webhook in group:
                await self._take_for(webhook, lines, through)

    async def _miss(self, webhooks: Sequence[Webhook], through: int) -> None:
        numbers = [webhook.number for webhook in webhooks]
        if await self._record(lambda rows, _: rows.miss(numbers, through)):
            ids = [webhook.id for webhook in webhooks]
            _tell(log.warning, "webhooks have missed what retention removed", webhooks=ids, missed_through=through)

    async def _take_for(self, webhook: Webhook, lines: Sequence[Line], through: int) -> None:
        own = [line for line in lines if line.operator == webhook.operator and kind_of(line.kind) in webhook.kinds]
        if not own or await self._record(lambda rows, now: rows.take(webhook, own, through, now)):
            self._read_through[webhook.number] = through

    def _send(self, webhooks: dict[int, Webhook], due: Sequence[int]) -> None:
        """Begin to send what is due, as far as there is room: lane by lane to those who have the fewest.

        Among equals it goes round. So others wait for slow receivers, however many these are, for a turn at most.
        """
        of_operator = Counter(webhook.operator for webhook in self._lanes.values())
        of_webhook = Counter(webhook.number for webhook in self._lanes.values())

        def wants(webhook: Webhook) -> bool:
            return of_webhook[webhook.number] < (_LANES if webhook.failing_since_ms is None else _LANES_IF_FAILING)

        def turn(webhook: Webhook) -> tuple[int, int, bool, int]:
            fewest = of_operator[webhook.operator], of_webhook[webhook.number]
            return *fewest, webhook.number <= self._last, webhook.number

        waiting = [webhooks[number] for number in due if number in webhooks and wants(webhooks[number])]
        while len(self._lanes) < _MOST_LANES:
            webhook = min(
                (one for one in waiting if of_operator[one.operator] < _LANES_OF_OPERATOR), key=turn, default=None
            )
            if webhook is None:
                break
            lane = asyncio.create_task(self._serve(webhook))
            self._lanes[lane] = webhook
            lane.add_done_callback(self._lanes.pop)
            of_operator[webhook.operator] += 1
            of_webhook[webhook.number] += 1
            self._last = webhook.number
            waiting = [one for one in waiting if wants(one)]
        self._is_short = bool(waiting)

    async def _serve(self, webhook: Webhook) -> None:
        """Send what is due to a webhook, one event after another, until there is nothing more or others wait."""
        sending = self._sending[webhook.number]
        began = self._elapsed_ms()
        try:
            while self._is_ours() and not (self._is_short and self._elapsed_ms() - began >= _TURN_MS):
                with self._ledger.webhooks() as rows:
                    due = rows.due(webhook.number, self._clock(), len(sending) + 1)
                waiting = next((event for event in due if event.sequence not in sending), None)
                if waiting is None:
                    return
                sending.add(waiting.sequence)
                try:
                    await self._deliver(webhook, waiting)
                finally:
                    sending.discard(waiting.sequence)
        except Exception as error:
            _complain(error)

    async def _deliver(self, webhook: Webhook, waiting: Waiting) -> None:
        """Send one event, and have recorded what became of it."""
        with self._ledger.webhooks() as rows:
            found = rows.event(waiting)
        if found is None:
            await self._record(lambda rows, now: rows.lost(waiting, now))
            self._observe(LOST)
            return
        entry, reference = found
        now = self._clock()
        content = body(webhook, entry, reference, now)
        headers = {
            "Content-Type": "application/json",
            "AirMatrix-Delivery": delivery_id(webhook, entry),
            "AirMatrix-Signature": signature(webhook.secret, now // 1000, content),
        }
        # Whether failing begins or ends with this; recording may take more than one try.
        turns: list[bool] = []
        try:
            await self._post(webhook.url, content, headers)
        except DeliveryFailed as failure:
            error = str(failure)
        else:
            if await self._record(lambda rows, now: turns.append(rows.delivered(waiting, now))) and turns[-1]:
                _tell(log.warning, "webhook deliveries work again", webhook=webhook.id)
            self._observe(DELIVERED)
            return
        about = {"webhook": webhook.id, "flight_intent": entry.intent_id, "revision": entry.revision, "error": error}
        if self._clock() - entry.time_ms >= _GIVE_UP_MS:
            _tell(log.warning, "webhook delivery given up", **about, attempts=waiting.attempts + 1)
            await self._record(lambda rows, now: rows.given_up(waiting, error, now))
            self._observe(GIVEN_UP)
            return
        wait_ms = retry_after_ms(waiting.attempts + 1, self._chance())
        record = self._record(lambda rows, now: turns.append(rows.failed(waiting, error, now + wait_ms, now)))
        if await record and turns[-1]:
            _tell(log.warning, "webhook deliveries fail", **about)
        self._observe(FAILED)


def _complain(error: Exception) -> None:
    if isinstance(error, LedgerUnavailable | OutcomeUnknown):
        _tell(log.warning, "webhooks are not served", error=str(error))
    else:
        _tell(log.error, "delivery to webhooks failed", exc_info=error)


def _tell(say: Callable[..., object], event: str, **details: object) -> None:
    """Log an event; a log that cannot be written (its disk is full, its reader gone) stops nothing."""
    with suppress(OSError, ValueError):
        say(event, **details)
