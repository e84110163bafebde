"""Whole fits of data whose truth is known, made here from plain NumPy and rotation matrices."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
import pytest
from scipy import stats

from fitting import Rule, fit
from gonio.errors import DatasetError, ParameterError
from gonio.posterior import Posterior
from gonio.samples import BRDFSamples, SharedError
from tests.measurements import measure

QUICK = Rule(ensembles=2, taus=15, drift=0.3, first=150)


def material(wi, wr, albedo, alpha, f_0, lobe="ggx"):
    h = (wi + wr) / np.linalg.norm(wi + wr, axis=-1, keepdims=True)
    tan2 = 1.0 / h[:, 2] ** 2 - 1.0
    if lobe == "ggx":
        d = 1.0 / (np.pi * alpha**2 * h[:, 2] ** 4 * (1.0 + tan2 / alpha**2) ** 2)
    else:  # Beckmann
        d = np.exp(-tan2 / alpha**2) / (np.pi * alpha**2 * h[:, 2] ** 4)
    lam = [0.5 * (-1.0 + np.sqrt(1.0 + alpha**2 * (1.0 / w[:, 2] ** 2 - 1.0))) for w in (wi, wr)]
    fresnel = f_0 + (1.0 - f_0) * (1.0 - np.sum(wi * h, axis=-1)) ** 5
    return albedo / np.pi + fresnel * d / (1.0 + lam[0] + lam[1]) / (4.0 * wi[:, 2] * wr[:, 2])


@dataclass
class Scan:
    samples: BRDFSamples
    truth: dict[str, float]


def scan(seed, n, truth=(0.3, 0.25, 0.05), noise=0.01, lobe="ggx", stated=True):
    samples, errors = measure(
        np.random.default_rng(seed),
        lambda wi, wr: material(wi, wr, *truth, lobe=lobe),
        n,
        lambda wi, wr: noise * material(wi, wr, *truth, lobe=lobe) + 1e-4,
    )
    if not stated:
        samples = replace(samples, u_f_r=np.full(n, np.nan))
    names = ("lambertian.albedo", "ggx.alpha", "ggx.f_0")
    return Scan(samples, dict(zip(names, truth, strict=True)) | errors)


def pulls(posterior, truth):
    summary = posterior.summary()
    return {name: (summary[name]["mean"] - value) / summary[name]["sd"] for name, value in truth.items() if name in summary}


def paper(seed, n=12, albedo=0.6, u=0.01, u_scale=0.02):
    """A Lambertian surface seen through a shared scale error: (samples, true scale error)."""
    rng = np.random.default_rng(seed)
    delta = rng.normal(0, u_scale)
    theta = rng.uniform(0, 1.2, (2, n))
    f = albedo / np.pi * np.exp(delta) + rng.normal(0, u, n) * albedo / np.pi
    plain = BRDFSamples.plain(theta[0], 0.0, theta[1], 2.0, f, u * albedo / np.pi)
    zero = np.zeros((n, 3, 1))
    return BRDFSamples(
        **(vars(plain) | {"shared": (SharedError("scale", u_scale),), "d_omega_i": zero, "d_omega_r": zero,
                          "d_ln_f": np.ones((n, 1))})
    )  # fmt: skip


def exact_albedo_quantiles(s, probabilities):
    """Quantiles of p(albedo | data) with the scale error integrated out, on a grid (flat prior on [0, 1])."""
    a = np.linspace(1e-3, 1.0, 4001)
    z, w = np.polynomial.hermite_e.hermegauss(80)
    mean, sd = np.pi * s.f_r.mean(), np.pi * s.u_f_r[0] / math.sqrt(len(s))
    density = stats.norm.pdf(a[:, None] * np.exp(s.shared[0].u * z)[None], mean, sd) @ w
    cumulative = np.cumsum(density)
    return np.interp(probabilities, cumulative / cumulative[-1], a)


def test_quantiles_are_those_of_the_exact_posterior():
    s = paper(1)
    summary = fit(s, "lambertian", seed=1).summary()["lambertian.albedo"]
    exact = exact_albedo_quantiles(s, [0.025, 0.16, 0.5, 0.84, 0.975])
    got = [summary[key] for key in ("q025", "q16", "median", "q84", "q975")]
    assert np.abs(np.array(got) - exact) == pytest.approx(np.zeros(5), abs=0.08 * summary["sd"])


def test_intervals_cover_the_truth_as_often_as_they_say():
    """40 sets; binomial chance of failing by accident below 1 %, and the seeds are fixed."""
    inside95 = inside68 = 0
    for seed in range(40):
        q = fit(paper(seed), "lambertian", seed=seed, rule=QUICK).summary()["lambertian.albedo"]
        inside95 += q["q025"] <= 0.6 <= q["q975"]
        inside68 += q["q16"] <= 0.6 <= q["q84"]
    assert inside95 >= 34
    assert 19 <= inside68 <= 35


def test_without_the_shared_error_the_intervals_collapse():
    """The scale error is 7 times the random error of the mean: taken as 0, intervals miss the truth most of the time."""
    inside = 0
    for seed in range(15):
        q = fit(paper(seed), "lambertian", seed=seed, rule=QUICK, shared=False).summary()["lambertian.albedo"]
        inside += q["q025"] <= 0.6 <= q["q975"]
    assert inside <= 7


@pytest.mark.parametrize(("seed", "truth"), [(1, (0.3, 0.25, 0.05)), (2, (0.05, 0.1, 0.5))])
def test_lambert_and_ggx_are_recovered_with_the_errors_of_the_rig(seed, truth):
    s = scan(seed, 150, truth)
    posterior = fit(s.samples, seed=seed, rule=Rule(ensembles=2, taus=20, drift=0.1))
    assert posterior.converged, posterior.diagnostics["status"]
    assert posterior.names == tuple(s.truth)
    assert posterior.fixed["ggx.k_s"] == 1.0
    assert max(abs(p) for p in pulls(posterior, s.truth).values()) < 3.5
    assert posterior.diagnostics["chi2_per_n"] == pytest.approx(1.0, abs=4 * math.sqrt(2 / 150))
    assert not posterior.diagnostics["discrepancy"]
    assert posterior.diagnostics["advice"] == []
    assert min(posterior.diagnostics["contraction"][n] for n in list(s.truth)[:3]) > 0.9


def test_unknown_noise_is_inferred():
    """3 % noise that nobody stated: found again, as relative and absolute part together, at the middle reading."""
    s = scan(3, 200, noise=0.03, stated=False)
    posterior = fit(s.samples, seed=1, shared=False, rule=QUICK)
    relative, absolute = (posterior.flat()[:, posterior.names.index(f"noise.{n}")] for n in ("relative", "absolute"))
    middle = float(np.median(s.samples.f_r))
    noise = np.hypot(relative, absolute / middle)
    assert abs(noise.mean() - (0.03 + 1e-4 / middle)) < 4 * noise.std()
    assert noise.std() < 0.004
    assert posterior.diagnostics["noise"] == "inferred"
    assert max(abs(p) for n, p in pulls(posterior, s.truth).items() if n != "lambertian.albedo") < 4.5


def test_a_wrong_model_is_flagged_and_its_interval_not_absurdly_narrow():
    """Beckmann data fitted by GGX: chi2/N says so, and a discrepancy is inferred instead of a 0.1 % band."""
    s = scan(4, 200, lobe="beckmann")
    posterior = fit(s.samples, seed=1, rule=QUICK)
    assert posterior.diagnostics["chi2_per_n"] > 3
    assert posterior.diagnostics["chi2_per_n_with_discrepancy"] == pytest.approx(1.0, abs=0.5)
    assert "noise.discrepancy" in posterior.names
    assert "does not describe the data" in posterior.diagnostics["advice"][0]
    trusting = fit(s.samples, seed=1, rule=QUICK, discrepancy=False)
    assert posterior.summary()["ggx.alpha"]["sd"] > 2 * trusting.summary()["ggx.alpha"]["sd"]


def test_one_seed_gives_the_same_bytes():
    s = scan(5, 40).samples
    rule = Rule(ensembles=2, taus=2, drift=10.0, first=100, max_steps=300)
    one, two = fit(s, seed=9, rule=rule), fit(s, seed=9, rule=rule)
    assert one.draws.tobytes() == two.draws.tobytes()
    assert one.diagnostics == two.diagnostics
    assert one.draws.tobytes() != fit(s, seed=10, rule=rule).draws.tobytes()


def test_a_fit_goes_on_from_its_file(tmp_path):
    """Chains that stopped at 200 steps, saved, loaded and resumed to 400: the bytes of a fit of 400."""
    s = scan(5, 40).samples
    short, long = (Rule(ensembles=2, taus=1e6, first=100, max_steps=steps) for steps in (200, 400))
    half = fit(s, seed=9, chain=True, rule=short)
    assert not half.converged
    half.save(tmp_path / "posterior.nc")
    loaded = Posterior.load(tmp_path / "posterior.nc")
    both = fit(s, seed=9, chain=True, rule=long, resume=loaded)
    whole = fit(s, seed=9, chain=True, rule=long)
    assert both.draws.tobytes() == whole.draws.tobytes()
    assert both.diagnostics == whole.diagnostics
    with pytest.raises(DatasetError, match="cannot go on: they are of other samples"):
        fit(s, seed=8, chain=True, rule=long, resume=loaded)
    with pytest.raises(DatasetError, match="cannot go on: they have converged"):
        fit(s, seed=9, rule=long, resume=fit(s, seed=9, shared=False))


def test_stray_readings_pull_gauss_and_not_student():
    """One reading in 20 is 30 % too high: Gauss's albedo is off by many sd, that of t with 4 degrees of freedom is not."""
    s = scan(6, 120)
    stray = np.arange(120) % 20 == 0
    spoiled = replace(s.samples, f_r=np.where(stray, 1.3 * s.samples.f_r, s.samples.f_r))
    gauss = fit(spoiled, seed=1, discrepancy=False)
    student = fit(spoiled, seed=1, student=4.0)
    assert max(abs(p) for p in pulls(gauss, s.truth).values()) > 4.0
    assert max(abs(p) for p in pulls(student, s.truth).values()) < 3.5
    assert set(np.flatnonzero(stray)) <= set(student.diagnostics["outliers"])
    assert "Student's t gives them little weight" in " ".join(student.diagnostics["advice"])
    with pytest.raises(ParameterError, match=r"student = 0.5 degrees of freedom"):
        fit(spoiled, student=0.5)


