"""A Firefox on a virtual screen (Xvfb), driven by its built-in WebDriver BiDi, for tests.

Firefox offers no WebGL without a screen, so it is not started headless.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

from browser import Page, end

from roboxim_core.errors import ErrorCode, RoboximError

NAMES = ("firefox-esr", "firefox")
PREFERENCES = {
    "app.normandy.enabled": False, "app.update.enabled": False, "browser.shell.checkDefaultBrowser": False,
    "browser.startup.homepage_override.mstone": "ignore", "datareporting.policy.dataSubmissionEnabled": False,
    "network.captive-portal-service.enabled": False, "network.connectivity-service.enabled": False,
    "toolkit.telemetry.reportingpolicy.firstRun": False, "webgl.force-enabled": True,
}  # fmt: skip
"""Preferences of the profile: no requests to the internet, and software WebGL is allowed."""


def find_firefox() -> str:
    """Return the path of an installed Firefox, if there is an Xvfb too; else empty. ``ROBOXIM_FIREFOX`` names one."""
    named = os.environ.get("ROBOXIM_FIREFOX", "") or next(filter(None, map(shutil.which, NAMES)), "")
    return named if shutil.which("Xvfb") else ""


class Firefox(Page):
    """A Firefox with one page. A context manager."""

    def __init__(self, *, width: int = 1280, height: int = 800) -> None:
        """Start a browser with an empty page on a virtual screen.

        Args:
            width: Width of the screen [px].
            height: Height of the screen [px].

        Raises:
            RoboximError: When Firefox or Xvfb are not installed, or do not start.
        """
        super().__init__()
        path = find_firefox()
        if not path:
            raise RoboximError(
                "no Firefox with an Xvfb is installed; install both (apt-get install firefox-esr xvfb)",
                ErrorCode.UNAVAILABLE,
            )
        self._folder = tempfile.TemporaryDirectory(prefix="roboxim-browser-", ignore_cleanup_errors=True)
        folder = Path(self._folder.name)
        lines = (f"user_pref({json.dumps(name)}, {json.dumps(value)});\n" for name, value in PREFERENCES.items())
        (folder / "user.js").write_text("".join(lines))
        self._screen, display = _screen(width, height)
        self._process = subprocess.Popen(
            [path, "--no-remote", "--profile", str(folder), "--remote-debugging-port", "0", "about:blank"],
            env={**os.environ, "DISPLAY": display, "HOME": str(folder)},
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            self._connect(self._process, self._address)
            self._call("session.new", capabilities={})
            self._context = self._call("browsingContext.getTree")["contexts"][0]["context"]
            self._call("session.subscribe", events=["log.entryAdded", "network.beforeRequestSent"])
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        """End the browser and its screen."""
        if self._socket is not None:
            self._socket.close()
        for process in (self._process, self._screen):
            end(process)
        self._folder.cleanup()

    def open(self, url: str) -> None:
        """Open an address."""
        self._call("browsingContext.navigate", context=self._context, url=url, wait="none")

    def run(self, script: str) -> Any:
        """Return the value of a JavaScript expression that is text, a number, a truth value or nothing.

        Raises:
            RoboximError: When it raises.
        """
        answer = self._call(
            "script.evaluate", expression=script, target={"context": self._context}, awaitPromise=True
        )  # fmt: skip
        if answer["type"] == "exception":
            raise RoboximError(f"the page's script failed: {answer['exceptionDetails']['text']}")
        return answer["result"].get("value")

    def press(self, key: str) -> None:
        """Press and release a key, e.g. ``.``."""
        actions = [{"type": "keyDown", "value": key}, {"type": "keyUp", "value": key}]
        self._call(
            "input.performActions", context=self._context, actions=[{"type": "key", "id": "keys", "actions": actions}]
        )

    def screenshot(self, path: Path) -> None:
        """Write the page as PNG."""
        data = self._call("browsingContext.captureScreenshot", context=self._context)["data"]
        path.write_bytes(base64.b64decode(data))

    def _address(self) -> str:
        try:
            found = json.loads((Path(self._folder.name) / "WebDriverBiDiServer.json").read_text())
        except (OSError, ValueError):  # not there, or not whole yet
            return ""
        return f"ws://{found['ws_host']}:{found['ws_port']}/session"

    def _call(self, method: str, **parameters: Any) -> Any:
        answer = self._exchange({"method": method, "params": parameters})
        if answer.get("type") == "error":
            raise RoboximError(f"the browser refuses {method}: {answer['error']}: {answer['message']}")
        return answer["result"]

    def _note(self, event: Any) -> None:
        if event.get("method") == "network.beforeRequestSent":
            self.requests.append(event["params"]["request"]["url"])
        elif event.get("method") == "log.entryAdded" and event["params"].get("type") == "javascript":
            self.errors.append(str(event["params"]["text"]))


def _screen(width: int, height: int) -> tuple[subprocess.Popen[bytes], str]:
    """Start a virtual screen; return its process and its name."""
    readable, writable = os.pipe()
    process = subprocess.Popen(
        ["Xvfb", "-displayfd", str(writable), "-screen", "0", f"{width}x{height}x24", "-nolisten", "tcp"],
        pass_fds=(writable,), stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
    )  # fmt: skip
    os.close(writable)
    with os.fdopen(readable) as display:
        number = display.readline().strip()
    if not number:
        end(process)
        raise RoboximError("Xvfb did not start", ErrorCode.UNAVAILABLE)
    return process, f":{number}"
