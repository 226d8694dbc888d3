"""Which experiment to run next: the feasible one that tells the competing hypotheses apart best."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from diagnosis.machine.machine_protocol import Real
from diagnosis.next_experiment.discrimination import CompetingHypothesis, distances
from diagnosis.next_experiment.experiment_choices import (
    ALSO_WEAK,
    Excitation,
    Limits,
    excitations,
    tailored_excitations,
    within,
)

# A pair this many standard deviations apart is settled; an experiment earns nothing by parting it further.
_SETTLED = 20.0
# Below this nothing is said to separate two hypotheses.
_SEPARATES = 3.0
# A runner-up with less than this share of the first hypothesis' probability is beaten.
_DECIDED = 0.01
# Enough amplitudes and phases that a handful of free parameters cannot absorb them.
_TAILORED_LINES = 12


@dataclass(frozen=True)
class Separation:
    """How far an experiment parts two hypotheses."""

    hypotheses: tuple[str, str]
    standard_deviations: float
    log_bayes_factor: float

    @property
    def separated(self) -> bool:
        return self.standard_deviations >= _SEPARATES


@dataclass(frozen=True)
class Considered:
    """An excitation that was looked at.

    `feasible`: stays in the limits at a useful size. `at_most`: its score if no free parameter absorbed
    anything; `score`: the score, None where at_most was already too low to win.
    """

    kind: str
    parameters: Mapping[str, float | int | str]
    amplitude_V: float
    feasible: bool
    at_most: float
    score: float | None


@dataclass(frozen=True, eq=False)
class NextExperiment:
    """The experiment to run next.

    kind, parameters, amplitude_V, duration_s, dt_s, voltage_V (T,)
        The excitation.
    separations : tuple of Separation. Every pair of hypotheses.
    expected_log_bayes_factor : float. Over the pairs, weighted with the product of their probabilities.
    hub_angle_range_rad, deflection_range_m : Least and largest value any of the hypotheses predicts.
    separates : bool. Whether any pair comes apart by three standard deviations.
    decided : bool. The records already decide for the first hypothesis; the experiment would only confirm it.
    considered : tuple of Considered. Best first.
    """

    kind: str
    parameters: dict[str, float | int | str]
    amplitude_V: float
    duration_s: float
    dt_s: float
    voltage_V: Real
    separations: tuple[Separation, ...]
    expected_log_bayes_factor: float
    hub_angle_range_rad: tuple[float, float]
    deflection_range_m: tuple[float, float]
    separates: bool
    decided: bool
    considered: tuple[Considered, ...] = ()


def next_experiment(
    competing: Sequence[CompetingHypothesis],
    limits: Limits,
    *,
    n_samples: int = 1400,
    rng: np.random.Generator | None = None,
) -> NextExperiment:
    """Choose among `excitations` of n_samples within the limits, and two made for these hypotheses.

    competing : Two at least, all with the same sampling period and noise.
    rng : Of the random excitations; without it a fixed sequence.

    Raises ValueError: fewer than two hypotheses, hypotheses that sample differently or are noise-free, no
    excitation that stays in the limits.
    """
    competing = tuple(competing)
    _check(competing)
    weights = pair_weights(competing)
    dt = competing[0].rig.sampling.dt_s
    rng = np.random.default_rng(0) if rng is None else rng
    choices = list(excitations(limits.voltage_V, n_samples, dt, rng))
    looked_at = [_Prospect.of(choice, limits, competing) for choice in choices]
    feasible = [p for p in looked_at if p is not None]
    further = [p.excitation.scaled(1 / 3) for p in feasible if p.excitation.kind in ALSO_WEAK]
    further += _tailored(feasible, competing, weights, limits, rng)
    looked_at += [_Prospect.of(choice, limits, competing) for choice in further]
    choices += further
    prospects = sorted((p for p in looked_at if p is not None), key=lambda p: p.bound, reverse=True)
    if not prospects:
        raise ValueError(
            f"no experiment stays within {limits.hub_angle_rad} rad and {limits.deflection_m} m at a "
            f"hundredth of {limits.voltage_V} V or more: give wider limits"
        )
    chosen, best, distance = prospects[0], (-np.inf, -np.inf), np.zeros(0)
    for prospect in prospects:
        # Absorbing parameters only lessen a difference: what cannot win without them need not be computed.
        if prospect.bound[0] <= best[0]:
            break
        apart, _ = prospect.distances(competing)
        score = expected_log_bayes_factor(apart, weights)
        prospect.score = score[0]
        if score > best:
            chosen, best, distance = prospect, score, apart
    left_out = [c for c, p in zip(choices, looked_at, strict=True) if p is None]
    considered = [p.considered() for p in sorted(prospects, key=lambda p: -(p.score or 0.0))]
    considered += [Considered(c.kind, c.parameters, c.amplitude_V, False, 0.0, None) for c in left_out]
    x = chosen.excitation
    pairs = separations(competing, distance)
    first, second = sorted((r.probability for r in competing), reverse=True)[:2]
    return NextExperiment(
        kind=x.kind,
        parameters=dict(x.parameters),
        amplitude_V=x.amplitude_V,
        duration_s=float(x.voltage_V.size * dt),
        dt_s=dt,
        voltage_V=x.voltage_V,
        separations=pairs,
        expected_log_bayes_factor=best[1],
        hub_angle_range_rad=chosen.hub,
        deflection_range_m=chosen.deflection,
        separates=any(pair.separated for pair in pairs),
        decided=second < _DECIDED * first,
        considered=tuple(considered),
    )


def _check(competing: Sequence[CompetingHypothesis]) -> None:
    if len(competing) < 2:
        raise ValueError(f"an experiment separates at least two hypotheses; got {len(competing)}")
    first = competing[0]
    for one in competing:
        if one.rig.sampling.dt_s != first.rig.sampling.dt_s or not np.array_equal(one.noise, first.noise):
            raise ValueError("all hypotheses need the same sampling period and sensor noise")
    if not np.all(first.noise > 0):
        raise ValueError("sensors need a noise level above zero to tell hypotheses apart by")


def separations(competing: Sequence[CompetingHypothesis], distance: Real) -> tuple[Separation, ...]:
    """Of every pair, from `distances`."""
    names = combinations([r.name for r in competing], 2)
    return tuple(Separation(two, float(d), float(d**2 / 2)) for two, d in zip(names, distance, strict=True))


def pair_weights(competing: Sequence[CompetingHypothesis]) -> Real:
    """Of every pair, the product of their probabilities; of hopeless ones all alike."""
    p = np.array([a.probability * b.probability for a, b in combinations(competing, 2)])
    return p / p.sum() if p.sum() > 0 else np.full(p.size, 1 / p.size)


def expected_log_bayes_factor(distance: Real, weights: Real) -> tuple[float, float]:
    """Expected log Bayes factor with settled pairs cut off, and without, to choose between equals."""
    return float(weights @ np.minimum(distance, _SETTLED) ** 2 / 2), float(weights @ distance**2 / 2)


class _Prospect:
    """An excitation within the limits with every hypothesis' prediction."""

    def __init__(
        self, excitation: Excitation, outputs: Sequence[Real], competing: Sequence[CompetingHypothesis]
    ) -> None:
        self.excitation = excitation
        self._whitened = [np.asarray(y / competing[0].noise).ravel() for y in outputs]
        self.hub = _range([y[:, 0] for y in outputs])
        self.deflection = _range(_deflections(competing, outputs))
        self.score: float | None = None
        plain = np.array([np.linalg.norm(a - b) for a, b in combinations(self._whitened, 2)])
        self.bound = expected_log_bayes_factor(plain, pair_weights(competing))

    @classmethod
    def of(
        cls, choice: Excitation, limits: Limits, competing: Sequence[CompetingHypothesis]
    ) -> _Prospect | None:
        outputs: list[Real] = []

        def respond(voltage: Real) -> tuple[float, float]:
            outputs[:] = [r.outputs(voltage) for r in competing]
            angle = max(map(abs, _range([y[:, 0] for y in outputs])))
            return angle, max(map(abs, _range(_deflections(competing, outputs))))

        excitation = within(choice, limits, respond)
        return None if excitation is None else cls(excitation, outputs, competing)

    def distances(self, competing: Sequence[CompetingHypothesis]) -> tuple[Real, list[Real]]:
        return distances(competing, self.excitation.voltage_V, self._whitened)

    def considered(self) -> Considered:
        x = self.excitation
        return Considered(x.kind, x.parameters, x.amplitude_V, True, self.bound[0], self.score)


