"""The viewer's server for tests, as real as `squilla view` runs it, and a line to it."""

import asyncio
import json
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
import uvicorn
from websockets.sync.client import connect

from squilla.live import protocol, server
from squilla.live.guard import GuardedProtocol


@contextmanager
def running(
    *sources: server.Source, token: str | None = None, references: tuple = ()
) -> Iterator[str]:
    """Run a real server on a real port, as `server.serve` does; yields host and port."""
    config = uvicorn.Config(
        server.application(sources, token=token, references=references),
        log_level="critical", lifespan="off", ws=GuardedProtocol,
        ws_max_size=protocol.LARGEST + 4096, ws_per_message_deflate=False,
    )  # fmt: skip
    with server.bind("127.0.0.1", 0) as listening:
        listening.listen()
        host = uvicorn.Server(config)
        thread = threading.Thread(target=lambda: asyncio.run(host.serve([listening])), daemon=True)
        thread.start()
        yield f"127.0.0.1:{listening.getsockname()[1]}"
        host.should_exit = host.force_exit = True
        thread.join(10)


def unpack(message: bytes) -> tuple[dict, np.ndarray | None]:
    """Take a binary answer apart."""
    length = int.from_bytes(message[:4], "little")
    header = json.loads(message[4 : 4 + length])
    if "shape" not in header:
        return header, None
    return header, np.frombuffer(message[4 + length :], "<f4").reshape(header["shape"])


class Line:
    """What the page does, without a page."""

    def __init__(self, address: str, room: int = 1 << 20):
        host, port = address.split(":")
        line = socket.socket()
        line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, room)  # what may lie there unread
        line.connect((host, int(port)))
        self.socket = connect(
            f"ws://{address}/socket",
            origin=f"http://{address}",
            sock=line,
            compression=None,
            max_size=None,
        )
        self.hello, _ = unpack(self.socket.recv())

    def receive(self) -> tuple[dict, np.ndarray | None]:
        """Wait for the next answer."""
        return unpack(self.socket.recv(timeout=60))

    def tell(self, text: str | bytes) -> tuple[dict, np.ndarray | None]:
        """Send anything, and return what comes next."""
        self.socket.send(text)
        return self.receive()

    def ask(self, **message) -> tuple[dict, np.ndarray | None]:
        """Ask, and return what comes next."""
        return self.tell(json.dumps({"id": 7, **message}))
