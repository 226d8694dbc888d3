"""What a test or a check found, as numbers and names; its sentence is written by whoever shows it.

Numerical code says what it noticed as a `Finding`: a kind and the values that belong to it. The sentences
stand in `workflow.text.findings`, a function for each kind of these values, so that numbers can be tested
without words and words be changed without numerical code. `PriorTest` is the verdict of
the data on something that was stated as known, with the statistic that decided it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np

from ident.data.shown import Shown

# A value that a sentence is made with.
Value = float | bool | int | str

# Confidence level of the tests of what is stated as known: one true statement in a hundred is refused. At
# .95 a user with a few statements would often be told that a right one is wrong.
TEST_LEVEL = 0.99
# Lags at which residuals are tested for whiteness: 25 samples, a few periods of what a sampled model can
# follow; chosen. A test over so many lags takes more than twice as many samples.
WHITE_LAGS = 25


class FindingKind(Enum):
    """Which question a finding answers, or what it warns of.

    Each has its sentence, and with it the names of its values, in a function of `workflow.text.findings`.
    """

    # Poles at a bound of the search.
    NO_POLE = auto()
    SLOW_BOUND = auto()
    FAST_BOUND = auto()
    OVERDAMPED_PAIR = auto()
    DAMPING_BOUND = auto()
    NO_DECAY = auto()
    FREQUENCY_BOUND = auto()
    # A model that explains nothing.
    NO_ANSWER = auto()
    NO_ANSWER_THERE = auto()
    # Pole pairs that can be no mode, or that nothing measured surrounds.
    SLOW_PAIR = auto()
    DAMPED_PAIR = auto()
    OUTSIDE_BAND = auto()
    # Records.
    TIME_UNIT = auto()
    REPAIRED = auto()
    RESAMPLED = auto()
    CLOCK_DRIFTS = auto()
    SKIPPED_ROWS = auto()
    CUT_ROW = auto()
    FOOTER = auto()
    BOOKKEPT = auto()
    TIMER_WRAPS = auto()
    HELD = auto()
    WRAPS = auto()
    LATE_COMMAND = auto()
    CONTROLLER_PERIOD = auto()
    SPIKES = auto()
    NO_READING = auto()
    LONG_STEPS = auto()
    UNIT_CONTRADICTED = auto()
    UNIT_CONVERTED = auto()
    UNIT_OF_LOOP = auto()
    EXCHANGED = auto()
    OPPOSITE = auto()
    UNIT_OF_REFERENCE = auto()
    REFERENCE_STILL = auto()
    FEW_SAMPLES = auto()
    UNKNOWN_TIME_CONSTANT = auto()
    UNKNOWN_DAMPING = auto()
    WEAK_INPUT = auto()
    ALIKE_INPUTS = auto()
    CLIPPED = auto()
    SATURATED = auto()
    FEW_READINGS = auto()
    READINGS_HELD = auto()
    SLOW_POLE_IS_DRIFT = auto()
    DRIFT = auto()
    FAR_FROM_ZERO = auto()
    # Questions left to the data, and what was stated as known.
    NUISANCE = auto()
    INTEGRATORS = auto()
    SPARE_INTEGRATORS = auto()
    FIXED_POLES = auto()
    DELAY = auto()
    DEAD_TIME = auto()
    DEADBEAT = auto()
    ANSWERS_AT_ONCE = auto()
    DIRECT_TERM = auto()
    RELATIVE_DEGREE = auto()
    TOO_FEW_POLES = auto()
    # Residuals and noise.
    COLOURED_NOISE = auto()
    COLOURED_RESIDUAL = auto()
    WHITENESS = auto()
    INDEPENDENCE = auto()
    NOT_WHITE = auto()
    UNTRIED_FRICTION = auto()
    REMOTE_FRICTION = auto()
    NOMINAL_OUTSIDE = auto()
    NOT_INDEPENDENT = auto()
    CHI_SQUARE = auto()
    ASSUMED_OUTSIDE = auto()
    RESPONSE_AT_ONCE = auto()
    # Records made in closed loop.
    TWO_STAGE = auto()
    INDIRECT = auto()
    DIRECT = auto()
    DIRECT_WITH_FRICTION = auto()
    UNEXPLAINED_INPUT = auto()
    # Noise and nonlinear distortion.
    LINEAR = auto()
    DISTORTED = auto()
    NOISE_HIDES = auto()
    ONE_REALISATION = auto()
    ONE_PERIOD = auto()
    NOT_PERIODIC = auto()
    REPEATED = auto()
    AMPLITUDE_EFFECT = auto()
    AMPLITUDE_HIDDEN = auto()


@dataclass(frozen=True, repr=False)
class Finding(Shown):
    """Something that a test or a check found.

    Attributes
    ----------
    kind : FindingKind
    values : mapping of str to Value
        The numbers and names that belong to it, with units in their keys (`dt_s`); which there are depends on
        the kind.
    """

    kind: FindingKind
    values: Mapping[str, Value]


def finding(kind: FindingKind, **values: Value | np.generic) -> Finding:
    """Return a finding of a kind with these values; numbers of numpy become plain ones, as JSON has them.

    Which values a kind needs is not checked here: its sentence fails where one is missing. Arrays are kept as
    they are.
    """
    plain_values: dict[str, Value] = {}
    for name, value in values.items():
        plain_values[name] = value.item() if isinstance(value, np.generic) else value
    return Finding(kind, plain_values)


@dataclass(frozen=True)
class PriorTest:
    """Verdict of the data on one prior: something that the user stated as known.

    Attributes
    ----------
    kind : FindingKind
        Which prior it is: `INTEGRATORS`, `DELAY`, `FIXED_POLES`, ...
    prior : str
        The prior in words.
    refused : bool
        The statistic exceeds the limit (of a cancelled integrator, it falls below).
    imposed : bool
        The model keeps to the prior all the same.
    statistic, limit : float
        The statistic is chi-square distributed where the prior holds; the limit is its quantile at 99 %
        (`TEST_LEVEL`).
    degrees_of_freedom : int
    details : mapping of str to Value
        What the advice needs beside these.
    """

    kind: FindingKind
    prior: str
    refused: bool
    imposed: bool
    statistic: float
    limit: float
    degrees_of_freedom: int
    details: Mapping[str, Value] = field(default_factory=dict)

    @property
    def finding(self) -> Finding:
        """The verdict as a finding of its kind, with the level of the test and the details.

        TypeError where a key of `details` is one of the names above.
        """
        return finding(
            self.kind,
            prior=self.prior,
            refused=self.refused,
            imposed=self.imposed,
            statistic=self.statistic,
            limit=self.limit,
            level=TEST_LEVEL,
            **self.details,
        )


def distinct(findings: Sequence[Finding]) -> tuple[Finding, ...]:
    """Return each of some findings once: those of one kind with equal values are the same.

    They stay in the order in which each comes first. Of equal ones the last is kept, in the place of the
    first. Empty for none.
    """
    by_content = {}
    for item in findings:
        by_content[item.kind, repr(dict(item.values))] = item
    return tuple(by_content.values())
