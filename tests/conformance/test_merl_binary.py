"""MERL files read back by a reader that shares no code with gonio, written from the format's definition.

Definition (Matusik et al., ACM TOG 22(3), 2003, and the reading code distributed with the database): three little-endian
int32 90, 90, 180; float64 planes red, green, blue; index ``phi_d + 180 (theta_d + 90 theta_h)``; scales 1/1500, 1.15/1500,
1.66/1500; theta_h bin ``int(sqrt(theta_h / 90 deg) * 90)``; phi_d folded by pi. The reader truncates, as the original does.
"""

from __future__ import annotations

import math
import struct
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

import gonio
from gonio import formats
from gonio.brdf.tabulated import from_brdf, node_directions, tabulate
from gonio.errors import ConfigurationError, DatasetError
from gonio.formats import merl

Array = NDArray[np.float64]
Vector = tuple[float, float, float]


class OriginalReader:
    """Look-up by truncation in the file's bytes, one direction pair at a time."""

    def __init__(self, path: Path) -> None:
        self.data = path.read_bytes()
        assert struct.unpack_from("<3i", self.data) == (90, 90, 180)
        assert len(self.data) == 12 + 8 * 3 * 90 * 90 * 180

    def stored(self, k_h: int, k_d: int, k_p: int) -> tuple[float, float, float]:
        index = k_p + 180 * (k_d + 90 * k_h)
        rgb = [struct.unpack_from("<d", self.data, 12 + 8 * (index + plane * 90 * 90 * 180))[0] for plane in range(3)]
        return rgb[0] / 1500.0, rgb[1] * 1.15 / 1500.0, rgb[2] * 1.66 / 1500.0

    def __call__(self, wi: Vector, wr: Vector) -> tuple[float, float, float]:
        h = [a + b for a, b in zip(wi, wr, strict=True)]
        length = math.sqrt(sum(a * a for a in h))
        h = [a / length for a in h]
        theta_h, phi_h = math.acos(min(h[2], 1.0)), math.atan2(h[1], h[0])

        def turn_z(v: Vector, angle: float) -> Vector:
            c, s = math.cos(angle), math.sin(angle)
            return (c * v[0] - s * v[1], s * v[0] + c * v[1], v[2])

        def turn_y(v: Vector, angle: float) -> Vector:
            c, s = math.cos(angle), math.sin(angle)
            return (c * v[0] + s * v[2], v[1], -s * v[0] + c * v[2])

        d = turn_y(turn_z(wi, -phi_h), -theta_h)
        theta_d, phi_d = math.acos(min(max(d[2], -1.0), 1.0)), math.atan2(d[1], d[0])
        if phi_d < 0:
            phi_d += math.pi
        k_h = min(int(math.sqrt(theta_h / (math.pi / 2)) * 90), 89)
        k_d = min(int(theta_d / (math.pi / 2) * 90), 89)
        k_p = min(int(phi_d / math.pi * 180), 179)
        return self.stored(k_h, k_d, k_p)

    def plane(self) -> Array:
        """The green channel [1/sr], shape (90, 90, 180)."""
        at = 12 + 8 * 90 * 90 * 180
        return np.frombuffer(self.data, dtype="<f8", count=90 * 90 * 180, offset=at).reshape(90, 90, 180) * 1.15 / 1500.0

    def green(self, wi: Array, wr: Array) -> Array:
        """The green channel at many pairs (n, 3), by the same formulas on arrays."""
        theta_h, theta_d, phi_d = bin_angles(wi, wr)
        k_h = np.minimum(np.sqrt(theta_h / (math.pi / 2)) * 90, 89).astype(int)
        k_d, k_p = np.minimum(theta_d / (math.pi / 2) * 90, 89), np.minimum(phi_d / math.pi * 180, 179)
        return self.plane()[k_h, k_d.astype(int), k_p.astype(int)]


