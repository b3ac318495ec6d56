"""The explorer's server: its address, who may use it, how it ends, and what it needs."""

import contextlib
import http.client
import queue
import re
import signal
import socket
import threading
import urllib.parse
import webbrowser
from pathlib import Path
from types import SimpleNamespace

import pytest

from rootsopt.commands.table import explore as command
from rootsopt.config import load
from rootsopt.errors import InputError
from rootsopt.optimize.design import optimize_design
from rootsopt.view.pages.knobs import Engine
from tests.commands.test_door import MODULE, python

CIC = "cic_drawn"


class Idle(Engine):
    """An engine that never gets ready: the server is tested, not what it shows."""

    def shape(self, config):
        raise InputError("no shape")


@contextlib.contextmanager
def serving(engine):
    from rootsopt.view.pages.server import PageServer

    found, stop = queue.SimpleQueue(), threading.Event()
    thread = threading.Thread(target=lambda: PageServer(engine, "cic").run(stop, found.put))
    thread.start()
    yield found.get(timeout=60)
    stop.set()
    thread.join(30)
    assert not thread.is_alive()


@pytest.fixture(scope="module")
def address():
    with serving(Idle(load(CIC), optimize_design)) as found:
        yield found


def get(url, **headers):
    """Return (status, text) of a request."""
    _, _, host, path = url.split("/", 3)
    with contextlib.closing(http.client.HTTPConnection(host, timeout=30)) as connection:
        connection.request("GET", f"/{path}", headers=headers)
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


def test_page_is_served_to_those_who_know_the_token(address):
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", address)
    status, page = get(address)
    assert status == 200
    assert "rootsopt explore cic" in page
    scripts = re.findall(r'(?:src|href)="([^"]+)"', page)
    assert scripts
    here = "static/", address, "data:", "/"
    assert [one for one in scripts if not one.startswith(here) or one.startswith("//")] == []


@pytest.mark.parametrize(
    "path",
    [
        "",
        "ws",
        "static/js/bokeh.min.js",
        "autoload.js",
        "x" * 32 + "/",
        "?token=1",
        "metadata",
        "favicon.ico",
    ],
)
def test_requests_without_the_token_are_refused(address, path):
    assert get(f"{address[:-33]}{path}")[0] == 404


@pytest.mark.parametrize(("origin", "status"), [("http://example.org", 403), (None, 101)])
def test_foreign_pages_may_not_connect(address, origin, status):
    """A web page of another origin that knows the address cannot open the connection."""
    headers = {"Upgrade": "websocket", "Connection": "Upgrade", "Sec-WebSocket-Version": "13",
               "Sec-WebSocket-Key": "dGhlIHNhbXBsZSBub25jZQ==",
               "Origin": origin or "/".join(address.split("/")[:3])}  # fmt: skip
    assert get(f"{address}ws", **headers)[0] == status


def test_malformed_requests_leave_no_traceback(address, capfd):
    """They are answered or dropped; stderr has at most one line for each, without the token."""
    _, _, host, token, _ = address.split("/")
    page = f"/{token}/"
    end = f" HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n\r\n"
    upgrade = (
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        f"Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nOrigin: http://{host}\r\n"
    )
    socket_of = f"GET {page}ws HTTP/1.1\r\nHost: {host}\r\n{upgrade}"
    requests = [
        "GET / HTTP/9.9\r\n\r\n", "\x16\x03\x01\xff\r\n\r\n", "GET /\r\n\r\n", f"FOO {page}{end}",
        f"GET /\xff{end}", f"GET http://[{end}", "GET / HTTP/1.1\r\nHost: \x00\r\n\r\n",
        f"POST /{end.replace('close', 'close' + chr(13) + chr(10) + 'Content-Length: -1')}",
        f"GET {page}static/%00{end}", f"GET {page}static/%ff{end}",
        f"GET {page}?bokeh-token=zz{end}",
        f"GET {page}autoload.js?bokeh-autoload-element=1&bokeh-session-id=%00{end}",
        f"{socket_of}\r\n", f"{socket_of}Sec-WebSocket-Protocol: bokeh, zz\r\n\r\n",
        f"{socket_of}Sec-WebSocket-Protocol: bokeh\r\n\r\n{chr(255) * 30}",
    ]  # fmt: skip
    for text in requests:  # No HTTP library would send them.
        with socket.create_connection(host.split(":"), timeout=30) as connection:
            connection.sendall(text.encode("latin1"))
            connection.makefile("rb").readline()
    assert get(f"{address}static/js/bokeh.min.js")[0] == 200
    lines = capfd.readouterr().err.splitlines()
    assert lines
    assert all(line.startswith("rootsopt: explore: a request failed: ") for line in lines)
    assert token not in "".join(lines)


def test_browser_is_given_no_secret(monkeypatch):
    """Its arguments, which all users can list, name a file that only this user can read."""
    opened, ready = [], threading.Event()

    def run(stop, started):
        started("http://127.0.0.1:1/secret/")
        assert ready.wait(60)

    def browse(address):
        file = Path(urllib.parse.unquote(address.removeprefix("file://")))
        opened.extend((address, file, file.read_text(), file.parent.stat().st_mode & 0o777))
        ready.set()

    server = "rootsopt.view.pages.server.PageServer"
    monkeypatch.setattr(server, lambda *_: SimpleNamespace(run=run))
    monkeypatch.setattr("rootsopt.view.pages.knobs.Engine.prepare", lambda self: None)
    monkeypatch.setattr(webbrowser, "open", browse)
    assert command.main([CIC]) == 0
    address, file, text, mode = opened
    assert "secret" not in address
    assert 'url=http://127.0.0.1:1/secret/"' in text
    assert mode == 0o700
    assert not file.exists()


def test_server_listens_on_the_loopback_address_only(address):
    port = int(re.findall(r":(\d+)/", address)[0])
    for family, one in ((socket.AF_INET, "127.0.0.2"), (socket.AF_INET6, "::1")):
        with socket.socket(family) as probe:
            probe.settimeout(5)
            assert probe.connect_ex((one, port)) != 0


def test_port_in_use_is_named(capsys):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert command.main([CIC, "--no-browser", "--port", str(port)]) == 2
    assert f"{port} cannot be used" in capsys.readouterr().err


def test_ctrl_c_ends_with_success():
    """The address is printed on standard output; Ctrl-C ends with exit code 0 and one line."""
    process = python(MODULE, "rootsopt", "explore", CIC, "--no-browser")
    assert get(process.stdout.readline().split()[-1])[0] == 200
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 0
    assert errors == "rootsopt explore: Ctrl-C: the page closes (once more to stop at once)\n"
