"""What other people's programs read from the files that gonio writes, as figures: run by tests and by

    python -m tests.format_figures

which prints the table of docs/formats.md and writes it there. Truth is the BRDF that was exported, evaluated directly.
A figure of a format that no third-party program reads comes from a reader here or in `tests.format_readers`, written from
the format's definition and sharing no code with gonio's.
"""

from __future__ import annotations

import math
import platform
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import RegularGridInterpolator

import gonio
from gonio import formats
from gonio.brdf import grained
from gonio.brdf.tables import Tables
from gonio.brdf.tabulated import tabulate
from gonio.formats import Material, klems, peers, rgl
from gonio.geometry import unit_vector
from tests import materials
from tests.format_readers import Reader, albedo, binned_albedo, patch_points, random_pairs, ssdd_reader

Array = NDArray[np.float64]
BLACK = Path(__file__).parent / "data" / "optics-blacks" / "AnoBlackEC1onAlum.bsdf"
PAGE = Path(__file__).parents[1] / "docs" / "formats.md"
BEGIN, END = "<!-- figures: written by python -m tests.format_figures -->", "<!-- end of figures -->"


@dataclass(frozen=True)
class Figure:
    """One number, what it may be at most (infinite: told only), and what it is of."""

    format: str
    reader: str
    of: str
    what: str
    value: float
    limit: float = math.inf

    @property
    def met(self) -> bool:
        return bool(self.value <= self.limit)

    def row(self) -> str:
        limit = f"{self.limit:.1e}" if math.isfinite(self.limit) else "-"
        return f"| {self.format} | {self.reader} | {self.of} | {self.what} | {self.value:.1e} | {limit} |"


def measured_table() -> Material:
    """Anodised black, tabulated from 647 measured samples."""
    found = formats.material_of(tabulate(formats.read_samples(BLACK)))
    assert found is not None
    return found


def compare(
    name: str, reader: str, of: str, read: Reader, material: Material, limit: float, n: int, seed: int
) -> list[Figure]:
    """Between nodes, white furnace and reciprocity of a file as that reader sees it."""
    wi, wr = random_pairs(n, seed)
    truth, found = material.evaluate(wi, wr)[0], read(wi, wr)
    relative = np.abs(found / truth - 1)
    back = read(wr, wi)
    skew = np.abs(found - back) / (0.5 * (found + back))
    furnace = []
    for degrees in (0.0, 30.0, 60.0):
        own = albedo(lambda a, b: material.evaluate(a, b)[0], math.radians(degrees))
        furnace.append(abs(albedo(read, math.radians(degrees)) / own - 1))
    return [
        Figure(name, reader, of, "between nodes, rms", float(np.sqrt(np.mean(relative**2))), limit),
        Figure(name, reader, of, "between nodes, 95th percentile", float(np.quantile(relative, 0.95))),
        Figure(name, reader, of, "white furnace, largest of 0, 30, 60 degrees", max(furnace), 5e-3),
        Figure(name, reader, of, "reciprocity, rms", float(np.sqrt(np.mean(skew**2))), 5e-3),
        Figure(name, reader, of, "reciprocity, largest", float(skew.max())),
    ]


def rgl_figures(folder: Path, of: str, material: Material, n: int = 4000) -> list[Figure]:
    """Mitsuba's ``measured``."""
    path = folder / "rgl.bsdf"
    formats.export("rgl", path, material=material)
    bsdf = peers.mitsuba_bsdf(path)

    def read(wi: Array, wr: Array) -> Array:
        return peers.mitsuba_f_cos(bsdf, wi, wr)[:, 0] / wr[:, 2]

    fields = rgl.tensor.read(path)
    rng = np.random.default_rng(5)
    size = fields["luminance"].shape[-1]
    theta_i = fields["theta_i"].astype(float)[rng.integers(0, len(fields["theta_i"]) - 4, n)]
    theta_h, phi_h = rgl.half_vectors(size)
    m = unit_vector(theta_h[rng.integers(0, size, n)], phi_h[rng.integers(0, size, n)])
    wi = unit_vector(theta_i, 0.0)
    wr = 2 * np.sum(wi * m, axis=1)[:, None] * m - wi
    up = (np.sum(wi * m, axis=1) > 0) & (wr[:, 2] > 0.05)
    nodes = np.abs(read(wi[up], wr[up]) / material.evaluate(wi[up], wr[up])[0] - 1)
    out = [Figure("rgl", "mitsuba", of, "at nodes, largest", float(nodes.max()), 1e-4)]
    out += compare("rgl", "mitsuba", of, read, material, 5e-3, n, 1)
    direction = unit_vector(0.7, 0.0)
    mean, error = peers.mitsuba_albedo(bsdf, direction, 20_000, 3)
    own = albedo(lambda a, b: material.evaluate(a, b)[0], 0.7)
    away = max(abs(mean - own) - 4 * error, 0.0) / own
    out.append(Figure("rgl", "mitsuba", of, "albedo by its own sampling, less 4 standard errors", away, 5e-3))
    return out


