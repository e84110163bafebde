"""What a BRDF is: a weighted sum of terms, each a model with its parameters.

A model is one scalar function of two unit vectors in the local frame (normal along +z) and a parameter array; batch
evaluation, likelihood and integrator are compiled from it. It returns 0 below the horizon, never NaN. A BRDF is never
multiplied by a cosine here.

References
----------
.. [1] F. E. Nicodemus et al., "Geometrical Considerations and Nomenclature for Reflectance", NBS Monograph 160, 1977.
   doi:10.6028/NBS.MONO.160
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.brdf.kernels import accumulate, sum_kernel
from gonio.brdf.parameter import Parameter
from gonio.errors import GeometryError, ParameterError
from gonio.geometry import unit_vector

Array = NDArray[np.float64]
_SLANTED = np.array([0.6, 0.0, 0.8])


@dataclass(frozen=True)
class Model:
    """Declaration of a BRDF model.

    Attributes
    ----------
    name, doc, reference : str
    parameters : tuple of Parameter
        In the order of the parameter array, whose first numbers they are.
    function : callable
        ``f(xi, yi, zi, xr, yr, zr, p) -> f_r`` [1/sr], compiled by `gonio.jit.model`; None for a delta function and for
        a function that is not compiled.
    lobe_width : callable, optional
        Of the parameter array: half width [rad] of the narrowest structure around the mirror direction, in half-vector
        angle; the integrator lays its nodes by it. None: no lobe.
    layer_width : callable, optional
        Of the parameter array: height [rad] above the horizon within which f_r, as a function of omega_i, changes, where the
        lobe's width and a grazing view do not tell. A broken power of mu_i has structure at every height: give the height
        up to which its integral is nothing. Goes with `lobe_width`.
    kinks : callable, optional
        ``(p, omega_r (..., 3)) -> (..., k, 4)``: planes ``c . w = d`` (rows c_x, c_y, c_z, d; c a unit vector) across which
        f_r or a derivative jumps, as a function of w = omega_i for the given omega_r; the integrator breaks its panels
        there. A plane that one omega_r does not have is out of reach: d = 2. A user's own function takes one omega_r.
    kink_power : callable, optional
        Of the parameter array: f_r begins at its kinks as this broken power of the distance; infinite for one so high that
        it is smooth. None: on either side of its kinks f_r is smooth.
    faint_kinks : callable, optional
        Of the parameter array: whether f_r next to its kinks is nothing against its largest values, so that only those who
        ask for the far tail of a lobe need to break there. None: never.
    bent : bool
        A derivative jumps elsewhere too, not at planes: only cells that are halved until they agree will do.
    features : callable, optional
        ``(p, omega_r (3,)) -> (k, 4)``: narrow structures elsewhere than at the mirror direction, as a function of omega_i
        for the given omega_r: rows of a unit vector and a half width [rad], such as an opposition peak's.
    shadowed : bool
        Whether a model with a lobe may change within the lobe's width along the horizon, too. False: it is analytic there.
    derived : callable, optional
        Of the parameters (n,): numbers (m,) that depend on them only and that the function finds behind them in the
        parameter array, such as a table of albedos.
    derived_slopes : callable, optional
        Of the parameters (n,): derivatives of these numbers by each parameter (n, m). Without it they come from differences.
    factors : tuple of str
        Parameters to each of which f_r is proportional, the others held; a fit solves for those.
    affine : tuple of str
        Parameters of each of which f_r is ``a + b x``, the others held.
    array_function : callable, optional
        ``(omega_i (n, 3), omega_r (n, 3), p) -> (n,)`` for code that is not compiled; `function` is then None.
    diffuse : bool
        f_r is the same for all pairs of directions (Lambert).
    isotropic, reciprocal, energy_bounded : bool
    pieces : bool
        f_r is made of pieces, a table's cells, at whose borders a higher derivative jumps.
    choices : mapping of str to str
        What tells this model from others of its name and is not the default: ``{"variant": "full"}``.
    own : bool
        A user's function: errors of its integrals are estimates.
    """

    name: str
    parameters: tuple[Parameter, ...]
    function: Callable[..., float] | None
    doc: str
    reference: str
    lobe_width: Callable[[Array], float] | None = None
    layer_width: Callable[[Array], float] | None = None
    kinks: Callable[[Array, Array], Array] | None = None
    kink_power: Callable[[Array], float] | None = None
    faint_kinks: Callable[[Array], bool] | None = None
    bent: bool = False
    features: Callable[[Array, Array], Array] | None = None
    derived: Callable[[Array], Array] | None = None
    derived_slopes: Callable[[Array], Array] | None = None
    factors: tuple[str, ...] = ()
    affine: tuple[str, ...] = ()
    array_function: Callable[[Array, Array, Array], Array] | None = None
    shadowed: bool = True
    diffuse: bool = False
    isotropic: bool = True
    reciprocal: bool = True
    energy_bounded: bool = True
    pieces: bool = False
    choices: Mapping[str, str] = field(default_factory=dict)
    own: bool = False

    def __post_init__(self) -> None:
        if self.function is not None and not hasattr(self.function, "py_func"):
            raise ParameterError(f"{self.name}: its function is not compiled; decorate it with @gonio.jit.model")
        if self.function is not None and self.function.py_func.__code__.co_argcount != 7:
            raise ParameterError(f"{self.name}: its function takes seven arguments, (xi, yi, zi, xr, yr, zr, p)")
        names = [parameter.name for parameter in self.parameters]
        if len(set(names)) != len(names):
            raise ParameterError(f"{self.name} has two parameters of one name among {', '.join(names)}; rename one")
        for name in (*self.factors, *self.affine):
            if name not in names:
                raise ParameterError(f"{self.name} says that f_r is linear in {name!r}, which is none of its parameters")

    @property
    def expression(self) -> str:
        """Name and choices, as `gonio.brdf.parse` reads them: ``"oren_nayar[variant=full]"``."""
        chosen = ",".join(f"{key}={value}" for key, value in self.choices.items())
        return f"{self.name}[{chosen}]" if chosen else self.name

    @property
    def delta(self) -> bool:
        """Whether the model is a delta function, without a value at a pair of directions."""
        return self.function is None and self.array_function is None

    def values(self, given: Mapping[str, float]) -> Array:
        """Parameter array from named values: all that have no default, and no others."""
        names = [parameter.name for parameter in self.parameters]
        for name in given:
            if name not in names:
                raise ParameterError(
                    f"{self.name} has no parameter {name!r}{_suggest(name, names)}; it has: {', '.join(names)}"
                )
        given = {p.name: p.default for p in self.parameters if p.default is not None} | dict(given)
        missing = [name for name in names if name not in given]
        if missing:
            raise ParameterError(f"{self.name} needs {', '.join(missing)} as well; its parameters are: {', '.join(names)}")
        return self.complete(np.array([parameter.check(given[parameter.name], self.name) for parameter in self.parameters]))

    def complete(self, parameters: Array) -> Array:
        """The parameter array: the parameters (n,) and what is derived from them."""
        return parameters if self.derived is None else np.concatenate((parameters, self.derived(parameters)))


@dataclass(frozen=True)
class Term:
    """One model with its parameter array and a weight."""

    model: Model
    values: Array
    weight: float = 1.0

    def lobe_width(self) -> float | None:
        """Half width of the term's lobe [rad], None without one."""
        return None if self.model.lobe_width is None else float(self.model.lobe_width(self.values))

    def layer_width(self) -> float:
        """Height of the structure at the horizon [rad]: at most the lobe's width, or 1."""
        width = self.lobe_width() or 1.0
        return width if self.model.layer_width is None else min(width, float(self.model.layer_width(self.values)))

    @property
    def plain(self) -> bool:
        """Compiled, isotropic, no user's, without kinks and features: what a rule for smooth integrands may take."""
        return len(self.kinks(_SLANTED)) == 0 and self.mirror_only and not self.model.own

    @property
    def mirror_only(self) -> bool:
        """Compiled, isotropic, without narrow structures elsewhere than at the mirror direction and unknown bends."""
        return self.upright and len(self.features(_SLANTED)) == 0

    @property
    def upright(self) -> bool:
        """Compiled, isotropic, without unknown bends, and narrow in directions of the plane of incidence only."""
        model = self.model
        plain = model.function is not None and model.isotropic and not model.bent
        return plain and bool(np.all(self.features(_SLANTED)[:, 1] == 0.0))

    def features(self, omega_r: Array) -> Array:
        """Narrow structures elsewhere than at the mirror: rows of a unit vector and a half width [rad], shape (k, 4)."""
        return np.empty((0, 4)) if self.model.features is None else self.model.features(self.values, omega_r)

    @property
    def kinked(self) -> bool:
        """Whether the model has kinks next to which f_r counts."""
        model = self.model
        return model.kinks is not None and not (model.faint_kinks is not None and model.faint_kinks(self.values))

    def kinks(self, omega_r: Array) -> Array:
        """`edges` next to which f_r counts, as rules for what is not faint take them."""
        return self.edges(omega_r) if self.kinked else np.empty((*omega_r.shape[:-1], 0, 4))

    def edges(self, omega_r: Array) -> Array:
        """Planes ``c . w = d`` of the term's kinks for reflected directions (..., 3), shape (..., k, 4); k = 0 without any.

        Of a user's own function: for one direction (3,).
        """
        if self.model.kinks is None:
            return np.empty((*omega_r.shape[:-1], 0, 4))
        return self.model.kinks(self.values, omega_r)


