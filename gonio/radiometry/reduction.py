r"""Brackets of a scan become BRDF samples, each with its random error and its sensitivity to the shared ones.

A sample is measured against a white reference of known radiance factor beta, both at the origin and so at the same
distance from lamp and camera:

.. math:: f_r = \frac{x_s}{x_w}\,\frac{\cos\theta_{i,w}}{\cos\theta_{i,s}}\,\frac{\beta}{\pi}.

Angles are those that the encoders measured. If the true joint angles are these plus the zero errors delta, then with
the light that truly arrives, x_s is proportional to f_r cos theta_i,s and x_w to cos theta_i,w at the true angles, so

.. math:: \ln f_r^\mathrm{read} = \ln f_r(\omega + \partial\omega\,\delta)
          + \sum_k \Bigl(\frac{\partial_k\cos\theta_{i,s}}{\cos\theta_{i,s}}
          - \frac{\partial_k\cos\theta_{i,w}}{\cos\theta_{i,w}}\Bigr)\delta_k + \delta_\mathrm{scale} + \dots

to first order. Here delta_scale = ln(beta used / beta true), plus what else all samples inherit from the white.

The module takes the white's radiance factor as constant near its reference geometry. It corrects neither finite
apertures nor the spread of angles over the region of interest; keep both small against the lobe.

References
----------
.. [1] F. E. Nicodemus et al., NBS Monograph 160, 1977. doi:10.6028/NBS.MONO.160
.. [2] JCGM 100:2008, Evaluation of measurement data: Guide to the expression of uncertainty in measurement.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from gonio.calibration import (
    CameraNoise,
    Dark,
    Linearity,
    Reference,
    crop,
    linearity,
    photon_transfer,
    stack_darks,
    white_block,
)
from gonio.config import RigConfig
from gonio.config.axis import COUNTS_PER_TURN
from gonio.errors import MeasurementError
from gonio.geometry import angles
from gonio.interfaces import Frame
from gonio.kinematics import AXES, Joints, forward, jacobian
from gonio.radiometry.bracket import Reading, read_bracket
from gonio.samples import BRDFSamples, SharedError

Array = NDArray[np.float64]
Progress = Callable[[str, int, int], None]
ENCODER_STEP = 2.0 * math.pi / COUNTS_PER_TURN
"""One count of the servos' position [rad]."""
MIN_COSINE = 1e-3
"""Lamp or camera closer to the horizon of the specimen than this cosine: no sample."""


@dataclass(frozen=True)
class Bracket:
    """Exposures of one unmoved scene.

    Attributes
    ----------
    frames : sequence of Frame
    joints : Joints
        Joint angles measured at the exposures [rad].
    pose : int
        Pose of the scan, -1 for the white.
    time_s : float, optional
        Rig time of the middle [s]; by default from the frames.
    """

    frames: Sequence[Frame]
    joints: Joints
    pose: int = -1
    time_s: float | None = None


@dataclass(frozen=True)
class Setup:
    """What has to be known of the rig.

    Attributes
    ----------
    noise : CameraNoise
        Nominal gain and read noise of the camera.
    roi : tuple of int or None
        x0, y0, width, height [pixel].
    beta, u_beta : float
        Radiance factor of the white at its geometry [1], and its relative standard uncertainty [1].
    u_zero : tuple of float
        Standard uncertainty of the zeros of arm, pan and tilt [rad].
    u_encoder : float
        Standard deviation of one reading of a joint angle [rad].
    max_nonlinearity : float
        Largest relative deviation between the rates of neighbouring exposures.
    attributes : mapping of str to str
        Go to the samples as they are.
    """

    noise: CameraNoise
    roi: tuple[int, int, int, int] | None
    beta: float
    u_beta: float
    u_zero: tuple[float, float, float]
    u_encoder: float = ENCODER_STEP / math.sqrt(12.0)
    max_nonlinearity: float = 0.01
    attributes: Mapping[str, str] = field(default_factory=dict)

    @classmethod
    def of(cls, rig: RigConfig) -> Setup:
        """The setup that a rig.toml describes."""
        zeros = [rig.axes[name].u_zero for name in AXES]
        return cls(
            noise=CameraNoise(rig.camera.gain_dn_per_e, rig.camera.read_noise_e),
            roi=rig.camera.roi,
            beta=rig.white.beta,
            u_beta=rig.white.u_beta,
            u_zero=(zeros[0], zeros[1], zeros[2]),
            attributes={"rig": rig.name},
        )


