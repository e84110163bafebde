r"""Microfacet models: rough mirrors made of small facets.

.. math:: f_r = k_s \frac{F(\omega_r\cdot h)\,D(h)\,G}{4\cos\theta_i\cos\theta_r}

put together from a distribution D (`gonio.brdf.facets`), a reflectance F (`gonio.brdf.fresnel`) and a shadowing G:

- smith: :math:`1/G = 1 + \Lambda_i + \Lambda_r`, height-correlated [1]_;
- smith_separable: :math:`1/G = (1+\Lambda_i)(1+\Lambda_r)`;
- v_groove: :math:`G = \min(1, 2\mu_h\mu_i/c, 2\mu_h\mu_r/c)` with :math:`c = \omega_r\cdot h` [2]_; it has kinks.

All are written without the half vector's normalisation: with :math:`l^2 = |\omega_i+\omega_r|^2 = 2+2\cos g`,
:math:`\cos^2\theta_h = (\mu_i+\mu_r)^2/l^2` and :math:`\sin^2\theta_h` from the tangential components, so nothing cancels
near h = n. With :math:`M = \mu\Lambda`, :math:`G/(4\mu_i\mu_r) = 1/(4(\mu_i\mu_r+\mu_r M_i+\mu_i M_r))` is finite at
the horizon. Facets reflect light once; ``multiple_scattering`` adds what the others give back
(`gonio.brdf.multiple_scattering`).

References
----------
.. [1] E. Heitz, "Understanding the Masking-Shadowing Function in Microfacet-Based BRDFs", JCGT 3(2), 2014, eq. 99.
.. [2] K. E. Torrance, E. M. Sparrow, "Theory for Off-Specular Reflection From Roughened Surfaces", JOSA 57(9), 1967. R. L.
   Cook, K. E. Torrance, "A Reflectance Model for Computer Graphics", ACM TOG 1(1), 1982 (which prints 1/pi where 1/4
   belongs with a normalised D).
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from gonio import jit
from gonio.brdf import multiple_scattering as again
from gonio.brdf.base import Model
from gonio.brdf.facets import FACETS
from gonio.brdf.fresnel import FRESNEL
from gonio.brdf.parameter import Parameter
from gonio.errors import ParameterError

Array = NDArray[np.float64]
CHOICES = {
    "distribution": tuple(FACETS),
    "fresnel": tuple(FRESNEL),
    "shadowing": ("smith", "smith_separable", "v_groove"),
    "multiple_scattering": ("false", "true"),
}
LOWEST = 1e-30  # cosine below which a lit direction is taken as on the horizon, its limit: squares must not underflow


@jit.model
def smith(mu_i, mu_r, m_i, m_r, z, l2):  # type: ignore[no-untyped-def]
    """Numerator and denominator of G / (4 mu_i mu_r), height-correlated."""
    return 0.25, mu_i * mu_r + (mu_r * m_i + mu_i * m_r)


@jit.model
def smith_separable(mu_i, mu_r, m_i, m_r, z, l2):  # type: ignore[no-untyped-def]
    return 0.25, (mu_i + m_i) * (mu_r + m_r)


@jit.model
def v_groove(mu_i, mu_r, m_i, m_r, z, l2):  # type: ignore[no-untyped-def]
    # 2 mu_h mu / c = 4 (mu_i + mu_r) mu / l^2
    most = mu_i * mu_r
    low = mu_i if mu_i < mu_r else mu_r
    g = 4.0 * z * low
    return (g if g < l2 else l2), 4.0 * most * l2


_SHADOWING = {"smith": smith, "smith_separable": smith_separable, "v_groove": v_groove}


@functools.cache
def _function(distribution: str, fresnel: str, shadowing: str, repeated: bool) -> Callable[..., float]:
    """The scalar function of a set of choices; p holds k_s, alpha, (gamma), Fresnel's numbers, the derived ones."""
    facets = FACETS[distribution]
    first = 2 + len(facets.parameters)
    at = first + len(FRESNEL[fresnel].parameters)
    density, hidden, geometry = facets.density(at), facets.hidden(at), _SHADOWING[shadowing]
    reflected = FRESNEL[fresnel].factor(first)

    def once(xi, yi, zi, xr, yr, zr, p):  # type: ignore[no-untyped-def]
        lit = (zi > 0.0) & (zr > 0.0)  # no branch: the loop vectorises
        mu_i = zi if zi > LOWEST else LOWEST
        mu_r = zr if zr > LOWEST else LOWEST
        x, y, z = xi + xr, yi + yr, mu_i + mu_r
        dx, dy, dz = xi - xr, yi - yr, mu_i - mu_r
        s2 = x * x + y * y  # l^2 sin^2 theta_h
        l2 = s2 + z * z
        d_n, d_d = density(s2, z, l2, p)
        f_n, f_d = reflected(l2, dx * dx + dy * dy + dz * dz, p)
        m_i, m_r = hidden(mu_i, xi * xi + yi * yi, p), hidden(mu_r, xr * xr + yr * yr, p)
        g_n, g_d = geometry(mu_i, mu_r, m_i, m_r, z, l2)
        value = (p[0] * d_n * f_n * g_n) / (d_d * f_d * g_d)
        return value if lit else 0.0

    single = jit.model(once)
    if not repeated:
        return single  # type: ignore[no-any-return]
    lost, numbers = again.lost(facets, at + facets.count), at + facets.count

    def more(xi, yi, zi, xr, yr, zr, p):  # type: ignore[no-untyped-def]
        lit = (zi > 0.0) & (zr > 0.0)
        mu_i = zi if zi > LOWEST else LOWEST
        mu_r = zr if zr > LOWEST else LOWEST
        value = single(xi, yi, zi, xr, yr, zr, p) + p[0] * p[numbers] * lost(mu_i, xi * xi + yi * yi, p) * lost(
            mu_r, xr * xr + yr * yr, p
        )
        return value if lit else 0.0

    return jit.model(more)  # type: ignore[no-any-return]


