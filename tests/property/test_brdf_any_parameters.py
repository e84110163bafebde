"""Every model with any parameters inside its ranges: finite, never negative, 0 below the horizon, reciprocal.

Hypothesis draws the parameters, ends of the ranges included, and a seed for 200 pairs of directions of the whole sphere,
many of them grazing, near the normal, near the mirror and near each other. Outside the ranges there is one clear sentence.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, seed, settings
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


def check(model: tuple[str, dict[str, Any]], count: int, first_seed: int = 0) -> None:
    """As many parameter sets of a model."""
    name, choices = model

    @seed(first_seed)
    @settings(max_examples=count, deadline=None, database=None, suppress_health_check=list(HealthCheck))
    @given(parameters=parameter_sets(name, **choices), number=st.integers(0, 2**31))
    def run(parameters: dict[str, Any], number: int) -> None:
        assert reciprocity(make(name, **parameters), 200, number) <= LIMIT

    run()


@pytest.mark.parametrize("model", [*MODELS, *BARE], ids=_named)
def test_any_parameters(model: tuple[str, dict[str, Any]]) -> None:
    check(model, 30)


@pytest.mark.gate
def test_gate_any_parameters() -> None:
    """10^5 parameter sets, spread evenly over all models and choices; tables of seconds get fewer."""
    microfacets = [(c.name, dict(c.choices)) for c in MICROFACETS]
    slow = [m for m in microfacets if m[1]["distribution"] == "gtr"]
    quick = [*MODELS, *(m for m in microfacets if m not in slow)]
    counts = [(m, 100) for m in slow] + [(m, 10) for m in REPEATED]
    each = -(-(GATE_TOTAL - sum(n for _, n in counts)) // len(quick))
    counts += [(m, each) for m in quick]
    for k, (model, count) in enumerate(counts):
        check(model, count, k)
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
