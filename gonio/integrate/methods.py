"""How each method of a plan is carried out on a list of gradients, tile by tile where it can be."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from gonio.fields import EnvironmentMap, Field, FunctionField, Lobes
from gonio.integrate import closed_forms, diffuse, disk, quadtree, radial
from gonio.integrate import threads as tiling
from gonio.integrate.frames import Elements
from gonio.integrate.grid import Gradients, add_beam
from gonio.integrate.lights import over_field
from gonio.integrate.plan import Method, Step
from gonio.integrate.profile import sample
from gonio.integrate.quadrature import integrate_cap
from gonio.integrate.ring_patches import Room
from gonio.integrate.ring_scene import Scene
from gonio.integrate.ring_table import tabulate
from gonio.integrate.rings import integrate_rings, scene_of, slopes_are_few
from gonio.integrate.tails import NOTHING, ROUNDING
from gonio.source import Cap, Collimated

Array = NDArray[np.float64]
_FEW = 64  # gradients up to which a table in theta_n does not pay
_FEW_BY_CELLS = 512  # where cells are the rule, which take their time for each of a table's nodes, too
_MOST_BESIDE = 256  # gradients that are done one by one where a table in theta_n falls short
_HANDFUL = 8  # gradients up to which cells are as fast as rings
_CELLS = 1 << 20  # with which gradients may be done that rings leave above their tolerance: seconds
_FEW_CELLS, _FEW_WAVES = 1 << 10, 256  # so many cells cost a gradient less than twice as many waves
_AT_LEAST, _PER_LOBE, _PER_CELL = 100, 20, 225  # cells that one gradient takes; their nodes
_SAMPLE = 0.125  # of the tolerance: that of a table's samples
_SAMPLE_OF_TREE = 0.015
_MANY_SLOPES = 1024  # gradients from which on a table is worth what it takes
_TRIED = 8  # slopes that tell what one takes
_MANY = 1 << 19  # gradients from which on a quadtree pays


@dataclass
class Run:
    """One map: gradients and tolerances.

    Attributes
    ----------
    gradients : Gradients
    tangent : ndarray, shape (n,), optional
        For anisotropic surfaces [rad].
    rtol, atol : float
        Tolerance of each step.
    threads : int, optional
        None: all cores.
    steps : list of Step
        All of them: some are carried out together.
    """

    gradients: Gradients
    tangent: Array | None
    rtol: float
    atol: float
    threads: int | None
    steps: list[Step] = field(default_factory=list)

    def add(self, step: Step, value: Array, error: Array) -> float:
        """Add one step's value and error (n,); returns its largest relative error."""
        count = tiling.available() if self.threads is None else self.threads
        by_tile = self._by_tile(step, count)
        if by_tile is not None:
            return max(tiling.run(lambda tile: by_tile(tile, value, error), self.gradients.tiles(), count), default=0.0)
        if isinstance(step.part, Cap) and step.method is Method.GENERAL and disk.suits(step.term, step.part):
            if not self._by_tree(step):
                return self._disk(step, step.part, count, value, error)
            together = [other for other in self.steps if other.part is step.part and self._by_tree(other)]
            if step is not together[0]:
                return together[0].error
            return self._tree(together, step.part, count, value, error)
        few = _FEW if step.term.mirror_only else _FEW_BY_CELLS
        if step.method is Method.RADIAL and isinstance(step.part, Cap) and self.gradients.size > few:
            return self._radial(step, step.part, count, value, error)
        if step.method is Method.RINGS and isinstance(step.part, Field):
            return self._rings(step, step.part, count, value, error)
        elements = self.gradients.elements()
        if not step.term.model.isotropic and self.tangent is not None:
            elements = elements.turned(self.tangent)
        v, e = self._by_element(step, elements, count)
        value += v
        error += e
        return float(np.max(np.divide(e, np.abs(v), out=np.zeros_like(e), where=v != 0), initial=0.0))

    def _by_tile(self, step: Step, threads: int) -> Callable[[tuple[int, int], Array, Array], float] | None:
        term, part, grid = step.term, step.part, self.gradients
        if isinstance(part, Collimated) and term.model.function is not None and term.model.isotropic:
            step.effort.add(grid.size, 1)
            return lambda tile, value, error: add_beam(term, part, grid, tile, value, error)
        if not isinstance(part, Cap):
            return None
        if step.method is Method.LAMBERT:
            return lambda tile, value, error: diffuse.add(term, part, grid, tile, value, error)
        return None

    def _disk(self, step: Step, cap: Cap, threads: int, value: Array, error: Array) -> float:
        """Most gradients by rules for small disks, the others by the general rule."""
        floor, known = disk.negligible(step.term, cap, self.gradients, self.atol)
        v, e = (value, error) if known else (np.zeros_like(value), np.zeros_like(error))
        done = tiling.run(
            lambda tile: disk.add(step.term, cap, self.gradients, tile, self.rtol, floor, v, e),
            self.gradients.tiles(),
            threads,
        )
        step.effort.add(sum(nodes for _, nodes, _ in done), 1)
        worst = max((relative for relative, _, _ in done), default=0.0)
        left = np.concatenate([index for _, _, index in done]) if done else np.empty(0, dtype=np.intp)
        if not known:  # what is faint counts if nothing is brighter
            largest = float(np.max(np.abs(value + v), initial=0.0))
            faint = np.flatnonzero((e > self.rtol * np.abs(v)) & (e > max(ROUNDING * largest, self.atol, NOTHING)))
            v[faint] = e[faint] = 0.0
            left = np.union1d(left, faint)
            value += v
            error += e
        if left.size:
            v, e = self._by_element(step, self.gradients.select(left).elements(), threads)
            value[left] += v
            error[left] += e
            worst = max(worst, float(np.max(np.divide(e, np.abs(v), out=np.zeros_like(e), where=v != 0))))
        return worst

    def _by_tree(self, step: Step) -> bool:
        cap = step.part
        if not (isinstance(cap, Cap) and step.method is Method.GENERAL and self.gradients.size >= _MANY):
            return False
        return disk.suits(step.term, cap) and step.term.plain

    def _tree(self, steps: list[Step], cap: Cap, threads: int, value: Array, error: Array) -> float:
        """Terms under one disk: their sum from polynomials on squares of normals; where there are none, by `_disk`."""

        def sample(p: Array, q: Array, rtol: float = _SAMPLE_OF_TREE * self.rtol) -> tuple[Array, Array]:
            v, e = np.zeros(p.size), np.zeros(p.size)
            run = Run(Gradients(p, q), None, rtol, 0.0, threads)
            for step in steps:
                run._disk(step, cap, threads, v, e)
            return v, e

        grid = self.gradients
        width = min(step.term.lobe_width() or 10.0 for step in steps)
        tree = quadtree.build(cap, width, grid, sample, self.rtol)
        done = tiling.run(lambda tile: tree.add(grid, tile, self.rtol, value, error), grid.tiles(), threads)
        worst = max(relative for relative, _ in done)
        left = np.concatenate([index for _, index in done])
        if left.size:
            some = grid.select(left)
            v, e = sample(some.p, some.q, self.rtol)
            value[left] += v
            error[left] += e
            worst = max(worst, _largest(e, v, 0.0))
        for step in steps:
            step.reason += "; many gradients: from polynomials on squares of normals, all terms together"
        return worst

    def _rings(self, step: Step, field: Field, threads: int, value: Array, error: Array) -> float:
        """By rings; few gradients, and those that rings leave above their tolerance, by adaptive cells.

        Rings add waves of either sign, so a value far below the largest at its slope has few digits left; cells add what is
        positive.
        """
        grid, rtol = self.gradients, self.rtol
        most = max(_FEW, int(_CELLS / _cells_of(field)))  # for cells
        handful = most > _FEW and grid.size <= _HANDFUL
        if handful:
            spare = self._spare(value, error)
            return self._added(*self._cells(step, field, grid.elements(), spare, threads), value, error)
        scene = scene_of(step.term, field, rtol, step.effort, threads)
        table = None
        if not slopes_are_few(grid):
            room = Room(grid, rtol, self.atol, value, error, threads)
            table = tabulate(scene, rtol, room, self._worth(scene, field, most))
        if table is None:
            spare = self._spare(value, error)
            return self._added(*self._slopes(step, scene, field, grid.elements(), spare, most, threads), value, error)
        negligible = ROUNDING * max(room.largest, table.largest)

        def add(tile: tuple[int, int]) -> tuple[float, NDArray[np.intp]]:
            return table.add(grid, tile, rtol, self.atol, value, error, negligible)

        done = tiling.run(add, grid.tiles(), threads)
        missed = np.concatenate([index for _, index in done])
        worst = max(relative for relative, _ in done)
        if missed.size == 0:
            return worst
        some, v, e = grid.select(missed), np.zeros(missed.size), np.zeros(missed.size)
        table.add(some, (0, missed.size), rtol, math.inf, v, e)
        late = np.arange(missed.size) if missed.size <= most else np.flatnonzero(e > negligible)
        if late.size <= most:
            spare = self._spare(value[missed[late]], error[missed[late]])
            v[late], e[late] = self._better(step, field, some.elements().select(late), v[late], e[late], spare, threads)
        value[missed] += v
        error[missed] += e
        return max(worst, _largest(error[missed], value[missed], negligible))

    def _added(self, v: Array, e: Array, value: Array, error: Array) -> float:
        """Add v and e to value and error; returns the largest relative error."""
        value += v
        error += e
        return _largest(e, value, ROUNDING * np.max(np.abs(value), initial=0.0))

    def _worth(self, scene: Scene, field: Field, most: int) -> float:
        """Evaluations that a table may take: with some hundreds of gradients, as many as slope by slope and by cells."""
        grid = self.gradients
        if grid.size > _MANY_SLOPES:
            return math.inf
        begun, some = scene.effort.evaluations, np.linspace(0, grid.size - 1, _TRIED).astype(np.intp)
        waves = self._waves(field, most)
        v, e = integrate_rings(scene, grid.select(some).elements(), rtol=self.rtol, atol=self.atol, most_waves=waves)
        missed = np.count_nonzero(e > np.maximum(self.rtol * np.abs(v), self.atol)) if grid.size <= most else 0
        return (scene.effort.evaluations - begun + missed * _PER_CELL * _cells_of(field)) * grid.size / _TRIED

    def _waves(self, field: Field, most: int) -> int:
        """Up to which rings go slope by slope, where cells may take over."""
        return _FEW_WAVES if self.gradients.size <= most and _cells_of(field) <= _FEW_CELLS else 1 << 20

    def _slopes(
        self, step: Step, scene: Scene, field: Field, elements: Elements, spare: Array, most: int, threads: int
    ) -> tuple[Array, Array]:
        """Rings slope by slope; up to `most` that they leave above their tolerance by cells."""
        v, e = integrate_rings(scene, elements, rtol=self.rtol, atol=spare, most_waves=self._waves(field, most))
        missed = np.flatnonzero(e > np.maximum(self.rtol * np.abs(v), spare))
        if 0 < missed.size <= most:
            v[missed], e[missed] = self._better(
                step, field, elements.select(missed), v[missed], e[missed], spare[missed], threads
            )
        return v, e

    def _better(
        self, step: Step, field: Field, elements: Elements, v: Array, e: Array, spare: Array, threads: int
    ) -> tuple[Array, Array]:
        """Value and error by cells where their error is smaller than the one there is."""
        again, left = self._cells(step, field, elements, spare, threads)
        return np.where(left < e, again, v), np.minimum(left, e)

    def _spare(self, value: Array, error: Array) -> Array:
        """What steps before leave of the tolerance, which is relative to the sum."""
        return np.maximum(self.atol, 0.5 * (self.rtol * np.abs(value) - error))

    def _cells(self, step: Step, field: Field, elements: Elements, spare: Array, threads: int) -> tuple[Array, Array]:
        cores = 1 if isinstance(field, FunctionField) else threads  # who knows what a user's function can stand
        return over_field(step.term, field, elements, rtol=self.rtol, atol=spare, effort=step.effort, threads=cores)

    def _by_element(self, step: Step, elements: Elements, threads: int) -> tuple[Array, Array]:
        term, part = step.term, step.part
        if isinstance(part, Collimated):
            step.effort.add(len(elements), 1)
            return closed_forms.collimated(term, part, elements)
        if step.method is Method.MIRROR:
            return closed_forms.mirror_cap(term, part, elements)
        if isinstance(part, Field):
            return over_field(term, part, elements, rtol=self.rtol, atol=self.atol, effort=step.effort)
        return integrate_cap(
            term, part, elements, rtol=self.rtol, atol=self.atol, about_normal=None, effort=step.effort, threads=threads
        )

    def _radial(self, step: Step, cap: Cap, threads: int, value: Array, error: Array) -> float:
        """By a table in theta_n; a few gradients where that falls short, each by itself."""
        table, grid = self._table(step, cap, threads), self.gradients
        if table.relative <= self.rtol:
            return max(tiling.run(lambda tile: table.add(grid, tile, value, error), grid.tiles(), threads), default=0.0)
        v, e = np.zeros(grid.size), np.zeros(grid.size)
        tiling.run(lambda tile: table.add(grid, tile, v, e), grid.tiles(), threads)
        missed = np.flatnonzero(e > np.maximum(self.rtol * np.abs(v), self.atol))
        if 0 < missed.size <= _MOST_BESIDE:
            again, left = self._by_element(step, grid.select(missed).elements(), threads)
            better = left < e[missed]
            v[missed[better]], e[missed[better]] = again[better], left[better]
        value += v
        error += e
        return _largest(e, v, 0.0)

    def _table(self, step: Step, cap: Cap, threads: int) -> radial.Table:
        def profile(tau: Array, finer: NDArray[np.intp]) -> tuple[Array, Array]:
            return sample(
                step.term, cap, tau, radial.PROBES, finer, rtol=_SAMPLE * self.rtol, atol=_SAMPLE * self.atol,
                effort=step.effort, threads=threads,
            )  # fmt: skip

        width = min(step.term.lobe_width() or 1.0, 1.0)
        features = [(math.pi / 2, max(width, 0.05))]
        if cap.half_angle < math.pi:
            rim = cap.half_angle if cap.axis[2] > 0 else math.pi - cap.half_angle
            features.append((0.5 * rim, width))  # the mirror direction is on the rim
            if cap.half_angle < math.pi / 2:
                features.append((math.pi / 2 - cap.half_angle, 0.02))  # the rim sets
        upper = radial.tau_of_slope(self.gradients.steepest)
        return radial.tabulate(profile, upper, rtol=self.rtol, atol=self.atol, features=features)


def _cells_of(field: Field) -> float:
    """About how many cells a gradient takes."""
    if isinstance(field, Lobes):
        return _AT_LEAST + _PER_LOBE * len(field.kappa)
    return _AT_LEAST + 2.0 * (field.samples.size if isinstance(field, EnvironmentMap) else 1.0 / field.detail**2)


def _largest(error: Array, value: Array, negligible: float) -> float:
    """Largest relative error, of errors that are not negligible."""
    counts = (error > negligible) & (value != 0.0)
    return float(np.max(np.divide(error, np.abs(value), out=np.zeros_like(error), where=counts), initial=0.0))
