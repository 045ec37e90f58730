"""The local server: one page, one WebSocket, nothing else.

It trusts nobody. Bound to the machine itself it answers pages of its own origin alone; bound to a
network it also demands a token. No path from a client reaches the file system: the page's files
are read once, by name, when the server is made. What a client may ask is bounded in size and in
number, and so is what it can leave unread.
"""

import asyncio
import json
import secrets
import socket
import time
from collections.abc import Callable, Sequence
from hashlib import sha256
from importlib.resources import files as package_files
from ipaddress import ip_address
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from squilla import __version__
from squilla.errors import InputError
from squilla.live import protocol
from squilla.live.protocol import Control, Picture, Reference, Spectra, Watch

if TYPE_CHECKING:
    from starlette.applications import Starlette
    from starlette.requests import HTTPConnection
    from starlette.websockets import WebSocket

PORT = 8750

_CLIENTS = 16  # pages at a time
_AT_ONCE = 4  # asks of one page that are worked on
_WORKERS = 8  # threads that work on the asks of all pages
_PATIENCE = 20.0  # seconds that a page may leave an answer unread
_POLL = 0.005  # seconds between looks for a newer frame

_KINDS = {
    ".html": "text/html; charset=utf-8",
    ".js": "text/javascript; charset=utf-8",
    ".css": "text/css; charset=utf-8",
    ".svg": "image/svg+xml",
    ".woff2": "font/woff2",
}

_HEADERS = {
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; "
    "font-src 'self'; img-src 'self' blob: data:; connect-src 'self'; base-uri 'none'; "
    "form-action 'none'; frame-ancestors 'none'",
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cache-Control": "no-store",
}


class View(Protocol):
    """What stands still while it is asked: a stored cube, or one frame of a live camera."""

    @property
    def number(self) -> int:
        """Of the frame, increasing."""
        ...

    def picture(self, ask: Picture) -> tuple[np.ndarray, dict[str, Any]]: ...
    def spectra(self, ask: Spectra) -> tuple[np.ndarray, dict[str, Any]]: ...

    def status(self) -> dict[str, Any]:
        """Return what the page shows of the frame; numbers, strings and None."""
        ...


class Source(Protocol):
    """What a page can show. A live one has newer views as time goes on, and takes wishes."""

    def describe(self) -> dict[str, Any]: ...
    def now(self) -> View: ...


class Broken:
    """In the place of a cube that could not be opened: says why."""

    def __init__(self, title: str, reason: str):
        self.title, self.reason = title, reason

    def describe(self) -> dict[str, Any]:
        """Return the title and the reason."""
        return {"title": self.title, "error": self.reason, "live": False}

    def now(self) -> View:
        """Refuse."""
        raise InputError(self.reason)


def application(
    sources: Sequence[Source],
    *,
    references: Sequence[dict[str, Any]] = (),
    token: str | None = None,
) -> "Starlette":
    """Make the application that serves the page and answers for some sources.

    Parameters
    ----------
    sources : sequence of Source
    references : sequence of dict
        Spectra to begin with, as `parse_references` returns them.
    token : str, optional
        Secret that a page must bring; without it only pages on this machine are answered.
    """
    from starlette.applications import Starlette
    from starlette.responses import PlainTextResponse, RedirectResponse, Response
    from starlette.routing import Route, WebSocketRoute

    page = _page()
    # Cookies know no ports: a name of its own keeps two viewers on one machine apart.
    cookie = f"squilla-{sha256((token or '').encode()).hexdigest()[:8]}"

    def welcome(connection: "HTTPConnection") -> bool:
        if token is None:
            return _is_local(connection.headers.get("host", ""))
        return secrets.compare_digest(connection.cookies.get(cookie, ""), token)

    async def serve(request) -> Response:
        given = request.query_params.get("token")
        if token is not None and given is not None and secrets.compare_digest(given, token):
            answer = RedirectResponse("/", 303, _HEADERS)
            answer.set_cookie(cookie, token, httponly=True, samesite="lax")
            return answer
        if not welcome(request):
            told = "This viewer is not open to you. Use the address, with its token, that the "
            return PlainTextResponse(f"{told}terminal printed.\n", 403, _HEADERS)
        name = request.path_params.get("name") or "index.html"
        if name not in page:
            return PlainTextResponse("There is no such page.\n", 404, _HEADERS)
        content, kind = page[name]
        return Response(content, headers=_HEADERS, media_type=kind)

    clients: set[Client] = set()
    workers = asyncio.Semaphore(_WORKERS)

    async def talk(socket: "WebSocket") -> None:
        origin, host = socket.headers.get("origin", ""), socket.headers.get("host", "")
        own = origin in (f"http://{host}", f"https://{host}")
        if not (own and welcome(socket)) or len(clients) >= _CLIENTS:
            await socket.close(1008)
            return
        await socket.accept()
        client = Client(socket, sources, workers)
        clients.add(client)
        try:
            await client.greet(references)
            await client.listen()
        finally:
            clients.discard(client)
            await client.leave()

    return Starlette(
        routes=[
            Route("/", serve),
            WebSocketRoute("/socket", talk),
            Route("/{name}", serve),
        ]
    )


