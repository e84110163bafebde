"""Effective draws per second of a posterior: gonio's fit against what a user would write.

The same data, the same density and the same priors for all; `TEXT` says how.
"""

from __future__ import annotations

import importlib.util
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

import gonio
from fitting import optimum, sample, sampled
from fitting.diagnostics import autocorrelation_time
from fitting.likelihood import Problem
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]
MODEL = "lambertian+microfacet[distribution=ggx,fresnel=dielectric]"
FREE = ("microfacet.k_s", "noise.scale")
ORDER = ("lambertian.albedo", "microfacet.k_s", "microfacet.alpha", "microfacet.n", "noise.scale")
PRIORS = {"microfacet.alpha": ("log_uniform", 0.01, 1.0), "microfacet.n": ("uniform", 1.05, 3.0)}
TEXT = """5,000 samples of a rough dielectric over a diffuse base, 2 % noise; five parameters: albedo, weight, roughness,
index, and a scale of the noise, with flat priors (of roughness and scale: in the logarithm). Data and density are the same
for all, and draws are of all five: what gonio integrates out is drawn back.

The user's script is emcee as its tutorial has it: 32 walkers, stretch moves, each walker's density in NumPy. NUTS is
numpyro's (JAX, double precision, dense mass matrix, two chains one after the other), warm-up counted, compilation not.
gonio's rows are what `gonio fit` does between the modes and the draws, burn-in counted. All start where the posterior is.
Rates are per second of processor, so that what else the machine does counts little; with two threads per second of wall
time, against the user's wall time. Importance sampling is so short that its row is ten runs, of which the first has the
error: the largest of the five means, against 40,000 effective draws.

"""
TRUTH = (0.3, 0.8, 0.2, 1.5, 1.0)
LIMITS = {"gonio, emcee": 12.0, "gonio, emcee, 2 threads": 20.0, "gonio, importance sampling": 90.0}


@dataclass(frozen=True)
class Row:
    """One program.

    Attributes
    ----------
    name : str
    processor_s, wall_s : float
        Of sampling [s].
    effective : float
        Effective draws of the parameter that has fewest.
    error : float
        Largest error of a mean over the posterior's standard deviation.
    """

    name: str
    processor_s: float
    wall_s: float
    effective: float
    error: float


def data(n: int) -> BRDFSamples:
    """Samples near the plane of incidence and elsewhere, up to 80 degrees; the uncertainty is that of the truth."""
    rng = np.random.default_rng(1)
    theta_i = np.radians(rng.uniform(2.0, 80.0, n))
    near = rng.random(n) < 0.5
    theta_r = np.where(near, theta_i + rng.normal(0, 0.2, n), np.radians(rng.uniform(2.0, 80.0, n)))
    theta_r = np.clip(theta_r, 0.0, np.radians(80.0))
    phi_r = np.where(near, math.pi + rng.normal(0, 0.3, n), rng.uniform(0.0, 2 * math.pi, n))
    truth = gonio.brdf.make("lambertian", albedo=TRUTH[0])
    truth += gonio.brdf.make(
        "microfacet", distribution="ggx", fresnel="dielectric", k_s=TRUTH[1], alpha=TRUTH[2], n=TRUTH[3]
    )
    f = truth.f_r(theta_i, 0.0, theta_r, phi_r)
    return BRDFSamples.plain(theta_i, 0.0, theta_r, phi_r, f * (1.0 + 0.02 * rng.normal(size=n)), 0.02 * f)


def log_density(x, geometry, y, u, np=np):  # type: ignore[no-untyped-def]
    """The user's: parameters (albedo, k_s, ln alpha, n, ln s); GGX, Fresnel's equations, height-correlated shadowing."""
    albedo, k_s, ln_alpha, n, ln_s = x
    mu_i, mu_r, c, mu_h2 = geometry
    a2 = np.exp(2.0 * ln_alpha)
    d = a2 / (np.pi * (mu_h2 * (a2 - 1.0) + 1.0) ** 2)
    g = np.sqrt(n * n - 1.0 + c * c)
    fresnel = 0.5 * ((g - c) / (g + c)) ** 2 * (1.0 + ((c * (g + c) - 1.0) / (c * (g - c) + 1.0)) ** 2)
    hidden = [0.5 * (np.sqrt(1.0 + a2 * (1.0 / (mu * mu) - 1.0)) - 1.0) for mu in (mu_i, mu_r)]
    f = albedo / np.pi + k_s * fresnel * d / (1.0 + hidden[0] + hidden[1]) / (4.0 * mu_i * mu_r)
    return -0.5 * np.sum(((y - f) / u) ** 2) * np.exp(-2.0 * ln_s) - len(y) * ln_s


BOUNDS = np.array([[0.0, 1.0], [0.0, 1.0], [math.log(0.01), 0.0], [1.05, 3.0], [math.log(0.01), math.log(100.0)]])


def geometry_of(samples: BRDFSamples) -> tuple[Array, Array, Array, Array]:
    wi, wr = samples.omega_i(), samples.omega_r()
    h = wi + wr
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    return wi[:, 2], wr[:, 2], np.sum(wi * h, axis=1), h[:, 2] ** 2


