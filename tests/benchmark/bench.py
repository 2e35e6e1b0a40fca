"""`make bench`: time the planner, alone and beside others; see README.md in this folder."""

import argparse
import platform
from collections.abc import Callable
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path

import numba
import numpy as np

from planner.warm_up import warm_up
from tests.benchmark import city, committed, intents, measuring, peers, together

PARTS: dict[str, Callable[[int], None]] = {
    "intents": intents.measure,
    "committed": committed.measure,
    "city": city.measure,
    "peers": peers.measure,
    "together": together.measure,
}


def main() -> None:
    """Run the chosen parts, by default all."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="part", help=f"{', '.join(PARTS)}; default: all")
    parser.add_argument("--repeat", type=int, default=3, help="runs of each row, whose median is shown; default: 3")
    options = parser.parse_args()
    if unknown := sorted(set(options.parts) - set(PARTS)):
        parser.error(f"unknown part {unknown[0]!r}; there are {', '.join(PARTS)}")
    if options.repeat < 1:
        parser.error("--repeat must be at least 1")
    warm_up()
    measuring.show(_header(options.repeat))
    for name, measure in PARTS.items():
        if not options.parts or name in options.parts:
            measure(options.repeat)


def _header(repeat: int) -> str:
    versions = f"Python {platform.python_version()}, numba {numba.__version__}, numpy {np.__version__}"
    return (
        f"{datetime.now(UTC).date()}, {_processor()}, one core, {platform.system()}; airmatrix {version('airmatrix')}, "
        f"{versions}; median of {repeat} runs"
    )


def _processor() -> str:
    cpus = Path("/proc/cpuinfo")
    lines = cpus.read_text().splitlines() if cpus.exists() else []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


if __name__ == "__main__":
    main()
