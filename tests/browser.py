"""A headless Chromium for tests of pages, driven over its own pipe by the DevTools protocol: nothing to install but it.

https://chromedevtools.github.io/devtools-protocol describes the methods. Chromium reads messages from its file
descriptor 3 and writes to 4 (``--remote-debugging-pipe``), JSON ended by a zero byte.
"""

import base64
import contextlib
import fcntl
import json
import os
import select
import shutil
import signal
import tempfile
import time
from collections import deque
from typing import Any

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OPTIONS = (
    "--headless=new",
    "--remote-debugging-pipe",
    "--disable-gpu",
    "--disable-dev-shm-usage",
    "--disable-extensions",
    "--disable-background-networking",
    "--disable-component-update",
    "--no-first-run",
    "--no-default-browser-check",
    "--hide-scrollbars",
)
TIMEOUT = 60.0  # s for an answer
PATIENCE = 10.0  # s for the browser to end by itself


def browser_path() -> str | None:
    """The program named by $JAXEIT_BROWSER, or a Chromium on the path; None without one."""
    return os.environ.get("JAXEIT_BROWSER") or next(filter(None, map(shutil.which, NAMES)), None)


class Browser:
    """A browser process with no page but those that `open` makes; a context manager."""

    def __init__(self, path: str):
        self._folder = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        (theirs_in, self._out), (self._in, theirs_out) = os.pipe(), os.pipe()
        high = [fcntl.fcntl(fd, fcntl.F_DUPFD_CLOEXEC, 20) for fd in (theirs_in, theirs_out)]  # none is 3 or 4
        sandbox = ["--no-sandbox"] if os.geteuid() == 0 else []
        command = [path, *OPTIONS, *sandbox, f"--user-data-dir={self._folder.name}", "about:blank"]
        silent = [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_RDWR, 0) for number in (1, 2)]
        pipes = [(os.POSIX_SPAWN_DUP2, fd, number) for fd, number in zip(high, (3, 4), strict=True)]
        self._process = os.posix_spawn(path, command, os.environ, file_actions=[*silent, *pipes], setpgroup=0)
        for fd in (theirs_in, theirs_out, *high):
            os.close(fd)
        self._unread, self._number = b"", 0
        self.events: deque[dict[str, Any]] = deque()

    def call(self, method: str, session: str | None = None, **parameters: Any) -> Any:
        """The result of a method; events that arrive meanwhile are kept.

        Raises:
            RuntimeError: if the browser refuses. TimeoutError: if it does not answer.
        """
        self._number += 1
        message = {"id": self._number, "method": method, "params": parameters} | (
            {"sessionId": session} if session else {}
        )
        os.write(self._out, json.dumps(message).encode() + b"\0")
        until = time.monotonic() + TIMEOUT
        while (answer := self._read(until)).get("id") != self._number:
            self.events.append(answer)
        if "error" in answer:
            raise RuntimeError(f"{method}: {answer['error']['message']}")
        return answer["result"]

    def _read(self, until: float) -> dict[str, Any]:
        while b"\0" not in self._unread:
            if not select.select([self._in], [], [], max(0.0, until - time.monotonic()))[0]:
                raise TimeoutError("the browser does not answer")
            data = os.read(self._in, 1 << 20)
            if not data:
                raise RuntimeError("the browser has ended")
            self._unread += data
        message, _, self._unread = self._unread.partition(b"\0")
        found: dict[str, Any] = json.loads(message)
        return found

    def open(self, url: str, width: int, height: int = 800, *, dark: bool = False) -> "Tab":
        """A page at this width in CSS pixels, with the light or the dark colours."""
        target = self.call("Target.createTarget", url="about:blank")["targetId"]
        session = self.call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
        tab = Tab(self, target, session)
        for domain in ("Page", "Runtime", "Log"):
            tab.call(f"{domain}.enable")
        tab.resize(width, height)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        tab.call("Emulation.setEmulatedMedia", features=[scheme])
        tab.call("Page.navigate", url=url)
        tab.wait_for("document.readyState === 'complete' && location.href !== 'about:blank'")
        return tab

    def __enter__(self) -> "Browser":
        return self

    def __exit__(self, *error: object) -> None:
        with contextlib.suppress(RuntimeError, TimeoutError, OSError):  # it has ended already
            self.call("Browser.close")
        until = time.monotonic() + PATIENCE
        while not (ended := os.waitpid(self._process, os.WNOHANG)[0]) and time.monotonic() < until:
            time.sleep(0.02)
        if not ended:
            os.killpg(self._process, signal.SIGKILL)
            os.waitpid(self._process, 0)
        os.close(self._in)
        os.close(self._out)
        self._folder.cleanup()


