"""The report: pictures of real objects, one HTML file that stands alone, and a JSON twin that says the same."""

from __future__ import annotations

import base64
import io
import json
import math
from html.parser import HTMLParser
from pathlib import Path

import numpy as np
import pytest

import gonio.brdf
from gonio import report
from gonio.brdf.base import BRDF
from gonio.errors import DatasetError
from gonio.geometry import gradient_from_normal
from gonio.maps import ReflectanceMap
from gonio.posterior import Posterior
from gonio.report import content, contours, html, slices, style
from gonio.report.residuals import expected_reading, residuals, verdict
from gonio.samples import BRDFSamples, SharedError

HOSTILE = "<script>alert('x')</script> \"quoted\" & $\\frac{ \x00"
TRUTH = {"lambertian.albedo": 0.5, "ggx.k_s": 1.0, "ggx.alpha": 0.2, "ggx.f_0": 0.06, "shared.scale": 0.004}


def paint(albedo: float = 0.5, alpha: float = 0.2, f_0: float = 0.06) -> BRDF:
    return gonio.brdf.make("lambertian", albedo=albedo) + gonio.brdf.make("ggx", k_s=1.0, alpha=alpha, f_0=f_0)


@pytest.fixture(scope="module")
def samples() -> BRDFSamples:
    """Six angles of incidence, in and out of plane; scale off by 0.4 %, arm by 0.1 degrees, 1 % noise."""
    rng = np.random.default_rng(11)
    grid = np.radians(
        [(i, r, phi) for i in (0, 15, 30, 45, 60, 70) for r in np.arange(2.0, 80.0, 7.5) for phi in (0, 90, 178.0, 180)]
    )
    theta_i, theta_r, phi = grid.T
    n = len(grid)
    d_omega_i = np.zeros((n, 3, 2))
    d_omega_i[:, 0, 1], d_omega_i[:, 2, 1] = np.cos(theta_i), -np.sin(theta_i)
    d_ln_f = np.zeros((n, 2))
    d_ln_f[:, 0] = 1.0
    f = paint().f_r(theta_i, 0.0, theta_r, phi)
    shared = (SharedError("scale", 0.005), SharedError("arm", 0.0017, 0.0002, "rad"))
    bare = BRDFSamples(
        theta_i, np.zeros(n), theta_r, phi, f, 0.01 * f, np.arange(n), shared, d_omega_i, np.zeros((n, 3, 2)), d_ln_f,
        {"quantity": "BRDF f_r [1/sr]", "material": HOSTILE},
    )  # fmt: skip
    exact = expected_reading(bare, paint(), np.array([0.004, np.radians(0.1)]))
    return BRDFSamples(**{**vars(bare), "f_r": exact + bare.u_f_r * rng.normal(size=n)})


@pytest.fixture(scope="module")
def posterior() -> Posterior:
    rng = np.random.default_rng(12)
    names = ("lambertian.albedo", "ggx.alpha", "ggx.f_0", "shared.scale", "shared.arm")
    centre, sd = np.array([0.501, 0.2, 0.0602, 0.003, np.radians(0.09)]), np.array([3e-3, 1e-3, 6e-4, 3e-3, 3e-4])
    draws = centre + sd * rng.normal(size=(4, 400, 5))
    diagnostics = {
        "converged": True, "tau": dict.fromkeys(names, 31.0), "ess": dict.fromkeys(names, 2000.0),
        "rhat": dict.fromkeys(names, 1.002), "acceptance": 0.41, "chi2_per_n": 1.02, "n_samples": 264, "advice": "",
    }  # fmt: skip
    log_probability = -0.5 * np.sum(((draws - centre) / sd) ** 2, axis=-1)
    return Posterior("lambertian+ggx", names, draws, log_probability, {"ggx.k_s": 1.0}, diagnostics)