def grain_figures(folder: Path, n: int = 4000) -> list[Figure]:
    """A brushed metal, which needs tables over four angles, through Mitsuba, and as a table stored and loaded."""
    material, of = materials.brushed(), "brushed, 0.15 and 0.4"
    formats.export("rgl", folder / "grain.bsdf", material=material)
    bsdf = peers.mitsuba_bsdf(folder / "grain.bsdf")
    wi, wr = random_pairs(n, 1)
    found, back = (peers.mitsuba_f_cos(bsdf, a, b)[:, 0] / b[:, 2] for a, b in ((wi, wr), (wr, wi)))
    relative = np.abs(found / material.evaluate(wi, wr)[0] - 1)
    skew = 2 * np.abs(found - back) / (found + back)
    Tables((grained.from_brdf(material.brdfs[0]),)).save(folder / "grain.nc")
    stored = np.abs(Tables.load(folder / "grain.nc").brdf().evaluate(wi, wr) / material.evaluate(wi, wr)[0] - 1)
    return [
        Figure("netcdf", "gonio", of, "between nodes, rms", float(np.sqrt(np.mean(stored**2))), 5e-3),
        Figure("netcdf", "gonio", of, "between nodes, 95th percentile", float(np.quantile(stored, 0.95))),
        Figure("rgl", "mitsuba", of, "between nodes, rms", float(np.sqrt(np.mean(relative**2)))),
        Figure("rgl", "mitsuba", of, "between nodes, 95th percentile", float(np.quantile(relative, 0.95))),
        Figure("rgl", "mitsuba", of, "reciprocity, rms", float(np.sqrt(np.mean(skew**2))), 5e-3),
    ]


def klems_figures(folder: Path, of: str, material: Material, probes: int = 40) -> list[Figure]:
    """pyWinCalc and Radiance; truth is the patch average by a finer quadrature."""
    path = folder / "klems.xml"
    formats.export("klems", path, material=material)
    basis = klems.FULL
    omega = basis.projected_solid_angle()
    found = peers.pywincalc_matrices(path)["back"]
    rng = np.random.default_rng(7)
    worst, furnace = 0.0, 0.0
    for i in rng.choice(145, 3, replace=False).tolist():
        incident = patch_points(basis, i, 4000, rng) * klems.MIRRORED
        for r in [i, *rng.choice(145, 4, replace=False).tolist()]:  # the mirror patch, and others
            value = material.evaluate(incident, patch_points(basis, r, 4000, rng))[0]
            error = float(value.std() / math.sqrt(len(value)))
            worst = max(worst, (abs(found[r, i] - float(value.mean())) - 4 * error) / found[r, i])
        t0, t1, _, _ = basis.patches()[i]
        node, weight = np.polynomial.legendre.leggauss(5)
        theta = np.arcsin(np.sqrt(np.sin(t0) ** 2 + (np.sin(t1) ** 2 - np.sin(t0) ** 2) * 0.5 * (node + 1)))
        mean = sum(
            0.5 * w * albedo(lambda a, b: material.evaluate(a, b)[0], float(t)) for w, t in zip(weight, theta, strict=True)
        )
        furnace = max(furnace, abs(float(found[:, i] @ omega) / mean - 1))
    skew = np.abs(found - found.T) / (0.5 * (found + found.T))
    i, r = rng.integers(0, 145, probes), rng.integers(0, 145, probes)
    centre = basis.centres()
    seen = peers.radiance_f_r(path, centre[i] * klems.MIRRORED, centre[r])[:, 1]
    ours = klems.read_matrices(path)[1][0]
    return [
        Figure(
            "klems",
            "pywincalc",
            of,
            "15 cells against patch means by 4000 random pairs, less 4 standard errors",
            max(worst, 0.0),
            5e-3,
        ),
        Figure("klems", "pywincalc", of, "white furnace of 3 patches, largest", furnace, 5e-3),
        Figure("klems", "pywincalc", of, "reciprocity, largest", float(skew.max()), 5e-3),
        Figure(
            "klems", "pywincalc", of, "cells against what was written, largest", float(np.abs(found / ours - 1).max()), 1e-6
        ),
        Figure("klems", "Radiance rtrace", of, f"{probes} cells, largest", float(np.abs(seen / ours[r, i] - 1).max()), 2e-3),
        Figure(
            "klems",
            "Radiance checkBSDF",
            of,
            "reciprocity error, mean",
            peers.radiance_reciprocity_percent(path)[1] / 100,
            5e-3,
        ),
    ]


