"""A file through other people's programs: mitsuba, Radiance (pyradiance), pyWinCalc, jsonschema, xarray.

Each function takes a file and returns what that program makes of it, as f_r [1/sr] or f_r cos(theta_r), so that a test or
``gonio check-file`` can compare. Every program is optional (``pip install 'gonio[check]'``); `installed` says which are
there. Nothing of gonio's own readers is used here.

References
----------
.. [1] LBNL Radiance, ray/src/rt/rtrace.c, m_bsdf.c.
"""

from __future__ import annotations

import importlib.util
import json
import os
import re
import subprocess
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.errors import DatasetError

Array = NDArray[np.float64]
PEERS = {
    "mitsuba": "Mitsuba 3, plugin measured (RGL)",
    "pyradiance": "Radiance: rtrace, checkBSDF, pabopto2bsdf (Klems, PAB)",
    "pywincalc": "pyWinCalc (Klems)",
    "jsonschema": "jsonschema with the BiRD schemas",
    "xarray": "xarray (NetCDF)",
}
SCHEMAS = Path(__file__).with_name("bird_schemas")
SECONDS = 120
SOURCE_DEG = 0.5  # angular diameter of the lamp in the Radiance scene
RADIANCE_LUMINANCE = np.array([0.265074126, 0.670114631, 0.064811243])  # Y of Radiance's own primaries, src/common/color.h


def installed() -> dict[str, bool]:
    """Which programs can be imported."""
    return {name: importlib.util.find_spec(name) is not None for name in PEERS}


def mitsuba_bsdf(path: Path, spectral: bool = False) -> Any:
    """The file as Mitsuba's ``measured`` in a scalar variant."""
    import mitsuba

    mitsuba.set_variant("scalar_spectral" if spectral else "scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    try:
        return mitsuba.load_dict({"type": "measured", "filename": str(path)})
    except RuntimeError as error:
        raise DatasetError(f"mitsuba does not load {path}: {' '.join(str(error).split())[:200]}") from None


def mitsuba_f_cos(bsdf: Any, omega_i: Array, omega_r: Array, wavelengths_nm: Sequence[float] | None = None) -> Array:
    """f_r cos(theta_r) [1/sr] that Mitsuba evaluates at pairs of directions (n, 3), shape (n, 3 or wavelengths).

    At most four wavelengths, which is what its spectra hold.
    """
    import mitsuba

    context, surface = mitsuba.BSDFContext(), mitsuba.SurfaceInteraction3f()
    if wavelengths_nm is not None:
        four = [*wavelengths_nm, *[wavelengths_nm[-1]] * (4 - len(wavelengths_nm))]
        surface.wavelengths = type(surface.wavelengths)(*four)
    out = []
    for wi, wr in zip(omega_i.tolist(), omega_r.tolist(), strict=True):
        surface.wi = mitsuba.Vector3f(*wi)
        value = bsdf.eval(context, surface, mitsuba.Vector3f(*wr))
        out.append([float(v) for v in value][: None if wavelengths_nm is None else len(wavelengths_nm)])
    return np.array(out)


def mitsuba_albedo(bsdf: Any, omega_i: Array, n: int, seed: int) -> tuple[float, float]:
    """Directional albedo that Mitsuba's own importance sampling gives (channel 0), and its standard error."""
    import mitsuba

    rng = np.random.default_rng(seed)
    context, surface = mitsuba.BSDFContext(), mitsuba.SurfaceInteraction3f()
    surface.wi = mitsuba.Vector3f(*omega_i.tolist())
    weights = []
    for one, x, y in rng.random((n, 3)).tolist():
        _, weight = bsdf.sample(context, surface, one, mitsuba.Point2f(x, y))
        weights.append(float(weight[0]))
    return float(np.mean(weights)), float(np.std(weights) / np.sqrt(n))


def _radiance(command: Sequence[str], folder: Path, given: bytes | None = None) -> bytes:
    import pyradiance

    binaries = Path(pyradiance.BINPATH)
    environment = {
        **os.environ,
        "PATH": f"{binaries}{os.pathsep}{os.environ.get('PATH', '')}",
        "RAYPATH": f".{os.pathsep}{binaries.parent / 'lib'}",
    }
    full = [str(binaries / command[0]), *command[1:]]
    try:
        done = subprocess.run(
            full, input=given, capture_output=True, cwd=folder, env=environment, timeout=SECONDS, check=False
        )
    except (OSError, subprocess.TimeoutExpired) as error:
        raise DatasetError(f"{command[0]} of Radiance cannot be run: {error}") from None
    if done.returncode != 0:
        raise DatasetError(
            f"{command[0]} of Radiance refuses the file: {' '.join(done.stderr.decode(errors='replace').split())[:200]}"
        )
    return done.stdout


def radiance_f_r(path: Path, omega_i: Array, omega_r: Array) -> Array:
    """f_r [1/sr] that rtrace finds on a surface of that BSDF file under a small lamp, shape (n, 3): R, G, B.

    Parameters
    ----------
    path : Path
        Klems or tensor-tree XML.
    omega_i, omega_r : ndarray, shape (n, 3)
        Towards the lamp and towards the viewer; one octree for each distinct omega_i.
    """
    out = np.empty((len(omega_i), 3))
    solid_angle = 2.0 * np.pi * (1.0 - np.cos(np.radians(SOURCE_DEG / 2)))
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "surface.xml").write_bytes(path.read_bytes())
        lamps, index = np.unique(omega_i, axis=0, return_inverse=True)
        for k, wi in enumerate(lamps):
            scene = (
                "void light lamp 0 0 3 1e5 1e5 1e5\n"
                f"lamp source sun 0 0 4 {wi[0]:.12g} {wi[1]:.12g} {wi[2]:.12g} {SOURCE_DEG}\n"
                "void BSDF material 6 0 surface.xml 0 1 0 . 0 0\n"
                "material polygon plate 0 0 12 -1 -1 0 1 -1 0 1 1 0 -1 1 0\n"
            )
            (folder / "scene.rad").write_text(scene)
            (folder / "scene.oct").write_bytes(_radiance(["oconv", "-w", "scene.rad"], folder))
            mine = np.flatnonzero(index.ravel() == k)
            rays = "".join("{:.9g} {:.9g} {:.9g} {:.9g} {:.9g} {:.9g}\n".format(*w, *-w) for w in omega_r[mine])
            options = ["-h", "-ab", "0", "-dj", "0", "-dt", "0", "-dc", "1", "-ss", "0", "-st", "0", "-I-"]
            found = _radiance(["rtrace", *options, "scene.oct"], folder, rays.encode())
            radiance = np.array([[float(x) for x in line.split()] for line in found.decode().splitlines() if line.strip()])
            out[mine] = radiance / (1e5 * solid_angle * wi[2])
    return out


