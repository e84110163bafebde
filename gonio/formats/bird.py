"""BiRD universal BRDF data format: JSON with metadata, four angles, BRDF and its uncertainty per row.

The only open format of measured BRDFs with an uncertainty at each point. ``data`` holds parallel arrays ``theta_i``,
``phi_i``, ``theta_r``, ``phi_r``, ``BRDF`` and perhaps ``uBRDF`` and ``wavelength_i``, each with its unit. Spectral rows
are put together where the directions agree, and two orthogonal incident polarisations are averaged, which is f_r of
unpolarised light; other states that change from row to row are refused, as rows would be mixed unseen. Written are angles
in radians, BRDF and uBRDF in sr^-1. The format has no negative BRDF: such rows are left out and their number stands in
the comment. uBRDF is written if it is known for all rows. Channels without a wavelength are an ad hoc variable
``channel``.

References
----------
.. [1] EURAMET 16NRM08 BiRD, BRDF_JSON_schema v1.0, BiRD-project/BiRD_view.
"""

from __future__ import annotations

import datetime
import json
import uuid
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from gonio.channels import RGB, SINGLE, XYZ, Channels, ChannelSamples, spectral
from gonio.errors import DatasetError
from gonio.formats import json_text, rows

Array = NDArray[np.float64]
SCHEMA = "https://raw.githubusercontent.com/BiRD-project/BiRD_view/master/BRDF_JSON_schema/brdf_json_schema_v1.0.json"
ANGLES = ("theta_i", "phi_i", "theta_r", "phi_r")
UNITS = {"rad": 1.0, "deg": np.pi / 180, "°": np.pi / 180}
PROVENANCE = ("organization", "country", "city", "street", "building_nr", "postal_code", "email", "contact_person")


def sniff(head: bytes) -> bool:
    """A JSON object that names its schema, or BRDF values and angles."""
    start = head.lstrip(b"\xef\xbb\xbf \t\r\n")
    return start[:1] == b"{" and b'"metadata"' in head and (b"brdf_json_schema" in head or b'"BRDF"' in head)


