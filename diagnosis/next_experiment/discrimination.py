"""How far two explanations of a machine lie apart in the records of an experiment.

Two hypotheses i and j predict outputs y_i, y_j for an input. Their difference in noise deviations, D, is what
an experiment has to show, less what free parameters absorb: with derivatives J by them and the precision L of
what is known about them,

    d^2 = D' (I + J L^-1 J')^-1 D = D'D - D'J (J'J + L)^-1 J'D,

the expected log Bayes factor is about d^2 / 2, and d reads as standard deviations between the two. Where fits
to the records give the precision, J holds both hypotheses' parameters. Where they do not, one is taken as
true at its parameters and the other one refits its own (effect parameters known to a factor e, nominal ones
to their tolerances), and d^2 is the mean of both ways round: with both free, any two effects could vanish
together. To first order in the free parameters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from scipy.linalg import block_diag

from diagnosis.machine.machine_protocol import Real
from plant.effects import EFFECTS, Effect
from plant.rig import Rig
from plant.simulate import simulate

# Relative steps of difference quotients; contacts that switch need one that averages over many of them.
_STEP = {"smooth": 1e-4, "continuous": 1e-3, "non-smooth": 3e-2}
# In tolerances: small against one, large against the wobble of friction.
_TOLERANCE_STEP = 0.02
_LOG_PRECISION = 1.0


@dataclass(frozen=True, eq=False)
class CompetingHypothesis:
    """One explanation that is left.

    Attributes
    ----------
    probability : float
    rig : Rig
        With its fitted nominal parameters.
    effects : tuple of Effect
    directions : callable, optional
        Voltage (T,) -> derivatives (2 T, P) of the outputs in noise deviations, hub before tip sample by
        sample, by the hypothesis' free parameters. Without it: difference quotients by the logarithms of the
        effects' parameters and by the tolerances of the rig (there without non-smooth effects, whose contacts
        say little about a small change of a parameter and cost most of the time).
    precision : (P, P), optional
        What is known about the free parameters: the Gauss-Newton Hessian of the fit to the records, prior
        included. Needed with `directions`.
    name : str
        In sentences; by default the names of the effects.
    """

    probability: float
    rig: Rig
    effects: tuple[Effect, ...] = ()
    directions: Callable[[Real], Real] | None = None
    precision: Real | None = None
    name: str = ""

    def __post_init__(self) -> None:
        if not 0 <= self.probability <= 1 + 1e-9:  # a sum of shares may round above one
            raise ValueError(f"a hypothesis' probability lies between 0 and 1; got {self.probability}")
        object.__setattr__(self, "effects", tuple(self.effects))
        if (self.directions is None) != (self.precision is None):
            raise ValueError("a hypothesis with directions needs their precision, and the other way round")
        if not self.name:
            names = " with ".join(type(effect).id for effect in self.effects)
            object.__setattr__(self, "name", names or "no effect")


def distances(
    competing: Sequence[CompetingHypothesis], voltage: Real, whitened: Sequence[Real]
) -> tuple[Real, list[Real]]:
    """d of every pair in standard deviations, and what parameters leave of its difference (2 T,).

    whitened: every hypothesis' outputs (2 T,) in noise deviations for the voltage (T,), sample by sample.
    """
    noise = noise_of(competing[0].rig)
    free = [_directions(r, voltage, y, noise) for r, y in zip(competing, whitened, strict=True)]
    found, remains = [], []
    for i, j in combinations(range(len(competing)), 2):
        D = whitened[i] - whitened[j]
        if competing[i].precision is not None and competing[j].precision is not None:
            J = np.hstack([free[i][0], free[j][0]])
            sides = [(J, block_diag(free[i][1], free[j][1]))]
        else:
            sides = [free[i], free[j]]
        lefts = [_left(D, *side) for side in sides]
        found.append(np.sqrt(np.mean([squared for squared, _ in lefts])))
        remains.append(np.mean([rest for _, rest in lefts], axis=0))
    return np.array(found), remains


def noise_of(rig: Rig) -> Real:
    """(2,) noise standard deviations of hub angle and tip."""
    return np.array([rig.sensors.hub_angle_noise_rad, rig.sensors.tip_noise_m])


def _left(D: Real, J: Real, L: Real) -> tuple[float, Real]:
    """D' (I + J L^-1 J')^-1 D and (I + J L^-1 J')^-1 D."""
    if not J.shape[1]:
        return float(D @ D), D
    moment = J.T @ D
    absorbed = np.linalg.lstsq(J.T @ J + L, moment, rcond=1e-13)[0]
    return max(float(D @ D - moment @ absorbed), 0.0), np.asarray(D - J @ absorbed)


def _directions(
    hypothesis: CompetingHypothesis, voltage: Real, whitened: Real, noise: Real
) -> tuple[Real, Real]:
    """Derivatives (2 T, P) by the free parameters and their precision (P, P)."""
    if hypothesis.directions is not None and hypothesis.precision is not None:
        J = np.asarray(hypothesis.directions(voltage), dtype=np.float64)
        L = np.asarray(hypothesis.precision, dtype=np.float64)
        if J.shape != (whitened.size, L.shape[0]) or L.shape != (J.shape[1], J.shape[1]):
            raise ValueError(
                f"hypothesis {hypothesis.name}: needs directions ({whitened.size}, P) and precision (P, P); "
                f"got {J.shape} and {L.shape}"
            )
        return J, L
    columns, precision = [], []
    for rig, effects, step in _effect_steps(hypothesis):
        output = simulate(rig, voltage, effects).output / noise
        columns.append((output.ravel() - whitened) / step)
        precision.append(_LOG_PRECISION)
    if hypothesis.rig.tolerances:
        effects = tuple(e for e in hypothesis.effects if type(e).dependence != "non-smooth")
        start = whitened
        if len(effects) < len(hypothesis.effects):
            start = (simulate(hypothesis.rig, voltage, effects).output / noise).ravel()
        for key, tolerance in hypothesis.rig.tolerances.items():
            moved = hypothesis.rig.scaled({key: 1.0 / (1.0 + tolerance * _TOLERANCE_STEP)})
            output = simulate(moved, voltage, effects).output / noise
            columns.append((output.ravel() - start) / _TOLERANCE_STEP)
            precision.append(1.0)
    if not columns:
        return np.zeros((whitened.size, 0)), np.zeros((0, 0))
    return np.column_stack(columns), np.diag(precision)


def _effect_steps(hypothesis: CompetingHypothesis) -> list[tuple[Rig, tuple[Effect, ...], float]]:
    """The hypothesis with one effect parameter moved: rig, effects, step; one entry per parameter."""
    found = []
    for k, effect in enumerate(hypothesis.effects):
        for name, value in effect.parameters().items():
            step = _STEP[type(effect).dependence]
            moved, step = _moved(effect, name, value, step)
            if moved is not None:
                effects = (*hypothesis.effects[:k], moved, *hypothesis.effects[k + 1 :])
                found.append((hypothesis.rig, effects, step))
    return found


def _moved(effect: Effect, name: str, value: float, step: float) -> tuple[Effect | None, float]:
    """The effect with one parameter a small factor larger, or smaller at a bound; None at zero.

    A phase moves by radians.
    """
    for signed in (step, -step):
        target = value + signed if name == "phase_rad" else value * (1 + signed)
        if target == value:
            return None, step
        try:
            return EFFECTS[type(effect).id](**{**effect.parameters(), name: target}), signed
        except ValueError:
            continue
    return None, step
