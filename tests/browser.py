"""What a reader's browser makes of a page: Chromium without a screen, over a pipe (DevTools protocol)."""

import base64
import importlib.util
import json
import os
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import Any

PROGRAM = shutil.which("chromium")
_FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--disable-dev-shm-usage",
    "--no-first-run", "--disable-background-networking", "--disable-component-update", "--disable-sync",
    "--disable-extensions", "--hide-scrollbars", "--force-color-profile=srgb", "--remote-debugging-pipe",
)  # fmt: skip


class Browser:
    """One page at a time. `events` are what the page did since it was opened."""

    def __init__(self) -> None:
        assert PROGRAM is not None
        self._profile = tempfile.TemporaryDirectory(ignore_cleanup_errors=True)
        to_read, self._out = os.pipe()
        self._in, to_write = os.pipe()

        def numbered() -> None:  # the protocol's pipe is file 3 (read) and 4 (written)
            read, write = os.dup(to_read), os.dup(to_write)
            os.dup2(read, 3)
            os.dup2(write, 4)

        self._process = subprocess.Popen(
            [PROGRAM, *_FLAGS, f"--user-data-dir={self._profile.name}", "about:blank"],
            preexec_fn=numbered,
            close_fds=False,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )
        os.close(to_read)
        os.close(to_write)
        self._rest, self._number, self._session = b"", 0, ""
        self.events: list[dict[str, Any]] = []
        target = next(t for t in self.call("Target.getTargets")["targetInfos"] if t["type"] == "page")
        attached = self.call("Target.attachToTarget", targetId=target["targetId"], flatten=True)
        self._session = attached["sessionId"]
        for domain in ("Page", "Runtime", "Log", "Network"):
            self.call(f"{domain}.enable")

    def call(self, method: str, **parameters: Any) -> dict[str, Any]:
        self._number += 1
        message: dict[str, Any] = {"id": self._number, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._out, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._next()
            if answer.get("id") == self._number:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return dict(answer["result"])

    def _next(self) -> dict[str, Any]:
        while b"\0" not in self._rest:
            piece = os.read(self._in, 1 << 16)
            if not piece:
                raise RuntimeError("the browser has gone")
            self._rest += piece
        line, _, self._rest = self._rest.partition(b"\0")
        answer = json.loads(line)
        if "method" in answer:
            self.events.append(answer)
        return dict(answer)

    def open(self, page: Path, width: int = 1280, height: int = 800, *, dark: bool = False) -> None:
        """Load a file at a size of window [px]; returns once it is laid out."""
        self.go(page.resolve().as_uri(), width, height, dark=dark)

    def go(self, url: str, width: int = 1280, height: int = 800, *, dark: bool = False) -> None:
        """The same by address."""
        self.resize(width, height, dark=dark)
        self.events.clear()
        self.call("Page.navigate", url=url)
        while not any(event["method"] == "Page.loadEventFired" for event in self.events):
            self._next()

    def resize(self, width: int, height: int = 800, *, dark: bool = False) -> None:
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self.call("Emulation.setDeviceMetricsOverride", **size)
        theme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self.call("Emulation.setEmulatedMedia", features=[theme])

    def ask(self, script: str) -> Any:
        """Value of a JavaScript expression."""
        found = self.call("Runtime.evaluate", expression=script, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"]["exception"]["description"])
        return found["result"].get("value")

    def press(self, key: str) -> None:
        codes = {
            "Enter": 13, "Escape": 27, "Tab": 9, "ArrowRight": 39, "ArrowLeft": 37, "PageDown": 34, " ": 32,
        }  # fmt: skip
        text = {"Enter": "\r", " ": " "}.get(key, key if len(key) == 1 else "")
        more = {"text": text} if text else {}
        for kind in ("keyDown", "keyUp"):
            code = codes.get(key, 0)
            self.call("Input.dispatchKeyEvent", type=kind, key=key, windowsVirtualKeyCode=code, **more)

    def mouse(self, kind: str, x: float, y: float, *, down: bool = False) -> None:
        """kind: mouseMoved, mousePressed or mouseReleased, at a place in the window [px]."""
        held = {"button": "left", "buttons": 1, "clickCount": 1} if down or kind != "mouseMoved" else {}
        self.call("Input.dispatchMouseEvent", type=kind, x=x, y=y, **held)

    def picture(self, path: Path, *, whole: bool = True) -> None:
        """What is seen, as PNG."""
        shot = self.call("Page.captureScreenshot", captureBeyondViewport=whole, **self._clip(whole))
        path.write_bytes(base64.b64decode(shot["data"]))

    def _clip(self, whole: bool) -> dict[str, Any]:
        if not whole:
            return {}
        size = self.call("Page.getLayoutMetrics")["cssContentSize"]
        return {"clip": {"x": 0, "y": 0, "width": size["width"], "height": size["height"], "scale": 1}}

    def complaints(self) -> list[str]:
        """Errors and warnings of the page since it was opened, and everything it asked the network for."""
        said = []
        for event in self.events:
            method, what = event["method"], event["params"]
            if method == "Runtime.exceptionThrown":
                said.append(f"exception: {what['exceptionDetails'].get('exception', what)}")
            elif method == "Runtime.consoleAPICalled":
                said.append(f"console: {what['args']}")
            elif method == "Log.entryAdded":
                said.append(f"log: {what['entry']['text']}")
            elif method == "Network.requestWillBeSent" and not what["request"]["url"].startswith(
                ("file:", "data:")
            ):
                said.append(f"request: {what['request']['url'][:100]}")
        return said

    def close(self) -> None:
        try:
            self.call("Browser.close")
            self._process.wait(timeout=10)
        except (RuntimeError, OSError, subprocess.TimeoutExpired):
            self._process.kill()
            self._process.wait()
        os.close(self._out)
        os.close(self._in)
        self._profile.cleanup()


_READER = Path(__file__).with_name("reader.js").read_text().partition("\n")[2]
AXE = importlib.util.find_spec("axe_core_python")  # of the extra dev
_SERIOUS = """axe.run().then(found => found.violations.filter(one => /serious|critical/.test(one.impact))
  .map(one => `${one.impact}: ${one.id}, ${one.nodes.length} times: ${one.nodes[0].html.slice(0, 100)}`))"""


def barriers(browser: Browser) -> list[str]:
    """What axe-core calls serious or critical on the open page; nothing where it is not installed."""
    if AXE is None or AXE.origin is None:
        return []
    browser.ask(Path(AXE.origin).with_name("axe.min.js").read_text(encoding="utf-8") + ";0")
    return list(browser.ask(_SERIOUS))


def faults_of(browser: Browser, page: Path) -> list[str]:
    """What a reader would mind: complaints, requests, what is cut or too pale; light, dark, wide, narrow."""
    found: list[str] = []
    for width, dark in ((1280, False), (1280, True), (400, False)):
        browser.open(page, width, dark=dark)
        faults, _ = browser.ask(f"({_READER})()")
        found += [f"{page.name}: {fault}" for fault in faults + browser.complaints() + barriers(browser)]
    return list(dict.fromkeys(found))
