"""Code blocks of Markdown pages, and how tests run them."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import NamedTuple

from rootsopt.commands.console import main

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"


class Fence(NamedTuple):
    """A fenced block: `language`, the `words` after it, and its `text`."""

    language: str
    words: str
    text: str


def blocks_of(page: Path) -> list[Fence]:
    """Return the fenced blocks of a page, in order."""
    found = re.findall(r"^```([^\s`]*)[ ]*([^\n`]*)\n(.*?)^```$", page.read_text(), re.M | re.S)
    return [Fence(*one) for one in found]


def in_shell(text: str, folder: Path) -> subprocess.CompletedProcess:
    """Run shell commands in a folder, where `rootsopt` is the package of this tree."""
    program = f'set -e\nrootsopt() {{ "{sys.executable}" -m rootsopt "$@"; }}\n{text}'
    return _run(["bash", "-c", program], folder)


def in_process(text: str, folder: Path, capsys, monkeypatch) -> subprocess.CompletedProcess:
    """Run the `rootsopt` commands of a shell block in this process and in a folder."""
    monkeypatch.chdir(folder)
    lines = text.replace("\\\n", " ").splitlines()
    codes = [main(shlex.split(line)[1:]) for line in lines if line.startswith("rootsopt ")]
    return subprocess.CompletedProcess(text, codes[-1], *capsys.readouterr())


def in_python(text: str, folder: Path) -> subprocess.CompletedProcess:
    """Run Python in a process and folder of its own, without a display."""
    file = folder / "page.py"
    file.write_text(text)
    return _run([sys.executable, str(file)], folder)


def _run(command: list[str], folder: Path) -> subprocess.CompletedProcess:
    places = [str(ROOT), *filter(None, [os.environ.get("PYTHONPATH")])]
    extra = {"PYTHONPATH": os.pathsep.join(places), "MPLBACKEND": "Agg"}
    return subprocess.run(
        command,
        cwd=folder,
        env={**os.environ, **extra},
        capture_output=True,
        text=True,
        check=False,
        timeout=1800,
    )