def read(path: Path) -> ChannelSamples:
    """Samples with their uncertainties; `DatasetError` if the file is damaged or mixes variables."""
    document = json_text.read(path)
    data = json_text.member(path, document, "data", dict)
    columns = [_column(path, data, name, UNITS) for name in ANGLES]
    f = _column(path, data, "BRDF", {"sr^-1": 1.0, "1/sr": 1.0})
    lengths = {name: len(c) for name, c in zip((*ANGLES, "BRDF"), (*columns, f), strict=True)}
    if len(set(lengths.values())) != 1 or not len(f):
        raise DatasetError(f"{path}: the columns have different lengths ({lengths}); the file is damaged")
    u = np.full(len(f), np.nan)
    if "uBRDF" in data:
        percent = data["uBRDF"].get("unit") == "%" if isinstance(data["uBRDF"], dict) else False
        u = _column(path, data, "uBRDF", {"sr^-1": 1.0, "1/sr": 1.0, "%": 0.01})
        if len(u) != len(f):
            raise DatasetError(f"{path}: uBRDF has {len(u)} values, BRDF {len(f)}; the file is damaged")
        u = u * np.abs(f) if percent else u
    if np.any(f < 0) or np.any(u < 0):
        raise DatasetError(f"{path}: a value of BRDF or uBRDF is negative, which the format forbids; correct the file")
    key, names = _channel_of_rows(path, data, len(f))
    first, second = _polarisations(path, data, len(f))
    if len(second):  # f of unpolarised light is the mean over two orthogonal states
        rows_ = [np.lexsort((key[half], *(c[half] for c in columns))) for half in (first, second)]
        one, two = first[rows_[0]], second[rows_[1]]
        if len(one) != len(two) or any(not np.array_equal(c[one], c[two]) for c in (*columns, key)):
            raise DatasetError(f"{path}: the two polarisations were not measured at the same rows; select one state first")
        f, u = 0.5 * (f[one] + f[two]), 0.5 * np.hypot(u[one], u[two])
        columns, key = [c[one] for c in columns], key[one]
    polar = np.stack((columns[0], columns[2]))
    if np.any(np.abs(polar) > np.pi) or np.any(np.abs(np.stack((columns[1], columns[3]))) > 4 * np.pi):
        raise DatasetError(f"{path}: an angle is beyond half a turn; check the units of the angles")
    for k in (0, 2):  # a negative polar angle is on the other side
        columns[k + 1] = np.where(columns[k] < 0, columns[k + 1] + np.pi, columns[k + 1])
        columns[k] = np.abs(columns[k])
    keep = (columns[0] < np.pi / 2) & (columns[2] < np.pi / 2)
    if not np.any(keep):
        raise DatasetError(f"{path} holds no sample above the horizon")
    where = np.stack([c[keep] for c in columns], axis=-1)
    pairs, index = np.unique(where, axis=0, return_inverse=True)
    index = index.ravel()
    rows.check_size(path, len(pairs), len(names))
    value, uncertainty = np.full((len(pairs), len(names)), np.nan), np.full((len(pairs), len(names)), np.nan)
    if len(np.unique(index * len(names) + key[keep])) != np.count_nonzero(keep):  # directions measured more than once
        if len(names) > 1:
            raise DatasetError(f"{path}: a direction stands twice in one channel; average or remove the repetitions")
        pairs, index = where, np.arange(len(where))
        value, uncertainty = np.full((len(pairs), 1), np.nan), np.full((len(pairs), 1), np.nan)
    value[index, key[keep]], uncertainty[index, key[keep]] = f[keep], u[keep]
    attributes = {
        "quantity": "brdf",
        "source_quantity": "brdf",
        "source_format": "bird",
        "n_below_horizon": str(int(np.count_nonzero(~keep))),
        "polarisation": "mean of two orthogonal incident states" if len(second) else "as measured",
        "uncertainty": "as the file states it (uBRDF)" if "uBRDF" in data else "none in the file",
    }
    metadata = document.get("metadata")
    sample = metadata.get("sample") if isinstance(metadata, dict) else None
    if isinstance(sample, dict) and isinstance(sample.get("name"), str):
        attributes["material"] = rows.one_line(sample["name"], 200)
    theta_i, phi_i, theta_r, phi_r = pairs.T
    return ChannelSamples.make(theta_i, phi_i, theta_r, phi_r, value, names, uncertainty, attributes)


def _column(path: Path, data: dict[str, Any], name: str, units: Mapping[str, float]) -> Array:
    part = json_text.member(path, data, name, dict)
    unit = part.get("unit")
    if not isinstance(unit, str) or unit not in units:
        raise DatasetError(f"{path}: the unit of {name} is {unit!r:.40}; the format allows {', '.join(units)}")
    return json_text.numbers(path, json_text.member(path, part, "values", list), name) * units[unit]


def _channel_of_rows(path: Path, data: dict[str, Any], n: int) -> tuple[NDArray[np.int64], Channels]:
    """Channel of each row, and the channels."""
    adhoc = data.get("adhoc_variables")
    part = adhoc.get("channel") if isinstance(adhoc, dict) else None
    if isinstance(part, dict):
        values = json_text.member(path, part, "values", list)
        for channels in (RGB, XYZ):
            if len(values) == n and all(v in channels.names for v in values):
                return np.array([channels.names.index(v) for v in values]), channels
    if "wavelength_i" not in data:
        return np.zeros(n, dtype=np.int64), SINGLE
    waves = _column(path, data, "wavelength_i", {"nm": 1.0, "μm": 1000.0, "µm": 1000.0})
    if len(waves) != n:
        raise DatasetError(f"{path}: wavelength_i has {len(waves)} values, BRDF {n}; the file is damaged")
    unique, key = np.unique(np.round(waves, 9), return_inverse=True)
    if len(unique) > 2000:
        raise DatasetError(f"{path}: {len(unique)} different wavelengths, at most 2000 are read; thin the file")
    return key.ravel(), spectral(unique, str(path))