@pytest.fixture(scope="module")
def lit_map() -> ReflectanceMap:
    """Lambert's cosine for a collimated source at theta = 35, phi = 40 degrees, by its textbook formula."""
    p_s, q_s = (float(x) for x in gradient_from_normal(np.radians(35.0), np.radians(40.0)))
    axis = np.linspace(-3.0, 3.0, 97)
    p, q = axis[None, :], axis[:, None]
    cosine = (1 + p * p_s + q * q_s) / np.sqrt((1 + p * p + q * q) * (1 + p_s**2 + q_s**2))
    value = np.maximum(cosine, 0.0) * 0.8 / np.pi
    band = np.stack((value * (0.99 - 0.005 * np.abs(p)), value * (1.01 + 0.005 * np.abs(p))))
    return ReflectanceMap(axis, axis, value, 1e-12 * value, band, sources=((p_s, q_s),), attributes={"source": "sun"})


class Page(HTMLParser):
    """Everything a test asks of a page."""

    VOID = frozenset({"meta", "img", "br", "link", "hr", "input"})

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.open: list[str] = []
        self.text: dict[str, list[str]] = {}
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag not in self.VOID:
            self.open.append(tag)
            self.text.setdefault(tag, []).append("")

    def handle_endtag(self, tag: str) -> None:
        assert self.open and self.open[-1] == tag
        self.open.pop()

    def handle_data(self, data: str) -> None:
        for tag in set(self.open):
            self.text[tag][-1] += data

    def pictures(self) -> list[bytes]:
        sources = [str(attributes["src"]) for tag, attributes in self.tags if tag == "img"]
        assert all(source.startswith("data:image/png;base64,") for source in sources)
        return [base64.b64decode(source.partition(",")[2], validate=True) for source in sources]


def pixels(png: bytes) -> np.ndarray:
    from PIL import Image

    with Image.open(io.BytesIO(png)) as image:
        return np.asarray(image.convert("RGB"))


def is_drawn(png: bytes) -> bool:
    """Wide enough to print, and neither blank nor a solid block."""
    image = pixels(png)
    ink = np.mean(np.any(image != 255, axis=-1))
    colours = np.unique(image.astype(np.int64) @ (65536, 256, 1)).size
    return image.shape[1] > 400 and 0.005 < ink < 0.95 and colours > 20


@pytest.fixture(scope="module")
def built(tmp_path_factory, samples, posterior, lit_map) -> Path:
    folder = tmp_path_factory.mktemp("run")
    return report.build(
        folder,
        title=f"Report of {HOSTILE}",
        samples=samples,
        posterior=posterior,
        maps={"sun": lit_map, HOSTILE: lit_map},
        truth=TRUTH,
        attributes={"seed": 7, HOSTILE: HOSTILE, "lamp_hours": math.inf},
        warnings=[f"lamp {HOSTILE}"],
        documents={"rig.toml": f"# {HOSTILE}\n[rig]\n", HOSTILE: "x"},
    )


