"""Tests of a command's process: signals, closed and full streams, odd files as config."""

import os
import signal
import subprocess
import sys
import threading
import time
from unittest import mock

import pytest

from rootsopt.commands.console import COMMANDS, main
from tests.weight import ROOT

CIC = str(ROOT / "configs" / "cic_drawn.yaml")


def python(code, *arguments, **options):
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True} | options
    return subprocess.Popen(
        [sys.executable, "-c", code, *arguments],
        cwd=ROOT,
        # If the tests run in the background, Ctrl-C is ignored in their child processes too.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        **options,
    )


MODULE = "import runpy, sys; runpy.run_module(sys.argv.pop(1), run_name='__main__', alter_sys=True)"
DOOR = "import os, signal, sys, threading, time; from rootsopt.commands import door\n"
WORK = f"""{DOOR}
def work():
    print("x" * int(sys.argv[2]), flush=True)
    print("said", file=sys.stderr, flush=True)
    return int(sys.argv[1])
sys.exit(door.through("test", work, own=True))
"""


def ended(code, *arguments, **options):
    """Return exit code, stdout and stderr of a process that has run `code`."""
    process = python(code, *arguments, **options)
    out, err = process.communicate()
    return process.returncode, out, err


# Buffered output is written at the very end of the process.
BUFFERED = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}


def shell(redirection, code, size=10):
    """Return exit code and stderr of a process that prints, with a shell's redirection."""
    command = f'"$0" -c "$1" {code} {size} {redirection}; exit ${{PIPESTATUS[0]}}'
    done = subprocess.run(
        ["bash", "-c", command, sys.executable, WORK],
        cwd=ROOT, capture_output=True, text=True, check=False, env=BUFFERED,
    )  # fmt: skip
    return done.returncode, done.stderr


@pytest.mark.parametrize("code", [0, 3])
@pytest.mark.parametrize(
    ("redirection", "size"),
    [("| true", 200_000), *((one, 10) for one in ("| true", ">&-", "2>&-", ">&- 2>&- <&-"))],
)
def test_the_exit_code_is_the_runs_own(redirection, code, size):
    """The exit code does not depend on who reads the output, or on whether it is still read."""
    assert shell(redirection, code, size) in ((code, "said\n"), (code, ""))


@pytest.mark.parametrize("code", [0, 3])
def test_output_that_cannot_be_written_is_told(code):
    full = "standard output cannot be written: no space left on device; redirect it elsewhere"
    assert shell(">/dev/full", code) == (2, f"said\nrootsopt test: {full}\n")
    assert shell("2>/dev/full", code) == (code, "")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [(["--version"], 0), (["profile", "--help"], 0), ([], 2)],
)
def test_help_into_a_closed_pipe(arguments, code):
    reading, writing = os.pipe()
    os.close(reading)
    found = ended(MODULE, "rootsopt", *arguments, stdout=writing, env=BUFFERED)
    os.close(writing)
    assert found == (code, None, "")


@pytest.mark.parametrize(
    ("code", "variables", "found"),
    [
        # The process ends without waiting for a compilation that is no longer needed.
        (
            "go = lambda: threading.Thread(target=time.sleep, args=(60,)).start();"
            "door.leave(door.through('test', lambda: go() or print('said') or 3, own=True))",
            {},
            (3, "said\n", ""),
        ),
        # As for a background job of a script.
        (
            "signal.signal(signal.SIGINT, signal.SIG_IGN);"
            "kill = lambda: (os.kill(os.getpid(), signal.SIGINT), time.sleep(0.5));"
            "sys.exit(door.through('test', lambda: kill() and 0, own=True))",
            {},
            (0, "", ""),
        ),
        (
            "sys.exit(door.through('test', lambda: print('µm \\udcff') or 0, own=True))",
            {"PYTHONIOENCODING": "ascii", "PYTHONUTF8": "0"},
            (0, "?m ?\n", ""),
        ),
    ],
    ids=["thread", "signals that are ignored", "letters that the terminal lacks"],
)
def test_the_end_of_a_process(code, variables, found):
    began = time.monotonic()
    assert ended(DOOR + code, env=BUFFERED | variables) == found
    assert time.monotonic() - began < 30


# ------------------------------------------------------------------------- signals


WAITING = (
    DOOR
    + """
from rootsopt.view.runs import RunFolder
def work():
    with RunFolder(sys.argv[1]) as folder, door.leaving(folder.abandon):
        folder.write_text("config.yaml", "new")
        {wait}
        folder.write_json("result.json", {{}})
        folder.put_in_place()
    return 3
door.leave(door.through("test", work, own=True))
"""
)
# Unlike a sleep of the C library, this does not end at a signal.
COMPILED = """print('here', flush=True)
        import hashlib; hashlib.pbkdf2_hmac("sha256", b"a", b"b", 10**9)"""
PATIENT = """
        with door.patience("finishing") as stop:
            print('here', flush=True)
            while not stop.is_set() or "{twice}": time.sleep(0.01)"""


