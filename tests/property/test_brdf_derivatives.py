"""Derivatives of the models with respect to their parameters.

Truths: the primary formulas at 40 digits, differentiated by mpmath; and, for every registered model, its own scalar function
executed by mpmath instead of compiled, which shares the formula but neither the rewriting nor the arithmetic.
"""

from __future__ import annotations

import itertools
import math
import os
import subprocess
import sys
import types
from collections.abc import Callable, Iterable, Iterator, Sequence
from pathlib import Path
from typing import Any

import mpmath
import numpy as np
import pytest
from mpmath import mpf
from numpy.typing import NDArray

import gonio
from gonio import jit
from gonio.brdf import BRDF, Model, Parameter, Term, derivatives, families
from gonio.brdf.elementary import exp, log, log1p, power
from gonio.brdf.tangent import tangent
from gonio.errors import ParameterError
from gonio.geometry import unit_vector
from tests.brdf_formulas import MICROFACETS, PLAIN, SHORTS, Case
from tests.brdf_truth import Geometry
from tests.gates import record
from tests.registered import compiled, middle

Array = NDArray[np.float64]
make = gonio.brdf.make
LIMIT = 1e-10  # relative to the largest derivative by the same parameter


def directions() -> tuple[Array, Array]:
    """Twelve pairs: any, the normal, exact mirror and retro, beside them, grazing."""
    rng = np.random.default_rng(5)
    theta = np.concatenate((np.arccos(rng.uniform(0, 1, (6, 2))), [[0, 0], [0.7, 0.7], [0.7, 0.7 + 1e-8], [0.9, 0.9]]))
    phi = np.concatenate((rng.uniform(0, 7, (6, 2)), [[0.3, 0.3], [0.2, 0.2 + np.pi], [0.2, 0.2 + np.pi], [1.0, 1.0]]))
    grazing = math.radians(89.99)
    theta, phi = np.vstack((theta, [[grazing, grazing], [grazing, 0.2]])), np.vstack((phi, [[0.1, 0.1 + np.pi], [0, 0]]))
    return unit_vector(theta[:, 0], phi[:, 0]), unit_vector(theta[:, 1], phi[:, 1])


def agree(got: Array, truth: Array, floor: float = 0.0) -> float:
    """Largest difference of two (n, k), relative to the largest of a column; an infinity must be one in both."""
    assert not np.any(np.isnan(got))
    steep = np.abs(truth) > 1e12  # a one-sided difference of an infinite slope
    infinite = np.isinf(got)
    assert np.all(steep[infinite]) and np.all(np.sign(got[infinite]) == np.sign(truth[infinite]))
    apart = np.where(infinite, 0.0, np.abs(np.where(infinite, 0.0, got) - truth))
    scale = np.maximum(np.max(np.where(infinite, 0.0, np.abs(truth)), axis=0), floor)
    return float(np.max(apart / np.where(scale > 1e-18, scale, 1.0)))  # mpmath's one-sided difference of a flat end is 1e-25


# --- the primary formulas -------------------------------------------------------------------------------------------------


def _sets(case: Case) -> Iterator[tuple[dict[str, Any], list[str]]]:
    """Ordinary values and all derivatives; then each other value of a parameter, and the derivative by it."""
    sets = case.one_at_a_time()
    first = next(sets)
    yield first, [*case.values]
    for other in sets:
        moved = [name for name in case.values if other[name] != first[name]]
        if len(moved) == 1:
            yield other, moved


BARE = [case for case in MICROFACETS if [*case.choices.values()][1:] == ["none", "smith"]]


@pytest.mark.parametrize("case", [*PLAIN, *SHORTS], ids=str)
def test_derivatives_of_the_primary_formulas(case: Case) -> None:
    assert against_primary(case, _sets(case)) <= LIMIT


def test_derivatives_of_tabulated_numbers() -> None:
    """Student's t: its Smith's function is a table that is made of alpha and gamma."""
    (case,) = (case for case in BARE if case.choices["distribution"] == "std")
    assert against_primary(case, itertools.islice(_sets(case), 1)) <= LIMIT


def against_primary(case: Case, sets: Iterable[tuple[dict[str, Any], list[str]]]) -> float:
    """Largest error of the derivatives over parameter sets and directions, relative to the largest derivative."""
    omega_i, omega_r = directions()
    geometries = [Geometry(*pair) for pair in zip(omega_i, omega_r, strict=True)]
    model, names, worst = families.find(case.name).model(**case.choices), [*case.values], 0.0
    for given, chosen in sets:
        columns = [names.index(name) for name in chosen]
        with mpmath.workdps(60):
            x = [mpf(given[name]) for name in names]
            truth = np.array([
                [derivative(case.formula, at, names, x, j, model.parameters[j]) for j in columns] for at in geometries
            ], dtype=float)  # fmt: skip
        brdf = make(case.name, **given)
        floor = _floor(brdf, omega_i, omega_r, [*map(float, x)], columns)
        error = agree(brdf.jacobian(omega_i, omega_r)[:, columns], truth, floor)
        print(f"{case} at {given}: {error:.1e}")
        worst = max(worst, error)
    return worst