class Client:
    """One open page: reads its messages, works on a few at a time, sends the answers."""

    def __init__(self, socket: "WebSocket", sources: Sequence[Source], workers: asyncio.Semaphore):
        self._socket, self._sources, self._workers = socket, sources, workers
        self._sending = asyncio.Lock()
        self._tasks: set[asyncio.Task] = set()
        self._watch: asyncio.Task | None = None
        self._shown = asyncio.Event()
        self._frame = -1

    async def greet(self, references: Sequence[dict[str, Any]]) -> None:
        """Tell the page what there is."""
        told = [source.describe() for source in self._sources]
        await self._send({"hello": __version__, "sources": told, "references": list(references)})

    async def listen(self) -> None:
        """Answer until the page goes, or does not read what it asked for."""
        while True:
            event = await self._socket.receive()
            if event["type"] == "websocket.disconnect":
                return
            text = event.get("text")
            try:
                message = protocol.read_message(text or "")
            except InputError as error:
                await self._send({"id": _id_of(text), "error": str(error)})
                continue
            if isinstance(message, protocol.Acknowledge):
                if message.frame >= self._frame:
                    self._shown.set()
            elif isinstance(message, Watch):
                await self._stop_watching()
                if message.wanted:
                    self._watch = asyncio.create_task(self._follow(message))
            elif len(self._tasks) >= _AT_ONCE:
                busy = "Still busy with earlier questions; ask again."
                await self._send({"id": message.id, "error": busy, "busy": True})
            else:
                task = asyncio.create_task(self._answer(message))
                self._tasks.add(task)
                task.add_done_callback(self._done)

    async def leave(self) -> None:
        """Drop what is still under way."""
        await self._stop_watching()
        for task in self._tasks:
            task.cancel()

    def _done(self, task: asyncio.Task) -> None:
        self._tasks.discard(task)
        if not task.cancelled():
            task.exception()  # a page that went away in the middle is no fault of ours

    async def _answer(self, message: protocol.Message) -> None:
        await self._send_packed(await self._work(self._reply, message))

    async def _work(self, call: Callable, *arguments: Any) -> Any:
        async with self._workers:
            return await asyncio.to_thread(call, *arguments)

    def _reply(self, message: protocol.Message) -> bytes:
        """Work out an answer; in a thread."""
        try:
            if isinstance(message, Reference):
                from squilla.live.reference import parse_references

                found = parse_references(message.text, message.name)
                return protocol.pack({"id": message.id, "references": found})
            assert isinstance(message, Picture | Spectra | Control)
            source = self._source(message.source)
            if isinstance(message, Control):
                if not hasattr(source, "control"):
                    raise InputError(f"{source.describe()['title']} is no live camera.")
                told = source.control(message.name, message.value)
                return protocol.pack({"id": message.id, "control": told})
            return _asked(source.now(), message)
        except InputError as error:
            return protocol.pack({"id": message.id, "error": str(error)})

    def _source(self, number: int) -> Any:
        if number >= len(self._sources):
            raise InputError(f"There is no cube number {number}.")
        return self._sources[number]

    async def _follow(self, watch: Watch) -> None:
        """Send the answers for the newest frame, wait until they are shown, go on."""
        try:
            source = self._source(watch.source)
            if not source.describe()["live"]:
                raise InputError(f"{source.describe()['title']} never changes.")
            view = await self._work(source.now)  # may wait for the first frame
        except InputError as error:
            await self._send({"id": watch.id, "error": str(error)})
            return
        times: dict[str, float] = {}  # ms, of the frame before
        while True:
            self._frame, seen = view.number, view.number
            self._shown.clear()
            start, sent = time.perf_counter(), 0.0
            for ask in watch.wanted:
                answer = await self._work(_asked, view, ask, {"frame": seen})
                before = time.perf_counter()
                await self._send_packed(answer)
                sent += time.perf_counter() - before
            status = view.status()
            status = status | {"stages": status["stages"] | times}
            await self._send({"frame": seen, "status": status, "last": True})
            answered = time.perf_counter()
            await self._shown.wait()
            shown = time.perf_counter() - answered
            times = {
                "answer": 1000 * (answered - start - sent),
                "send": 1000 * sent,
                "page": 1000 * shown,
            }
            while (view := source.now()).number <= seen:
                await asyncio.sleep(_POLL)

    async def _stop_watching(self) -> None:
        if self._watch is not None:
            self._watch.cancel()
            await asyncio.gather(self._watch, return_exceptions=True)
            self._watch = None

    async def _send(self, header: dict[str, Any]) -> None:
        await self._send_packed(protocol.pack(header))

    async def _send_packed(self, message: bytes) -> None:
        try:
            # Not wait_for: that of Python 3.11 may lose a cancellation, and a dropped watch go on.
            async with self._sending, asyncio.timeout(_PATIENCE):
                await self._socket.send_bytes(message)
        except TimeoutError:
            await self._socket.close(1008)
            raise


