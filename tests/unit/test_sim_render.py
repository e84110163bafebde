"""Rendered images against an evaluation that shares no code with the simulator, and against the shared integrator."""

from __future__ import annotations

import dataclasses
import math

import numpy as np
import pytest

import gonio
from gonio import brdf
from gonio.errors import ConfigurationError
from gonio.integrate import scene_radiance
from sim.render import RTOL, Scene, radiance
from sim.world import rotation_x, rotation_y
from tests import gates
from tests.independent_rendering import pixel

EYE = np.array([0.0, 0.0, 600.0])
MATT, GLOSSY, SATIN = (0.8, 0.2, 0.0), (0.3, 0.05, 0.06), (0.5, 0.25, 0.06)
COMMAND = "pytest -m gate tests/unit/test_sim_render.py"


def scene(pose_deg, model=SATIN, **options):
    arm, pan, tilt = np.radians(pose_deg)
    albedo, alpha, f_0 = model
    material = brdf.make("lambertian", albedo=albedo)
    if f_0 > 0.0:
        material += brdf.make("microfacet", k_s=1, alpha=alpha, f_0=f_0, distribution="ggx")
    frame = rotation_y(float(pan)) @ rotation_x(float(tilt))
    return Scene(material, frame, rotation_y(float(arm))[:, 2] * 500.0, 1.0, **options)


def rays_to(targets):
    d = np.array([[x, y, -600.0] for x, y in targets])
    return d / np.linalg.norm(d, axis=1)[:, None]


def poses(count, seed):
    """Poses in which lamp and camera stand well above the specimen's horizon, every other one in or near its mirror."""
    rng = np.random.default_rng(seed)
    found = []
    while len(found) < count:
        arm, pan, tilt = rng.uniform([-90, -70, -40], [90, 70, 40])
        if len(found) % 2:
            pan, tilt = arm / 2 + pan / 20, tilt / 20
        cos_r = math.cos(math.radians(tilt)) * math.cos(math.radians(pan))
        cos_i = math.cos(math.radians(tilt)) * math.cos(math.radians(arm - pan))
        if min(cos_i, cos_r) > 0.2:
            found.append((arm, pan, tilt))
    return found


def worst(chosen, targets, n):
    """Largest relative difference over poses, three samples and pixels; globe of 6 mm, lens of 5 mm."""
    largest = 0.0
    for pose in chosen:
        for model, shape, radius in ((MATT, "flat", 25.0), (GLOSSY, "flat", 25.0), (SATIN, "sphere", 15.0)):
            seen = radiance(scene(pose, model, lamp_radius=6.0, shape=shape, radius=radius), EYE, rays_to(targets), 5.0)
            for target, value in zip(targets, seen, strict=True):
                expected = pixel(pose, target, shape=shape, radius=radius, model=model, globe=6.0, lens=5.0, n=n)
                if shape == "sphere" and not _all_lit(pose, target):
                    continue  # its terminator may cut the lamp
                largest = max(largest, abs(value / expected - 1))
    return largest


def _all_lit(pose, target):
    """Whether the lamp stands more than 5 degrees above the sphere's horizon there."""
    arm = math.radians(pose[0])
    normal = np.array([*target, math.sqrt(15.0**2 - target[0] ** 2 - target[1] ** 2)]) / 15.0
    return normal @ [math.sin(arm), 0.0, math.cos(arm)] > math.sin(math.radians(5))


def test_images_with_lamp_and_lens_at_a_few_poses():
    """Rationale: the whole chain of rays, near light, globe, lens and shapes. Expected: 0.1 % of a slow evaluation."""
    assert worst(poses(3, seed=1), [(1.0, -2.0)], n=(6, 14)) <= 1e-3


@pytest.mark.gate
def test_images_at_twenty_poses():
    largest = worst(poses(20, seed=0), [(0.0, 0.0), (3.0, -2.0), (-5.0, 4.0)], n=(8, 20))
    gates.record(
        "rendered radiance: Lambertian, glossy, spherical sample at 20 poses, globe 6 mm, lens 5 mm",
        f"largest difference {100 * largest:.1g} %",
        "<= 0.1 % of an evaluation over the globe's surface that shares no code",
        "0",
        COMMAND,
    )
    assert largest <= 1e-3


