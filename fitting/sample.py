r"""Draws from a posterior by emcee: independent ensembles, checked at growing intervals, the same draws for the same seed.

Moves are differential evolution [1]_, 0.9 with emcee's step and 0.1 with a full difference, which jumps between modes. The
snooker move of emcee 3.1.6 is not used: it samples a distribution that is too narrow (emcee pull request 531).

The ensembles share nothing but the likelihood, so that comparing them means something. Sampling ends when the chain kept
after burn-in is longer than `Rule.taus` autocorrelation times, that time has settled, and the ensembles agree; or after
`Rule.max_steps`, which is a status and not an error. No clock decides, so a seed gives the same bytes on a busy machine. A
`Walk` holds all that is needed to go on, and whoever does so gets the bytes of a run that was never stopped.

References
----------
.. [1] C. J. F. ter Braak, "A Markov Chain Monte Carlo version of the genetic algorithm Differential Evolution", Statistics
   and Computing 16, 2006; B. E. Nelson, E. B. Ford, M. J. Payne, ApJS 210:11, 2014.
.. [2] D. Foreman-Mackey, D. W. Hogg, D. Lang, J. Goodman, "emcee: The MCMC Hammer", PASP 125, 2013.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from numpy.typing import NDArray

from fitting.diagnostics import RHAT_LIMIT, autocorrelation_time, split_rhat
from fitting.optimum import Mode
from gonio.errors import ConvergenceError, ParameterError

Array = NDArray[np.float64]
Progress = Callable[[int, int], None]
_CHUNK = 100  # steps between two calls of the progress function


@dataclass(frozen=True)
class Rule:
    """How much to sample.

    Attributes
    ----------
    ensembles : int
        Independent ensembles; at least 2 are needed to compare them.
    walkers : int, optional
        Per ensemble; default max(32, 4 d). Even, and at least 2 d.
    taus : float
        Length of the kept chain in autocorrelation times.
    burn_taus : float
        Length of the burn-in in autocorrelation times.
    drift : float
        Largest relative change of the longest autocorrelation time since the last check.
    first, growth : int, float
        Steps at the first check, and the ratio of one check to the next.
    max_steps : int
        Per ensemble.
    effective : int
        Draws wanted where importance sampling does, in `ensembles` parts.
    """

    ensembles: int = 4
    walkers: int | None = None
    taus: float = 50.0
    burn_taus: float = 10.0
    drift: float = 0.02
    first: int = 200
    growth: float = 1.25
    max_steps: int = 10000
    effective: int = 4000

    def __post_init__(self) -> None:
        for name in ("ensembles", "first", "max_steps", "effective"):
            if getattr(self, name) < 1:
                raise ParameterError(f"{name} = {getattr(self, name)} leaves nothing to sample; choose 1 or more")

    def checks(self) -> Iterator[int]:
        """Steps at which a run asks whether to stop, whatever its largest number is."""
        at = self.first
        while True:
            yield at
            at = math.ceil(at * self.growth)


@dataclass(frozen=True)
class Walk:
    """All steps of all ensembles, and what the next ones depend on.

    Attributes
    ----------
    u : ndarray, shape (ensemble, step, walker, d)
    log_probability : ndarray, shape (ensemble, step, walker)
    accepted : ndarray, shape (ensemble, walker)
        Numbers of accepted moves.
    keys : ndarray of uint32, shape (ensemble, 624)
        State of the Mersenne twisters.
    places : ndarray, shape (ensemble, 3)
        Position in it, and the normal number kept for the next call: whether there is one, and its value.
    """

    u: Array
    log_probability: Array
    accepted: Array
    keys: NDArray[np.uint32]
    places: Array


@dataclass(frozen=True)
class Chains:
    """What sampling gave.

    Attributes
    ----------
    u : ndarray, shape (ensemble, step, walker, d)
        After burn-in, not thinned.
    log_probability : ndarray, shape (ensemble, step, walker)
    tau : ndarray, shape (d,)
        Integrated autocorrelation time [steps].
    rhat : ndarray, shape (d,)
    acceptance : float
    converged : bool
    status : str
        Why it stopped, in one sentence.
    steps, burn_in : int
        Per ensemble.
    walk : Walk
        To go on with.
    """

    u: Array
    log_probability: Array
    tau: Array
    rhat: Array
    acceptance: float
    converged: bool
    status: str
    steps: int
    burn_in: int
    walk: Walk


def moves() -> list[tuple[Any, float]]:
    """The mixture of proposals: name no snooker here."""
    import emcee

    return [(emcee.moves.DEMove(), 0.9), (emcee.moves.DEMove(gamma0=1.0), 0.1)]


def run(
    log_probability: Callable[[Array], Array],
    modes: Sequence[Mode],
    *,
    seed: int,
    quantities: Callable[[Array], Array] | None = None,
    rule: Rule | None = None,
    progress: Progress | None = None,
    walk: Walk | None = None,
) -> Chains:
    """Sample a density, starting from its modes or where an earlier run stopped.

    Parameters
    ----------
    log_probability : callable
        (w, d) -> (w,); -inf where the density is zero, never NaN.
    modes : sequence of Mode
        Walkers start at each in proportion to its mass, spread by 0.5 to 1 times its Laplace covariance.
    seed : int
        Draws are a function of the seed.
    quantities : callable, optional
        (w, d) -> (w, d): the values on which convergence is judged; default u itself.
    rule : Rule, optional
    progress : callable, optional
        ``progress(done, total)`` with steps of all ensembles; the total is an estimate that may change.
    walk : Walk, optional
        Of an earlier run of the same density and rule, to go on with; `modes` and `seed` then do not matter.

    Raises
    ------
    ConvergenceError
        If no start has a finite density.
    """
    rule = rule or Rule()
    if walk is not None and walk.u.shape[1] > rule.max_steps:
        raise ParameterError(f"the chains have {walk.u.shape[1]} steps already; raise max_steps (now {rule.max_steps})")
    d = len(modes[0].u)
    if walk is not None:
        ensembles = [_Ensemble(log_probability, walk, e) for e in range(rule.ensembles)]
    else:
        ensembles = []
        walkers = rule.walkers or max(32, 4 * d)
        for sequence in np.random.SeedSequence(seed).spawn(rule.ensembles):
            first, second = sequence.spawn(2)
            start = _start(log_probability, modes, walkers, np.random.default_rng(first))
            ensembles.append(_Ensemble(log_probability, _fresh(start, np.random.RandomState(np.random.MT19937(second))), 0))
    before, total = 1, rule.first
    for check in rule.checks():
        target = min(rule.max_steps, check)
        steps = ensembles[0].steps
        if target < steps:
            before = check
            continue
        total = min(rule.max_steps, max(total, target))
        for e, ensemble in enumerate(ensembles):
            for a in range(steps, target, _CHUNK):
                b = min(a + _CHUNK, target)
                ensemble.go(b - a)
                if progress is not None:
                    progress(steps * rule.ensembles + e * (target - steps) + b - steps, total * rule.ensembles)
        whole = _together(ensembles)
        judged = whole.u if quantities is None else quantities(whole.u.reshape(-1, d)).reshape(whole.u.shape)
        tau, burn_in = _settle(judged, rule)
        longest, earlier = float(tau.max()), float(_settle(judged[:, :before], rule)[0].max())
        kept = judged[:, burn_in:]
        rhat = split_rhat(kept[:, :: max(1, int(longest / 2))].reshape(rule.ensembles, -1, d))
        moved = abs(longest - earlier) / longest if before >= rule.first else math.inf
        converged = kept.shape[1] > rule.taus * longest and moved < rule.drift and bool(np.all(rhat < RHAT_LIMIT))
        total, before = math.ceil(1.05 * (rule.taus + rule.burn_taus) * longest), check
        if converged or target >= rule.max_steps:
            break
    if progress is not None:
        progress(target * rule.ensembles, target * rule.ensembles)
    return Chains(
        u=whole.u[:, burn_in:],
        log_probability=whole.log_probability[:, burn_in:],
        tau=tau,
        rhat=rhat,
        acceptance=float(np.mean(whole.accepted)) / target,
        converged=converged,
        status=_status(converged, kept.shape[1], tau, moved, rhat, rule),
        steps=target,
        burn_in=burn_in,
        walk=whole,
    )


class _Ensemble:
    """One ensemble of emcee that goes on from a walk."""

    def __init__(self, log_probability: Callable[[Array], Array], walk: Walk, number: int) -> None:
        import emcee

        self._past = Walk(*(getattr(walk, f.name)[number] for f in fields(Walk)))
        walkers, d = self._past.u.shape[1:]
        self._sampler = emcee.EnsembleSampler(walkers, d, log_probability, moves=moves(), vectorize=True)
        position, has, kept = self._past.places
        random = ("MT19937", self._past.keys, int(position), int(has), float(kept))
        # before the first step a walk has one row, the start, which is no step
        self._started = bool(np.isfinite(self._past.log_probability[-1]).all())
        known = self._past.log_probability[-1] if self._started else None
        self._state: Any = emcee.State(self._past.u[-1], log_prob=known, random_state=random)
        self._done = 0

    @property
    def steps(self) -> int:
        return (len(self._past.u) if self._started else 0) + self._done

    def go(self, steps: int) -> None:
        self._state = self._sampler.run_mcmc(self._state, steps, skip_initial_state_check=self.steps > 0)
        self._done += steps

    def walk(self) -> Walk:
        """All steps, with a leading axis of one ensemble."""
        past = self._past
        if self._done == 0:
            return Walk(*(getattr(past, f.name)[None] for f in fields(Walk)))
        u, log_probability = self._sampler.get_chain(), self._sampler.get_log_prob()
        accepted = self._sampler.backend.accepted
        if self._started:
            u, log_probability = np.concatenate((past.u, u)), np.concatenate((past.log_probability, log_probability))
            accepted = past.accepted + accepted
        _, keys, *places = self._sampler.random_state
        return Walk(u[None], log_probability[None], accepted[None], np.asarray(keys)[None], np.array([places], dtype=float))


def _fresh(start: Array, random: np.random.RandomState) -> Walk:
    """A walk of one ensemble before its first step."""
    state: Any = random.get_state()
    _, keys, *places = state
    none = np.full((1, 1, len(start)), np.nan)
    return Walk(start[None, None], none, np.zeros((1, len(start))), keys[None], np.array([places], dtype=float))


def _together(ensembles: Sequence[_Ensemble]) -> Walk:
    parts = [ensemble.walk() for ensemble in ensembles]
    return Walk(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Walk)))


def _settle(chain: Array, rule: Rule) -> tuple[Array, int]:
    """Autocorrelation time and burn-in that agree: `burn_taus` tau are left out, at most half the chain."""
    _, steps, _, d = chain.shape
    burn_in = steps // 2
    for _ in range(3):
        tau = autocorrelation_time(chain[:, burn_in:].transpose(1, 0, 2, 3).reshape(steps - burn_in, -1, d))
        wanted = min(steps // 2, math.ceil(rule.burn_taus * float(tau.max())))
        if wanted == burn_in:
            break
        burn_in = wanted
    return tau, burn_in


def _start(
    log_probability: Callable[[Array], Array], modes: Sequence[Mode], walkers: int, rng: np.random.Generator
) -> Array:
    """Walkers around the modes, all with a finite density, shape (walkers, d)."""
    d = len(modes[0].u)
    mass = np.array([m.log_mass for m in modes])
    share = np.exp(mass - mass.max())
    factors = [np.linalg.cholesky(m.covariance + 1e-14 * np.eye(d) * np.trace(m.covariance)) for m in modes]
    out = np.empty((walkers, d))
    missing = np.arange(walkers)
    for trial in range(100):
        pick = rng.choice(len(modes), size=len(missing), p=share / share.sum())
        spread = rng.uniform(0.5, 1.0) * 0.9**trial  # smaller and smaller, into the support
        z = rng.standard_normal((len(missing), d)) * math.sqrt(spread)
        out[missing] = [modes[i].u + factors[i] @ v for i, v in zip(pick, z, strict=True)]
        missing = missing[~np.isfinite(log_probability(out[missing]))]
        if len(missing) == 0:
            return out
    raise ConvergenceError(
        f"{len(missing)} of {walkers} walkers find no start with a finite probability around the optimum; "
        "check the priors against the data"
    )


def _status(converged: bool, kept: int, tau: Array, moved: float, rhat: Array, rule: Rule) -> str:
    longest, worst = float(tau.max()), float(np.max(rhat)) if np.all(np.isfinite(rhat)) else math.nan
    numbers = f"{kept} steps kept, longest autocorrelation time {longest:.1f} steps, R-hat {worst:.4f}"
    if converged:
        return f"converged: {numbers}"
    reasons = []
    if not kept > rule.taus * longest:
        needed = rule.taus * longest
        reasons.append(f"the chain should be longer than {rule.taus:g} autocorrelation times ({needed:.0f} steps)")
    if not moved < rule.drift:
        reasons.append(f"the autocorrelation time still moved by {moved:.1%}")
    if not worst < RHAT_LIMIT:
        reasons.append(f"the ensembles disagree (R-hat should be below {RHAT_LIMIT})")
    return f"not converged: {numbers}; {'; '.join(reasons)}; raise max_steps (now {rule.max_steps}) or fix a parameter"