def reduce(
    darks: Iterable[Frame],
    whites: Iterable[Sequence[Bracket]],
    poses: Iterable[Bracket],
    setup: Setup,
    *,
    total: int = 0,
    progress: Progress | None = None,
) -> BRDFSamples:
    """Reduce a scan.

    Parameters
    ----------
    darks : iterable of Frame
        Frames without light, at least two of each exposure.
    whites : iterable of sequence of Bracket
        The blocks of white reference brackets.
    poses : iterable of Bracket
        The poses with the sample; read once, one at a time.
    setup : Setup
    total : int, optional
        Number of poses, for `progress`.
    progress : callable, optional
        Called with ("reduce", done, total).

    Returns
    -------
    BRDFSamples
        One sample per pose. Poses without an exposure that is not saturated, and poses whose measured angles put lamp or
        camera at or below the horizon, are left out and counted in ``attributes``. Shared errors: ``scale``, ``arm``,
        ``pan``, ``tilt``, and ``drift`` if the white changed by more than its noise.

    Raises
    ------
    MeasurementError
        If there are no darks or no white, the camera is not linear, or no pose is left.
    """
    stacks = stack_darks(darks, setup.roi)
    blocks = [list(block) for block in whites]
    noise, said = _noise(stacks, blocks, setup)
    white_readings = [[read_bracket(b.frames, stacks, noise, setup.roi) for b in block] for block in blocks]
    reference, white_slope = _reference(blocks, white_readings)

    kept: list[Bracket] = []
    readings: list[Reading] = []
    saturated: list[int] = []
    behind: list[int] = []
    done = 0
    for done, bracket in enumerate(poses, 1):
        reading = read_bracket(bracket.frames, stacks, noise, setup.roi)
        omega_i, omega_r = forward(*bracket.joints)
        if min(omega_i[2], omega_r[2]) < MIN_COSINE:
            behind.append(bracket.pose)
        elif not reading.used.any():
            saturated.append(bracket.pose)
        else:
            kept.append(replace(bracket, frames=()))
            readings.append(reading)
        if progress is not None:
            progress("reduce", done, max(total, done))
    if not kept:
        raise MeasurementError(
            f"none of {done} poses gives a sample: {len(saturated)} are saturated in every exposure, {len(behind)} have "
            "lamp or camera behind the surface; shorten the exposures or change the plan"
        )
    check = _linearity(stacks, [r for block in white_readings for r in block] + readings)
    check.check(setup.max_nonlinearity)
    samples = _samples(kept, readings, reference, white_slope, setup)
    u_dark = max(r.u_dark / max(r.u_rate, 1e-300) for r in readings)
    attributes = {
        **setup.attributes,
        **samples.attributes,
        **said,
        "poses": str(done),
        "left_out_saturated": _listed(saturated),
        "left_out_behind": _listed(behind),
        "dark_frames": ", ".join(f"{d.count} of {t:g} s" for t, d in stacks.items()),
        "dark_over_random_uncertainty": f"{u_dark:.3g}",
        "linearity_deviation": f"{check.deviation:.3g}",
    }
    return replace(samples, attributes=attributes)


def _samples(
    kept: Sequence[Bracket], readings: Sequence[Reading], reference: Reference, white_slope: Array, setup: Setup
) -> BRDFSamples:
    joints = np.array([b.joints for b in kept], dtype=float).T  # (3, n): arm, pan, tilt
    omega_i, omega_r = forward(*joints)
    slope_i, slope_r = jacobian(*joints)  # (n, 3, 3)
    white, u_white, bow, bracketed = reference.at([_time(b, r) for b, r in zip(kept, readings, strict=True)])
    cos_i = omega_i[:, 2]
    # f_r = (x_s / cos theta_i,s) / (x_w / cos theta_i,w) * beta / pi; `white` is x_w / cos theta_i,w
    per_rate = setup.beta / (np.pi * white * cos_i)
    rate = np.array([r.rate for r in readings])
    u_rate = np.array([np.hypot(r.u_rate, r.u_dark) for r in readings])

    # Common to all samples: beta, the noise of the white, and the encoders' rounding while it was measured.
    u_encoder_white = setup.u_encoder * float(np.linalg.norm(white_slope))
    u_scale = float(np.sqrt(setup.u_beta**2 + np.max(u_white / white) ** 2 + u_encoder_white**2))
    shared = [SharedError("scale", u_scale)]
    shared += [SharedError(n, u, setup.u_encoder, "rad") for n, u in zip(AXES, setup.u_zero, strict=True)]
    columns = [np.ones(len(kept))]
    columns += [slope_i[:, 2, k] / cos_i - white_slope[k] for k in range(3)]
    if np.any(bow):
        largest = float(abs(reference.drift))
        shared.append(SharedError("drift", largest / math.sqrt(12.0)))
        columns.append(bow / largest)
    none = np.zeros((len(kept), 3, 1))
    after = np.zeros((len(kept), 3, len(shared) - 4))
    theta_i, phi_i = angles(omega_i)
    theta_r, phi_r = angles(omega_r)
    return BRDFSamples(
        theta_i=theta_i,
        phi_i=phi_i,
        theta_r=theta_r,
        phi_r=phi_r,
        f_r=rate * per_rate,
        u_f_r=u_rate * per_rate,
        pose=np.array([b.pose for b in kept], dtype=np.int64),
        shared=tuple(shared),
        d_omega_i=np.concatenate((none, slope_i, after), axis=2),
        d_omega_r=np.concatenate((none, slope_r, after), axis=2),
        d_ln_f=np.stack(columns, axis=1),
        attributes={
            "quantity": "brdf",
            "unit": "sr-1",
            "white_beta": f"{setup.beta:.6g}",
            "white_u_beta": f"{setup.u_beta:.6g}",
            "white_blocks": str(len(reference.blocks)),
            "white_drift": f"{reference.drift:.6g}",
            "white_not_bracketed": str(int(np.sum(~bracketed))),
        },
    )


