r"""Forward-mode automatic differentiation of model functions, by rewriting their source.

From a scalar function compiled by `gonio.jit.model` a second one is written that carries, beside every number which depends
on the parameters, its derivative along one direction of the parameter space, and is compiled in turn. The language is that
in which models are written: assignments, conditional expressions, ``if`` and ``for``, arithmetic, comparisons, functions of
`math`, and calls of other model functions, which are rewritten too. Numbers that do not depend on the parameters stay as
they are; so does the order in which everything is computed, and only the branch that is taken is evaluated.

Where a branch changes, the derivative is that of the branch taken. What vanishes together with the derivative of its
argument, such as :math:`\sqrt{x}` at an x that is 0 for all parameters, has derivative 0. Anything outside the language
is refused with the line where it stands.

References
----------
.. [1] A. Griewank, A. Walther, "Evaluating Derivatives", 2nd ed., SIAM 2008, sections 3.1 and 6.1 (forward mode, source
   transformation).
"""

from __future__ import annotations

import ast
import builtins
import functools
import inspect
import math
import textwrap
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from gonio import jit
from gonio.brdf import elementary
from gonio.errors import ParameterError

# derivative of f(a) and f(a, b); {v}: the value, {t}: the derivative of a, {s}: that of b
_ONE = {
    "sqrt": "0.5 * {t} / {v}",
    "exp": "{v} * {t}",
    "expm1": "({v} + 1.0) * {t}",
    "log": "{t} / {a}",
    "log1p": "{t} / (1.0 + {a})",
    "sin": "math.cos({a}) * {t}",
    "cos": "-math.sin({a}) * {t}",
    "tan": "(1.0 + {v} * {v}) * {t}",
    "asin": "{t} / math.sqrt((1.0 - {a}) * (1.0 + {a}))",
    "acos": "-{t} / math.sqrt((1.0 - {a}) * (1.0 + {a}))",
    "atan": "{t} / (1.0 + {a} * {a})",
    "sinh": "math.cosh({a}) * {t}",
    "cosh": "math.sinh({a}) * {t}",
    "tanh": "(1.0 - {v} * {v}) * {t}",
    "erf": "1.1283791670955126 * math.exp(-{a} * {a}) * {t}",  # 2 / sqrt(pi)
    "erfc": "-1.1283791670955126 * math.exp(-{a} * {a}) * {t}",
    "fabs": "{t} if {a} >= 0.0 else -{t}",
    "abs": "{t} if {a} >= 0.0 else -{t}",
    "float": "{t}",
    "log_near": "{t} / {a}",
}
_GUARDED = {"sqrt", "log", "log1p", "asin", "acos", "log_near"}  # 0 where t is, whatever it is divided by
_TWO = {
    "atan2": "({b} * {t} - {a} * {s}) / ({a} * {a} + {b} * {b})",
    "hypot": "({a} * {t} + {b} * {s}) / {v} if {v} != 0.0 else 0.0",
    "max": "{t} if {a} >= {b} else {s}",
    "min": "{t} if {a} <= {b} else {s}",
}
_STEPS = {"int", "len", "bool", "floor", "ceil", "trunc", "round", "isnan", "isfinite", "isinf", "range"}  # derivative 0
_ELEMENTARY = {"exp", "log", "log_near", "log1p", "power"}
_QUICK = {"sqrt", "abs", "fabs", "min", "max", "float"}
_OPERATORS: dict[type, str] = {ast.Add: "+", ast.Sub: "-", ast.Mult: "*", ast.Div: "/", ast.Pow: "**"}


@dataclass(frozen=True)
class Tangent:
    """A differentiated function.

    Attributes
    ----------
    function : callable
        Compiled: the arguments, then the derivatives of those that are active -> the values, then their derivatives.
    outputs : int
        How many values.
    source : str
        What was compiled.
    """

    function: Callable[..., Any]
    outputs: int
    source: str


def tangent(function: Any, active: Iterable[str] | None = None) -> Tangent:
    """The derivative of a model function along a direction.

    Parameters
    ----------
    function : callable
        Compiled by `gonio.jit.model`.
    active : iterable of str, optional
        Arguments with a derivative; the last one by default, which is a model's parameter array.

    Raises
    ------
    ParameterError
        If the function is not written in the language above.
    """
    inner = getattr(function, "py_func", function)
    names = inner.__code__.co_varnames[: inner.__code__.co_argcount]
    return _tangent(function, frozenset(names[-1:] if active is None else active))


