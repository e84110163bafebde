"""Radiance fields as sources: values, conventions, files, and what is refused."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import gonio
from gonio.errors import DatasetError, GeometryError, ParameterError
from gonio.fields import Harmonics
from gonio.geometry import unit_vector

make = gonio.source.make


def test_lobes_are_exponentials_of_the_cosine() -> None:
    lobes = make("lobes", amplitude=[1.0, 2.0], kappa=[10.0, 1e5], theta=[0.3, 1.2], phi=[0.0, 2.0])
    peak = unit_vector(1.2, 2.0)
    away = math.exp(10.0 * (float(unit_vector(0.3, 0.0) @ peak) - 1.0))
    assert float(lobes.radiance(peak)) == pytest.approx(2.0 + away, rel=1e-14)
    near = float(lobes.radiance(unit_vector(1.2 + 1e-3, 2.0)))  # 1e5 (cos 1e-3 - 1) = -0.05 + 4e-9
    assert near == pytest.approx(2.0 * math.exp(-0.05) + away, rel=1e-5)


@pytest.mark.parametrize("interpolation", ["bilinear", "smooth"])
def test_a_map_goes_through_its_samples_at_pixel_centres(interpolation: str) -> None:
    samples = np.random.default_rng(1).uniform(0.5, 1.0, (6, 12))
    theta, phi = (np.arange(6) + 0.5) * np.pi / 6, (np.arange(12) + 0.5) * np.pi / 6
    source = make("environment_map", radiance=samples, interpolation=interpolation)
    assert source.radiance(unit_vector(theta[:, None], phi[None, :])) == pytest.approx(samples, rel=1e-12)


def test_a_bilinear_map_between_samples_and_at_the_poles() -> None:
    samples = np.random.default_rng(2).uniform(0.0, 1.0, (4, 8))
    source = make("environment_map", radiance=samples)
    middle = source.radiance(unit_vector(2 * np.pi / 4, 0.0))  # between rows 1, 2 and, across the seam, columns 7, 0
    assert float(middle) == pytest.approx(samples[1:3, [7, 0]].mean(), rel=1e-12)
    above = source.radiance(unit_vector(0.01, 1.5 * np.pi / 4))  # column 1, beyond the first row: clamped
    assert float(above) == pytest.approx(samples[0, 1], rel=1e-12)


def test_a_smooth_map_is_continuous_across_the_pole() -> None:
    samples = np.random.default_rng(3).uniform(0.5, 1.0, (8, 16))
    source = make("environment_map", radiance=samples, interpolation="smooth")
    one, other = (float(source.radiance(unit_vector(1e-7, phi))) for phi in (0.4, 0.4 + np.pi))
    assert one == pytest.approx(other, abs=1e-5)


def test_harmonics_are_orthonormal_with_known_signs() -> None:
    x, w = np.polynomial.legendre.leggauss(20)
    phi = 2 * np.pi * np.arange(40) / 40
    w3 = unit_vector(np.arccos(x)[:, None], phi[None, :])
    constant = 10.0
    base = np.zeros(16)
    base[0] = constant
    values = []
    for k in range(16):
        c = base.copy()
        c[k] += 1.0
        values.append(make("spherical_harmonics", coefficients=c).radiance(w3) - constant / math.sqrt(4 * math.pi))
    gram = np.einsum("ktp,jtp,t->kj", np.array(values), np.array(values), w) * (2 * np.pi / 40)
    assert gram == pytest.approx(np.eye(16), abs=1e-12)
    assert values[3] == pytest.approx(math.sqrt(3 / (4 * math.pi)) * w3[..., 0], abs=1e-13)
    assert values[1] == pytest.approx(math.sqrt(3 / (4 * math.pi)) * w3[..., 1], abs=1e-13)
    assert values[2] == pytest.approx(math.sqrt(3 / (4 * math.pi)) * w3[..., 2], abs=1e-13)


def test_functions_add_to_sources() -> None:
    sky = make("uniform", radiance=1.0)
    for both in (sky + (lambda w: 1.0 + w[:, 2]), (lambda w: 1.0 + w[:, 2]) + sky):
        assert float(both.radiance([0.0, 0.0, 1.0])) == 3.0
    assert repr(sky + (lambda w: np.ones(len(w)))) == "uniform + function"


def test_a_lamp_at_a_distance_falls_with_its_square() -> None:
    lamp = gonio.source.point([0.0, 0.3, 0.4], intensity=2.0)
    beam = lamp.beam_at([0.0, 0.0, 0.0]).parts[0]
    assert isinstance(beam, gonio.source.Collimated)
    assert beam.direction == pytest.approx((0.0, 0.6, 0.8)) and beam.irradiance == pytest.approx(8.0)
    assert lamp.irradiance([0.0, 0.0, 0.0], [0.0, 0.0, 1.0]) == pytest.approx(6.4)
    assert lamp.irradiance([0.0, 0.0, 0.0], [0.0, 0.0, -1.0]) == 0.0
    with pytest.raises(GeometryError, match="distance"):
        lamp.beam_at([0.0, 0.3, 0.4])


def test_files_of_all_kinds(tmp_path: Path) -> None:
    import cv2

    colours = np.random.default_rng(4).uniform(0.1, 2.0, (4, 8, 3)).astype(np.float32)  # red, green, blue
    np.save(tmp_path / "sky.npy", colours[..., 0])
    cv2.imwrite(str(tmp_path / "sky.tiff"), colours[..., ::-1])
    cv2.imwrite(str(tmp_path / "sky.hdr"), colours[..., ::-1])
    red = colours[..., 0].astype(float)
    luminance = colours.astype(float) @ np.array([0.2126, 0.7152, 0.0722])
    theta, phi = (np.arange(4) + 0.5) * np.pi / 4, (np.arange(8) + 0.5) * np.pi / 4
    w = unit_vector(theta[:, None], phi[None, :])
    assert make("environment_map", radiance=str(tmp_path / "sky.npy")).radiance(w) == pytest.approx(red, rel=1e-12)
    tiff = make("environment_map", radiance=tmp_path / "sky.tiff")
    assert tiff.radiance(w) == pytest.approx(luminance, rel=1e-6)
    hdr = make("environment_map", radiance=tmp_path / "sky.hdr", channel="red")
    assert hdr.radiance(w) == pytest.approx(red, abs=0.02)  # 8 bits of mantissa, one exponent for three colours


def test_files_that_are_refused(tmp_path: Path) -> None:
    import cv2

    np.save(tmp_path / "objects.npy", np.array([[{"a": 1}]], dtype=object), allow_pickle=True)
    np.save(tmp_path / "line.npy", np.ones(5))
    cv2.imwrite(str(tmp_path / "photo.tiff"), np.full((4, 8), 200, dtype=np.uint8))
    (tmp_path / "noise.hdr").write_bytes(b"nothing")
    (tmp_path / "short.npy").write_bytes(b"\x93NUMPY")
    (tmp_path / "sky.exr").write_bytes(b"")
    for name, match in {
        "objects.npy": "readable", "line.npy": "shape", "photo.tiff": "display", "noise.hdr": "no image",
        "short.npy": "readable", "sky.exr": "OpenEXR", "missing.hdr": "no such file",
    }.items():  # fmt: skip
        with pytest.raises(DatasetError, match=match):
            make("environment_map", radiance=tmp_path / name)


@pytest.mark.parametrize(
    ("kind", "parameters", "match"),
    [
        ("lobes", {"amplitude": -1.0, "kappa": 1.0, "theta": 0.0, "phi": 0.0}, "negative"),
        ("lobes", {"amplitude": 1.0, "kappa": 2e5, "theta": 0.0, "phi": 0.0}, "kappa"),
        ("lobes", {"amplitude": math.nan, "kappa": 1.0, "theta": 0.0, "phi": 0.0}, "finite"),
        ("lobes", {"amplitude": 1.0, "kappa": 1.0, "theta": 4.0, "phi": 0.0}, "theta"),
        ("lobes", {"amplitude": [1.0, 2.0], "kappa": [1.0, 2.0, 3.0], "theta": 0.0, "phi": 0.0}, "together"),
        ("environment_map", {"radiance": [[1.0, math.nan]]}, "finite"),
        ("environment_map", {"radiance": [[1.0, -1.0]]}, "negative"),
        ("environment_map", {"radiance": [1.0, 2.0]}, "shape"),
        ("environment_map", {"radiance": np.ones((4, 8)), "interpolation": "cubic"}, "bilinear"),
        ("environment_map", {"radiance": np.ones((4, 7)), "interpolation": "smooth"}, "even"),
        ("spherical_harmonics", {"coefficients": [1.0, 2.0]}, "coefficients"),
        ("spherical_harmonics", {"coefficients": [1.0, 0.0, 3.0, 0.0]}, "negative"),
        ("spherical_harmonics", {"coefficients": [math.inf]}, "finite"),
        ("function", {"radiance": 3.0}, "called"),
        ("function", {"radiance": lambda w: np.ones(2)}, "shape"),
        ("function", {"radiance": lambda w: -np.ones(len(w))}, "must be finite"),
    ],
)
def test_what_is_no_radiance_is_told(kind: str, parameters: dict[str, object], match: str) -> None:
    with pytest.raises((ParameterError, GeometryError), match=match):
        make(kind, **parameters)


GOOD: dict[str, dict[str, object]] = {
    "collimated": {"theta": 0.3, "phi": 1.0, "irradiance": 1.0},
    "uniform": {"radiance": 1.0},
    "hemispherical": {"radiance": 1.0, "axis": (0.0, 0.0, 1.0)},
    "disk": {"theta": 0.3, "phi": 1.0, "half_angle": 0.1, "radiance": 1.0},
    "overcast": {"zenith_radiance": 1.0, "axis": (0.0, 0.0, 1.0)},
    "lobes": {"amplitude": 1.0, "kappa": 5.0, "theta": 0.3, "phi": 1.0},
    "spherical_harmonics": {"coefficients": [1.0]},
}


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf, -1.0, "bright", [[1.0, 2.0], [3.0]]], ids=str)
@pytest.mark.parametrize("kind", GOOD)
def test_no_parameter_of_a_source_takes_what_is_no_number(kind: str, bad: object) -> None:
    """NaN, infinite, negative, a text, a list of lists; the message has the parameter's name. Azimuths may be negative."""
    for name, value in GOOD[kind].items():
        if bad == -1.0 and name in ("phi", "axis"):
            continue
        given = bad if not isinstance(value, tuple | list) else [bad, *value[1:]]
        with pytest.raises((ParameterError, GeometryError), match=name.replace("coefficients", "coefficient|radiance")):
            make(kind, **{**GOOD[kind], name: given})


