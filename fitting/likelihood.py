r"""The likelihood of BRDF samples: shared errors as parameters, independent ones as variance of the model's own making.

With the expected reading of `gonio.samples`,

.. math:: \ln L = -\tfrac12\sum_j\Bigl[\frac{(f_j-\hat f_j)^2}{s_j^2}+\ln s_j^2\Bigr],\qquad
   s_j^2 = (s\,u_j)^2 + \sum_k\Bigl(\frac{\partial\hat f_j}{\partial\delta_k}\,u_{\mathrm{sample},k}\Bigr)^2
         + (\epsilon\hat f_j)^2 + [u_j\ \text{unknown}]\,\bigl((r\hat f_j)^2+a^2\bigr),

Every part of the variance that scales with the reading is taken from the model, never from the noisy reading, which
would pull the fit towards low readings; so the term ln s^2 stays. The slope is a finite difference of the compiled model
at the parameters of the moment: a slope frozen at the optimum would let a walker with a narrower lobe claim the error of
a wider one. It is linear in the angular error, so `u_sample` must be small against the width of a lobe.

`noise.relative` (r) and `noise.absolute` (a) are inferred where a sample has no uncertainty; `noise.discrepancy`
(epsilon) allows for a model that is not the material, and `noise.scale` (s, 1 unless freed) for stated uncertainties that
are wrong by a common factor. For stray readings there is Student's t instead of Gauss, with s_j as its scale [3]_:
:math:`-\tfrac12\sum_j[(\nu+1)\ln(1+(f_j-\hat f_j)^2/(\nu s_j^2))+\ln s_j^2]`.

Walkers are evaluated some at a time, so that a block stays in the cache; on several threads if asked for, with the same
numbers. This module draws nothing and chooses no parameters.

References
----------
.. [1] JCGM 100:2008 (GUM), 5.1.2 and 5.2.2: propagation by sensitivity coefficients, independent and correlated.
.. [2] M. C. Kennedy, A. O'Hagan, "Bayesian calibration of computer models", JRSS B 63(3), 2001: model discrepancy.
.. [3] K. L. Lange, R. J. A. Little, J. M. G. Taylor, "Robust statistical modeling using the t distribution", JASA 84, 1989.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.parameters import Declared, Space, declare, declare_channels, of_each_channel
from gonio import jit
from gonio.brdf import Model, term_names
from gonio.brdf.elementary import exp, log, log1p
from gonio.errors import DatasetError, ParameterError
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
STEP = 1e-6  # of a shared error, for slopes: f'' STEP / f' is 1e-5 for a lobe of 0.1 rad, rounding 1e-10
BLOCK = 512  # samples at a time: one block of 16 walkers and 4 geometries stays in the cache
WALKERS = 16  # at a time
RELATIVE, ABSOLUTE, DISCREPANCY, SCALE = "noise.relative", "noise.absolute", "noise.discrepancy", "noise.scale"


def _directions(base, slope, full, offset, varied, step, out):  # type: ignore[no-untyped-def]
    """Perturbed unit vectors: base (6, n), slope (k, 6, n) -> out (w, 1 + v, 6, n); out[:, 0] holds the deltas, out[:, 1:]
    one more step of one shared error each, renormalised to first order in the step.

    A direction that was measured was above the horizon, so z stays positive.
    """
    n = base.shape[1]
    inverse, along = np.empty(n), np.empty(n)  # loops of few arrays each: the compiler vectorises those
    for w in range(out.shape[0]):
        raw = out[w, 0]
        raw[:] = base
        for k in range(slope.shape[0]):
            delta = full[w, offset + k]
            if delta != 0.0:
                for c in range(6):
                    to, by = raw[c], slope[k, c]
                    for j in range(n):
                        to[j] += delta * by[j]
        for c in (0, 3):
            x, y, z = raw[c], raw[c + 1], raw[c + 2]
            for j in range(n):
                z[j] = max(z[j], 1e-9)
            for j in range(n):
                inverse[j] = 1.0 / math.sqrt(x[j] * x[j] + y[j] * y[j] + z[j] * z[j])
            for i in (c, c + 1, c + 2):
                to = raw[i]
                for j in range(n):
                    to[j] *= inverse[j]
            for v in range(varied.size):
                dx, dy, dz = slope[varied[v], c], slope[varied[v], c + 1], slope[varied[v], c + 2]
                for j in range(n):
                    along[j] = x[j] * dx[j] + y[j] * dy[j] + z[j] * dz[j]
                for i in (c, c + 1, c + 2):
                    to, at, by = out[w, v + 1, i], raw[i], slope[varied[v], i]
                    for j in range(n):
                        to[j] = at[j] + step * inverse[j] * (by[j] - along[j] * at[j])
                to = out[w, v + 1, c + 2]
                for j in range(n):
                    to[j] = max(to[j], 1e-12)


@jit.part
def shared_factor(errors, offset, log_slope, factor):  # type: ignore[no-untyped-def]
    """What the shared errors that begin at `offset` multiply readings by: log_slope (k, n) -> factor (n,)."""
    factor[:] = 0.0
    for k in range(log_slope.shape[0]):
        delta, by = errors[offset + k], log_slope[k]
        if delta != 0.0:
            for j in range(factor.size):
                factor[j] += delta * by[j]
    for j in range(factor.size):
        factor[j] = exp(factor[j])


def _moments(values, full, offset, noise, log_slope, has_log, noisy, variant, u_sample, step, u2, unknown, mean, var):  # type: ignore[no-untyped-def]
    """Expected readings and variances: values (w, 1 + v, n) -> mean, var (w, n)."""
    n = u2.size
    for w in range(values.shape[0]):
        f, m, s2 = values[w, 0], mean[w], var[w]
        factor = np.ones(n)
        if has_log:
            shared_factor(full[w], offset, log_slope, factor)
        relative2, absolute2, epsilon2 = full[w, noise] ** 2, full[w, noise + 1] ** 2, full[w, noise + 2] ** 2
        scale2 = full[w, noise + 3] ** 2
        for j in range(n):
            m[j] = f[j] * factor[j]
            s2[j] = scale2 * u2[j] + epsilon2 * m[j] * m[j] + unknown[j] * (relative2 * m[j] * m[j] + absolute2)
        for q in range(noisy.size):
            k = noisy[q]
            shifted = values[w, variant[q]]  # the unshifted geometry itself where the error does not turn anything
            for j in range(n):
                d = (factor[j] * (shifted[j] - f[j]) / step + m[j] * log_slope[k, j]) * u_sample[k]
                s2[j] += d * d


def _reduce(mean, var, reading, nu, log_likelihood, chi2):  # type: ignore[no-untyped-def]
    for w in range(mean.shape[0]):
        c, l = 0.0, 0.0
        for j in range(reading.size):
            r = reading[j] - mean[w, j]
            c += r * r / var[w, j]
        for j in range(reading.size):
            l += log(var[w, j])
        chi2[w] += c
        if nu > 0.0:
            c = 0.0
            for j in range(reading.size):
                r = reading[j] - mean[w, j]
                c += log1p(r * r / (nu * var[w, j]))
            c *= nu + 1.0
        log_likelihood[w] -= 0.5 * (c + l)


_directions_kernel, _moments_kernel, _reduce_kernel = jit.kernel(_directions), jit.kernel(_moments), jit.kernel(_reduce)


@functools.cache
def _term_kernel(function: Callable[..., float]) -> Any:
    """Add one model's f_r: directions (w or 1, v, 6, n), parameters (w, k), out (w, v, n)."""

    def accumulate_walkers(directions, parameters, out):  # type: ignore[no-untyped-def]
        for w in range(out.shape[0]):
            p = parameters[w]
            for v in range(out.shape[1]):
                d = directions[w if directions.shape[0] > 1 else 0, v]
                xi, yi, zi, xr, yr, zr, to = d[0], d[1], d[2], d[3], d[4], d[5], out[w, v]
                for j in range(to.size):
                    to[j] += function(xi[j], yi[j], zi[j], xr[j], yr[j], zr[j], p)

    return jit.kernel(accumulate_walkers, apart=True)


