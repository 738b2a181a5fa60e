"""A headless Chromium, driven by the DevTools protocol, for tests, screenshots of the documentation, and benchmarks."""

from __future__ import annotations

import base64
import itertools
import json
import os
import shutil
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, Self

from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from roboxim_core.errors import ErrorCode, RoboximError

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
OPTIONS = (
    "--headless", "--no-sandbox", "--no-first-run", "--disable-dev-shm-usage", "--disable-extensions", "--mute-audio",
    "--disable-background-networking", "--disable-component-update", "--remote-debugging-port=0",
    "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader",
)  # fmt: skip
WAIT_S = 180.0
"""Longest wait for a condition; software WebGL on a busy machine is slow."""


def find_browser() -> str:
    """Return the path of an installed Chromium; empty when there is none. ``ROBOXIM_CHROMIUM`` names another."""
    named = os.environ.get("ROBOXIM_CHROMIUM", "")
    return named or next(filter(None, map(shutil.which, NAMES)), "")


class Page:
    """What tests do with a page of any browser: run scripts in it, and wait for what they return."""

    def __init__(self) -> None:
        """Make a page without a browser."""
        self._ids = itertools.count(1)
        self._socket: Any = None
        self.requests: list[str] = []
        """Addresses that the page has asked for."""
        self.errors: list[str] = []
        """Uncaught errors of the page's scripts."""

    def __enter__(self) -> Self:
        """Return itself."""
        return self

    def __exit__(self, *_: object) -> None:
        """Close."""
        self.close()

    def close(self) -> None:
        """End the browser."""
        raise NotImplementedError

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression; promises are awaited.

        Raises:
            RoboximError: When it raises.
        """
        raise NotImplementedError

    def wait(self, script: str, seconds: float = WAIT_S) -> None:
        """Wait until an expression is true; one that raises is not yet.

        Raises:
            RoboximError: When it is not in time; with the page's text.
        """
        wait_for(
            lambda: self.run(f"(() => {{ try {{ return !!({script}) }} catch (e) {{ return false }} }})()"),
            f"'{script}' in the page", seconds, self._describe,
        )  # fmt: skip

    def text(self, selector: str) -> str:
        """Return the text of the first element of a selector; empty when there is none."""
        return str(self.run(f"(document.querySelector({json.dumps(selector)}) || {{innerText: ''}}).innerText"))

    def click(self, label: str) -> None:
        """Click the button of a label, by the page's own event: it need not be in sight."""
        self.wait(f"!!({_button(label)})")
        self.run(f"({_button(label)}).click()")

    def _describe(self) -> str:
        shown = str(self.run("document.body ? document.body.innerText.slice(0, 600) : ''"))
        return f"the page shows {shown!r}; errors of its scripts: {self.errors[-3:]}"

    def _connect(self, process: subprocess.Popen[Any], address: Callable[[], str]) -> None:
        """Connect to a browser as soon as it reports its address.

        Args:
            process: The browser.
            address: Returns its address; empty: it is not known yet.

        Raises:
            RoboximError: When it ends before, or reports nothing in time.
        """

        def found() -> str:
            if process.poll() is not None:
                raise RoboximError(f"the browser ended with {process.returncode}", ErrorCode.UNAVAILABLE)
            return address()

        self._socket = connect(wait_for(found, "the browser"), max_size=None, max_queue=None, ping_interval=None)

    def _exchange(self, message: dict[str, Any]) -> Any:
        """Send a command and return its answer; events that come before it are noted.

        Raises:
            RoboximError: When the browser does not answer.
        """
        message["id"] = next(self._ids)
        try:
            self._socket.send(json.dumps(message))
            while True:
                answer = json.loads(self._socket.recv(timeout=WAIT_S))
                if answer.get("id") == message["id"]:
                    return answer
                self._note(answer)
        except (ConnectionClosed, TimeoutError) as error:
            text = f"the browser does not answer {message['method']}: {error}"
            raise RoboximError(text, ErrorCode.UNAVAILABLE) from error

    def _note(self, event: Any) -> None:
        """Keep what an event says."""
        raise NotImplementedError


