"""The simulated world against the bench's geometry written out by hand, and the errors that it draws."""

from __future__ import annotations

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from gonio import kinematics
from gonio.errors import ConfigurationError, ParameterError
from sim.dynamixel import Servo
from sim.lamp import ScpiLamp
from sim.settings import AXES, Settings
from sim.simulation import Simulation
from sim.world import Truth, World

COUNT = 2 * math.pi / 4096


def bench(angles_deg=(0.0, 0.0, 0.0), lamp_on=True, drift=0.0, **truth):
    """A bench without errors whose joints stand at `angles_deg` (to the count's fraction, no play)."""
    drawn = Settings.from_mapping({"sim": {"truth": {"errors": False, "backlash_deg": 0.0, **truth}}})
    servos = {
        name: Servo(k, initial_counts=2048 + math.radians(a) / COUNT, backlash_counts=0.0)
        for k, (name, a) in enumerate(zip(AXES, angles_deg, strict=True), start=1)
    }
    lamp = ScpiLamp(drift_per_hour=drift)
    if lamp_on:
        lamp.feed(b"OUTP ON\n", 0.0)
    return World(drawn, Truth.draw(drawn), servos, lamp)


EYE = np.array([0.0, 0.0, 600.0])
DOWN = np.array([[0.0, 0.0, -1.0]])


def ray_to(x, y):
    """Unit vector from the eye to the point (x, y, 0), shape (1, 3)."""
    d = np.array([[x, y, -600.0]])
    return d / np.linalg.norm(d)


def radiance_by_hand(arm_deg, pan_deg, tilt_deg, x, y, albedo=0.5, alpha=0.2, f_0=0.06):
    """Radiance along one ray with 30 digits, from vectors in the bench's frame and no local frame at all.

    n is a closed form of R_y(pan) R_x(tilt) z; Lambert + GGX is isotropic, so only dot products enter.
    """
    with mpmath.workdps(30):
        mp = mpmath.mpf
        g, b, t = (mp(v) * mpmath.pi / 180 for v in (arm_deg, pan_deg, tilt_deg))
        dot = lambda u, v: u[0] * v[0] + u[1] * v[1] + u[2] * v[2]  # noqa: E731
        n = [mpmath.sin(b) * mpmath.cos(t), -mpmath.sin(t), mpmath.cos(b) * mpmath.cos(t)]
        lamp = [500 * mpmath.sin(g), mp(0), 500 * mpmath.cos(g)]
        eye, ray = [mp(0), mp(0), mp(600)], [mp(x), mp(y), mp(-600)]
        s = -dot(n, eye) / dot(n, ray)
        place = [e + s * r for e, r in zip(eye, ray, strict=True)]
        to_lamp = [a - c for a, c in zip(lamp, place, strict=True)]
        to_eye = [a - c for a, c in zip(eye, place, strict=True)]
        d, back = mpmath.sqrt(dot(to_lamp, to_lamp)), mpmath.sqrt(dot(to_eye, to_eye))
        wi, wr = [c / d for c in to_lamp], [c / back for c in to_eye]
        ci, cr = dot(n, wi), dot(n, wr)
        if ci <= 0 or cr <= 0 or dot(place, place) > 25**2:
            return 0.0
        h = [p + q for p, q in zip(wi, wr, strict=True)]
        length = mpmath.sqrt(dot(h, h))
        ch, chr_ = dot(n, h) / length, dot(wr, h) / length
        a2 = mp(alpha) ** 2
        distribution = a2 / (mpmath.pi * (ch**2 * (a2 - 1) + 1) ** 2)
        smith = lambda c: (mpmath.sqrt(1 + a2 * (1 - c**2) / c**2) - 1) / 2  # noqa: E731
        shadow = 1 / (1 + smith(ci) + smith(cr))
        fresnel = f_0 + (1 - mp(f_0)) * (1 - chr_) ** 5
        f_r = mp(albedo) / mpmath.pi + distribution * shadow * fresnel / (4 * ci * cr)
        return float(f_r * ci / (d / 1000) ** 2)  # I = 1 W/sr