def grid_figures(folder: Path, of: str, material: Material, bins: float, n: int = 4000) -> list[Figure]:
    """SSDD and MERL through readers of their definitions, NetCDF through its own table."""
    from tests.conformance.test_merl_binary import OriginalReader, bin_angles, bin_mean, pair

    formats.export("ssdd", folder / "a.ssdd", material=material)
    out = compare("ssdd", "linear interpolation", of, ssdd_reader(folder / "a.ssdd"), material, 5e-3, n, 1)
    formats.export("merl", folder / "a.binary", material=material)
    merl = OriginalReader(folder / "a.binary")

    wi, wr = random_pairs(n, 1)
    relative = np.abs(merl.green(wi, wr) / material.evaluate(wi, wr)[0] - 1)
    out.append(Figure("merl", "truncating look-up", of, "at random, rms", float(np.sqrt(np.mean(relative**2)))))
    rng, means = np.random.default_rng(8), []
    for k_h, k_d, k_p in rng.integers((0, 0, 0), (60, 45, 180), (60, 3)).tolist():
        far = pair(math.radians((k_h + 1) ** 2 / 90), math.radians(k_d + 1), math.radians(k_p + (k_p >= 90)))
        if min(far[0][2], far[1][2]) > 0.02:
            means.append(merl.stored(k_h, k_d, k_p)[1] / bin_mean(material.brdfs[0], k_h, k_d, k_p, 4) - 1)
    worst = float(np.abs(means).max())
    out.append(Figure("merl", "truncating look-up", of, f"{len(means)} bins against their means, largest", worst, bins))
    furnace = 0.0
    for degrees in (0.0, 30.0, 60.0):
        own = albedo(lambda a, b: material.evaluate(a, b)[0], math.radians(degrees))
        furnace = max(furnace, abs(binned_albedo(merl.green, math.radians(degrees)) / own - 1))
    out.append(Figure("merl", "truncating look-up", of, "white furnace, largest of 0, 30, 60 degrees", furnace, 5e-3))
    k = np.arange(90.0)
    lower = RegularGridInterpolator(
        (np.radians(k * k / 90), np.radians(k), np.radians(np.arange(180))), np.maximum(merl.plane(), 0), bounds_error=False,
        fill_value=None,
    )  # fmt: skip
    relative = np.abs(lower(np.stack(bin_angles(wi, wr), axis=-1)) / material.evaluate(wi, wr)[0] - 1)
    rms = float(np.sqrt(np.mean(relative**2)))
    out.append(Figure("merl", "interpolation between lower edges", of, "at random, rms", rms))
    return out


def netcdf_figures(folder: Path, of: str, brdf: gonio.BRDF, n: int = 4000) -> list[Figure]:
    """A table of the BRDF, stored and loaded."""
    from gonio.brdf.tabulated import TabulatedBRDF, from_brdf

    from_brdf(brdf).save(folder / "a.nc")
    loaded = TabulatedBRDF.load(folder / "a.nc").brdf()
    return compare("netcdf", "gonio (xarray reads the nodes)", of, loaded.evaluate, Material((brdf,)), 5e-3, n, 1)


