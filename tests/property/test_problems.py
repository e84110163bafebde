"""Reflectance maps against a table of integrals that no gonio code has touched: tolerance kept, error never understated."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio
from gonio.errors import IntegrationError
from tests.gates import record
from tests.independent import reflected_radiance
from tests.make_problems import MORE
from tests.problems import Problem, brightness, load, make_brdf, make_source

PROBLEMS = load()
TOLERANCES = (1e-3, 1e-6, 1e-9)
NOTHING = 1e-24  # of the source's brightness: the far tail of a lobe, below which no relative accuracy is asked


def verdict(problem: Problem, value: float, error: float, rtol: float, raised: bool) -> str:
    """Empty if tolerance and error are kept, else what is wrong.

    A bilinear map has an edge at every texel; 1e-6 is promised for it. Beyond, gonio may refuse, but not lie.
    """
    off, slack = abs(value - problem.value), NOTHING * brightness(problem.source)
    may_refuse = problem.source_name == "map" and rtol < 1e-6
    kept = (off <= rtol * abs(problem.value) + slack) and not raised
    honest = off <= error + problem.uncertainty + slack
    if (kept or (raised and may_refuse)) and honest and math.isfinite(value):
        return ""
    scale = abs(problem.value) or 1.0
    what = ", ".join(w for w, bad in (("refused", raised), ("not kept", not kept), ("dishonest", not honest)) if bad)
    seen = f"{value!r}, truth {problem.value!r}, off {off / scale:.1e}, error {error / scale:.1e}"
    return f"{problem} at {rtol:g}: {seen}: {what}"


def solve(problems: list[Problem], more: np.ndarray, rtol: float) -> list[str]:
    """Problems of one BRDF and one source on one map, together with further gradients (n, 2)."""
    brdf, source = make_brdf(problems[0].brdf), make_source(problems[0].source)
    at = np.concatenate(([(x.p, x.q) for x in problems], more.reshape(-1, 2)))
    raised = False
    try:
        got = gonio.reflectance_map(
            brdf, source, at[:, 0], at[:, 1], rtol=rtol, atol=NOTHING * brightness(problems[0].source)
        )
    except IntegrationError as exc:  # of which gradients it is true, the errors say
        got, raised = exc.best, True  # type: ignore[assignment]
    wrong = []
    for problem, value, error in zip(problems, got.value, got.error, strict=False):
        missed = raised and (len(more) == 0 or error > 1.01 * rtol * abs(value) + NOTHING * brightness(problem.source))
        wrong.append(verdict(problem, float(value), float(error), rtol, missed))
    return [w for w in wrong if w]


PAIRS = sorted({(x.brdf_name, x.source_name) for x in PROBLEMS})
FIRST = [x for x in PROBLEMS if x.brdf_name not in MORE]
# of every other model one kind of light in turn, of those that share kernels with other tests
LIGHTS = ("sphere", "map", "harmonics", "tilted sky", "smooth map")
TURN = {name: LIGHTS[k % len(LIGHTS)] for k, name in enumerate(MORE)}
SLICE = FIRST + [x for x in PROBLEMS if TURN.get(x.brdf_name) == x.source_name]
# gradients, all of different slopes, at which a map is made from tables
GRID = np.stack(np.meshgrid(np.linspace(-2.9, 2.7, 12), np.linspace(-2.3, 3.1, 10)), axis=-1).reshape(-1, 2)


def of(pair: tuple[str, str]) -> list[Problem]:
    return [x for x in PROBLEMS if (x.brdf_name, x.source_name) == pair]


@pytest.mark.parametrize("problem", SLICE, ids=str)
def test_one_gradient(problem: Problem) -> None:
    wrong = [w for rtol in TOLERANCES for w in solve([problem], np.empty((0, 2)), rtol)]
    assert not wrong, "\n".join(wrong)


def test_the_grid_is_large_enough_for_tables() -> None:
    """Of theta_n under skies, of rings under fields: twice as many gradients take no more evaluations."""
    for pair in (("ggx 0.1", "sky"), ("ggx 0.1", "studio")):
        brdf, source = make_brdf(of(pair)[0].brdf), make_source(of(pair)[0].source)
        once, twice = (
            gonio.reflectance_map(brdf, source, *grid.T, rtol=1e-6).plan[-1].effort.evaluations
            for grid in (GRID, np.concatenate((GRID, GRID + 1e-3)))
        )
        assert twice < 1.2 * once


@pytest.mark.parametrize("pair", [pair for pair in PAIRS if pair[0] not in MORE][::6], ids=" / ".join)
def test_within_a_map(pair: tuple[str, str]) -> None:
    """The same gradients as pixels of a map, where tables and interpolation serve; CI takes one pair in six at 1e-6."""
    wrong = solve(of(pair), GRID, 1e-6)
    assert not wrong, "\n".join(wrong)


def test_two_sums_that_take_as_many_nodes() -> None:
    """Seen along the surface, rings are so short that two numbers of digits may come to the same rule."""
    wrong = [w for rtol in TOLERANCES for w in solve(of(("paint", "harmonics")), GRID, rtol)]
    assert not wrong, "\n".join(wrong)


def test_gradients_at_which_a_table_falls_short() -> None:
    """Of multiple scattering, itself a table with borders, no order of rings is sure of nine digits."""
    wrong = solve(of(("furnace", "sphere")), GRID, 1e-9)
    assert not wrong, "\n".join(wrong)


@pytest.mark.gate
def test_whole_table_alone() -> None:
    """All problems at all tolerances, each by itself."""
    nothing = np.empty((0, 2))
    wrong = [w for x in PROBLEMS for rtol in TOLERANCES for w in solve([x], nothing, rtol)]
    print("\n".join(wrong))
    record(
        "problem table, single gradients",
        f"{len(wrong)} of {len(PROBLEMS) * len(TOLERANCES)} off",
        "0: relative error within 1e-3, 1e-6, 1e-9 and within the reported error",
        "-",
        "pytest -m gate tests/property/test_problems.py -s -k alone",
    )
    assert not wrong


@pytest.mark.gate
@pytest.mark.parametrize("rtol", TOLERANCES)
def test_whole_table_within_maps(rtol: float) -> None:
    """All problems as pixels of maps of their BRDF and source; each map tells what is wrong as soon as it is done."""
    wrong = []
    for number, pair in enumerate(PAIRS):
        found = solve(of(pair), GRID, rtol)
        print(f"{number + 1} of {len(PAIRS)}: {' / '.join(pair)}", *found, sep="\n    ", flush=True)
        wrong += found
    record(
        f"problem table, within maps, {rtol:g}",
        f"{len(wrong)} of {len(PROBLEMS)} off, on {len(PAIRS)} maps",
        f"0: relative error within {rtol:g} and within the reported error",
        "-",
        f"pytest -m gate tests/property/test_problems.py -s -k '{rtol:g}'",
    )
    assert not wrong


# --- the table itself ---------------------------------------------------------------------------------------------------


def test_the_table_is_broad_and_its_two_methods_agree() -> None:
    assert len(PROBLEMS) >= 700
    assert all(x.uncertainty <= 1.2e-11 * x.value for x in PROBLEMS)
    tags = {tag for x in PROBLEMS for tag in x.tags}
    assert {"theta_n 0", "theta_n 89.9", "mirror", "terminator - 0.1", "terminator + 0.1", "small source"} <= tags
    assert {"rim at the horizon", "rim mirrored", "narrow lobe", "kinks", "two horizons"} <= tags


@pytest.mark.parametrize("method", ["normal", "other"])
def test_the_second_opinion_knows_what_is_known_exactly(method: str) -> None:
    """Closed forms: 14b, 14c, a sun on white paper, E(1; GGX, alpha = 1) = 1 - ln 2, Phong's albedo at normal incidence."""
    white = [{"model": "lambertian", "albedo": 1.0}]

    def value(brdf: list[dict[str, object]], source: dict[str, object], p: float, q: float) -> float:
        return reflected_radiance({"brdf": brdf, "source": [source], "p": p, "q": q}, method)

    for p, q in ((0.0, 0.0), (0.3, -0.8), (5.0, 2.0)):
        length = math.sqrt(1 + p * p + q * q)
        assert value(white, {"kind": "uniform", "radiance": 1.0}, p, q) == pytest.approx(1.0, rel=1e-12)
        sky = value(white, {"kind": "hemispherical", "radiance": 1.0}, p, q)
        assert sky == pytest.approx((1 + 1 / length) / 2, rel=1e-12)
        sun = {"kind": "disk", "theta": 0.3, "phi": 1.0, "half_angle": 0.02, "radiance": 1.0}
        cos_i = (-p * math.sin(0.3) * math.cos(1.0) - q * math.sin(0.3) * math.sin(1.0) + math.cos(0.3)) / length
        if cos_i > 0.1:
            assert value(white, sun, p, q) == pytest.approx(math.sin(0.02) ** 2 * cos_i, rel=1e-11)
    sphere = {"kind": "uniform", "radiance": 1.0}
    metal = [{"model": "ggx", "k_s": 1.0, "alpha": 1.0, "f_0": 1.0}]
    assert value(metal, sphere, 0.0, 0.0) == pytest.approx(1 - math.log(2), rel=1e-12)
    assert value([{"model": "phong", "k_s": 0.7, "n": 30.0}], sphere, 0.0, 0.0) == pytest.approx(0.7, rel=1e-12)
    lobe = {"kind": "lobes", "amplitude": 1.0, "kappa": 3.0, "theta": 0.0, "phi": 0.0}
    assert value(white, lobe, 0.0, 0.0) == pytest.approx(2 * (3 - 1 + math.exp(-3)) / 9, rel=1e-12)  # by parts
