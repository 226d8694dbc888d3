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
from plant.rig import Rig

# A pair this many standard deviations apart is settled; an experiment earns nothing by parting it further.
# Chosen; doubled, one pair that is far apart outweighs two that are not.
_SETTLED = 20.0
# Below this many standard deviations nothing is said to separate two hypotheses: one in a thousand.
_SEPARATES = 3.0
# A runner-up with less than this share of the first hypothesis' probability is beaten.
_DECIDED = 0.01
# Lines of a tailored excitation: enough amplitudes and phases that a handful of free parameters cannot absorb
# them. Chosen; twice as many share the same voltage.
_TAILORED_LINES = 12
# Size of the weak excitations that are tried beside those at the limits: friction weighs three times as much
# in them, and the motion still stands above the noise of usual sensors. Chosen.
_WEAK = 1 / 3
# Power of a line over that of the strongest one below which it is not driven.
_DRIVEN = 1e-6


@dataclass(frozen=True)
class Separation:
    """How far an experiment parts two hypotheses, by name; log_bayes_factor is the expected one."""

    hypotheses: tuple[str, str]
    standard_deviations: float
    log_bayes_factor: float

    @property
    def separated(self) -> bool:
        """Whether the two come apart by three standard deviations."""
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
    """Choose among `excitations` within the limits, and two made for these hypotheses.

    Parameters
    ----------
    competing : sequence of CompetingHypothesis
        Two at least, all with the same sampling period and noise.
    limits : Limits
    n_samples : int
        Of every excitation; by default those of a record of the workshop.
    rng : numpy Generator, optional
        Of the random excitations; without it a fixed sequence.

    Raises
    ------
    ValueError
        Fewer than two hypotheses, one of a plant of one's own, hypotheses that sample differently or are
        noise-free, no excitation that stays in the limits.
    """
    competing = tuple(competing)
    _check(competing)
    weights = pair_weights(competing)
    dt = competing[0].rig.sampling.dt_s
    rng = np.random.default_rng(0) if rng is None else rng

    # Each at the limits; those that show friction and play also weaker; and what is made to measure.
    choices = list(excitations(limits.voltage_V, n_samples, dt, rng))
    looked_at = [_Prospect.of(choice, limits, competing) for choice in choices]
    feasible = [prospect for prospect in looked_at if prospect is not None]
    further = [
        prospect.excitation.scaled(_WEAK) for prospect in feasible if prospect.excitation.kind in ALSO_WEAK
    ]
    further += _tailored(feasible, competing, weights, limits, rng)
    looked_at += [_Prospect.of(choice, limits, competing) for choice in further]
    choices += further
    prospects = [prospect for prospect in looked_at if prospect is not None]
    if not prospects:
        raise ValueError(
            f"no experiment stays within {limits.hub_angle_rad} rad and {limits.deflection_m} m at a "
            f"hundredth of {limits.voltage_V} V or more: give wider limits"
        )

    prospects.sort(key=lambda prospect: prospect.bound, reverse=True)
    chosen = prospects[0]
    best = (-np.inf, -np.inf)
    apart_in_best = np.zeros(0)
    for prospect in prospects:
        # Absorbing parameters only lessen a difference: what cannot win without them need not be computed.
        if prospect.bound <= best:
            break
        apart, _ = prospect.distances(competing)
        score = expected_log_bayes_factor(apart, weights)
        prospect.score = score[0]
        if score > best:
            chosen = prospect
            best = score
            apart_in_best = apart

    considered = [prospect.considered() for prospect in sorted(prospects, key=lambda p: -(p.score or 0.0))]
    for choice, looked in zip(choices, looked_at, strict=True):
        if looked is None:
            considered.append(
                Considered(choice.kind, choice.parameters, choice.amplitude_V, False, 0.0, None)
            )
    excitation = chosen.excitation
    pairs = separations(competing, apart_in_best)
    first, second = sorted((hypothesis.probability for hypothesis in competing), reverse=True)[:2]
    return NextExperiment(
        kind=excitation.kind,
        parameters=dict(excitation.parameters),
        amplitude_V=excitation.amplitude_V,
        duration_s=float(excitation.voltage_V.size * dt),
        dt_s=dt,
        voltage_V=excitation.voltage_V,
        separations=pairs,
        expected_log_bayes_factor=best[1],
        hub_angle_range_rad=chosen.hub,
        deflection_range_m=chosen.deflection,
        separates=any(pair.separated for pair in pairs),
        decided=second < _DECIDED * first,
        considered=tuple(considered),
    )


def _check(competing: Sequence[CompetingHypothesis]) -> None:
    """Raise ValueError where hypotheses cannot be compared (`next_experiment`)."""
    if len(competing) < 2:
        raise ValueError(f"an experiment separates at least two hypotheses; got {len(competing)}")
    first = competing[0]
    for hypothesis in competing:
        if not isinstance(hypothesis.rig, Rig):
            raise ValueError(
                f"{hypothesis.name}: excitations are made for a rig's motor; what to record of a plant of "
                "one's own its diagnosis says (`Diagnosis.next_experiment`)"
            )
        same_period = hypothesis.rig.sampling.dt_s == first.rig.sampling.dt_s
        if not same_period or not np.array_equal(hypothesis.noise, first.noise):
            raise ValueError("all hypotheses need the same sampling period and sensor noise")
    if not np.all(first.noise > 0):
        raise ValueError("sensors need a noise level above zero to tell hypotheses apart by")


