"""Writes tests/data/problems.json: reflectance-map integrals with their values, by two methods that must agree to 1e-11.

Run by hand: ``python -m tests.make_problems``. What the file already holds for the same scene is kept; ``--afresh`` starts
anew. No gonio code takes part: the values are those of tests/independent.py.
"""

from __future__ import annotations

import json
import math
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.independent import reflected_radiance

FILE = Path(__file__).parent / "data" / "problems.json"
AGREEMENT = 1e-11

Terms = list[dict[str, Any]]


def lambertian(albedo: float) -> dict[str, Any]:
    return {"model": "lambertian", "albedo": albedo}


def ggx(alpha: float, f_0: float = 0.04) -> dict[str, Any]:
    return {"model": "ggx", "k_s": 1.0, "alpha": alpha, "f_0": f_0}


def phong(n: float, k_s: float = 1.0) -> dict[str, Any]:
    return {"model": "phong", "k_s": k_s, "n": n}


def oren_nayar(sigma: float) -> dict[str, Any]:
    return {"model": "oren_nayar", "albedo": 0.8, "sigma": sigma}


BRDFS: dict[str, Terms] = {
    "paper": [lambertian(0.8)],
    "rough metal": [ggx(1.0, f_0=1.0)],
    "ggx 0.3": [ggx(0.3)],
    "ggx 0.1": [ggx(0.1, f_0=0.9)],
    "ggx 0.02": [ggx(0.02)],
    "ggx 0.001": [ggx(0.001)],
    "satin": [lambertian(0.5), ggx(0.1)],
    "phong 1": [phong(1.0)],
    "phong 50": [phong(50.0)],
    "phong 1000": [phong(1000.0, k_s=0.3)],
    "clay": [oren_nayar(math.radians(20.0))],
    "rough clay": [oren_nayar(0.8)],
    "mirror": [{"model": "specular", "rho": 0.7}],
    "varnish": [lambertian(0.3), ggx(0.05), phong(20.0, k_s=0.2), {"model": "specular", "rho": 0.04}],
}