class Browser(Page):
    """A Chromium with one page. A context manager."""

    def __init__(self, *, width: int = 1280, height: int = 800, scale: float = 1.0) -> None:
        """Start a browser with an empty page.

        Args:
            width: Width of the page [px].
            height: Height of the page [px].
            scale: Device pixels per pixel.

        Raises:
            RoboximError: When no browser is installed, or it does not start.
        """
        super().__init__()
        path = find_browser()
        if not path:
            raise RoboximError(
                "no Chromium is installed; install one (apt-get install chromium), or name it in ROBOXIM_CHROMIUM",
                ErrorCode.UNAVAILABLE,
            )
        self._folder = tempfile.TemporaryDirectory(prefix="roboxim-browser-", ignore_cleanup_errors=True)
        options = (*OPTIONS, f"--user-data-dir={self._folder.name}", f"--window-size={width},{height}", "about:blank")
        self._process = subprocess.Popen([path, *options], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        try:
            self._connect(self._process, self._address)
            self._session = ""
            target = self._call("Target.createTarget", url="about:blank")["targetId"]
            self._session = self._call("Target.attachToTarget", targetId=target, flatten=True)["sessionId"]
            for domain in ("Page", "Runtime", "Network"):
                self._call(f"{domain}.enable")
            self.resize(width, height, scale)
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the browser."""
        if self._socket is not None:
            self._socket.close()
        end(self._process)
        self._folder.cleanup()

    def open(self, url: str) -> None:
        """Open an address."""
        self._call("Page.navigate", url=url)

    def before_pages(self, script: str) -> str:
        """Run a script in every page that opens, before the page's own; returns what `forget` takes."""
        return str(self._call("Page.addScriptToEvaluateOnNewDocument", source=script)["identifier"])

    def forget(self, script: str) -> None:
        """Run a script of `before_pages` no longer."""
        self._call("Page.removeScriptToEvaluateOnNewDocument", identifier=script)

    def resize(self, width: int, height: int, scale: float = 1.0, *, phone: bool = False) -> None:
        """Set the size of the page [px]; a phone's page reports touch instead of a mouse."""
        self._call(
            "Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=scale, mobile=phone
        )

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression; promises are awaited.

        Raises:
            RoboximError: When it raises.
        """
        answer = self._call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in answer:
            raise RoboximError(f"the page's script failed: {answer['exceptionDetails']}")
        return answer["result"].get("value")

    def key(self, code: str, *, down: bool) -> None:
        """Press or release a key, e.g. ``KeyW``."""
        key = code.removeprefix("Key").lower() if code.startswith("Key") else {"Space": " "}.get(code, code)
        self._call("Input.dispatchKeyEvent", type="keyDown" if down else "keyUp", code=code, key=key)

    def mouse(self, kind: str, x: float, y: float) -> None:
        """Send ``mousePressed``, ``mouseMoved`` or ``mouseReleased`` at a place of the page [px]."""
        pressed = kind != "mouseReleased"
        self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=int(pressed), clickCount=1)

    def screenshot(self, path: Path) -> None:
        """Write the page as PNG."""
        data = self._call("Page.captureScreenshot", format="png")["data"]
        path.write_bytes(base64.b64decode(data))

    def _address(self) -> str:
        file = Path(self._folder.name) / "DevToolsActivePort"
        lines = file.read_text().split("\n") if file.exists() else []
        return f"ws://127.0.0.1:{lines[0]}{lines[1]}" if len(lines) > 1 else ""

    def _call(self, method: str, **parameters: Any) -> Any:
        message: dict[str, Any] = {"method": method, "params": parameters}
        if getattr(self, "_session", ""):
            message["sessionId"] = self._session
        answer = self._exchange(message)
        if "error" in answer:
            raise RoboximError(f"the browser refuses {method}: {answer['error']}")
        return answer["result"]

    def _note(self, event: Any) -> None:
        if event.get("method") == "Network.requestWillBeSent":
            self.requests.append(event["params"]["request"]["url"])
        elif event.get("method") == "Network.webSocketCreated":
            self.requests.append(event["params"]["url"])
        elif event.get("method") == "Runtime.exceptionThrown":
            details = event["params"]["exceptionDetails"]
            self.errors.append(str(details.get("exception", {}).get("description", details.get("text"))))


def wait_for(
    condition: Callable[[], Any], description: str, seconds: float = WAIT_S, describe: Callable[[], str] = lambda: ""
) -> Any:
    """Return the first true value of a condition.

    Raises:
        RoboximError: When there is none in time.
    """
    end = time.monotonic() + seconds
    while not (found := condition()):
        if time.monotonic() > end:
            raise RoboximError(f"waited {seconds:g} s for {description}; {describe()}", ErrorCode.TIMEOUT)
        time.sleep(0.05)
    return found


def end(process: subprocess.Popen[Any]) -> None:
    """End a process that this one has started."""
    process.terminate()
    try:
        process.wait(timeout=10)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def _button(label: str) -> str:
    return (
        "[...document.querySelectorAll('button, [role=tab]')].find((one) => one.innerText.trim() === "
        f"{json.dumps(label)})"
    )
