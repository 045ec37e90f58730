"""The viewer's server for tests, as real as `squilla view` runs it."""

import asyncio
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import uvicorn

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
