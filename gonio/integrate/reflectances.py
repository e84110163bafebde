r"""The nine reflectances of Nicodemus, and what else follows from one integral over directions.

Each of the incident and the reflected light is a direction, a cone or the hemisphere [1]_. With the projected solid angles
:math:`\Omega = \int \cos\theta\,\mathrm{d}\omega`, all nine are one mean of the BRDF,

.. math:: \bar f = \frac{1}{\Omega_i\,\Omega_r}\int\!\!\int f_r\,\mathrm{d}\Omega_i\,\mathrm{d}\Omega_r ,

times :math:`\Omega_r` for a reflectance, times pi for a reflectance factor. A reflectance into a direction is differential:
:math:`\bar f` is its coefficient of :math:`\mathrm{d}\Omega_r`. Angles are those of the BRDF, azimuths from its x axis, so
an anisotropic surface needs no tangent here. Light is unpolarised and comes with the same radiance from all of the cone.

References
----------
.. [1] F. E. Nicodemus et al., "Geometrical Considerations and Nomenclature for Reflectance", NBS Monograph 160, 1977, table
   2. doi:10.6028/NBS.MONO.160
.. [2] B. K. P. Horn, R. W. Sjoberg, MIT AI Memo 498, 1978, section 9.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from gonio.brdf.base import BRDF, Model, Term
from gonio.errors import GeometryError, IntegrationError, ParameterError
from gonio.geometry import unit_vector
from gonio.integrate.adaptive import Region, integrate
from gonio.integrate.quadrature import Effort
from gonio.integrate.results import Estimate

Array = NDArray[np.float64]
EPS = float(np.finfo(float).eps)
_FLIP = np.array([-1.0, -1.0, 1.0])  # mirror image in the normal


@dataclass(frozen=True)
class Direction:
    """One direction.

    Attributes
    ----------
    theta, phi : float
        From the normal and from the BRDF's x axis [rad], 0 <= theta < pi/2.
    """

    theta: float
    phi: float = 0.0

    def __post_init__(self) -> None:
        if not (math.isfinite(self.phi) and 0 <= self.theta < math.pi / 2):
            raise GeometryError(
                f"direction theta = {math.degrees(self.theta):g}, phi = {math.degrees(self.phi):g} degrees; choose "
                "0 <= theta < 90 degrees and a finite phi"
            )

    def axis(self) -> Array:
        """Unit vector in the local frame."""
        return unit_vector(self.theta, self.phi)


@dataclass(frozen=True)
class Cone:
    """All directions within a half angle of an axis, as far as they are above the surface.

    Attributes
    ----------
    theta, phi : float
        Of the axis, from the normal and from the BRDF's x axis [rad], 0 <= theta <= pi/2.
    half_angle : float
        [rad], 0 < half_angle <= pi/2.
    """

    theta: float
    phi: float
    half_angle: float

    def __post_init__(self) -> None:
        if not (math.isfinite(self.phi) and 0 <= self.theta <= math.pi / 2 and 1e-6 <= self.half_angle <= math.pi / 2):
            raise GeometryError(
                f"cone theta = {math.degrees(self.theta):g}, phi = {math.degrees(self.phi):g}, half angle = "
                f"{math.degrees(self.half_angle):g} degrees; choose 0 <= theta <= 90, 6e-5 <= half angle <= 90 degrees; "
                "narrower ones are a Direction"
            )

    def axis(self) -> Array:
        """Unit vector in the local frame."""
        return unit_vector(self.theta, self.phi)

    def projected_solid_angle(self) -> float:
        """Integral of cos(theta) d omega over the cone above the surface [sr]: pi for the hemisphere."""
        if self.theta + self.half_angle <= math.pi / 2:
            return math.pi * math.sin(self.half_angle) ** 2 * math.cos(self.theta)
        value, _ = integrate(_ONE, _UP, _region(self, 1), None, rtol=1e-13, atol=0.0, effort=Effort())
        return float(value[0])


HEMISPHERE = Cone(0.0, 0.0, math.pi / 2)


def reflectance(brdf: BRDF, incident: Direction | Cone, reflected: Direction | Cone, *, rtol: float = 1e-6) -> Estimate:
    r"""Any of the nine reflectances [1]_.

    Parameters
    ----------
    brdf : BRDF
    incident, reflected : Direction or Cone
        `HEMISPHERE` is the cone of all directions.
    rtol : float, optional
        Relative error requested.

    Returns
    -------
    Estimate
        Into a cone or the hemisphere: reflected over incident flux [1]. Into a direction: the coefficient of the projected
        solid angle :math:`\mathrm{d}\Omega_r` [1/sr], which for light from a direction is f_r itself.

    Raises
    ------
    ParameterError
        For a delta function from direction to direction.
    IntegrationError
        If `rtol` is not met; ``exc.best`` is the estimate reached.

    Examples
    --------
    A white diffuse surface sends sin^2(30 degrees) = 1/4 of its light into a cone of that half angle about its normal:

    >>> import gonio
    >>> white, cone = gonio.brdf.make("lambertian", albedo=1.0), Cone(0.0, 0.0, math.radians(30))
    >>> round(float(reflectance(white, Direction(0.7), cone).value), 12)
    0.25
    """
    mean = _mean(brdf, incident, reflected, rtol)
    size = reflected.projected_solid_angle() if isinstance(reflected, Cone) else 1.0
    return _met(_scaled(mean, size), rtol)


def reflectance_factor(
    brdf: BRDF, incident: Direction | Cone, reflected: Direction | Cone, *, rtol: float = 1e-6
) -> Estimate:
    r"""Any of the nine reflectance factors [1]_: the reflectance relative to that of a perfect diffuser, :math:`\pi\bar f`.

    Parameters and errors are those of `reflectance`.
    """
    return _met(_scaled(_mean(brdf, incident, reflected, rtol), math.pi), rtol)


def white_sky_albedo(brdf: BRDF, *, rtol: float = 1e-6) -> Estimate:
    """Bi-hemispherical reflectance: of light that comes with the same radiance from everywhere."""
    return reflectance(brdf, HEMISPHERE, HEMISPHERE, rtol=rtol)


def _scaled(estimate: Estimate, factor: float) -> Estimate:
    return replace(estimate, value=estimate.value * factor, error=estimate.error * factor)


def _met(estimate: Estimate, rtol: float) -> Estimate:
    if float(estimate.error) > rtol * float(estimate.value) * (1 + 1e-9) + 1e-15:
        raise IntegrationError(
            f"reflectance: reached a relative error of {float(estimate.error / estimate.value):.1e} where {rtol:.1e} was "
            "asked for; ask for a larger rtol or use the estimate in exc.best",
            estimate,
        )
    return estimate


def _mean(brdf: BRDF, incident: Direction | Cone, reflected: Direction | Cone, rtol: float) -> Estimate:
    """The mean of f_r over both projected solid angles [1/sr]."""
    if not (math.isfinite(rtol) and rtol > 0):
        raise ParameterError(f"rtol = {rtol:g} must be positive")
    value = error = 0.0
    for term in brdf.terms:
        if term.weight == 0.0:
            continue
        v, e = _mirror(term, incident, reflected) if term.model.delta else _smooth(term, incident, reflected, rtol)
        value, error = value + v, error + e
    own = any(term.model.own for term in brdf.terms)
    return Estimate(np.asarray(value), np.asarray(error), error_is_bound=not own)


def _smooth(term: Term, incident: Direction | Cone, reflected: Direction | Cone, rtol: float) -> tuple[float, float]:
    if isinstance(incident, Direction) and isinstance(reflected, Direction):
        value = float(BRDF([term]).evaluate(incident.axis(), reflected.axis()))
        return value, 32.0 * EPS * value * (1.0 + 1.0 / (term.lobe_width() or 1.0))
    if isinstance(reflected, Direction):
        assert isinstance(incident, Cone)
        v, e = _inner(term, reflected.axis()[None, :], incident, 0.3 * rtol, reverse=False)
        return _over(v[0], e[0], incident.projected_solid_angle())
    if isinstance(incident, Direction):
        v, e = _inner(term, incident.axis()[None, :], reflected, 0.3 * rtol, reverse=True)
        return _over(v[0], e[0], reflected.projected_solid_angle())
    # the narrower cone outside: over it the inner integral varies least
    swap = incident.half_angle < reflected.half_angle
    outer, inner = (incident, reflected) if swap else (reflected, incident)
    total, error = _double(term, outer, inner, rtol, reverse=swap)
    return _over(total, error, outer.projected_solid_angle() * inner.projected_solid_angle())


def _over(value: float, error: float, size: float) -> tuple[float, float]:
    return float(value) / size, float(error) / size


def _inner(term: Term, fixed: Array, cone: Cone, rtol: float, *, reverse: bool) -> tuple[Array, Array]:
    """Integral of f_r over a cone's projected solid angle, for fixed directions (n, 3) on the other side."""
    reverse &= not term.model.reciprocal  # the other way round holds declared kinks and nothing else
    return integrate(term, fixed, _region(cone, len(fixed)), None, rtol=rtol, atol=0.0, effort=Effort(), reverse=reverse)