def _tailored(
    prospects: Sequence[_Prospect],
    competing: Sequence[CompetingHypothesis],
    weights: Real,
    limits: Limits,
    rng: np.random.Generator,
) -> list[Excitation]:
    """Multisine and binary signal at the lines where the hypotheses differ most for the voltage spent there,
    by the first multisine among the prospects; exact for linear machines with nothing to absorb."""
    wide = [p for p in prospects if p.excitation.kind == "multisine"]
    if not wide:
        return []
    voltage = wide[0].excitation.voltage_V
    period = voltage.size // 2
    _, remains = wide[0].distances(competing)
    last = [rest.reshape(-1, 2)[period : 2 * period] for rest in remains]
    power = sum(
        w * np.sum(np.abs(np.fft.rfft(rest, axis=0)) ** 2, axis=1)
        for w, rest in zip(weights, last, strict=True)
    )
    drive = np.abs(np.fft.rfft(voltage[period : 2 * period])) ** 2
    driven = np.flatnonzero(drive > 1e-6 * drive.max())
    gain = np.asarray(power)[driven] / drive[driven]
    lines = np.sort(driven[np.argsort(-gain, kind="stable")[:_TAILORED_LINES]])
    return tailored_excitations(lines, voltage.size, competing[0].rig.sampling.dt_s, limits.voltage_V, rng)


def _deflections(competing: Sequence[CompetingHypothesis], outputs: Sequence[Real]) -> list[Real]:
    return [
        np.asarray(y[:, 1] - (r.rig.hub.radius_m + r.rig.link.length_m) * y[:, 0])
        for r, y in zip(competing, outputs, strict=True)
    ]


def _range(signals: Sequence[Real]) -> tuple[float, float]:
    return float(min(s.min() for s in signals)), float(max(s.max() for s in signals))