def shared_parameters(samples: BRDFSamples, use: bool) -> list[Declared]:
    """A parameter for each shared error, prior N(0, u); held at 0 if its u is 0 or `use` is False."""
    names = [error.name for error in samples.shared]
    for name in names:
        if names.count(name) > 1:
            raise DatasetError(f"samples: {names.count(name)} shared errors are called {name!r}; names must differ")
    return [
        Declared(
            f"shared.{e.name}", -math.inf, math.inf, ("normal", 0.0, e.u or 1.0), e.unit, None if use and e.u > 0 else 0.0
        )
        for e in samples.shared
    ]


def noise_parameters(samples: BRDFSamples, discrepancy: bool) -> list[Declared]:
    """``noise.relative``, ``noise.absolute`` and ``noise.discrepancy``, held at 0 where they are not needed, and
    ``noise.scale``, held at 1.

    The priors are half-normal and wide: sd 0.3 for r; the root mean square of the readings without an uncertainty for a;
    0.1 for epsilon. The lower ends, 1e-4 and 1e-6 of the scale, keep the likelihood finite for noise-free data; no
    goniometer repeats better. That of s is flat in its logarithm from 0.01 to 100.
    """
    unknown = np.isnan(samples.u_f_r)
    rms = float(np.sqrt(np.mean(samples.f_r[unknown] ** 2))) if unknown.any() else 1.0
    rms = rms if rms > 0 else 1.0
    infer = None if unknown.any() else 0.0
    return [
        Declared(RELATIVE, 1e-4, 3.0, ("half_normal", 0.3), "1", infer),
        Declared(ABSOLUTE, 1e-6 * rms, 10.0 * rms, ("half_normal", rms), "1/sr", infer),
        Declared(DISCREPANCY, 1e-4, 3.0, ("half_normal", 0.1), "1", None if discrepancy else 0.0),
        Declared(SCALE, 0.01, 100.0, ("log_uniform", 0.01, 100.0), "1", 1.0),
    ]