def radiance_reciprocity_percent(path: Path) -> tuple[float, float, float]:
    """Least, mean and largest reciprocity error [%] that checkBSDF reports of the inner reflection."""
    text = _radiance(["checkBSDF", str(path.resolve())], Path.cwd()).decode(errors="replace")
    tail = text[text.find("Reciprocity Error") :]
    found = re.search(r"Interior Refl\s+([\d.]+)\s+([\d.]+)\s+([\d.]+)", tail)
    if found is None:
        raise DatasetError(f"checkBSDF of Radiance finds no reflection in {path}")
    low, mean, high = (float(x) for x in found.groups())
    return low, mean, high


def radiance_klems_of_pab(paths: Sequence[Path]) -> bytes:
    """Klems XML that Radiance interpolates from PAB-Opto files (pabopto2bsdf, then bsdf2klems)."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "fit.sir").write_bytes(_radiance(["pabopto2bsdf", *(str(p.resolve()) for p in paths)], folder))
        return _radiance(["bsdf2klems", "fit.sir"], folder)


def pywincalc_matrices(path: Path) -> dict[str, Array]:
    """Front and back reflectance matrices [1/sr] (reflected, incident) that pyWinCalc parses."""
    import pywincalc

    try:
        visible = pywincalc.parse_bsdf_xml_file(str(path)).measurements.visible
    except (RuntimeError, ValueError, AttributeError) as error:
        raise DatasetError(f"pywincalc does not load {path}: {' '.join(str(error).split())[:200]}") from None
    return {"front": np.array(visible.reflectance_front.data), "back": np.array(visible.reflectance_back.data)}


def bird_errors(path: Path) -> list[str]:
    """What the BiRD schemas find wrong with a JSON file; empty if it is valid."""
    import jsonschema
    import referencing

    resources = []
    for file in sorted(SCHEMAS.glob("*.json")):
        try:
            schema = json.loads(file.read_text(encoding="utf-8"))
        except json.JSONDecodeError:  # the published sample_holder schema is not JSON, and nothing refers to it
            continue
        resources.append((schema["$id"], referencing.Resource.from_contents(schema)))
    registry: Any = referencing.Registry().with_resources(resources)
    root = registry.contents(next(key for key, _ in resources if key.endswith("/brdf_json_schema_v1.0.json")))
    validator = jsonschema.Draft202012Validator(root, registry=registry)
    document = json.loads(path.read_text(encoding="utf-8"))
    return [f"{'/'.join(map(str, e.absolute_path))}: {e.message[:150]}" for e in validator.iter_errors(document)]