def test_threads_change_no_number():
    s = scan(5, 40).samples
    one, two = (fit(s, seed=9, threads=threads, rule=Rule(effective=400)) for threads in (1, 2))
    assert one.draws.tobytes() == two.draws.tobytes()
    assert one.diagnostics == two.diagnostics


def test_a_common_factor_of_the_uncertainties_is_inferred():
    """Uncertainties stated at half their size: noise.scale = 2, with the relative error 1 / sqrt(2 N)."""
    s = scan(7, 300).samples
    quiet = replace(s, u_f_r=0.5 * s.u_f_r, shared=tuple(replace(e, u_sample=0.0) for e in s.shared))
    posterior = fit(quiet, seed=1, free=["noise.scale"])
    assert posterior.diagnostics["marginalised"] == ["lambertian.albedo", "ggx.f_0", "noise.scale"]
    scale = posterior.summary()["noise.scale"]
    assert scale["sd"] == pytest.approx(scale["mean"] / math.sqrt(600), rel=0.1)
    assert abs(scale["mean"] - 2.0) < 0.5  # the encoder's errors are in the scatter as well
    assert "noise.scale" in " ".join(posterior.diagnostics["advice"])


def test_more_samples_than_asked_for_are_cut_and_said():
    theta = np.linspace(0.0, 1.2, 300)
    s = BRDFSamples.plain(theta, 0.0, 0.3, 2.0, np.full(300, 0.2), 0.01)
    posterior = fit(s, "lambertian", seed=1, rule=QUICK, max_samples=100)
    assert (posterior.diagnostics["n_samples"], posterior.diagnostics["n_samples_given"]) == (100, 300)
    assert "a random 100 of 300 samples" in " ".join(posterior.diagnostics["advice"])