def derivative(
    formula: Callable[..., mpf], at: Geometry, names: list[str], x: list[mpf], j: int, parameter: Parameter
) -> mpf:
    """Of the formula by its j-th parameter, from inside at the end of a range."""

    def moved(t: mpf) -> mpf:
        return formula(at, **dict(zip(names, [*x[:j], t, *x[j + 1 :]], strict=True)))

    side = _side(parameter, float(x[j]))
    # closed forms of gtr at whole gammas and quadratures beside them have no difference to all digits
    start = x[j] + side * mpf("1e-25") if parameter.name == "gamma" else x[j]
    return mpmath.diff(moved, start, direction=side)


def _floor(brdf: BRDF, omega_i: Array, omega_r: Array, values: Sequence[float], chosen: list[int]) -> float:
    """A parameter so large that it hardly matters, such as gamma at 1e6, has a derivative of what rounding leaves of f."""
    largest = float(np.max(brdf.evaluate(omega_i, omega_r)))
    return 0.1 * largest / max(1.0, *map(abs, values)) if len(chosen) == 1 else 0.0


def _side(parameter: Parameter, x: float) -> int:
    return 1 if x <= parameter.lower else -1 if x >= parameter.upper else 0


# --- every model against itself in mpmath ---------------------------------------------------------------------------------


class _Mathematics(types.ModuleType):
    """`math`, at the digits of the mpmath context."""

    def __getattr__(self, name: str) -> Any:
        named = {"fabs": abs, "pow": mpmath.power, "inf": mpmath.inf, "isfinite": mpmath.isfinite}
        return named.get(name) or getattr(mpmath, name)


_ELEMENTARY = {
    "exp": mpmath.exp, "log": lambda x: mpmath.log(x) if x > 0 else -mpmath.inf, "log1p": mpmath.log1p,
    "log_near": lambda u, f: mpmath.log(u) if u > 0 else -mpmath.inf, "power": lambda x, y: mpf(x) ** y,
    "two_products": lambda a, b, c, d: a * b + c * d,
}  # fmt: skip


def in_mpmath(function: Any) -> Callable[..., Any]:
    """A model function, and all that it calls, executed by mpmath."""
    inner = getattr(function, "py_func", function)
    if inner.__module__ == "gonio.brdf.elementary":
        return _ELEMENTARY[inner.__name__]  # of bits, which mpmath's numbers do not have

    def swap(value: Any) -> Any:
        if value is math or value is np:
            return _Mathematics("math")
        return in_mpmath(value) if hasattr(value, "py_func") else value

    space = {k: swap(v) for k, v in inner.__globals__.items() if k in inner.__code__.co_names}
    cells = tuple(types.CellType(swap(c.cell_contents)) for c in inner.__closure__ or ())
    space |= {"float": mpf, "__builtins__": __builtins__}
    return types.FunctionType(inner.__code__, space, inner.__name__, inner.__defaults__, cells)


MODELS = {model.expression: model for model in compiled()}


def parameter_sets(model: Model) -> Iterator[tuple[list[float], list[int]]]:
    """All inside the ranges, and all derivatives; then each parameter at each of its ends, and the derivative by it."""
    inside = [middle(p) for p in model.parameters]
    yield inside, [*range(len(inside))]
    for j, p in enumerate(model.parameters):
        for end in (p.lower, p.upper):
            yield [*inside[:j], end, *inside[j + 1 :]], [j]


SLOW = ("microfacet[distribution=gtr]", "microfacet[multiple_scattering=true]")  # tables of seconds, in derived numbers


@pytest.mark.parametrize("expression", [name for name in MODELS if name not in SLOW])
def test_every_model_against_itself_in_mpmath(expression: str) -> None:
    assert against_itself(expression) <= LIMIT


@pytest.mark.gate
def test_gate_derivatives() -> None:
    own = {expression: against_itself(expression) for expression in MODELS}
    primary = {str(case): against_primary(case, _sets(case)) for case in (*PLAIN, *SHORTS, *BARE)}
    for what, worst in (("themselves in mpmath", own), ("the primary formulas", primary)):
        name = max(worst, key=lambda n, worst=worst: worst[n])  # type: ignore[misc]
        record(
            f"derivatives of the BRDF models against {what}", f"{worst[name]:.1e} ({name}) of {len(worst)} models",
            f"<= {LIMIT:g} of the largest one", "-", "pytest -m gate tests/property/test_brdf_derivatives.py",
        )  # fmt: skip
    assert max(*own.values(), *primary.values()) <= LIMIT


