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

from collections.abc import Mapping
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

    def points(self, n: int) -> tuple[Array, Array]:
        """Quadrature points (patches, n * n, 3) and weights (n * n,), which add to 1, even in projected solid angle."""
        node, weight = np.polynomial.legendre.leggauss(n)
        node, weight = 0.5 * (node + 1.0), 0.5 * weight
        t0, t1, p0, p1 = self.patches().T
        s2 = np.sin(t0)[:, None] ** 2 + (np.sin(t1) ** 2 - np.sin(t0) ** 2)[:, None] * node  # sin^2 theta
        phi = p0[:, None] + (p1 - p0)[:, None] * node
        s, c = np.sqrt(s2)[:, :, None], np.sqrt(1.0 - s2)[:, :, None]
        phi = phi[:, None, :]
        out = np.stack(np.broadcast_arrays(s * np.cos(phi), s * np.sin(phi), c), axis=-1)
        return out.reshape(len(self), n * n, 3), np.outer(weight, weight).ravel()


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
    """Patch averages [1/sr], shape (c, reflected patch, incident patch)."""
    # points per patch and axis: two within the reflected lobe's half width at least
    n = int(np.clip(np.ceil(0.27 / material.lobe_width()), 4, 8))
    points, weight = basis.points(n)
    size = len(basis)
    out = np.empty((len(material.channels), size, size))
    for k in range(size):
        wi = points[k] * MIRRORED
        value = material.evaluate(wi[None, :, None, :], points[:, None, :, :])  # (c, size, n n, n n)
        out[:, :, k] = np.einsum("coir,i,r->co", value, weight, weight)
    return out


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
