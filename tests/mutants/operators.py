"""Operators that make mistakes: those of Cosmic Ray, and three of the same kind for numerical code.

Cosmic Ray's `<` for `<=` and the like are left out, which change nothing except on a set of measure
zero, and exchanges such as `+` for `>>`, which nobody makes."""

import functools
import re

import parso
import parso.python.tree as tree
from cosmic_ray.operators.operator import Operator
from cosmic_ray.operators.provider import OperatorProvider

_USED = re.compile(
    r"ReplaceBinaryOperator_(Add_Sub|Sub_Add|Mul_Div|Div_Mul|FloorDiv_Mul|Mod_FloorDiv|Pow_Mul"
    r"|BitAnd_BitOr|BitOr_BitAnd)"
    r"|ReplaceComparisonOperator_(Lt_Gt|Gt_Lt|LtE_GtE|GtE_LtE|Eq_NotEq|NotEq_Eq|Is_IsNot|IsNot_Is)"
    r"|ReplaceUnaryOperator_Delete_(USub|Invert|Not)|NumberReplacer|AddNot|ZeroIterationForLoop"
    r"|Replace(TrueWithFalse|FalseWithTrue|AndWithOr|OrWithAnd|BreakWithContinue|ContinueWithBreak)"
)
_WORDS = {
    "+=": "-=", "-=": "+=", "|=": "&=", "&=": "|=", "*=": "/=",
    "minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min",
    "argmin": "argmax", "argmax": "argmin", "any": "all", "all": "any",
    "sin": "cos", "cos": "sin", "arctan2": "hypot", "sum": "prod", "floor": "ceil",
    "ceil": "floor", "ones_like": "zeros_like", "zeros_like": "ones_like",
    "sqrt": "square", "sign": "abs", "append": "maximum", "vstack": "hstack",
}  # fmt: skip


class Own(Operator):
    """An operator of this project. Cosmic Ray asks for examples, which its own tests use."""

    @classmethod
    def examples(cls):
        return ()


class ExchangeWord(Own):
    """Replace a function or operator by one that is easily confused with it: sine by cosine."""

    def mutation_positions(self, node):
        known = isinstance(node, tree.Operator | tree.Name) and node.value in _WORDS
        if known and (node.type == "operator" or node.get_previous_leaf().value == "."):
            yield node.start_pos, node.end_pos

    def mutate(self, node, index):
        node.value = _WORDS[node.value]
        return node


class ExchangeBranches(Own):
    """Exchange the branches of a `where`."""

    def mutation_positions(self, node):
        if node.type == "arglist" and node.parent.get_previous_leaf().value == "where":
            yield node.children[2].start_pos, node.children[-1].end_pos

    def mutate(self, node, index):
        condition, comma, one, between, *other = node.children
        node.children = [condition, comma, *other, between, one]
        return node


class Double(Own):
    """Double a returned result: a forgotten factor."""

    def mutation_positions(self, node):
        if node.type == "return_stmt" and node.children[-1].type in ("arith_expr", "term", "power"):
            yield node.children[1].start_pos, node.children[1].end_pos

    def mutate(self, node, index):
        node.children[1] = parso.parse(f" 2 * ({node.children[1].get_code().strip()})")
        return node


@functools.cache
def operators() -> list[Operator]:
    provided = OperatorProvider()
    names = sorted(filter(_USED.fullmatch, provided))
    return [*(provided[name]() for name in names), ExchangeWord(), ExchangeBranches(), Double()]
