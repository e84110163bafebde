"""Surface elements as the integrator sees them: cosines of the normal, and directions turned into the local frame."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gonio.geometry import normal_cosines

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Elements:
    """Surface elements seen by the viewer, each array of shape (n,).

    In the local frame the viewer stands at (-sin_theta, 0, cos_theta) and the mirror direction at (sin_theta, 0, cos_theta),
    unless the frame is turned.

    Attributes
    ----------
    turn : ndarray, shape (n,), optional
        Angle [rad] about the normal from there to the x axis of an anisotropic surface, which is then the frame's.
    view : ndarray, shape (3, 3), optional
        For a viewer off the axis: the rotation that takes his direction to z. The normals are in his coordinates then,
        while the directions given to `local`, and those that `mirror` returns, are in the scene's.
    """

    cos_theta: Array
    sin_theta: Array
    cos_phi: Array
    sin_phi: Array
    turn: Array | None = None
    view: Array | None = None

    @classmethod
    def from_gradient(cls, p: ArrayLike, q: ArrayLike) -> Elements:
        """Elements of flat gradient arrays."""
        return cls(*(np.atleast_1d(a) for a in normal_cosines(p, q)))

    @classmethod
    def from_polar(cls, theta_n: ArrayLike, phi_n: ArrayLike) -> Elements:
        """Elements of normals given by polar angles [rad], 0 <= theta_n <= pi/2."""
        theta, phi = np.broadcast_arrays(np.atleast_1d(np.asarray(theta_n, dtype=float)), np.asarray(phi_n, dtype=float))
        return cls(np.cos(theta), np.sin(theta), np.cos(phi), np.sin(phi))

    def __len__(self) -> int:
        return len(self.cos_theta)

    def select(self, index: NDArray[np.intp] | NDArray[np.bool_]) -> Elements:
        """Some of the elements."""
        turn = None if self.turn is None else self.turn[index]
        cosines = (self.cos_theta[index], self.sin_theta[index], self.cos_phi[index], self.sin_phi[index])
        return Elements(*cosines, turn=turn, view=self.view)

    def turned(self, tangent: ArrayLike) -> Elements:
        """With the frames' x axes along the surface's own: `tangent` [rad] about the normal from (1, 0, p), dz along x.

        Seen down the normal the angle runs counter-clockwise; (n,) or a scalar.
        """
        # in the local frame (1, 0, p) is along (cos phi, -sin phi cos theta)
        start = np.arctan2(-self.sin_phi * self.cos_theta, self.cos_phi)
        return replace(self, turn=np.broadcast_to(start + np.asarray(tangent, dtype=float), start.shape))

    def viewer(self) -> Array:
        """Direction of the viewer in the local frame, shape (n, 3)."""
        return self._turn(-self.sin_theta, np.zeros_like(self.sin_theta), self.cos_theta)

    def local(self, direction: Sequence[float]) -> Array:
        """A viewer-oriented direction in the local frames, shape (n, 3) (memo, section 12, in vectors)."""
        x, y, z = direction if self.view is None else self.view @ np.asarray(direction, dtype=float)
        along = x * self.cos_phi + y * self.sin_phi  # 0 exactly for the viewer's axis
        across = y * self.cos_phi - x * self.sin_phi
        return self._turn(along * self.cos_theta - z * self.sin_theta, across, along * self.sin_theta + z * self.cos_theta)

    def _turn(self, x: Array, y: Array, z: Array) -> Array:
        if self.turn is None:
            return np.stack((x, y, z), axis=-1)
        c, s = np.cos(self.turn), np.sin(self.turn)
        return np.stack((c * x + s * y, c * y - s * x, z), axis=-1)

    def mirror(self) -> Array:
        """Viewer-oriented direction that a mirror would show, shape (n, 3): theta = 2 theta_n, phi = phi_n."""
        s2 = 2.0 * self.sin_theta * self.cos_theta
        c2 = (self.cos_theta - self.sin_theta) * (self.cos_theta + self.sin_theta)
        seen = np.stack((s2 * self.cos_phi, s2 * self.sin_phi, c2), axis=-1)
        return seen if self.view is None else np.asarray(seen @ self.view)