def text_figures(folder: Path, of: str, material: Material) -> list[Figure]:
    """Text formats parsed by numpy alone, and the BiRD schemas."""
    out = []
    samples = material.rows()
    wi, wr = unit_vector(samples.theta_i, samples.phi_i), unit_vector(samples.theta_r, samples.phi_r)
    for name, skip, separator in (("alta", "#", None), ("astm", "VARS", ","), ("cornell", "#", None)):
        formats.export(name, folder / name, samples=samples)
        lines = (folder / name).read_text(encoding="utf-8").splitlines()
        start = {"astm": next((k for k, x in enumerate(lines) if x.startswith(skip)), 0) + 1, "alta": 0, "cornell": 0}[name]
        rows = [line for line in lines[start:] if line.strip() and not line.startswith("#")][2 if name == "cornell" else 0 :]
        table = np.array([[float(x) for x in line.split(separator)] for line in rows])
        pair = unit_vector(table[:, 0], table[:, 1]), unit_vector(table[:, 2], table[:, 3])
        out.append(Figure(name, "numpy", of, "at rows, largest", _largest(table[:, 4], material.evaluate(*pair)[0]), 1e-6))
    formats.export("bird", folder / "a.json", samples=samples)
    out.append(
        Figure("bird", "jsonschema", of, "violations of the schemas", float(len(peers.bird_errors(folder / "a.json"))), 0)
    )
    import json

    data = json.loads((folder / "a.json").read_text(encoding="utf-8"))["data"]
    a, b, c, d, f = (np.array(data[k]["values"]) for k in ("theta_i", "phi_i", "theta_r", "phi_r", "BRDF"))
    out.append(
        Figure(
            "bird",
            "json",
            of,
            "at rows, largest",
            _largest(f, material.evaluate(unit_vector(a, b), unit_vector(c, d))[0]),
            1e-6,
        )
    )
    formats.export("csv", folder / "a.csv", samples=samples)
    header = sum(x.startswith("#") for x in (folder / "a.csv").read_text(encoding="utf-8").splitlines()) + 1
    table = np.genfromtxt(folder / "a.csv", delimiter=",", skip_header=header)
    pair = unit_vector(*np.radians(table[:, :2]).T), unit_vector(*np.radians(table[:, 2:4]).T)
    out.append(Figure("csv", "numpy", of, "at rows, largest", _largest(table[:, 4], material.evaluate(*pair)[0]), 1e-6))
    formats.export("netcdf", folder / "s.nc", samples=samples)
    import xarray

    with xarray.open_dataset(folder / "s.nc", engine="h5netcdf") as data_set:
        value = data_set["brdf"].values[:, 0]
    out.append(Figure("netcdf", "xarray", of, "at rows, largest", _largest(value, material.evaluate(wi, wr)[0]), 1e-6))
    return out


def opticstudio_figures(folder: Path, of: str, material: Material) -> list[Figure]:
    """The text by its definition: specular-relative angles, TIS."""
    formats.export("opticstudio", folder / "a.bsdf", material=material)
    lines = [x for x in (folder / "a.bsdf").read_text(encoding="utf-8").splitlines() if x and not x.startswith("#")]
    words = [x.split() for x in lines]
    lists = {
        w[0]: [float(x) for x in words[k + 1]]
        for k, w in enumerate(words)
        if w[0] in ("AngleOfIncidence", "ScatterAzimuth", "ScatterRadial")
    }
    rows, worst, furnace = words[words.index(["DataBegin"]) + 1 :], 0.0, 0.0
    n = len(lists["ScatterAzimuth"])
    for k, degrees in enumerate(lists["AngleOfIncidence"]):
        block = np.array([[float(x) for x in row] for row in rows[k * (n + 1) + 1 : (k + 1) * (n + 1)]])
        a = math.radians(degrees)
        az, r = np.radians(lists["ScatterAzimuth"])[:, None], np.radians(lists["ScatterRadial"])
        s, towards = np.array([-math.sin(a), 0, math.cos(a)]), np.array([math.cos(a), 0, math.sin(a)])
        wr = np.cos(r)[..., None] * s + np.sin(r)[..., None] * (
            np.cos(az)[..., None] * towards + np.sin(az)[..., None] * np.array([0, 1.0, 0])
        )
        up = (wr[..., 2] > 1e-6) & (block > 0)
        wi = np.broadcast_to([math.sin(a), 0, math.cos(a)], wr[up].shape)
        worst = max(worst, _largest(block[up], material.evaluate(wi, wr[up])[0]))
        if degrees in (0.0, 30.0, 60.0):
            tis = float(rows[k * (n + 1)][1])
            furnace = max(furnace, abs(tis / albedo(lambda x, y: material.evaluate(x, y)[0], a) - 1))
    return [
        Figure("opticstudio", "its definition", of, "at nodes, largest", worst, 1e-6),
        Figure(
            "opticstudio",
            "its definition",
            of,
            "white furnace (TIS against albedo), largest of 0, 30, 60 degrees",
            furnace,
            5e-3,
        ),
    ]


