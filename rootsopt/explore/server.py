"""Serves the explorer's page on the loopback address, to those who know its secret address."""

# The models of Bokeh accept more than their annotations say.
# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportCallIssue=false

import logging
import secrets
import socket
import threading
from collections.abc import Callable

from bokeh.application import Application
from bokeh.application.handlers.function import FunctionHandler
from bokeh.document import Document
from bokeh.server.server import Server
from tornado.ioloop import IOLoop, PeriodicCallback
from tornado.web import RequestHandler

from rootsopt.errors import InputError
from rootsopt.explore.engine import Engine
from rootsopt.explore.page import Page

ADDRESS = "127.0.0.1"
"""The only address on which the page is served."""
_TOKEN = 24
"""Bytes of the secret in the page's address."""
_POLL = 100
"""Interval (ms) at which the server looks whether it is to end."""
_LIFETIME = 30_000
"""Time (ms) for which a session is kept whose tab is closed or out of reach."""
_REFUSED = (
    "This address lacks the secret token. Open the address that `rootsopt explore` has printed.\n"
)


class _Refusal(RequestHandler):
    """Answers all requests whose address does not begin with the token."""

    def prepare(self) -> None:
        self.set_status(403)
        self.set_header("Content-Type", "text/plain; charset=utf-8")
        self.finish(_REFUSED)


class PageServer:
    """Serves one page per browser tab, each with a session of its own.

    `engine`: computes what the pages show; `source`: name of the config; `port`: of the server, 0
    for any free one. `url` is the address of the page, with its token: all paths of the server
    begin with the token, and any other request is refused.

    Raises `InputError` if the port cannot be used."""

    def __init__(self, engine: Engine, source: str, port: int = 0):
        self.engine, self.source = engine, source
        token = secrets.token_urlsafe(_TOKEN)
        # A refused request is no event worth a line on stderr.
        logging.getLogger("tornado.access").setLevel(logging.ERROR)
        application = Application(FunctionHandler(self._open))
        try:
            self.port = port or _free_port()
            self.server = Server(
                {"/": application},
                io_loop=IOLoop(),
                address=ADDRESS,
                port=self.port,
                prefix=f"/{token}",
                # Only the page's own scripts may connect.
                allow_websocket_origin=[f"{ADDRESS}:{self.port}"],
                ico_path="none",
                default_handler_class=_Refusal,
                unused_session_lifetime_milliseconds=_LIFETIME,
                check_unused_sessions_milliseconds=_LIFETIME // 3,
            )
        except OSError as error:
            raise InputError(
                f"`--port` must be a free port, but {port} cannot be used "
                f"({error.strerror or error}); choose another one, or leave `--port` out"
            ) from error
        self.url = f"http://{ADDRESS}:{self.port}/{token}/"

    def _open(self, document: Document) -> None:
        page = Page(document, self.engine, self.source)
        document.on_session_destroyed(lambda _: page.close())

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


def _free_port() -> int:
    with socket.socket() as one:
        one.bind((ADDRESS, 0))
        return one.getsockname()[1]


__all__ = ["ADDRESS", "PageServer"]