def test_a_function_that_turns_negative_later_is_told() -> None:
    paper = gonio.brdf.make("lambertian", albedo=0.5)
    with pytest.raises(ParameterError, match="must be finite"):
        gonio.reflectance_map(paper, lambda w: np.where(w[:, 0] * w[:, 1] > 0.4, -1.0, 1.0), 0.1, 0.2, rtol=1e-2)


@pytest.mark.parametrize("degree", [0, 1, 5, 30])
def test_turned_harmonics_are_the_same_light(degree: int) -> None:
    rng = np.random.default_rng(degree)
    light = Harmonics(rng.normal(size=(degree + 1) ** 2))
    turn, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    turn *= np.sign(np.linalg.det(turn))
    w = rng.normal(size=(300, 3))
    w /= np.linalg.norm(w, axis=1, keepdims=True)
    np.testing.assert_allclose(light.turned(turn).at(w @ turn.T), light.at(w), atol=1e-12 * np.abs(light.at(w)).max())


def test_harmonics_from_the_side_as_any_function() -> None:
    """The fast path of turned harmonics, and the slow one that knows nothing of them."""
    light = gonio.source.make("spherical_harmonics", coefficients=[3.5, 0.2, 0.5, -0.3, 0.1, 0.0, 0.2, 0.1, -0.1])
    paint = gonio.brdf.make("lambertian", albedo=0.5) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.4, f_0=0.04)
    p, q, viewer = np.array([0.1, -0.5, 0.3]), np.array([0.2, 0.4, -0.8]), (0.6, 2.0)
    fast = gonio.reflectance_map(paint, light, p, q, rtol=1e-7, viewer=viewer)
    slow = gonio.reflectance_map(paint, gonio.source.function(light.radiance), p, q, rtol=1e-5, viewer=viewer)
    np.testing.assert_allclose(fast.value, slow.value, rtol=2e-5)
    assert all("viewer off axis" not in step.reason for step in fast.plan)
