"""Draws of all parameters from a posterior's modes, by importance where that can be trusted, else by a walk.

Both ways end in the same: draws of equal weight in natural units, in four independent chains, with what judges them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting import importance, marginal, optimum, psis, sample
from fitting.diagnostics import split_rhat
from fitting.likelihood import Problem
from fitting.marginal import Target, Whole
from fitting.optimum import Mode

Array = NDArray[np.float64]
LEAST_INSIDE = 0.25  # share of a walk's draws that must lie inside the ranges of what was integrated out


@dataclass(frozen=True)
class Sampled:
    """Draws and their quality.

    Attributes
    ----------
    draws : ndarray, shape (chain, draw, d)
        Natural values of all free parameters.
    log_posterior : ndarray, shape (chain, draw)
        Log density of the natural values, up to a constant.
    converged : bool
    status : str
        In one sentence.
    ess, rhat : ndarray, shape (d,)
    acceptance : float
        Of moves; by importance, effective draws per proposal.
    numbers : dict
        What else tells how the draws were made, for diagnostics.
    walk : fitting.sample.Walk, optional
        To go on with.
    """

    draws: Array
    log_posterior: Array
    converged: bool
    status: str
    ess: Array
    rhat: Array
    acceptance: float
    numbers: dict[str, Any] = field(default_factory=dict)
    walk: sample.Walk | None = None


def run(
    problem: Problem,
    modes: Sequence[Mode],
    *,
    seed: int,
    rule: sample.Rule,
    chain: bool = False,
    progress: sample.Progress | None = None,
    walk: sample.Walk | None = None,
) -> Sampled:
    """Sample a problem.

    Parameters
    ----------
    problem : Problem
    modes : sequence of Mode
        Of the whole problem, the best first.
    seed : int
    rule : fitting.sample.Rule
    chain : bool
        Walk, even where importance sampling would do.
    progress : callable, optional
    walk : fitting.sample.Walk, optional
        Of an earlier run with the same arguments, to go on with.
    """
    first, second, third = (int(s.generate_state(1)[0]) for s in np.random.SeedSequence(seed).spawn(3))
    target = marginal.of(problem, modes[0], np.random.default_rng(first))
    for attempt in (target, Whole(problem)):
        if walk is not None and walk.u.shape[-1] != len(attempt.space):
            continue
        if attempt.marginalised:
            kept = [i for i, name in enumerate(problem.space.names) if name not in attempt.marginalised]
            tops = optimum.project(modes, kept, attempt.log_probability)
        else:
            tops = tuple(modes)
        if not chain and walk is None:
            found = importance.run(attempt, tops, seed=second, effective=rule.effective, batches=rule.ensembles)
            if found is not None:
                return _of_importance(attempt, found)
        sampled = _of_walk(attempt, tops, third, rule, progress, walk)
        if sampled is not None:
            return sampled
    raise AssertionError("a walk with nothing integrated out is inside all ranges")


def _of_importance(target: Target, found: importance.Weighted) -> Sampled:
    d = found.draws.shape[2]
    numbers: dict[str, Any] = {
        "method": "importance sampling", "marginalised": list(target.marginalised), "k_hat": found.k_hat,
        "proposals": found.proposals,
    }  # fmt: skip
    status = (
        f"converged: {found.effective:.0f} effective draws of {found.proposals} by importance sampling, "
        f"Pareto k = {max(found.k_hat, 0.0):.2f} (at most {psis.GOOD})"
    )
    # drawing again in proportion to the weights adds the variance of that many draws
    ess = 1.0 / (1.0 / found.effective + 1.0 / (found.draws.shape[0] * found.draws.shape[1]))
    return Sampled(
        found.draws, found.log_posterior, True, status, np.full(d, ess), split_rhat(found.draws),
        found.effective / found.proposals, numbers,
    )  # fmt: skip


def _of_walk(
    target: Target, modes: Sequence[Mode], seed: int, rule: sample.Rule, progress: sample.Progress | None,
    walk: sample.Walk | None,
) -> Sampled | None:  # fmt: skip
    """None if too few draws fall inside the ranges of what was integrated out."""
    chains = sample.run(
        target.log_probability, modes, seed=seed, quantities=lambda u: target.space.natural(u)[0], rule=rule,
        progress=progress, walk=walk,
    )  # fmt: skip
    longest = float(chains.tau.max())
    thin = max(1, int(longest / 2)) if chains.converged else 1 + chains.u.shape[1] // 200
    u = chains.u[:, ::thin]
    rng = np.random.default_rng(np.random.SeedSequence(seed).spawn(1)[0])
    drawn = target.draw(u.reshape(-1, u.shape[-1]), rng)
    accepted = np.log(rng.random(len(drawn.x))) < drawn.log_weight - np.max(drawn.log_weight)
    share = float(np.mean(accepted))
    if share < LEAST_INSIDE:
        return None
    chosen = [np.flatnonzero(part) for part in accepted.reshape(len(u), -1)]
    count, each = min(len(part) for part in chosen), len(accepted) // len(u)
    rows = np.array([part[:count] + e * each for e, part in enumerate(chosen)])
    draws = drawn.x[rows]
    names, left = target.problem.space.names, target.space.names
    kept = chains.u.shape[0] * chains.u.shape[1] * chains.u.shape[2]
    tau = {name: float(t) for name, t in zip(left, chains.tau, strict=True)}
    # what was integrated out is drawn afresh for each kept draw: no worse than the slowest of the others
    ess = np.array([kept / tau[name] if name in tau else min(kept / longest, count * len(rows)) for name in names])
    rhat = split_rhat(draws)
    for name, value in zip(left, chains.rhat, strict=True):
        rhat[names.index(name)] = value
    numbers = {
        "method": "emcee", "marginalised": list(target.marginalised), "tau": tau, "ensembles": rule.ensembles,
        "walkers": chains.u.shape[2], "steps": chains.steps, "burn_in": chains.burn_in, "thin": thin, "inside": share,
    }  # fmt: skip
    return Sampled(
        draws, drawn.log_posterior[rows], chains.converged, chains.status, ess, rhat, chains.acceptance, numbers,
        None if chains.converged else chains.walk,
    )  # fmt: skip