@dataclass(frozen=True)
class Channelled:
    """To which of several channels each sample belongs.

    Attributes
    ----------
    names : tuple of str
    index : ndarray of int, shape (n,)
        In ascending order.
    tie : tuple of str
        See `fitting.parameters.declare_channels`.
    """

    names: tuple[str, ...]
    index: NDArray[np.int64]
    tie: tuple[str, ...] = ()


class Problem:
    """Samples, model and priors: everything that a fit needs.

    Parameters
    ----------
    samples : BRDFSamples
    models : sequence of Model
        Terms of the sum.
    free, fix, priors
        See `fitting.parameters.Space`.
    shared : bool
        Infer the shared errors; False holds them at 0.
    discrepancy : bool
        Infer ``noise.discrepancy``.
    student : float, optional
        Degrees of freedom of Student's t in place of Gauss.
    threads : int
        For log densities of several walkers.
    channels : Channelled, optional
        Which channel each sample belongs to, for models with some parameters of each; the samples are in order of it.

    Attributes
    ----------
    fixed_variances : bool
        The variances depend on no parameter but ``noise.scale``.

    Raises
    ------
    DatasetError
        If there are no samples, or an uncertainty is zero.
    ParameterError
        If nothing of the model is free.
    """

    def __init__(
        self,
        samples: BRDFSamples,
        models: Sequence[Model],
        *,
        free: Sequence[str] = (),
        fix: dict[str, float] | None = None,
        priors: dict[str, Sequence[object]] | None = None,
        shared: bool = True,
        discrepancy: bool = False,
        student: float | None = None,
        threads: int = 1,
        channels: Channelled | None = None,
    ) -> None:
        if len(samples) == 0:
            raise DatasetError("there are no samples to fit: scan or import some first")
        if np.any(samples.u_f_r == 0):
            worst = int(np.flatnonzero(samples.u_f_r == 0)[0])
            raise DatasetError(f"sample {worst} has u_f_r = 0 1/sr; give its standard uncertainty, or nan if it is unknown")
        if np.any((samples.f_r != 0) & (np.abs(samples.f_r) > 1e100)):
            worst = int(np.argmax(np.abs(samples.f_r)))
            raise DatasetError(f"sample {worst} has f_r = {samples.f_r[worst]:g} 1/sr; that is no reading, remove it")
        if student is not None and not (math.isfinite(student) and student >= 1.0):
            raise ParameterError(f"student = {student:g} degrees of freedom; choose 1 or more, such as 4")
        if threads < 1:
            raise ParameterError(f"threads = {threads}; choose 1 or more")
        self.samples, self.models, self.student, self.threads = samples, tuple(models), student, threads
        self.channels = channels or Channelled(("",), np.zeros(len(samples), dtype=np.int64))
        if channels is None:
            own = declare(self.models)
            self._columns = np.arange(len(own))[None, :]
        else:
            own, self._columns = declare_channels(self.models, channels.names, channels.tie)
        errors = shared_parameters(samples, shared)
        declared = [*own, *errors, *noise_parameters(samples, discrepancy)]
        fix, priors = dict(fix or {}), dict(priors or {})
        meant = of_each_channel((*free, *fix, *priors), declared)
        self.space = Space(
            declared,
            free=[one for name in free for one in meant[name]],
            fix={one: value for name, value in fix.items() for one in meant[name]},
            priors={one: q for name, q in priors.items() for one in meant[name]},
        )
        self.model_names = tuple(name for name in self.space.names if name in {p.name for p in own})
        if not self.model_names:
            raise ParameterError("every parameter of the model is fixed; free at least one")
        starts = np.cumsum([0, *(len(m.parameters) for m in self.models)])
        self.terms = tuple(zip(term_names(self.models), self.models, map(int, starts[:-1]), strict=True))
        self._offset, self._noise = len(own), len(own) + len(errors)
        self._pool = ThreadPoolExecutor(threads) if threads > 1 else None
        self._geometry(errors)
        held = self.space.fixed.get(DISCREPANCY) == 0.0
        self.fixed_variances = held and self._noisy.size == 0 and not np.isnan(samples.u_f_r).any() and student is None

    def _geometry(self, errors: Sequence[Declared]) -> None:
        """Arrays of the kernels, component by component and cut into blocks."""
        s, k = self.samples, len(errors)
        base = np.ascontiguousarray(np.concatenate((s.omega_i(), s.omega_r()), axis=1).T)  # (6, n)
        slope = np.concatenate((s.d_omega_i, s.d_omega_r), axis=1).transpose(2, 1, 0)  # (k, 6, n)
        turns = np.array([bool(np.any(slope[i])) for i in range(k)], dtype=bool)
        self._u_sample = np.array([e.u_sample for e in s.shared], dtype=float)
        self._noisy = np.flatnonzero(self._u_sample > 0)
        self._varied = np.array([i for i in self._noisy if turns[i]], dtype=np.int64)
        place = {int(i): v + 1 for v, i in enumerate(self._varied)}
        self._variant = np.array([place.get(int(i), 0) for i in self._noisy], dtype=np.int64)
        names = set(self.space.names)
        self._moves = any(turns[i] and e.name in names for i, e in enumerate(errors))
        self._has_log = bool(np.any(s.d_ln_f))
        unknown = np.isnan(s.u_f_r)
        u2 = np.where(unknown, 0.0, np.nan_to_num(s.u_f_r)) ** 2
        self._blocks, self.block_channels = [], []
        edges = np.searchsorted(self.channels.index, np.arange(len(self.channels.names) + 1))
        cuts = [(c, a) for c, (start, end) in enumerate(itertools.pairwise(edges)) for a in range(start, end, BLOCK)]
        for channel, a in cuts:
            cut = slice(a, min(a + BLOCK, edges[channel + 1]))
            self.block_channels.append(channel)
            block = (
                np.ascontiguousarray(base[:, cut]),
                np.ascontiguousarray(slope[:, :, cut]),
                np.ascontiguousarray(s.d_ln_f[cut].T),
                u2[cut].copy(),
                unknown[cut].astype(float),
                s.f_r[cut].copy(),
            )
            held = None
            if not self._moves:
                held = np.empty((1, 1 + len(self._varied), 6, block[0].shape[1]))
                constant = np.nan_to_num(self.space.template)[None, :]
                _directions_kernel(block[0], block[1], constant, self._offset, self._varied, STEP, held)
            self._blocks.append((block, held))

    @property
    def blocks(self) -> range:
        """Numbers of the blocks into which the samples are cut, in order."""
        return range(len(self._blocks))

    def directions(self, full: Array, index: int) -> Array:
        """Unit vectors of a block of samples with all shared errors, shape (w or 1, 1 + v, 6, n)."""
        (base, slope, *_), held = self._blocks[index]
        if held is not None:
            return held
        out = np.empty((len(full), 1 + len(self._varied), 6, base.shape[1]))
        _directions_kernel(base, slope, full, self._offset, self._varied, STEP, out)
        return out

    def columns(self, term: int, channel: int) -> NDArray[np.int64]:
        """Places of a term's parameters among all declared ones."""
        _, model, first = self.terms[term]
        return self._columns[channel, first : first + len(model.parameters)]

    def add_term(self, term: int, full: Array, directions: Array, out: Array, channel: int) -> None:
        """Add f_r of one term to `out`, shape (w, 1 + v, n); the shared errors turn directions and do nothing else."""
        model = self.terms[term][1]
        parameters = np.ascontiguousarray(full[:, self.columns(term, channel)])
        if model.derived is not None:
            parameters = np.array([model.complete(row) for row in parameters])
        _term_kernel(model.function)(directions, parameters, out)

    def log_slopes(self, index: int) -> tuple[Array, int, bool]:
        """Derivatives (k, n) of the logarithm of a block's readings by the shared errors; the place of the first of those in
        the parameter array; whether there is any that is not 0."""
        return self._blocks[index][0][2], self._offset, self._has_log

    def _moments_of(self, full: Array, index: int) -> tuple[Array, Array]:
        (_, _, log_slope, u2, unknown, _), _ = self._blocks[index]
        directions = self.directions(full, index)
        values = np.zeros((len(full), *directions.shape[1::2]))
        for term in range(len(self.terms)):
            self.add_term(term, full, directions, values, self.block_channels[index])
        mean, var = np.empty((len(full), u2.size)), np.empty((len(full), u2.size))
        _moments_kernel(
            values, full, self._offset, self._noise, log_slope, self._has_log, self._noisy, self._variant,
            self._u_sample, STEP, u2, unknown, mean, var,
        )  # fmt: skip
        return mean, var

    def predict(self, x: Array) -> tuple[Array, Array]:
        """Expected readings [1/sr] and their variances [1/sr^2], each (w, n), for free parameters x, shape (w, d)."""
        full = self.space.full(np.atleast_2d(x))
        parts = [self._moments_of(full, i) for i in self.blocks]
        return np.concatenate([m for m, _ in parts], axis=1), np.concatenate([v for _, v in parts], axis=1)

    def in_parts(self, function: Callable[[Array], tuple[Array, ...]], rows: Array) -> tuple[Array, ...]:
        """What a function of some rows (w, ...) gives, put together again; on several threads if there are some."""
        step = max(1, min(WALKERS, -(-len(rows) // self.threads)))
        parts = [rows[a : a + step] for a in range(0, len(rows), step)]
        found = list(map(function, parts) if self._pool is None or len(parts) == 1 else self._pool.map(function, parts))
        return found[0] if len(found) == 1 else tuple(np.concatenate(column) for column in zip(*found, strict=True))

    def log_likelihood(self, x: Array, *, stated: bool = False) -> tuple[Array, Array]:
        """ln L (up to a constant; -inf where it is not finite) and chi^2, each (w,), for free parameters x, (w, d).

        `stated` leaves the model's discrepancy and the scale of the noise out of the variances.
        """
        full = self.space.full(x)
        if stated:
            full[:, self._noise + 2], full[:, self._noise + 3] = 0.0, 1.0
        total, chi2 = self.in_parts(self._log_likelihood, full)
        return np.where(np.isfinite(total), total, -np.inf), chi2

    def _log_likelihood(self, full: Array) -> tuple[Array, ...]:
        total, chi2 = np.zeros(len(full)), np.zeros(len(full))
        for i, (block, _) in enumerate(self._blocks):
            mean, var = self._moments_of(full, i)
            _reduce_kernel(mean, var, block[5], self.student or 0.0, total, chi2)
        return total, chi2

    def log_probability(self, u: Array) -> Array:
        """Log posterior density of the unbounded coordinates, up to a constant: (w, d) -> (w,); never NaN."""
        x, log_prior = self.space.natural(u)
        total = log_prior + self.log_likelihood(x)[0]
        return np.where(np.isfinite(total), total, -np.inf)
