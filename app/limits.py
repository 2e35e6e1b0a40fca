"""How often each operator may ask: a token bucket for each, in each process."""

import math
from collections.abc import Callable
from dataclasses import dataclass

from app.errors import TooManyRequests

# So many operators may be remembered before those are forgotten whose buckets are full again.
_PRUNED_BEYOND = 1_000


@dataclass
class _Bucket:
    tokens: float
    filled_ms: int


class RateLimit:
    """Lets `burst` requests of an operator pass at once, and `per_s` a second in the long run; for one thread."""

    def __init__(self, per_s: float, burst: int, elapsed_ms: Callable[[], int]) -> None:
        self._per_s = per_s
        self._burst = burst
        self._elapsed_ms = elapsed_ms
        self._buckets: dict[str | None, _Bucket] = {}

    def spend(self, operator: str | None) -> None:
        """Take a request of an operator (None: of whom nobody knows) into account; raises `TooManyRequests`."""
        bucket = self._bucket(operator)
        if bucket.tokens < 1:
            raise self._refusal(operator, bucket)
        bucket.tokens -= 1

    def overdraw(self, operator: str | None, count: int) -> None:
        """Take into account that a request that has passed is worth so many more: the operator waits for them
        afterwards. Raises `TooManyRequests` where it has to wait for others already.
        """
        bucket = self._bucket(operator)
        if bucket.tokens < 0:
            raise self._refusal(operator, bucket)
        bucket.tokens -= count

    def _bucket(self, operator: str | None) -> _Bucket:
        """Return an operator's bucket as it is now."""
        now = self._elapsed_ms()
        bucket = self._buckets.get(operator)
        if bucket is None:
            self._forget_full(now)
            bucket = self._buckets[operator] = _Bucket(self._burst, now)
        bucket.tokens = self._filled(bucket, now)
        bucket.filled_ms = now
        return bucket

    def _refusal(self, operator: str | None, bucket: _Bucket) -> TooManyRequests:
        whose = "" if operator is None else f" of operator {operator!r}"
        return TooManyRequests(
            f"more than {self._per_s:g} requests a second{whose}", math.ceil((1 - bucket.tokens) / self._per_s)
        )

    def _filled(self, bucket: _Bucket, now: int) -> float:
        return min(self._burst, bucket.tokens + (now - bucket.filled_ms) / 1000 * self._per_s)

    def _forget_full(self, now: int) -> None:
        """A full bucket is as good as none."""
        if len(self._buckets) >= _PRUNED_BEYOND:
            self._buckets = {
                operator: bucket
                for operator, bucket in self._buckets.items()
                if self._filled(bucket, now) < self._burst
            }
