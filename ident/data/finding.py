"""What a test or a check found, as numbers; its sentence stands in the template of those who show it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import Enum, auto

import numpy as np

from ident.data.shown import Shown

Value = float | bool | int | str  # what a sentence is made with

# Level of the tests of what is stated as known.
TEST_LEVEL = 0.99

# Lags at which residuals are tested for whiteness: 25 samples, a few periods of what a sampled model can
# follow. A test over so many lags takes more than twice as many samples.
WHITE_LAGS = 25


class FindingKind(Enum):
    """Which question a finding answers, or what it warns of."""

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
    UNIT_OF_REFERENCE = auto()
    FEW_SAMPLES = auto()
    UNKNOWN_TIME_CONSTANT = auto()
    UNKNOWN_DAMPING = auto()
    WEAK_INPUT = auto()
    ALIKE_INPUTS = auto()
    CLIPPED = auto()
    SATURATED = auto()
    FEW_READINGS = auto()
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
    """A kind, and the numbers and names that belong to it (units in their names)."""

    kind: FindingKind
    values: Mapping[str, Value]


def finding(kind: FindingKind, **values: Value | np.generic) -> Finding:
    """Numbers of numpy become plain ones."""
    return Finding(kind, {k: v.item() if isinstance(v, np.generic) else v for k, v in values.items()})


@dataclass(frozen=True)
class PriorTest:
    """Verdict of the data on one prior: refused where statistic exceeds limit, the chi-square quantile at 99
    % with degrees_of_freedom (a cancelled integrator the other way round). imposed: the model keeps to the
    prior; details: what the advice needs beside these."""

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


def distinct(found: Sequence[Finding]) -> tuple[Finding, ...]:
    """Each one once, in their order."""
    return tuple({(item.kind, repr(dict(item.values))): item for item in found}.values())
