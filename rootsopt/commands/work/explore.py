"""`rootsopt explore`: serve the page with sliders, and open it in the browser."""

import argparse
import html
import os
import sys
import tempfile
import threading
import webbrowser
from pathlib import Path

from rootsopt.commands import door
from rootsopt.config.reading import Config
from rootsopt.runtime import environment
from rootsopt.scene.check import check_geometry
from rootsopt.view import files, pages


def body(config: Config, options: argparse.Namespace) -> int:
    """Run `rootsopt explore`: serve the page until the user stops it. Return the exit code.

    Raises `InputError` if the config or an option is invalid, or if a library is missing."""
    pages.require("`explore`", "explore")
    check_geometry(config)
    from rootsopt.optimize.design import optimize_design
    from rootsopt.view.pages.knobs import Engine
    from rootsopt.view.pages.server import PageServer

    engine = Engine(config, optimize_design)
    server = PageServer(engine, str(options.config), options.port)

    def prepare() -> None:
        try:
            engine.prepare()
        except Exception as error:
            engine.ready.set()  # Pages meet the same error, and show it.
            environment.say(f"the programs could not be prepared: {error}")

    def started(url: str) -> None:
        print(f"rootsopt explore: {url}\nCtrl-C ends it.", flush=True)
        if not options.no_browser:
            file = _redirection(Path(private), url)
            threading.Thread(target=webbrowser.open, args=(file,), daemon=True).start()

    threading.Thread(target=prepare, daemon=True).start()
    with tempfile.TemporaryDirectory() as private, door.patience("the page closes") as stop:
        try:
            server.run(stop, started)
        except KeyboardInterrupt:  # if Python's own handler of Ctrl-C is in place
            print("rootsopt explore: the page closes", file=sys.stderr)
    if stop.is_set():  # Python would wait for programs that are half compiled.
        sys.stdout.flush()
        os._exit(door.OK)
    return door.OK


def _redirection(folder: Path, url: str) -> str:
    """Write a file that leads a browser to `url`, and return the file's address.

    Every user of this machine can list the arguments of a browser, so that they must not contain
    the secret of the page. The `folder` is the user's own."""
    file = folder / "explore.html"
    target = html.escape(url)
    text = f'<meta http-equiv="refresh" content="0; url={target}"><a href="{target}">{target}</a>'
    files.create(file, text.encode())
    return file.as_uri()