def bin_angles(wi: Array, wr: Array) -> tuple[Array, Array, Array]:
    """theta_h, theta_d and phi_d in [0, pi) of pairs (n, 3), as the database's code finds them."""
    h = (wi + wr) / np.linalg.norm(wi + wr, axis=1, keepdims=True)
    theta_h, phi_h = np.arccos(np.minimum(h[:, 2], 1.0)), np.arctan2(h[:, 1], h[:, 0])
    c, s = np.cos(-phi_h), np.sin(-phi_h)
    x, y = c * wi[:, 0] - s * wi[:, 1], s * wi[:, 0] + c * wi[:, 1]
    c, s = np.cos(-theta_h), np.sin(-theta_h)
    x, z = c * x + s * wi[:, 2], -s * x + c * wi[:, 2]
    theta_d, phi_d = np.arccos(np.clip(z, -1.0, 1.0)), np.arctan2(y, x)
    phi_d[phi_d < 0] += math.pi
    return theta_h, theta_d, phi_d


def pair(theta_h: float, theta_d: float, phi_d: float) -> tuple[Vector, Vector]:
    """Directions of half and difference angles, phi_h = 0, by the textbook: wi = R_y(theta_h) d, wr = 2 (wi h) h - wi."""
    d = (math.sin(theta_d) * math.cos(phi_d), math.sin(theta_d) * math.sin(phi_d), math.cos(theta_d))
    c, s = math.cos(theta_h), math.sin(theta_h)
    wi = (c * d[0] + s * d[2], d[1], -s * d[0] + c * d[2])
    h = (s, 0.0, c)
    dot = sum(a * b for a, b in zip(wi, h, strict=True))
    return wi, (2 * dot * h[0] - wi[0], 2 * dot * h[1] - wi[1], 2 * dot * h[2] - wi[2])


def value(brdf: gonio.BRDF, wi: Vector, wr: Vector) -> float:
    return float(brdf.evaluate(np.array(wi), np.array(wr)))


@pytest.fixture(scope="module")
def truth() -> gonio.BRDF:
    return gonio.brdf.make("lambertian", albedo=0.4) + gonio.brdf.make("ggx", k_s=1.0, alpha=0.3, f_0=0.04)