_METAL = {"model": "microfacet", "k_s": 1.0, "alpha": 1.0, "distribution": "ggx", "multiple_scattering": True}
MORE: dict[str, Terms] = {
    "maria": [{"model": "minnaert", "albedo": 0.3, "k": 0.6}],
    "velvet": [{"model": "minnaert", "albedo": 0.5, "k": 1.6}],
    "dust": [{"model": "lommel_seeliger", "w": 0.3}],
    "regolith": [{"model": "hapke", "w": 0.4, "b": 0.3, "c": 0.4, "B_0": 0.8, "h": 0.06, "theta_bar": math.radians(20.0)}],
    "snow": [{"model": "hapke", "w": 0.97, "b": 0.4, "c": -0.6, "B_0": 0.0, "h": 0.05, "theta_bar": 0.0, "H": "2002"}],
    "paint": [{"model": "kubelka_munk", "K_over_S": 0.1, "k_1": 0.04, "k_2": 0.6}],
    "plaster": [{"model": "oren_nayar", "albedo": 0.7, "sigma": 0.5, "variant": "full"}],
    "ceramic": [{"model": "eon", "albedo": 0.9, "roughness": 0.8}],
    "plastic": [{"model": "plastic", "albedo": 0.6, "n": 1.5}],
    "blinn 80": [{"model": "blinn_phong", "k_s": 0.5, "n": 80.0}],
    "beads": [{"model": "lafortune", "k_s": 0.4, "C_xy": 0.9, "C_z": 1.0, "n": 30.0}],
    "off specular": [{"model": "lafortune", "k_s": 0.6, "C_xy": -1.0, "C_z": 0.8, "n": 15.0}],
    "ward 0.15": [{"model": "ward", "k_s": 0.6, "alpha": 0.15}],
    "duer 0.2": [{"model": "ward", "k_s": 0.6, "alpha": 0.2, "variant": "duer"}],
    "bounded ward": [{"model": "ward", "k_s": 0.9, "alpha": 0.1, "variant": "gmd"}],
    "lacquer": [{"model": "ashikhmin_shirley", "R_d": 0.4, "R_s": 0.05, "n": 200.0}],
    "scratched": [{"model": "abg", "A": 1e-3, "B": 1e-3, "g": 1.5}],
    "polished": [{"model": "harvey_shack", "b_0": 50.0, "l": 0.01, "s": -1.8}],
    "superpolished": [{"model": "k_correlation", "A": 1e-3, "B": 20.0, "C": 2.0, "wavelength_um": 0.6328}],
    "beckmann 0.2": [{"model": "beckmann", "k_s": 1.0, "alpha": 0.2, "f_0": 0.05}],
    "berry": [{"model": "microfacet", "k_s": 1.0, "alpha": 0.15, "gamma": 1.0, "f_0": 0.6, "distribution": "gtr"}],
    "student": [
        {
            "model": "microfacet", "k_s": 1.0, "alpha": 0.2, "gamma": 3.0, "n": 1.5, "distribution": "std",
            "fresnel": "dielectric",
        }
    ],
    "gold": [
        {
            "model": "microfacet", "k_s": 1.0, "alpha": 0.25, "n": 0.2, "k": 3.0, "distribution": "ggx",
            "fresnel": "conductor", "shadowing": "smith_separable",
        }
    ],
    "grooves": [
        {
            "model": "microfacet", "k_s": 1.0, "alpha": 0.3, "n": 2.8, "k": 3.2, "distribution": "beckmann",
            "fresnel": "conductor", "shadowing": "v_groove",
        }
    ],
    "wide grooves": [
        {
            "model": "microfacet", "k_s": 0.9, "alpha": 0.4, "gamma": 1.5, "distribution": "gtr", "fresnel": "none",
            "shadowing": "v_groove",
        }
    ],
    "furnace": [{**_METAL, "fresnel": "none"}],
    "rough gold": [{**_METAL, "fresnel": "schlick", "f_0": 0.7}],
    "coated paint": [
        {"model": "plastic", "albedo": 0.6, "n": 1.5},
        {"model": "beckmann", "k_s": 1.0, "alpha": 0.1, "f_0": 0.04},
        {"model": "abg", "A": 1e-4, "B": 1e-3, "g": 2.0},
    ],
}  # fmt: skip
BRDFS |= MORE

ASIDE = (0.7, 1.0)  # theta, phi [rad] of the sources that have a direction
LOW = (1.25, 2.5)


def beam(irradiance: float, where: tuple[float, float]) -> dict[str, Any]:
    return {"kind": "collimated", "theta": where[0], "phi": where[1], "irradiance": irradiance}


def disk(degrees: float, where: tuple[float, float] = ASIDE) -> dict[str, Any]:
    return {"kind": "disk", "theta": where[0], "phi": where[1], "half_angle": math.radians(degrees), "radiance": 3.0}


def lobe(kappa: float) -> dict[str, Any]:
    return {"kind": "lobes", "amplitude": 2.0, "kappa": kappa, "theta": ASIDE[0], "phi": ASIDE[1]}


