"""A running application behind a socket, for those who care how bytes get to it."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn
from fastapi import FastAPI

from app.commands.serve import configuration
from app.settings import Settings


@contextmanager
def listening(app: FastAPI, settings: Settings) -> Iterator[int]:
    """Serve an application on loopback as `airmatrix serve` does; yield the port, which is any free one."""
    server = uvicorn.Server(configuration(app, settings))
    with socket.create_server(("127.0.0.1", 0)) as listener:
        thread = threading.Thread(target=server.run, kwargs={"sockets": [listener]})
        thread.start()
        try:
            # Its first kernels may have to be compiled, which no limit of a test should include.
            while not server.started and thread.is_alive():
                thread.join(0.01)
            yield listener.getsockname()[1]
        finally:
            server.should_exit = True
            thread.join()
