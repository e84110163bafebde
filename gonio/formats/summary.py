"""What a file holds, in numbers: quantity, channels, coverage, energy, reciprocity. What `gonio info` prints."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio import files, formats
from gonio.brdf import grained
from gonio.brdf.base import BRDF
from gonio.brdf.tables import Tables
from gonio.brdf.tabulated import tabulate
from gonio.channels import ChannelSamples
from gonio.errors import DatasetError, IntegrationError
from gonio.formats import quantity as quantities
from gonio.integrate import directional_albedo, reflectance_map
from gonio.samples import BRDFSamples
from gonio.source import uniform

Array = NDArray[np.float64]
ALBEDO_DEG = (0.0, 30.0, 60.0)
MOST = 20_000  # samples of which a table is made to judge the energy
SAME = 1e-4  # directions closer than this [rad] count as one
MOST_GRAINED = 5_000
HEMISPHERE_BINS = 6 * 6  # of azimuth, from the incident to the mirror side, and of polar angle


def describe(path: Path, quantity: str | None = None) -> dict[str, Any]:
    """Facts of a file of any known format, ready for JSON.

    Raises
    ------
    DatasetError
        If the file cannot be read.
    """
    name = formats.sniff(path)
    form = formats.FORMATS[name]
    found = formats.read(path, quantity)
    out: dict[str, Any] = {"file": str(path), "bytes": files.size_of(path), "format": name, "format_doc": form.doc}
    stated = quantity or form.quantity or found.attributes.get("source_quantity", "brdf")
    word, space, rest = stated.partition(" ")
    out["quantity_in_file"] = quantities.QUANTITIES.get(word, word) + space + rest
    out["quantity_read"] = quantities.QUANTITIES["brdf"]
    if isinstance(found, Tables):
        out |= {
            "table_nodes": list(found.main.shape),
            "grain": found.grained,
            "channels": list(found.channels.names),
            "coverage": found.counts(),
            "attributes": dict(found.attributes),
        }
        return out | energy_of(found)
    channels = ChannelSamples.of(found) if isinstance(found, BRDFSamples) else found
    one = found if isinstance(found, BRDFSamples) else found.channel()
    out |= {
        "samples": len(channels),
        "channels": list(channels.channels.names),
        "channel_shown": one.attributes.get("channel", channels.channels.names[0]),
        "attributes": dict(channels.attributes),
    }
    grain = grained.shown_by(one)
    return out | {"grain": grain} | coverage_of(one) | reciprocity_of(one, grain) | energy_of(one, grain)


def coverage_of(samples: BRDFSamples) -> dict[str, Any]:
    """Which directions there are, and how far up the values and uncertainties go."""
    incidence = np.unique(np.round(np.degrees(samples.theta_i), 3))
    azimuth = np.unique(np.round(np.degrees(samples.phi_i), 3))
    relative = np.arccos(np.clip(np.cos(samples.phi_r - samples.phi_i), -1.0, 1.0))  # both sides of the plane count as one
    of_azimuth = np.minimum(np.floor(relative / np.pi * 6 + 1e-9), 5).astype(int)
    bins = of_azimuth * 6 + np.minimum(np.floor(samples.theta_r / (np.pi / 2) * 6), 5).astype(int)
    known = np.isfinite(samples.u_f_r)
    out: dict[str, Any] = {
        "incidences_deg": incidence.tolist() if len(incidence) <= 24 else [float(incidence[0]), float(incidence[-1])],
        "n_incidences": len(incidence),
        "n_incident_azimuths": len(azimuth),
        "theta_r_deg": [float(np.degrees(samples.theta_r.min())), float(np.degrees(samples.theta_r.max()))],
        "hemisphere_covered": len(np.unique(bins)) / HEMISPHERE_BINS,
        "f_r": [float(samples.f_r.min()), float(samples.f_r.max())],
        "with_uncertainty": int(np.count_nonzero(known)),
        "negative": int(np.count_nonzero(samples.f_r < 0)),
    }
    if np.any(known & (samples.f_r > 0)):
        take = known & (samples.f_r > 0)
        out["median_relative_u"] = float(np.median(samples.u_f_r[take] / samples.f_r[take]))
    return out


def reciprocity_of(samples: BRDFSamples, grain: bool) -> dict[str, Any]:
    """Pairs of samples with swapped directions, without a grain also turned about the normal, and how much they differ."""
    from scipy.spatial import cKDTree

    if grain:
        wi, wr = samples.omega_i(), samples.omega_r()
        key, swapped = np.concatenate((wi, wr), axis=-1), np.concatenate((wr, wi), axis=-1)
    else:
        key = np.stack((samples.theta_i, samples.theta_r, np.cos(samples.phi_r - samples.phi_i)), axis=-1)
        swapped = key[:, [1, 0, 2]]
    other = np.abs(samples.theta_i - samples.theta_r) > 10 * SAME
    if not np.any(other):
        return {"reciprocal_pairs": 0}
    distance, index = cKDTree(key).query(swapped[other])
    near = distance < SAME
    first, second = samples.f_r[other][near], samples.f_r[index[near]]
    out: dict[str, Any] = {"reciprocal_pairs": int(np.count_nonzero(near)) // 2}
    mean = 0.5 * (np.abs(first) + np.abs(second))
    if np.any(mean > 0):
        skew = np.abs(first - second)[mean > 0] / mean[mean > 0]
        out |= {"reciprocity_rms": float(np.sqrt(np.mean(skew**2))), "reciprocity_largest": float(skew.max())}
    return out


def energy_of(data: BRDFSamples | Tables, grain: bool = False) -> dict[str, Any]:
    """Directional albedo of the table, or of a table made from the samples; says why where there is none."""
    try:
        if isinstance(data, Tables):
            brdf = data.brdf()
        else:
            take = np.random.default_rng(0).permutation(len(data))[: MOST_GRAINED if grain else MOST]
            some = data.select(np.sort(take))
            brdf = grained.tabulate(some, (16, 14, 10, 8)).brdf() if grain else tabulate(some).brdf()
        albedo = [_albedo(brdf, float(np.radians(a))) for a in ALBEDO_DEG]
    except (DatasetError, IntegrationError) as error:
        return {"energy": f"not known: {error}"}
    out: dict[str, Any] = {"albedo_deg": list(ALBEDO_DEG), "albedo": albedo}
    worst = max(albedo)
    out["energy"] = "conserved" if worst <= 1.0 else f"NOT conserved: an albedo of {worst:.4g} is above 1"
    return out


def _albedo(brdf: BRDF, theta: float) -> float:
    """Directional albedo; with a grain the mean over eight azimuths."""
    if all(term.model.isotropic for term in brdf.terms):
        return float(directional_albedo(brdf, theta, rtol=1e-3).value)
    turned = np.pi * np.arange(8) / 8
    return float(np.mean(reflectance_map(brdf, uniform(1.0), np.tan(theta), 0.0, rtol=1e-3, tangent=turned).value))
