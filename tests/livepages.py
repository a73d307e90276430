"""Pages that look at a live view: a plain client over its websocket, and a real browser."""

import base64
import contextlib
import json
import os
import shutil
import subprocess
import tempfile
import threading
import time
import urllib.request
from pathlib import Path

LOOK = {
    "type": "ViewerCameraMessage",
    "wxyz": [1.0, 0.0, 0.0, 0.0],
    "position": [3.0, 3.0, 3.0],
    "fov": 1.3,
    "near": 0.01,
    "far": 1000.0,
    "image_height": 600,
    "image_width": 800,
    "look_at": [0.0, 0.0, 0.0],
    "up_direction": [0.0, -1.0, 0.0],
}
BROWSERS = ("chromium", "chromium-browser", "google-chrome", "chrome")


def browser():
    """Return the path of a Chromium, None where there is none."""
    return os.environ.get("ODOMAP_CHROMIUM") or next(
        filter(None, map(shutil.which, BROWSERS)), None
    )


def until(condition, seconds=20.0):
    """Wait until something is so; return whether it came to be."""
    end = time.monotonic() + seconds
    while not (is_so := condition()) and time.monotonic() < end:
        time.sleep(0.02)
    return bool(is_so)


@contextlib.contextmanager
def page(url):
    """A client as a browser is one: it says where it looks from, and reads all that it is sent."""
    import msgspec
    import viser
    from websockets.sync.client import connect

    address = url.replace("http", "ws", 1)
    got = []
    with connect(address, subprotocols=[f"viser-v{viser.__version__}"], max_size=None) as socket:
        socket.send(msgspec.msgpack.encode(LOOK))

        def read():
            with contextlib.suppress(Exception):
                for message in socket:
                    got.append(len(message))

        reader = threading.Thread(target=read)
        reader.start()
        try:
            yield got
        finally:
            socket.close()
            reader.join()


class Chromium:
    """A headless browser on one page, driven by its own protocol.

    Args:
        url: the page.
        size: of the window, pixels.
    """

    def __init__(self, url, size=(1200, 800)):
        from websockets.sync.client import connect

        self._folder = tempfile.mkdtemp()
        words = "--headless=new --no-sandbox --use-gl=angle --use-angle=swiftshader "
        words += "--enable-unsafe-swiftshader --ignore-gpu-blocklist --no-first-run "
        words += "--disable-background-networking --disable-dev-shm-usage "
        words += f"--remote-debugging-port=0 --user-data-dir={self._folder} "
        words += f"--window-size={size[0]},{size[1]}"
        quiet = subprocess.DEVNULL
        command = [browser(), *words.split(), "about:blank"]
        self._process = subprocess.Popen(command, stdout=quiet, stderr=quiet)
        self._count = 0
        try:
            told = Path(self._folder) / "DevToolsActivePort"
            assert until(lambda: told.exists() and "\n" in told.read_text(), 60), "no browser"
            port = told.read_text().split()[0]
            with urllib.request.urlopen(f"http://127.0.0.1:{port}/json") as answer:
                pages = [p for p in json.load(answer) if p["type"] == "page"]
            self._socket = connect(pages[0]["webSocketDebuggerUrl"], max_size=None)
            self.call("Page.navigate", url=url)
        except BaseException:
            self._end()
            raise

    def __enter__(self):
        return self

    def __exit__(self, *_):
        self._socket.close()
        self._end()

    def _end(self):
        self._process.terminate()
        self._process.wait(20)
        shutil.rmtree(self._folder, ignore_errors=True)

    def call(self, method, **values):
        """Ask the browser something and return its answer."""
        self._count += 1
        self._socket.send(json.dumps({"id": self._count, "method": method, "params": values}))
        while True:
            answer = json.loads(self._socket.recv(timeout=60))
            if answer.get("id") == self._count:
                return answer["result"]

    @property
    def text(self):
        """What a person can read on the page."""
        script = {"expression": "document.body ? document.body.innerText : ''"}
        return self.call("Runtime.evaluate", **script)["result"].get("value", "")

    def screenshot(self):
        """Return the page as (H, W, 3) RGB."""
        import cv2
        import numpy as np

        png = base64.b64decode(self.call("Page.captureScreenshot", format="png")["data"])
        return cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)[:, :, ::-1]
