"""A headless Chromium that is spoken to through its debugging pipe: it loads a file, evaluates scripts, and gets real
pointer and key events. Nothing but the browser itself is needed."""

import base64
import json
import os
import shutil
import signal
import time

from tests.support.processes import PATIENCE

FLAGS = (
    "--headless", "--no-sandbox", "--disable-gpu", "--disable-quic", "--no-first-run", "--hide-scrollbars",
    "--disable-background-networking", "--disable-component-update", "--disable-sync", "--remote-debugging-pipe",
)  # fmt: skip


def find():
    """Return the path of a Chromium or Chrome on this machine, None if there is none."""
    names = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
    return next(filter(None, map(shutil.which, names)), None)


class Chromium:
    """A page in a browser of its own, whose profile is the empty folder `profile`; use it in a `with` statement."""

    def __init__(self, executable, profile, width=1200, height=1600):
        command = [executable, *FLAGS, f"--user-data-dir={profile}", f"--window-size={width},{height}", "about:blank"]
        read, self._write = os.pipe()
        self._read, write = os.pipe()
        files = [(os.POSIX_SPAWN_OPEN, number, os.devnull, os.O_RDWR, 0) for number in (0, 1, 2)]
        # The browser reads from file descriptor 3 and writes to 4.
        files += [(os.POSIX_SPAWN_DUP2, read, 3), (os.POSIX_SPAWN_DUP2, write, 4)]
        self._process = os.posix_spawn(executable, command, os.environ, file_actions=files)
        os.close(read)
        os.close(write)
        self._buffer, self._count, self._session = b"", 0, None
        self.failures = []  # what scripts threw, and requests of the network
        pages = [one for one in self._call("Target.getTargets")["targetInfos"] if one["type"] == "page"]
        target = {"targetId": pages[0]["targetId"], "flatten": True}
        self._session = self._call("Target.attachToTarget", **target)["sessionId"]
        for domain in ("Page", "Runtime", "Network"):
            self._call(f"{domain}.enable")

    def __enter__(self):
        return self

    def __exit__(self, *_):
        os.kill(self._process, signal.SIGKILL)
        os.waitpid(self._process, 0)
        os.close(self._read)
        os.close(self._write)

    def open(self, path):
        """Load a file and wait until it is there."""
        self._call("Page.navigate", url=path.absolute().as_uri())
        self.wait("document.readyState === 'complete'")

    def value(self, expression):
        """Return the value of a JavaScript expression; raises RuntimeError if it throws."""
        found = self._call("Runtime.evaluate", expression=expression, returnByValue=True, awaitPromise=True)
        if "exceptionDetails" in found:
            raise RuntimeError(found["exceptionDetails"]["exception"]["description"])
        return found["result"].get("value")

    def wait(self, expression, seconds=PATIENCE):
        """Wait until a JavaScript expression is true; raises TimeoutError."""
        end = time.monotonic() + seconds
        while not self.value(expression):
            if time.monotonic() > end:
                raise TimeoutError(expression)
            time.sleep(0.02)

    def centre(self, selector):
        """Return the middle of the first element that a selector finds, having scrolled to it."""
        return self.value(
            f"(() => {{ const e=document.querySelector({json.dumps(selector)}); e.scrollIntoView({{block:'nearest'}}); "
            "const box = e.getBoundingClientRect(); return [box.x + box.width / 2, box.y + box.height / 2]; })()"
        )

    def click(self, selector):
        x, y = self.centre(selector)
        self.drag(x, y, x, y)

    def drag(self, x, y, to_x, to_y):
        """Press the left button at one place and release it at another."""
        self._mouse("mousePressed", x, y, 1)
        for step in (0.5, 1) if (x, y) != (to_x, to_y) else ():
            self._mouse("mouseMoved", x + step * (to_x - x), y + step * (to_y - y), 1)
        self._mouse("mouseReleased", to_x, to_y, 0)

    def wheel(self, x, y, by, control=False):
        turned = {"type": "mouseWheel", "x": x, "y": y, "deltaX": 0, "deltaY": by, "modifiers": 2 * control}
        self._call("Input.dispatchMouseEvent", **turned)

    def move(self, x, y):
        self._mouse("mouseMoved", x, y, 0)

    def press(self, key, shift=False):
        code = f"Digit{key}" if key.isdecimal() else ""
        for kind in ("keyDown", "keyUp"):
            self._call("Input.dispatchKeyEvent", type=kind, key=key, code=code, modifiers=8 * shift)

    def look(self, width, height, dark=False):
        """Give the window a size, in CSS pixels, and a preference for dark pages or light ones."""
        size = {"width": width, "height": height, "deviceScaleFactor": 1, "mobile": False}
        self._call("Emulation.setDeviceMetricsOverride", **size)
        scheme = {"name": "prefers-color-scheme", "value": "dark" if dark else "light"}
        self._call("Emulation.setEmulatedMedia", features=[scheme])

    def run_scripts(self, allowed):
        """Say whether pages that are loaded from now on may run scripts."""
        self._call("Emulation.setScriptExecutionDisabled", value=not allowed)

    def screenshot(self, path):
        """Write what the window shows to a PNG file."""
        path.write_bytes(base64.b64decode(self._call("Page.captureScreenshot")["data"]))

    def _mouse(self, kind, x, y, buttons):
        self._call("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", buttons=buttons, clickCount=1)

    def _call(self, method, **parameters):
        self._count += 1
        message = {"id": self._count, "method": method, "params": parameters}
        if self._session:
            message["sessionId"] = self._session
        os.write(self._write, json.dumps(message).encode() + b"\0")
        while True:
            answer = self._receive()
            if answer.get("method") == "Runtime.exceptionThrown":
                self.failures.append(answer["params"]["exceptionDetails"]["exception"].get("description"))
            elif answer.get("method") == "Network.requestWillBeSent":
                url = answer["params"]["request"]["url"]
                self.failures += [] if url.startswith(("file:", "data:", "blob:")) else [url]
            if answer.get("id") == self._count:
                if "error" in answer:
                    raise RuntimeError(f"{method}: {answer['error']['message']}")
                return answer["result"]

    def _receive(self):
        while b"\0" not in self._buffer:
            received = os.read(self._read, 2**16)
            if not received:
                raise RuntimeError("the browser has ended")
            self._buffer += received
        message, _, self._buffer = self._buffer.partition(b"\0")
        return json.loads(message)


def choose(page, selector, value):
    """Select a value like a user, and wait until the page is painted."""
    before = page.value("document.querySelector('.stage').dataset.painted")
    page.value(
        f"(() => {{ const e = document.querySelector('{selector}'); e.value = '{value}'; "
        "for (const type of ['input', 'change']) e.dispatchEvent(new Event(type)); })()"
    )
    page.wait(f"document.querySelector('.stage').dataset.painted > {before}")
