"""``python -m tests.conformance [--write]``: for every model what confirms it, as tables; with --write as docs/models.md.

Takes minutes: every model is evaluated at 60 digits as well. Programs that are not installed are named and left out, and
then nothing is written.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import math
import sys
from collections.abc import Iterable, Sequence
from pathlib import Path

from gonio.brdf import Model, families
from tests.brdf_formulas import MICROFACETS, PLAIN, SHORTS, Case
from tests.brdf_truth import compare, pairs
from tests.conformance.third_party import Comparison, everything

PAGE = Path(__file__).parents[2] / "docs" / "models.md"
THIN, DIGITS = 12, 60
HEAD = """# Models, and what confirms each

All figures of this page are from one run of

    make conformance     # .venv/bin/python -m tests.conformance --write

which first installs two programs of others, Mitsuba and pySCATMECH (the latter is compiled, which takes minutes). Without
them the tests in `tests/conformance/test_third_party.py` are left out. `gonio models NAME` explains a model and draws its
lobe. Times of all models are in [benchmarks.md](benchmarks.md).
"""
FORTY = """
## Against the primary formulas

The worst relative error against the formula as its source prints it, evaluated at {digits} digits
(`tests/brdf_formulas.py`), over {pairs} pairs of directions - among them the normal, 89.99 degrees, exact mirrors, exact
retro-reflection, and 1e-8 and 1e-4 rad beside these - times the parameter sets: each parameter at both ends of its range
and at places where a formula could fail, among ordinary values of the others. Demanded: 1e-12. `make gates` takes all
combinations of values and choices: [gates.md](gates.md). R: reciprocal. E: directional albedo at most 1.
"""
OTHERS = """
## Against programs of others

{releases}, each at {count} pairs of directions up to 88.9 degrees, among them the normal, mirrors and exact
retro-reflection. SCATMECH (NIST) was written for scatter from optics, in double precision; Mitsuba is a renderer, in single
precision. The largest relative difference; values below 1e-6 of the largest count by their absolute difference. Where a
program states that it approximates something, a second row shows what is left once gonio is given the same approximation.
"""
NONE = """
Neither computes {names} as gonio does; these have the formulas above, and limits and closed forms in
`tests/property/test_brdf_*.py`. `ggx` and `beckmann` are microfacet models with Schlick's reflectance and height-correlated
shadowing, which neither has; their distributions and all else are those of the rows of `microfacet`. Hapke's model is
confirmed where single scattering is all: its phase function. `specular` is a delta function. Light that facets scatter
several times is in neither; Kulla and Conty's integrals are held against independent ones in
`tests/property/test_brdf_microfacet.py`.
"""


def main() -> int:
    """Print the page; write it if asked to."""
    parser = argparse.ArgumentParser(prog="python -m tests.conformance", description=__doc__)
    parser.add_argument("--write", action="store_true", help="write docs/models.md")
    given = parser.parse_args()
    found = everything()
    missing = sorted({c.program for c in found if c.missing})
    found = [c for c in found if not c.missing]
    text = HEAD + FORTY.format(digits=DIGITS, pairs=len(pairs(THIN)[0])) + "\n" + formulas()
    if found:
        releases = " and ".join(dict.fromkeys(c.release for c in found))
        text += OTHERS.format(releases=releases, count=len(found[0].values()[0])) + "\n" + programs(found) + nobody(found)
    print(text)
    for program in missing:
        print(f"{program} is not installed (pip install -e '.[conformance]'): left out")
    if given.write and not missing:
        PAGE.write_text(text, encoding="utf-8")
        print(f"wrote {PAGE}")
    off = [c for c in found if not c.difference <= c.limit]
    for c in off:
        print(f"OFF by {c.difference:.1e}, not {c.limit:.0e}: {c}")
    return 1 if off or (given.write and missing) else 0


def formulas() -> str:
    """The table of errors against the primary formulas."""
    default = {key: allowed[0] for key, allowed in families.FAMILIES["microfacet"].choices.items()}
    few = [case for case in MICROFACETS if sum(default[k] != v for k, v in case.choices.items()) <= 1]
    rows = []
    for case in (*PLAIN, *SHORTS, *few):
        model = families.find(case.name).model(**case.choices)
        worst, count = _worst(case)
        print(f"{model.expression}: {worst:.1e}", file=sys.stderr, flush=True)
        kept = "R" * model.reciprocal + " E" * model.energy_bounded
        rows.append([model.expression, _ranges(model), model.reference, kept, f"{worst:.1e}", str(count)])
    return _table(["model", "parameters", "source", "", "worst error", "values"], rows)


def _worst(case: Case) -> tuple[float, int]:
    sets = list(case.one_at_a_time())
    with contextlib.redirect_stdout(io.StringIO()):
        worst = compare(case.name, case.formula, sets, thin=THIN, digits=DIGITS)
    return worst, len(sets) * len(pairs(THIN)[0])


def _ranges(model: Model) -> str:
    def shown(x: float, unit: str) -> str:
        return f"{math.degrees(x):.4g} deg" if unit == "rad" else f"{x:g}"

    return ", ".join(f"{p.name} {shown(p.lower, p.unit)} to {shown(p.upper, p.unit)}" for p in model.parameters)


def programs(found: Sequence[Comparison]) -> str:
    """The table of differences from programs of others, one row for each of their models and gonio's."""
    groups: dict[tuple[str, str, str], list[Comparison]] = {}
    for c in found:
        groups.setdefault((c.brdf.terms[0].model.expression, c.release, c.theirs), []).append(c)
    rows = []
    for (model, release, theirs), same in sorted(groups.items()):
        worst = max(c.difference for c in same)
        mark = "" if all(c.difference <= c.limit for c in same) else " OFF"
        rows.append([model, f"{release}: {theirs}", _values(same), f"{worst:.1e}{mark}", same[0].limited_by])
    return _table(["model", "program and its model", "parameters", "difference", "limited by"], rows)


def _values(same: Iterable[Comparison]) -> str:
    """``alpha 0.05, 0.35, 0.8; n 1.5``"""
    values: dict[str, list[str]] = {}
    for c in same:
        for name, value in c.brdf.parameters().items():
            values.setdefault(name.partition(".")[2], []).append(f"{value:g}")
    return "; ".join(f"{name} {', '.join(dict.fromkeys(shown))}" for name, shown in values.items())


def nobody(found: Sequence[Comparison]) -> str:
    confirmed = {c.brdf.terms[0].model.name for c in found} | {"specular", "ggx", "beckmann"}
    return NONE.format(names=", ".join(name for name in families.FAMILIES if name not in confirmed))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    return "\n".join("| " + " | ".join(row) + " |" for row in (head, ["---"] * len(head), *rows)) + "\n"


if __name__ == "__main__":
    sys.exit(main())
