"""Asking a ledger that may not answer."""

import asyncio
from concurrent.futures import Future
from contextlib import suppress
from threading import Thread

import structlog

from app.errors import LedgerUnavailable
from app.ledger import Ledger

log = structlog.get_logger()

_PATIENCE_S = 2.0


class LedgerProbe:
    """Reads the newest revision for health checks: never for long, and never with more than one thread.

    The thread is none of those that serve requests, which a ledger that hangs may hold all; and a process may end
    while it waits.
    """

    def __init__(self, ledger: Ledger, patience_s: float = _PATIENCE_S) -> None:
        self._ledger = ledger
        self._patience_s = patience_s
        self._asked: Future[int] | None = None

    async def revision(self) -> int:
        """Return the ledger's newest revision; `LedgerUnavailable` if it cannot be read, or not in time.

        Why it cannot be read is only logged: health is everybody's to see, and where the ledger is is not.
        """
        if self._asked is None or self._asked.done():
            asked: Future[int] = Future()
            Thread(target=self._ask, args=(asked,), name="ledger-probe", daemon=True).start()
            self._asked = asked
        try:
            # Shielded: who asks next waits for the same answer.
            return await asyncio.wait_for(asyncio.shield(asyncio.wrap_future(self._asked)), self._patience_s)
        except TimeoutError:
            raise LedgerUnavailable(
                f"the ledger cannot be read: it has not answered within {self._patience_s:g} s"
            ) from None

    def _ask(self, asked: "Future[int]") -> None:
        try:
            asked.set_result(self._ledger.revision())
        except LedgerUnavailable as error:
            with suppress(OSError, ValueError):
                log.warning("the ledger did not answer a health check", error=str(error))
            asked.set_exception(LedgerUnavailable("the ledger cannot be read"))
        except Exception as error:
            asked.set_exception(error)
