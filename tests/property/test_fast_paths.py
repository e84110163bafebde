"""The fast ways of the integrator against its general rule at random and at extreme scenes, and against themselves."""

from __future__ import annotations

import math

import numpy as np
import pytest

import gonio
from gonio.brdf.base import BRDF
from gonio.errors import IntegrationError
from gonio.geometry import normal_from_gradient
from gonio.integrate import MapValues, scene_radiance
from gonio.integrate.frames import Elements
from gonio.integrate.quadrature import Effort, integrate_cap
from gonio.source import Cap, Source
from tests.gates import record

make_source, make_brdf = gonio.source.make, gonio.brdf.make


def metal(alpha: float) -> BRDF:
    return make_brdf("ggx", k_s=1.0, alpha=alpha, f_0=0.04)


def best(brdf: BRDF, source: Source, p: np.ndarray, q: np.ndarray, rtol: float) -> MapValues:
    """The map, or what was reached where a tolerance is out of reach."""
    try:
        return gonio.reflectance_map(brdf, source, p, q, rtol=rtol)
    except IntegrationError as exc:
        assert isinstance(exc.best, MapValues)
        return exc.best


@pytest.mark.parametrize("half_angle_deg", [1e-4, 0.25, 5.0, 15.0])
@pytest.mark.parametrize("alpha", [0.3, 0.02, 1e-3])
@pytest.mark.parametrize("rtol", [1e-3, 1e-6])
def test_disks_near_terminator_and_mirror(half_angle_deg: float, alpha: float, rtol: float) -> None:
    """Rationale: a disk's map has three rules (whole, cut, near the lobe); their seams are where one could be wrong."""
    rng = np.random.default_rng(11)
    delta = math.radians(half_angle_deg)
    disk = make_source("disk", theta=0.7, phi=0.4, half_angle=delta, radiance=1.0)
    (part,) = disk.parts
    assert isinstance(part, Cap)
    x, y, z = part.axis
    p, q = rng.normal(size=(2, 120))
    p[:40] = -x / (1.0 + z) + (delta + alpha) * rng.normal(size=40)  # the mirror direction on the disk or next to it
    q[:40] = -y / (1.0 + z) + (delta + alpha) * rng.normal(size=40)
    cut = rng.uniform(-1.2, 1.2, 50) * delta * np.sqrt(1.0 + q[40:90] ** 2)
    p[40:90] = (z - q[40:90] * y - cut) / x  # the horizon through the disk
    got = best(metal(alpha), disk, p, q, rtol)
    truth = scene_radiance(metal(alpha), disk, *normal_from_gradient(p, q), form="viewer", rtol=1e-11)
    off = np.abs(got.value - truth.value)
    assert np.all(off <= got.error + truth.error)
    assert np.all((got.error <= rtol * got.value * (1 + 1e-9)) | (got.value == 0.0) | (half_angle_deg < 0.01))
    assert np.all((got.value > 0.0) | (truth.value <= truth.error))


def understated(value: np.ndarray, error: np.ndarray, truth: np.ndarray, doubt: np.ndarray) -> list[tuple[int, str]]:
    """Which values err by more than they say, and by how much."""
    off = np.abs(value - truth)
    return [(int(k), f"{off[k]:.1e} off, not {error[k]:.1e},") for k in np.flatnonzero(off > error + doubt)]


def random_caps(rounds: int, seed: int) -> tuple[int, list[str]]:
    """How many values were checked, and which of them err by more than they say.

    alpha from 1e-4 to 1, views to 1e-6 rad of grazing, caps of any size and axis, at 1e-3, 1e-6 and 1e-9, against 1e-13.
    """
    rng = np.random.default_rng(seed)
    checked, wrong = 0, []
    for _ in range(rounds):
        alpha = 10 ** rng.uniform(-4, 0)
        axis = rng.normal(size=3)
        source = [
            make_source("uniform", radiance=1.0),
            make_source("hemispherical", radiance=1.0, axis=axis),
            make_source("overcast", zenith_radiance=1.0, axis=axis),
            make_source("disk", theta=rng.uniform(0, 2), phi=1.0, half_angle=10 ** rng.uniform(-5, 0.19), radiance=1.0),
        ][rng.integers(4)]
        (cap,) = source.parts
        assert isinstance(cap, Cap)
        theta, phi = np.arccos(rng.uniform(0, 1, 20)), rng.uniform(0, 2 * np.pi, 20)
        theta[:3] = np.pi / 2 - 10 ** rng.uniform(-6, -1, 3)
        elements = Elements.from_polar(theta, phi)
        term = metal(alpha).terms[0]
        effort = Effort()
        truth, doubt = integrate_cap(term, cap, elements, rtol=1e-13, atol=0.0, about_normal=None, effort=effort)
        for rtol in (1e-3, 1e-6, 1e-9):
            value, error = integrate_cap(term, cap, elements, rtol=rtol, atol=0.0, about_normal=None, effort=effort)
            assert np.all(np.isfinite(value)) and np.all(value >= 0.0)
            assert np.all((value > 0.0) | (truth <= doubt))
            checked += len(value)
            wrong += [
                f"{text} at {rtol:g}: alpha {alpha!r}, {cap}, normal {theta[k]!r}, {phi[k]!r}"
                for k, text in understated(value, error, truth, doubt)
            ]
    return checked, wrong


