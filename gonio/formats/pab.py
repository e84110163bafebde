"""PAB-Opto ``.dat``, one file for each direction of incidence; written only, and read by Radiance's ``pabopto2bsdf``.

Header lines begin with ``#`` and have no space after it: ``#sample_name "x"``, ``#format: theta phi BRDF``, ``#intheta``,
``#inphi``. Then rows theta, phi [deg], f_r [1/sr]; theta below 90 degrees is reflection. In these files the light comes
from ``inphi`` and the mirror direction is at phi = inphi + 180 degrees. Radiance infers the symmetry from the incident
azimuths: one is isotropic. Its interpolation smooths; for Klems matrices write ``klems`` instead.

References
----------
.. [1] LBNL Radiance, src/cv/pabopto2bsdf.c.
"""

from __future__ import annotations

import math
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from gonio.channels import ChannelSamples
from gonio.errors import DatasetError
from gonio.formats import rows

FEWEST_ROWS = 10


def write(folder: Path, found: ChannelSamples, attributes: Mapping[str, str] | None = None) -> list[Path]:
    """Write a folder with one file per incidence of the main channel; returns the files.

    Raises
    ------
    DatasetError
        If the folder exists and is not empty, or the samples have no two incidences with at least 10 directions each.
    """
    if folder.exists() and (not folder.is_dir() or any(folder.iterdir())):
        raise DatasetError(f"{folder} exists and is not empty; PAB-Opto is a folder of files: give a new one")
    one = found.channel()
    incidence = np.round(np.degrees(np.stack((one.theta_i, one.phi_i), axis=-1)), 6)
    pairs, index, count = np.unique(incidence, axis=0, return_inverse=True, return_counts=True)
    enough = np.flatnonzero(count >= FEWEST_ROWS)
    if len(enough) < 2:
        raise DatasetError(
            f"{folder}: PAB-Opto needs at least 2 incidences with {FEWEST_ROWS} directions each, the data have {len(enough)}"
        )
    told = {**one.attributes, **(attributes or {})}
    name = rows.one_line(told.get("material", "sample"), 100).replace('"', "'")
    temporary = folder.with_name(f".{folder.name}.{secrets.token_hex(4)}.part")
    try:
        temporary.mkdir()
        names = []
        for k in enough:
            theta, phi = pairs[k].tolist()
            mine = index.ravel() == k
            out = [f'#sample_name "{name}"', "#format: theta phi BRDF", f"#intheta {theta:.6f}", f"#inphi {phi:.6f}"]
            columns = zip(one.theta_r[mine].tolist(), one.phi_r[mine].tolist(), one.f_r[mine].tolist(), strict=True)
            out += [f"{math.degrees(t):.9g}\t{math.degrees(p):.9g}\t{f!r}" for t, p, f in columns]
            names.append(f"incidence_{theta:07.3f}_{phi:07.3f}.dat")
            (temporary / names[-1]).write_text("\n".join(out) + "\n", encoding="utf-8")
        if folder.exists():
            folder.rmdir()
        temporary.rename(folder)
    except OSError as error:
        raise DatasetError(f"{folder} cannot be written: {error.strerror or error}; check folder and free space") from error
    finally:
        shutil.rmtree(temporary, ignore_errors=True)
    return [folder / name for name in names]
