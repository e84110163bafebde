"""Is a fit without a chain right: the same pixels by emcee."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.batch import Estimates, Job
from fitting.inference import fit
from fitting.sample import Rule
from gonio.samples import BRDFSamples

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Comparison:
    """One pixel by both ways.

    Attributes
    ----------
    pixel : int
    converged : bool
        Of the chains.
    shift : ndarray, shape (d,)
        Difference of the means over the chains' standard deviation.
    ratio : ndarray, shape (d,)
        Standard deviation over the chains'.
    summary : dict
        Of the chains; see `gonio.posterior.Posterior.summary`.
    """

    pixel: int
    converged: bool
    shift: Array
    ratio: Array
    summary: dict[str, dict[str, float]]


def validate(
    job: Job,
    readings: Array,
    u: Array | None,
    estimates: Estimates,
    pixels: Iterable[int],
    *,
    rule: Rule | None = None,
    progress: Callable[[int], None] | None = None,
) -> list[Comparison]:
    """Sample some pixels with emcee.

    Parameters
    ----------
    job : Job
    readings, u : ndarray, shape (p, n)
        As for `Job.fit`.
    estimates : Estimates
        Of these readings.
    pixels : iterable of int
        Places among them.
    progress : callable, optional
        Called after each with the number done.
    """
    out = []
    for pixel in pixels:
        found = fit(
            _one(job.samples, readings[pixel], None if u is None else u[pixel]), job.model, free=job.free,
            fix=dict(job.fix), priors=dict(job.priors), shared=job.shared, seed=1, discrepancy=job.discrepancy,
            chain=True, rule=rule,
        )  # fmt: skip
        summary = found.summary()
        mean, sd = (np.array([summary[name][key] for name in estimates.names]) for key in ("mean", "sd"))
        out.append(
            Comparison(pixel, found.converged, (estimates.mean[pixel] - mean) / sd, estimates.sd[pixel] / sd, summary)
        )
        if progress is not None:
            progress(len(out))
    return out


def _one(samples: BRDFSamples, f_r: Array, u: Array | None) -> BRDFSamples:
    keep = np.isfinite(f_r)
    given: dict[str, Any] = {"f_r": np.nan_to_num(f_r)}
    if u is not None:
        given["u_f_r"] = np.where(keep, u, 1.0)
    return replace(samples, **given).select(keep)