class BRDF:
    """A sum of terms.

    Examples
    --------
    >>> import gonio
    >>> paper = gonio.brdf.make("lambertian", albedo=0.5)
    >>> round(float(paper.f_r(0.3, 0.0, 0.9, 3.0)) * math.pi, 15)
    0.5
    """

    def __init__(self, terms: Iterable[Term]) -> None:
        self.terms = tuple(terms)
        if not self.terms:
            raise ParameterError("a BRDF needs at least one term")

    def __add__(self, other: BRDF) -> BRDF:
        if not isinstance(other, BRDF):
            return NotImplemented
        return BRDF(self.terms + other.terms)

    def __radd__(self, other: object) -> BRDF:
        return self if other == 0 else NotImplemented  # sum() begins with 0

    def __mul__(self, factor: float) -> BRDF:
        if not isinstance(factor, int | float | np.floating):
            return NotImplemented
        if not (math.isfinite(factor) and factor >= 0):
            raise ParameterError(f"a BRDF cannot be scaled by {factor:g}; use a finite factor >= 0")
        return BRDF(Term(t.model, t.values, t.weight * float(factor)) for t in self.terms)

    __rmul__ = __mul__

    def __repr__(self) -> str:
        shown = []
        for name, term in zip(term_names(t.model for t in self.terms), self.terms, strict=True):
            pairs = ", ".join(f"{p.name}={v:.6g}" for p, v in zip(term.model.parameters, term.values, strict=False))
            pairs = ", ".join([pairs, *(f'{key}="{value}"' for key, value in term.model.choices.items())])
            shown.append(("" if term.weight == 1.0 else f"{term.weight:g} * ") + f"{name}({pairs})")
        return " + ".join(shown)

    @property
    def name(self) -> str:
        """Names of the models, with their choices, joined by ``+``."""
        return "+".join(term.model.expression for term in self.terms)

    def parameters(self) -> dict[str, float]:
        """Qualified parameter values, such as ``{"ggx.alpha": 0.3}``."""
        return {
            f"{name}.{parameter.name}": float(value)
            for name, term in zip(term_names(t.model for t in self.terms), self.terms, strict=True)
            for parameter, value in zip(term.model.parameters, term.values, strict=False)
        }

    def f_r(self, theta_i: ArrayLike, phi_i: ArrayLike, theta_r: ArrayLike, phi_r: ArrayLike) -> Array:
        """BRDF value, as defined in [1]_.

        Parameters
        ----------
        theta_i, phi_i, theta_r, phi_r : array_like, shapes broadcast to (...)
            Incident and reflected direction from the normal [rad]; mirror direction at phi_r = phi_i + pi.

        Returns
        -------
        ndarray, shape (...)
            [1/sr]; 0 where a direction is at or below the horizon.

        Raises
        ------
        GeometryError
            If an angle is not finite or a polar angle is outside [0, pi].
        """
        for name, theta in (("theta_i", theta_i), ("theta_r", theta_r)):
            t = np.asarray(theta, dtype=float)
            if np.any(~((t >= 0) & (t <= np.pi))):
                raise GeometryError(
                    f"{name} must be within 0 and 180 degrees; got {np.degrees(t[~((t >= 0) & (t <= np.pi))].flat[0]):g}"
                )
        if not (np.all(np.isfinite(phi_i)) and np.all(np.isfinite(phi_r))):
            raise GeometryError("phi_i and phi_r must be finite")
        return self.evaluate(unit_vector(theta_i, phi_i), unit_vector(theta_r, phi_r))

    def evaluate(self, omega_i: ArrayLike, omega_r: ArrayLike) -> Array:
        """BRDF value for unit vectors in the local frame.

        Parameters
        ----------
        omega_i, omega_r : array_like, shapes broadcast to (..., 3)

        Returns
        -------
        ndarray, shape (...)
            [1/sr]; 0 where a direction is at or below the horizon, NaN where one is NaN.
        """
        wi, wr = np.broadcast_arrays(np.asarray(omega_i, dtype=float), np.asarray(omega_r, dtype=float))
        flat_i, flat_r = np.ascontiguousarray(wi.reshape(-1, 3)), np.ascontiguousarray(wr.reshape(-1, 3))
        fused = sum_kernel(self.terms)
        if fused is not None:
            out = np.empty(len(flat_i))
            fused[0](flat_i, flat_r, fused[1], out)
            return out.reshape(wi.shape[:-1])
        out = np.zeros(len(flat_i))
        for term in self.terms:
            accumulate(term.model)(flat_i, flat_r, term.values, term.weight, out)
        return out.reshape(wi.shape[:-1])

    def jacobian(self, omega_i: ArrayLike, omega_r: ArrayLike) -> Array:
        """Derivatives of the BRDF value with respect to the parameters.

        Parameters
        ----------
        omega_i, omega_r : array_like, shapes broadcast to (..., 3)
            Unit vectors in the local frame.

        Returns
        -------
        ndarray, shape (..., k)
            [1/sr per unit of the parameter], in the order of `parameters`; weights of terms are counted in. One-sided at
            the end of a parameter's range, infinite where the derivative is; see `gonio.brdf.derivatives`.

        Raises
        ------
        ParameterError
            If a term is a delta function.

        Examples
        --------
        >>> import gonio
        >>> up = np.array([0.0, 0.0, 1.0])
        >>> float(gonio.brdf.make("lambertian", albedo=0.5).jacobian(up, up)[0]) * math.pi
        1.0
        """
        from gonio.brdf.derivatives import jacobian

        for term in self.terms:
            accumulate(term.model)  # a delta function has none
        wi, wr = np.broadcast_arrays(np.asarray(omega_i, dtype=float), np.asarray(omega_r, dtype=float))
        flat_i, flat_r = np.ascontiguousarray(wi.reshape(-1, 3)), np.ascontiguousarray(wr.reshape(-1, 3))
        rows = jacobian(self.terms, flat_i, flat_r)
        return np.moveaxis(rows.reshape(len(rows), *wi.shape[:-1]), 0, -1)


def term_names(models: Iterable[Model]) -> tuple[str, ...]:
    """Names that tell terms apart: ``ggx``, then ``ggx2`` for a second term of the same model."""
    count: dict[str, int] = {}
    names = []
    for model in models:
        count[model.name] = count.get(model.name, 0) + 1
        names.append(model.name + (str(count[model.name]) if count[model.name] > 1 else ""))
    return tuple(names)


def _suggest(name: str, known: Iterable[str]) -> str:
    near = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {near[0]!r}?)" if near else ""