def sphere_figure(folder: Path, of: str, material: Material, size: int = 48, spp: int = 64) -> Figure:
    """A sphere under a distant lamp, rendered by Mitsuba, against gonio's reflectance map averaged over the same pixels."""
    import mitsuba

    path = folder / "sphere.bsdf"
    formats.export("rgl", path, material=material)
    mitsuba.set_variant("scalar_rgb")
    mitsuba.set_log_level(mitsuba.LogLevel.Error)
    lamp = unit_vector(0.6, 0.4)
    scene = mitsuba.load_dict({
        "type": "scene",
        "integrator": {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0},
        "sensor": {
            "type": "orthographic",
            "to_world": mitsuba.ScalarTransform4f().look_at(origin=[0, 0, 5], target=[0, 0, 0], up=[0, 1, 0]),
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "box"}},
            "sampler": {"type": "stratified", "sample_count": spp, "seed": 1},
        },
        "sphere": {"type": "sphere", "bsdf": {"type": "measured", "filename": str(path)}},
        "lamp": {"type": "directional", "direction": (-lamp).tolist(), "irradiance": {"type": "rgb", "value": [1.0] * 3}},
    })  # fmt: skip
    image = np.array(mitsuba.render(scene))[..., 0]
    k = 8
    at = (np.arange(size * k) + 0.5) / (size * k) * 2 - 1
    x, y = np.meshgrid(at, -at)  # rows run downwards
    inside = x * x + y * y < 0.97
    z = np.sqrt(np.maximum(1 - x * x - y * y, 0.01))
    source = gonio.source.collimated(float(np.arccos(lamp[2])), float(np.arctan2(lamp[1], lamp[0])), 1.0)
    values = np.zeros(x.shape)
    values[inside] = gonio.reflectance_map(material.brdfs[0], source, (-x / z)[inside], (-y / z)[inside], rtol=1e-6).value
    mean = values.reshape(size, k, size, k).mean(axis=(1, 3))
    whole = inside.reshape(size, k, size, k).all(axis=(1, 3)) & (mean > 0.05 * mean.max())
    relative = image[whole] / mean[whole] - 1
    return Figure(
        "rgl", "mitsuba, rendered sphere", of, f"{int(whole.sum())} pixels, rms", float(np.sqrt(np.mean(relative**2))), 1e-2
    )


def _largest(found: Array, truth: Array) -> float:
    return float(np.abs(found / truth - 1).max())


def figures(folder: Path) -> list[Figure]:
    """All of the page."""
    synthetic, table = materials.single(0.1), measured_table()
    paint, black = "Lambert + GGX 0.1", "measured black"
    out = rgl_figures(folder, paint, synthetic) + rgl_figures(folder, black, table)
    out += grain_figures(folder)
    out.append(sphere_figure(folder, paint, synthetic))
    for of, material in ((paint, synthetic), (black, table)):
        out += klems_figures(folder, of, material)
        out += grid_figures(folder, of, material, 1e-6 if material is synthetic else 1e-3)  # the table's cubics have borders
        out += text_figures(folder, of, material)
        out += opticstudio_figures(folder, of, material)
    return out + netcdf_figures(folder, paint, synthetic.brdfs[0])


def main() -> None:
    with tempfile.TemporaryDirectory() as name:
        found = figures(Path(name))
    head = [BEGIN, "", "| format | reader | of | figure | value | at most |", "|---|---|---|---|---|---|"]
    text = "\n".join([*head, *(f.row() for f in found), "", END])
    print(text)
    print(platform.python_version(), [f.what for f in found if not f.met])
    if PAGE.exists():
        page = PAGE.read_text(encoding="utf-8")
        if BEGIN in page:
            PAGE.write_text(page[: page.index(BEGIN)] + text + page[page.index(END) + len(END) :], encoding="utf-8")
    sys.exit(0 if all(f.met for f in found) else 1)


if __name__ == "__main__":
    main()
