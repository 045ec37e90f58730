"""A headless Chromium, driven by its own DevTools protocol over a WebSocket: no driver needed."""

import base64
import json
import os
import shutil
import subprocess
import tempfile
import time
from pathlib import Path
from types import TracebackType

from websockets.sync.client import connect

NAMES = ("chromium", "chromium-browser", "google-chrome", "chrome", "microsoft-edge")
FLAGS = [
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run",
    "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-extensions", "--hide-scrollbars", "--force-color-profile=srgb",
]  # fmt: skip
MISSING = (
    "needs a browser: install Chromium (on Debian: apt-get install chromium), or name one with "
    "the variable CHROMIUM"
)


def find() -> str | None:
    """Return the browser of this machine, or None."""
    return os.environ.get("CHROMIUM") or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """One browser process; use it in a ``with``."""

    def __enter__(self) -> "Browser":
        self.home = tempfile.mkdtemp(prefix="squilla-browser-")
        command = [
            find() or "",
            *FLAGS,
            "--remote-debugging-port=0",
            f"--user-data-dir={self.home}",
        ]
        self.process = subprocess.Popen(
            [*command, "about:blank"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        told = Path(self.home) / "DevToolsActivePort"
        for _ in range(1500):
            if told.exists() and len(told.read_text().split()) == 2:
                break
            assert self.process.poll() is None, "the browser ended at once"
            time.sleep(0.02)
        port, path = told.read_text().split()
        self.socket = connect(f"ws://127.0.0.1:{port}{path}", max_size=None, compression=None)
        self.last = 0
        self.events: list[dict] = []
        return self

    def __exit__(
        self, kind: type | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.socket.close()
        self.process.kill()
        self.process.wait()
        shutil.rmtree(self.home, ignore_errors=True)

    def send(self, method: str, session: str | None = None, **parameters: object) -> dict:
        """Call a method of the protocol and return its result."""
        self.last += 1
        message = {"id": self.last, "method": method, "params": parameters}
        self.socket.send(json.dumps(message | ({"sessionId": session} if session else {})))
        while True:
            answer = json.loads(self.socket.recv(timeout=30))
            if answer.get("id") == self.last:
                assert "error" not in answer, f"{method}: {answer['error']}"
                return answer["result"]
            self.events.append(answer)

    def page(self, width: int = 1280, height: int = 720, **how: bool) -> "Page":
        """Open an empty page of a size, px; `dark`, `phone`."""
        return Page(self, width, height, **how)


class Page:
    """One page of the browser."""

    def __init__(
        self, browser: Browser, width: int, height: int, *, dark: bool = False, phone: bool = False
    ):
        self.browser = browser
        target = browser.send("Target.createTarget", url="about:blank")["targetId"]
        attached = browser.send("Target.attachToTarget", targetId=target, flatten=True)
        self.target, self.session = target, attached["sessionId"]
        self.send("Page.enable")
        self.send("Runtime.enable")
        self.send(
            "Emulation.setDeviceMetricsOverride",
            width=width, height=height, deviceScaleFactor=2 if phone else 1, mobile=phone,
        )  # fmt: skip
        if phone:
            self.send("Emulation.setTouchEmulationEnabled", enabled=True)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.send("Emulation.setEmulatedMedia", features=[scheme])

    def send(self, method: str, **parameters: object) -> dict:
        """Call a method of the protocol on this page."""
        return self.browser.send(method, self.session, **parameters)

    def open(self, address: str) -> None:
        """Go to an address."""
        self.send("Page.navigate", url=address)

    def close(self) -> None:
        """Close the page."""
        self.browser.send("Target.closeTarget", targetId=self.target)

    def js(self, expression: str) -> object:
        """Return the value of an expression, awaited if it is a promise."""
        answer = self.send(
            "Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True
        )
        assert "exceptionDetails" not in answer, answer["exceptionDetails"]
        return answer["result"].get("value")

    def wait(self, expression: str, seconds: float = 60.0) -> object:
        """Wait until an expression is true, and return its value."""
        end = time.monotonic() + seconds
        while not (value := self.js(expression)):
            assert time.monotonic() < end, f"never true: {expression}; {self.complaints()}"
            time.sleep(0.02)
        return value

    def complaints(self) -> list[str]:
        """Return what the page threw or wrote as an error."""
        self.js("0")  # fetches what is under way
        found = []
        for event in self.browser.events:
            told = event.get("params", {})
            if event.get("sessionId") != self.session:
                continue
            if event["method"] == "Runtime.exceptionThrown":
                details = told["exceptionDetails"]
                found.append(details.get("exception", details).get("description", str(details)))
            if event["method"] == "Runtime.consoleAPICalled" and told["type"] == "error":
                found.append(str([each.get("value") for each in told["args"]]))
        return found

    def place(self, selector: str) -> tuple[float, float, float, float]:
        """Return left, top, width and height of an element, px."""
        box = self.js(
            f"(({{x, y, width, height}}) => [x, y, width, height])"
            f"(document.querySelector({json.dumps(selector)}).getBoundingClientRect())"
        )
        assert isinstance(box, list)
        return box[0], box[1], box[2], box[3]

    def click(self, selector: str) -> None:
        """Click the middle of an element."""
        left, top, width, height = self.place(selector)
        self.drag([(left + width / 2, top + height / 2)])

    def drag(self, path: list[tuple[float, float]]) -> None:
        """Press the mouse at the first place, move it along a path, let go: one place, a click."""
        mouse = {"button": "left", "buttons": 1, "clickCount": 1}
        for kind, (x, y) in [
            ("mouseMoved", path[0]), ("mousePressed", path[0]),
            *(("mouseMoved", each) for each in path[1:]), ("mouseReleased", path[-1]),
        ]:  # fmt: skip
            self.send("Input.dispatchMouseEvent", type=kind, x=x, y=y, **mouse)

    def key(self, key: str, *, shift: bool = False) -> None:
        """Press a key."""
        codes = {"Enter": 13, "ArrowUp": 38, "ArrowDown": 40, "ArrowLeft": 37, "ArrowRight": 39}
        text = {"Enter": "\r"}.get(key, key if len(key) == 1 else "")
        press = {"key": key, "windowsVirtualKeyCode": codes.get(key, ord(key[0].upper()))}
        press |= {"modifiers": 8 if shift else 0}
        self.send("Input.dispatchKeyEvent", type="keyDown", text=text, **press)
        self.send("Input.dispatchKeyEvent", type="keyUp", **press)

    def screenshot(self, path: Path) -> None:
        """Save what the page looks like, PNG."""
        path.write_bytes(base64.b64decode(self.send("Page.captureScreenshot")["data"]))
