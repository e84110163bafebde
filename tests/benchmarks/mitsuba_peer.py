"""Mitsuba 3, the peer that a graphics user would pick: a sphere, an orthographic camera, Monte Carlo.

The camera looks at one spot of the sphere at a time, so small that the normal is the same in all of it. Mitsuba's models
are not gonio's (its rough conductor has another shadowing term, its rough plastic another diffuse part), so only the
diffuse surface can be compared by error. It computes in single precision. It is not among gonio's dependencies; ``pip
install -e '.[bench]'`` brings it, and without it this peer is left out and says so. It renders in a process of its own,
which its LLVM variant may take down with it; then the scalar one has its turn.
"""

from __future__ import annotations

import importlib.util
import json
import math
import subprocess
import sys
import time
from typing import Any

import numpy as np
from numpy.typing import NDArray

from tests.benchmarks.scenes import AXIS, N, Scene, relative_error, sample

VARIANTS = ("llvm_ad_rgb", "scalar_rgb")
FILM = 16  # pixels along each side of the spot
SAMPLES = (1, 16, 256)  # for each of its pixels
SPOT = 1e-3  # radius of the spot, the sphere's is 1
_said: set[str] = set()


def measure(scene: Scene, true: NDArray[np.float64]) -> list[tuple[str, float, float, float]]:
    """(setting, seconds per map on one core, error, samples per gradient); empty without mitsuba."""
    if importlib.util.find_spec("mitsuba") is None:
        return _leave("mitsuba is not installed (pip install -e '.[bench]'): left out")
    for variant in VARIANTS:
        command = [sys.executable, "-m", "tests.benchmarks.mitsuba_peer", variant, scene.surface, scene.light]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode == 0:
            answers = json.loads(done.stdout.splitlines()[-1])
            return [
                (variant, a["seconds"] * N * N, relative_error(np.array(a["values"]), true), a["samples"]) for a in answers
            ]
    why = (done.stderr.strip().splitlines() or [f"exit status {done.returncode}"])[-1]
    return _leave(f"mitsuba does not run here ({why[:150]}): left out")


def _leave(reason: str) -> list[Any]:
    if reason not in _said:
        print(reason)
        _said.add(reason)
    return []


def render(variant: str, scene: Scene) -> list[dict[str, Any]]:
    """Values (of the pixels of the sample), processor seconds and samples per gradient, for each number of samples."""
    import mitsuba as mi

    mi.set_variant(variant)
    albedo = float(scene.data["brdf"][0]["albedo"])
    if scene.kind == "uniform":
        emitter: dict[str, Any] = {"type": "constant", "radiance": {"type": "rgb", "value": 1.0}}
    else:
        # the first and the last row of Mitsuba's maps are at the poles: the rows between ours are the means of two
        ours = np.array(scene.data["source"][0]["radiance"])
        rows = np.empty((2 * len(ours) + 1, ours.shape[1]), dtype=np.float32)
        rows[1::2], rows[2:-1:2], rows[0], rows[-1] = ours, (ours[1:] + ours[:-1]) / 2, ours[0], ours[-1]
        grid = np.repeat(rows[:, :, None], 3, axis=2)
        # they have y up and the azimuth from -z towards x
        turn = mi.ScalarTransform4f(np.array([[0, 0, -1, 0], [1, 0, 0, 0], [0, 1, 0, 0], [0, 0, 0, 1]], dtype=float))
        emitter = {"type": "envmap", "bitmap": mi.Bitmap(grid), "to_world": turn}
    ball = {
        "type": "sphere", "radius": 1.0, "bsdf": {"type": "diffuse", "reflectance": {"type": "rgb", "value": albedo}}
    }  # fmt: skip
    world = mi.load_dict({"type": "scene", "ball": ball, "sky": emitter, "integrator": {"type": "direct"}})
    spots = []
    for i, j in sample():
        p, q = AXIS[j], AXIS[i]
        x, y = -p / math.sqrt(1 + p * p + q * q), -q / math.sqrt(1 + p * p + q * q)
        look = mi.ScalarTransform4f().look_at(origin=[x, y, 10.0], target=[x, y, 0.0], up=[0, 1, 0])
        film = {"type": "hdrfilm", "width": FILM, "height": FILM, "rfilter": {"type": "box"}}
        camera = {"type": "orthographic", "to_world": look @ mi.ScalarTransform4f().scale([SPOT, SPOT, 1.0]), "film": film}
        spots.append(mi.load_dict(camera))
    mi.render(world, sensor=spots[0], spp=1)
    answers = []
    for count in SAMPLES:
        start = time.process_time()
        images = [np.array(mi.render(world, sensor=s, spp=count, seed=k)) for k, s in enumerate(spots)]
        values = [float(np.mean(image[:, :, 0])) for image in images]
        seconds = (time.process_time() - start) / len(spots)
        answers.append({"values": values, "seconds": seconds, "samples": FILM * FILM * count})
    return answers


if __name__ == "__main__":
    print(json.dumps(render(sys.argv[1], Scene(sys.argv[2], sys.argv[3]))))
