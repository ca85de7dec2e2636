"""Coefficients written as arithmetic of parameters, `-k / m`, evaluated without running code."""

from __future__ import annotations

import ast
import math
import operator
from collections.abc import Callable, Mapping

from protocol.errors import InputError

BINARY: dict[type[ast.operator], Callable[[float, float], float]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
FUNCTIONS: dict[str, Callable[[float], float]] = {"sqrt": math.sqrt, "exp": math.exp, "sin": math.sin, "cos": math.cos}


def names_in(text: str | float, key: str) -> set[str]:
    """Parameters that a coefficient depends on. Raises InputError, naming `key`, for anything but arithmetic."""
    if not isinstance(text, str):
        return set()
    try:
        tree = ast.parse(text, mode="eval")
    except SyntaxError:
        raise InputError(key, text, "a number or arithmetic of parameters, such as -k / m") from None
    names = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Name):
            names.add(node.id)
        elif not isinstance(
            node, (ast.Expression, ast.BinOp, ast.UnaryOp, ast.Constant, ast.Call, ast.Load, ast.USub, ast.UAdd, *BINARY)
        ):
            raise InputError(key, text, "a number or arithmetic of parameters, such as -k / m")
    return names - set(FUNCTIONS)


def value_of(text: str | float, parameters: Mapping[str, float]) -> float:
    """Value of a coefficient; NaN where it is not defined, as after a division by zero."""
    if not isinstance(text, str):
        return float(text)
    try:
        return _value(ast.parse(text, mode="eval").body, parameters)
    except (ArithmeticError, ValueError):
        return math.nan


def _value(node: ast.expr, parameters: Mapping[str, float]) -> float:
    if isinstance(node, ast.Constant) and isinstance(node.value, int | float):
        return float(node.value)
    if isinstance(node, ast.Name):
        return float(parameters[node.id])
    if isinstance(node, ast.BinOp):
        return float(BINARY[type(node.op)](_value(node.left, parameters), _value(node.right, parameters)))
    if isinstance(node, ast.UnaryOp):
        value = _value(node.operand, parameters)
        return -value if isinstance(node.op, ast.USub) else value
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 1:
        return FUNCTIONS[node.func.id](_value(node.args[0], parameters))
    raise InputError("linear", ast.unparse(node), "a number or arithmetic of parameters, such as -k / m")
