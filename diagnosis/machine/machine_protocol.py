"""What the diagnosis asks of a machine and its records; a flexible link is one of many that can answer.

`diagnosis.machine.flexible_arm.FlexibleArm` answers for a rig, `diagnosis.machine.own_plant.Plant` for a
simulation somebody brings. The engine (residual, nominal, screening, fit, hypotheses, search, diagnosis)
knows no other machine.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, Protocol, TypeVar

import numpy as np
import numpy.typing as npt

from plant.effects import EFFECTS

if TYPE_CHECKING:
    from diagnosis.machine.candidates import Candidate

Real = npt.NDArray[np.float64]
Dependence = Literal["smooth", "continuous", "jagged"]
Stated = TypeVar("Stated", bound="StatedValues")


@dataclass(frozen=True)
class Weighing:
    """How residuals of a machine are weighed.

    Attributes
    ----------
    listed : tuple of str
        Effects that are looked for; prior probabilities are shared among them.
    model_error : float
        What even the right set of effects may leave over, in noise deviations (scale of a half-normal prior,
        RMS over all samples). Zero where the simulation is as good as the sensors.
    correlation_samples : float
        Samples per independent value of what is left over; counts only beside a model error.
    """

    listed: tuple[str, ...] = tuple(EFFECTS)
    model_error: float = 0.0
    correlation_samples: float = 1.0

    @property
    def scale(self) -> float:
        """Residuals count by this much less than white noise of the sensors would."""
        if not self.model_error > 0:
            return 1.0
        return float(np.sqrt(self.correlation_samples * (1 + self.model_error**2)))


class StatedValues(Protocol):
    """Something with stated parameters that may be off."""

    @property
    def tolerances(self) -> Mapping[str, float]:
        """Parameter -> relative standard deviation of its stated value."""

    def scaled(self: Stated, factors: Mapping[str, float]) -> Stated:
        """The same with these parameters multiplied."""


class Machine(StatedValues, Protocol):
    """A machine that can be simulated, as its makers know it."""

    @property
    def output_names(self) -> tuple[str, ...]:
        """(Y,) names with units."""

    @property
    def noise(self) -> Real:
        """(Y,) noise standard deviations in the outputs' units."""

    @property
    def weighing(self) -> Weighing: ...

    @property
    def description(self) -> Any:
        """What a user gets back as the repaired machine."""

    def simulator(self, effects: Sequence[Any]) -> Callable[[Real], Real]:
        """Inputs (T, U) -> outputs (T, Y) without noise; effects as its own candidates make them."""

    def candidates(self, case: Any) -> tuple[Candidate, ...]:
        """Effects that may be missing, as search spaces with ranges that fit the case's records."""


class RecordOfMachine(Protocol):
    """One experiment."""

    @property
    def name(self) -> str: ...

    @property
    def role(self) -> Literal["estimation", "held_out"]: ...

    @property
    def input(self) -> Real:
        """(T, U)"""

    @property
    def output(self) -> Real:
        """(T, Y) as measured."""


class CaseOfMachine(Protocol):
    """A machine and its records."""

    @property
    def name(self) -> str: ...

    @property
    def machine(self) -> Machine: ...

    @property
    def experiments(self) -> Sequence[RecordOfMachine]: ...

    @property
    def estimation(self) -> Sequence[RecordOfMachine]: ...

    @property
    def held_out(self) -> Sequence[RecordOfMachine]: ...

    @property
    def noise(self) -> Real: ...

    @property
    def steps(self) -> Real:
        """(Y,) steps of outputs whose values lie on a lattice, 0 for all others."""