def test_page_stands_alone_and_is_well_formed(built: Path) -> None:
    text = built.read_text(encoding="utf-8")
    page = Page(text)
    tags = [tag for tag, _ in page.tags]
    assert not {"script", "link", "iframe", "object", "embed", "form", "base"} & set(tags)
    assert all(not name.startswith("on") and name != "style" for _, attributes in page.tags for name in attributes)
    assert all(tag == "img" for tag, attributes in page.tags if {"src", "href", "srcset"} & set(attributes))
    policy = next(a["content"] or "" for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    assert "default-src 'none'" in policy and "unsafe" not in policy and "script-src" not in policy
    assert built.stat().st_size < 10_000_000


def test_policy_admits_exactly_the_style_inside(built: Path) -> None:
    import hashlib

    page = Page(built.read_text(encoding="utf-8"))
    policy = next(a["content"] or "" for tag, a in page.tags if a.get("http-equiv") == "Content-Security-Policy")
    digest = base64.b64encode(hashlib.sha256(page.text["style"][0].encode()).digest()).decode()
    assert f"style-src 'sha256-{digest}'" in policy


def test_hostile_names_are_text(built: Path) -> None:
    text = built.read_text(encoding="utf-8")
    assert "<script" not in text and "\x00" not in text
    page = Page(text)
    shown = HOSTILE.replace("\x00", "�")
    assert page.text["h1"] == [f"Report of {shown}"]
    assert any(shown in item for item in page.text["li"])
    assert any(shown in item for item in page.text["td"])
    assert any(shown in item for item in page.text["pre"])
    assert any(shown in str(a.get("alt")) for tag, a in page.tags if tag == "img")


def test_warnings_come_first(built: Path) -> None:
    text = built.read_text(encoding="utf-8")
    assert text.index("Warnings") < text.index("Summary") < text.index("Fig. 1.")


def test_every_figure_is_drawn_and_captioned(built: Path) -> None:
    page = Page(built.read_text(encoding="utf-8"))
    pictures, captions = page.pictures(), page.text["figcaption"]
    files = sorted(path.name for path in (built.parent / "figures").iterdir())
    assert len(pictures) == len(captions) == len(files) == 7
    assert all(is_drawn(picture) for picture in pictures)
    assert all(is_drawn((built.parent / "figures" / name).read_bytes()) for name in files)
    assert {"slices.png", "residuals.png", "coverage.png", "corner.png", "trace.png", "map_1_sun.png"} < set(files)
    assert all("/" not in name and "<" not in name for name in files)
    for word in ("Reflectance map", "plane of incidence", "Residuals", "half and difference angles", "Posterior", "chains"):
        assert any(word in caption for caption in captions)
    twin = json.loads((built.parent / "report.json").read_text())
    assert [f"Fig. {k}. {text}".replace("\x00", "�") for k, text in enumerate(twin["figures"], 1)] == captions


def test_what_a_reader_must_be_told(built: Path) -> None:
    page = Page(built.read_text(encoding="utf-8"))
    everything = " ".join(page.text["body"])
    for said in (
        "dL_r/dE_i", "1/sr", "phi_i + 180 degrees", "k = 1", "k = 2", "chi2/N = 1.02", "converged", "tau 31", "ESS 2000",
        "R-hat 1.002", "0.41", "lambertian+ggx", "ggx.k_s = 1", "seed", gonio.__version__, np.__version__,
    ):  # fmt: skip
        assert said in everything, said


def test_twin_is_strict_json_with_the_same_numbers(built: Path, posterior: Posterior) -> None:
    def refuse(name: str) -> float:
        raise AssertionError(f"{name} is not JSON")

    twin = json.loads((built.parent / "report.json").read_text(), parse_constant=refuse)
    assert twin["data"]["parameters"]["ggx.alpha"]["median"] == pytest.approx(np.median(posterior.draws[..., 1]))
    assert twin["data"]["attributes"]["lamp_hours"] is None
    assert twin["title"] == f"Report of {HOSTILE}"
    assert twin["data"]["diagnostics"]["converged"] is True


def test_parameter_table_shows_angles_in_degrees_and_distance_from_truth(posterior, samples) -> None:
    table = content.parameters(posterior, TRUTH, samples)
    rows = {str(row[0]): dict(zip(table.header[1:4], row[1:4], strict=True)) | {"z": row[-1]} for row in table.rows}
    arm = np.degrees(np.median(posterior.draws[..., 4]))
    assert rows["shared.arm"]["unit"] == "deg" and rows["shared.arm"]["median"] == pytest.approx(arm)
    alpha = posterior.draws[..., 1].ravel()
    assert rows["ggx.alpha"]["z"] == pytest.approx((np.median(alpha) - 0.2) / np.std(alpha), rel=0.01)
    assert rows["shared.arm"]["truth"] is None and rows["shared.scale"]["truth"] == 0.004


def test_budget_carries_shared_errors_through_the_model(samples: BRDFSamples) -> None:
    """A scale error moves every reading by its own size; the arm moves a Lambertian surface not at all."""
    table = content.budget(samples, gonio.brdf.make("lambertian", albedo=0.5))
    assert table is not None
    median = {str(row[0]): row[3] for row in table.rows}
    assert median["random, each sample"] == pytest.approx(1.0, rel=0.1)
    assert median["scale, shared"] == pytest.approx(0.5, rel=1e-6)
    assert median["arm, shared"] == pytest.approx(0.0, abs=1e-9)
    rough = content.budget(samples, paint())
    assert rough is not None and float(rough.rows[2][4] or 0.0) > 0.5  # the lobe's flank feels 0.1 degrees


def test_residuals_of_the_truth_are_unit_normal(samples: BRDFSamples) -> None:
    exact = {"shared.scale": 0.004, "shared.arm": float(np.radians(0.1))}
    left = residuals(samples, paint(), exact)
    n = len(samples)
    assert abs(np.mean(left.pull)) < 4 / math.sqrt(n)
    assert abs(left.chi2_per_n - 1.0) < 4 * math.sqrt(2 / n)
    assert residuals(samples, paint()).chi2_per_n > left.chi2_per_n  # without the shared errors


def test_residual_uncertainty_has_the_slope_and_the_inferred_noise() -> None:
    """Lambert: no slope. A cosine-free check of the slope: f_r read with a scale error of its own in every sample."""
    n = 5
    angle = np.full(n, 0.3)
    brdf = gonio.brdf.make("lambertian", albedo=0.6)
    f = np.full(n, 0.6 / np.pi)
    known = np.array([0.01, 0.01, 0.01, np.nan, np.nan])
    zero = np.zeros((n, 3, 1))
    one = BRDFSamples(
        angle, 0 * angle, angle, 0 * angle, f, known, np.arange(n), (SharedError("scale", 0.1, 0.02),), zero, zero,
        np.ones((n, 1)),
    )  # fmt: skip
    left = residuals(one, brdf, {"noise.relative": 0.05, "noise.absolute": 0.003})
    per_sample = 0.02 * f[0]
    assert left.u[:3] == pytest.approx(math.hypot(0.01, per_sample))
    assert left.u[3:] == pytest.approx(math.sqrt((0.05 * f[0]) ** 2 + 0.003**2 + per_sample**2))
    assert np.all(np.isnan(residuals(one, brdf).u[3:]))


def test_verdict_names_the_consequence() -> None:
    assert "does not describe" in verdict(2.0, 300) and "do not quote" in verdict(2.0, 300)
    assert "inferred discrepancy" in verdict(2.0, 300, discrepancy=True)
    assert "does not test" in verdict(1.0, 300, noise="inferred")
    assert "scatter less" in verdict(0.3, 300)
    assert verdict(1.1, 300).endswith("within their uncertainties.")
    assert "not known" in verdict(math.nan, 300)
    assert "does not" not in verdict(2.0, 8)  # 8 samples scatter that much


def test_bad_fits_are_warned_about(samples: BRDFSamples, posterior: Posterior) -> None:
    worse = dict(posterior.diagnostics) | {
        "converged": False, "chi2_per_n": 3.0, "advice": ["run 5000 more steps"], "contraction": {"ggx.f_0": 0.1},
    }  # fmt: skip
    poor = Posterior(posterior.model, posterior.names, posterior.draws, posterior.log_probability, posterior.fixed, worse)
    found = " ".join(content.warnings_of(samples, poor))
    for said in ("not converged", "5000 more steps", "chi2/N = 3, expected 1", "hardly constrain ggx.f_0"):
        assert said in found
    assert content.warnings_of(samples, posterior) == []


def test_contour_levels_are_round_and_inside() -> None:
    linear = contours.levels(np.linspace(0.0, 0.256, 1001))
    assert linear[0] > 0 and linear[-1] < 0.256 and np.ptp(np.diff(linear)) < 1e-12
    assert len(contours.levels(np.full(100, 0.3))) == 0
    spread = contours.levels(np.concatenate((np.full(900, 0.1), np.geomspace(0.1, 100.0, 100))))
    assert np.all(np.diff(np.log(spread)) > 0.2) and spread[-1] > 10.0


def test_map_marks_source_and_terminator_where_theory_has_them(lit_map: ReflectanceMap) -> None:
    figure = contours.map_contours(lit_map, title=HOSTILE)
    axes = figure.axes[0]
    assert axes.get_aspect() == 1.0 and axes.get_xlabel() == "$p$" and axes.get_ylabel() == "$q$"
    lines = [np.asarray(line.get_xydata()) for line in axes.get_lines()]
    ((p_s, q_s),) = lit_map.sources
    assert any(len(line) == 1 and line[0] == pytest.approx((p_s, q_s)) for line in lines)
    edge = next(line for line in lines if len(line) == 2)
    assert 1 + edge @ (p_s, q_s) == pytest.approx([0.0, 0.0], abs=1e-9)  # cos theta_i = 0
    assert len(figure.axes) == 2 and is_drawn(style.png(figure))


def test_maps_that_are_hard_to_draw(lit_map: ReflectanceMap) -> None:
    axis = np.linspace(-1.0, 1.0, 5)
    flat = ReflectanceMap(axis, axis, np.full((5, 5), 0.25), np.zeros((5, 5)), impulses=((0.2, 0.1, 1.5),))
    assert is_drawn(style.png(contours.map_contours(flat)))
    holes = np.where(lit_map.value > 0.1, lit_map.value, np.nan)
    assert is_drawn(style.png(contours.map_contours(ReflectanceMap(lit_map.p, lit_map.q, holes, holes))))
    dark = ReflectanceMap(axis, axis, np.zeros((5, 5)), np.zeros((5, 5)), sources=((0.0, 0.0),))
    assert is_drawn(style.png(contours.map_contours(dark)))
    with pytest.raises(DatasetError, match="no contours"):
        contours.map_contours(ReflectanceMap(axis, axis, np.full((5, 5), np.nan), np.zeros((5, 5))))


def test_in_plane_angle_is_positive_on_the_mirror_side() -> None:
    some = BRDFSamples.plain(0.5, 0.0, [0.3, 0.3, 0.3], [np.pi, 0.0, np.pi / 2], [1.0, 1.0, 1.0])
    signed, offset = slices.in_plane_angle(some)
    assert signed == pytest.approx([0.3, -0.3, 0.0], abs=1e-12)
    assert offset == pytest.approx([0.0, 0.0, 0.3], abs=1e-12)


def test_incidence_angles_are_those_measured(samples: BRDFSamples) -> None:
    assert np.degrees(slices.incidence_angles(samples.theta_i, 6)) == pytest.approx([0, 15, 30, 45, 60, 70])
    spread = slices.incidence_angles(np.radians(np.random.default_rng(1).uniform(0, 80, 4000)), 5)
    assert len(spread) == 5 and np.all(np.diff(spread) >= np.radians(2.9))
    assert slices.incidence_angles(np.zeros(0), 6).size == 0


def test_slice_draws_model_and_measurement_where_they_are(samples: BRDFSamples) -> None:
    figure = slices.brdf_slices(samples, paint(), truth=paint(albedo=0.4), band=[paint(), paint(alpha=0.21)])
    labels = [text.get_text() for text in figure.legends[0].get_texts()]
    assert {"68 % band", "fit, median", "truth"} < set(labels)
    axes = next(a for a in figure.axes if a.get_title(loc="left").startswith(r"$\theta_i$ = 45"))
    line = next(line for line in axes.get_lines() if line.get_label() == "fit, median")
    x, y = (np.asarray(v, dtype=float) for v in line.get_data())
    peak = x[np.argmax(np.where(np.abs(x) < 60, y, 0.0))]
    assert 43 < peak < 52  # near the mirror direction, pushed outwards by shadowing and Fresnel
    assert y[np.argmin(np.abs(x + 30))] == pytest.approx(float(paint().f_r(np.radians(45), 0.0, np.radians(30), 0.0)))
    assert all("1/sr" in a.get_ylabel() for a in (figure.axes[0], figure.axes[3]))


def test_truth_is_drawn_only_if_it_is_complete() -> None:
    whole = content.brdf_from(TRUTH)
    assert whole is not None and whole.parameters() == {n: v for n, v in TRUTH.items() if not n.startswith("shared.")}
    assert content.brdf_from({"ggx.alpha": 0.2}) is None
    assert content.brdf_from({"oren_nayar.albedo": 0.5, "oren_nayar.sigma": 0.3}) is None  # of two variants
    assert content.brdf_from({"shared.scale": 0.004}) is None


def test_samples_without_uncertainty_or_in_no_plane(tmp_path: Path) -> None:
    out = BRDFSamples.plain(0.6, 0.0, np.linspace(0.4, 0.9, 7), np.pi / 2, np.full(7, 0.1))
    assert is_drawn(style.png(slices.brdf_slices(out, paint())))
    assert is_drawn(style.png(slices.residual_plot(out, residuals(out, paint()))))
    path = report.build(tmp_path, samples=out)
    page = Page(path.read_text(encoding="utf-8"))
    assert any("no uncertainty" in item for item in page.text["li"])
    empty = out.select(np.zeros(7, dtype=bool))
    assert Page(report.build(tmp_path, samples=empty).read_text(encoding="utf-8")).text["h1"] == ["BRDF report"]


def test_corner_and_trace_bear_constant_and_hostile_parameters(posterior: Posterior) -> None:
    draws = posterior.draws.copy()
    draws[..., 2] = 0.06
    names = ("lambertian.albedo", HOSTILE, "ggx.f_0", "shared.scale", "shared.arm")
    odd = Posterior(posterior.model, names, draws, posterior.log_probability, {}, {})
    assert is_drawn(style.png(report.corner(odd, {HOSTILE: 0.2})))
    assert is_drawn(style.png(report.trace(odd)))
    with pytest.raises(DatasetError, match="nothing"):
        report.corner(posterior, names=["nothing"])


def test_no_trace_in_global_state(posterior: Posterior) -> None:
    import matplotlib
    from matplotlib._pylab_helpers import Gcf

    before = matplotlib.rcParams.copy()
    first = style.png(report.corner(posterior))
    assert matplotlib.rcParams.copy() == before
    assert first == style.png(report.corner(posterior))  # the same picture, byte for byte
    assert Gcf.get_all_fig_managers() == []  # pyplot keeps no figure alive


def test_page_too_large_is_refused_and_nothing_written(tmp_path: Path) -> None:
    documents = {f"log {k}": "&" * 199_000 for k in range(11)}
    with pytest.raises(DatasetError, match="10 MB"):
        html.write_report(tmp_path / "report.html", title="t", documents=documents)
    assert list(tmp_path.iterdir()) == []


def test_interrupted_write_leaves_the_old_file(tmp_path: Path) -> None:
    target = tmp_path / "report.html"
    html.write_bytes(target, b"old")
    with pytest.raises(TypeError):
        html.write_bytes(target, "not bytes")  # type: ignore[arg-type]
    assert target.read_bytes() == b"old" and [path.name for path in tmp_path.iterdir()] == ["report.html"]


def test_the_band_of_readings_is_that_of_curve_and_noise_together():
    """One known curve with 10 % and 0.05 1/sr of noise: a normal distribution; curves of sd 0.3: the sum of variances."""
    low, high = slices.readings_band(np.array([[1.0, 2.0]]), np.array([[0.1, 0.05]]))
    sd = np.hypot(0.1 * np.array([1.0, 2.0]), 0.05)
    assert high - [1.0, 2.0] == pytest.approx(1.96 * sd, rel=0.03)
    assert [1.0, 2.0] - low == pytest.approx(1.96 * sd, rel=0.03)
    curves = np.random.default_rng(1).normal(5.0, 0.3, (4000, 1))
    low, high = slices.readings_band(curves, np.tile([0.0, 0.4], (4000, 1)))
    assert high - low == pytest.approx(2 * 1.96 * np.hypot(0.3, 0.4), rel=0.04)
