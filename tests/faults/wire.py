"""A wire between a service and PostgreSQL that breaks around commits."""

import random
import selectors
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from enum import Enum

_CHUNK = 65_536
_COMMIT = b"COMMIT"
# Who has sent more since the last commit has written a flight intent, and not only read or set something.
_WRITTEN = 2_000
_PATIENCE_S = 10.0


class Cut(Enum):
    """When a connection breaks: the server never hears of the commit, or nobody hears what came of it."""

    BEFORE = "before the commit"
    AT = "at the commit"
    AFTER = "after the commit"


class Wire:
    """Passes bytes on between one listening port and a server, each connection in a thread of its own.

    Of all commits of flight intents, so many are cut as `cut_of` says. If it `breaks_down`, nobody gets through after
    the next cut.
    """

    def __init__(self, server: tuple[str, int], chance: random.Random) -> None:
        self._server = server
        self._chance = chance
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._open: set[socket.socket] = set()
        self.cut_of = 0.0
        self.breaks_down = False
        self._is_down = False
        self.cuts: list[Cut] = []

    @property
    def port(self) -> int:
        """Where it listens."""
        return int(self._listener.getsockname()[1])

    def mend(self) -> None:
        """Cut no more, and let connections through again."""
        self.cut_of = 0.0
        self.breaks_down = self._is_down = False

    def run(self) -> None:
        """Accept connections until `close`."""
        while True:
            try:
                client, _ = self._listener.accept()
            except OSError:
                return
            if self._is_down:
                _close(client)
            else:
                threading.Thread(target=self._connect, args=(client,), daemon=True).start()

    def close(self) -> None:
        """Stop listening, and cut all connections."""
        with suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()
        self._hang_up()

    def _connect(self, client: socket.socket) -> None:
        try:
            server = socket.create_connection(self._server, timeout=_PATIENCE_S)
        except OSError:
            _close(client)
            return
        ends = {client, server}
        self._open |= ends
        try:
            with suppress(OSError):
                self._pass_on(client, server)
        finally:
            for end in ends:
                _close(end)
            self._open -= ends

    def _pass_on(self, client: socket.socket, server: socket.socket) -> None:
        """Pass bytes on until an end closes or a commit is cut."""
        with selectors.DefaultSelector() as selector:
            selector.register(client, selectors.EVENT_READ, server)
            selector.register(server, selectors.EVENT_READ, client)
            sent = 0
            while True:
                for key, _ in selector.select():
                    source, target = key.fileobj, key.data
                    assert isinstance(source, socket.socket)
                    content = source.recv(_CHUNK)
                    if not content:
                        return
                    sent += len(content) * (source is client)
                    if source is client and _COMMIT in content:
                        if sent > _WRITTEN and self._chance.random() < self.cut_of:
                            self._cut(content, server)
                            return
                        sent = 0
                    target.sendall(content)

    def _cut(self, content: bytes, server: socket.socket) -> None:
        """Let the connection end here, with the commit or without it."""
        cut = self._chance.choice(list(Cut))
        self.cuts.append(cut)
        if cut is not Cut.BEFORE:
            server.sendall(content)
        if cut is Cut.AFTER:
            server.recv(_CHUNK)
        if self.breaks_down:
            self._is_down = True
            self._hang_up()

    def _hang_up(self) -> None:
        for end in list(self._open):
            _close(end)


@contextmanager
def wire(server: tuple[str, int], chance: random.Random) -> Iterator[Wire]:
    """Lay a wire to a server."""
    laid = Wire(server, chance)
    thread = threading.Thread(target=laid.run, daemon=True)
    thread.start()
    try:
        yield laid
    finally:
        laid.close()
        thread.join()


def _close(end: socket.socket) -> None:
    with suppress(OSError):
        end.shutdown(socket.SHUT_RDWR)
    end.close()