def test_random_caps_have_honest_errors() -> None:
    checked, wrong = random_caps(40, seed=12)
    assert checked == 2400 and not wrong, "\n".join(wrong)


@pytest.mark.gate
def test_a_hundred_thousand_caps_have_honest_errors() -> None:
    checked, wrong = random_caps(1700, seed=13)
    print("\n".join(wrong))
    record(
        "honest errors under caps",
        f"{len(wrong)} of {checked} values understated",
        "0 of 10^5: the reported error covers the difference from the same rule at 1e-13",
        "13",
        "pytest -m gate tests/property/test_fast_paths.py -s",
    )
    assert checked >= 100_000 and not wrong


def random_surface(rng: np.random.Generator) -> BRDF:
    """One term, of the models whose lobes, layers and kinks are laid out in different ways."""
    alpha = 10 ** rng.uniform(-3, 0)
    return [
        lambda: make_brdf("phong", k_s=1.0, n=10 ** rng.uniform(-0.3, 4)),
        lambda: make_brdf("oren_nayar", albedo=0.8, sigma=rng.uniform(0, 1)),
        lambda: make_brdf("beckmann", k_s=1.0, alpha=alpha, f_0=0.1),
        lambda: make_brdf("ward", k_s=0.5, alpha=max(alpha, 1e-2)),
        lambda: make_brdf("abg", A=1e-3, B=10 ** rng.uniform(-4, -1), g=rng.uniform(1, 2.5)),
        lambda: make_brdf("minnaert", albedo=0.5, k=rng.uniform(0.5, 2)),
        lambda: make_brdf("plastic", albedo=0.6, n=1.5),
        lambda: metal(alpha),
        lambda: metal(alpha),
        lambda: metal(alpha),
    ][rng.integers(10)]()


def random_tables(rounds: int, seed: int) -> tuple[int, list[str]]:
    """How many values read from tables in theta_n were checked, and which of them err by more than they say.

    Lights symmetric about the view axis, before or behind the viewer, of any size; slopes evenly and logarithmically.
    """
    rng = np.random.default_rng(seed)
    checked, wrong = 0, []
    for _ in range(rounds):
        brdf, axis = random_surface(rng), (0.0, 0.0, float(rng.choice([-1, 1])))
        theta, half_angle = 0.0 if axis[2] > 0.0 else math.pi, 10 ** rng.uniform(-2, 0.19)
        source = [
            make_source("uniform", radiance=1.0),
            make_source("hemispherical", radiance=1.0, axis=axis),
            make_source("overcast", zenith_radiance=1.0, axis=axis),
            make_source("disk", theta=theta, phi=0.0, half_angle=half_angle, radiance=1.0),
        ][rng.integers(4)]
        (cap,) = source.parts
        assert isinstance(cap, Cap)
        rtol, steepest = float(rng.choice([1e-3, 1e-5, 1e-6, 1e-7])), float(rng.choice([0.1, 0.3, 3.0, 10.0]))
        p = steepest * np.concatenate((rng.uniform(0, 1, 60), 10 ** rng.uniform(-3, 0, 60)))
        got = best(brdf, source, p, np.zeros(1), rtol)
        some = rng.choice(120, 12, replace=False)
        elements = Elements.from_polar(np.arctan(p[some]), np.full(12, np.pi))
        truth, doubt = integrate_cap(
            brdf.terms[0], cap, elements, rtol=1e-12, atol=1e-26, about_normal=None, effort=Effort()
        )
        checked += len(some)
        wrong += [
            f"{text} at {rtol:g}: {brdf}, {cap}, p = {p[some][k]!r}"
            for k, text in understated(got.value[some], got.error[some], truth, doubt)
        ]
    return checked, wrong


