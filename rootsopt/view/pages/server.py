"""Serves the explorer's page on the loopback address, under a secret path."""

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import logging
import secrets
import threading
from collections.abc import Callable

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.server.server import BaseServer
from bokeh.server.tornado import BokehTornado
from tornado.httpserver import HTTPServer
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.netutil import bind_sockets

from rootsopt.errors import InputError
from rootsopt.runtime.environment import say, shortened
from rootsopt.view.pages.knobs import Engine
from rootsopt.view.pages.page import Page

ADDRESS = "127.0.0.1"
"""The only address on which the page is served."""

# Bytes of the secret in the page's address.
_TOKEN = 24

# Interval (ms) at which the server checks whether to end.
_POLL = 100

# Time (ms) for which the session of a closed or unreachable tab is kept.
_LIFETIME = 30_000


class _OneLine(logging.Handler):
    """Prints an error of the libraries as one line; a malformed request needs no traceback."""

    def emit(self, record: logging.LogRecord) -> None:
        error = record.exc_info[1] if record.exc_info else None
        words = record.getMessage() if error is None else f"{type(error).__name__}: {error}"
        say(f"explore: a request failed: {shortened(words)}")


def _keep_quiet() -> None:
    """Let the libraries report errors alone, in one line each, and no requests.

    Their own messages hold tracebacks and the secret address."""
    for name in ("asyncio", "bokeh", "tornado"):
        logger = logging.getLogger(name)
        logger.handlers, logger.propagate = [_OneLine()], False
        logger.setLevel(logging.ERROR)
    logging.getLogger("tornado.access").setLevel(logging.CRITICAL)


class PageServer:
    """Serves one page per browser tab, each with a session of its own.

    `engine`: computes what the pages show; `source`: name of the config; `port`: of the server, 0
    for any free one. `url` is the address of the page, with its token: all paths of the server
    begin with the token. Pages of other sites do not know it, not even one whose name resolves to
    this machine (DNS rebinding).

    Raises `InputError` if the port cannot be used."""

    def __init__(self, engine: Engine, source: str, port: int = 0):
        _keep_quiet()
        prefix = f"/{secrets.token_urlsafe(_TOKEN)}"
        loop = IOLoop()
        try:
            sockets = bind_sockets(port, ADDRESS)
        except OSError as error:
            raise InputError(
                f"`--port` must be a free port, but {port} cannot be used "
                f"({error.strerror or error}); choose another one, or leave `--port` out"
            ) from error
        port = sockets[0].getsockname()[1]
        pages = BokehTornado(
            {"/": Application(FunctionHandler(lambda tab: Page(tab, engine, source)))},
            prefix=prefix,
            # Only the page's own scripts may connect.
            extra_websocket_origins=[f"{name}:{port}" for name in (ADDRESS, "localhost")],
            ico_path="none",
            unused_session_lifetime_milliseconds=_LIFETIME,
            check_unused_sessions_milliseconds=_LIFETIME // 3,
        )
        web = HTTPServer(pages)
        web.add_sockets(sockets)
        self.server = BaseServer(loop, pages, web)
        self.url = f"http://{ADDRESS}:{port}{prefix}/"

    def run(self, stop: threading.Event, started: Callable[[str], None]) -> None:
        """Serve pages until `stop` is set. `started` is called with the address."""
        loop = self.server.io_loop
        self.server.start()
        watch = PeriodicCallback(lambda: loop.stop() if stop.is_set() else None, _POLL)
        loop.add_callback(watch.start)
        loop.add_callback(started, self.url)
        try:
            loop.start()
        finally:
            watch.stop()
            self.server.stop()