def _kinks(p: Array, omega_r: Array) -> Array:
    """Of v-grooves, where the less elevated direction changes and where its grooves begin to hide nothing.

    The border for omega_i as the lower direction is no plane: the model is `bent`.
    """
    mu = omega_r[..., 2]
    planes = np.zeros((*mu.shape, 2, 4))
    planes[..., 0, :3] = omega_r * (-1.0, -1.0, 1.0)
    planes[..., 0, 3] = 1.0 - 2.0 * mu * mu
    planes[..., 1, 2], planes[..., 1, 3] = 1.0, mu
    return planes


def _layer(p: Array) -> float:
    """What is lost at the first time goes with mu_i ln mu_i at the horizon; below this height its integral is nothing."""
    return 0.01 * float(p[1])


@functools.cache
def build(distribution: str, fresnel: str, shadowing: str, multiple_scattering: str, name: str = "microfacet") -> Model:
    """The model of a set of choices."""
    repeated = multiple_scattering == "true"
    if repeated and shadowing == "v_groove":
        raise ParameterError(
            "microfacet: multiple_scattering=True is defined with Smith's shadowing only, as it takes what v-grooves hide "
            'for lost by their own facets; use shadowing="smith" or leave multiple_scattering out'
        )
    facets, reflectance = FACETS[distribution], FRESNEL[fresnel]
    shape = 1 + len(facets.parameters)  # alpha and gamma
    numbers = 1 + shape + len(reflectance.parameters)

    def derived(p: Array) -> Array:
        own = facets.derived(p[1 : 1 + shape])
        if not repeated:
            return own
        average = reflectance.average(p[1 + shape : numbers])
        made = np.concatenate((p[:numbers], own))
        return np.concatenate((own, again.derived(facets, shadowing, average, made, numbers)))

    @functools.lru_cache(maxsize=256)
    def own_slopes(values: tuple[float, ...]) -> Array:
        assert facets.slopes is not None
        return facets.slopes(np.array(values))

    def slopes(p: Array) -> Array:
        found = np.zeros((len(p), facets.count))
        found[1 : 1 + shape] = own_slopes(tuple(map(float, p[1 : 1 + shape])))
        return found

    chosen = {
        "distribution": distribution,
        "fresnel": fresnel,
        "shadowing": shadowing,
        "multiple_scattering": multiple_scattering,
    }
    hiding = {"smith": "height-correlated Smith", "smith_separable": "separable Smith", "v_groove": "V-groove"}[shadowing]
    return Model(
        name=name,
        parameters=(
            Parameter("k_s", 0.0, 1.0, "specular weight", ("uniform", 0.0, 1.0), fixed=1.0),
            Parameter("alpha", 1e-4, 1.0, "roughness, used as it is (not squared)", ("log_normal", math.log(0.2), 0.9)),
            *facets.parameters,
            *reflectance.parameters,
        ),
        function=_function(distribution, fresnel, shadowing, repeated),
        factors=("k_s",),
        affine=("f_0",) if fresnel == "schlick" and not repeated else (),
        doc=f"{facets.doc} facets, {hiding} shadowing, {reflectance.doc}"
        + (", and light scattered several times." if repeated else "."),
        reference="; ".join(
            text for text in (
                facets.reference, reflectance.reference, "Torrance & Sparrow, JOSA 57(9), 1967" * (shadowing == "v_groove"),
                "Kulla & Conty, SIGGRAPH course, 2017" * repeated,
            ) if text
        ),
        lobe_width=lambda p: facets.width(p[1 : 1 + shape]),
        layer_width=_layer if repeated else None,
        kinks=_kinks if shadowing == "v_groove" else None,
        bent=shadowing == "v_groove",
        derived=derived if facets.count or repeated else None,
        derived_slopes=None if repeated or facets.slopes is None else slopes,
        choices={} if name != "microfacet" else {k: v for k, v in chosen.items() if v != CHOICES[k][0]},
    )  # fmt: skip


GGX = build("ggx", "schlick", "smith", "false", name="ggx")
BECKMANN = build("beckmann", "schlick", "smith", "false", name="beckmann")
