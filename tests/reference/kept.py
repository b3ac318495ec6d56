"""The file of stored results."""

import json
from pathlib import Path
from typing import Any

from tests.reference import package

FILE = Path(__file__).with_name("reference.json")


def read() -> dict[str, dict[str, Any]]:
    """Return the stored results by name of the case."""
    return json.loads(FILE.read_text())["results"] if FILE.exists() else {}


def write(results: dict[str, dict[str, Any]]) -> None:
    """Store results: numbers with all their digits, a line for each case."""
    head = {"call": package.CALL, "versions": package.versions()}
    lines = [f"{json.dumps(name)}: {json.dumps(result)}" for name, result in results.items()]
    body = ",\n".join(lines)
    text = f'{json.dumps(head)[:-1]},\n"results": {{\n{body}\n}}}}\n'
    json.loads(text)
    FILE.write_text(text)