def _double(term: Term, outer: Cone, inner: Cone, rtol: float, *, reverse: bool) -> tuple[float, float]:
    """Integral over both projected solid angles: the adaptive rule over `outer` of adaptive integrals over `inner`."""
    worst = 0.0  # relative error of any inner integral
    symmetric = term.model.isotropic and inner.theta == 0.0

    def inside(directions: Array, _fixed: Array, _p: Array) -> Array:
        nonlocal worst
        where = None
        if symmetric:  # a function of the polar angle alone: once per ring
            z, where = np.unique(np.round(directions[:, 2], 14), return_inverse=True)
            z = np.maximum(z, 1e-14)
            directions = np.stack((np.sqrt((1.0 - z) * (1.0 + z)), np.zeros_like(z), z), axis=-1)
        value, error = _inner(term, directions, inner, 0.1 * rtol, reverse=reverse)
        worst = max(worst, float(np.max(np.divide(error, value, out=np.zeros_like(value), where=value > 0), initial=0.0)))
        return value if where is None else value[where]

    rim = np.array([[*(inner.axis() * _FLIP), math.cos(inner.half_angle)]])
    width = term.lobe_width()
    pseudo = Term(
        Model(
            term.model.name, (), None, "", "", array_function=inside,
            lobe_width=None if width is None else lambda p: max(width, 0.5 * inner.half_angle),
            # as seen over the outer cone, a lobe ends at the mirrored rim of the inner one
            kinks=None if width is None or inner == HEMISPHERE else lambda p, fixed: rim,
        ),
        np.empty(0),
    )  # fmt: skip
    value, error = integrate(
        pseudo, inner.axis()[None, :], _region(outer, 1), None, rtol=0.3 * rtol, atol=0.0, effort=Effort()
    )
    return float(value[0]), float(error[0] + worst * value[0])


