"""Every model and every choice against the primary formula at 40 digits and more, at both ends of all parameters.

Directions: 0, 1e-8 and 0.3 rad to 89.99 degrees, exact mirror, exact retro-reflection, and 1e-8 and 1e-4 rad beside them. CI
takes each special value of a parameter among ordinary ones, and the microfacet models by 16 sets of choices in which each
pair occurs; the gate takes all combinations of values (of Hapke's every seventh) and of choices, in all directions.
"""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
import pytest

from gonio.brdf import families
from gonio.brdf.microfacet import CHOICES
from tests.brdf_formulas import MICROFACETS, PLAIN, SHORTS, Case
from tests.brdf_truth import compare
from tests.gates import record

LIMIT = 1e-12
DIGITS = 60


def _pairwise(cases: tuple[Case, ...]) -> list[Case]:
    """One shadowing for each distribution and reflectance, such that every two choices meet."""
    kinds = {key: list(dict.fromkeys(case.choices[key] for case in cases)) for key in cases[0].choices}

    def place(case: Case, key: str) -> int:
        return kinds[key].index(case.choices[key])

    return [c for c in cases if (place(c, "distribution") + place(c, "fresnel")) % 3 == place(c, "shadowing")]


@pytest.mark.parametrize("case", [*PLAIN, *SHORTS, *_pairwise(MICROFACETS)], ids=str)
def test_at_forty_digits(case: Case) -> None:
    assert compare(case.name, case.formula, case.one_at_a_time(), thin=12, digits=DIGITS) <= LIMIT


def test_every_model_has_its_formula() -> None:
    """Contract of names: all models but the mirror, a delta, and measured tables; all values inside the declared ranges."""
    named = {case.name for case in (*PLAIN, *SHORTS, *MICROFACETS)}
    assert named | {"specular"} == set(families.FAMILIES)
    assert len(MICROFACETS) == np.prod([len(CHOICES[key]) for key in MICROFACETS[0].choices])
    for case in (*PLAIN, *SHORTS, *MICROFACETS):
        parameters = families.find(case.name).model(**case.choices).parameters
        assert list(case.values) == [p.name for p in parameters]
        for p in parameters:
            ends = {p.lower, p.upper} - ({0.0} if case.choices.get("variant") == "full" else set())
            if p.name != "k_s" and len(case.values[p.name]) > 1:
                assert ends <= set(case.values[p.name]), (case, p.name)


@pytest.mark.gate
@pytest.mark.parametrize("group", ["plain", "microfacet"])
def test_gate_forty_digits_everywhere(group: str) -> None:
    cases = PLAIN if group == "plain" else (*SHORTS, *MICROFACETS)
    worst, count = (0.0, cases[0]), 0
    for case in cases:
        every = 1 if math.prod(map(len, case.values.values())) < 1000 else 7  # of Hapke's 1944
        sets: list[dict[str, Any]] = [*case.one_at_a_time(), *itertools.islice(case.all_together(), 0, None, every)]
        count += len(sets)
        worst = max(worst, (compare(case.name, case.formula, sets, digits=DIGITS), case), key=lambda w: w[0])
    assert worst[0] <= LIMIT
    record(
        f"BRDF models at {DIGITS} digits, {group}",
        f"{worst[0]:.1e} ({worst[1]}) of {len(cases)} models with {count} parameter sets",
        f"<= {LIMIT:g} relative, also at alpha = 1e-4", "-", "pytest -m gate tests/property/test_brdf_forty_digits.py",
    )  # fmt: skip
