"""A receiver of webhooks on this machine that answers as it is told, and what it has received."""

import json
import ssl
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

Event = dict[str, Any]


@dataclass(frozen=True)
class Delivery:
    """One POST: its headers, its body as it came, and what is in it."""

    headers: dict[str, str]
    content: bytes

    @property
    def parsed(self) -> dict[str, Any]:
        parsed: dict[str, Any] = json.loads(self.content)
        return parsed

    @property
    def event(self) -> Event:
        event: Event = self.parsed["event"]
        return event


@dataclass
class Receiver:
    """Answers with what `verdict` says of an event: a status, or None for no answer before `release`."""

    url: str = ""
    verdict: Callable[[Event], int | None] = lambda _: 204
    deliveries: list[Delivery] = field(default_factory=list)
    released: threading.Event = field(default_factory=threading.Event)

    @property
    def kinds(self) -> list[str]:
        """What has happened, in the order of the deliveries."""
        return [delivery.event["kind"] for delivery in self.deliveries]

    @property
    def told(self) -> list[tuple[int, str]]:
        """Sequence numbers and kinds, in the order of the deliveries."""
        return [(delivery.event["sequence"], delivery.event["kind"]) for delivery in self.deliveries]


@contextmanager
def receiving(certificates: ssl.SSLContext | None = None) -> Iterator[Receiver]:
    """Run a receiver on loopback; with `certificates`, over TLS under the name localhost."""
    receiver = Receiver()

    class Handler(BaseHTTPRequestHandler):
        def do_POST(self) -> None:
            delivery = Delivery(dict(self.headers), self.rfile.read(int(self.headers["Content-Length"])))
            receiver.deliveries.append(delivery)
            status = receiver.verdict(delivery.event)
            if status is None:
                receiver.released.wait(30)
                return
            self.send_response(status)
            if 300 <= status < 400:
                self.send_header("Location", receiver.url)
            self.send_header("Content-Length", "0")
            self.end_headers()

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    class Server(ThreadingHTTPServer):
        def handle_error(self, *_: object) -> None:
            """Whoever gave up in the middle is none of our business."""

    with Server(("127.0.0.1", 0), Handler) as server:
        host, port = "127.0.0.1", server.server_address[1]
        if certificates is not None:
            server.socket = certificates.wrap_socket(server.socket, server_side=True)
            host = "localhost"
        receiver.url = f"http{'' if certificates is None else 's'}://{host}:{port}/events?of=us"
        thread = threading.Thread(target=server.serve_forever, kwargs={"poll_interval": 0.02})
        thread.start()
        try:
            yield receiver
        finally:
            receiver.released.set()
            server.shutdown()
            thread.join()
