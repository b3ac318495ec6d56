"""Run the tests of one mutant in a copy of the tree."""

import dataclasses
import os
import re
import resource
import shutil
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

_LEFT_OUT = (".git", ".venv", "results", "dist", "build", "__pycache__", ".hypothesis",
             ".pytest_cache", ".ruff_cache")  # fmt: skip
_OWN_CACHE = "tests/runtime/test_programs.py"
"""Tests of the package's own cache, which is not used together with that of JAX."""
_WORDS = {"caught": "caught by", "timeout": "no end", "survived": "SURVIVED", "void": "VOID"}


@dataclasses.dataclass
class Outcome:
    """Outcome of a mutant: `caught` by a test, `timeout` (an endless loop, also noticed), or
    `survived`.

    `void`: the test also fails without the change, or the change cannot be made."""

    key: str
    place: str
    change: str
    verdict: str
    by: str
    seconds: float

    @property
    def noticed(self) -> bool:
        """Whether a user of the tests would have noticed the mistake."""
        return self.verdict in ("caught", "timeout")

    def row(self) -> str:
        """Return two lines for the table."""
        head = f"{self.place}  {_WORDS[self.verdict]} {self.by}  ({self.seconds:.0f} s)"
        return f"{head}\n    {self.change}"


class Copy:
    """A copy of the tree in `folder` in which modules can be changed; the tree itself never is."""

    def __init__(self, root: Path, folder: Path, cache: Path, cpu_seconds: int):
        self.folder, self.cpu_seconds = folder, cpu_seconds
        ignore = shutil.ignore_patterns(*_LEFT_OUT)
        shutil.copytree(root, folder, ignore=ignore)
        # Programs that a mutant does not change are compiled only once.
        self.environment = os.environ | {
            "JAX_COMPILATION_CACHE_DIR": str(cache),
            "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS": "0.3",
            "PYTHONPATH": os.pathsep.join(filter(None, (str(folder), os.getenv("PYTHONPATH")))),
            "HYPOTHESIS_STORAGE_DIRECTORY": str(folder / ".hypothesis"),
        }
        self.environment.pop("ROOTSOPT_TEST_CACHE", None)
        self._stamp = time.time()

    def run(self, tests: tuple[str, ...], *options: str) -> tuple[int, list[str], str]:
        """Return the exit code of pytest, the failed tests, and the output.

        The process is killed after a limit of processor time, however busy the machine is."""
        command = [sys.executable, "-m", "pytest", "-p", "tests.mutants.order", "-rfE", "--tb=line"]
        command += ["-p", "no:cacheprovider", "-m", "not long", *options, *tests]

        def bounded():
            resource.setrlimit(resource.RLIMIT_CPU, (self.cpu_seconds, self.cpu_seconds))

        environment = dict(self.environment)
        if any(test.startswith(_OWN_CACHE) for test in tests):
            del environment["JAX_COMPILATION_CACHE_DIR"]
        done = subprocess.run(
            command,
            cwd=self.folder,
            env=environment,
            preexec_fn=bounded,
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            stdin=subprocess.DEVNULL,
            text=True,
            errors="replace",
            check=False,
        )
        failed = re.findall(
            r"^(?:FAILED|ERROR) (tests/\S+?\.py(?:::.*?)?)(?: - |$)", done.stdout, re.M
        )
        return done.returncode, failed, done.stdout

    def failing(self, tests: Iterable[str]) -> list[str]:
        """Return those of `tests` that fail without any change."""
        own = [test for test in tests if test.startswith(_OWN_CACHE)]
        groups = own, [test for test in tests if test not in own]
        return [one for group in groups if group for one in self.run(tuple(group))[1]]

    def write(self, file: str, source: str) -> None:
        """Write a module, newer than any compiled form of it."""
        path = self.folder / file
        path.write_text(source)
        self._stamp += 2
        os.utime(path, (self._stamp, self._stamp))

    def trial(self, key: str, place: str, change: str, file: str, source: str, tests) -> Outcome:
        """Return the outcome for one module changed to `source`."""
        original = (self.folder / file).read_text()
        began = time.monotonic()
        self.write(file, source)
        try:
            code, failed, output = self.run(tests, "-x")
        finally:
            self.write(file, original)
        seconds = time.monotonic() - began
        if code == 0:
            verdict, by = "survived", ""
        elif failed and code in (1, 2):
            verdict, by = "caught", failed[0]
        elif code in (-9, -24):  # of RLIMIT_CPU
            verdict, by = "timeout", f"within {self.cpu_seconds} s of processor time"
        elif code < 0:
            verdict, by = "caught", f"signal {-code}"
        elif code in (2, 4) and "rror" in output:  # The package cannot even be imported.
            verdict, by = "caught", "import"
        else:
            verdict, by = "void", " ".join(output.split())[-200:]
        return Outcome(key, place, change, verdict, by, seconds)