def _polarisations(path: Path, data: dict[str, Any], n: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Rows of two orthogonal incident polarisations; all rows and none if there is only one state."""
    every, none = np.arange(n), np.arange(0)
    for name in ("polarization_r", "polarization_i"):
        part = data.get(name)
        values = part.get("values") if isinstance(part, dict) else None
        texts = [json.dumps(v) for v in values] if isinstance(values, list) else []
        states = sorted(set(texts))
        if len(states) < 2:
            continue
        refusal = (
            f"{path}: {name} changes from row to row and is no pair of orthogonal incident states; select one state first"
        )
        if name == "polarization_r" or len(texts) != n or len(states) != 2:
            raise DatasetError(refusal)
        a, b = (json.loads(s) for s in states)
        vectors = all(isinstance(s, list) and len(s) == 4 for s in (a, b))
        if not vectors or json_text.numbers(path, a, name) @ json_text.numbers(path, b, name) != 0 or a[0] != b[0]:
            raise DatasetError(refusal)
        mine = np.array(texts) == states[0]
        return every[mine], every[~mine]
    return every, none


def write(path: Path, found: ChannelSamples, attributes: Mapping[str, str] | None = None) -> None:
    """Write samples, each with its uncertainty if all are known.

    Parameters
    ----------
    path : Path
    found : ChannelSamples
    attributes : mapping of str to str, optional
        ``organization``, ``country``, ``city``, ``street``, ``building_nr``, ``postal_code``, ``email``,
        ``contact_person``, ``material`` fill what the format demands; what is not known is ``"unknown"``.
    """
    from gonio import __version__

    told = {**found.attributes, **(attributes or {})}
    n, c = found.f_r.shape
    f, u = found.f_r.ravel(), found.u_f_r.ravel()  # channels of one direction together
    keep = np.isfinite(f) & (f >= 0)
    if not np.any(keep):
        raise DatasetError(f"{path}: no value is positive, and the format allows no other; nothing was written")
    angle = [np.repeat(getattr(found, name), c)[keep].tolist() for name in ANGLES]
    data: dict[str, Any] = {name: {"unit": "rad", "values": v} for name, v in zip(ANGLES, angle, strict=True)}
    left_out = int(np.count_nonzero(~keep))
    comment = f"{left_out} rows left out: negative or not measured" if left_out else "all rows"
    data["BRDF"] = {"unit": "sr^-1", "values": f[keep].tolist(), "comments": comment}
    if np.all(np.isfinite(u[keep])):
        data["uBRDF"] = {
            "unit": "sr^-1",
            "values": u[keep].tolist(),
            "comments": "standard uncertainty, k = 1, random errors",
        }
    if found.channels.wavelengths_nm is not None:
        waves = np.tile(np.array(found.channels.wavelengths_nm), n)[keep].tolist()
        data["wavelength_i"] = {"unit": "nm", "values": waves}
    elif c > 1:
        names = np.tile(np.array(found.channels.names), n)[keep].tolist()
        data["adhoc_variables"] = {
            "channel": {"description": "colour channel of each row", "unit": "1", "type": "string", "values": names}
        }
    where = {name: str(told.get(name, "unknown")) for name in PROVENANCE}
    where["email"] = told.get("email", "unknown@example.org")
    location = {name: where.pop(name) for name in ("country", "city", "street", "building_nr", "postal_code")}
    simulated = told.get("origin") == "model"
    metadata = {
        "schema": SCHEMA,
        "id": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_OID, repr(sorted(told.items())) + repr(f.sum()))}",
        "type": "BRDF",
        "timestamp": told.get("timestamp", datetime.datetime.now(datetime.UTC).replace(microsecond=0).isoformat()),
        "provenance": {**where, "location": location},
        "description": rows.one_line(told.get("title", "BRDF f_r [1/sr], mirror direction at phi_r = phi_i + pi")),
        "method": "simulation" if simulated else "measurement",
        "instrumentation": "NA",
        "software": {"name": "gonio", "version": __version__},
        "sample": {
            "name": rows.one_line(told.get("material", "unknown"), 200),
            "type": "unknown",
            "dimensions": {},
            "shape": "unknown",
            "zero_azimuth_location": "unknown",
        },
        "environment": "NA",
        "comments": rows.one_line("; ".join(f"{k}: {v}" for k, v in sorted(told.items())), 4000),
    }
    rows.put(path, json.dumps({"metadata": metadata, "data": data}, allow_nan=False, ensure_ascii=False) + "\n")