def against_itself(expression: str) -> float:
    """Largest error of the derivatives over parameter sets and directions, relative to the largest derivative."""
    model, worst = MODELS[expression], 0.0
    twin = in_mpmath(model.function)
    omega_i, omega_r = directions()
    assert derivatives.how(model) == "automatic"
    for values, chosen in parameter_sets(model):
        brdf = BRDF([Term(model, model.complete(np.array(values)))])
        p, along = brdf.terms[0].values, derivatives.seeds(model, brdf.terms[0].values)
        truth = np.zeros((len(omega_i), len(values)))
        with mpmath.workdps(50):
            for k, j in itertools.product(range(len(omega_i)), chosen):
                w = [mpf(c) for c in (*omega_i[k], *omega_r[k])]
                side = _side(model.parameters[j], values[j])
                start, slope = [mpf(x) for x in p], [mpf(x) for x in along[j]]

                def moved(t: mpf, w: Any = w, start: Any = start, slope: Any = slope) -> mpf:
                    return twin(*w, [a + t * b if b else a for a, b in zip(start, slope, strict=True)])

                truth[k, j] = mpmath.diff(moved, 0, direction=side)
        floor = _floor(brdf, omega_i, omega_r, values, chosen)
        error = agree(brdf.jacobian(omega_i, omega_r)[:, chosen], truth[:, chosen], floor)
        print(f"{expression} at {values}: {error:.1e}")
        worst = max(worst, error)
    return worst


# --- the language ---------------------------------------------------------------------------------------------------------


@jit.model
def _pair(a: float, b: float) -> tuple[float, float]:
    if a > 2.0:
        return a, b * b
    c = a * b
    return c, math.hypot(a, b) + 1.0


@jit.model
def _series(x: float, count: int) -> float:
    """1 + x + x^2 / 2 + ... by a loop."""
    total, term = 1.0, 1.0
    for k in range(1, count):
        term *= x / k
        total += term
    return total


