"""A service whose clock runs many times as fast as time: days of traffic in minutes."""

import sys
import time
from pathlib import Path

import uvicorn

from app import logs
from app.main import create_app
from app.settings import Settings
from app.times import now_ms


def main() -> None:
    """Serve the shipped airspace from `folder` on `port`, `rate` seconds a second."""
    folder, port, rate = Path(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
    began, start_ms = time.monotonic(), now_ms()

    def fast_clock() -> int:
        return start_ms + int((time.monotonic() - began) * rate * 1000)

    settings = Settings(
        ledger=str(folder / "soak.sqlite"), retention_days=1 / 24, idempotency_hours=1, log_level="warning"
    )
    logs.configure(settings)
    app = create_app(settings, fast_clock, elapsed_ms=fast_clock)
    uvicorn.run(app, port=port, log_config=None, access_log=False)


if __name__ == "__main__":
    main()
