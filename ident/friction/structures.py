"""Structures of an arm with friction in a loop that are compared, each at its own optimum.

A `Search` knows the logs and what was tried; a `Candidate` is a structure (dead time, number of poles, lag of
the drive, friction at the load or falling with speed) at the least prediction errors it reaches. `better`
brings other structures to their optima and takes the best by the Bayesian information criterion. What the
steps (`ident.friction.structure_steps`) make their proposals of stands here as well.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace

import numpy as np

from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import Poles
from ident.checks.plausible_modes import AT_BOUND, LARGEST_DAMPING
from ident.data.record import Record
from ident.fit.least_squares import fit as linear_fit
from ident.fit.regression import prepare
from ident.friction.arm import SteppedArm
from ident.friction.descent import ConvergedFit, converged
from ident.friction.gauss_newton import FrictionFit
from ident.friction.inverse_dynamics import highest_Hz
from ident.friction.logs import LoopLogs
from ident.friction.observer import ObserverFilter
from ident.friction.parameters import LEAST_LAG_SAMPLES, has_least_damping
from ident.friction.spring import Spring

# Lowest further pair, as a share of the first mode: friction that is left over looks like slow poles. Chosen.
_LOWEST_PAIR = 0.4
# Highest pair, in units of the frequency up to which the position is above its noise. Chosen: a mode at its
# very end still has poles.
_ABOVE_NOISE = 1.2


@dataclass(frozen=True, eq=False)
class Candidate:
    """A structure of arm, drive and friction, at its optimum on thinned logs.

    Attributes
    ----------
    at_optimum : ConvergedFit
        Its arm has each pole once and no dead time.
    delay_samples : int
        Dead time of the input, samples of the whole logs.
    """

    at_optimum: ConvergedFit
    delay_samples: int

    @property
    def fit(self) -> FrictionFit:
        """The fit on thinned logs, without the dead time."""
        return self.at_optimum.fit

    @property
    def criterion(self) -> float:
        """Least is best (`ConvergedFit.criterion`)."""
        return self.at_optimum.criterion


@dataclass(frozen=True, eq=False)
class Search:
    """What the steps of the estimator know of the logs.

    Attributes
    ----------
    whole : LoopLogs
    options : IdentOptions
        Of the arm's poles, at the step of the thinned logs.
    steps : int
        Of the whole logs in one of the thinned logs.
    delay_is_open : bool
        The dead time was not stated.
    thinned_logs : dict
        Thinned logs by dead time, filled when they are asked for.
    tried : set
        Structures that were fitted (`_structure_of`).
    """

    whole: LoopLogs
    options: IdentOptions
    steps: int
    delay_is_open: bool
    thinned_logs: dict[int, LoopLogs] = field(default_factory=dict)
    tried: set[tuple[object, ...]] = field(default_factory=set)

    def logs(self, delay_samples: int) -> LoopLogs:
        """Thinned logs whose positions are later by a dead time, samples of the whole logs."""
        if delay_samples not in self.thinned_logs:
            self.thinned_logs[delay_samples] = self.whole.thinned(self.steps, delay_samples)
        return self.thinned_logs[delay_samples]

    def better(self, candidate: Candidate, starts: Iterable[tuple[FrictionFit, int]]) -> Candidate:
        """The best of a candidate and the optima that some starts, fits and their dead times, lead to.

        Each structure is fitted once: its optimum does not depend on where the steps begin. What no observer
        follows explains nothing better.
        """
        self.tried.add(_structure_of(candidate.fit, candidate.delay_samples))
        best = candidate
        for start, delay_samples in starts:
            structure = _structure_of(start, delay_samples)
            if structure in self.tried:
                continue
            self.tried.add(structure)
            with suppress(ValueError, np.linalg.LinAlgError):
                logs = self.logs(delay_samples)
                optimum = converged(start, logs, self.options, to_beat=best.criterion)
                if optimum.has_empty_part:
                    # Without its empty parts it is another structure, perhaps one that was not tried.
                    start = without_empty_parts(optimum.fit, logs.rms_speed)
                    start = _without_undamped(logs, start, self.options)
                    structure = _structure_of(start, delay_samples)
                    if structure in self.tried:
                        continue
                    self.tried.add(structure)
                    optimum = converged(start, logs, self.options, to_beat=best.criterion)
                if optimum.has_empty_part or not optimum.criterion < best.criterion:
                    continue
                if not best.at_optimum.is_converged:
                    # Both sides at their optima, before one of them is taken.
                    best = self.completed(best, to_beat=optimum.criterion)
                proposal = Candidate(optimum, delay_samples)
                best = min(best, proposal, key=lambda one: one.criterion)
        return best

    def completed(self, candidate: Candidate, *, to_beat: float = np.inf) -> Candidate:
        """A candidate at its optimum, unless not even that beats a criterion."""
        if candidate.at_optimum.is_converged:
            return candidate
        logs = self.logs(candidate.delay_samples)
        return replace(candidate, at_optimum=converged(candidate.fit, logs, self.options, to_beat=to_beat))


def _structure_of(fit: FrictionFit, delay_samples: int) -> tuple[object, ...]:
    """What tells the structure of a fit from others: dead time, in samples, number of poles, and which parts
    of drive and friction it has."""
    has_stribeck = bool(np.isfinite(fit.law.fall))
    return (delay_samples, fit.model.poles.counts, fit.lag > 0, fit.spring is not None, has_stribeck)


def without_empty_parts(fit: FrictionFit, largest_fall: float) -> FrictionFit:
    """A fit without a Stribeck excess, a lag or a friction at the load that has come out as nothing, or a
    Stribeck speed that has come out as the largest (`largest_fall`, output units per second)."""
    if fit.lag <= LEAST_LAG_SAMPLES:
        fit = replace(fit, lag=0.0)
    if np.isfinite(fit.law.fall) and (fit.law.excess <= 0 or fit.law.fall >= largest_fall / AT_BOUND):
        fit = replace(fit, law=replace(fit.law, excess=0.0, fall=np.inf))
    if fit.spring is not None and fit.beyond <= 0:
        fit = replace(fit, spring=None, beyond=0.0)
    return fit


def _without_undamped(logs: LoopLogs, fit: FrictionFit, options: IdentOptions) -> FrictionFit:
    """A fit without the pairs whose damping has come out as the least of all; the fit itself where it has
    none. ValueError where no pole is left."""
    structure = fit.arm.structure
    known = np.concatenate([options.fixed().pairs, structure.unstable.pairs])
    poles = fit.model.poles
    is_undamped = has_least_damping(poles.zeta(), options) & ~np.isin(poles.pairs, known)
    if not np.any(is_undamped):
        return fit
    fewer = Poles(poles.real, poles.pairs[~is_undamped])
    if not fewer.order:
        raise ValueError("no pole of the arm is left")
    return on_poles(logs, fit, fewer)


def on_model(fit: FrictionFit, model: GobfModel) -> FrictionFit:
    """A fit with its law on another model of the arm, each pole once; its observer is left open."""
    spring = fit.spring
    if spring is not None:
        spring = Spring.of(model) or spring
    arm = SteppedArm.of(model.poles, fit.arm.structure, model.dt_s, doubled=False)
    return replace(
        fit, model=model, arm=arm, coefficients=model.coefficients, spring=spring, correction=None, ratio=0.0
    )


def on_poles(logs: LoopLogs, fit: FrictionFit, poles: Poles) -> FrictionFit:
    """A fit on other poles, the coefficients of its arm by least squares behind its friction and observer."""
    structure = replace(fit.arm.structure, estimate_initial_state=True)
    linear = linear_fit(prepare(white(logs, fit), structure), poles)
    return on_model(fit, replace(fit.model, poles=poles, coefficients=np.ravel(linear.coefficients)))


def white(logs: LoopLogs, fit: FrictionFit) -> list[Record]:
    """The logs with the force on the linear arm as their input, whitened by the observer of a fit."""
    whiten = ObserverFilter.of(fit)
    return [whiten.filtered(fit.forced(record)) for record in logs.records]


def moving(options: IdentOptions) -> IdentOptions:
    """Options for records that were cut by a filter: they start in motion."""
    return options.model_copy(update={"estimate_initial_state": True})


def above_noise(records: Sequence[Record], options: IdentOptions) -> IdentOptions:
    """Options with pairs no higher than the position rises above its noise, and real poles no slower than a
    record tells, unless their limits are stated."""
    longest_s = max(record.n_samples * record.dt_s for record in records)
    update: dict[str, float | str] = {"noise": "white"}
    if options.omega_max_rad_s is None:
        update["omega_max_rad_s"] = 2 * np.pi * _ABOVE_NOISE * highest_Hz(records)
    if options.decay_min_per_s is None:
        update["decay_min_per_s"] = 1 / longest_s
    return options.model_copy(update=update)


def few_poles(options: IdentOptions) -> IdentOptions:
    """Options that state the fewest poles, where their number is open: one real pole and one pair, one more
    where a spring or weight holds. More are led by a wrong level."""
    n_pairs = options.n_pairs
    if n_pairs is None:
        held_by_spring = not options.integrators and not options.fixed().order
        n_pairs = min(2 if held_by_spring else 1, options.max_pairs)
    n_real = min(1, options.max_real) if options.n_real is None else options.n_real
    return options.model_copy(update={"n_real": n_real, "n_pairs": n_pairs})


def without_slow_pairs(fit: FrictionFit, options: IdentOptions) -> IdentOptions:
    """Options with no pair far below the first mode of a fit, and one real pole: friction that is left looks
    like slow ones.

    With friction at the load, whose zero is known, no pair below the middle between it and the mode.
    """
    update: dict[str, float | int] = {"max_real": min(options.max_real, 1)}
    poles = fit.model.poles
    is_mode = poles.zeta() < LARGEST_DAMPING
    modes_rad_s = poles.omega_rad_s(fit.model.dt_s)[is_mode]
    if modes_rad_s.size:
        lowest_rad_s = _LOWEST_PAIR * float(modes_rad_s.min())
        spring = fit.spring if fit.arm.structure.integrators else None
        if spring is not None and spring.omega_rad_s < modes_rad_s.max():
            is_above = modes_rad_s > spring.omega_rad_s
            lowest_rad_s = float(np.sqrt(spring.omega_rad_s * modes_rad_s[is_above].min()))
        update["omega_min_rad_s"] = max(lowest_rad_s, options.omega_min_rad_s or 0.0)
    return options.model_copy(update=update)


def of_order(fit: FrictionFit, options: IdentOptions) -> IdentOptions:
    """Options that state the structure, the number of poles and the dead time of a fit."""
    structure = fit.arm.structure
    options = options.model_copy(update={"integrators": structure.integrators})
    if structure.unstable.order:
        options = options.with_unstable(structure.unstable)
    # Poles that come with integrators and unstable poles are not searched for.
    n_real, n_pairs = fit.model.poles.counts
    n_fixed_real, n_fixed_pairs = options.fixed().counts
    stated = {
        "n_real": n_real - n_fixed_real,
        "n_pairs": n_pairs - n_fixed_pairs,
        "input_delay_samples": structure.input_delay_samples,
    }
    return options.model_copy(update=stated)
