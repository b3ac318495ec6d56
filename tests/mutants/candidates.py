"""All mutants of the numerical modules, and the seeded choice among them."""

import ast
import dataclasses
import functools
import hashlib
from collections.abc import Iterator
from pathlib import Path

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code

from tests.mutants.equivalent import equivalents
from tests.mutants.names import key_of
from tests.mutants.operators import operators
from tests.mutants.rooms import ROOMS, modules

_SMALL = 40
"""Number of lines of a module below which it has no mutant of its own in a choice."""


@dataclasses.dataclass(frozen=True)
class Mutant:
    """One change of one module: the lines it `was` and `becomes`, inside `function`.

    `source`: the whole module with the change; `tests`: those that should notice it."""

    file: str
    function: str
    line: int
    was: str
    becomes: str
    kind: str
    source: str
    tests: tuple[str, ...]

    @property
    def key(self) -> str:
        """Name that does not change with the line number."""
        return key_of(self.file, self.function, self.was, self.becomes)


@dataclasses.dataclass(frozen=True)
class _Place:
    """A place where an operator applies for the `occurrence`-th time; `rank` orders places by a
    seed."""

    rank: str
    kind: str
    operator: object
    occurrence: int
    function: str
    line: int


def chosen(root: Path, seed: int, count: int) -> list[Mutant]:
    """Return `count` mutants, distributed over modules by length, and over kinds in each module.

    A place is ranked by a hash of its text, not of its line. A change of one module therefore
    leaves the mutants of the others unchanged. Known equivalent mutants are skipped."""
    known = {tuple(one[key] for key in _KEYS) for one in equivalents()}
    files = modules(root)
    sizes = {file: len((root / file).read_text().splitlines()) for file in files}
    found = []
    for file, quota in _quotas(sizes, count).items():
        if quota == 0:
            continue
        places = sorted(_places(root, file, seed), key=lambda place: place.rank)
        fresh: list[Mutant] = []
        used: dict[str, int] = {}
        while places and len(fresh) < quota:
            # Take the first place in rank among the kinds used least so far.
            place = min(places, key=lambda one: used.get(one.kind, 0))
            places.remove(place)
            mutant = _mutant(root, file, place)
            if mutant is None or (file, mutant.function, mutant.was, mutant.becomes) in known:
                continue
            used[place.kind] = used.get(place.kind, 0) + 1
            fresh.append(mutant)
        found += fresh
    return found


_KEYS = "file", "function", "was", "becomes"


def _quotas(sizes: dict[str, int], count: int) -> dict[str, int]:
    """Return the number of mutants of each module, by largest remainders of its share of all
    lines."""
    counted = {file: size for file, size in sizes.items() if size >= _SMALL}
    total = sum(counted.values())
    exact = {file: count * size / total for file, size in counted.items()}
    quotas = {file: int(share) for file, share in exact.items()}
    left = sorted(exact, key=lambda file: quotas[file] - exact[file])
    for file in left[: count - sum(quotas.values())]:
        quotas[file] += 1
    return quotas


def _places(root: Path, file: str, seed: int) -> Iterator[_Place]:
    source = (root / file).read_text()
    lines = source.splitlines()
    outside, functions = _outside(source), _functions(source)
    nodes = list(ast_nodes(get_ast(source)))
    seen: dict[tuple, int] = {}
    for kind, name, operator in operators():
        occurrence = -1
        for node in nodes:
            for start, end in operator.mutation_positions(node):
                occurrence += 1
                if any(begin <= start and end <= stop for begin, stop in outside):
                    continue
                line = start[0]
                inner = [f for f in functions if f[1] <= line <= f[2]]
                function = max(inner, key=lambda f: f[1])[0] if inner else "(module)"
                what = file, function, name, lines[line - 1].strip()
                seen[what] = seen.get(what, 0) + 1
                words = "\n".join(map(str, (seed, *what, seen[what])))
                rank = hashlib.sha256(words.encode()).hexdigest()
                yield _Place(rank, kind, operator, occurrence, function, line)


def _mutant(root: Path, file: str, place: _Place) -> Mutant | None:
    """Return the mutant of a place; None if the program is unchanged or invalid."""
    source = (root / file).read_text()
    mutated = mutate_code(source, place.operator, place.occurrence)
    try:
        same = mutated is None or ast.dump(ast.parse(source)) == ast.dump(ast.parse(mutated))
    except SyntaxError:
        return None
    if same:
        return None
    assert mutated is not None
    old, new = source.splitlines(), mutated.splitlines()
    first = next(k for k, pair in enumerate(zip(old, new, strict=False)) if pair[0] != pair[1])
    tail = 0
    while old[-1 - tail] == new[-1 - tail]:
        tail += 1
    was, becomes = (
        " ".join(" ".join(text[first : len(text) - tail]).split()) for text in (old, new)
    )
    return Mutant(
        file=file,
        function=place.function,
        line=first + 1,
        was=was,
        becomes=becomes,
        kind=place.kind,
        source=mutated,
        tests=ROOMS[file],
    )


@functools.cache
def _outside(source: str) -> list[tuple[tuple[int, int], tuple[int, int]]]:
    """Return spans that do not affect results: annotations, messages, assertions, decorators."""
    lines = source.splitlines()
    found: list[ast.stmt | ast.expr | None] = []
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Assert | ast.Raise | ast.JoinedStr | ast.Import | ast.ImportFrom):
            found.append(node)
        elif isinstance(node, ast.arg | ast.AnnAssign):
            found.append(node.annotation)
        elif isinstance(node, ast.FunctionDef):
            found += [node.returns, *node.decorator_list]
        elif isinstance(node, ast.ClassDef):
            found += node.decorator_list

    def place(line: int | None, offset: int | None) -> tuple[int, int]:
        assert line is not None
        # From bytes to characters.
        return line, len(lines[line - 1].encode()[:offset].decode())

    return [
        (place(node.lineno, node.col_offset), place(node.end_lineno, node.end_col_offset))
        for node in found
        if node is not None
    ]


@functools.cache
def _functions(source: str) -> list[tuple[str, int, int]]:
    """Return (qualified name, first line, last line) of every function and class."""
    found = []

    def walk(node: ast.AST, prefix: str) -> None:
        for child in ast.iter_child_nodes(node):
            name = prefix
            if isinstance(child, ast.FunctionDef | ast.ClassDef):
                name = f"{prefix}.{child.name}" if prefix else child.name
                found.append((name, child.lineno, child.end_lineno))
            walk(child, name)

    walk(ast.parse(source), "")
    return found