@functools.cache
def _tangent(function: Any, active: frozenset[str]) -> Tangent:
    return _Writer(getattr(function, "py_func", function), active).write()


class _Writer:
    """Writes the tangent of one function. ``d__x`` is the derivative of ``x``, ``v__3`` the third intermediate value."""

    def __init__(self, function: Callable[..., Any], active: frozenset[str]) -> None:
        self.function = function
        self.tree = self._parse()
        self.arguments = [a.arg for a in self.tree.args.args]
        self.seeds = [a for a in self.arguments if a in active]
        self.active = set(self.seeds)
        self.local = {n.id for n in ast.walk(self.tree) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        self.local |= set(self.arguments)
        self.space: dict[str, Any] = {"math": math}
        self.lines: list[str] = []
        self.depth, self.count, self.outputs = 1, 0, 0

    def _parse(self) -> ast.FunctionDef:
        try:
            tree = ast.parse(textwrap.dedent(inspect.getsource(self.function))).body[0]
        except (OSError, TypeError, SyntaxError, IndexError) as exc:
            raise ParameterError(
                f"{self.function.__name__}: its source cannot be read ({exc}), so it is not differentiated; "
                "define it with `def` in a file"
            ) from exc
        arguments = getattr(tree, "args", None)
        if not isinstance(tree, ast.FunctionDef) or arguments is None or arguments.vararg or arguments.kwonlyargs:
            raise ParameterError(f"{self.function.__name__} is not differentiated: write a plain `def` with named arguments")
        return tree

    def refuse(self, node: ast.AST) -> ParameterError:
        code = self.function.__code__
        line = code.co_firstlineno + getattr(node, "lineno", 1) - 1
        shown = ast.unparse(node).splitlines()[0]
        return ParameterError(
            f"`{shown}` ({Path(code.co_filename).name}, line {line}) is outside the language that gonio differentiates; "
            "use assignments, arithmetic, conditions and functions of math"
        )

    def write(self) -> Tangent:
        before = -1
        while len(self.active) != before:  # a loop may carry a derivative back
            before = len(self.active)
            for node in ast.walk(self.tree):
                self._spread(node)
        for statement in self.tree.body:
            self.statement(statement)
        head = ", ".join([*self.arguments, *(f"d__{a}" for a in self.seeds)])
        source = "\n".join([f"def tangent_{self.tree.name}({head}):", *self.lines]) + "\n"
        space = {"__name__": "gonio.brdf.tangent", **self.space}
        exec(compile(source, f"<tangent of {self.function.__qualname__}>", "exec"), space)
        return Tangent(jit.model(space[f"tangent_{self.tree.name}"]), self.outputs, source)

    # --- what depends on the parameters -----------------------------------------------------------------------------------

    def _spread(self, node: ast.AST) -> None:
        if isinstance(node, ast.Assign):
            for target in node.targets:
                pairs = [(target, node.value)]
                if isinstance(target, ast.Tuple):
                    several = isinstance(node.value, ast.Tuple) and len(node.value.elts) == len(target.elts)
                    pairs = [
                        (one, node.value.elts[k] if several else node.value)  # type: ignore[attr-defined]
                        for k, one in enumerate(target.elts)
                    ]
                self.active |= {one.id for one, value in pairs if isinstance(one, ast.Name) and self.depends(value)}
        elif isinstance(node, ast.AugAssign | ast.AnnAssign) and isinstance(node.target, ast.Name):
            self.active |= {node.target.id} if node.value is not None and self.depends(node.value) else set()

    def depends(self, node: ast.AST) -> bool:
        """Whether a value has a derivative other than 0."""
        if isinstance(node, ast.Compare | ast.BoolOp | ast.Constant | ast.Slice):
            return False
        if isinstance(node, ast.Name):
            return node.id in self.active
        if isinstance(node, ast.Subscript):
            return self.depends(node.value)
        if isinstance(node, ast.IfExp):
            return self.depends(node.body) or self.depends(node.orelse)
        if isinstance(node, ast.Call):
            return self.called(node)[0] not in _STEPS and any(self.depends(a) for a in node.args)
        if isinstance(node, ast.Attribute) and node.attr in ("size", "shape", "ndim"):
            return False
        if isinstance(node, ast.BinOp) and isinstance(node.op, ast.BitAnd | ast.BitOr | ast.FloorDiv):
            return False
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.Not):
            return False
        return any(self.depends(child) for child in ast.iter_child_nodes(node))

    def called(self, node: ast.Call) -> tuple[str, Any]:
        """Name of a function of `math`, of `gonio.brdf.elementary` or builtin, else "", and the object called."""
        try:
            found = self.resolve(node.func)
        except (KeyError, AttributeError):
            raise self.refuse(node) from None
        module, name = getattr(found, "__module__", ""), str(getattr(found, "__name__", ""))
        known = name in _ELEMENTARY if module == elementary.__name__ else module in ("math", "builtins")
        return (name if known or isinstance(found, np.ufunc) else ""), found

    def resolve(self, node: ast.AST) -> Any:
        if isinstance(node, ast.Attribute):
            return getattr(self.resolve(node.value), node.attr)
        name = node.id if isinstance(node, ast.Name) else ""
        freevars = self.function.__code__.co_freevars
        if name in freevars:
            return (self.function.__closure__ or ())[freevars.index(name)].cell_contents
        return self.function.__globals__[name] if name in self.function.__globals__ else getattr(builtins, name)

    # --- writing ----------------------------------------------------------------------------------------------------------

    def emit(self, line: str) -> None:
        self.lines.append("    " * self.depth + line)

    def fresh(self, expression: str, prefix: str = "v") -> str:
        self.count += 1
        name = f"{prefix}__{self.count}"
        self.emit(f"{name} = {expression}")
        return name

    def verbatim(self, node: ast.AST) -> str:
        """The node as it is, the names it needs from outside noted."""
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name) and inner.id not in self.local and not hasattr(builtins, inner.id):
                self.space[inner.id] = self.resolve(inner)
            elif isinstance(inner, ast.Lambda | ast.ListComp | ast.GeneratorExp | ast.NamedExpr | ast.DictComp):
                raise self.refuse(inner)
        return ast.unparse(node)

    def block(self, statements: Iterable[ast.stmt]) -> None:
        self.depth += 1
        for statement in statements:
            self.statement(statement)
        if self.lines[-1].endswith(":"):
            self.emit("pass")
        self.depth -= 1

    def statement(self, node: ast.stmt) -> None:
        if isinstance(node, ast.Assign) and len(node.targets) == 1:
            self.assign(node.targets[0], node.value)
        elif isinstance(node, ast.AnnAssign) and node.value is not None:
            self.assign(node.target, node.value)
        elif isinstance(node, ast.AugAssign) and isinstance(node.target, ast.Name):
            old = ast.copy_location(ast.Name(node.target.id, ast.Load()), node)
            self.assign(node.target, ast.copy_location(ast.BinOp(old, node.op, node.value), node))
        elif isinstance(node, ast.Return) and node.value is not None:
            values = node.value.elts if isinstance(node.value, ast.Tuple) else [node.value]
            if self.outputs not in (0, len(values)):
                raise self.refuse(node)
            self.outputs = len(values)
            pairs = [self.value(v) for v in values]
            self.emit("return " + ", ".join([*(v for v, _ in pairs), *(t or "0.0" for _, t in pairs)]))
        elif isinstance(node, ast.If):
            self.emit(f"if {self.verbatim(node.test)}:")
            self.block(node.body)
            if node.orelse:
                self.emit("else:")
                self.block(node.orelse)
        elif isinstance(node, ast.While) and not node.orelse:
            self.emit(f"while {self.verbatim(node.test)}:")
            self.block(node.body)
        elif isinstance(node, ast.For) and not node.orelse and not self.depends(node.iter):
            self.emit(f"for {ast.unparse(node.target)} in {self.verbatim(node.iter)}:")
            self.block(node.body)
        elif isinstance(node, ast.Break | ast.Continue | ast.Pass):
            self.emit(ast.unparse(node))
        elif not (isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant)):
            raise self.refuse(node)

    def assign(self, target: ast.expr, value: ast.expr) -> None:
        names = [t for t in (target.elts if isinstance(target, ast.Tuple) else [target]) if isinstance(t, ast.Name)]
        count = len(target.elts) if isinstance(target, ast.Tuple) else 1
        if len(names) != count:
            raise self.refuse(target)
        if isinstance(target, ast.Tuple) and not isinstance(value, ast.Tuple):
            if not self.depends(value):
                pairs: list[tuple[str, str | None]] = []
                self.emit(f"{ast.unparse(target)} = {self.verbatim(value)}")
            elif isinstance(value, ast.Call):
                pairs = self.call(value, count)
            else:
                raise self.refuse(value)
        else:
            several = isinstance(target, ast.Tuple) and isinstance(value, ast.Tuple)
            pairs = [self.value(v) for v in (value.elts if several else [value])]  # type: ignore[attr-defined]
            if len(pairs) != count:
                raise self.refuse(value)
        left = [n.id for n in names] if pairs else []
        right = [v for v, _ in pairs]
        for k, name in enumerate(names):
            if name.id in self.active:
                left.append(f"d__{name.id}")
                right.append((pairs[k][1] if pairs else None) or "0.0")
        if left:
            self.emit(f"{', '.join(left)} = {', '.join(right)}")

    def value(self, node: ast.expr) -> tuple[str, str | None]:
        """Value and derivative as names or constants, what is needed for them written before; None: no derivative."""
        if not self.depends(node):
            text = self.verbatim(node)
            return (text if isinstance(node, ast.Name | ast.Constant) else self.fresh(text)), None
        if isinstance(node, ast.Name):
            return node.id, f"d__{node.id}"
        if isinstance(node, ast.Subscript) and isinstance(node.value, ast.Name):
            at = self.verbatim(node.slice)
            return self.fresh(f"{node.value.id}[{at}]"), self.fresh(f"d__{node.value.id}[{at}]", "d")
        if isinstance(node, ast.UnaryOp) and isinstance(node.op, ast.USub | ast.UAdd):
            sign = "-" if isinstance(node.op, ast.USub) else ""
            v, t = self.value(node.operand)
            return self.fresh(f"{sign}{v}"), self.fresh(f"{sign}{t}", "d")
        if isinstance(node, ast.BinOp) and type(node.op) in _OPERATORS:
            return self.operation(node)
        if isinstance(node, ast.IfExp):
            return self.choice(node)
        if isinstance(node, ast.Call):
            (pair,) = self.call(node, 1)
            return pair
        raise self.refuse(node)

    def operation(self, node: ast.BinOp) -> tuple[str, str]:
        (a, t), (b, s) = self.value(node.left), self.value(node.right)
        sign = _OPERATORS[type(node.op)]
        v = self.fresh(f"{a} {sign} {b}")
        if sign in "+-":
            d = f"{t} {sign} {s}" if t and s else t or (s if sign == "+" else f"-{s}")
        elif sign == "*":
            d = " + ".join([f"{t} * {b}"] * bool(t) + [f"{a} * {s}"] * bool(s))
        elif sign == "/":
            d = f"({t or '0.0'} - {v} * {s}) / {b}" if s else f"{t} / {b}"
        elif s is None and isinstance(node.right, ast.Constant):
            d = f"{b} * {a} ** {node.right.value - 1} * {t}"  # type: ignore[operator]
        else:
            return v, self.power((a, t), (b, s), v, steep=True)
        return v, self.fresh(str(d), "d")

    def choice(self, node: ast.IfExp) -> tuple[str, str]:
        test = self.fresh(self.verbatim(node.test))
        if self.cheap(node.body) and self.cheap(node.orelse):  # no branch: the loop vectorises
            (a, t), (b, s) = self.value(node.body), self.value(node.orelse)
            return self.fresh(f"{a} if {test} else {b}"), self.fresh(f"{t or '0.0'} if {test} else {s or '0.0'}", "d")
        self.count += 1
        v, d = f"v__{self.count}", f"d__{self.count}"
        for word, branch in ((f"if {test}:", node.body), ("else:", node.orelse)):
            self.emit(word)
            self.depth += 1
            a, t = self.value(branch)
            self.emit(f"{v}, {d} = {a}, {t or '0.0'}")
            self.depth -= 1
        return v, d

    def cheap(self, node: ast.AST) -> bool:
        """Whether a value may be computed where it is not wanted: it reads no memory and calls no library."""
        inner = list(ast.walk(node))
        calls = [self.called(n) for n in inner if isinstance(n, ast.Call)]
        quick = all(n in _QUICK or getattr(f, "__module__", "") == elementary.__name__ for n, f in calls)
        return quick and not any(
            isinstance(n, ast.Subscript) or (isinstance(n, ast.BinOp) and isinstance(n.op, ast.Pow)) for n in inner
        )

    def call(self, node: ast.Call, count: int) -> list[tuple[str, str | None]]:
        name, found = self.called(node)
        if node.keywords or any(isinstance(a, ast.Starred) for a in node.args):
            raise self.refuse(node)
        pairs = [self.value(a) for a in node.args]
        if name and count == 1:
            return [self.known(node, name, pairs)]
        if name or not hasattr(found, "py_func") or found.py_func.__code__.co_argcount != len(pairs):
            raise self.refuse(node)
        arguments = found.py_func.__code__.co_varnames[: len(pairs)]
        inner = _tangent(found, frozenset(n for n, (_, t) in zip(arguments, pairs, strict=True) if t is not None))
        if inner.outputs != count:
            raise self.refuse(node)
        self.count += 1
        helper = f"h__{self.count}_{found.py_func.__name__}"
        self.space[helper] = inner.function
        values, slopes = ([f"{c}__{self.count}_{k}" for k in range(count)] for c in "vd")
        given = [*(v for v, _ in pairs), *(t for _, t in pairs if t is not None)]
        self.emit(f"{', '.join([*values, *slopes])} = {helper}({', '.join(given)})")
        return list(zip(values, slopes, strict=True))

    def known(self, node: ast.Call, name: str, pairs: list[tuple[str, str | None]]) -> tuple[str, str]:
        """A function whose derivative the tables above have."""
        function, (v, t) = self.verbatim(node.func), pairs[0]
        if name in ("min", "max"):
            for b, s in pairs[1:]:
                a, v = v, self.fresh(f"{function}({v}, {b})")
                t = self.fresh(_TWO[name].format(a=a, b=b, t=t or "0.0", s=s or "0.0"), "d")
            return v, str(t)
        v = self.fresh(f"{function}({', '.join(v for v, _ in pairs)})")
        if name in ("pow", "power") and len(pairs) == 2:
            self.space["log__"] = elementary.log
            return v, self.power(pairs[0], pairs[1], v, steep=name == "pow")
        if name == "log_near" or (name in _ONE and len(pairs) == 1):
            a, t = pairs[0]
            d = self.fresh(_ONE[name].format(a=a, t=t, v=v), "d")
            if name == "exp":  # what has underflown stays 0, however steep the exponent is
                return v, self.unless_zero(d, f"{v} != 0.0")
            return v, self.unless_zero(d, f"{t} != 0.0") if name in _GUARDED else d
        if name in _TWO and len(pairs) == 2:
            (a, t), (b, s) = pairs
            return v, self.fresh(_TWO[name].format(a=a, b=b, v=v, t=t or "0.0", s=s or "0.0"), "d")
        raise self.refuse(node)

    def power(self, base: tuple[str, str | None], exponent: tuple[str, str | None], v: str, *, steep: bool) -> str:
        """Derivative of a^b, of value v; not `steep`: without a second power, for a base that does not get to 0."""
        (a, t), (b, s), parts = base, exponent, []
        if t:
            slope = f"{a} ** ({b} - 1.0)" if steep else f"{v} / {a}"
            parts.append(self.unless_zero(self.fresh(f"{b} * {slope} * {t}", "d"), f"{t} != 0.0"))
        if s:
            product = self.fresh(f"{v} * {'math.log' if steep else 'log__'}({a}) * {s}", "d")
            parts.append(self.unless_zero(product, f"({v} != 0.0) & ({s} != 0.0)"))
        return self.fresh(" + ".join(parts), "d")

    def unless_zero(self, d: str, test: str) -> str:
        return self.fresh(f"{d} if {test} else 0.0", "d")  # the quotient before the question: no branch, so it vectorises