FINISHING = signal.SIGTERM, "SIGTERM: finishing (once more to stop at once)"


@pytest.mark.parametrize(
    ("wait", "signals", "left"),
    [
        (COMPILED, [(signal.SIGTERM, "stopped by SIGTERM; {run} is unchanged")], set()),
        (PATIENT.format(twice=""), [FINISHING], {"run", "config.yaml", "result.json"}),
        (
            PATIENT.format(twice="yes"),
            [FINISHING, (signal.SIGINT, "stopped by Ctrl-C; {run} is unchanged")],
            set(),
        ),
    ],
    ids=["in compiled code", "a patient run", "a patient run at the second signal"],
)
def test_a_signal_stops_a_run(tmp_path, wait, signals, left):
    """A signal also stops compiled code, which Python cannot interrupt; nothing is left behind. A
    patient run ends by itself, or at a second signal."""
    process = python(WAITING.format(wait=wait), str(tmp_path / "run"))
    assert process.stdout.readline() == "here\n"
    assert len(os.listdir(tmp_path)) == 2
    for number, said in signals:
        process.send_signal(number)
        assert process.stderr.readline() == f"rootsopt test: {said.format(run=tmp_path / 'run')}\n"
    assert (process.wait(20), process.stderr.read()) == (3, "")
    assert {path.name for path in tmp_path.rglob("*")} == left


@pytest.mark.parametrize(
    ("command", "module"),
    [
        ("rootsopt simulate", "argparse"),
        ("rootsopt.simulate", "jax"),
        ("rootsopt.optimize", "pydantic"),
    ],
)
def test_an_interrupt_during_imports(tmp_path, command, module):
    """An interrupt is handled while a module is imported; a stand-in of that name never returns."""
    endless = "print('here', flush=True)\nimport time\ntime.sleep(60)\n"
    (tmp_path / f"{module}.py").write_text(endless)
    arguments = [*command.split(), CIC, "-o", str(tmp_path / "run")]
    environment = os.environ | {"PYTHONPATH": f"{tmp_path}{os.pathsep}{ROOT}"}
    process = python(MODULE, *arguments, env=environment)
    assert process.stdout.readline() == "here\n"
    process.send_signal(signal.SIGINT)
    _, told = process.communicate()
    assert (process.returncode, told.count("\n")) == (3, 1)
    assert "stopped by Ctrl-C" in told


def test_called_from_python_nothing_global_changes(tmp_path, capsys, monkeypatch):
    def state():
        return *map(signal.getsignal, (signal.SIGINT, signal.SIGTERM)), sys.stdout, sys.stderr

    before, threads = state(), threading.active_count()
    assert main(["profile", "missing.yaml"]) == 2
    assert (state(), threading.active_count()) == (before, threads)
    monkeypatch.setattr(sys, "argv", ["rootsopt", "--version"])
    assert main() == 0
    assert state() == before


WORKS = ", ".join(
    f"rootsopt.commands.work.{name}"
    for name in ("attractors", "optimize", "pareto", "simulate", "sweep")
)


@pytest.mark.parametrize(
    ("code", "slow"),
    [
        (
            "import rootsopt.simulate, rootsopt.__main__, rootsopt.optimize.__main__",
            ["numpy", "yaml", "pydantic", "jax", "rich"],
        ),
        (
            f"from rootsopt.commands import cli, table; cli.parser(table.profile)\nimport {WORKS}",
            ["matplotlib", "optax", "PIL", "scipy", "xarray", "jinja2", "bokeh",
             "rootsopt.view.pages.html"],
        ),
    ],
    ids=["doors", "commands"],
)  # fmt: skip
def test_what_is_slow_is_imported_where_it_is_used(code, slow):
    """Doors load little, and commands not what a run may not need; figures in the background."""
    code = f"import sys\n{code}\nprint([n for n in {slow} if n in sys.modules])"
    assert ended(code)[1] == "[]\n"


# ------------------------------------------------------------------- odd arguments


def test_an_empty_output_is_refused(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    for command in (x.name for x in COMMANDS.values() if x.takes == "CONFIG" and x.writes):
        for arguments in (["-o", ""], ["--output="]):
            assert main([command, CIC, *arguments]) == 2
            (told,) = capsys.readouterr().err.splitlines()
            assert "`--output` must name a folder" in told
    assert os.listdir(tmp_path) == []


def test_wrong_arguments_take_one_line(capsys):
    for arguments in ([], [CIC, "--nonsense"], [CIC, "-o"], [CIC, "two"]):
        with pytest.raises(SystemExit, match=r"^2$"):
            main(["profile", *arguments])
        assert capsys.readouterr().err.count("\n") == 1


def test_full_disks_elsewhere_take_one_line(capsys, monkeypatch):
    full = OSError(28, "No space left on device", "elsewhere/file")
    monkeypatch.setattr("rootsopt.commands.cli.load", mock.Mock(side_effect=full))
    assert main(["profile", CIC]) == 2
    assert capsys.readouterr().err == "rootsopt profile: elsewhere/file: no space left on device\n"
