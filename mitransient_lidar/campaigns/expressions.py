"""Arithmetic expressions for parameters that depend on others."""

from __future__ import annotations

import ast
import operator
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from mitransient_lidar.core.errors import UserError
from mitransient_lidar.core.validation import FloatArray, shown

_OPERATORS: dict[type[ast.AST], Callable[..., Any]] = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
    ast.USub: operator.neg,
    ast.UAdd: operator.pos,
}

_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "min": np.minimum,
    "max": np.maximum,
}

#: Most characters in an expression: its evaluation is recursive.
_LONGEST = 500

_ALLOWED = f"numbers, parameters, + - * / ** ( ) and {', '.join(_FUNCTIONS)}"


class Expression:
    """An arithmetic expression of named quantities, such as ``0.8 * attenuation``.

    It may contain numbers, names, ``+ - * / **``, parentheses, and the functions ``sqrt``, ``exp``, ``log``, ``sin``,
    ``cos``, ``tan`` (of radians), ``min`` and ``max`` (of two arguments).

    Raises UserError if it contains anything else.

    `name`: name of the quantity that it defines, for messages.

    Attributes
    ----------
    names
        Names of the quantities that it needs.
    """

    def __init__(self, name: str, text: str) -> None:
        self.name, self.text = name, text
        if len(text) > _LONGEST:
            raise UserError(f"{name} = {shown(text)} has {len(text)} characters: it may have {_LONGEST}")
        try:
            self._tree = ast.parse(text.strip(), mode="eval").body
        except (SyntaxError, ValueError, RecursionError, MemoryError):
            raise UserError(f"{name} = {shown(text)} is no expression: it may hold {_ALLOWED}") from None
        functions = {id(node.func) for node in ast.walk(self._tree) if isinstance(node, ast.Call)}
        for node in ast.walk(self._tree):
            self._check(node, functions)
        self.names = {
            node.id for node in ast.walk(self._tree) if isinstance(node, ast.Name) and id(node) not in functions
        }

    def _check(self, node: ast.AST, functions: set[int]) -> None:
        """Refuse a part that is not arithmetic."""
        known = isinstance(node, (ast.BinOp, ast.UnaryOp, ast.Load, ast.Name)) or type(node) in _OPERATORS
        if isinstance(node, ast.Name) and id(node) in functions:
            known = node.id in _FUNCTIONS
        elif isinstance(node, ast.Call):
            count = 2 if isinstance(node.func, ast.Name) and node.func.id in ("min", "max") else 1
            known = isinstance(node.func, ast.Name) and not node.keywords and len(node.args) == count
        elif isinstance(node, ast.Constant):
            known = isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
        if not known:
            part = ast.get_source_segment(self.text.strip(), node) or type(node).__name__
            raise UserError(f"{self.name} = {self.text!r} holds {shown(part)}: it may hold {_ALLOWED}")

    def evaluate(self, values: Mapping[str, FloatArray]) -> FloatArray:
        """Return the value for arrays of equal shape by name; raise `UserError` where it is not finite."""
        with np.errstate(all="ignore"):
            try:
                found = np.asarray(self._value(self._tree, values), dtype=np.float64)
            except OverflowError:
                found = np.asarray(np.inf)
        if not np.all(np.isfinite(found)):
            raise UserError(f"{self.name} = {self.text!r} is not finite in every run")
        return found

    def _value(self, node: ast.AST, values: Mapping[str, FloatArray]) -> Any:
        if isinstance(node, ast.Constant):
            # NumPy's numbers divide by zero and overflow as arrays do.
            return np.float64(node.value)  # type: ignore[arg-type]
        if isinstance(node, ast.Name):
            return values[node.id]
        if isinstance(node, ast.UnaryOp):
            return _OPERATORS[type(node.op)](self._value(node.operand, values))
        if isinstance(node, ast.BinOp):
            left, right = self._value(node.left, values), self._value(node.right, values)
            return _OPERATORS[type(node.op)](left, right)
        assert isinstance(node, ast.Call)
        assert isinstance(node.func, ast.Name)
        return _FUNCTIONS[node.func.id](*(self._value(each, values) for each in node.args))
