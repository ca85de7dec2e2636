"""Whether an equation has the right form: its values, on the case's own recordings, follow those of the true one.

Both are evaluated on the held-out recording; what gain and offset of the nominal model would absorb is taken out of both;
the form is right where the remainder of the one explains at least 90 % of the remainder of the other.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Callable

import numpy as np

Array = np.ndarray
ENOUGH = 0.9
_WRITTEN = (("^", "**"), ("·", "*"), ("×", "*"), ("−", "-"), ("²", "**2"), ("³", "**3"), ("π", "pi"))


def right_form(equation: str, truth: str, columns: dict[str, Array], absorbed: list[str]) -> bool:
    """True where `equation` (its right side, if it has two) follows `truth`; both in names of `columns` (n,).

    columns hold `time_s`; names may lack their unit. absorbed: columns that the nominal model takes up linearly.
    An equation that cannot be read is not of the right form.
    """
    base = np.column_stack([np.ones(len(columns["time_s"])), *(columns[name] for name in absorbed)])
    wanted = _rest(evaluate(truth, columns), base)
    try:
        # constants inside (widths, wave numbers) are the finder's own; a sum may be right in one of its terms only
        found = [_rest(evaluate(part, columns), base) for part in candidates(equation)]
    except (ValueError, ArithmeticError, TypeError):
        return False
    return any(_share(wanted, x) >= ENOUGH for x in found)


def candidates(equation: str) -> list[str]:
    """The right side of an equation as text that can be read."""
    text = equation.rpartition("=")[2].strip()
    for written, meant in _WRITTEN:
        text = text.replace(written, meant)
    text = re.sub(r"\|([^|]+)\|", r"abs(\1)", text)
    text = re.sub(r"d\(?(\w+)\)?/dt", r"rate(\1)", text)
    return [text]


def _rest(x: Array, base: Array) -> Array:
    """Return the residual of x after linear regression on `base`."""
    if not np.all(np.isfinite(x)):
        raise ValueError("equation: found a value that is not finite")
    x = np.broadcast_to(x, (len(base),)).astype(float)
    return np.asarray(x - base @ np.linalg.lstsq(base, x, rcond=None)[0])


def _share(wanted: Array, found: Array) -> float:
    """Return the squared correlation of two columns (n,)."""
    energy = float(wanted @ wanted) * float(found @ found)
    return float(wanted @ found) ** 2 / energy if energy > 1e-300 else 0.0


def evaluate(text: str, columns: dict[str, Array]) -> Array:
    """Value (n,) of an arithmetic expression in column names. Raises ValueError for anything else than arithmetic."""
    try:
        tree = ast.parse(text, mode="eval").body
    except SyntaxError as error:
        raise ValueError(f"equation: found {text!r}, wanted arithmetic") from error
    return np.asarray(_value(tree, columns))


def _value(node: ast.expr, columns: dict[str, Array]) -> Array:
    if isinstance(node, ast.Constant) and isinstance(node.value, (int, float)):
        return np.asarray(float(node.value))
    if isinstance(node, ast.Name):
        return _named(node.id, columns)
    if isinstance(node, ast.UnaryOp) and isinstance(node.op, (ast.USub, ast.UAdd)):
        inner = _value(node.operand, columns)
        return -inner if isinstance(node.op, ast.USub) else inner
    if isinstance(node, ast.BinOp):
        return _combined(node.op, _value(node.left, columns), _value(node.right, columns))
    if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and not node.keywords:
        return _called(node.func.id.lower(), [_value(a, columns) for a in node.args], columns)
    raise ValueError(f"equation: found {ast.dump(node)[:60]}, wanted arithmetic")


def _combined(operation: ast.operator, a: Array, b: Array) -> Array:
    ways = {ast.Add: np.add, ast.Sub: np.subtract, ast.Mult: np.multiply, ast.Div: np.divide, ast.Pow: np.power}
    if type(operation) not in ways:
        raise ValueError(f"equation: found {type(operation).__name__}, wanted + - * / **")
    with np.errstate(all="ignore"):
        return np.asarray(ways[type(operation)](a, b))


def _named(name: str, columns: dict[str, Array]) -> Array:
    """A column by its name, with or without its unit; `NAME_rate`, `d_NAME`, `v_NAME` are its speed; pi is known."""
    if name == "pi":
        return np.asarray(np.pi)
    for column, values in columns.items():
        if name in (column, column.rpartition("_")[0]):
            return values
    for pattern in (
        r"^(\w+)_(?:rate|dot|speed|velocity)(?:_\w+)?$",
        r"^(?:d|v|rate|speed)_(\w+)$",
        r"^(\w+?)(?:_\w+?)?_per_s$",
    ):
        found = re.match(pattern, name)
        if found:
            return _called("rate", [_named(found.group(1), columns)], columns)
    raise ValueError(f"equation: found {name!r}, wanted one of {', '.join(columns)}")


def _called(name: str, given: list[Array], columns: dict[str, Array]) -> Array:
    time = columns["time_s"]
    plain: dict[str, Callable[[Array], Array]] = {
        "sin": np.sin,
        "cos": np.cos,
        "tan": np.tan,
        "tanh": np.tanh,
        "exp": np.exp,
        "log": np.log,
        "sqrt": np.sqrt,
        "abs": np.abs,
        "sign": np.sign,
        "square": np.square,
        "cube": lambda x: x**3,
    }
    if not given:
        raise ValueError(f"equation: found {name}(), wanted an argument")
    if name in plain:
        with np.errstate(all="ignore"):
            return np.asarray(plain[name](given[0]))
    if name in ("rate", "d", "ddt", "diff", "speed", "velocity"):
        return np.gradient(given[0], time)
    if name in ("play", "backlash") and len(given) == 2:
        return _play(given[0], float(given[1]))
    if name in ("lag", "lowpass") and len(given) == 2:
        return _lag(given[0], float(given[1]), time)
    raise ValueError(f"equation: found {name}(), wanted a function that is known")


def _play(x: Array, width: float) -> Array:
    out, y = np.empty_like(x), float(x[0])
    for i, value in enumerate(x):
        y = min(max(y, value - 0.5 * abs(width)), value + 0.5 * abs(width))
        out[i] = y
    return out


def _lag(x: Array, time_constant_s: float, time_s: Array) -> Array:
    out, y = np.empty_like(x), float(x[0])
    for i, value in enumerate(x):
        step = time_s[i] - time_s[max(i - 1, 0)]
        y += (value - y) * (1.0 - np.exp(-step / max(time_constant_s, 1e-6)))
        out[i] = y
    return out
