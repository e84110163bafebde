r"""The parameters of a fit: which are free, which are held, and the unbounded coordinates in which a sampler walks.

A parameter of the model, a shared error and a noise term are treated alike. A bounded parameter x is walked as

.. math:: u = \Phi^{-1}\frac{g(x)-g(a)}{g(b)-g(a)}, \qquad g(x) = x \text{ or } \ln x,

with the normal distribution function Phi: a uniform prior becomes N(0, 1), and a posterior at an edge gets a Gaussian tail
(that of a logit is exponential and took up to twice the steps). g is the logarithm where the prior is one of a scale. An
unbounded parameter is walked as ``u = (x - mean) / sd`` of its normal prior. A half-normal one, as of a noise that enters
squared, is folded: ``x = a + sd |u|``, so a noise of about zero is the middle of a hill and not the end of a long tail.
The density of u holds the Jacobian dx/du, so the posterior of x does not depend on the choice.

This module knows names, ranges and priors, but no data.
"""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from fitting.priors import HALF_NORMAL, LOG_NORMAL, LOG_UNIFORM, NORMAL, UNIFORM, Prior, prior
from gonio import jit
from gonio.brdf import Model, term_names
from gonio.errors import ParameterError

Array = NDArray[np.float64]
_AFFINE, _PROBIT, _PROBIT_OF_LN, _FOLDED = range(4)
_SQRT_HALF = math.sqrt(0.5)


@dataclass(frozen=True)
class Declared:
    """One parameter that a fit may free.

    Attributes
    ----------
    name : str
        Qualified: ``"ggx.alpha"``, ``"shared.scale"``, ``"noise.relative"``.
    lower, upper : float
        Range; infinite for a shared error.
    prior : tuple
        See `fitting.priors`.
    unit : str
    held : float, optional
        Value at which it stays unless it is freed.
    """

    name: str
    lower: float
    upper: float
    prior: tuple[object, ...]
    unit: str = "1"
    held: float | None = None


def declare(models: Sequence[Model]) -> list[Declared]:
    """The parameters of a sum of models, in the order of their parameter arrays."""
    declared = []
    for term, model in zip(term_names(models), models, strict=True):
        if model.delta:
            raise ParameterError(f"{model.name} is a delta function and has no value at a pair of directions; leave it out")
        if model.function is None:
            raise ParameterError(f"{model.name} is not compiled, as a fit needs it; write it with @gonio.jit.model")
        declared += [Declared(f"{term}.{p.name}", p.lower, p.upper, p.prior, p.unit, p.fixed) for p in model.parameters]
    return declared


def declare_channels(
    models: Sequence[Model], channels: Sequence[str], tie: Iterable[str] = ()
) -> tuple[list[Declared], NDArray[np.int64]]:
    """The parameters of a sum of models that is fitted to several channels at once.

    Those in which f_r is linear, such as an albedo, are one for each channel, ``"lambertian.albedo[red]"``; the others, such
    as a roughness, are the same in all.

    Parameters
    ----------
    models : sequence of Model
    channels : sequence of str
    tie : iterable of str
        Linear parameters that are the same in all channels nevertheless.

    Returns
    -------
    declared : list of Declared
    columns : ndarray, shape (channels, parameters of the sum)
        For each channel, the place of each parameter among the declared ones.
    """
    plain = declare(models)
    linear = {
        f"{term}.{short}" for term, m in zip(term_names(models), models, strict=True) for short in (*m.factors, *m.affine)
    }
    tied = set(tie)
    for name in tied:
        if name not in linear:
            raise ParameterError(f"tie: {name!r} is no linear parameter{suggestion(name, linear)}; others are tied anyway")
    declared: list[Declared] = []
    columns = np.empty((len(channels), len(plain)), dtype=np.int64)
    for i, p in enumerate(plain):
        names = [f"{p.name}[{c}]" for c in channels] if p.name in linear - tied else [p.name]
        columns[:, i] = len(declared) + np.arange(len(names))
        declared += [replace(p, name=name) for name in names]
    return declared, columns


