"""A page on this machine that shows what a live run sees: no window, no network, no library.

It is served on 127.0.0.1 alone. The browser asks for the newest state and image; older ones are gone.
"""

import errno
import json
import threading
import time
from collections.abc import Callable, Mapping
from http import HTTPStatus
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from jaxtyping import Float
from torch import Tensor

ADDRESS = "127.0.0.1"
_PAGE = Path(__file__).with_name("web_view.html")
_LOOKED = 3.0  # s after its last question, that a page counts as being looked at
_QUALITY = 80  # of JPEG


class WebView:
    """Serves the newest image and state until it is closed.

    `port` 0 takes a free one. `stop` is called when somebody presses the page's button. Raises ValueError where
    another program has the port.
    """

    def __init__(self, port: int, stop: Callable[[], None]) -> None:
        self.stop = stop
        self._state: bytes = b"{}"
        self._image: bytes = b""
        self._asked = -_LOOKED
        view = self

        class Handler(_Handler):
            pass

        Handler.view = view
        try:
            self._server = ThreadingHTTPServer((ADDRESS, port), Handler)
        except OSError as error:
            if error.errno not in (errno.EADDRINUSE, errno.EACCES):
                raise
            raise ValueError(
                f"live.port must be a port that this machine has free, got {port}: {error.strerror}; close the other "
                "program, or give another number, such as live.port=0 for any"
            ) from None
        self.port: int = self._server.server_address[1]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.1,), daemon=True)
        self._thread.start()

    @property
    def url(self) -> str:
        """Where a browser on this machine finds the page."""
        return f"http://{ADDRESS}:{self.port}"

    @property
    def watched(self) -> bool:
        """Whether a page was open a moment ago: nobody else needs a picture."""
        return time.monotonic() - self._asked < _LOOKED

    def show(self, state: Mapping[str, Any], image: Float[Tensor, "3 height width"] | None = None) -> None:
        """The newest state, which must be fit for JSON, and the newest image, RGB in [0, 1]; None leaves the last."""
        if image is not None:
            levels = image.clamp(0, 1).mul(255).round().byte().permute(1, 2, 0).cpu().numpy()
            _, data = cv2.imencode(
                ".jpg", np.ascontiguousarray(levels[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _QUALITY]
            )
            self._image = data.tobytes()
        self._state = json.dumps(state).encode()

    def close(self) -> None:
        """Serve no more."""
        self._server.shutdown()
        self._server.server_close()
        self._thread.join()


class _Handler(BaseHTTPRequestHandler):
    """Answers a browser on this machine, and no page of another site that it has open."""

    view: WebView
    timeout = 10  # s, after which a connection that says nothing is closed

    def do_GET(self) -> None:
        self.view._asked = time.monotonic()
        path = self.path.partition("?")[0]
        if not self._ours():
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"this page is for this machine alone\n")
        elif path == "/":
            self._answer(HTTPStatus.OK, "text/html; charset=utf-8", _PAGE.read_bytes())
        elif path == "/state.json":
            self._answer(HTTPStatus.OK, "application/json", self.view._state)
        elif path == "/frame.jpg" and self.view._image:
            self._answer(HTTPStatus.OK, "image/jpeg", self.view._image)
        else:
            self._answer(HTTPStatus.NOT_FOUND, "text/plain", b"there is /, /state.json and /frame.jpg\n")

    def do_POST(self) -> None:
        if self.path != "/stop" or not self._ours():
            self._answer(HTTPStatus.FORBIDDEN, "text/plain", b"only this page's own button stops the run\n")
            return
        self.view.stop()
        self._answer(HTTPStatus.OK, "text/plain", b"stopping\n")

    def _ours(self) -> bool:
        """Whether the question was asked of this address, and by our own page: other sites' scripts may not."""
        own = {f"{name}:{self.view.port}" for name in (ADDRESS, "localhost")}
        origin = self.headers.get("Origin")
        return self.headers.get("Host") in own and (origin is None or origin.partition("//")[2] in own)

    def _answer(self, status: HTTPStatus, kind: str, body: bytes) -> None:
        self.send_response(status)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: Any) -> None:
        """Say nothing: a page asks several times a second."""
