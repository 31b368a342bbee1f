"""The numbers in the source of a module, and those in a table of the documentation."""

from __future__ import annotations

import ast
import operator
import re
from functools import cache
from typing import NamedTuple

#: Numbers that say nothing but "none", "one more", "twice", "half": indices, signs, dimensions, coefficients.
TRIVIAL = frozenset({0, 1, 2, 3, 4, 0.25, 0.5})

_ARITHMETIC = {
    ast.Add: operator.add,
    ast.Sub: operator.sub,
    ast.Mult: operator.mul,
    ast.Div: operator.truediv,
    ast.Pow: operator.pow,
}
_BITS = (ast.LShift, ast.RShift, ast.BitAnd, ast.BitOr, ast.BitXor)


class Number(NamedTuple):
    """A numeric constant.

    file : path of the module.
    where : name of the constant; of a number in an expression, of the function or method (not of functions inside).
    value : of the number.
    """

    file: str
    where: str
    value: float


@cache
def numbers_in_source(file: str, source: str) -> set[Number]:
    """The numeric constants of a module.

    A power or a fraction of two numbers, such as ``10**7``, is one number. What is not counted:

    * numbers of `TRIVIAL` in expressions. As the value of a named constant, these count, too: it has a name because
      it could be another;
    * hexadecimal numbers, and operands of shifts and of other operations on bits: hashes, masks, seeds;
    * what is in brackets after a name: indices;
    * members of enumerations: labels.
    """
    found: set[Number] = set()

    def visit(node: ast.AST, where: str) -> None:
        if isinstance(node, ast.ClassDef):
            if any("Enum" in ast.unparse(base) for base in node.bases):
                return
            for child in node.body:
                visit(child, f"{where}.{node.name}" if where else node.name)
        elif isinstance(node, ast.FunctionDef) and not in_function(where):
            for child in ast.iter_child_nodes(node):
                visit(child, f"{where}.{node.name}()" if where else f"{node.name}()")
        elif isinstance(node, (ast.Assign, ast.AnnAssign)) and not in_function(where):
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            for target in targets:
                assign(target, node.value, where)
        elif isinstance(node, ast.Subscript):
            visit(node.value, where)
        elif (value := number(node)) is not None:
            if abs(value) not in TRIVIAL:
                found.add(Number(file, where, value))
        elif not is_hexadecimal(node):
            for child in ast.iter_child_nodes(node):
                if not (bits(node) and number(child) is not None):
                    visit(child, where)

    def assign(target: ast.expr, value: ast.expr | None, where: str) -> None:
        if isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple):
            for t, v in zip(target.elts, value.elts, strict=True):
                assign(t, v, where)
        elif value is not None:
            name = f"{where}.{ast.unparse(target)}" if where else ast.unparse(target)
            if number(value) is not None and ast.unparse(target).lstrip("_").isupper():
                found.add(Number(file, name, number(value)))
            else:
                visit(value, name)

    def number(node: ast.AST) -> float | None:
        if isinstance(node, ast.Constant):
            is_number = isinstance(node.value, (int, float)) and not isinstance(node.value, bool)
            return node.value if is_number and not is_hexadecimal(node) else None
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub):
            value = number(node.operand)
            return None if value is None else -value
        if isinstance(node, ast.BinOp) and type(node.op) in _ARITHMETIC:
            left, right = number(node.left), number(node.right)
            return None if left is None or right is None else _ARITHMETIC[type(node.op)](left, right)
        return None

    def is_hexadecimal(node: ast.AST) -> bool:
        # Offsets are counted in bytes. (`ast.get_source_segment` splits the whole source for each node.)
        start = lambda: lines[node.lineno - 1][node.col_offset : node.col_offset + 2]
        return isinstance(node, ast.Constant) and start().lower() == b"0x"

    lines = source.encode("utf-8").split(b"\n")
    in_function = lambda where: where.endswith("()")
    bits = lambda node: isinstance(node, (ast.BinOp, ast.AugAssign)) and isinstance(node.op, _BITS)
    visit(ast.parse(source), "")
    return found


def numbers_in_table(text: str) -> list[Number]:
    """The first three columns of the table with the head "file | where | number". An empty file: as in the row above.

    Raises
    ------
    ValueError : what stands in the third column is not a number.
    """
    lines = iter(text.splitlines())
    for line in lines:
        if re.match(r"\| file \| where \| number \|", line):
            break
    next(lines, None)
    found, file = [], ""
    for line in lines:
        if not line.startswith("|"):
            break
        first, where, number = (cell.strip().strip("`") for cell in line.split("|")[1:4])
        file = first or file
        # An assignment to a named constant: nothing is exempt.
        try:
            (value,) = numbers_in_source(file, f"NUMBER = {number}")
        except ValueError:
            raise ValueError(f'{file}: {where}: "{number}" is not a number') from None
        found.append(Number(file, where, value.value))
    return found
