"""Requests that wait for the one writer: given up, finished when it stops, too many."""

import asyncio
import contextlib

import pytest

from app.deconfliction import Outcome
from app.errors import LedgerUnavailable, QueueFull
from app.flight_intents import State
from app.writer import Policy
from tests.ledger.district import SQUARE
from tests.ledger.locations import write_lock
from tests.ledger.process import POLICY, FakeClock, Process, assert_sound, until


def test_a_request_that_is_given_up_while_it_is_planned_does_not_stop_the_writer(square: Process) -> None:
    async def give_up() -> Outcome:
        with write_lock(square.location):
            given_up = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S")))
            last = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("S", "N")))
            await until(lambda: square.writer.waiting == 1)
            given_up.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await given_up
        return await asyncio.wait_for(last, timeout=2)

    assert asyncio.run(give_up()).intent.sequence == 2
    assert square.writer.is_running
    assert_sound(square)


def test_a_request_that_is_given_up_in_the_queue_does_not_stop_the_writer(square: Process) -> None:
    async def give_up() -> Outcome:
        with write_lock(square.location):
            first = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S")))
            given_up = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S")))
            last = asyncio.create_task(square.deconfliction.submit(SQUARE.submission("S", "N")))
            await until(lambda: square.writer.waiting == 2)
            given_up.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await given_up
        await first
        return await asyncio.wait_for(last, timeout=2)

    assert asyncio.run(give_up()).intent.state is State.ACCEPTED
    assert square.writer.is_running
    assert_sound(square)


def test_a_request_to_a_writer_that_has_stopped_is_refused_at_once(square: Process) -> None:
    square.writer.stop()

    async def submit() -> None:
        await asyncio.wait_for(square.deconfliction.submit(SQUARE.submission("N", "S")), timeout=2)

    with pytest.raises(LedgerUnavailable):
        asyncio.run(submit())


def test_stopping_finishes_what_waits(square: Process) -> None:
    async def stop_meanwhile() -> list[Outcome]:
        with write_lock(square.location):
            tasks = [asyncio.create_task(square.deconfliction.submit(SQUARE.submission("N", "S"))) for _ in range(3)]
            await until(lambda: square.writer.waiting == 2)
            stopping = asyncio.create_task(asyncio.to_thread(square.writer.stop))
            await until(lambda: square.writer.waiting == 3)
        await stopping
        return await asyncio.gather(*tasks)

    assert [outcome.intent.sequence for outcome in asyncio.run(stop_meanwhile())] == [1, 2, 3]


def test_a_full_queue_takes_nothing(ledger: str, clock: FakeClock) -> None:
    policy = Policy(POLICY.idempotency_ms, queue_limit=1)
    with Process(ledger, SQUARE.airspace, clock, policy=policy) as process:

        async def overfill() -> list[Outcome]:
            with write_lock(process.location):
                first = asyncio.create_task(process.deconfliction.submit(SQUARE.submission("N", "S")))
                await asyncio.sleep(0)
                await until(lambda: process.writer.waiting == 0)
                second = asyncio.create_task(process.deconfliction.submit(SQUARE.submission("N", "S")))
                await asyncio.sleep(0)
                with pytest.raises(QueueFull, match="1 requests are waiting"):
                    await process.deconfliction.submit(SQUARE.submission("N", "S"))
            return [await first, await second]

        assert [outcome.intent.sequence for outcome in asyncio.run(overfill())] == [1, 2]
        assert len(process.ledger.everything()[0]) == 2