STUDIO = {
    "kind": "lobes",
    "amplitude": [5.0, 2.0, 1.0, 3.0],
    "kappa": [100.0, 30.0, 10.0, 60.0],
    "theta": [0.5, 1.2, 0.9, 2.0],
    "phi": [0.3, 2.0, 4.5, 5.5],
}
MAP = {
    "kind": "environment_map",
    "radiance": [
        [round(0.2 + math.sin(1.3 * i + 0.7 * j) ** 2 + (i == 2) * (j == 5) * 4.0, 6) for j in range(16)] for i in range(8)
    ],
}
SMOOTH = {**MAP, "interpolation": "smooth", "radiance": [[round(1.0 + v, 6) for v in row] for row in MAP["radiance"]]}
HARMONICS = {"kind": "spherical_harmonics", "coefficients": [3.0, 0.4, 0.9, -0.5, 0.3, -0.2, 0.35, 0.15, -0.25]}
SOURCES: dict[str, Terms] = {
    "beam": [beam(2.0, ASIDE)],
    "sphere": [{"kind": "uniform", "radiance": 1.0}],
    "sky": [{"kind": "hemispherical", "radiance": 1.0}],
    "tilted sky": [{"kind": "hemispherical", "radiance": 1.0, "axis": [0.4, -0.3, 0.8]}],
    "sky from the side": [{"kind": "hemispherical", "radiance": 1.0, "axis": [1.0, 0.2, 0.1]}],
    "overcast": [{"kind": "overcast", "zenith_radiance": 1.0}],
    "tilted overcast": [{"kind": "overcast", "zenith_radiance": 1.0, "axis": [-0.5, 0.2, 0.7]}],
    "sun": [disk(0.25)],
    "disk 5": [disk(5.0)],
    "low disk 20": [disk(20.0, LOW)],
    "disk 60": [disk(60.0)],
    "lobe 1": [lobe(1.0)],
    "lobe 100": [lobe(100.0)],
    "lobe 10000": [lobe(1e4)],
    "studio": [{"kind": "uniform", "radiance": 0.2}, STUDIO],
    "map": [MAP],
    "smooth map": [SMOOTH],
    "harmonics": [HARMONICS],
    "day": [{"kind": "overcast", "zenith_radiance": 0.5}, disk(0.25), beam(1.0, LOW)],
}


def gradient(theta_n: float, phi_n: float) -> tuple[float, float]:
    t = math.tan(theta_n)
    return -t * math.cos(phi_n), -t * math.sin(phi_n)


MORE_SOURCES = (
    "sphere", "tilted sky", "tilted overcast", "sun", "disk 5", "lobe 100", "studio", "map", "smooth map", "harmonics",
)  # fmt: skip
TILTS = (0.0, 30.0, 60.0, 85.0, 89.9)


def special(source: str) -> list[tuple[str, tuple[float, float]]]:
    """Gradients where a source with a direction is hard: it is mirrored, or its centre or rim is on the horizon."""
    part = SOURCES[source][0]
    if "theta" not in part or isinstance(part["theta"], list):
        return []
    theta, phi = part["theta"], part["phi"]
    found = [("mirror", gradient(theta / 2, phi))]
    step = math.radians(0.1)
    rise = math.pi / 2 - theta  # theta_n at which the centre is on the horizon, the surface turned away
    found.append(("terminator - 0.1", gradient(rise - step, phi + math.pi)))
    found.append(("terminator + 0.1", gradient(rise + step, phi + math.pi)))
    if part["kind"] == "disk" and part["half_angle"] < rise:
        found.append(("rim at the horizon", gradient(rise - part["half_angle"] + 0.1 * step, phi + math.pi)))
        found.append(("rim mirrored", gradient((theta + part["half_angle"]) / 2, phi)))
    return found


def feasible(brdf: str, degrees: float) -> bool:
    """A lobe of 1e-3 seen at 89.9 degrees is 2e-6 wide across: doubles leave it 1e-10."""
    return not (brdf == "ggx 0.001" and degrees > 89)


def problems() -> Iterator[dict[str, Any]]:
    """All scenes, without values."""
    for b, brdf in enumerate(name for name in BRDFS if name not in MORE):
        for s, source in enumerate(name for name in SOURCES if name not in ("smooth map", "harmonics")):
            if source == "beam" and brdf in ("mirror", "varnish"):
                continue  # a delta function of the gradient: no value
            for k in (0, 2) if source in ("sky", "map", "studio") else (0,):
                degrees = TILTS[(b + s + k) % len(TILTS)]
                if not feasible(brdf, degrees):
                    degrees = 30.0
                phi_n = (2.4 * b + 1.1 * s) % 6.28 if degrees else 0.0
                tags = [f"theta_n {degrees:g}"] + (["grazing"] if degrees > 80 else [])
                yield scene(brdf, source, gradient(math.radians(degrees), phi_n) if degrees else (0.0, 0.0), tags)
            hard = special(source)
            for k, (tag, at) in enumerate(hard):
                if brdf in ("satin", "phong 50") or k == b % len(hard):
                    yield scene(brdf, source, at, [tag])


    yield from more_problems()