class Tab:
    """A page in the browser; a context manager that closes it."""

    def __init__(self, browser: Browser, target: str, session: str):
        self._browser, self._target, self._session = browser, target, session

    def call(self, method: str, **parameters: Any) -> Any:
        """As `Browser.call`, for this page."""
        return self._browser.call(method, self._session, **parameters)

    def resize(self, width: int, height: int) -> None:
        """Give the page another size in CSS pixels."""
        self.call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=width < 600
        )

    def value(self, expression: str) -> Any:
        """The value of a JavaScript expression, or of its promise, as JSON has it."""
        found = self.call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(f"{expression}: {found['exceptionDetails']}")
        return found["result"].get("value")

    def wait_for(self, expression: str, seconds: float = 20.0) -> None:
        """Wait until an expression is true."""
        until = time.monotonic() + seconds
        while not self.value(f"Boolean({expression})"):
            if time.monotonic() > until:
                raise TimeoutError(f"never true: {expression}")
            time.sleep(0.02)

    def press(self, key: str, code: str = "", text: str = "") -> None:
        """Press and release a key, such as ``press("Tab")`` or ``press(" ", "Space", " ")``."""
        number = {"Tab": 9, "Enter": 13, " ": 32, "Escape": 27}.get(key, ord(key[0].upper()))
        about = {"key": key, "code": code or key, "windowsVirtualKeyCode": number}
        self.call("Input.dispatchKeyEvent", type="keyDown", **about, **({"text": text} if text else {}))
        self.call("Input.dispatchKeyEvent", type="keyUp", **about)

    def overflow(self) -> int:
        """CSS pixels by which the page is wider than its window."""
        return int(self.value("document.scrollingElement.scrollWidth - document.documentElement.clientWidth"))

    def errors(self) -> list[str]:
        """Exceptions and errors that the page has logged so far."""
        self.value("0")  # all events before this answer have arrived
        mine = [event for event in self._browser.events if event.get("sessionId") == self._session]
        thrown = [
            e["params"]["exceptionDetails"].get("exception", {}).get("description", e["params"]["exceptionDetails"])
            for e in mine
            if e["method"] == "Runtime.exceptionThrown"
        ]
        logged = [e["params"]["entry"] for e in mine if e["method"] == "Log.entryAdded"]
        return [str(e) for e in thrown] + [e["text"] for e in logged if e["level"] == "error"]

    def accessible(self) -> list[dict[str, str]]:
        """What a screen reader is told: role and name of each part, in order."""
        nodes = self.call("Accessibility.getFullAXTree")["nodes"]
        return [
            {"role": n["role"]["value"], "name": n.get("name", {}).get("value", "")}
            for n in nodes
            if not n.get("ignored") and "role" in n
        ]

    def box(self, of: str) -> list[float]:
        """Left, top, width and height of an element (JavaScript) on the page, in CSS pixels."""
        corner = "[b.x + scrollX, b.y + scrollY, b.width, b.height]"
        found: list[float] = self.value(f"(b => {corner})({of}.getBoundingClientRect())")
        return found

    def screenshot(self, *, whole: bool = True, of: str | None = None) -> bytes:
        """The page as PNG: all of it, what the window shows, or an element (JavaScript)."""
        clip = (
            {} if of is None else {"clip": dict(zip(("x", "y", "width", "height"), self.box(of), strict=True), scale=1)}
        )
        return base64.b64decode(self.call("Page.captureScreenshot", captureBeyondViewport=whole, **clip)["data"])

    def __enter__(self) -> "Tab":
        return self

    def __exit__(self, *error: object) -> None:
        self._browser.call("Target.closeTarget", targetId=self._target)