def _mirror(term: Term, incident: Direction | Cone, reflected: Direction | Cone) -> tuple[float, float]:
    """A mirror: the projected solid angle that one cone shares with the mirror image of the other."""
    rho = term.weight * float(term.values[0])
    if isinstance(incident, Direction) and isinstance(reflected, Direction):
        raise ParameterError(
            f"{term.model.name} is a delta function and has no value from direction to direction; use a cone"
        )
    if isinstance(incident, Cone) and isinstance(reflected, Cone):
        image = incident.axis() * _FLIP
        rim = np.array([[*image, math.cos(incident.half_angle)]])

        def shared(directions: Array, _fixed: Array, _p: Array) -> Array:
            return np.where(directions @ image >= rim[0, 3], 1.0, 0.0)

        both = Term(Model("overlap", (), None, "", "", array_function=shared, kinks=lambda p, fixed: rim), np.empty(0))
        v, e = integrate(both, _UP, _region(reflected, 1), None, rtol=1e-12, atol=1e-300, effort=Effort())
        size = incident.projected_solid_angle() * reflected.projected_solid_angle()
        return _over(rho * v[0], rho * e[0], size)
    cone, beam = (incident, reflected) if isinstance(incident, Cone) else (reflected, incident)
    assert isinstance(cone, Cone)
    hit = float((beam.axis() * _FLIP) @ cone.axis()) >= math.cos(cone.half_angle)
    value = rho / cone.projected_solid_angle() if hit else 0.0
    return value, 8.0 * EPS * value


def _region(cone: Cone, count: int) -> Region:
    return Region(np.tile(cone.axis(), (count, 1)), cone.half_angle, cone.half_angle > 0.5)


def _ones(omega_i: Array, _omega_r: Array, _p: Array) -> Array:
    return np.ones(len(omega_i))


_UP = np.array([[0.0, 0.0, 1.0]])
_ONE = Term(Model("one", (), None, "", "", array_function=_ones), np.empty(0))
