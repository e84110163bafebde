"""What does this scene need? One step per (BRDF term, source part), the cheapest method that is right for it."""

from __future__ import annotations

import enum
from dataclasses import dataclass, field

from gonio.brdf.base import BRDF, Term
from gonio.fields import Field
from gonio.integrate import diffuse
from gonio.integrate.quadrature import Effort
from gonio.source import Collimated, Part, Source


class Method(enum.Enum):
    """How one step is computed."""

    ZERO = "skipped"
    BEAM = "closed form 14a"
    LAMBERT = "closed form of a diffuse surface"
    MIRROR = "closed form 15b, 15c"
    IMPULSE = "closed form 15a"
    RADIAL = "one-dimensional in theta_n"
    GENERAL = "quadrature per gradient"
    RINGS = "rings about the view axis"
    FIELD = "quadrature of a field per gradient"


@dataclass
class Step:
    """One (term, part) with its method and, after the run, what it took.

    Attributes
    ----------
    reason : str
        Why this method; what was skipped.
    seconds, error : float
        Filled by the run: wall time [s], without that of loading and compiling kernels, and the largest error relative to
        what the step itself adds, or to the sum of the steps so far where the method shares the tolerance with them (rings).
    """

    term: Term
    part: Part
    method: Method
    reason: str
    effort: Effort = field(default_factory=Effort)
    seconds: float = 0.0
    error: float = 0.0

    def describe(self) -> dict[str, object]:
        """Row of ``--explain``."""
        kind = "collimated" if isinstance(self.part, Collimated) else self.part.kind
        return {
            "term": self.term.model.name,
            "source": kind,
            "method": self.method.value,
            "reason": self.reason,
            "evaluations": self.effort.evaluations,
            "order": self.effort.order,
            "largest_relative_error": self.error,
            "seconds": self.seconds,
        }


def plan(brdf: BRDF, source: Source) -> list[Step]:
    """Choose a method for every pair of BRDF term and source part."""
    return [_step(term, part) for term in brdf.terms for part in source.parts]


def _step(term: Term, part: Part) -> Step:
    amount = part.irradiance if isinstance(part, Collimated) else part.radiance
    mirror = term.model.delta
    if amount == 0.0 or term.weight == 0.0:
        return Step(term, part, Method.ZERO, "zero radiance" if amount == 0.0 else "zero weight")
    if isinstance(part, Collimated):
        if mirror:
            return Step(term, part, Method.IMPULSE, "a mirror in a beam: a delta function of the gradient")
        return Step(term, part, Method.BEAM, "a beam: one evaluation per gradient; back-facing gradients are 0")
    if mirror:
        return Step(term, part, Method.MIRROR, "a mirror: the source seen in the mirror direction")
    if isinstance(part, Field) and term.upright:
        return Step(term, part, Method.RINGS, "isotropic: one kernel for all phi_n, the field's waves apart")
    if isinstance(part, Field):
        return Step(term, part, Method.FIELD, "a radiance field: cells between its edges and the surface's horizon")
    if diffuse.suits(term, part):
        return Step(term, part, Method.LAMBERT, "a diffuse surface under a uniform sphere, hemisphere or disk")
    if term.model.isotropic and part.axis in ((0.0, 0.0, 1.0), (0.0, 0.0, -1.0)):
        return Step(term, part, Method.RADIAL, "symmetric about the view axis: R depends on theta_n only; half the azimuths")
    if not term.plain:
        return Step(term, part, Method.GENERAL, "kinks, a grain or a user's function: adaptive cells between known edges")
    return Step(term, part, Method.GENERAL, "only directions above both horizons")