def of_each_channel(names: Iterable[str], declared: Iterable[Declared]) -> dict[str, tuple[str, ...]]:
    """What a user's names mean: that of a parameter of each channel stands for all channels', others for themselves."""
    known = [p.name for p in declared]
    found = {}
    for name in names:
        several = tuple(k for k in known if k.startswith(f"{name}["))
        found[name] = several if several and name not in known else (name,)
    return found


def _form(q: Prior) -> int:
    if q.kind == "half_normal":
        return _FOLDED
    return _AFFINE if not q.bounded else _PROBIT_OF_LN if q.logarithmic else _PROBIT


def _forward(u, form, lower, upper, code, a, b, x, log_prior):  # type: ignore[no-untyped-def]
    """x and the log density of u, Jacobian included; u (w, d) -> x (w, d), log_prior (w,)."""
    for w in range(u.shape[0]):
        total = 0.0
        for i in range(u.shape[1]):
            if form[i] == _AFFINE:
                value = a[i] + b[i] * u[w, i]
                log_x = 0.0
            elif form[i] == _FOLDED:
                value = lower[i] + b[i] * abs(u[w, i])
                log_x = 0.0
                if value > upper[i]:
                    total = -math.inf
            else:
                s = 0.5 * math.erfc(-u[w, i] * _SQRT_HALF)  # Phi(u)
                total -= 0.5 * u[w, i] * u[w, i]  # ln dPhi/du
                if form[i] == _PROBIT:
                    value = lower[i] + (upper[i] - lower[i]) * s
                    log_x = math.log(value) if code[i] == LOG_NORMAL or code[i] == LOG_UNIFORM else 0.0
                else:
                    l0 = math.log(lower[i])
                    log_x = l0 + (math.log(upper[i]) - l0) * s
                    value = math.exp(log_x)
                    total += log_x  # dx/d ln x = x
                value = min(max(value, lower[i]), upper[i])
            x[w, i] = value
            if code[i] == NORMAL or code[i] == HALF_NORMAL:
                z = (value - a[i]) / b[i]
                total -= 0.5 * z * z
            elif code[i] == LOG_NORMAL:
                z = (log_x - a[i]) / b[i]
                total -= log_x + 0.5 * z * z
            elif code[i] == LOG_UNIFORM:
                total -= log_x
        log_prior[w] = total


_forward_kernel = jit.kernel(_forward)


