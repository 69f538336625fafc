"""Pages in headless Chromium, and a web server for them."""

import functools
import http.server
import shutil
import threading

import cv2
import numpy as np

NAMES = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable")
CHROMIUM = next(filter(None, map(shutil.which, NAMES)), None)
WIDTH = 480
HEIGHT = 360
# A software rasteriser on a busy machine starts slowly.
TIMEOUT_MS = 60_000
HIDDEN = "#bar, #legend, #message, #notes {visibility: hidden}"
# Sorting waits for `sortAll`, from the beginning of the page.
HOLD_FIRST_SORTING = """
const post = Worker.prototype.postMessage;
const held = new Promise((resolve) => (window.sortAll = resolve));
Worker.prototype.postMessage = function (message, ...rest) {
  const send = () => post.call(this, message, ...rest);
  if (message.name === "sortSplats32") held.then(send);
  else send();
};
"""


class Page:
    """A page with what it requested and what it reported; it has Playwright's methods, too."""

    def __init__(self, browser, address, script="", **context):
        options = {"viewport": {"width": WIDTH, "height": HEIGHT}, **context}
        self.page = browser.new_context(**options).new_page()
        self.page.add_init_script(script)
        self.page.set_default_timeout(TIMEOUT_MS)
        self.errors = []
        self.requests = []
        self.page.on(
            "console",
            lambda m: self.errors.append(m.text) if m.type in ("error", "warning") else None,
        )
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        self.page.goto(address)

    def __getattr__(self, name):
        return getattr(self.page, name)

    def __enter__(self):
        return self

    def __exit__(self, *error):
        self.page.context.close()

    def wait(self, condition):
        """Wait for a condition; wait_for_function() needs `eval`, which the player forbids."""
        for _ in range(TIMEOUT_MS // 50):
            if self.page.evaluate(condition):
                return
            self.page.wait_for_timeout(50)
        raise AssertionError(f"{condition} does not become true; {self.text('body')} {self.errors}")

    def text(self, selector):
        return self.page.locator(selector).inner_text()

    def image(self):
        """Return the image behind the controls."""
        style = self.page.add_style_tag(content=HIDDEN)
        image = cv2.cvtColor(
            cv2.imdecode(np.frombuffer(self.page.screenshot(), np.uint8), 1), cv2.COLOR_BGR2RGB
        )
        style.evaluate("node => node.remove()")
        return image


class served:
    """Serve a folder on this machine, as a context that returns its address."""

    def __init__(self, folder):
        handler = functools.partial(_Quiet, directory=str(folder))
        self.server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler)

    def __enter__(self):
        threading.Thread(target=self.server.serve_forever, daemon=True).start()
        return f"http://127.0.0.1:{self.server.server_port}"

    def __exit__(self, *error):
        self.server.shutdown()
        self.server.server_close()


class _Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, format, *args):
        pass