@jit.model
def _everything(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    a, b = p[0], p[1]
    u, v = _pair(a, b * zi)
    u, v = v, u  # exchanged
    w = -_series(a * zr, 20) if zi < zr else +_series(b, int(3.7))
    n = 0
    while n < 3:
        n += 1
        w = w * b / (a + n)
    first = p[2:]
    s: float = math.log1p(a * zi) + math.expm1(b) + math.log(a) + math.atan2(b, a) + math.tan(a / 4) + math.fabs(w)
    s += math.sin(u) * math.cos(v) + math.erf(b) - math.erfc(a) + math.tanh(a) + math.asin(b / 9) - math.acos(b / 9)
    s += math.sinh(b) + math.cosh(a) + math.atan(u) + abs(-a) + float(b) + a**3 + a**b + math.pow(b, a * zi)
    s += max(a, b * zi, 0.5) + min(u, v) + exp(-a) + log(b) + log1p(a) + power(a, zr) + power(zr, b) + power(b, a)
    return s + math.exp(first[0]) * math.sqrt(a * a + b * b) - math.sqrt(0.0 * a)


def _declared(name: str, function: Any, **given: Any) -> Model:
    names = [Parameter(n, 0.1, 3.0, "", ("uniform", 0.1, 3.0)) for n in ("a", "b", "c")]
    return Model(name, tuple(names), function, "of a test", "none", **given)


def test_the_language_of_models_is_differentiated() -> None:
    model = _declared("everything", _everything)
    twin, (omega_i, omega_r) = in_mpmath(_everything), directions()
    for values in ([0.7, 1.3, 0.2], [2.4, 0.6, 1.0]):
        truth = np.zeros((len(omega_i), 3))
        with mpmath.workdps(30):
            for k, j in itertools.product(range(len(omega_i)), range(3)):
                w, x = [mpf(c) for c in (*omega_i[k], *omega_r[k])], [mpf(v) for v in values]
                truth[k, j] = mpmath.diff(lambda t, w=w, x=x, j=j: twin(*w, [*x[:j], t, *x[j + 1 :]]), x[j])  # type: ignore[misc]
        got = BRDF([Term(model, np.array(values))]).jacobian(omega_i, omega_r)
        assert agree(got, truth) <= 1e-13
        apart = derivatives._differences(Term(model, np.array(values)), omega_i, omega_r).T
        assert agree(apart, truth) <= 1e-11


@jit.model
def _with_a_list(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    powers = [p[0], p[1] * zi]
    return (powers[0] + powers[1] * p[2] ** 2) if zi > 0.0 and zr > 0.0 else 0.0


def test_beyond_the_language_there_are_differences_and_a_reason() -> None:
    where = r"`\[p\[0\], p\[1\] \* zi\]` \(test_brdf_derivatives.py, line \d+\) is outside"
    with pytest.raises(ParameterError, match=where):
        tangent(_with_a_list)
    omega_i, omega_r = directions()
    listed, asked = _declared("listed", _with_a_list), []

    def array(wi: Array, wr: Array, p: Array) -> Array:
        asked.append(p.copy())
        return p[0] + p[1] * p[2] ** 2 * wi[:, 2]

    arrays = _declared("arrays", None, array_function=array)
    assert derivatives.how(listed).startswith("differences: `[p[0]") and "not compiled" in derivatives.how(arrays)
    zi = omega_i[:, 2]
    for values in ([0.5, 1.0, 2.0], [0.1, 3.0, 0.1], [3.0, 0.1, 3.0]):
        truth = np.stack((np.ones_like(zi), values[2] ** 2 * zi, 2 * values[1] * values[2] * zi), axis=1)
        for model in (listed, arrays):
            assert agree((2 * BRDF([Term(model, np.array(values))])).jacobian(omega_i, omega_r), 2 * truth) <= 1e-11
    assert np.all(np.array(asked) >= 0.1) and np.all(np.array(asked) <= 3.0)  # never outside the declared ranges


def test_derived_numbers_enter_by_the_chain_rule() -> None:
    """f_r = albedo / pi written as derived numbers of a and b; at the ends of their ranges too."""

    def derived(p: Array) -> Array:
        return np.array([math.exp(-p[0]) * p[1], 7.0, math.sqrt(p[1])])

    model = _declared("chained", _chained, derived=derived)
    omega_i, omega_r = directions()
    for a, b in ((0.1, 0.1), (1.0, 2.0), (3.0, 3.0)):
        p = model.values({"a": a, "b": b, "c": 0.3})
        got = BRDF([Term(model, p)]).jacobian(omega_i, omega_r)
        one = np.ones(len(omega_i))
        by_b = math.exp(-a) * 7 + 0.3 * 0.5 / math.sqrt(b)
        truth = np.stack((-math.exp(-a) * b * 7 * one, by_b * one, math.sqrt(b) * one), axis=1)
        assert agree(got, truth) <= 1e-11


@jit.model
def _chained(xi: float, yi: float, zi: float, xr: float, yr: float, zr: float, p: list[float]) -> float:
    return p[3] * p[4] + p[2] * p[5]


def test_sums_weights_shapes_and_deltas() -> None:
    omega_i, omega_r = directions()
    paper, gloss = make("lambertian", albedo=0.4), make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)
    both = paper + 0.5 * gloss
    assert list(both.parameters()) == ["lambertian.albedo", "ggx.k_s", "ggx.alpha", "ggx.f_0"]
    parts = np.concatenate((paper.jacobian(omega_i, omega_r), 0.5 * gloss.jacobian(omega_i, omega_r)), axis=1)
    assert np.array_equal(both.jacobian(omega_i, omega_r), parts)
    assert both.jacobian(omega_i[:, None], omega_r[None, :5]).shape == (12, 5, 4)
    assert both.jacobian(omega_i[0], omega_r[0]).shape == (4,)
    assert np.all(both.jacobian(-omega_i, omega_r) == 0.0)  # below the horizon
    mine = gonio.brdf.from_function(lambda wi, wr: np.full(len(wi), 0.1))
    assert (paper + mine).jacobian(omega_i, omega_r).shape == (12, 1)
    with pytest.raises(ParameterError, match="delta function"):
        (paper + make("specular", rho=1.0)).jacobian(omega_i, omega_r)


def test_compiled_derivatives_are_kept_on_disk(tmp_path: Path) -> None:
    script = (
        "import numpy as np; from gonio import brdf, jit; up = np.array([0, 0, 1.0]); "
        "print(brdf.make('lommel_seeliger', w=1).jacobian(up, up), jit.compiled_count())"
    )
    environment = os.environ | {"NUMBA_CACHE_DIR": str(tmp_path), "PYTHONPATH": str(Path(jit.__file__).parents[1])}
    told = [
        subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, check=True).stdout
        for _ in range(2)
    ]
    assert told[0].endswith("] 1\n") and told[1].endswith("] 0\n") and told[0].split("]")[0] == told[1].split("]")[0]
