"""Serves the page of a scene that still trains, on this machine."""

from __future__ import annotations

import errno
import html
import json
import os
import secrets
import sys
import threading
import time
from collections.abc import Mapping
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

from heatsplat.contracts import SceneError

WAITING = """<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta http-equiv="refresh" content="2"><title>{title}</title>
<link rel="icon" href="data:,"></head>
<body style="font: 16px/1.5 system-ui, sans-serif; margin: 3em"><h1 style="font-size: 1.2em">{title}</h1>
<p>{text}</p></body></html>
"""
LAST_LOOK_S = 3.0  # that a page has to fetch the last state: it asks every two seconds


class LiveServer:
    """A server of two things: ``/``, the page with the newest state, and ``/status``, which the page asks for.

    It listens from the start, and serves in threads of its own that end with the process. The status is JSON: ``run``, which is
    another one for each server, ``state``, the number of the newest one, 0 before there is any, and what ``tell`` was told.

    Args:
        title: of the page before there is a state.
        host, port: where it listens; port 0 takes a free one, which ``url`` tells.

    Raises:
        SceneError: that address cannot be had, with the key and the remedy.
    """

    def __init__(self, title: str, host: str, port: int) -> None:
        self.run = secrets.token_hex(4)
        self._status: dict[str, Any] = {"run": self.run, "state": 0}
        self._page = b""
        self._title = title
        self._lock = threading.Lock()
        self._asked: float | None = None  # when somebody asked last
        self._served = (0, False)  # the state that was fetched last, and whether a page knows of the end
        try:
            self._http = _Http((host, port), _Handler)
        except OSError as error:
            raise SceneError(_refusal(host, port, error)) from error
        self._http.live = self
        self.port = self._http.server_address[1]
        shown = "localhost" if host in ("127.0.0.1", "0.0.0.0", "") else host
        self.url = f"http://{shown}:{self.port}"
        self._thread = threading.Thread(
            target=self._http.serve_forever, kwargs={"poll_interval": 0.1}, name="live viewer", daemon=True
        )
        self._thread.start()

    def watched(self, within_s: float) -> bool:
        """Whether a browser asked for something in the last seconds."""
        return self._asked is not None and time.monotonic() - self._asked <= within_s

    def tell(self, **told: Any) -> None:
        """Adds to the status."""
        with self._lock:
            self._status |= told

    def show(self, page: str, state: int) -> None:
        """A newer state takes the place of the one that was served."""
        content = page.encode("utf-8")
        with self._lock:
            self._page = content
            self._status["state"] = state

    def end(self, phase: str, within_s: float) -> None:
        """Tells that training is over, and gives a page that was open in the last seconds the time to fetch the last state."""
        self.tell(phase=phase)
        end = time.monotonic() + LAST_LOOK_S
        while self.watched(within_s) and self._served != (self._status["state"], True) and time.monotonic() < end:
            time.sleep(0.05)

    def close(self) -> None:
        """Ends it; the port is free again."""
        self._http.shutdown()
        self._http.server_close()
        self._thread.join()

    def answer(self, path: str) -> tuple[str, bytes] | None:
        """Type and content of what is served at a path; None for nothing."""
        with self._lock:
            if path not in ("/", "/status"):
                return None
            self._asked = time.monotonic()
            if path == "/status":
                self._served = (self._served[0], "phase" in self._status)
                return "application/json", json.dumps(self._status).encode("utf-8")
            self._served = (self._status["state"], self._served[1])
            return "text/html; charset=utf-8", self._page or self._waiting()

    def _waiting(self) -> bytes:
        text = self._status.get("problem") or "Waiting for the first state. This page opens it by itself."
        return WAITING.format(title=html.escape(self._title), text=html.escape(text)).encode("utf-8")


class _Http(ThreadingHTTPServer):
    daemon_threads = True
    # On Windows it would let two programs listen at one port.
    allow_reuse_address = os.name != "nt"
    live: LiveServer

    def handle_error(self, request: Any, client_address: Any) -> None:
        if not isinstance(sys.exc_info()[1], ConnectionError):  # a browser that went away
            super().handle_error(request, client_address)


class _Handler(BaseHTTPRequestHandler):
    server: _Http

    def do_GET(self) -> None:
        found = self.server.live.answer(self.path.partition("?")[0])
        if found is None:
            self.send_error(404)
            return
        kind, content = found
        self.send_response(200)
        headers: Mapping[str, str] = {
            "Content-Type": kind,
            "Content-Length": str(len(content)),
            "Cache-Control": "no-store",
        }
        for name, value in headers.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(content)

    def log_message(self, *_: Any) -> None:
        """A run's log is not for requests."""


def _refusal(host: str, port: int, error: OSError) -> str:
    if error.errno == errno.EADDRINUSE:
        return (
            f"callbacks.live.port={port}: another program listens there, maybe another run. Take a free one with "
            "callbacks.live.port=0, or give another number"
        )
    if error.errno == errno.EACCES:
        return f"callbacks.live.port={port} is not allowed here: take one above 1023, or a free one with callbacks.live.port=0"
    return (
        f"callbacks.live.host={host} is no address at which this machine can listen ({error.strerror or error}): give "
        "127.0.0.1 for this machine alone, or 0.0.0.0"
    )
