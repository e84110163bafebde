"""gonio info: what a file of anyone holds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import click

from gonio.cli.output import json_option, speaking

CONVENTIONS = "angles from the normal, mirror direction at phi_r = phi_i + 180 degrees; read as radians"


@click.command()
@click.argument("file", type=click.Path(path_type=Path, dir_okay=False))
@click.option(
    "--quantity", type=click.Choice(["brdf", "brf", "brdf_cos"]), help="What the values are, where the file does not say."
)
@json_option
def info(file: Path, quantity: str | None, as_json: bool) -> None:
    """Say what FILE holds: format, quantity, units, conventions, channels, coverage, energy, reciprocity."""
    from gonio.formats.summary import describe

    with speaking(as_json) as output:
        found = describe(file, quantity)
        output.say(f"{file.name}: {found['format_doc']}, {found['bytes']} bytes")
        for key, text in lines(found):
            output.say(f"    {key:<14}{text}")
        said = {"quantity", "source_file", "source_format"}
        shown = {k: v for k, v in found["attributes"].items() if k not in said and (k, v) != ("source_quantity", "brdf")}
        if shown:
            output.say("notes")
        for key, value in shown.items():
            output.say(f"    {key}: {value[:200]}")
        output.result(**found)


def lines(found: Mapping[str, Any]) -> list[tuple[str, str]]:
    """What `describe` found, as a key and a sentence each."""
    from gonio.formats.quantity import QUANTITIES

    out = [("quantity", found["quantity_in_file"]), ("conventions", CONVENTIONS)]
    if not found["quantity_in_file"].startswith(QUANTITIES["brdf"]):
        out.insert(1, ("read as", QUANTITIES["brdf"]))
    if "samples" in found:
        low, high = found["f_r"]
        out.append(("samples", f"{found['samples']} in {_channels(found['channels'])}; f_r {low:.4g} to {high:.4g} 1/sr"))
        if len(found["channels"]) > 1:
            out.append(("shown is", f"{found['channel_shown']}; --channel of import and convert takes another one"))
        if found["n_incident_azimuths"] > 1:
            out.append(("grain", "f_r depends on the incident azimuth" if found["grain"] else "none seen"))
        out += [("uncertainty", _uncertainty(found)), ("coverage", _coverage(found)), ("reciprocity", _reciprocity(found))]
    else:
        over = "phi_h, theta_h, theta_d, phi_d" if found["grain"] else "theta_h, theta_d, phi_d"
        shape = " x ".join(map(str, found["table_nodes"]))
        out.append(("table", f"{shape} nodes over {over} in {_channels(found['channels'])}"))
        out.append(("coverage", ", ".join(f"{n} {k}" for k, n in found["coverage"].items())))
    energy = found["energy"]
    if "albedo" in found:
        albedo, at = (", ".join(f"{x:.3g}" for x in found[k]) for k in ("albedo", "albedo_deg"))
        of = ", by a table of the samples" if "samples" in found else ""
        energy += f"; directional albedo {albedo} at {at} degrees{of}"
    return [*out, ("energy", energy)]


def _channels(names: Sequence[str]) -> str:
    if len(names) == 1:
        return f"one channel ({names[0]})"
    shown = ", ".join(names) if len(names) <= 6 else f"{', '.join(names[:2])} ... {names[-1]}"
    return f"{len(names)} channels ({shown})"


def _uncertainty(found: Mapping[str, Any]) -> str:
    known, n = found["with_uncertainty"], found["samples"]
    if not known:
        return "none in the file"
    of = "all" if known == n else f"{known} of {n}"
    return f"known of {of} samples" + (
        f", median {100 * found['median_relative_u']:.2g} %" if "median_relative_u" in found else ""
    )


def _coverage(found: Mapping[str, Any]) -> str:
    n, angles = found["n_incidences"], [f"{a:.3g}" for a in found["incidences_deg"]]
    at = ", ".join(angles) if n == len(angles) else f"{angles[0]} to {angles[-1]}"
    azimuths = found["n_incident_azimuths"]
    low, high = found["theta_r_deg"]
    return (
        f"{n} incidence{'s' * (n > 1)} ({at} degrees) at {azimuths} azimuth{'s' * (azimuths > 1)}; theta_r {low:.3g} to "
        f"{high:.3g} degrees; {100 * found['hemisphere_covered']:.0f} % of the hemisphere, azimuths folded"
    )


def _reciprocity(found: Mapping[str, Any]) -> str:
    if "reciprocity_rms" not in found:
        return "no pairs of swapped directions"
    rms, largest = 100 * found["reciprocity_rms"], 100 * found["reciprocity_largest"]
    return f"{found['reciprocal_pairs']} pairs of swapped directions differ by {rms:.2g} % rms, {largest:.2g} % at most"
