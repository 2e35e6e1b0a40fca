"""Every setting of the service, in one object that is passed in. Each is also an ``AIRMATRIX_*`` variable."""

from ipaddress import ip_network
from pathlib import Path
from typing import Annotated, Literal

from pydantic import AfterValidator, Field, model_validator
from pydantic_settings import BaseSettings, SettingsConfigDict

from app.times import Timestamp, parse_time
from planner.cfa_star import Search

# A day: no hover and no ground hold is longer.
_LONGEST_S = 86_400.0
# An hour: clocks of servers on one ledger differ by less.
_SHORTEST_RETENTION_DAYS = 1 / 24
# Even the fastest clock takes years from there to the last year that can be named.
_LATEST_CLOCK_START_MS = parse_time("2999-12-31T23:59:59.999Z")


def _proxies(text: str) -> str:
    """Check that these are addresses and networks; a name, or `*` for everybody, is none."""
    for part in text.split(",") if text else ():
        ip_network(part.strip())
    return text


Proxies = Annotated[str, AfterValidator(_proxies)]


class Settings(BaseSettings):
    """Frozen; unknown ``AIRMATRIX_*`` variables are ignored, malformed ones refused."""

    model_config = SettingsConfigDict(env_prefix="AIRMATRIX_", frozen=True, extra="ignore")

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=0, le=65535)] = 8000
    ledger: str = "airmatrix.sqlite"
    airspace: Path | None = None
    aircraft_types: Path | None = None
    workers: Annotated[int, Field(ge=1, le=64)] = 1
    read_only: bool = False

    search: Search = Search.SAFE_INTERVAL
    hover_limit_s: Annotated[float, Field(gt=0, le=_LONGEST_S)] = 60.0
    # How much longer than without traffic a flight may be in the air.
    detour_limit_s: Annotated[float, Field(gt=0, le=_LONGEST_S)] = 300.0
    most_expansions: Annotated[int, Field(ge=1)] = 300_000
    # How long a path may last that an operator brings.
    path_limit_s: Annotated[float, Field(gt=0, le=_LONGEST_S)] = 3_600.0
    ground_hold_s: Annotated[float, Field(ge=0, le=_LONGEST_S)] = 300.0
    # So long before its departure a flight is no longer moved for others.
    notice_s: Annotated[float, Field(ge=0, le=_LONGEST_S)] = 60.0
    # So long before its departure a flight may be activated, which is no longer moved either; without it, at any time.
    activation_lead_s: Annotated[float, Field(ge=0, le=_LONGEST_S)] | None = None
    # From so soon on a flight in the air can be planned anew.
    replan_lead_s: Annotated[float, Field(ge=0, le=600)] = 5.0
    horizon_days: Annotated[float, Field(gt=0, le=60)] = 30.0
    idempotency_hours: Annotated[float, Field(gt=0, le=24 * 365)] = 24.0
    # Without it, nothing is ever removed.
    retention_days: Annotated[float, Field(ge=_SHORTEST_RETENTION_DAYS, le=36_500)] | None = None

    # Older than this, a newest position says nothing any more.
    freshness_s: Annotated[float, Field(gt=0, le=3_600)] = 5.0
    # How much earlier or later than its reservations an aircraft may be.
    tolerance_s: Annotated[float, Field(ge=0, le=3_600)] = 2.0
    contingent_after_s: Annotated[float, Field(gt=0, le=_LONGEST_S)] = 30.0
    # How far ahead a deviating flight is looked after.
    projection_s: Annotated[float, Field(gt=0, le=3_600)] = 60.0
    # How often a process looks at the air.
    monitor_every_s: Annotated[float, Field(ge=0.1, le=3_600)] = 1.0
    telemetry_hours: Annotated[float, Field(gt=0, le=24 * 365)] = 1.0

    # For demonstrations and tests only: a clock that is set, and may run faster than time.
    clock_start: Annotated[Timestamp, Field(le=_LATEST_CLOCK_START_MS)] | None = None
    clock_rate: Annotated[float, Field(gt=0, le=1_000)] = 1.0

    queue_limit: Annotated[int, Field(ge=1)] = 1024
    max_body_bytes: Annotated[int, Field(ge=1024)] = 64 * 1024
    # Of a flight intent, which may bring a path of thousands of entries.
    max_intent_bytes: Annotated[int, Field(ge=1024)] = 1024 * 1024
    max_telemetry_bytes: Annotated[int, Field(ge=1024)] = 2 * 1024 * 1024
    max_batch_bytes: Annotated[int, Field(ge=1024)] = 1024 * 1024

    # How long a request's head may take to arrive, and then its body; and how soon some of an answer must be read.
    head_timeout_s: Annotated[float, Field(gt=0, le=3_600)] = 10.0
    body_timeout_s: Annotated[float, Field(gt=0, le=3_600)] = 10.0
    send_timeout_s: Annotated[float, Field(gt=0, le=3_600)] = 10.0
    # Of one process.
    max_connections: Annotated[int, Field(ge=1, le=100_000)] = 1_000
    max_streams: Annotated[int, Field(ge=1, le=100_000)] = 200
    # Addresses or networks, with commas between them, that say for whom and by which protocol they ask.
    trusted_proxies: Proxies = ""

    # Where the public keys of tokens are: a file's path or an address. Without it there is no authentication.
    jwks: Annotated[str, Field(min_length=1)] | None = None
    audience: Annotated[str, Field(min_length=1)] = "airmatrix"
    issuer: Annotated[str, Field(min_length=1)] | None = None
    # How often an address is asked for keys; a file is read again when it changes.
    jwks_refresh_s: Annotated[float, Field(ge=1, le=_LONGEST_S)] = 300.0
    # How far the clocks of issuers may be off.
    leeway_s: Annotated[float, Field(ge=0, le=300)] = 5.0
    allow_unauthenticated: bool = False

    # Of each operator: requests that plan or change flight intents, by each process; flight intents that are not over.
    rate_per_s: Annotated[float, Field(gt=0, le=1_000_000)] | None = None
    rate_burst: Annotated[int, Field(ge=1, le=1_000_000)] = 20
    open_intents_limit: Annotated[int, Field(ge=1)] | None = None

    # Whether webhooks may lead to addresses that are not public.
    webhook_allow_private: bool = False

    log_format: Literal["console", "json"] = "console"
    log_level: Literal["debug", "info", "warning", "error"] = "info"

    @model_validator(mode="after")
    def _keys_do_not_outlive_intents(self) -> "Settings":
        if self.retention_days is not None and self.retention_days * 24 < self.idempotency_hours:
            raise ValueError(
                f"retention_days ({self.retention_days:g}) is shorter than idempotency_hours "
                f"({self.idempotency_hours:g}); shorten AIRMATRIX_IDEMPOTENCY_HOURS too"
            )
        return self

    @classmethod
    def given(cls, **options: object) -> "Settings":
        """Return settings where the options that are not None win over the environment."""
        return cls.model_validate({name: value for name, value in options.items() if value is not None})
