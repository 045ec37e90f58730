"""The WebSocket of uvicorn, deaf to those who would fill its memory."""

from uvicorn.protocols.websockets.websockets_sansio_impl import WebSocketsSansIOProtocol

_PIECES = 256
"""Frames that one message may come in."""


class GuardedProtocol(WebSocketsSansIOProtocol):
    """Leaves out two holes: pongs for one who does not read, and messages in endless pieces."""

    def handle_ping(self) -> None:
        """Answer a ping unless earlier answers lie unread; then the connection is ended."""
        if self.writable.is_set():
            super().handle_ping()
        else:
            self.transport.abort()

    def handle_cont(self, event) -> None:
        """Take a further piece of a message."""
        if len(self.frames) < _PIECES:
            super().handle_cont(event)
        else:
            self.transport.abort()
