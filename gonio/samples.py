r"""BRDF samples: what a measurement knows, with its random and its shared errors kept apart.

A random error belongs to one sample. A shared error (the scale of the white reference, the zero of an axis) is the same
unknown number for all samples, so it is neither averaged away nor added to the scatter: it is a parameter with a prior,
and each sample carries its derivatives with respect to it. The expected reading of sample j is

.. math:: \hat f_j = f_r(\omega_i + \sum_k \partial_k\omega_i\,\delta_k,\ \omega_r + \sum_k \partial_k\omega_r\,\delta_k)
          \exp\Bigl(\sum_k \partial_k\ln f\,\delta_k\Bigr), \qquad \delta_k \sim N(0, u_k).

The split into random, structured and systematic errors follows the GUM: JCGM 100:2008, 5.2 (correlated quantities).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.errors import DatasetError
from gonio.geometry import unit_vector

Array = NDArray[np.float64]


@dataclass(frozen=True)
class SharedError:
    """One error that all samples share.

    Attributes
    ----------
    name : str
        ``"scale"``, ``"arm"``, ``"pan"``, ``"tilt"``, ...
    u : float
        Standard uncertainty of the shared value, the prior of the fit.
    u_sample : float
        Standard deviation of an independent error of the same kind in every sample, such as encoder quantisation.
    unit : str
        ``"1"`` or ``"rad"``.
    """

    name: str
    u: float
    u_sample: float = 0.0
    unit: str = "1"


@dataclass(frozen=True)
class BRDFSamples:
    """Scattered samples of a BRDF.

    Attributes
    ----------
    theta_i, phi_i, theta_r, phi_r : ndarray, shape (n,)
        Incident and reflected direction [rad], from the normal; mirror direction at phi_r = phi_i + pi.
    f_r : ndarray, shape (n,)
        BRDF [1/sr]. Negative values are kept: noise around zero is data.
    u_f_r : ndarray, shape (n,)
        Standard random uncertainty of f_r [1/sr]; NaN where it is unknown.
    pose : ndarray of int64, shape (n,)
        Pose of the scan that gave the sample, -1 if none.
    shared : tuple of SharedError, length K
    d_omega_i, d_omega_r : ndarray, shape (n, 3, K)
        Derivatives of the unit vectors, in the local frame, with respect to each shared error.
    d_ln_f : ndarray, shape (n, K)
        Derivative of the logarithm of the reading with respect to each shared error, directions held.
    attributes : mapping of str to str
        Quantity, material, origin.
    """

    theta_i: Array
    phi_i: Array
    theta_r: Array
    phi_r: Array
    f_r: Array
    u_f_r: Array
    pose: NDArray[np.int64]
    shared: tuple[SharedError, ...]
    d_omega_i: Array
    d_omega_r: Array
    d_ln_f: Array
    attributes: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n, k = len(self.f_r), len(self.shared)
        shapes: dict[str, tuple[int, ...]] = {
            "theta_i": (n,), "phi_i": (n,), "theta_r": (n,), "phi_r": (n,), "f_r": (n,), "u_f_r": (n,), "pose": (n,),
            "d_omega_i": (n, 3, k), "d_omega_r": (n, 3, k), "d_ln_f": (n, k),
        }  # fmt: skip
        for name, shape in shapes.items():
            array = getattr(self, name)
            if array.shape != shape:
                raise DatasetError(f"samples: {name} has shape {array.shape}, needed is {shape}")
            if name != "u_f_r" and not np.all(np.isfinite(array)):
                raise DatasetError(f"samples: {name} holds a value that is not finite; remove those rows first")
        if np.any(np.isinf(self.u_f_r)) or np.any(self.u_f_r < 0):
            raise DatasetError("samples: u_f_r must be zero, positive or NaN (unknown)")
        for name in ("theta_i", "theta_r"):
            theta = getattr(self, name)
            if np.any((theta < 0) | (theta >= np.pi / 2)):
                worst = np.degrees(theta[(theta < 0) | (theta >= np.pi / 2)][0])
                raise DatasetError(f"samples: {name} = {worst:g} degrees; a BRDF needs 0 <= {name} < 90 degrees")

    def __len__(self) -> int:
        return len(self.f_r)

    def omega_i(self) -> Array:
        """Incident unit vectors in the local frame, shape (n, 3)."""
        return unit_vector(self.theta_i, self.phi_i)

    def omega_r(self) -> Array:
        """Reflected unit vectors in the local frame, shape (n, 3)."""
        return unit_vector(self.theta_r, self.phi_r)

    def select(self, mask: NDArray[np.bool_] | NDArray[np.int64]) -> BRDFSamples:
        """The samples of a mask or of an index array."""
        arrays = {f.name: getattr(self, f.name)[mask] for f in fields(self) if f.name not in ("shared", "attributes")}
        return replace(self, **arrays)

    @classmethod
    def joined(cls, parts: Sequence[BRDFSamples]) -> BRDFSamples:
        """The samples of several sets with the same shared errors, one after the other; attributes are the first one's."""
        if any(part.shared != parts[0].shared for part in parts):
            raise DatasetError("samples: sets with different shared errors cannot be put together")
        arrays: dict[str, Any] = {
            f.name: np.concatenate([getattr(part, f.name) for part in parts])
            for f in fields(cls) if f.name not in ("shared", "attributes")
        }  # fmt: skip
        return replace(parts[0], **arrays)

    @classmethod
    def plain(
        cls,
        theta_i: ArrayLike,
        phi_i: ArrayLike,
        theta_r: ArrayLike,
        phi_r: ArrayLike,
        f_r: ArrayLike,
        u_f_r: ArrayLike | None = None,
        attributes: Mapping[str, str] | None = None,
    ) -> BRDFSamples:
        """Samples without poses and shared errors, as imported ones are.

        Parameters
        ----------
        theta_i, phi_i, theta_r, phi_r : array_like, shapes broadcast to (n,)
            [rad].
        f_r : array_like, shape (n,)
            [1/sr].
        u_f_r : array_like, shape (n,), optional
            Standard uncertainty [1/sr]; NaN, and NaN everywhere by default, where unknown.
        """
        value = np.array(f_r, dtype=float)
        n = len(value)
        a, b, c, d = (np.array(np.broadcast_to(np.asarray(x, dtype=float), (n,))) for x in (theta_i, phi_i, theta_r, phi_r))
        u = np.full(n, np.nan) if u_f_r is None else np.array(np.broadcast_to(np.asarray(u_f_r, dtype=float), (n,)))
        none = np.zeros((n, 3, 0))
        pose = np.full(n, -1, dtype=np.int64)
        return cls(a, b, c, d, value, u, pose, (), none, none, np.zeros((n, 0)), dict(attributes or {}))