@pytest.mark.parametrize(
    ("arm", "pan", "tilt"),
    [(30, 15, 0), (30, 15, 20), (-40, 10, -25), (75, 40, 5), (-60, -30, 0.5), (50, -20, 40), (8, 70, 10), (95, 60, 0)],
)
@pytest.mark.parametrize(("x", "y"), [(0.0, 0.0), (2.5, 0.0), (-1.0, 2.0), (7.0, -3.0)])
def test_radiance_of_one_ray_is_that_of_the_bench_written_out(arm, pan, tilt, x, y):
    """Rationale: perspective, near light, both rotations and both angles' signs must come out, off the centre too.

    Expected: agreement to rounding with a scalar evaluation that uses no matrix and no local frame.
    """
    expected = radiance_by_hand(arm, pan, tilt, x, y)
    seen = bench((arm, pan, tilt)).radiance(0.0, EYE, ray_to(x, y))[0]
    assert seen == pytest.approx(expected, rel=1e-10, abs=1e-300)


def test_the_mirror_direction_is_where_the_normal_halves_lamp_and_camera():
    """A glossy sample is brightest at pan = arm / 2 (up to the slope of the cosine, far weaker than its lobe)."""
    seen = {pan: bench((60.0, pan, 0.0), **{"ggx.alpha": 0.02}).radiance(0.0, EYE, DOWN)[0] for pan in (-30, 28, 30, 32)}
    assert max(seen, key=seen.get) == 30


@pytest.mark.parametrize(("arm", "pan", "tilt"), [(0, 0, 0), (45, 0, 0), (45, 0, 30), (60, 50, 0), (-20, 30, 10)])
def test_the_white_obeys_lambert_and_the_inverse_square(arm, pan, tilt):
    """Expected: L = beta / pi I cos(theta_i) / d^2, cos(theta_i) = n.l from the closed forms of n and l."""
    world = bench((arm, pan, tilt))
    world.mount("white")
    g, b, t = np.radians([arm, pan, tilt])
    cosine = math.sin(b) * math.cos(t) * math.sin(g) + math.cos(b) * math.cos(t) * math.cos(g)
    assert world.radiance(0.0, EYE, DOWN)[0] == pytest.approx(0.99 / math.pi * cosine / 0.5**2, rel=1e-12)


def test_no_light_from_behind_beside_the_dark_and_the_trap():
    assert bench((90.0, -10.0, 0.0)).radiance(0.0, EYE, DOWN)[0] == 0.0  # lamp behind the specimen
    assert bench((80.0, 95.0, 0.0)).radiance(0.0, EYE, ray_to(1.0, 0.0))[0] == 0.0  # camera behind it
    assert bench((30.0, 0.0, 0.0)).radiance(0.0, EYE, ray_to(25.1, 0.0))[0] == 0.0  # past the rim
    assert bench((30.0, 0.0, 0.0)).radiance(0.0, EYE, ray_to(24.9, 0.0))[0] > 0.0
    assert bench((30.0, 0.0, 0.0)).radiance(0.0, EYE, -DOWN)[0] == 0.0  # looking up
    assert bench((30.0, 0.0, 0.0), lamp_on=False).radiance(0.0, EYE, DOWN)[0] == 0.0
    world = bench((30.0, 0.0, 0.0))
    world.mount("trap")
    assert world.radiance(0.0, EYE, DOWN)[0] == 0.0
    with pytest.raises(ConfigurationError, match="no specimen 'mirror'"):
        world.mount("mirror")


def test_light_follows_the_lamp():
    world = bench((30.0, 0.0, 0.0), drift=-0.1)
    start, later = (world.radiance(t, EYE, DOWN)[0] for t in (0.0, 1800.0))
    assert later / start == pytest.approx(0.95, rel=1e-12)


@pytest.mark.parametrize("direction", [1, -1])
@pytest.mark.parametrize(("approach", "sign"), [("up", 1), ("down", -1)])
def test_after_the_usual_approach_only_the_zero_error_remains(direction, approach, sign):
    """Rationale: the zero was set with that approach, so half of the play is part of it.

    Expected: true minus encoder angle is the zero error then, and differs by the play after the other approach.
    """
    config = {
        "axes": {"pan": {"direction": direction, "approach": approach}},
        "sim": {"truth": {"errors": False, "zero_deg": {"pan": 0.3}, "backlash_deg": 0.25}},
    }
    stated = Settings.from_mapping(config)
    truth = Truth.draw(stated)
    servos = {name: Servo(k, backlash_counts=truth.backlash / COUNT) for k, name in enumerate(AXES, start=1)}
    world = World(stated, truth, servos, ScpiLamp())
    pan = servos["pan"]
    pan.write(64, b"\x01", 0.0)
    found = {}
    for t, away, name in ((0.0, -1, "up"), (20.0, +1, "down")):  # first away from the goal, then onto it
        start = 2048 + direction * (100 + 200 * away)
        for moment, goal in ((t, start), (t + 10.0, 2048 + direction * 100)):
            pan.write(116, goal.to_bytes(4, "little"), moment)
        encoder = direction * (pan.shaft_counts(t + 20.0) - 2048) * COUNT
        found[name] = math.degrees(world.angles(t + 20.0)["pan"] - encoder)
    other = "down" if approach == "up" else "up"
    assert found[approach] == pytest.approx(0.3, abs=1e-9)
    assert found[other] == pytest.approx(0.3 + sign * 0.25, abs=1e-9)


