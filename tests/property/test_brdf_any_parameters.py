"""Every model with any parameters inside its ranges: finite, never negative, 0 below the horizon, reciprocal.

In CI Hypothesis draws the parameters, ends of the ranges included, and a seed for 200 pairs of directions of the whole
sphere, many of them grazing, near the normal, near the mirror and near each other; the gate draws 10^5 sets. Outside the
ranges there is one clear sentence.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import gonio
from gonio.brdf import families
from gonio.errors import ParameterError
from tests.brdf_formulas import MICROFACETS, PLAIN, SHORTS
from tests.brdf_truth import check_refusals, parameter_sets, reciprocity
from tests.gates import record

make = gonio.brdf.make
LIMIT = 1e-13
REPEATED: list[tuple[str, dict[str, Any]]] = [
    ("microfacet", {"distribution": d, "shadowing": s, "fresnel": f, "multiple_scattering": True})
    for d, s, f in (
        ("ggx", "smith", "none"), ("beckmann", "smith_separable", "schlick"), ("std", "smith", "conductor"),
        ("gtr", "smith", "dielectric"),
    )
]  # fmt: skip
MODELS: list[tuple[str, dict[str, Any]]] = [(c.name, dict(c.choices)) for c in (*PLAIN, *SHORTS)]
BARE = [(c.name, dict(c.choices)) for c in MICROFACETS if [*c.choices.values()][1:] == ["none", "smith"]]
GATE_TOTAL = 100_000


def _named(value: Any) -> str:
    return "-".join([value[0], *map(str, value[1].values())])


def random_sets(name: str, choices: dict[str, Any], count: int, seed: int) -> Iterator[dict[str, Any]]:
    """Arguments of `gonio.brdf.make`: evenly inside the ranges, where wide by logarithm; every fifth value an end."""
    rng = np.random.default_rng(seed)
    parameters = families.find(name).model(**choices).parameters
    for _ in range(count):
        given = dict(choices)
        for p in parameters:
            value = rng.uniform(p.lower, p.upper)
            if p.lower > 0 and p.upper / p.lower > 100 and rng.random() < 0.6:
                value = min(max(math.exp(rng.uniform(math.log(p.lower), math.log(p.upper))), p.lower), p.upper)
            given[p.name] = value if rng.random() < 0.8 else (p.lower, p.upper)[rng.integers(2)]
        yield given


@pytest.mark.parametrize("model", [*MODELS, *BARE, REPEATED[0]], ids=_named)
def test_any_parameters(model: tuple[str, dict[str, Any]]) -> None:
    name, choices = model

    @settings(max_examples=30, deadline=None, derandomize=True)
    @given(parameters=parameter_sets(name, **choices), seed=st.integers(0, 2**31))
    def run(parameters: dict[str, Any], seed: int) -> None:
        assert reciprocity(make(name, **parameters), 200, seed) <= LIMIT

    run()


@pytest.mark.gate
def test_gate_any_parameters() -> None:
    """10^5 parameter sets, spread evenly over all models and choices; tables of seconds get fewer."""
    microfacets = [(c.name, dict(c.choices)) for c in MICROFACETS]
    slow = [m for m in microfacets if m[1]["distribution"] == "gtr"]
    quick = [*MODELS, *(m for m in microfacets if m not in slow)]
    counts = [(m, 100) for m in slow] + [(m, 10) for m in REPEATED]
    each = -(-(GATE_TOTAL - sum(n for _, n in counts)) // len(quick))
    counts += [(m, each) for m in quick]
    for k, ((name, choices), count) in enumerate(counts):
        for n, parameters in enumerate(random_sets(name, choices, count, k)):
            assert reciprocity(make(name, **parameters), 200, n % 256) <= LIMIT, parameters
    total = sum(n for _, n in counts)
    record(
        "BRDF models with any parameters",
        f"{total} parameter sets of {len(counts)} models, 200 pairs of directions each: none failed",
        f"finite, never negative, reciprocal to {LIMIT:g}", f"0 to {len(counts) - 1}",
        "pytest -m gate tests/property/test_brdf_any_parameters.py",
    )  # fmt: skip


@pytest.mark.parametrize("model", [*MODELS, ("specular", {})], ids=_named)
def test_refusals(model: tuple[str, dict[str, Any]]) -> None:
    name, choices = model
    inside = {p.name: p.lower for p in families.find(name).model(**choices).parameters}
    check_refusals(name, inside, **choices)
    for wrong in (dict.fromkeys([*inside][1:], 0.5) if len(inside) > 1 else {}, {**inside, "colour": 1.0}):
        with pytest.raises(ParameterError, match=r"needs .* as well|has no parameter 'colour'"):
            make(name, **{**wrong, **choices})


@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        ({"distribution": "std", "f_0": 0.5}, "needs gamma"),
        ({"f_0": 0.5, "gamma": 2.0}, "no parameter 'gamma'"),
        ({"fresnel": "dielectric", "f_0": 0.5}, "no parameter 'f_0'"),
        ({"distribution": "beckman", "f_0": 0.5}, "did you mean 'beckmann'"),
        ({"shadowing": "v_groove", "multiple_scattering": True, "f_0": 0.5}, "Smith's shadowing only"),
        ({"multiple_scattering": 1.0, "f_0": 0.5}, "multiple_scattering"),
        ({"multiple_scattering": np.True_, "shadowing": "v_groove", "f_0": 0.5}, "Smith's shadowing only"),
        ({"varient": "full", "f_0": 0.5}, "no choice 'varient'; it has: distribution"),
        *(({"f_0": value}, "f_0 = .* is not a number; choose one inside") for value in (None, "0.5", [0.5], True, 1j)),
    ],
)
def test_undefined_combinations_are_one_sentence(wrong: dict[str, Any], words: str) -> None:
    with pytest.raises(ParameterError, match=words) as told:
        make("microfacet", k_s=1.0, alpha=0.1, **wrong)
    assert "\n" not in str(told.value)
