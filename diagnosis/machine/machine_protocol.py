"""What the diagnosis asks of a machine and its records; a flexible link is one of many that can answer.

`diagnosis.machine.flexible_arm.FlexibleArm` answers for a rig, `diagnosis.machine.own_plant.Plant` for a
simulation somebody brings: a Python function, an FMU, a MuJoCo model, the force that a measured motion takes
(`diagnosis.machine.simulation.Simulation`). Fits, evidence and `diagnose` know no other machine.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Generic, Literal, Protocol, TypeVar, get_args

import numpy as np
import numpy.typing as npt

from plant.effects import EFFECTS
from plant.effects.search_space import Candidate

Real = npt.NDArray[np.float64]
Role = Literal["estimation", "held_out"]
Record = TypeVar("Record", bound="RecordOfMachine")

# Records of a role that a case names when it is printed: one line of a terminal.
_NAMED = 6
# Samples of a record at least: fewer tell no more than a handful of parameters.
FEWEST_SAMPLES = 20
# Records of a case at most. A search simulates every record some thousand times: more records than this take
# hours, however short.
MOST_RECORDS = 500


@dataclass(frozen=True)
class Weighing:
    """How residuals of a machine are weighed.

    listed : tuple of str. Effects that are looked for; prior probabilities are shared among them.
    model_error : float. Share of the motion (RMS of an output about its mean) that a good model may miss;
        zero where the simulation is as good as the sensors.
    most_effects : int. Beside a model error, effects that are looked for together.
    stated : bool. Somebody has said that the model error does not interest; else it is what is usual, and
        what no effect explains is an unknown cause however small.
    """

    listed: tuple[str, ...] = field(default_factory=lambda: tuple(EFFECTS))
    model_error: float = 0.0
    most_effects: int = 3
    stated: bool = True


@dataclass(frozen=True, eq=False)
class UnknownStart:
    """What nobody knows about the start of a record and the zeros of its sensors.

    state_spread : (S,) prior standard deviations of the states at the start; infinite: free.
    zero_spread : (Z,) prior standard deviations of zeros of sensors, which all records share.
    zero_outputs : (Z, Y) outputs per zero.
    state_per_zero : (S, Z) what a zero moves of a start that was read off the measurement.
    guess : record -> (S,) start as its first samples say.
    responses : effects, samples -> S arrays (T, Y): outputs per unit of a state, of the linear part; None
        where nobody knows that, and spreads are finite.
    zero_seen : bool. Another output tells the zero; else it matters only to what depends on the true angle.
    tried : (., S) moves of a start that are tried beside contacts that switch.
    """

    state_spread: Real
    zero_spread: Real
    zero_outputs: Real
    state_per_zero: Real
    guess: Callable[[Any], Real]
    responses: Callable[[Sequence[Any], int], list[Real]] | None
    zero_seen: bool = True
    tried: Real = field(default_factory=lambda: np.zeros((0, 0)))


KNOWN_START = UnknownStart(
    np.zeros(0),
    np.zeros(0),
    np.zeros((0, 0)),
    np.zeros((0, 0)),
    lambda record: np.zeros(0),
    lambda effects, samples: [],
)


class SimulatedMachine(Protocol):
    """A machine that can be simulated, as its makers know it; stated parameters may be off."""

    @property
    def tolerances(self) -> Mapping[str, float]:
        """Parameter -> relative standard deviation of its stated value."""

    def scaled(self, factors: Mapping[str, float]) -> SimulatedMachine:
        """The machine with its parameters multiplied by these factors (parameter -> factor)."""

    @property
    def output_names(self) -> Sequence[str]:
        """(Y,) names of the outputs."""

    @property
    def input_names(self) -> Sequence[str]:
        """Empty where nobody has named them."""

    @property
    def noise(self) -> Real:
        """(Y,) noise standard deviations in the outputs' units."""

    @property
    def weighing(self) -> Weighing:
        """How its residuals are weighed."""

    @property
    def description(self) -> Any:
        """What a user gets back as the repaired machine."""

    @property
    def unknown_start(self) -> UnknownStart:
        """What nobody knows about the start of its records."""

    def simulator(self, effects: Sequence[Any]) -> Callable[..., Real]:
        """Inputs (T, U) -> outputs (T, Y) without noise; effects as its own candidates make them.

        Further arguments, where a start is unknown: states (S,), zeros (Z,); first_row of a part of a run.
        """

    def torque_response(self, samples: int) -> tuple[Real, float] | None:
        """(T, Y) outputs after a torque of one on the hub over the first sample, and the sampling period [s];
        None for a machine without a hub."""

    def force_places(self, inputs: int) -> Sequence[Any]:
        """(F,) places (`diagnosis.machine.force_places.ForcePlace`) at which a missing force may act, of a
        machine with so many input columns; empty where the output is the force itself."""

    def other_coordinates(self, outputs: Real) -> Mapping[str, Real]:
        """Name with its unit -> (T,) coordinates that stand for the other outputs (T, Y) beside a place."""

    def pushed(self, inputs: Real, forces: Real) -> Real:
        """(T, Y) outputs without noise under inputs (T, U) and forces (T, F) at the force places."""

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        """Effects that may be missing, as search spaces with ranges that fit the records."""