OF_A_RUN = ("drift",)  # shared errors that are other ones in each run; the others belong to the rig


def together(runs: Sequence[BRDFSamples], u_mount: float) -> BRDFSamples:
    """Samples of one material from several runs of one rig, between which the sample was taken off and put back.

    Errors of the rig are the same unknown in all runs. What putting back changes, above all where on the sample the light
    falls, is a relative error of each run's own, ``mount_1``, ``mount_2``, ...

    Parameters
    ----------
    runs : sequence of BRDFSamples
    u_mount : float
        Relative standard uncertainty of putting back, the prior of each of these errors.

    Raises
    ------
    DatasetError
        If `u_mount` is not positive, or an error of the rig is not equally uncertain in all runs.
    """
    if not (np.isfinite(u_mount) and u_mount > 0):
        raise DatasetError(f"u_mount = {u_mount:g}; give the relative uncertainty of putting a sample back, such as 0.005")
    errors: dict[str, SharedError] = {}
    place: list[dict[str, int]] = []  # of each run: its errors among all
    for k, run in enumerate(runs, 1):
        own = {}
        for error in run.shared:
            name = f"{error.name}_{k}" if error.name in OF_A_RUN else error.name
            known = errors.setdefault(name, replace(error, name=name))
            if known != replace(error, name=name):
                raise DatasetError(
                    f"{error.name} has an uncertainty of {error.u:g} {error.unit} in run {k} and of {known.u:g} in one "
                    "before; runs of one rig and calibration fit together"
                )
            own[error.name] = list(errors).index(name)
        errors[f"mount_{k}"] = SharedError(f"mount_{k}", u_mount)
        own["mount"] = len(errors) - 1
        place.append(own)
    wide = []
    for run, own in zip(runs, place, strict=True):
        n, total = len(run), len(errors)
        d_i, d_r, d_f = np.zeros((n, 3, total)), np.zeros((n, 3, total)), np.zeros((n, total))
        for j, error in enumerate(run.shared):
            at = own[error.name]
            d_i[:, :, at], d_r[:, :, at], d_f[:, at] = run.d_omega_i[:, :, j], run.d_omega_r[:, :, j], run.d_ln_f[:, j]
        d_f[:, own["mount"]] = 1.0
        wide.append(replace(run, shared=tuple(errors.values()), d_omega_i=d_i, d_omega_r=d_r, d_ln_f=d_f))
    return BRDFSamples.joined(wide)
