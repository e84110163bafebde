"""Do intervals of parameters and of R(p, q) hold the truth as often as they say, and what are the shared errors for?

Rationale: a rig's scale and axis zeros are off by one unknown amount in a whole measurement. Each set draws them, an encoder
error in every pose, the noise and the material; its samples come from rotation matrices and formulas in NumPy, which share
nothing with the likelihood. Expected: 68 % and 95 % of the intervals hold the truth, and far fewer if the same sets are
fitted as if nothing was shared.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from fitting import Rule, fit
from tests.gates import record
from tests.measurements import SHARED, measure
from tests.unit.test_fitting_recovery import material

OWN = ("lambertian.albedo", "ggx.alpha", "ggx.f_0")
LIGHT = np.array([math.sin(0.5) * math.cos(0.7), math.sin(0.5) * math.sin(0.7), math.cos(0.5)])
# the one that faces the bisector of light and viewer, where the lobe peaks, and nine around it, lit and seen
GRADIENTS = np.array([
    (-0.20, -0.16), (0.0, 0.0), (-0.4, -0.3), (-0.1, -0.3), (-0.3, 0.0), (-0.8, -0.6), (0.4, 0.0), (0.0, 0.5), (-1.0, 0.3),
    (0.3, -0.9),
])  # fmt: skip


def reflectances(albedo, alpha, f_0):
    """R(p, q) for an irradiance of 1 across the light [1/sr]: f_r cos theta_i at each of `GRADIENTS`."""
    out = []
    for p, q in GRADIENTS:
        normal = np.array([-p, -q, 1.0]) / math.sqrt(1.0 + p * p + q * q)
        x = np.cross([0.0, 1.0, 0.0], normal)
        frame = np.array([x / np.linalg.norm(x), np.cross(normal, x / np.linalg.norm(x)), normal])
        wi, wr = (frame @ LIGHT)[None], (frame @ np.array([0.0, 0.0, 1.0]))[None]
        out.append(material(wi, wr, albedo, alpha, f_0) * wi[0, 2])
    return np.stack(out, axis=-1)


def drawn(seed, n=80):
    """A measurement, and its truth."""
    rng = np.random.default_rng([seed, 95])
    truth = (rng.uniform(0.1, 0.9), math.exp(rng.uniform(-2.5, -0.5)), rng.uniform(0.03, 0.6))
    samples, errors = measure(
        rng, lambda wi, wr: material(wi, wr, *truth), n, lambda wi, wr: 0.01 * material(wi, wr, *truth) + 1e-4
    )
    return samples, dict(zip(OWN, truth, strict=True)) | errors


def held(seed, shared):
    """For all parameters, then R at the gradients: is the truth in the 68 % interval, in the 95 % one (k, 2); converged."""
    samples, truth = drawn(seed)
    posterior = fit(samples, "lambertian+ggx", seed=seed, shared=shared, rule=Rule(effective=2000, max_steps=4000))
    names = (*OWN, *SHARED) if shared else OWN
    draws = posterior.flat()[:, [posterior.names.index(name) for name in names]]
    values = np.concatenate((draws, reflectances(*draws[:, :3].T)), axis=1)
    true = np.concatenate(([truth[name] for name in names], reflectances(*(truth[name] for name in OWN)).ravel()))
    low95, low68, high68, high95 = np.quantile(values, [0.025, 0.16, 0.84, 0.975], axis=0)
    inside = np.stack(((low68 <= true) & (true <= high68), (low95 <= true) & (true <= high95)), axis=-1)
    return inside, posterior.converged


def coverage(seeds, shared):
    found = [held(seed, shared) for seed in seeds]
    return np.mean([inside for inside, _ in found], axis=0), sum(not converged for _, converged in found)


def test_a_slice():
    """6 sets of 17 quantities: 95 % of the intervals hold the truth give or take; the errors of one set go together."""
    share, _ = coverage(range(6), True)
    assert share[:, 1].mean() > 0.8
    assert 0.4 < share[:, 0].mean() < 0.95


@pytest.mark.gate
@pytest.mark.parametrize("shared", [True, False], ids=["shared", "nothing-shared"])
def test_coverage_of_1000_measurements(shared):
    share, lost = coverage(range(1000), shared)
    count = len(share) - len(GRADIENTS)
    names = (*OWN, *SHARED)[:count]
    each = ", ".join(f"{name} {a:.3f} and {b:.3f}" for name, (a, b) in zip(names, share[:count], strict=True))
    spans = [f"{share[count:, k].min():.3f} to {share[count:, k].max():.3f}" for k in (0, 1)]
    title = "1000 simulated measurements" if shared else "the same 1000 measurements, shared errors taken as 0"
    record(
        f"coverage of 68 % and 95 % intervals, {title}",
        f"{each}; R(p, q) at ten gradients {spans[0]} and {spans[1]}; {lost} not converged",
        "0.64 to 0.72 and 0.93 to 0.97, each" if shared else "below 0.64 and 0.93: what they are for",
        "0 to 999",
        f"pytest -m gate tests/closed_loop/test_fit_coverage.py -k {'1000 and not nothing' if shared else 'nothing'}",
    )
    if shared:
        assert np.all((share[:, 0] >= 0.64) & (share[:, 0] <= 0.72)), share
        assert np.all((share[:, 1] >= 0.93) & (share[:, 1] <= 0.97)), share
    else:
        assert share[0, 1] < 0.5, share
        assert np.all(share[count:, 1] < 0.93), share
