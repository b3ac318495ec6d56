"""Mistakes made by hand, and a random choice of those that operators can make."""

import ast
import random
from typing import NamedTuple

import yaml

from tests.mutants.rooms import ROOMS
from tests.weight import ROOT


class Mistake(NamedTuple):
    """A `change` of a `file`, its whole `source` with the mistake, and the tests of it."""

    file: str
    change: str
    source: str
    tests: tuple[str, ...]

    def __str__(self) -> str:
        return f"{self.file}: {self.change}"


def by_hand() -> list[Mistake]:
    """Return the mistakes of `by_hand.yaml`. Raises `LookupError` if a text does not occur once."""
    found = []
    for row in yaml.safe_load((ROOT / "tests" / "mutants" / "by_hand.yaml").read_text()):
        text, was, becomes = (ROOT / row["file"]).read_text(), row["was"], row["becomes"]
        if text.count(was) != 1:
            raise LookupError(f"{row['file']}: {was!r} must occur once")
        change, source = f"{row['mistake']}: {becomes}", text.replace(was, becomes)
        found.append(Mistake(row["file"], change, source, (row["test"],)))
    return found


def chosen(seed: int, count: int) -> list[Mistake]:
    """Return `count` mistakes of the operators, drawn at random from all numerical modules."""
    from cosmic_ray.ast import ast_nodes, get_ast
    from cosmic_ray.mutating import mutate_code

    from tests.mutants.operators import operators

    draw, found = random.Random(seed), []
    texts = {file: (ROOT / file).read_text() for file in sorted(ROOMS)}
    while len(found) < count:
        (file,) = draw.choices(list(texts), [len(text) for text in texts.values()])
        operator, source = draw.choice(operators()), texts[file]
        nodes = [*ast_nodes(get_ast(source))]
        places = [place for node in nodes for place in operator.mutation_positions(node)]
        if not places:
            continue
        number = draw.randrange(len(places))
        mutated = mutate_code(source, operator, number)
        if mutated is not None and _counts(source, places[number][0][0], mutated):
            line = source.splitlines()[places[number][0][0] - 1].strip()
            change = f"{type(operator).__name__} {number} in {line}"
            found.append(Mistake(file, change, mutated, ROOMS[file]))
    return found


def _counts(source: str, line: int, mutated: str) -> bool:
    """Return whether a change at a line can affect results: not in annotations, nor in messages."""
    plain = ast.Raise | ast.Assert | ast.Import | ast.ImportFrom | ast.AnnAssign | ast.arguments
    for node in ast.walk(ast.parse(source)):
        inner = node.args if isinstance(node, ast.arguments) else [node]
        if isinstance(node, plain) and any(x.lineno <= line <= x.end_lineno for x in inner):
            return False
    try:
        return ast.dump(ast.parse(source)) != ast.dump(ast.parse(mutated))
    except SyntaxError:
        return False