def test_errors_are_drawn_as_the_rig_file_states_them():
    """Expected over 2000 seeds: standard normal within four standard errors, axes independent."""
    config = {"axes": {"tilt": {"u_zero_deg": 0.4}}, "white": {"beta": 0.8, "u_beta": 0.02}}
    drawn = [Truth.draw(Settings.from_mapping({**config, "sim": {"seed": seed}})) for seed in range(2000)]
    z = np.array(
        [
            [np.degrees(t.zero_errors["arm"]) / 0.1, np.degrees(t.zero_errors["pan"]) / 0.1,
             np.degrees(t.zero_errors["tilt"]) / 0.4, (t.white_beta / 0.8 - 1) / 0.02]
            for t in drawn
        ]
    )  # fmt: skip
    assert np.all(np.abs(z.mean(axis=0)) < 4 / math.sqrt(2000))
    assert np.all(np.abs(z.var(axis=0) - 1) < 4 * math.sqrt(2 / 2000))
    assert np.all(np.abs(np.corrcoef(z.T) - np.eye(4)) < 4 / math.sqrt(2000))


def test_truth_is_the_same_for_the_same_seed_and_can_be_told():
    stated = Settings.from_mapping({"sim": {"seed": 7}})
    assert Truth.draw(stated) == Truth.draw(stated)
    told = Truth.draw(stated).as_dict()
    assert told["parameters"] == {"lambertian.albedo": 0.5, "ggx.k_s": 1.0, "ggx.alpha": 0.2, "ggx.f_0": 0.06}
    assert Truth.draw(stated).sample_brdf().parameters() == told["parameters"]


@pytest.mark.parametrize(
    "written", [{"ggx.alpha": 0.11}, {"ggx": {"alpha": 0.11}}, {"parameters": {"ggx.alpha": 0.11}}], ids=repr
)
def test_parameters_may_be_written_in_three_ways(written):
    truth = Truth.draw(Settings.from_mapping({"sim": {"truth": written}}))
    assert truth.parameters["ggx.alpha"] == 0.11
    assert truth.parameters["lambertian.albedo"] == 0.5


@pytest.mark.parametrize(
    ("truth", "error", "message"),
    [
        ({"backlash": 0.1}, ConfigurationError, "did you mean 'backlash_deg'"),
        ({"ggx.alhpa": 0.1}, ParameterError, "ggx has no parameter 'alhpa'"),
        ({"ggx.alpha": 3.0}, ParameterError, r"alpha = 3 is outside"),
        ({"model": "lambertian", "parameters": {"ggx.alpha": 0.1}}, ConfigurationError, "no term of the model"),
        ({"errors": 1}, ConfigurationError, "true or false"),
        ({"zero_deg": {"spin": 1.0}}, ConfigurationError, "known are arm, pan, tilt"),
        ({"friction_counts": [0.2]}, ConfigurationError, "2 numbers"),
        ({"veiling_glare": float("nan")}, ConfigurationError, "veiling_glare = nan is outside"),
    ],
)
def test_what_cannot_be_true_is_refused(truth, error, message):
    with pytest.raises(error, match=message):
        Truth.draw(Settings.from_mapping({"sim": {"truth": truth}}))


@settings(max_examples=60, deadline=None, derandomize=True)
@given(st.floats(-100, 100), st.floats(-80, 80), st.floats(-45, 45))
def test_two_independent_kinematics_agree(arm, pan, tilt):
    """Rationale: the world composes matrices of its own; were a sign wrong in either, a scan would measure another BRDF.

    Expected: the radiance at the centre is f_r cos(theta_i) I / d^2 at the angles of `gonio.kinematics`.
    """
    theta_i, phi_i, theta_r, phi_r = kinematics.four_angles(*np.radians([arm, pan, tilt]))
    world = bench((arm, pan, tilt))
    f_r = world.truth.sample_brdf().f_r(theta_i, phi_i, theta_r, phi_r)
    expected = max(float(f_r * np.cos(theta_i)), 0.0) / 0.5**2
    assert world.radiance(0.0, EYE, DOWN)[0] == pytest.approx(expected, rel=1e-8, abs=1e-10)


