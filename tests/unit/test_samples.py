"""Runs of one sample, put back between them."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from fitting import fit
from gonio.cli.main import main
from gonio.errors import DatasetError
from gonio.posterior import Posterior
from gonio.samples import BRDFSamples, SharedError, together

U = {"scale": 0.02, "drift": 0.003}


def paper(mount=0.0, scale=0.0, n=30, albedo=0.5, u=0.001):
    """A Lambertian surface with shared errors of scale and drift, noise-free."""
    theta = np.linspace(0.1, 1.2, n)
    f = np.full(n, albedo / math.pi * math.exp(scale + mount))
    plain = BRDFSamples.plain(theta, 0.0, 0.3, 2.0, f, u * albedo / math.pi)
    none = np.zeros((n, 3, 2))
    d_ln_f = np.column_stack((np.ones(n), np.linspace(-0.5, 0.5, n)))
    shared = tuple(SharedError(name, u) for name, u in U.items())
    return replace(plain, shared=shared, d_omega_i=none, d_omega_r=none, d_ln_f=d_ln_f)


def test_errors_of_the_rig_are_common_and_those_of_a_run_its_own():
    both = together([paper(n=3), paper(n=4)], 0.01)
    assert [e.name for e in both.shared] == ["scale", "drift_1", "mount_1", "drift_2", "mount_2"]
    assert len(both) == 7
    assert np.all(both.d_ln_f[:, 0] == 1.0)
    assert np.all((both.d_ln_f[:, 2] == 1.0) == (np.arange(7) < 3))
    assert np.all(both.d_ln_f[3:, 1] == 0.0) and both.d_ln_f[3, 3] == -0.5
    assert both.shared[2].u == 0.01


def test_the_mean_of_remounts_and_its_uncertainty():
    """Linear and Gaussian in ln f: with mount errors m_k of sd 1 % the albedo follows the mean of the runs, and its sd is
    that of scale and 1 % / sqrt(runs) together; one run alone would have been wrong by its whole m_k."""
    given = (0.012, -0.004, 0.001, 0.007)
    found = fit(together([paper(m) for m in given], 0.01), "lambertian", seed=1).summary()
    albedo = found["lambertian.albedo"]
    exact = 0.5 * math.hypot(U["scale"], 0.01 / math.sqrt(len(given)))
    assert albedo["sd"] == pytest.approx(exact, rel=0.06)
    assert albedo["mean"] == pytest.approx(0.5 * math.exp(np.mean(given)), abs=0.1 * exact)
    middle = np.mean(given)
    for k, m in enumerate(given, 1):  # each has pulled away from the mean by what it is, and the mean is unknown
        assert found[f"shared.mount_{k}"]["mean"] == pytest.approx(m - middle, abs=0.1 * 0.01)


def test_runs_of_different_calibrations_are_not_mixed():
    other = replace(paper(), shared=(SharedError("scale", 0.03), SharedError("drift", 0.003)))
    with pytest.raises(DatasetError, match=r"scale has an uncertainty of 0\.03 1 in run 2 and of 0\.02 in one before"):
        together([paper(), other], 0.01)
    with pytest.raises(DatasetError, match="u_mount = 0"):
        together([paper()], 0.0)


def test_runs_are_fitted_together_from_the_command_line(tmp_path):
    """Paper measured twice, the second time 2 % brighter."""
    for k, factor in enumerate((1.0, 1.02)):
        rows = "\n".join(f"{t},0,30,120,{0.5 / math.pi * factor},{0.0005}" for t in range(0, 70, 4))
        data = tmp_path / f"{k}.csv"
        data.write_text(f"theta_i_deg,phi_i_deg,theta_r_deg,phi_r_deg,f_r,u_f_r\n{rows}\n", encoding="utf-8")
        assert main(["import", str(data), "--quantity", "brdf", "--out", str(tmp_path / f"run{k}")]) == 0
    first, second = (str(tmp_path / f"run{k}") for k in (0, 1))
    assert main(["fit", first, "--with", second, "--mount", "0.01", "--model", "lambertian"]) == 0
    posterior = Posterior.load(tmp_path / "run0" / "posterior.nc")
    assert posterior.names == ("lambertian.albedo", "shared.mount_1", "shared.mount_2")
    albedo = posterior.summary()["lambertian.albedo"]
    assert albedo["mean"] == pytest.approx(0.505, abs=0.002)
    assert albedo["sd"] == pytest.approx(0.5 * 0.01 / math.sqrt(2), rel=0.1)
    assert main(["report", first]) == 0
