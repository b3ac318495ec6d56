"""Directives that list config keys, families, commands and statuses, from what `--help` prints."""

import argparse

from docutils import nodes
from sphinx.util.docutils import SphinxDirective

from rootsopt.commands import cli
from rootsopt.commands.table import COMMANDS, Command
from rootsopt.config import Config
from rootsopt.config.explain import keys_of
from rootsopt.config.families import families
from rootsopt.status import Status

Cell = str | nodes.Node
"""Entry of a table: text, or a node."""


def code(text: str) -> nodes.Node:
    """Return a `text` as code."""
    return nodes.literal(text, text)


def table(
    heads: tuple[str, ...], widths: tuple[int, ...], rows, ids=(), kind: str = "reference"
) -> nodes.table:
    """Return a table with the `heads` of its columns, their relative `widths`, and its `rows`.

    `ids`: anchors of the rows, or none; `kind`: class of the table for its style."""
    group = nodes.tgroup(cols=len(heads))
    group += [nodes.colspec(colwidth=width) for width in widths]
    head, body = nodes.thead(), nodes.tbody()
    head += _row(heads)
    for number, cells in enumerate(rows):
        row = _row(cells)
        row["ids"] += ids[number : number + 1]
        body += row
    group += [head, body]
    return nodes.table("", group, classes=["reference", kind])


def _row(cells) -> nodes.row:
    row = nodes.row()
    for cell in cells:
        inner = nodes.Text(cell) if isinstance(cell, str) else cell
        row += nodes.entry("", nodes.paragraph("", "", inner))
    return row


def _listed(words: str) -> nodes.Node:
    """Return `words` that are separated by bars as a list of code."""
    result = nodes.inline()
    for number, word in enumerate(words.split(" | ")):
        result += [nodes.Text(", " if number else ""), code(word)]
    return result


class ConfigKeys(SphinxDirective):
    """`config-keys` SECTION: the keys of one section of a config.

    Anchors are `key-` and the dotted name, with a hyphen for each dot."""

    required_arguments = 1

    def run(self) -> list[nodes.Node]:
        section = self.arguments[0]
        found = [key for key in keys_of(Config) if key.name.startswith(f"{section}.")]
        if not found:
            raise self.error(f"a config has no section {section!r}")
        rows, ids = [], []
        for key in found:
            allowed = nodes.inline()
            if key.choices:
                allowed += _listed(key.choices)
            if key.range:
                allowed += nodes.Text(f"{', ' if key.choices else ''}{key.range}")
            default = "required" if key.required else code(key.default) if key.default else ""
            rows.append((code(key.name), key.meaning, key.unit, allowed, default))
            ids.append(f"key-{key.name.replace('.', '-')}")
        heads = "key", "meaning", "unit", "allowed", "default"
        return [table(heads, (26, 34, 8, 20, 12), rows, ids)]


class Families(SphinxDirective):
    """`profile-families`: all profile families, each with its keys and a valid design."""

    def run(self) -> list[nodes.Node]:
        rows = []
        for name, family in families().items():
            values = ", ".join(f"{key}: {value}" for key, value in family.example.items())
            rows.append((code(name), family.help, code(values) if values else ""))
        heads = "family", "curves of the addendum", "a valid design: 3 lobes, pitch radius 33 mm"
        return [table(heads, (18, 40, 42), rows)]


class CommandOptions(SphinxDirective):
    """`command-options` [COMMAND]: options of one command; without a name, those of all."""

    optional_arguments = 1

    def run(self) -> list[nodes.Node]:
        common = cli.parser(Command("COMMAND", "", ""))
        if not self.arguments:
            return [_options(common, set())]
        found = cli.parser(COMMANDS[self.arguments[0]])
        shared = {action.dest for action in common._actions}
        purpose = nodes.paragraph(text=found.description or "")
        own = [action for action in found._actions if action.dest not in shared]
        none = nodes.paragraph(text="It has no options besides those of every command.")
        return [purpose, _options(found, shared) if own else none]


def _options(parser: argparse.ArgumentParser, left_out: set[str]) -> nodes.table:
    rows = []
    formatter = argparse.HelpFormatter(parser.prog)
    for action in parser._actions:
        if action.dest in left_out:
            continue
        value = "" if action.nargs == 0 else f" {action.metavar or action.dest.upper()}"
        names = [f"{name}{value}" for name in action.option_strings] or [action.dest.upper()]
        meaning = formatter._expand_help(action)
        rows.append((_listed(" | ".join(names)), meaning))
    return table(("option", "meaning"), (30, 70), rows, kind="options")


class Statuses(SphinxDirective):
    """`statuses`: every status of a result, with what it means and what to do."""

    def run(self) -> list[nodes.Node]:
        rows = [(code(one.label), one.value) for one in Status]
        return [table(("status", "meaning, and what to do"), (20, 80), rows)]


def setup(app):
    """Register the directives."""
    app.add_directive("config-keys", ConfigKeys)
    app.add_directive("profile-families", Families)
    app.add_directive("command-options", CommandOptions)
    app.add_directive("statuses", Statuses)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