# ---- what else a bench may have ------------------------------------------------------------------------------------


@pytest.mark.parametrize("model", ["lambertian", "oren_nayar"])
def test_a_white_has_its_radiance_factor_at_the_certificates_geometry(model):
    """Expected: pi L / E = white_beta there, whatever the white's BRDF; elsewhere another one unless it is Lambertian."""
    parameters = {"albedo": 0.9, "sigma": 0.4} if model == "oren_nayar" else {}
    seen = {}
    for pose in ((30.0, 15.0, 0.0), (40.0, -20.0, 0.0)):
        world = bench(pose, white_beta=0.97, white_model=model, white_parameters=parameters)
        world.mount("white")
        cosine = math.cos(math.radians(pose[0] - pose[1]))
        seen[pose] = world.radiance(0.0, EYE, DOWN)[0] * math.pi * 0.5**2 / cosine
    assert seen[30.0, 15.0, 0.0] == pytest.approx(0.97, rel=1e-9)
    assert (abs(seen[40.0, -20.0, 0.0] - 0.97) < 1e-9) == (model == "lambertian")


def test_hidden_mechanics_reach_the_servos():
    """Expected: a tilt axis that carries 1 N m at 90 degrees from hanging droops by 34.5 counts; waves move the arm."""
    config = {
        "load_nm": {"tilt": 1.0}, "hanging_deg": {"tilt": 90.0}, "encoder_harmonics_deg": {"arm": [[1, 0.5, 90.0]]},
        "friction_counts": [0, 0], "errors": False, "backlash_deg": 0.0, "supply_v": 11.0,
    }  # fmt: skip
    simulation = Simulation({"sim": {"truth": config}})
    tilt = simulation.servos["tilt"]
    tilt.write(64, b"\x01", 0.0)
    tilt.write(116, (2048).to_bytes(4, "little"), 0.0)
    assert tilt.shaft_counts(9.0) - 2048 == pytest.approx(4096 / 4096 / (4.1 * 800 / 128 / 885), rel=0.01)
    wave = 0.5 * math.sin(math.pi + math.pi / 2)
    assert math.degrees(simulation.world.angles(9.0)["arm"]) == pytest.approx(wave, abs=1e-9)
    assert simulation.servos["arm"].read(144, 2, 0.0) == (110).to_bytes(2, "little")
    told = simulation.camera.truth()
    assert told["encoder_harmonics_deg"]["arm"] == [[1, pytest.approx(0.5), pytest.approx(90.0)]]
    assert (told["load_nm"]["tilt"], told["supply_v"], told["sensor"]["response"]) == (1.0, 11.0, "linear")


def test_led_channels_colour_the_light():
    channels = [{"share": 0.75, "colour": [3, 0, 0]}, {"share": 0.25, "colour": [0, 0, 3]}]
    truth = {"lamp_channels": channels, "cfa": "RGGB", "errors": False, "lamp_drift_per_hour": 0.0}
    simulation = Simulation({"sim": {"truth": truth}})
    simulation.lamp.feed(b"OUTP1 ON;:OUTP2 ON\n", 0.0)
    both = simulation.camera.rate(0.0)[60:62, 80:82]
    simulation.lamp.feed(b"OUTP1 OFF\n", 1.0)
    blue = simulation.camera.rate(1.0)[60:62, 80:82]
    assert both[0, 0] / both[1, 1] == pytest.approx(0.75 * 0.6 / (0.25 * 0.5), rel=1e-3)
    assert both[0, 1] == both[1, 0] == blue[0, 0] == 0.0
    assert blue[1, 1] == pytest.approx(both[1, 1])


@pytest.mark.parametrize(
    ("truth", "message"),
    [
        ({"shape": "cube"}, "choose one of flat, sphere, cylinder"),
        ({"lamp_channels": []}, "must be a list of tables"),
        ({"lamp_channels": [{"shade": 1}]}, "did you mean 'share'"),
        ({"encoder_harmonics_deg": {"arm": [[1, 0.5]]}}, "3 numbers"),
        ({"load_nm": {"elbow": 1.0}}, "known are arm, pan, tilt"),
        ({"lamp_radius_mm": 400.0}, "outside 0 to 150"),
        ({"board_squares": [2, 2]}, "outside 3 to 50"),
    ],
)
def test_a_bench_that_cannot_be_is_refused(truth, message):
    with pytest.raises(ConfigurationError, match=message):
        Truth.draw(Settings.from_mapping({"sim": {"truth": truth}}))