def separations(competing: Sequence[CompetingHypothesis], apart: Real) -> tuple[Separation, ...]:
    """Every pair with its distance, from (pairs,) standard deviations as `distances` gives them."""
    names = combinations([hypothesis.name for hypothesis in competing], 2)
    return tuple(Separation(pair, float(d), float(d**2 / 2)) for pair, d in zip(names, apart, strict=True))


def pair_weights(competing: Sequence[CompetingHypothesis]) -> Real:
    """(pairs,) products of the probabilities, over their sum; of hopeless ones all alike."""
    products = np.array([a.probability * b.probability for a, b in combinations(competing, 2)])
    if not products.sum() > 0:
        return np.full(products.size, 1 / products.size)
    return np.asarray(products / products.sum())


def expected_log_bayes_factor(apart: Real, weights: Real) -> tuple[float, float]:
    """Expected log Bayes factor with settled pairs cut off, and without, to choose between equals.

    apart, weights : (pairs,) standard deviations, and weights that sum to one.
    """
    cut_off = np.minimum(apart, _SETTLED)
    return float(weights @ cut_off**2 / 2), float(weights @ apart**2 / 2)


class _Prospect:
    """An excitation within the limits with every hypothesis' prediction.

    hub, deflection : least and largest value that any hypothesis predicts [rad], [m].
    bound : score if no free parameter absorbed anything. score : the score, None before it is computed.
    """

    def __init__(
        self, excitation: Excitation, outputs: Sequence[Real], competing: Sequence[CompetingHypothesis]
    ) -> None:
        self.excitation = excitation
        self._whitened = [np.asarray(y / competing[0].noise).ravel() for y in outputs]
        self.hub = _range([y[:, 0] for y in outputs])
        self.deflection = _range(_deflections(competing, outputs))
        self.score: float | None = None
        differences = np.array([np.linalg.norm(a - b) for a, b in combinations(self._whitened, 2)])
        self.bound = expected_log_bayes_factor(differences, pair_weights(competing))

    @classmethod
    def of(
        cls, choice: Excitation, limits: Limits, competing: Sequence[CompetingHypothesis]
    ) -> _Prospect | None:
        """A choice, scaled into the limits by every hypothesis; None where that leaves nothing of use."""
        outputs: list[Real] = []

        def respond(voltage: Real) -> tuple[float, float]:
            outputs[:] = [hypothesis.outputs(voltage) for hypothesis in competing]
            angle = max(map(abs, _range([y[:, 0] for y in outputs])))
            return angle, max(map(abs, _range(_deflections(competing, outputs))))

        excitation = within(choice, limits, respond)
        return None if excitation is None else cls(excitation, outputs, competing)

    def distances(self, competing: Sequence[CompetingHypothesis]) -> tuple[Real, list[Real]]:
        """`discrimination.distances` of this experiment."""
        return distances(competing, self.excitation.voltage_V, self._whitened)

    def considered(self) -> Considered:
        """What is told of it."""
        excitation = self.excitation
        return Considered(
            kind=excitation.kind,
            parameters=excitation.parameters,
            amplitude_V=excitation.amplitude_V,
            feasible=True,
            at_most=self.bound[0],
            score=self.score,
        )


def _tailored(
    prospects: Sequence[_Prospect],
    competing: Sequence[CompetingHypothesis],
    weights: Real,
    limits: Limits,
    rng: np.random.Generator,
) -> list[Excitation]:
    """Multisine and binary signal at the lines where the hypotheses differ most for the voltage spent there,
    by the first multisine among the prospects; exact for linear machines with nothing to absorb. Empty
    without a multisine."""
    multisines = [prospect for prospect in prospects if prospect.excitation.kind == "multisine"]
    if not multisines:
        return []
    voltage = multisines[0].excitation.voltage_V
    period = voltage.size // 2
    _, remains = multisines[0].distances(competing)
    # Power of what remains of each pair's difference, line by line of the second period.
    power = np.zeros(period // 2 + 1)
    for weight, remaining in zip(weights, remains, strict=True):
        last_period = remaining.reshape(-1, 2)[period : 2 * period]
        power += weight * np.sum(np.abs(np.fft.rfft(last_period, axis=0)) ** 2, axis=1)
    drive = np.abs(np.fft.rfft(voltage[period : 2 * period])) ** 2
    driven = np.flatnonzero(drive > _DRIVEN * drive.max())
    gain = power[driven] / drive[driven]
    lines = np.sort(driven[np.argsort(-gain, kind="stable")[:_TAILORED_LINES]])
    return tailored_excitations(lines, voltage.size, competing[0].rig.sampling.dt_s, limits.voltage_V, rng)


def _deflections(competing: Sequence[CompetingHypothesis], outputs: Sequence[Real]) -> list[Real]:
    """(T,) deflection of the tip [m] of every hypothesis, from its outputs (T, 2): hub angle and tip."""
    deflections = []
    for hypothesis, output in zip(competing, outputs, strict=True):
        reach = hypothesis.rig.hub.radius_m + hypothesis.rig.link.length_m
        deflections.append(np.asarray(output[:, 1] - reach * output[:, 0]))
    return deflections


def _range(signals: Sequence[Real]) -> tuple[float, float]:
    """Least and largest value of some signals."""
    return float(min(signal.min() for signal in signals)), float(max(signal.max() for signal in signals))
