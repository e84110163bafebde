"""Fit BRDF models to samples: priors, likelihood, optimum, emcee, diagnostics.

It knows the physics and does no input or output; who calls it hands it samples and takes a `gonio.posterior.Posterior`.
"""

from __future__ import annotations

from fitting.inference import fit
from fitting.sample import Rule

__all__ = ["Rule", "fit"]
