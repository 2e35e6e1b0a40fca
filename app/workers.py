"""Several processes of one service: started together, watched, replaced when they die, stopped together.

Workers are spawned, so each has threads, connections and compiled code of its own. Every second a worker tells its
parent that it lives. One that falls silent is killed: frozen in the middle of a transaction, it would hold the write
lock of all. A worker whose parent is gone ends by itself.
"""

import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnProcess
from pathlib import Path

import structlog

from app.errors import StartupError

log = structlog.get_logger()

Work = Callable[[Callable[[], None]], None]

_PULSE_S = 1.0
# Nothing that a worker does keeps all of its threads from running for longer.
_SILENCE_S = 20.0
# Until the first pulse there is more to load, and many may be loading at once.
_FIRST_PULSE_S = 120.0
# What a worker may take to finish its requests and close its ledger.
_STOP_S = 9.0
# Before another try at a worker that died while it started, although others had started well before.
_AGAIN_S = 2.0

_spawning = multiprocessing.get_context("spawn")


@dataclass(eq=False)
class _Worker:
    process: SpawnProcess
    pulse: Connection
    heard: float
    may_be_silent_s: float = _FIRST_PULSE_S
    ready: bool = False


class Workers:
    """`count` processes that each run `work`, which is pickled and is given a function to call once it is ready."""

    def __init__(self, count: int, work: Work, *, silence_s: float = _SILENCE_S, stop_s: float = _STOP_S) -> None:
        self._count = count
        self._work = work
        self._silence_s = silence_s
        self._stop_s = stop_s
        self._workers: list[_Worker] = []
        self._due: list[float] = []
        self._announced = False

    def run(
        self,
        on_ready: Callable[[], None],
        on_death: Callable[[int], None] = lambda _: None,
        on_stop: Callable[[], None] = lambda: None,
    ) -> signal.Signals:
        """Run the workers until SIGTERM or SIGINT comes, stop them, and return which it was. For the main thread.

        `on_ready` is called when all are ready for the first time, `on_death` with the process id of each that died,
        `on_stop` before they are stopped. Raises `StartupError` if one dies before all are ready.
        """
        self._due = [time.monotonic()] * self._count
        # Left to the first start, this would unblock what is blocked around it.
        resource_tracker.ensure_running()
        with _caught(signal.SIGTERM, signal.SIGINT) as caught:
            try:
                while True:
                    self._start_due()
                    self._listen(caught)
                    if (number := _signal_in(caught)) is not None:
                        return number
                    self._kill_the_silent()
                    self._bury_the_dead(on_death)
                    if not self._announced and all(worker.ready for worker in self._workers):
                        self._announced = True
                        on_ready()
            finally:
                on_stop()
                self._stop()

    def _start_due(self) -> None:
        now = time.monotonic()
        _let_go_of_a_broken_stderr()
        starting, self._due = [due for due in self._due if due <= now], [due for due in self._due if due > now]
        for _ in starting:
            try:
                self._workers.append(_start(self._work))
            except OSError as error:
                if not self._announced:
                    raise StartupError(f"cannot start a worker: {error.strerror}") from error
                _tell(log.critical, "no worker could be started", error=error.strerror)
                self._due.append(now + _AGAIN_S)

    def _listen(self, caught: int) -> None:
        """Wait until a worker says something or dies, or a signal comes, or some time has passed."""
        sources = [source for worker in self._workers for source in (worker.pulse, worker.process.sentinel)]
        began = time.monotonic()
        multiprocessing.connection.wait([*sources, caught], timeout=_PULSE_S / 2)
        if time.monotonic() - began > 2 * _PULSE_S:
            # This process stood still itself, as after Ctrl-Z, and perhaps all did: nobody is known to be silent.
            for worker in self._workers:
                worker.heard = time.monotonic()
        for worker in self._workers:
            # The pipe of a dead worker ends.
            with suppress(EOFError):
                while worker.pulse.poll():
                    self._hear(worker, ready=worker.pulse.recv())

    def _hear(self, worker: _Worker, *, ready: bool) -> None:
        if ready and not worker.ready:
            _tell(log.info, "worker is ready", worker=worker.process.pid)
        worker.ready = ready
        worker.heard, worker.may_be_silent_s = time.monotonic(), self._silence_s

    def _kill_the_silent(self) -> None:
        for worker in self._workers:
            silent_s = time.monotonic() - worker.heard
            if silent_s > worker.may_be_silent_s:
                _tell(
                    log.critical,
                    "worker is silent and is killed",
                    worker=worker.process.pid,
                    silent_s=round(silent_s, 1),
                )
                worker.process.kill()
                worker.process.join()

    def _bury_the_dead(self, on_death: Callable[[int], None]) -> None:
        for worker in [worker for worker in self._workers if worker.process.exitcode is not None]:
            pid, status = worker.process.pid, worker.process.exitcode
            assert pid is not None
            if not self._announced:
                raise StartupError(f"worker {pid} could not start; it ended with status {status}, its reason is above")
            _tell(log.critical, "worker died, another one is started", worker=pid, status=status)
            self._workers.remove(worker)
            worker.pulse.close()
            on_death(pid)
            self._due.append(time.monotonic() + (0.0 if worker.ready else _AGAIN_S))

    def _stop(self) -> None:
        for worker in self._workers:
            worker.process.terminate()
        until = time.monotonic() + self._stop_s
        for worker in self._workers:
            worker.process.join(max(until - time.monotonic(), 0.0))
            if worker.process.exitcode is None:
                _tell(log.critical, "worker does not stop and is killed", worker=worker.process.pid)
                worker.process.kill()
                worker.process.join()
            worker.pulse.close()
        self._workers.clear()