def more_problems() -> Iterator[dict[str, Any]]:
    """Every other model under every kind of light, the hard gradients and the tilts in turn."""
    for b, brdf in enumerate(MORE):
        for s, source in enumerate(MORE_SOURCES):
            hard = special(source)
            phi_n = ASIDE[1] + 0.3 if hard else (1.7 * b + 0.9 * s) % 6.28  # a tilted surface sees the source
            tilts = [(f"theta_n {t:g}", gradient(math.radians(t), phi_n)) for t in TILTS]
            tilts[0] = ("theta_n 0", (0.0, 0.0))
            hard = hard + tilts[-2:] if hard else tilts
            for k in (0, 2) if source in ("sphere", "disk 5") else (0,):
                tag, at = hard[(b + s + k) % len(hard)]
                yield scene(brdf, source, at, [tag] + (["grazing"] if tag in ("theta_n 85", "theta_n 89.9") else []))


def scene(brdf: str, source: str, at: tuple[float, float], tags: list[str]) -> dict[str, Any]:
    widths = [t["alpha"] if "alpha" in t else t.get("n", 1.0) ** -0.5 for t in BRDFS[brdf]]
    more = ["narrow lobe"] if min(widths) < 0.04 else []
    kinked = ("clay", "rough clay", "regolith", "plaster", "ceramic", "lacquer", "grooves", "wide grooves")
    more += ["kinks"] if brdf in kinked or source == "map" else []
    more += ["small source"] if source in ("sun", "lobe 10000", "day") else []
    more += ["two horizons"] if "sky" in source or "overcast" in source else []
    return {"brdf": brdf, "source": source, "p": at[0], "q": at[1], "tags": tags + more}


def main() -> None:
    known: dict[str, dict[str, Any]] = {}
    if FILE.exists() and "--afresh" not in sys.argv:
        old = json.loads(FILE.read_text(encoding="utf-8"))
        for problem in old["problems"]:
            b, s = problem["brdf"], problem["source"]
            if old["brdfs"].get(b) == BRDFS.get(b) and old["sources"].get(s) == SOURCES.get(s):
                known[key(problem)] = problem
    done: list[dict[str, Any]] = []
    for problem in problems():
        if any(key(problem) == key(other) for other in done):
            continue
        if key(problem) in known:
            done.append({**known[key(problem)], "tags": problem["tags"]})
            continue
        full = {"brdf": BRDFS[problem["brdf"]], "source": SOURCES[problem["source"]], "p": problem["p"], "q": problem["q"]}
        value, second = (reflected_radiance(full, method) for method in ("normal", "other"))
        off = abs(value - second) / abs(value) if value else abs(second)
        if off > AGREEMENT:
            raise SystemExit(f"{problem}: {value!r} and {second!r} differ by {off:.1e}")
        done.append({**problem, "value": value, "second": second, "difference": off})
        tags = ", ".join(problem["tags"])
        print(f"{len(done):4d} {problem['brdf']:13s} {problem['source']:18s} {value:.16g} {off:.1e} {tags}", flush=True)
        if len(done) % 20 == 0:
            write(done + [p for k, p in known.items() if k not in {key(d) for d in done}])
    write(done)


def key(problem: dict[str, Any]) -> str:
    return f"{problem['brdf']}|{problem['source']}|{problem['p']!r}|{problem['q']!r}"


def write(done: list[dict[str, Any]]) -> None:
    """One problem a line."""
    head = json.dumps({"brdfs": BRDFS, "sources": SOURCES})[:-1]
    lines = ",\n".join(json.dumps(problem) for problem in done)
    FILE.write_text(f'{head}, "problems": [\n{lines}\n]}}\n', encoding="utf-8")


if __name__ == "__main__":
    main()
