"""Mistakes made by hand, from `by_hand.yaml`."""

import dataclasses
from pathlib import Path

import yaml

from tests.mutants.names import key_of

_LIST = Path(__file__).with_name("by_hand.yaml")


@dataclasses.dataclass(frozen=True)
class ByHand:
    """One mistake with the name `function`: in `file`, the text `was` is replaced.

    `source`: the whole module with the mistake; None if the text does not occur exactly once."""

    function: str
    file: str
    line: int
    was: str
    becomes: str
    source: str | None
    tests: tuple[str, ...]

    @property
    def key(self) -> str:
        """Name that does not change with the line number."""
        return key_of(self.file, self.function, self.was, self.becomes)


def by_hand(root: Path) -> list[ByHand]:
    """Return the mistakes, each with the module that contains it."""
    found = []
    for row in yaml.safe_load(_LIST.read_text()):
        text, was, becomes = (root / row["file"]).read_text(), row["was"], row["becomes"]
        once = text.count(was) == 1
        found.append(
            ByHand(
                function=row["mistake"],
                file=row["file"],
                line=text[: text.index(was)].count("\n") + 1 if once else 0,
                was=was,
                becomes=becomes,
                source=text.replace(was, becomes) if once else None,
                tests=(row["test"],),
            )
        )
    return found