class Space:
    """Free and held parameters of one fit.

    Parameters
    ----------
    declared : iterable of Declared
        All of them.
    free : iterable of str
        Names to free although their declaration holds them.
    fix : mapping of str to float
        Names to hold, with their values.
    priors : mapping of str to tuple
        Priors that replace the declared ones.

    Attributes
    ----------
    names : tuple of str
        The free parameters, d of them.
    priors : tuple of Prior
    fixed : dict of str to float
        The held ones.
    columns : ndarray of int, shape (d,)
        Places of the free parameters among the declared ones.
    template : ndarray, shape (number declared,)
        Held values; NaN where free.

    Raises
    ------
    ParameterError
        If a name is unknown (the nearest one is suggested), named twice, or a value is out of its range.
    """

    def __init__(
        self,
        declared: Iterable[Declared],
        *,
        free: Iterable[str] = (),
        fix: Mapping[str, float] | None = None,
        priors: Mapping[str, Sequence[object]] | None = None,
    ) -> None:
        self.declared = tuple(declared)
        self._given = (tuple(free), dict(fix or {}), dict(priors or {}))
        free, fix, priors = self._given
        known = [p.name for p in self.declared]
        for option, names in (("free", free), ("fix", fix), ("priors", priors)):
            for name in names:
                if name not in known:
                    near = suggestion(name, known)
                    raise ParameterError(f"{option}: no parameter {name!r}{near}; this fit has: {', '.join(known)}")
        for name in free:
            if name in fix:
                raise ParameterError(f"{name} is to be free and fixed at {fix[name]:g} at once; name it in one place")
        self.fixed: dict[str, float] = {}
        for p in self.declared:
            if p.name in fix:
                value = float(fix[p.name])
                if value != p.held and not (math.isfinite(value) and p.lower <= value <= p.upper):
                    raise ParameterError(f"fix: {p.name} = {value:g} is outside [{p.lower:g}, {p.upper:g}] {p.unit}")
                self.fixed[p.name] = value
            elif p.held is not None and p.name not in free and p.name not in priors:
                self.fixed[p.name] = p.held
        for name in priors:
            if name in self.fixed:
                raise ParameterError(f"{name} is fixed at {self.fixed[name]:g} and has a prior as well; choose one of them")
        kept = [(i, p) for i, p in enumerate(self.declared) if p.name not in self.fixed]
        self.names = tuple(p.name for _, p in kept)
        self.priors = tuple(prior(priors.get(p.name, p.prior), p.lower, p.upper, p.name) for _, p in kept)
        self.units = {p.name: p.unit for _, p in kept}
        self.columns = np.array([i for i, _ in kept], dtype=np.int64)
        self.template = np.array([self.fixed.get(p.name, math.nan) for p in self.declared])
        self._form = np.array([_form(q) for q in self.priors], dtype=np.int64)
        self._code = np.array([q.code for q in self.priors], dtype=np.int64)
        self._lower, self._upper, self._a, self._b = (
            np.array([getattr(q, key) for q in self.priors], dtype=float) for key in ("lower", "upper", "a", "b")
        )

    def __len__(self) -> int:
        return len(self.names)

    def natural(self, u: Array) -> tuple[Array, Array]:
        """Natural values and the log prior density of u, Jacobian included.

        Parameters
        ----------
        u : ndarray, shape (w, d)

        Returns
        -------
        x : ndarray, shape (w, d)
        log_prior : ndarray, shape (w,)
            Up to a constant.
        """
        u = np.ascontiguousarray(u, dtype=float)
        x, log_prior = np.empty_like(u), np.empty(len(u))
        _forward_kernel(u, self._form, self._lower, self._upper, self._code, self._a, self._b, x, log_prior)
        return x, log_prior

    def unbounded(self, x: Array) -> Array:
        """Coordinates u of natural values, shape (w, d); values on an edge end 1e-9 of the range inside."""
        from scipy.special import ndtri

        x = np.asarray(x, dtype=float)
        u = np.empty_like(x)
        for i, q in enumerate(self.priors):
            if self._form[i] == _AFFINE:
                u[:, i] = (x[:, i] - q.a) / q.b
                continue
            if self._form[i] == _FOLDED:
                u[:, i] = (x[:, i] - q.lower) / q.b
                continue
            if self._form[i] == _PROBIT:
                s = (x[:, i] - q.lower) / (q.upper - q.lower)
            else:
                s = np.log(np.maximum(x[:, i], q.lower) / q.lower) / math.log(q.upper / q.lower)
            u[:, i] = ndtri(np.clip(s, 1e-9, 1.0 - 1e-9))
        return u

    def without(self, names: Iterable[str]) -> Space:
        """The space of the other parameters; the named ones are held somewhere in their range."""
        gone = set(names)
        free, fix, priors = self._given
        place = {p.name: p.lower if math.isfinite(p.lower) else 0.0 for p in self.declared if p.name in gone}
        return Space(
            self.declared,
            free=[name for name in free if name not in gone],
            fix=fix | place,
            priors={name: q for name, q in priors.items() if name not in gone},
        )

    def log_density(self, x: Array) -> Array:
        """Log prior density of natural values, shape (w, d) -> (w,), up to a constant."""
        return np.asarray(sum((q.log_density(x[:, i]) for i, q in enumerate(self.priors)), np.zeros(len(x))))

    def full(self, x: Array) -> Array:
        """All declared parameters, shape (w, number declared), from the free ones, shape (w, d)."""
        out = np.empty((len(x), len(self.template)))
        out[:] = self.template
        out[:, self.columns] = x
        return out

    def draw(self, rng: np.random.Generator, n: int) -> Array:
        """Draws from the prior in natural units, shape (n, d)."""
        return np.column_stack([q.draw(rng, n) for q in self.priors])


def suggestion(name: str, known: Iterable[str]) -> str:
    """`` (did you mean 'x'?)``, or nothing."""
    near = difflib.get_close_matches(name, list(known), 1)
    return f" (did you mean {near[0]!r}?)" if near else ""


__all__ = ["UNIFORM", "Declared", "Prior", "Space", "declare", "suggestion"]