def measure(*, quick: bool) -> list[Row]:
    """All programs that are installed, the user's first."""
    samples = data(500 if quick else 5000)
    problem = _problem(samples, 1)
    modes = optimum.find(problem, np.random.default_rng(0))
    place = [problem.space.names.index(name) for name in ORDER]
    reference = sampled.run(problem, modes, seed=99, rule=sample.Rule(effective=4000 if quick else 40_000))
    flat = reference.draws.reshape(-1, len(ORDER))[:, place]
    mean, sd = flat.mean(axis=0), flat.std(axis=0)

    def natural(draws: Array) -> Array:
        return np.column_stack([draws[:, :2], np.exp(draws[:, 2]), draws[:, 3], np.exp(draws[:, 4])])

    def row(name: str, cost: tuple[float, float], draws: Array, effective: float) -> Row:
        return Row(name, *cost, effective, float(np.max(np.abs(draws.mean(axis=0) - mean) / sd)))

    start = flat[:: max(1, len(flat) // 32)][:32].copy()
    start[:, [2, 4]] = np.log(start[:, [2, 4]])
    rows = []
    cost, (chain, effective) = _timed(lambda: _user(samples, start, 300 if quick else 2000))
    rows.append(row("user's script, emcee", cost, natural(chain), effective))
    if importlib.util.find_spec("numpyro") is not None:
        cost, (chain, effective) = _nuts(samples, start, 100 if quick else 500)
        rows.append(row("numpyro, NUTS", cost, natural(chain), effective))
    rule = sample.Rule(ensembles=2, taus=10, drift=1.0, max_steps=400) if quick else sample.Rule()
    for threads in (1, 2):
        threaded = _problem(samples, threads)
        sampled.run(threaded, modes, seed=1, rule=replace(rule, max_steps=10), chain=True)  # kernels are loaded
        cost, found = _timed(lambda p=threaded: sampled.run(p, modes, seed=1, rule=rule, chain=True))
        name = "gonio, emcee" + (", 2 threads" if threads > 1 else "")
        rows.append(row(name, cost, found.draws.reshape(-1, len(ORDER))[:, place], float(np.min(found.ess))))
    cost, several = _timed(lambda: [sampled.run(problem, modes, seed=seed, rule=sample.Rule()) for seed in range(1, 11)])
    draws = several[0].draws.reshape(-1, len(ORDER))[:, place]
    rows.append(row("gonio, importance sampling", cost, draws, sum(float(np.min(found.ess)) for found in several)))
    return rows


def _problem(samples: BRDFSamples, threads: int) -> Problem:
    return Problem(samples, gonio.brdf.parse(MODEL), free=FREE, priors=PRIORS, threads=threads)


def _timed(work: Callable[[], Any]) -> tuple[tuple[float, float], Any]:
    wall, processor = time.perf_counter(), time.process_time()
    found = work()
    return (time.process_time() - processor, time.perf_counter() - wall), found


def _user(samples: BRDFSamples, start: Array, steps: int) -> tuple[Array, float]:
    import emcee

    given = geometry_of(samples), samples.f_r, samples.u_f_r

    def log_probability(x: Array) -> float:
        if np.any(x < BOUNDS[:, 0]) or np.any(x > BOUNDS[:, 1]):
            return -np.inf
        return float(log_density(x, *given))

    sampler = emcee.EnsembleSampler(len(start), start.shape[1], log_probability)
    sampler.random_state = np.random.RandomState(np.random.MT19937(1)).get_state()
    sampler.run_mcmc(start, steps)
    chain = sampler.get_chain()
    tau = autocorrelation_time(chain)
    return chain.reshape(-1, start.shape[1]), chain.shape[0] * chain.shape[1] / float(tau.max())


def _nuts(samples: BRDFSamples, start: Array, draws: int) -> tuple[tuple[float, float], tuple[Array, float]]:
    import jax
    import jax.numpy as jnp
    import numpyro
    import numpyro.distributions as dist
    from numpyro.diagnostics import effective_sample_size
    from numpyro.infer import MCMC, NUTS, init_to_value

    jax.config.update("jax_enable_x64", True)
    geometry = tuple(jnp.asarray(a) for a in geometry_of(samples))
    y, u = jnp.asarray(samples.f_r), jnp.asarray(samples.u_f_r)
    names = ("albedo", "k_s", "ln_alpha", "n", "ln_s")

    def model() -> None:
        x = [numpyro.sample(name, dist.Uniform(*bounds)) for name, bounds in zip(names, BOUNDS.tolist(), strict=True)]
        numpyro.factor("readings", log_density(x, geometry, y, u, np=jnp))

    first = init_to_value(values=dict(zip(names, start[0].tolist(), strict=True)))
    mcmc = MCMC(
        NUTS(model, dense_mass=True, init_strategy=first), num_warmup=draws, num_samples=draws, num_chains=2,
        chain_method="sequential", progress_bar=False,
    )  # fmt: skip
    mcmc.run(jax.random.PRNGKey(0))  # compiles
    cost, _ = _timed(lambda: mcmc.run(jax.random.PRNGKey(1)))
    by_chain = mcmc.get_samples(group_by_chain=True)
    effective = min(float(effective_sample_size(np.asarray(by_chain[name]))) for name in names)
    return cost, (np.column_stack([np.asarray(by_chain[name]).ravel() for name in names]), effective)


def report(rows: list[Row]) -> str:
    """The table and what of it was promised."""
    from tests.benchmarks import page

    user = rows[0]
    base, base_wall = user.effective / user.processor_s, user.effective / user.wall_s
    lines = []
    for r in rows:
        two = "2 threads" in r.name
        rate = r.effective / (r.wall_s if two else r.processor_s)
        ratio = rate / (base_wall if two else base)
        limit = LIMITS.get(r.name)
        kept = "" if limit is None else f"{'pass' if ratio >= limit else 'MISS'}: >= {limit:.0f}"
        lines.append([
            r.name, f"{r.processor_s:.1f} s, {r.wall_s:.1f} s", f"{r.effective:.0f}", f"{rate:.0f}", f"{ratio:.1f}",
            f"{r.error:.3f}", kept,
        ])  # fmt: skip
    head = ["program", "processor, wall", "effective draws", "per second", "ratio to the user's", "error of a mean / sd", ""]
    return TEXT + page.table(head, lines)
