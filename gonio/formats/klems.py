r"""Klems matrices in WINDOW XML: patch averages on 145 (full), 77 (half) or 41 (quarter) patches of the hemisphere.

``ScatteringData`` holds f_r [1/sr] for each pair of an incident and a reflected patch, without solid angle or cosine. The
incident vector of patch (theta, phi) is (-x, -y, z) of the reflected one's, so specular is on the diagonal. Structure
``Columns``: the file runs over reflected patches, and within each over incident ones; ``Rows`` is the transpose.

Written are averages over both patches, each weighted with the projected solid angle, by Gauss quadrature:
reciprocity of the BRDF is so kept exactly, and :math:`\sum_r f\,\Omega_r` is the patch's mean albedo. The sample is
opaque: front and back are the same. XML's "Reflection Back" is what Radiance shows on its +z side. Linear RGB becomes the
blocks CIE-X, Visible (Y) and CIE-Z; of a spectrum the channel nearest to 555 nm is Visible. A comma follows every value, as
pyWinCalc wants it.

Read are the same bases and custom ones, reflection only: samples at patch centres whose values are patch averages. Tensor
trees are refused.

References
----------
.. [1] J. H. Klems, "A New Method for Predicting the Solar Heat Gain of Complex Fenestration Systems", ASHRAE Trans. 100(1),
   1994.
.. [2] LBNL Radiance, src/common/bsdf_m.c (patches, directions, sides).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from xml.sax.saxutils import escape

import numpy as np
from numpy.typing import NDArray

from gonio import files
from gonio.channels import SINGLE, XYZ, ChannelSamples
from gonio.errors import DatasetError
from gonio.formats import rows, xml_text
from gonio.formats.material import Material

Array = NDArray[np.float64]
MOST_PATCHES = 1500


@dataclass(frozen=True)
class Basis:
    """Patches of the hemisphere: bounds of the rings [deg] and how many patches each has."""

    name: str
    bounds_deg: tuple[float, ...]
    n_phi: tuple[int, ...]

    def __len__(self) -> int:
        return sum(self.n_phi)

    def patches(self) -> Array:
        """theta_0, theta_1, phi_0, phi_1 [rad] of each patch, shape (n, 4); patch k of a ring is centred at 2 pi k / n."""
        out = []
        for low, high, n in zip(self.bounds_deg, self.bounds_deg[1:], self.n_phi, strict=False):
            for k in range(n):
                out.append((np.radians(low), np.radians(high), 2 * np.pi * (k - 0.5) / n, 2 * np.pi * (k + 0.5) / n))
        return np.array(out)

    def projected_solid_angle(self) -> Array:
        """Of each patch [sr], shape (n,)."""
        t0, t1, p0, p1 = self.patches().T
        return np.asarray(0.5 * (np.sin(t1) ** 2 - np.sin(t0) ** 2) * (p1 - p0))

    def centres(self) -> Array:
        """Reflected unit vectors of the patches, shape (n, 3); the first ring of one patch is the normal."""
        t0, t1, p0, p1 = self.patches().T
        theta, phi = np.where(p1 - p0 > 6.28, 0.0, 0.5 * (t0 + t1)), 0.5 * (p0 + p1)
        return np.stack((np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)), axis=-1)

    def points(self, n: int) -> list[tuple[Array, Array]]:
        """Of each patch quadrature points (m, 3) and weights (m,), which add to 1, even in projected solid angle."""
        node, weight = np.polynomial.legendre.leggauss(n)
        out = []
        for t0, t1, p0, p1 in self.patches():
            # in mu = cos(theta), of which a BRDF is smooth at the horizon; the weight mu d mu is integrated exactly
            c = np.cos(t1) + (np.cos(t0) - np.cos(t1)) * 0.5 * (node + 1.0)
            w_theta = weight * c / (np.cos(t0) + np.cos(t1))
            if p1 - p0 > 6.28:  # a full turn: even steps are the best rule for what is periodic
                phi, w_phi = 2 * np.pi * np.arange(2 * n) / (2 * n), np.full(2 * n, 0.5 / n)
            else:
                phi, w_phi = p0 + (p1 - p0) * 0.5 * (node + 1.0), 0.5 * weight
            c, s = c[:, None], np.sqrt(1.0 - c * c)[:, None]
            points = np.stack(np.broadcast_arrays(s * np.cos(phi), s * np.sin(phi), c), axis=-1)
            out.append((points.reshape(-1, 3), np.outer(w_theta, w_phi).ravel()))
        return out


FULL = Basis("LBNL/Klems Full", (0, 5, 15, 25, 35, 45, 55, 65, 75, 90), (1, 8, 16, 20, 24, 24, 24, 16, 12))
HALF = Basis("LBNL/Klems Half", (0, 6.5, 19.5, 32.5, 45.5, 58.5, 71.5, 90), (1, 8, 12, 16, 20, 12, 8))
QUARTER = Basis("LBNL/Klems Quarter", (0, 9, 27, 45, 63, 90), (1, 8, 12, 12, 8))
BASES = {basis.name.lower(): basis for basis in (FULL, HALF, QUARTER)}
MIRRORED = np.array([-1.0, -1.0, 1.0])


def sniff(head: bytes) -> bool:
    """XML with a window element."""
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    return start[:1] == b"<" and b"WindowElement" in head


def averages(material: Material, basis: Basis = FULL) -> Array:
    """Patch averages [1/sr], shape (c, reflected patch, incident patch).

    Each pair is integrated with more and more points until two results agree to 3e-4. Pairs that an isotropic BRDF cannot
    tell apart are integrated once, over one azimuth less.
    """
    size = len(basis)
    patches = basis.patches()
    r, i = (k.ravel() for k in np.meshgrid(np.arange(size), np.arange(size), indexing="ij"))
    # the first rule must see the lobe: two points within its width
    start = int(np.clip(np.ceil(0.27 / material.lobe_width()), 3, 10))
    steps = (start, start + 2, start + 5, start + 9, start + 16)
    if not material.isotropic:
        points = [basis.points(n) for n in steps[:4]]
        value = np.array([_converged(_mean_4(material, p[a], p[b]) for p in points) for a, b in zip(r, i, strict=True)])
        return np.ascontiguousarray(value.T).reshape(-1, size, size)
    ring = np.repeat(np.arange(len(basis.n_phi)), basis.n_phi)
    azimuth = np.concatenate([np.arange(n) / n for n in basis.n_phi])  # turns
    key = np.stack((ring[r], ring[i], np.round(np.mod(azimuth[r] - azimuth[i] + 1e-9, 1.0) * 1e6)), axis=-1)
    _, first, index = np.unique(key, axis=0, return_index=True, return_inverse=True)
    value = np.array([_converged(_mean_3(material, patches[r[k]], patches[i[k]], n) for n in steps) for k in first])
    return np.ascontiguousarray(value[index.ravel()].T).reshape(-1, size, size)


def _converged(means: Iterable[Array]) -> Array:
    """The first mean that agrees with the one before, or the last."""
    before = None
    for mean in means:
        if before is not None and np.all(np.abs(mean - before) <= 3e-4 * np.abs(mean)):
            break
        before = mean
    return mean


def _mean_4(material: Material, reflected: tuple[Array, Array], incident: tuple[Array, Array]) -> Array:
    """Mean over all pairs of points of two patches, shape (c,)."""
    (wr, weight_r), (wi, weight_i) = reflected, incident
    value = material.evaluate((wi * MIRRORED)[None, :, :], wr[:, None, :])
    return np.asarray(np.einsum("cri,r,i->c", value, weight_r, weight_i))


def _mean_3(material: Material, reflected: Array, incident: Array, n: int) -> Array:
    """Mean over two patches (theta_0, theta_1, phi_0, phi_1) of an isotropic BRDF, which knows one azimuth, shape (c,)."""
    (c_r, weight_r), (c_i, weight_i) = (_cosines(patch, n) for patch in (reflected, incident))
    delta, weight = _azimuths(reflected, incident, n)
    s_r, s_i = (np.sqrt(1.0 - c * c) for c in (c_r, c_i))
    shape = (n, n, len(delta))
    wi = np.stack(np.broadcast_arrays(-s_i[None, :, None], 0.0, np.broadcast_to(c_i[None, :, None], shape)), axis=-1)
    x, y = s_r[:, None, None] * np.cos(delta), s_r[:, None, None] * np.sin(delta)
    wr = np.stack(np.broadcast_arrays(x, y, np.broadcast_to(c_r[:, None, None], shape)), axis=-1)
    return np.asarray(np.einsum("cria,r,i,a->c", material.evaluate(wi, wr), weight_r, weight_i, weight))


def _cosines(patch: Array, n: int) -> tuple[Array, Array]:
    """Cosines (n,) and weights that add to 1, even in projected solid angle; crowded at a horizon that bounds it."""
    node, weight = np.polynomial.legendre.leggauss(n)
    low, high = np.cos(patch[1]), np.cos(patch[0])
    if low < 1e-9:
        u = 0.5 * (node + 1.0)
        c, w = high * u * u, weight * u  # dc = 2 high u du
    else:
        c, w = low + (high - low) * 0.5 * (node + 1.0), weight
    return c, w * c / np.sum(w * c)


def _azimuths(reflected: Array, incident: Array, n: int) -> tuple[Array, Array]:
    """Azimuth differences and weights that add to 1, for azimuths even within both patches; crowded at specular, 0.

    The density of the difference is the convolution of two boxes.
    """
    a, b = 0.5 * (reflected[3] - reflected[2]), 0.5 * (incident[3] - incident[2])  # half widths
    middle = 0.5 * (reflected[2] + reflected[3] - incident[2] - incident[3])
    middle -= 2 * np.pi * np.round(middle / (2 * np.pi))
    if max(a, b) > 3.14:
        ends, middle, flat = np.array([-np.pi, np.pi]), 0.0, np.inf
    else:
        ends, flat = middle + np.array([-a - b, -abs(a - b), abs(a - b), a + b]), abs(a - b)
    grazing = reflected[1] > 1.57 and incident[1] > 1.57  # there the lobe's azimuth width goes to 0
    crowd = 0.5 ** (np.arange(0, 16, 2) if grazing else np.arange(4))
    inside = np.concatenate([[0.0], crowd, -crowd])
    breaks = np.unique(np.concatenate((ends, inside[(inside > ends[0]) & (inside < ends[-1])])))
    node, weight = np.polynomial.legendre.leggauss(max(n // 2, 4))
    width = np.diff(breaks)[:, None]
    at = (breaks[:-1, None] + width * 0.5 * (node + 1.0)).ravel()
    density = np.ones_like(at) if np.isinf(flat) else np.clip(a + b - np.abs(at - middle), 0.0, a + b - flat)
    w = (width * weight).ravel() * density
    return at, w / np.sum(w)


def read(path: Path) -> ChannelSamples:
    """Samples at the centres of the patches; `DatasetError` if the file is damaged or holds no reflection matrix."""
    basis, blocks, side = read_matrices(path)
    channels = XYZ if len(blocks) == 3 else SINGLE
    centre = basis.centres()
    theta, phi = np.arccos(np.clip(centre[:, 2], -1, 1)), np.arctan2(centre[:, 1], centre[:, 0])
    n = len(basis)
    r, i = np.divmod(np.arange(n * n), n)
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf, averaged over an incident and a reflected patch",
        "source_format": "klems",
        "basis": basis.name,
        "side": side,
    }
    value = blocks.reshape(len(channels), -1).T
    return ChannelSamples.make(theta[i], phi[i] + np.pi, theta[r], phi[r], value, channels, attributes=attributes)


def read_matrices(path: Path) -> tuple[Basis, Array, str]:
    """Basis, matrices (c, reflected, incident) [1/sr], and the side they belong to."""
    root = xml_text.parse(path)
    definition = next(root.all("DataDefinition"), None)
    if root.name != "WindowElement" or definition is None:
        raise DatasetError(f"{path}: the XML has no WindowElement with a DataDefinition; it is no BSDF of WINDOW")
    structure = definition.words("IncidentDataStructure").lower()
    if structure.startswith("tensortree"):
        raise DatasetError(f"{path} is a tensor tree, which gonio does not read; convert it to Klems first")
    if structure not in ("columns", "rows"):
        raise DatasetError(f"{path}: IncidentDataStructure {files.shown(structure)} must be Columns or Rows")
    custom = {b.name.lower(): b for b in (_custom(path, e) for e in definition.all("AngleBasis")) if b is not None}
    found: dict[tuple[str, str], tuple[Basis, Array]] = {}
    for data in root.all("WavelengthData"):
        colour = data.words("Wavelength").lower()
        for block in data.all("WavelengthDataBlock"):
            side = block.words("WavelengthDataDirection").lower()
            if not side.startswith("reflection"):
                continue
            names = [block.words(k).lower() for k in ("ColumnAngleBasis", "RowAngleBasis")]
            if names[0] != names[1]:
                raise DatasetError(f"{path}: incident and reflected basis differ ({names[0]!r:.40}, {names[1]!r:.40})")
            basis = custom.get(names[0]) or BASES.get(names[0])
            if basis is None:
                raise DatasetError(
                    f"{path}: the angle basis {files.shown(names[0])} is neither known nor defined in the file"
                )
            words = block.words("ScatteringData").replace(",", " ").split()
            n = len(basis)
            if len(words) != n * n:
                raise DatasetError(
                    f"{path}: {side} has {len(words)} values, {basis.name} needs {n * n}; the file is damaged"
                )
            value = np.array(files.numbers(words, f"{path}, {side} {colour}")).reshape(n, n)
            if np.any(value < 0):
                raise DatasetError(f"{path}: a value of {value.min():g} in {side} is negative; a BRDF has none")
            found[side, colour] = basis, value if structure == "columns" else value.T
    sides = [s for s in ("reflection front", "reflection back") if any(k[0] == s for k in found)]
    if not sides:
        raise DatasetError(f"{path} holds no reflection matrix; gonio reads reflection only")
    side = sides[0]
    colours = ("cie-x", "visible", "cie-z")
    if all((side, c) in found for c in colours):
        chosen = [found[side, c] for c in colours]
    else:
        chosen = [found.get((side, "visible")) or next(v for k, v in found.items() if k[0] == side)]
    if len({b for b, _ in chosen}) != 1:
        raise DatasetError(f"{path}: the colours use different bases; the file is damaged")
    return chosen[0][0], np.stack([m for _, m in chosen]), side


def _custom(path: Path, element: xml_text.Element) -> Basis | None:
    name = element.words("AngleBasisName")
    bounds: list[float] = []
    counts: list[int] = []
    for block in element.all("AngleBasisBlock"):
        where = f"{path}, angle basis {files.shown(name)}"
        limits = block.find("ThetaBounds")
        if limits is None:
            raise DatasetError(f"{where}: a block has no ThetaBounds; the file is damaged")
        low, high = (files.number(limits.words(k), where) for k in ("LowerTheta", "UpperTheta"))
        if (bounds and abs(low - bounds[-1]) > 1e-6) or not 0 <= low < high <= 90 + 1e-6:
            raise DatasetError(f"{where}: rings must follow each other within 0 to 90 degrees; the file is damaged")
        bounds += [low, high] if not bounds else [high]
        counts.append(files.whole(block.words("nPhis"), where, MOST_PATCHES))
    if not counts:
        return None
    if sum(counts) > MOST_PATCHES:
        raise DatasetError(f"{path}: an angle basis of {sum(counts)} patches, at most {MOST_PATCHES} are read")
    return Basis(name, tuple(bounds), tuple(counts))


def write(path: Path, material: Material, attributes: Mapping[str, str] | None = None) -> None:
    """Write patch averages on the full basis: Visible alone, or CIE-X, Visible and CIE-Z."""
    if material.channels.kind == "rgb":
        material = material.tristimulus()
    if material.channels.kind != "xyz":
        material = material.one()
    write_matrices(path, FULL, averages(material), {**material.attributes, **(attributes or {})})


def write_matrices(path: Path, basis: Basis, matrices: Array, attributes: Mapping[str, str]) -> None:
    """Write matrices (c, reflected, incident), c = 1 or 3 (X, Y, Z); numbers come back bit for bit."""
    name = escape(rows.one_line(attributes.get("material", "sample"), 200))
    comment = "; ".join(f"{rows.one_line(k)}: {rows.one_line(v)}" for k, v in sorted(attributes.items())).replace(
        "--", "- -"
    )
    rings = []
    for low, high, n in zip(basis.bounds_deg, basis.bounds_deg[1:], basis.n_phi, strict=False):
        centre = 0.0 if n == 1 else 0.5 * (low + high)
        rings.append(
            f"<AngleBasisBlock><Theta>{centre:g}</Theta><nPhis>{n}</nPhis><ThetaBounds><LowerTheta>{low:g}</LowerTheta>"
            f"<UpperTheta>{high:g}</UpperTheta></ThetaBounds></AngleBasisBlock>"
        )
    colours = ("CIE-X", "Visible", "CIE-Z") if len(matrices) == 3 else ("Visible",)
    data = []
    for colour, matrix in zip(colours, matrices, strict=True):
        text = "\n".join("".join(f"{v!r}, " for v in row) for row in matrix.tolist())
        for side in ("Reflection Front", "Reflection Back"):
            data.append(
                f'<WavelengthData><LayerNumber>System</LayerNumber><Wavelength unit="Integral">{colour}</Wavelength>'
                "<SourceSpectrum>CIE Illuminant D65 1nm.ssp</SourceSpectrum>"
                f"<DetectorSpectrum>ASTM E308 1931 Y.dsp</DetectorSpectrum><WavelengthDataBlock>"
                f"<WavelengthDataDirection>{side}</WavelengthDataDirection>"
                f"<ColumnAngleBasis>{basis.name}</ColumnAngleBasis><RowAngleBasis>{basis.name}</RowAngleBasis>"
                f"<ScatteringDataType>BRDF</ScatteringDataType><ScatteringData>\n{text}\n</ScatteringData>"
                "</WavelengthDataBlock></WavelengthData>"
            )
    rows.put(
        path,
        '<?xml version="1.0" encoding="UTF-8"?>\n'
        f"<!-- BRDF f_r [1/sr], averages over incident and reflected patches; {escape(comment)} -->\n"
        '<WindowElement xmlns="http://windows.lbl.gov" xmlns:xsi="http://www.w3.org/2001/XMLSchema-instance">\n'
        "<WindowElementType>System</WindowElementType><FileType>BSDF</FileType>\n<Optical><Layer>\n"
        f"<Material><Name>{name}</Name><Manufacturer>unknown</Manufacturer>"
        '<Thickness unit="Millimeter">1</Thickness><Width unit="Millimeter">100</Width>'
        '<Height unit="Millimeter">100</Height>'
        "<DeviceType>Other</DeviceType></Material>\n"
        "<DataDefinition><IncidentDataStructure>Columns</IncidentDataStructure>\n"
        f"<AngleBasis><AngleBasisName>{basis.name}</AngleBasisName>\n"
        + "\n".join(rings) + "\n</AngleBasis></DataDefinition>\n"
        + "\n".join(data) + "\n</Layer></Optical>\n</WindowElement>\n",
    )  # fmt: skip