def _reference(blocks: Sequence[Sequence[Bracket]], readings: Sequence[Sequence[Reading]]) -> tuple[Reference, Array]:
    """The white's readings over cos theta_i, and the derivative of ln cos theta_i by arm, pan and tilt, shape (3,)."""
    combined, slopes = [], []
    for block, read in zip(blocks, readings, strict=True):
        good = [(b, r) for b, r in zip(block, read, strict=True) if r.used.any()]
        cosines = []
        for bracket, _ in good:
            omega_i, omega_r = forward(*bracket.joints)
            if min(omega_i[2], omega_r[2]) < MIN_COSINE:
                arm, pan, tilt = np.degrees(bracket.joints)
                raise MeasurementError(
                    f"the white was measured at arm {arm:.2f}, pan {pan:.2f}, tilt {tilt:.2f} degrees, where lamp or "
                    "camera is behind it; choose another [white] geometry"
                )
            cosines.append(float(omega_i[2]))
            slopes.append(jacobian(*bracket.joints)[0][2] / omega_i[2])
        combined.append(
            white_block(
                [_time(b, r) for b, r in good],
                [r.rate / c for (_, r), c in zip(good, cosines, strict=True)],
                [float(np.hypot(r.u_rate, r.u_dark)) / c for (_, r), c in zip(good, cosines, strict=True)],
            )
        )
    return Reference.of(combined), np.mean(slopes, axis=0)


def _noise(
    stacks: dict[float, Dark], blocks: Sequence[Sequence[Bracket]], setup: Setup
) -> tuple[CameraNoise, dict[str, str]]:
    """The camera's noise: nominal, unless pairs among the white's repeats show another gain; and what was decided."""
    said = {"gain_dn_per_e": f"{setup.noise.gain_dn_per_e:.6g}", "gain_origin": "nominal"}
    pairs, levels, full = [], [], 0.0
    for block in blocks:
        for one, two in zip(block[::2], block[1::2], strict=False):
            for first in one.frames:
                dark = stacks.get(first.exposure_s)
                second = next((f for f in two.frames if f.exposure_s == first.exposure_s), None)
                if dark is None or second is None:
                    continue
                a, b = crop(first, setup.roi), crop(second, setup.roi)
                full = float(first.saturation_dn)
                if max(a.max(), b.max()) < full and a.size >= 16:
                    pairs.append((a, b))
                    levels.append(float(dark.mean.mean()))
    try:
        floor = float(np.mean([d.frame_variance for d in stacks.values()])) if stacks else None
        measured = photon_transfer(pairs, levels, full, dark_variance=floor)
    except MeasurementError as error:
        return setup.noise, {**said, "photon_transfer": str(error)}
    said["photon_transfer"] = f"gain {measured.noise.gain_dn_per_e:.4g} DN/e, u = {measured.u_gain:.2g} DN/e"
    nominal, found, u = setup.noise.gain_dn_per_e, measured.noise.gain_dn_per_e, measured.u_gain
    if u < 0.1 * found and abs(found - nominal) > 0.05 * nominal + 3.0 * u:
        said |= {"gain_dn_per_e": f"{found:.6g}", "gain_origin": "measured"}
        return CameraNoise(found, setup.noise.read_noise_e * nominal / found), said
    return setup.noise, said


def _linearity(stacks: dict[float, Dark], readings: Sequence[Reading]) -> Linearity:
    """Over all brackets whose exposures have darks; rows are brackets, columns the exposures of the darks."""
    exposures = np.array(list(stacks))
    shape = (len(readings), len(exposures))
    signal, variance, usable = np.zeros(shape), np.zeros(shape), np.zeros(shape, dtype=bool)
    for row, reading in enumerate(readings):
        column = np.argmin(np.abs(exposures[:, None] - reading.exposure_s), axis=0)
        signal[row, column], variance[row, column], usable[row, column] = reading.signal, reading.variance, reading.used
    return linearity(exposures, signal, variance, usable)


def _time(bracket: Bracket, reading: Reading) -> float:
    return reading.time_s if bracket.time_s is None else bracket.time_s


def _listed(poses: Sequence[int]) -> str:
    """ "0", or the count and the first few poses."""
    if not poses:
        return "0"
    more = ", ..." if len(poses) > 10 else ""
    return f"{len(poses)} (poses {', '.join(map(str, poses[:10]))}{more})"