def test_random_tables_have_honest_errors() -> None:
    checked, wrong = random_tables(12, seed=14)
    assert checked == 144 and not wrong, "\n".join(wrong)


@pytest.mark.gate
def test_many_tables_have_honest_errors() -> None:
    checked, wrong = random_tables(600, seed=15)
    print("\n".join(wrong))
    record(
        "honest errors of tables in theta_n",
        f"{len(wrong)} of {checked} values of 600 maps understated",
        "0: the reported error covers the difference from the general rule at 1e-12",
        "15",
        "pytest -m gate tests/property/test_fast_paths.py -s -k tables",
    )
    assert not wrong


def test_results_do_not_depend_on_threads() -> None:
    axis = np.linspace(-3.0, 3.0, 200)
    brdf = make_brdf("lambertian", albedo=0.5) + metal(0.05)
    for source in (
        make_source("hemispherical", radiance=1.0),
        make_source("disk", theta=0.7, phi=0.4, half_angle=0.02, radiance=1.0),
        make_source("collimated", theta=0.7, phi=0.4, irradiance=1.0),
    ):
        one, two = (gonio.reflectance_map(brdf, source, axis[None, :], axis[:, None], threads=count) for count in (1, 2))
        assert np.array_equal(one.value, two.value) and np.array_equal(one.error, two.error)


def test_steep_gradients_reach_the_limit() -> None:
    """As p grows the map tends to its value at the limb, which an infinite component gives; single and in a table."""
    steep = np.concatenate((np.full(40, 0.3), 10.0 ** np.linspace(2, 16, 60), [1e150, np.inf]))
    for name in ("uniform", "hemispherical"):
        source = make_source(name, radiance=1.0)
        table = gonio.reflectance_map(metal(0.2), source, steep, 0.0, rtol=1e-4)
        single = gonio.reflectance_map(metal(0.2), source, steep[-20:], 0.0, rtol=1e-6)
        assert np.all(np.abs(table.value[-20:] - single.value) <= table.error[-20:] + single.error)
        assert single.value[-1] > 0.0
        assert single.value[-1] == pytest.approx(float(single.value[-3]), rel=1e-5)


def test_gradients_of_any_shape() -> None:
    source = make_source("hemispherical", radiance=1.0)
    brdf = metal(0.3)
    p, q = np.random.default_rng(13).normal(size=(2, 6, 5, 4))
    whole = gonio.reflectance_map(brdf, source, p, q).value
    assert whole.shape == (6, 5, 4)
    flat = gonio.reflectance_map(brdf, source, p.ravel(), q.ravel()).value
    assert np.array_equal(whole.ravel(), flat)
    assert gonio.reflectance_map(brdf, source, np.empty(0), 0.0).value.shape == (0,)
    assert gonio.reflectance_map(brdf, source, np.empty((0, 3)), 0.0).value.shape == (0, 3)


@pytest.mark.parametrize("name", ["hemispherical", "overcast"])
def test_tails_of_a_lobe_keep_their_digits_in_a_table(name: str) -> None:
    """Beyond theta_n = 45 deg Phong's lobe sinks below the sky's rim and R falls by orders of magnitude within a piece."""
    phong = make_brdf("phong", k_s=1.0, n=50.0)
    source = make_source(name, **{"radiance" if name == "hemispherical" else "zenith_radiance": 1.0})
    p = np.linspace(0.0, 4.0, 200)
    table = gonio.reflectance_map(phong, source, p, 0.0, rtol=1e-6)
    few = gonio.reflectance_map(phong, source, p[::10], 0.0, rtol=1e-9)
    assert np.min(few.value) < 1e-10 * np.max(few.value)
    assert np.all(np.abs(table.value[::10] - few.value) <= table.error[::10] + few.error)
    assert np.all(table.error <= 1e-6 * table.value * (1 + 1e-9))


def test_single_gradients_and_grids_take_the_same_cosines() -> None:
    """The loop that vectorises and the one for slopes of an unusual size, 0 and infinity among them, meet."""
    brdf, beam = metal(0.3), make_source("collimated", theta=0.4, phi=1.0, irradiance=1.0)
    slopes = np.array([0.0, 1e-300, 1e-99, 1e-101, 0.3, 1e99, 1e101, 1e150, np.inf])
    got = gonio.reflectance_map(brdf, beam, slopes, 0.5).value
    flat, steep = (gonio.reflectance_map(brdf, beam, s, 0.5).value for s in (0.0, 1e12))
    assert got[:4] == pytest.approx(np.full(4, float(flat)), rel=1e-13)
    assert got[5:] == pytest.approx(np.full(4, float(steep)), abs=1e-9)