def _asked(view: View, ask: Picture | Spectra, more: dict[str, Any] | None = None) -> bytes:
    header: dict[str, Any] = {"id": ask.id, **(more or {})}
    try:
        answer = view.picture if isinstance(ask, Picture) else view.spectra
        values, told = answer(ask)  # pyright: ignore[reportArgumentType]
        return protocol.pack(header | told, values)
    except InputError as error:
        return protocol.pack(header | {"error": str(error)})
    except Exception as error:  # a file that went away or rots; other asks go on
        reason = f"The file could not be read ({type(error).__name__}: {error})."
        return protocol.pack(header | {"error": reason})


def _id_of(text: str | None) -> int:
    """Return the number of a message that is otherwise not understood, 0 if there is none."""
    try:
        number = json.loads(text or "")["id"]
    except (ValueError, TypeError, KeyError):
        return 0
    return number if isinstance(number, int) else 0


def _page() -> dict[str, tuple[bytes, str]]:
    folder = package_files("squilla") / "live" / "page"
    return {
        file.name: (file.read_bytes(), _KINDS[suffix])
        for file in folder.iterdir()
        if (suffix := "." + file.name.rpartition(".")[2]) in _KINDS
    }


def _is_local(host: str) -> bool:
    """Tell whether a Host header names this machine itself; names of others may lead here too."""
    name = host.rsplit(":", 1)[0] if not host.endswith("]") else host
    return name in ("localhost", "127.0.0.1", "[::1]")


# --- running ------------------------------------------------------------------------------------


def is_loopback(host: str) -> bool:
    """Tell whether an address can be reached from this machine alone."""
    try:
        return host == "localhost" or ip_address(host).is_loopback
    except ValueError:
        return False


def bind(host: str, port: int) -> socket.socket:
    """Take a port, or say that it is taken.

    Raises
    ------
    InputError
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    # Named in full, or asyncio lets small answers wait for an acknowledgement of the last, 40 ms.
    taken = socket.socket(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
    taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        taken.bind((host, port))
    except (OSError, OverflowError) as error:
        taken.close()
        raise InputError(
            f"The port {port} of {host} cannot be had ({getattr(error, 'strerror', error)}); "
            "choose another with --port, or 0 for any that is free."
        ) from error
    return taken


def serve(
    sources: Sequence[Source],
    *,
    host: str = "127.0.0.1",
    port: int = PORT,
    references: Sequence[dict[str, Any]] = (),
    ready: Callable[[str], None] = lambda address: None,
) -> None:
    """Serve a page until interrupted.

    Parameters
    ----------
    sources : sequence of Source
    host : str
        Address to bind; one that others can reach demands a token.
    port : int
        0 takes any that is free.
    references : sequence of dict
    ready : callable
        Is told the address, with its token, when the server is about to answer.

    Raises
    ------
    InputError
        If the packages of the extra "live" are missing, or the port is taken.
    """
    try:
        import uvicorn

        from squilla.live.guard import GuardedProtocol
    except ImportError as error:
        raise InputError(
            "The viewer needs starlette, uvicorn and websockets; install them with: "
            "pip install 'squilla[live]'."
        ) from error
    token = None if is_loopback(host) else secrets.token_urlsafe(24)
    app = application(sources, references=references, token=token)
    listening = bind(host, port)
    config = uvicorn.Config(
        app,
        log_level="warning",
        access_log=False,
        server_header=False,
        ws=GuardedProtocol,
        ws_max_size=protocol.LARGEST + 4096,
        ws_per_message_deflate=False,  # ten times slower
        timeout_keep_alive=5,
        limit_concurrency=4 * _CLIENTS,
        timeout_graceful_shutdown=1,
        lifespan="off",
    )
    name = f"[{host}]" if ":" in host else host
    address = f"http://{name}:{listening.getsockname()[1]}/"
    with listening:
        listening.listen(64)
        ready(address if token is None else f"{address}?token={token}")
        uvicorn.Server(config).run(sockets=[listening])
