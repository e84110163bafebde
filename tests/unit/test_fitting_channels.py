"""Fits of several channels: one roughness, one albedo of each, against formulas and against fits of each alone."""

from __future__ import annotations

import math

import numpy as np
import pytest

from fitting import Rule, fit
from gonio.channels import RGB, ChannelSamples
from gonio.cli.main import main
from gonio.cli.steps import load_posterior, open_run
from gonio.errors import ParameterError
from gonio.posterior import Posterior
from gonio.samples import BRDFSamples
from tests.unit.test_fitting_likelihood import f_r_reference

ALBEDO, ALPHA, F_0 = (0.6, 0.3, 0.1), 0.25, (0.05, 0.06, 0.08)


def measured(n=80):
    rng = np.random.default_rng(3)
    theta_i = rng.uniform(0.0, 1.2, n)
    theta_r, phi = np.clip(theta_i + rng.normal(0, 0.3, n), 0.0, 1.3), math.pi + rng.normal(0, 0.4, n)
    plain = BRDFSamples.plain(theta_i, 0.0, theta_r, phi, np.ones(n), np.ones(n))
    wi, wr = plain.omega_i(), plain.omega_r()
    f = np.column_stack([f_r_reference(wi, wr, a, 1.0, ALPHA, f_0) for a, f_0 in zip(ALBEDO, F_0, strict=True)])
    u = 0.02 * f + 1e-3
    reading = f + rng.normal(0, u)
    reading[5, 1] = np.nan  # not measured in green
    return ChannelSamples.make(theta_i, np.zeros(n), theta_r, phi, reading, RGB, u)


def test_one_roughness_and_an_albedo_and_reflectance_of_each():
    samples = measured()
    both = fit(samples, seed=1)
    assert set(both.names) == {
        "ggx.alpha", *(f"{n}[{c}]" for n in ("lambertian.albedo", "ggx.f_0") for c in ("red", "green", "blue"))
    }
    assert both.diagnostics["n_samples"] == 239
    assert len(both.diagnostics["marginalised"]) == 6
    for c, albedo, f_0 in zip(RGB.names, ALBEDO, F_0, strict=True):
        one = both.channel(c)
        assert set(one.names) == {"lambertian.albedo", "ggx.alpha", "ggx.f_0"}
        for name, truth in (("lambertian.albedo", albedo), ("ggx.alpha", ALPHA), ("ggx.f_0", f_0)):
            s = one.summary()[name]
            assert abs(s["mean"] - truth) < 3.5 * s["sd"], (c, name)
        at = BRDFSamples.plain([0.3], 0.0, 0.3, math.pi, [1.0])
        expected = f_r_reference(at.omega_i(), at.omega_r(), albedo, 1.0, ALPHA, f_0)[0]
        assert float(one.brdf().f_r(0.3, 0.0, 0.3, math.pi)) == pytest.approx(expected, rel=0.05)
    alone = [fit(samples.channel(c), seed=1).summary()["ggx.alpha"] for c in RGB.names]
    together = sum(s["sd"] ** -2 for s in alone) ** -0.5
    mean = sum(s["mean"] / s["sd"] ** 2 for s in alone) * together**2
    assert both.summary()["ggx.alpha"]["sd"] == pytest.approx(together, rel=0.08)
    assert both.summary()["ggx.alpha"]["mean"] == pytest.approx(mean, abs=0.3 * together)


def test_a_tied_reflectance_is_one_number():
    both = fit(measured(), seed=1, tie=["ggx.f_0"], discrepancy=False, rule=Rule(effective=400))
    assert set(both.names) == {"ggx.alpha", "ggx.f_0", *(f"lambertian.albedo[{c}]" for c in RGB.names)}
    held = fit(measured(), seed=1, fix={"ggx.f_0": 0.05}, discrepancy=False, rule=Rule(effective=400))
    assert {held.fixed[f"ggx.f_0[{c}]"] for c in RGB.names} == {0.05}


def test_channels_of_an_imported_file_share_a_fit(tmp_path):
    """Paper in CSV: an albedo of each channel in one posterior, and the green one for whoever wants a material."""
    rng = np.random.default_rng(1)
    lines = ["theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r_red,f_r_green,f_r_blue"]
    for theta in range(5, 65, 3):
        f = [f"{a / math.pi * (1 + 0.01 * rng.normal()):.6f}" for a in ALBEDO]
        lines.append(f"{theta},0,30,180,{','.join(f)}")
    (tmp_path / "paper.csv").write_text("\n".join(lines) + "\n")
    given = [str(tmp_path / "paper.csv"), "--quantity", "brdf", "--out", str(tmp_path / "run")]
    assert main(["import", *given]) == 0
    assert main(["fit", str(tmp_path / "run"), "--model", "lambertian", "--channels"]) == 0
    posterior = Posterior.load(tmp_path / "run" / "posterior.nc")
    for channel, albedo in zip(RGB.names, ALBEDO, strict=True):
        s = posterior.channel(channel).summary()["lambertian.albedo"]
        assert abs(s["mean"] - albedo) < 4 * s["sd"]
    with open_run(tmp_path / "run") as opened:
        assert load_posterior(opened).brdf().parameters()["lambertian.albedo"] == pytest.approx(ALBEDO[1], rel=0.02)


def test_wrong_channels_and_ties_are_one_sentence(tmp_path):
    with pytest.raises(ParameterError, match=r"tie: 'ggx.f0' is no linear parameter .did you mean 'ggx.f_0'"):
        fit(measured(), tie=["ggx.f0"])
    with pytest.raises(ParameterError, match="the samples have one channel"):
        fit(measured().channel("red"), tie=["ggx.f_0"])
    posterior = fit(measured(), "lambertian", seed=1, discrepancy=False, rule=Rule(effective=400))
    posterior.save(tmp_path / "p.nc")
    assert Posterior.load(tmp_path / "p.nc").channel("green").names == ("lambertian.albedo",)
    with pytest.raises(ParameterError, match="no channel 'gren'; it has: red, green, blue"):
        posterior.channel("gren")