@pytest.mark.parametrize("shape", ["flat", "sphere"])
def test_a_point_lamp_and_a_pinhole_are_exact(shape):
    for pose in poses(5, seed=3):
        target = (2.0, -1.0)
        seen = radiance(scene(pose, GLOSSY, shape=shape, radius=20.0), EYE, rays_to([target]))[0]
        assert seen == pytest.approx(pixel(pose, target, shape=shape, radius=20.0, model=GLOSSY), rel=1e-9)


def test_a_globe_is_a_disk_of_the_shared_integrator():
    """Expected: `gonio.integrate.scene_radiance` of a disk of asin(R / d) and radiance I / (pi R^2)."""
    pose = (40.0, 10.0, 0.0)
    made = scene(pose, GLOSSY, lamp_radius=10.0)
    arm, pan, _ = np.radians(pose)
    disk = gonio.source.make(
        "disk", theta=arm, phi=0.0, half_angle=math.asin(10.0 / 500.0), radiance=1.0 / (math.pi * 0.01**2)
    )
    expected = scene_radiance(made.brdf, disk, pan, 0.0, rtol=1e-8).value
    assert radiance(made, EYE, rays_to([(0.0, 0.0)]))[0] == pytest.approx(float(expected), rel=2 * RTOL)


def test_finite_lamp_and_lens_lower_a_narrow_peak_as_expected():
    """Rationale: the peak's bias is -(a^2 / 8 alpha^2)(1 + sec^2 theta) per aperture of half angle a, while small."""
    alpha, a = 0.1, math.radians(0.5)
    mirror = (40.0, 20.0, 0.0)
    point, globe, lens = (
        radiance(scene(mirror, (0.0, alpha, 1.0), lamp_radius=r), EYE, rays_to([(0.0, 0.0)]), aperture)[0]
        for r, aperture in ((0.0, 0.0), (500 * math.sin(a), 0.0), (0.0, 600 * math.tan(a)))
    )
    bias = -(a**2) / (8 * alpha**2) * (1 + 1 / math.cos(math.radians(20)) ** 2)
    assert globe / point - 1 == pytest.approx(bias, rel=0.1)
    assert lens / point - 1 == pytest.approx(bias, rel=0.1)


def test_a_cylinder_is_lit_as_its_normal_says():
    """Expected at its ridge and at 3 mm beside it, pan 0: cos(theta_i) / d^2 of the place on x^2 + z^2 = R^2."""
    made = scene((30.0, 0.0, 0.0), (0.8, 0.1, 0.0), shape="cylinder", radius=10.0, half_length=20.0)
    lamp = made.lamp
    for x in (0.0, 3.0, -6.0):
        z = math.sqrt(100 - x * x)
        away = x * 600 / (600 - z)  # the ray that meets (x, 0, z) meets z = 0 there
        normal, to_lamp = np.array([x, 0, z]) / 10, lamp - [x, 0, z]
        d = np.linalg.norm(to_lamp)
        expected = 0.8 / math.pi * (normal @ to_lamp / d) / (d / 1000) ** 2
        assert radiance(made, EYE, rays_to([(away, 0.0)]))[0] == pytest.approx(expected, rel=1e-9)
    assert radiance(made, EYE, rays_to([(0.0, 21.0), (11.0, 0.0)])).tolist() == [0.0, 0.0]


def test_the_rim_blurs_out_of_focus_and_stays_sharp_in_it():
    """Expected at 60 degrees of tilt: the rim, 21.7 mm above the focus, blurs over 6 mm x 21.7 / 578 = 0.22 mm each way."""
    flat, tilted = (scene((0.0, 0.0, tilt), (0.8, 0.1, 0.0), radius=25.0) for tilt in (0.0, 60.0))
    height = 25.0 * math.sin(math.radians(60))
    rim = 12.5 * 600 / (600 - height)
    for made, edge, sharp in ((flat, 25.0, True), (tilted, rim, False)):
        seen = radiance(made, EYE, rays_to([(0.0, edge + dy) for dy in (-0.3, -0.1, 0.1, 0.3)]), 6.0)
        assert seen[0] > 0.0 and seen[3] == 0.0
        assert [0.02 < value / seen[0] < 0.98 for value in seen[1:3]] == [not sharp] * 2


def test_a_lamp_too_large_for_its_lobe_is_refused():
    made = dataclasses.replace(scene((40.0, 20.0, 0.0), (0.0, 0.002, 1.0)), lamp_radius=60.0)
    with pytest.raises(ConfigurationError, match="too large for so narrow a lobe"):
        radiance(made, EYE, rays_to([(0.0, 0.0), (1.0, 1.0)]))