def test_a_seed_or_a_length_that_makes_no_sense_is_refused():
    s = BRDFSamples.plain([0.3], [0.0], [0.5], [3.0], [0.2], [0.01])
    with pytest.raises(ParameterError, match="seed = -1"):
        fit(s, "lambertian", seed=-1)
    with pytest.raises(ParameterError, match="max_steps = 0"):
        fit(s, "lambertian", max_steps=0)


@pytest.mark.gate
def test_coverage_of_200_scans():
    """95 % intervals of all parameters, nuisance ones too, over 200 scans of materials drawn at random."""
    inside = []
    for seed in range(200):
        rng = np.random.default_rng(10_000 + seed)
        truth = (rng.uniform(0.1, 0.9), math.exp(rng.uniform(-2.5, -0.5)), rng.uniform(0.03, 0.5))
        s = scan(seed, 60, truth)
        q = fit(s.samples, seed=seed, rule=Rule(ensembles=2, taus=15, drift=0.3)).summary()
        inside.append([q[n]["q025"] <= v <= q[n]["q975"] for n, v in s.truth.items()])
    coverage = np.mean(inside, axis=0)
    print(dict(zip(s.truth, coverage, strict=True)))
    assert np.all((coverage >= 0.91) & (coverage <= 0.985)), coverage