@pytest.fixture(scope="module")
def file(truth: gonio.BRDF, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("merl") / "paint.binary"
    formats.export("merl", path, brdf=truth)
    return path


def test_size_and_header(file: Path) -> None:
    assert file.stat().st_size == 34_992_012
    assert file.read_bytes()[:12] == bytes.fromhex("5a0000005a000000b4000000")
    assert formats.sniff(file) == "merl"


def bin_mean(brdf: gonio.BRDF, k_h: int, k_d: int, k_p: int, n: int = 6) -> float:
    """Mean over a bin above the horizon, weighted cos(theta_i) cos(theta_r) d omega_i d omega_r, by n^3 Gauss points."""
    node, weight = np.polynomial.legendre.leggauss(n)
    node = 0.5 * (node + 1)
    total = mean = 0.0
    for a, w_a in zip(node, weight, strict=True):
        theta_h = math.radians((k_h**2 + a * (2 * k_h + 1)) / 90)
        for b, w_b in zip(node, weight, strict=True):
            theta_d = math.radians(k_d + b)
            for c, w_c in zip(node, weight, strict=True):
                wi, wr = pair(theta_h, theta_d, math.radians(k_p + c))
                w = w_a * w_b * w_c * math.sin(theta_h) * math.sin(2 * theta_d) * wi[2] * wr[2]
                total, mean = total + w, mean + w * value(brdf, wi, wr)
    return mean / total


def test_bins_hold_the_mean_of_the_brdf(file: Path, truth: gonio.BRDF) -> None:
    reader, rng, compared = OriginalReader(file), np.random.default_rng(1), 0
    for k_h, k_d, k_p in rng.integers(0, (90, 90, 180), (40, 3)).tolist():
        far = pair(math.radians((k_h + 1) ** 2 / 90), math.radians(k_d + 1), math.radians(k_p + (k_p >= 90)))
        if min(far[0][2], far[1][2]) < 0.02:
            continue
        compared += 1
        for channel in reader.stored(k_h, k_d, k_p):
            assert channel == pytest.approx(bin_mean(truth, k_h, k_d, k_p), rel=1e-6)
    assert compared > 15


@pytest.mark.parametrize("degrees", [0, 30, 60, 75])
def test_white_furnace_of_the_truncating_look_up(file: Path, truth: gonio.BRDF, degrees: int) -> None:
    """Each bin's mean carries its energy: the reader's directional albedo is the BRDF's."""
    theta_i, rng = math.radians(degrees), np.random.default_rng(4)
    wi = np.array([math.sin(theta_i), 0.0, math.cos(theta_i)])
    # midpoints in u, theta_h = u^2 pi/2, some twenty for each bin; d omega_r = 4 cos(theta_d) d omega_h
    u, phi = (np.arange(2000)[:, None] + 0.5) / 2000, 2 * math.pi * (np.arange(90) + rng.random((2000, 1))) / 90
    theta = u * u * math.pi / 2
    h = np.stack(np.broadcast_arrays(np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=-1)
    dot = h @ wi
    wr = 2 * dot[..., None] * h - wi
    up = (dot > 0) & (wr[..., 2] > 0)
    weight = (dot * np.sin(theta) * u)[up] * wr[up][:, 2]
    incident = np.broadcast_to(wi, wr[up].shape)
    found = np.sum(weight * OriginalReader(file).green(incident, wr[up]))
    assert found == pytest.approx(np.sum(weight * truth.evaluate(incident, wr[up])), rel=5e-4)


def test_truncating_look_up(file: Path, truth: gonio.BRDF) -> None:
    """Anywhere up to 80 degrees the original reader is within a bin's width of the truth, without bias of a percent."""
    reader, rng, pairs, found = OriginalReader(file), np.random.default_rng(2), [], []
    for _ in range(3000):
        a, b = np.arccos(rng.uniform(math.cos(math.radians(80)), 1, 2))
        phi = rng.uniform(0, 2 * math.pi, 2)
        angles = zip((a, b), phi, strict=True)
        wi, wr = ((math.sin(t) * math.cos(p), math.sin(t) * math.sin(p), math.cos(t)) for t, p in angles)
        pairs.append((wi, wr))
        found.append(reader(wi, wr)[1])
    omega_i, omega_r = np.moveaxis(np.array(pairs), 1, 0)
    np.testing.assert_allclose(reader.green(omega_i, omega_r), found, rtol=1e-12)
    ratio = found / truth.evaluate(omega_i, omega_r)
    assert abs(np.mean(ratio) - 1) < 0.005
    assert np.std(ratio) < 0.02
    assert min(ratio) > 0.8 and max(ratio) < 1.25


def test_below_the_horizon_is_negative(file: Path) -> None:
    """A bin is negative only if none of its corners is above the horizon."""
    reader, rng, negative = OriginalReader(file), np.random.default_rng(3), 0
    for k_h, k_d, k_p in rng.integers(0, (90, 90, 180), (1500, 3)).tolist():
        corners = [
            pair(math.radians((k_h + i) ** 2 / 90), math.radians(k_d + j), math.radians(k_p + k))
            for i in (0, 1) for j in (0, 1) for k in (0, 1)
        ]  # fmt: skip
        stored = reader.stored(k_h, k_d, k_p)[0]
        if stored < 0:
            negative += 1
            assert max(min(wi[2], wr[2]) for wi, wr in corners) < 1e-6
        else:
            assert max(min(wi[2], wr[2]) for wi, wr in corners) > 0
    assert negative > 100


def test_a_table_is_exported_as_it_is(tmp_path: Path, truth: gonio.BRDF) -> None:
    table = from_brdf(truth)
    formats.export("merl", tmp_path / "t.binary", table=table)
    reader = OriginalReader(tmp_path / "t.binary")
    assert reader.stored(20, 30, 45)[0] == pytest.approx(bin_mean(table.brdf(), 20, 30, 45), rel=1e-6)


def test_read_gives_scattered_samples_of_the_truth(file: Path, truth: gonio.BRDF) -> None:
    samples = formats.read_samples(file)
    assert 15_000 < len(samples) < 25_000
    # the mean of a bin against the value at its centre
    error = samples.f_r / truth.evaluate(samples.omega_i(), samples.omega_r()) - 1
    assert np.sqrt(np.mean(error**2)) < 4e-3 and np.abs(error).max() < 0.05
    high = np.maximum(samples.theta_i, samples.theta_r) < np.radians(84)
    assert np.sqrt(np.mean(error[high] ** 2)) < 1e-3 and abs(np.mean(error[high])) < 4e-4
    assert np.all(np.isnan(samples.u_f_r))
    assert samples.attributes["n_missing"] == "0" and samples.attributes["source_file"] == "paint.binary"
    assert len(formats.read_channels(file).channels) == 1  # three equal planes


def test_read_gives_colours(file: Path, tmp_path: Path) -> None:
    data = np.frombuffer(file.read_bytes(), dtype="<f8", offset=12).reshape(3, 90, 90, 180)
    coloured = np.where(data < 0, data, data * np.array([0.5, 1.0, 2.0])[:, None, None, None])
    (tmp_path / "a").write_bytes(file.read_bytes()[:12] + coloured.tobytes())
    red, green, blue = (formats.read_samples(tmp_path / "a", channel=name).f_r for name in ("red", "green", "blue"))
    np.testing.assert_allclose(np.stack((red, blue)), np.stack((0.5 * green, 2 * green)), rtol=1e-14)
    with pytest.raises(ConfigurationError, match="no channel 'infrared'"):
        formats.read_samples(tmp_path / "a", channel="infrared")


def test_file_to_table(file: Path, truth: gonio.BRDF) -> None:
    """What `gonio import` and `gonio table` make of a MERL file."""
    table = tabulate(formats.read_samples(file))
    omega_i, omega_r, _ = node_directions(table.shape, table.scale)
    known = (table.coverage == 1) | (table.coverage == 2)
    error = np.abs(table.value / truth.evaluate(omega_i, omega_r) - 1)[known]
    assert np.median(error) < 0.005 and np.quantile(error, 0.9) < 0.05


def test_invalid_bins_are_missing(file: Path, tmp_path: Path) -> None:
    data = np.frombuffer(file.read_bytes(), dtype="<f8", offset=12).reshape(3, 90, 90, 180).copy()
    data[:, :, 40:] = -1.0
    path = tmp_path / "holes.binary"
    path.write_bytes(file.read_bytes()[:12] + data.tobytes())
    samples = formats.read_samples(path)
    assert int(samples.attributes["n_missing"]) > 1000
    cosine = np.sum(samples.omega_i() * samples.omega_r(), axis=-1)  # of 2 theta_d
    assert np.degrees(np.arccos(np.clip(cosine, -1, 1))).max() / 2 < 40


def test_damaged_files(file: Path, tmp_path: Path) -> None:
    data = bytearray(file.read_bytes())
    path = tmp_path / "bad.binary"
    path.write_bytes(data[:-8])
    with pytest.raises(DatasetError, match="has 34992004 bytes, a MERL file has 34992012"):
        formats.read(path)
    path.write_bytes(struct.pack("<3i", 65536, 65536, 1) + bytes(data[12:100]))  # the product is 0 in 32 bits
    with pytest.raises(DatasetError, match=r"sizes \[65536, 65536, 1\]"):
        merl.read(path)
    data[12 + 8 * 7 : 12 + 8 * 8] = struct.pack("<d", math.nan)
    path.write_bytes(data)
    with pytest.raises(DatasetError, match="value 7 of 4374000 is not finite"):
        formats.read(path)
    path.write_bytes(bytes(data[:12]) + struct.pack("<d", -1.0) * (3 * 90 * 90 * 180))
    with pytest.raises(DatasetError, match="no value is valid"):
        formats.read(path)
    path.write_bytes(b"")
    with pytest.raises(DatasetError, match="it is no MERL file"):
        merl.read(path)


def test_a_write_that_fails_leaves_the_old_file(file: Path, tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="cannot be written"):
        formats.export("merl", tmp_path / "nowhere" / "x.binary", brdf=gonio.brdf.make("lambertian", albedo=0.5))
    assert not list(tmp_path.iterdir())
