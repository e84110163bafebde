"""What ``gonio map --explain`` prints: for each BRDF term and source which method ran, what it skipped, and what it took."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from gonio.cli.output import Output

if TYPE_CHECKING:
    from gonio.integrate import MapValues
    from gonio.maps import ReflectanceMap
    from gonio.source import Part

Array = NDArray[np.float64]


def explained(output: Output, made: ReflectanceMap, values: MapValues, rtol: float) -> None:
    """Print the table of steps, why each method was taken, and the sum."""
    from gonio import jit
    from gonio.brdf import term_names
    from gonio.fields import Field, Harmonics, Lobes

    assert made.brdf is not None and made.source is not None
    parts = made.source.parts
    if made.viewer is not None:  # other fields are done last
        parts = tuple(sorted(parts, key=lambda part: isinstance(part, Field) and not isinstance(part, Lobes | Harmonics)))
    normal, seen = _normals(made)
    lights = _numbered([_kind(part) for part in parts])
    terms = term_names(term.model for term in made.brdf.terms)
    left = {(name, k): None for name in terms for k in range(len(parts))}
    relative = _relative(values)
    worst = np.unravel_index(int(np.argmax(relative)), relative.shape)
    rows: list[list[str]] = []
    reasons: dict[str, dict[str, list[str]]] = {}
    for step in values.plan:
        term = next(k for k, one in enumerate(made.brdf.terms) if one is step.term)
        name, which = next((n, k) for n, k in left if n == terms[term])
        del left[name, which]
        # of a step's error two bounds are known: relative to its own value, and that of the sum
        rows.append([
            f"{name} x {lights[which]}", step.method.value, _skipped(parts[which], normal, step.method.name == "ZERO"),
            _per_gradient(step.effort.evaluations, values), f"{min(step.error, relative[worst]):.1e}",
            f"{1e3 * step.seconds:.1f} ms",
        ])  # fmt: skip
        reasons.setdefault(step.method.value, {}).setdefault(step.reason, []).append(rows[-1][0])
    total = sum(step.effort.evaluations for step in values.plan)
    seconds = sum(step.seconds for step in values.plan)
    rows.append(["sum", "", "", _per_gradient(total, values), f"{relative[worst]:.1e}", f"{1e3 * seconds:.1f} ms"])
    output.table(
        f"What was done, for {made.p.size} x {made.q.size} gradients",
        ["term x source", "method", "skipped", "f_r per gradient", "error / R", "time"], rows,
    )  # fmt: skip
    for method, why in reasons.items():
        for reason, pairs in why.items():
            which_pairs = f" ({', '.join(pairs)})" if len(why) > 1 else ""
            output.say(f"  {method}{which_pairs}: {reason}")
    kind = "a bound" if values.error_is_bound else "an estimate, as a function of the user's takes part"
    output.say(
        f"Largest error relative to R: {relative[worst]:.1e}, {kind}, at p = {made.p[worst[1]]:.4g}, "
        f"q = {made.q[worst[0]]:.4g}; {rtol:.1e} was asked for."
    )
    if not np.all(seen):
        output.say(f"{_share(float(np.mean(~seen)))} of the gradients face away from the viewer: skipped, R = 0.")
    dark = float(np.mean((values.value == 0.0) & seen))
    if dark:
        output.say(f"No light reaches {_share(dark)} of the gradients{'' if np.all(seen) else ' beside these'}: R = 0.")
    output.say(
        f"Not in these times: {jit.getting_ready_s():.2f} s for loading kernels from the cache or compiling them. The first "
        "use of a method includes the import of its libraries."
    )


def _relative(values: MapValues) -> Array:
    """Error relative to R, 0 where it is below what any tolerance allows."""
    from gonio.integrate.tails import ROUNDING

    size = np.abs(values.value)
    counts = (values.error > ROUNDING * np.max(size)) & (size > 0)
    return np.divide(values.error, size, out=np.zeros_like(size), where=counts)


def _per_gradient(evaluations: int, values: MapValues) -> str:
    count = evaluations / max(1, values.value.size)
    return f"{count:.0f}" if count >= 100 else f"{count:.3g}"


def _kind(part: Part) -> str:
    from gonio.source import Collimated

    return "collimated" if isinstance(part, Collimated) else part.kind


def _numbered(names: list[str]) -> list[str]:
    """``disk``, then ``disk 2``: in the order of the scene."""
    count: dict[str, int] = {}
    numbered = []
    for name in names:
        count[name] = count.get(name, 0) + 1
        numbered.append(f"{name} {count[name]}" if count[name] > 1 else name)
    return numbered


def _normals(made: ReflectanceMap) -> tuple[Array, NDArray[np.bool_]]:
    """Unit normals of all gradients, shape (m, n, 3), and which of them face the viewer."""
    p, q = np.broadcast_arrays(made.p[None, :], made.q[:, None])
    length = np.hypot(np.hypot(p, q), 1.0)
    normal = np.stack((-p / length, -q / length, 1.0 / length), axis=-1)
    if made.viewer is None:
        return normal, np.ones(p.shape, dtype=bool)
    theta, phi = made.viewer
    viewer = np.array([math.sin(theta) * math.cos(phi), math.sin(theta) * math.sin(phi), math.cos(theta)])
    return normal, normal @ viewer > 0


def _skipped(part: Part, normal: Array, everything: bool) -> str:
    """Which share of the gradients does not see a beam or a cap, and which share sees a part of it."""
    from gonio.source import Cap, Collimated

    if everything:
        return "everything"
    if isinstance(part, Collimated):
        return f"{_share(float(np.mean(normal @ np.array(part.direction) <= 0)))} back-facing"
    if not isinstance(part, Cap) or part.half_angle >= math.pi:
        return "below horizon"
    along, reach = normal @ np.array(part.axis), math.sin(part.half_angle)
    hidden = float(np.mean(along <= -reach if part.half_angle < math.pi / 2 else along <= -1.0))
    cut = float(np.mean(np.abs(along) < reach))
    told = [f"{_share(hidden)} back-facing"] * (hidden > 0) + [f"{_share(cut)} cut by horizon"] * (cut > 0)
    return ", ".join(told) or "nothing"


def _share(value: float) -> str:
    """In percent; never 0 or 100 unless it is."""
    if 0.0 < value < 0.01:
        return "< 1 %"
    if 0.99 < value < 1.0:
        return "> 99 %"
    return f"{100.0 * value:.0f} %"
