r"""Which model predicts best, by how much, and whether any is adequate.

Two scores, both sums of logarithms of predictive densities of readings that the fit has not seen:

- leave-one-out, from one fit and Pareto-smoothed weights (PSIS-LOO) [1]_. It asks how well a reading is told by its
  neighbours, and gonio's samples lie close together on one lobe;
- leave-one-incidence-out: a fit for each incidence (each of at most `FOLDS` groups of theta_i) without its readings. It asks
  how well the model extrapolates, which is what a model is for.

Differences have a standard error from their scatter over readings, over groups respectively [2]_; several `DECISIVE` of them
are a decision. Every model has a relative discrepancy of its own or, where the samples state no uncertainty, a noise of its
own, so that a wrong model is not merely punished for too narrow a variance.

A best model need not be a good one. `Comparison.faults` asks for chi^2/N within its limits, with the uncertainties as
stated, and for residuals of neighbouring directions that are not alike: their correlation is the share of the misfit that
is the model's and not noise. Where no uncertainty is stated, the noise that a model needs must also not be much more than
what a better one needs for the same readings.

References
----------
.. [1] A. Vehtari, A. Gelman, J. Gabry, "Practical Bayesian model evaluation using leave-one-out cross-validation and WAIC",
   Statistics and Computing 27, 2017. doi:10.1007/s11222-016-9696-4
.. [2] T. Sivula, M. Magnusson, A. A. Matamoros, A. Vehtari, "Uncertainty in Bayesian Leave-One-Out Cross-Validation Based
   Model Comparison", arXiv:2008.10296.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting import psis
from fitting.batch import STATUS, Job
from fitting.diagnostics import CONTRACTION_LIMIT, contraction, misfit_limit
from fitting.inference import MAX_SAMPLES, fit
from fitting.likelihood import Problem
from fitting.sample import Rule
from gonio import brdf
from gonio.errors import ParameterError
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
FOLDS = 10
DECISIVE, LIKELY = 4.0, 2.0  # standard errors
SMALL = 4.0  # difference of log scores that means nothing, whatever its error [2]_
FEW = 20  # readings
MORE_NOISE = 1.5
ALIKE = 0.3  # correlation of neighbouring residuals above which the misfit is the model's
_DRAWS = 2048  # of a fit
_RULE = Rule(ensembles=2, taus=20.0, drift=0.1)


@dataclass(frozen=True)
class Score:
    """One model.

    Attributes
    ----------
    model : str
    parameters : dict
        ``{name: (mean, sd)}`` of the free ones, from all samples.
    loo : ndarray, shape (n,)
        Log predictive density of each reading [ln sr], left out by weights.
    incidence : ndarray, shape (n,)
        The same, its group of theta_i left out by another fit; NaN with a single group.
    effective_parameters : float
        Log density of the readings when seen less that when left out.
    unsure : float
        Share of readings whose weights are not to be trusted (k-hat above its limit).
    chi2_per_n : float
        With the stated uncertainties, without discrepancy; NaN where none is stated.
    noise : float
        Relative noise or discrepancy of the median reading that the model needs beyond what is stated.
    alike : float
        Correlation of the pulls of neighbouring directions.
    blind : tuple of str
        Parameters that the samples do not inform.
    sampled : int
        Fits, of all and of those with a group left out, that took a chain.
    """

    model: str
    parameters: dict[str, tuple[float, float]]
    loo: Array
    incidence: Array
    effective_parameters: float
    unsure: float
    chi2_per_n: float
    noise: float
    alike: float
    blind: tuple[str, ...]
    sampled: int


@dataclass(frozen=True)
class Comparison:
    """Models, the best first.

    Attributes
    ----------
    scores : tuple of Score
    group : ndarray of int, shape (n,)
        Group of theta_i of each reading that was used.
    theta_i : ndarray, shape (g,)
        Mean of each group [rad].
    """

    scores: tuple[Score, ...]
    group: NDArray[np.int64]
    theta_i: Array

    def difference(self, score: Score, kind: str, other: Score | None = None) -> tuple[float, float]:
        """How much worse a model is than another, the best by default, and the standard error of that.

        `kind` is ``"loo"`` or ``"incidence"``; the error of the latter is from the scatter over groups.
        """
        other = other or self.scores[0]
        parts = getattr(other, kind) - getattr(score, kind)
        if kind == "incidence":
            parts = np.bincount(self.group, parts)
        total = float(np.sum(parts))
        return total, float(np.std(parts, ddof=min(1, len(parts) - 1)) * math.sqrt(len(parts)))

    def faults(self, score: Score) -> tuple[str, ...]:
        """Why a model is not adequate; empty if its residuals look like noise of the size that there is."""
        n, best = len(score.loo), self.scores[0]
        found = []
        if score.chi2_per_n > misfit_limit(n):
            found.append(f"chi2/N = {score.chi2_per_n:.3g}")
        if score.alike > max(ALIKE, 4.0 / math.sqrt(n)):
            found.append(f"{100 * score.alike:.0f} % of the misfit is systematic")
        gap, error = self.difference(score, self.kind)
        if math.isnan(score.chi2_per_n) and score.noise > MORE_NOISE * best.noise and gap > max(SMALL, LIKELY * error):
            found.append(f"off by {100 * score.noise:.2g} % where {best.model} is by {100 * best.noise:.2g} %")
        return tuple(found)

    @property
    def kind(self) -> str:
        """The score that ranks: ``"incidence"``, or ``"loo"`` where there is one incidence."""
        return "incidence" if len(self.theta_i) > 1 else "loo"

    def verdict(self) -> list[str]:
        """What to conclude, in sentences."""
        best = self.scores[0]
        said = []
        if len(self.scores) > 1:
            gap, error = self.difference(self.scores[1], self.kind)
            sure = "but not surely"
            if gap > SMALL and len(self.group) >= FEW:
                sure = "beyond doubt" if gap > DECISIVE * error else "probably" if gap > LIKELY * error else sure
            name = "left-out incidences" if self.kind == "incidence" else "left-out readings"
            said.append(
                f"{best.model} predicts {name} best, {sure}: {self.scores[1].model} is {gap:.0f} +- {error:.0f} behind"
            )
            nearest = max(self.scores, key=lambda s: float(np.sum(s.loo)))
            gap, error = self.difference(best, "loo", nearest)
            if gap > max(SMALL, LIKELY * error):
                said.append(
                    f"between neighbouring directions {nearest.model} is better, by {gap:.0f} +- {error:.0f}: it describes "
                    "what was measured and extrapolates worse"
                )
        good = [s for s in self.scores if not self.faults(s)]
        if good:
            said.append(f"adequate: {', '.join(s.model for s in good)}")
        bad = "; ".join(f"{s.model}: {', '.join(self.faults(s))}" for s in self.scores if s not in good)
        if bad:
            said.append(
                f"{'not' if good else 'no model is'} adequate: {bad}{'' if good else '; use the table, or another model'}"
            )
        if len(self.group) < FEW:
            said.append(f"{len(self.group)} readings are few: what describes them may be wrong elsewhere")
        if math.isnan(best.chi2_per_n):
            said.append(
                "the samples state no uncertainty: adequate means that the residuals look like noise, not that noise of "
                "that size is likely"
            )
        for s in self.scores:
            if s.blind:
                said.append(f"{s.model}: the samples do not inform {', '.join(s.blind)}; its prior decides")
            if s.unsure > 0.01:
                said.append(
                    f"{s.model}: {100 * s.unsure:.0f} % of the readings decide too much alone for their LOO to be sure"
                )
        return said


def compare(
    samples: BRDFSamples,
    models: Sequence[str],
    *,
    free: Iterable[str] = (),
    fix: Mapping[str, float] | None = None,
    priors: Mapping[str, Sequence[object]] | None = None,
    shared: bool = True,
    seed: int = 0,
    max_samples: int = MAX_SAMPLES,
    progress: Callable[[int, int], None] | None = None,
) -> Comparison:
    """Score models on the same samples.

    Parameters
    ----------
    samples : BRDFSamples
    models : sequence of str
        Each a sum such as ``"lambertian+ggx"``.
    free, fix, priors
        As for `fitting.fit`; a name applies to the models that have it.
    shared : bool
        Infer the shared errors of the samples.
    seed : int
        Of the choice of samples, if there are more than `max_samples`, and of chains.
    progress : callable, optional
        ``progress(done, total)`` in models.

    Raises
    ------
    ParameterError
        If there is no model, one stands twice, or a name belongs to none of them.
    """
    models = list(models)
    if not models or len(set(models)) < len(models):
        raise ParameterError("compare: name each model once, such as lambertian+ggx,lambertian+beckmann")
    if len(samples) > max_samples:
        chosen = np.sort(np.random.default_rng(seed).choice(len(samples), max_samples, replace=False))
        samples = samples.select(chosen)
    group = incidences(samples.theta_i)
    options = {"free": tuple(free), "fix": dict(fix or {}), "priors": dict(priors or {})}
    split = [_own(model, options) for model in models]
    for key, names in options.items():
        for name in names:
            if not any(name in own[key] for own in split):
                raise ParameterError(f"compare: {key} {name}: none of the models has it")
    scores = []
    for done, (model, own) in enumerate(zip(models, split, strict=True), 1):
        scores.append(_score(samples, model, group, shared, seed, own))
        if progress is not None:
            progress(done, len(models))
    theta_i = np.bincount(group, samples.theta_i) / np.bincount(group)
    found = Comparison(tuple(scores), group, theta_i)
    return replace(found, scores=tuple(sorted(scores, key=lambda s: -float(np.sum(getattr(s, found.kind))))))


def incidences(theta_i: Array) -> NDArray[np.int64]:
    """Group of each sample: its theta_i where there are few (to 0.1 degree), else one of `FOLDS` of equal size."""
    rounded = np.round(np.degrees(theta_i), 1)
    values, group = np.unique(rounded, return_inverse=True)
    if len(values) <= FOLDS:
        return np.asarray(group.ravel(), dtype=np.int64)
    edges = np.quantile(theta_i, np.linspace(0, 1, FOLDS + 1)[1:-1])
    return np.unique(np.searchsorted(edges, theta_i, side="right"), return_inverse=True)[1].ravel().astype(np.int64)


def _own(model: str, options: Mapping[str, Any]) -> dict[str, Any]:
    """The options that concern a model; shared errors and noise concern all."""
    from fitting.parameters import declare

    known = {p.name for p in declare(brdf.parse(model))}

    def concerns(name: str) -> bool:
        return name in known or name.startswith(("shared.", "noise."))

    return {
        "free": tuple(name for name in options["free"] if concerns(name)),
        "fix": {name: v for name, v in options["fix"].items() if concerns(name)},
        "priors": {name: v for name, v in options["priors"].items() if concerns(name)},
    }


def _score(
    samples: BRDFSamples, model: str, group: NDArray[np.int64], shared: bool, seed: int, options: Mapping[str, Any]
) -> Score:
    stated = ~np.isnan(samples.u_f_r)
    job = Job(samples, model, **options, shared=shared, draws=_DRAWS, discrepancy=bool(stated.any()))
    engine, y = job.engine(), samples.f_r
    folds = int(group.max()) + 1
    rows = np.tile(y, (1 + folds if folds > 1 else 1, 1))
    for g in range(len(rows) - 1):
        rows[1 + g, group == g] = np.nan
    drawn = engine.draw(rows)
    kept, sampled = [], 0
    for k in range(len(rows)):
        if STATUS[drawn.status[k]] == "good":
            kept.append((drawn.x[k], drawn.log_weights[k]))
            continue
        part = samples.select(np.isfinite(rows[k]))
        chain = fit(part, model, **options, shared=shared, seed=seed, discrepancy=job.discrepancy, rule=_RULE)
        kept.append((chain.thin(_DRAWS, np.random.default_rng(seed)), np.full(_DRAWS, -math.log(_DRAWS))))
        sampled += 1
    problem = engine.problem
    x, log_weights = kept[0]
    density = _log_density(problem, x).T  # (n, draws)
    smoothed, k_hat = psis.smooth(log_weights - density)
    loo = _log_sum(smoothed + density)
    incidence = np.full(len(y), np.nan)
    for g, (left, weights) in enumerate(kept[1:]):
        out = group == g
        incidence[out] = _log_sum(weights + _log_density(problem, left)[:, out].T)
    w = np.exp(log_weights)
    middle = w @ x
    sd = np.sqrt(w @ (x - middle) ** 2)
    mean, var = (v[0] for v in problem.predict(middle[None]))
    _, chi2 = problem.log_likelihood(middle[None], stated=True)
    return Score(
        model=model,
        parameters={name: (float(a), float(b)) for name, a, b in zip(engine.names, middle, sd, strict=True)},
        loo=loo,
        incidence=incidence,
        effective_parameters=float(np.sum(_log_sum(log_weights + density) - loo)),
        unsure=float(np.mean(~(k_hat <= psis.limit(_DRAWS)))),
        chi2_per_n=float(chi2[0]) / len(y) if stated.all() else math.nan,
        noise=_extra_noise(dict(zip(engine.names, middle, strict=True)), mean),
        alike=_alike(samples, (y - mean) / np.sqrt(var)),
        blind=_blind(problem, x, w),
        sampled=sampled,
    )


def _log_density(problem: Problem, x: Array) -> Array:
    """Log density of each reading under each draw, (s, n)."""
    n = len(problem.samples)
    step = max(1, 1_000_000 // n)
    out = np.empty((len(x), n))
    for a in range(0, len(x), step):
        mean, var = problem.predict(x[a : a + step])
        out[a : a + step] = -0.5 * ((problem.samples.f_r - mean) ** 2 / var + np.log(2.0 * math.pi * var))
    return out


def _log_sum(terms: Array) -> Array:
    """Logarithm of the sum of exponentials over the last axis."""
    top = np.max(terms, axis=-1, keepdims=True)
    return np.asarray(top[..., 0] + np.log(np.sum(np.exp(terms - top), axis=-1)))


def _extra_noise(value: Mapping[str, float], mean: Array) -> float:
    """What is inferred beyond the stated uncertainty, relative to the model's readings; of the median reading."""
    relative = math.hypot(value.get("noise.relative", 0.0), value.get("noise.discrepancy", 0.0))
    middle = float(np.median(np.abs(mean)))
    return math.hypot(relative, value.get("noise.absolute", 0.0) / middle if middle > 0 else 0.0)


def _alike(samples: BRDFSamples, pull: Array) -> float:
    """Correlation of each pull with that of the sample nearest in both directions."""
    from scipy.spatial import cKDTree

    at = np.concatenate((samples.omega_i(), samples.omega_r()), axis=1)
    if len(at) < 3:
        return 0.0
    nearest = cKDTree(at).query(at, k=2)[1]
    itself = nearest[:, 0] == np.arange(len(at))  # not where directions stand twice
    other = np.where(itself, nearest[:, 1], nearest[:, 0])
    square = float(np.mean(pull**2))
    return float(np.mean(pull * pull[other])) / square if square > 0 else 0.0


def _blind(problem: Problem, x: Array, weights: Array) -> tuple[str, ...]:
    """Parameters of the model whose variance the data lower by less than `CONTRACTION_LIMIT`."""
    out = []
    for i, (name, q) in enumerate(zip(problem.space.names, problem.space.priors, strict=True)):
        value = np.log(x[:, i]) if q.logarithmic else x[:, i]
        sd = math.sqrt(float(weights @ (value - weights @ value) ** 2))
        if name in problem.model_names and contraction(q.sd(), sd) < CONTRACTION_LIMIT:
            out.append(name)
    return tuple(out)
