"""`airmatrix demo`: it shows everything and leaves nothing."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx
import pytest

from app.client import Client
from tests.cli.serving import AIRMATRIX, environment

pytestmark = pytest.mark.compiled

PATIENCE_S = 90.0


@dataclass(frozen=True)
class Demo:
    """A running demonstration, in a folder of its own; the service's files lie in `temporary`."""

    process: "subprocess.Popen[bytes]"
    folder: Path
    temporary: Path

    @property
    def out(self) -> str:
        return (self.folder / "out").read_text(encoding="utf-8")

    @property
    def err(self) -> str:
        return (self.folder / "err").read_text(encoding="utf-8")

    @property
    def url(self) -> str:
        """Where the console is, once it is said."""
        until = time.monotonic() + PATIENCE_S
        while "console" not in self.out:
            assert self.process.poll() is None, self.err
            assert time.monotonic() < until
            time.sleep(0.001)
        (row,) = [line for line in self.out.splitlines() if "console" in line]
        return row.strip("│ ").split()[-1]

    def assert_nothing_is_left(self, url: str) -> None:
        """Assert that the service and its files are gone."""
        with pytest.raises(httpx.ConnectError):
            httpx.get(url)
        assert list(self.temporary.iterdir()) == []


@contextmanager
def demonstrating(folder: Path, town_file: Path, *options: object, **variables: str) -> Iterator[Demo]:
    """Run a demonstration of the town in a process group of its own, on any port; it is killed in the end."""
    temporary, here = folder / "temporary", folder / "here"
    temporary.mkdir()
    here.mkdir()
    variables = {"AIRMATRIX_AIRSPACE": str(town_file), "TMPDIR": str(temporary), **variables}
    command = [str(AIRMATRIX), "demo", "--port", "0", "--flights", "6", "--rate", "20", *map(str, options)]
    with (folder / "out").open("wb") as out, (folder / "err").open("wb") as err:
        process = subprocess.Popen(
            command, cwd=here, env=environment(**variables), stdout=out, stderr=err, start_new_session=True
        )
    try:
        yield Demo(process, folder, temporary)
    finally:
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()


def wait_for_aircraft(url: str) -> None:
    """Wait until something flies."""
    until = time.monotonic() + PATIENCE_S
    with Client(url) as client:
        while not any(item.position and item.position.airborne for item in client.flights().items):
            assert time.monotonic() < until
            time.sleep(0.05)


def test_it_serves_a_console_and_traffic_that_flies_until_ctrl_c_and_leaves_nothing(
    tmp_path: Path, town_file: Path
) -> None:
    with demonstrating(tmp_path, town_file) as demo:
        url = demo.url
        wait_for_aircraft(url)
        with Client(url) as client:
            clock = client.alerts().clock
        assert (clock.rate, clock.simulated) == (20.0, True)
        assert f"{url}/docs" in demo.out
        # As a terminal does it: everybody in the group gets it.
        os.killpg(demo.process.pid, signal.SIGINT)
        assert demo.process.wait(PATIENCE_S) == 130
        demo.assert_nothing_is_left(url)
        assert demo.err.startswith("demo: stopped, nothing is left; ")
        assert len(demo.err.splitlines()) == 1


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_to_it_alone_leaves_nothing_either(tmp_path: Path, town_file: Path, number: signal.Signals) -> None:
    with demonstrating(tmp_path, town_file) as demo:
        url = demo.url
        demo.process.send_signal(number)
        assert demo.process.wait(PATIENCE_S) == 0
        demo.assert_nothing_is_left(url)


def test_interrupted_while_it_starts_it_leaves_nothing(tmp_path: Path, town_file: Path) -> None:
    with demonstrating(tmp_path, town_file) as demo:
        until = time.monotonic() + PATIENCE_S
        while not list(demo.temporary.iterdir()):
            assert time.monotonic() < until
        os.killpg(demo.process.pid, signal.SIGINT)
        assert demo.process.wait(PATIENCE_S) == 130
        assert (demo.out, demo.err) == ("", "")
        assert list(demo.temporary.iterdir()) == []


def test_it_goes_on_with_new_flights_for_as_long_as_it_shall(tmp_path: Path, town_file: Path) -> None:
    with demonstrating(tmp_path, town_file, "--rate", 50, "--duration", 6) as demo:
        url = demo.url
        with Client(url) as client:
            sequences = 0
            while demo.process.poll() is None and sequences <= 6:
                sequences = max((event.sequence or 0 for event in client.events().items), default=0)
                time.sleep(0.05)
        assert sequences > 6
        assert demo.process.wait(PATIENCE_S) == 0
        demo.assert_nothing_is_left(url)


def test_settings_of_the_user_do_not_reach_it(tmp_path: Path, town_file: Path) -> None:
    settings = {
        "AIRMATRIX_READ_ONLY": "true", "AIRMATRIX_LEDGER": str(tmp_path / "mine.sqlite"), "AIRMATRIX_WORKERS": "3",
        "AIRMATRIX_CLOCK_START": "1999-01-01T00:00:00Z", "AIRMATRIX_LOG_LEVEL": "error",
    }  # fmt: skip
    with demonstrating(tmp_path, town_file, **settings) as demo:
        wait_for_aircraft(demo.url)
        assert not (tmp_path / "mine.sqlite").exists()
        assert list((tmp_path / "here").iterdir()) == []


def test_a_port_in_use_is_refused(tmp_path: Path, town_file: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with demonstrating(tmp_path, town_file, "--port", port) as demo:
            assert demo.process.wait(PATIENCE_S) == 2
            assert demo.out == ""
            assert demo.err.strip() == (
                f"error: cannot listen on 127.0.0.1:{port}: Address already in use; choose another with --port"
            )
            assert list(demo.temporary.iterdir()) == []


def test_a_service_that_dies_ends_it(tmp_path: Path, town_file: Path) -> None:
    with demonstrating(tmp_path, town_file) as demo:
        url = demo.url
        (service,) = Path(f"/proc/{demo.process.pid}/task/{demo.process.pid}/children").read_text().split()
        os.kill(int(service), signal.SIGKILL)
        assert demo.process.wait(PATIENCE_S) == 2
        assert "error: the service has ended" in demo.err
        demo.assert_nothing_is_left(url)
