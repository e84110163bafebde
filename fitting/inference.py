r"""One fit from samples to posterior.

The steps: declare the parameters, find the modes, judge chi^2, sample by importance or by a walk (`fitting.sampled`), and
put everything a reader needs to judge the result beside the draws. Nothing is read, written or printed here.

If the model misses the data by more than their stated uncertainty (chi^2/N above 1.5, or 4 standard deviations for few
samples), intervals from that uncertainty alone are far too narrow and around a biased value. Then a relative discrepancy
of the model, ``noise.discrepancy``, is inferred as well, unless the caller forbids it, and the diagnostics say so.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting import optimum, sample, sampled
from fitting.diagnostics import advice, contraction, entangled, misfit_limit
from fitting.likelihood import Channelled, Problem
from gonio import brdf
from gonio.channels import ChannelSamples
from gonio.errors import DatasetError, ParameterError
from gonio.posterior import Posterior
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
MAX_SAMPLES = 5000
OUTLYING = 5.0  # standard deviations


def fit(
    samples: BRDFSamples | ChannelSamples,
    model: str = "lambertian+ggx",
    *,
    free: Iterable[str] = (),
    fix: Mapping[str, float] | None = None,
    priors: Mapping[str, Sequence[object]] | None = None,
    seed: int = 0,
    max_steps: int | None = None,
    progress: sample.Progress | None = None,
    shared: bool = True,
    discrepancy: bool | None = None,
    student: float | None = None,
    threads: int = 1,
    chain: bool = False,
    tie: Iterable[str] = (),
    resume: Posterior | None = None,
    max_samples: int | None = MAX_SAMPLES,
    rule: sample.Rule | None = None,
) -> Posterior:
    """Posterior of a BRDF model given samples.

    Parameters
    ----------
    samples : BRDFSamples or ChannelSamples
        Of several channels, parameters in which f_r is linear are one for each, ``"lambertian.albedo[red]"``, and all others
        the same in all; see `gonio.posterior.Posterior.channel`.
    model : str
        Models joined by ``+``.
    free : iterable of str
        Parameters to free that the model holds by default, such as ``"ggx.k_s"``.
    fix : mapping of str to float
        Parameters to hold, with their values.
    priors : mapping of str to tuple
        Instead of the default priors; see `fitting.priors`.
    seed : int
        The same samples, options and seed give the same draws, byte by byte.
    max_steps : int, optional
        Longest chain per ensemble; default that of `rule`.
    progress : callable, optional
        ``progress(done, total)``; the total is an estimate.
    shared : bool
        Infer the shared errors of the samples; False takes them as exactly 0, and the intervals are too narrow.
    discrepancy : bool, optional
        Infer a relative discrepancy of the model. Default: only if chi^2/N demands it and `student` is not given.
    student : float, optional
        Degrees of freedom of Student's t in place of Gauss, such as 4, for samples with stray readings.
    threads : int
        For the likelihood of several walkers; the numbers do not depend on it.
    chain : bool
        Walk with emcee even where importance sampling would do.
    tie : iterable of str
        Linear parameters that are the same in all channels, too.
    resume : Posterior, optional
        Of the same samples and options, not converged: its chains go on, as if they had never stopped.
    max_samples : int, optional
        More samples than this are cut to a random choice, and the diagnostics say so. None: all.
    rule : fitting.sample.Rule, optional
        How much to sample.

    Returns
    -------
    Posterior
        ``diagnostics["converged"]`` says whether the chains can be trusted, ``diagnostics["advice"]`` what to do.
        `draws` are of equal weight; those of a walk are thinned to about two per autocorrelation time of a walker.

    Raises
    ------
    ParameterError
        If a name is unknown or a value outside its range.
    DatasetError
        If there is nothing to fit, or `resume` belongs to something else.
    ConvergenceError
        If no parameters give the samples a finite probability.

    Examples
    --------
    >>> import numpy as np
    >>> theta_i = np.linspace(0.1, 1.2, 40)
    >>> white = BRDFSamples.plain(theta_i, 0.0, 0.3, 1.0, np.full(40, 0.5 / np.pi), np.full(40, 0.003))
    >>> paper = fit(white, "lambertian", seed=1).summary()["lambertian.albedo"]
    >>> bool(abs(paper["mean"] - 0.5) < paper["sd"] and abs(paper["sd"] / (0.003 * np.pi / np.sqrt(40)) - 1) < 0.05)
    True
    """
    rule = rule or sample.Rule()
    if max_steps is not None:
        rule = replace(rule, max_steps=max_steps)
    if seed < 0:
        raise ParameterError(f"seed = {seed} is negative; choose a whole number from 0 up")
    models = brdf.parse(model)
    first, second = (int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(2))
    channels, tied = None, tuple(tie)
    if isinstance(samples, ChannelSamples):
        parts = samples.all_channels()
        index = np.repeat(np.arange(len(parts)), [len(part) for part in parts])
        channels, samples = Channelled(samples.channels.names, index, tied), BRDFSamples.joined(parts)
    elif tied:
        raise ParameterError(f"tie: {tied[0]!r} is one number anyway, as the samples have one channel")
    given = len(samples)
    if max_samples is not None and given > max_samples:
        chosen = np.sort(np.random.default_rng(first).choice(given, max_samples, replace=False))
        samples = samples.select(chosen)
        channels = channels and replace(channels, index=channels.index[chosen])
    options: dict[str, Any] = {
        "free": tuple(free), "fix": dict(fix or {}), "priors": dict(priors or {}), "shared": shared, "student": student,
        "threads": threads, "channels": channels,
    }  # fmt: skip
    problem = Problem(samples, models, discrepancy=bool(discrepancy), **options)
    modes = optimum.find(problem, np.random.default_rng(first))
    stated = _chi2_per_n(problem, modes[0].u, stated=True)
    unknown = np.isnan(samples.u_f_r)
    inflate = discrepancy is None and student is None and stated > misfit_limit(len(samples)) and not unknown.all()
    if inflate and not {"noise.discrepancy", "noise.scale"} & {*options["fix"], *options["free"]}:
        problem = Problem(samples, models, discrepancy=True, **options)
        modes = optimum.find(problem, np.random.default_rng(first))
    mark = _fingerprint(problem, model, seed, rule)
    if resume is not None and (resume.walk is None or resume.diagnostics.get("fingerprint") != mark):
        raise DatasetError(
            "these chains cannot go on: "
            + ("they have converged" if resume.converged else "they are of other samples, another model or other options")
        )
    found = sampled.run(
        problem, modes, seed=second, rule=rule, chain=chain, progress=progress,
        walk=None if resume is None else sample.Walk(**resume.walk or {}),
    )  # fmt: skip
    names, x = problem.space.names, found.draws.reshape(-1, len(problem.space))
    contractions = _contractions(problem, x)
    inferred = "noise.discrepancy" in names
    noise = "inferred" if unknown.all() else "mixed" if unknown.any() else "stated"
    best = problem.space.natural(modes[0].u[None])[0]
    outliers = _outliers(problem, best)
    said = advice(
        chi2_per_n=stated,
        n_samples=len(samples),
        n_parameters=len(names),
        contractions={name: contractions[name] for name in problem.model_names},
        noise=noise,
        discrepancy=inferred,
        acceptance=found.acceptance,
        outliers=len(outliers),
        robust=student is not None,
        scaled="noise.scale" in names,
        incidences=len(np.unique(np.round(samples.theta_i, 3))),
    )
    errors = [i for i, name in enumerate(names) if name.startswith("shared.")]
    said += entangled(problem.model_names, x[:, [names.index(name) for name in problem.model_names]], x[:, errors])
    if given > len(samples):
        said.append(f"a random {len(samples)} of {given} samples were used; raise max_samples to use more")
    if not found.converged:
        said.insert(0, found.status)
    diagnostics = {
        "converged": found.converged,
        "status": found.status,
        "advice": said,
        "ess": dict(zip(names, map(float, found.ess), strict=True)),
        "rhat": dict(zip(names, map(float, found.rhat), strict=True)),
        "acceptance": found.acceptance,
        "chi2_per_n": stated,
        "chi2_per_n_with_discrepancy": _chi2_per_n(problem, modes[0].u, stated=False) if inferred else None,
        "n_samples": len(samples),
        "n_samples_given": given,
        "n_parameters": len(names),
        "noise": noise,
        "discrepancy": inferred,
        "student": student,
        "outliers": [int(i) for i in outliers],
        "contraction": contractions,
        "optimum": dict(zip(names, map(float, best[0]), strict=True)),
        "modes": len(modes),
        "units": dict(problem.space.units),
        "priors": {
            name: {"kind": q.kind, "a": q.a, "b": q.b, "lower": q.lower, "upper": q.upper}
            for name, q in zip(names, problem.space.priors, strict=True)
        },
        "seed": seed,
        "fingerprint": mark,
        **found.numbers,
    }
    walk = None if found.walk is None else {f.name: getattr(found.walk, f.name) for f in fields(found.walk)}
    return Posterior(model, names, found.draws, found.log_posterior, dict(problem.space.fixed), diagnostics, walk)


def _outliers(problem: Problem, x: Array) -> NDArray[np.int64]:
    """Samples farther than `OUTLYING` standard deviations from the model at x, shape (1, d)."""
    mean, var = problem.predict(x)
    return np.flatnonzero(np.abs(problem.samples.f_r - mean[0]) > OUTLYING * np.sqrt(var[0]))


def _fingerprint(problem: Problem, model: str, seed: int, rule: sample.Rule) -> str:
    """Of all that decides the draws, but for the largest number of steps."""
    samples = problem.samples
    digest = hashlib.sha256()
    for name in ("theta_i", "phi_i", "theta_r", "phi_r", "f_r", "u_f_r", "d_omega_i", "d_omega_r", "d_ln_f"):
        digest.update(np.ascontiguousarray(getattr(samples, name)).tobytes())
    said = (samples.shared, model, problem.space.names, problem.space.priors, sorted(problem.space.fixed.items()))
    digest.update(repr((said, problem.student, seed, replace(rule, max_steps=1))).encode())
    return digest.hexdigest()


def _chi2_per_n(problem: Problem, u: Array, *, stated: bool) -> float:
    """chi^2 / N at a point, with or without the model's discrepancy in the variances."""
    _, chi2 = problem.log_likelihood(problem.space.natural(u[None])[0], stated=stated)
    return float(chi2[0]) / len(problem.samples)


def _contractions(problem: Problem, x: Array) -> dict[str, float]:
    out = {}
    for i, (name, q) in enumerate(zip(problem.space.names, problem.space.priors, strict=True)):
        value = np.log(x[:, i]) if q.logarithmic else x[:, i]
        out[name] = contraction(q.sd(), float(np.std(value)))
    return out