class RecordOfMachine(Protocol):
    """One experiment."""

    @property
    def name(self) -> str:
        """Name of the record; no other of its case has it."""

    @property
    def role(self) -> Role:
        """Held-out records fit no parameter."""

    @property
    def input(self) -> Real:
        """(T, U) held from each row to the next."""

    @property
    def output(self) -> Real:
        """(T, Y) as measured."""


class RecordedCase(ABC, Generic[Record]):
    """A machine and its records, in the order given.

    Raises ValueError if a role has no experiment or a name comes twice.
    """

    name: str
    experiments: tuple[Record, ...]

    def __post_init__(self) -> None:
        object.__setattr__(self, "experiments", tuple(self.experiments))
        check_count(len(self.experiments), f"case {self.name}")
        names = [experiment.name for experiment in self.experiments]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"case {self.name}: experiment {name} is given twice")
        for role in get_args(Role):
            if role not in [experiment.role for experiment in self.experiments]:
                raise ValueError(f"case {self.name}: no experiment has the role {role}")

    def __repr__(self) -> str:
        """A line on the machine and one for each role, with the first records by name."""
        lines = [
            f"{type(self).__name__} '{self.name}': {len(self.experiments)} records of "
            f"{', '.join(self.machine.output_names)}, {len(self.machine.weighing.listed)} candidate effects"
        ]
        for role, records in {"estimation": self.estimation, "validation": self.held_out}.items():
            names = [f"{e.name} ({len(e.output)} samples)" for e in records[:_NAMED]]
            if len(records) > _NAMED:
                names.append(f"{len(records) - _NAMED} more")
            lines.append(f"  {role}: {', '.join(names)}")
        return "\n".join(lines)

    @property
    @abstractmethod
    def machine(self) -> SimulatedMachine:
        """The machine in the form that fits and evidence ask for."""

    @property
    @abstractmethod
    def steps(self) -> Real:
        """(Y,) steps of outputs whose values lie on a quantisation grid, 0 for all others."""

    @property
    def noise(self) -> Real:
        """(Y,) noise standard deviations of the outputs."""
        return self.machine.noise

    @property
    def units(self) -> Mapping[str, str]:
        """Output -> unit, of outputs whose names do not end with it."""
        return {}

    @property
    def estimation(self) -> tuple[Record, ...]:
        """Records that parameters are fitted to."""
        return tuple(e for e in self.experiments if e.role == "estimation")

    @property
    def held_out(self) -> tuple[Record, ...]:
        """Records that fit no parameter, for validation."""
        return tuple(e for e in self.experiments if e.role == "held_out")


CaseOfMachine = RecordedCase[Any]


def check_count(records: int, where: str) -> None:
    """Raises ValueError, one line that begins with `where`: more records than a search can simulate."""
    if records > MOST_RECORDS:
        raise ValueError(
            f"{where}: {records} records, at most {MOST_RECORDS}; give the longest, or those that differ most"
        )


def check_record(record: RecordOfMachine, output_names: Sequence[str] = ()) -> None:
    """Refuses a record that cannot be used; the role "validation" becomes "held_out".

    Parameters
    ----------
    record : RecordOfMachine
    output_names : (Y,) sequence of str
        Of outputs that must move; without any, only shapes are checked.

    Raises
    ------
    ValueError
        One line: shapes that do not fit, a role that is none, a value that is not finite, too few samples, or
        an output with a name that never moves.
    """
    u = record.input
    y = record.output
    where = f"experiment {record.name}"
    has_shapes = u.ndim == 2 and y.ndim == 2 and len(u) == len(y)
    if not has_shapes or (output_names and y.shape[1] != len(output_names)):
        n_outputs = len(output_names) or "Y"
        raise ValueError(
            f"{where}: needs input (T, U) and output (T, {n_outputs}); got {u.shape} and {y.shape}"
        )
    if str(record.role) == "validation":
        object.__setattr__(record, "role", "held_out")
    if record.role not in ("estimation", "held_out"):
        raise ValueError(f"{where}: role must be estimation or validation; got {record.role!r}")
    if not (np.all(np.isfinite(u)) and np.all(np.isfinite(y))):
        raise ValueError(f"{where}: a value is not finite")
    if len(u) < FEWEST_SAMPLES:
        raise ValueError(f"{where}: {len(u)} samples, needs at least {FEWEST_SAMPLES}")
    for column, output in zip(y.T, output_names, strict=False):
        if np.ptp(column) == 0:
            raise ValueError(f"{where}: {output} is {column[0]:.6g} throughout: is the sensor dead?")