def _start(work: Work) -> _Worker:
    """Start a process; raises `OSError` where the system has no room for one more."""
    pulse, other_end = _spawning.Pipe(duplex=False)
    with closing(other_end):
        process = _spawning.Process(target=_run, args=(work, other_end))
        # Interrupting from a terminal reaches every process, but it is for the parent to stop its workers.
        signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
        try:
            process.start()
        finally:
            signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})
    return _Worker(process, pulse, heard=time.monotonic())


def _tell(say: Callable[..., object], event: str, **details: object) -> None:
    """Log an event; a log that cannot be written (its disk is full, its reader gone) stops nobody."""
    with suppress(OSError, ValueError):
        say(event, **details)


@contextmanager
def _caught(*numbers: signal.Signals) -> Iterator[int]:
    """Yield a descriptor from which the numbers of these signals can be read, one a byte, instead of dying of them."""
    reader, writer = os.pipe()
    os.set_blocking(reader, False)
    os.set_blocking(writer, False)
    before_fd = signal.set_wakeup_fd(writer)
    before = {number: signal.signal(number, lambda *_: None) for number in numbers}
    try:
        yield reader
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        signal.set_wakeup_fd(before_fd)
        os.close(reader)
        os.close(writer)


def _signal_in(caught: int) -> signal.Signals | None:
    try:
        return signal.Signals(os.read(caught, 1)[0])
    except BlockingIOError:
        return None


def _let_go_of_a_broken_stderr() -> None:
    """If nobody reads the log any more, write it nowhere: starting a process flushes stderr, and would fail."""
    try:
        sys.stderr.flush()
    except (OSError, ValueError):
        sys.stderr = Path(os.devnull).open("w", encoding="utf-8")  # noqa: SIM115


def _run(work: Work, pulse: Connection) -> None:
    """Run in a worker process."""
    ready = threading.Event()
    for task, arguments in ((_end_with_parent, ()), (_beat, (pulse, ready))):
        threading.Thread(target=task, args=arguments, daemon=True).start()
    work(ready.set)


def _beat(pulse: Connection, ready: threading.Event) -> None:
    with closing(pulse), suppress(OSError):
        while True:
            is_ready = ready.is_set()
            pulse.send(is_ready)
            if is_ready:
                time.sleep(_PULSE_S)
            else:
                ready.wait(_PULSE_S)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    _tell(log.critical, "the parent process is gone, so this worker ends")
    os.kill(os.getpid(), signal.SIGTERM)
    time.sleep(_STOP_S)
    os._exit(1)
