"""Operators that make mutants: those of Cosmic Ray, and three of the same kind for numerical code.

Two kinds of Cosmic Ray's operators are left out. `<` for `<=` and the like change nothing except on
a set of measure zero. Exchanges such as `+` for `>>` are unlikely mistakes."""

from collections.abc import Iterator

import parso
import parso.python.tree as tree
from cosmic_ray.operators.operator import Example, Operator
from cosmic_ray.operators.provider import OperatorProvider

_BINARY = ("Add_Sub", "Sub_Add", "Mul_Div", "Div_Mul", "FloorDiv_Mul", "Mod_FloorDiv", "Pow_Mul",
           "BitAnd_BitOr", "BitOr_BitAnd")  # fmt: skip
_COMPARISONS = ("Lt_Gt", "Gt_Lt", "LtE_GtE", "GtE_LtE", "Eq_NotEq", "NotEq_Eq", "Is_IsNot",
                "IsNot_Is")  # fmt: skip
_UNARY = ("Delete_USub", "Delete_Invert", "Delete_Not")
_LOGIC = ("AddNot", "ReplaceTrueWithFalse", "ReplaceFalseWithTrue", "ReplaceAndWithOr",
          "ReplaceOrWithAnd")  # fmt: skip
_FLOW = "ReplaceBreakWithContinue", "ReplaceContinueWithBreak", "ZeroIterationForLoop"

_WORDS = {
    "+=": "-=", "-=": "+=", "|=": "&=", "&=": "|=", "*=": "/=",
    "minimum": "maximum", "maximum": "minimum", "min": "max", "max": "min",
    "argmin": "argmax", "argmax": "argmin", "any": "all", "all": "any",
    "sin": "cos", "cos": "sin", "arctan2": "hypot", "sum": "prod", "floor": "ceil",
    "ceil": "floor", "ones_like": "zeros_like", "zeros_like": "ones_like",
    "sqrt": "square", "sign": "abs", "append": "maximum", "vstack": "hstack",
}  # fmt: skip
_ORDERLESS = {"maximum", "minimum", "hypot", "dot", "isclose"}
_SHAPED = {"ones", "zeros", "full", "asarray", "array", "eye"}


def _of_arrays(name) -> bool:
    """Return whether a name is that of a function of JAX or NumPy."""
    dot = name.get_previous_leaf()
    return dot is not None and dot.value == "." and dot.get_previous_leaf().value in ("jnp", "np")


class ExchangeWord(Operator):
    """Replace a function or operator by one that is easily confused with it: sine by cosine."""

    def mutation_positions(self, node):
        if isinstance(node, tree.Operator | tree.Name):
            following = node.get_next_leaf()
            called = following is not None and following.value == "("
            if node.value in _WORDS and (node.type == "operator" or (called and _of_arrays(node))):
                yield node.start_pos, node.end_pos

    def mutate(self, node, index):
        node.value = _WORDS[node.value]
        return node

    @classmethod
    def examples(cls):
        first = Example("x += jnp.sin(y)", "x -= jnp.sin(y)")
        return first, Example("x += jnp.sin(y)", "x += jnp.cos(y)", 1)


class ExchangeArguments(Operator):
    """Exchange the first two arguments of a function of arrays, or the branches of a `where`."""

    def mutation_positions(self, node):
        if node.type != "arglist" or node.parent.type != "trailer" or len(node.children) < 3:
            return
        function = node.parent.get_previous_leaf()
        begin = self._begin(function)
        if len(node.children) < begin + 3 or not _of_arrays(function):
            return
        first, second = node.children[begin], node.children[begin + 2]
        unnamed = all(one.type not in ("argument", "operator") for one in (first, second))
        same = first.get_code().strip() == second.get_code().strip()
        if unnamed and not same and function.value not in _ORDERLESS | _SHAPED:
            yield first.start_pos, second.end_pos

    @staticmethod
    def _begin(function) -> int:
        return 2 if function.value == "where" else 0

    def mutate(self, node, index):
        begin = self._begin(node.parent.get_previous_leaf())
        children = list(node.children)
        children[begin], children[begin + 2] = children[begin + 2], children[begin]
        node.children = children
        return node

    @classmethod
    def examples(cls):
        return Example("np.f(a,b)", "np.f(b,a)"), Example("jnp.where(a,b,c)", "jnp.where(a,c,b)")


class Double(Operator):
    """Double a returned result: a forgotten factor."""

    def mutation_positions(self, node):
        if node.type == "return_stmt" and len(node.children) == 2:
            value = node.children[1]
            if value.type in ("arith_expr", "term", "power"):
                yield value.start_pos, value.end_pos

    def mutate(self, node, index):
        node.children[1] = parso.parse(f" 2 * ({node.children[1].get_code().strip()})")
        return node

    @classmethod
    def examples(cls):
        return (Example("def f():\n    return a + b", "def f():\n    return 2 * (a + b)"),)


def operators() -> Iterator[tuple[str, str, Operator]]:
    """Yield (kind, name, operator) of every operator used, in a fixed order."""
    provided = OperatorProvider()
    names = {
        "arithmetic": [f"ReplaceBinaryOperator_{one}" for one in _BINARY],
        "comparison": [f"ReplaceComparisonOperator_{one}" for one in _COMPARISONS],
        "sign": [f"ReplaceUnaryOperator_{one}" for one in _UNARY],
        "constant": ["NumberReplacer"],
        "logic": _LOGIC,
        "flow": _FLOW,
    }
    for kind, group in names.items():
        for name in group:
            yield kind, name, provided[name]()
    own = {"function": ExchangeWord, "argument": ExchangeArguments, "factor": Double}
    for kind, operator in own.items():
        yield kind, operator.__name__, operator()
