"""One's own plant: a simulation with named parameters, a list of what may be missing, and records.

    def simulate(parameters, effects, inputs):  # {"mass_kg": 2.0}, {"dry_friction": {"force_N": 0.3}}, (T, U)
        return outputs  # (T, Y)

    plant = Plant(simulate, {"mass_kg": 2.0}, {"mass_kg": 0.1}, ("position_m",), np.array([1e-4]),
                  (PlantEffect("dry_friction", (EffectParameter("force_N", 1e-3, 10.0),)),))
    found = diagnose(PlantCase("mine", plant, experiments))

A constant bias or offset is a candidate like any other: list one for every input and output that may have it,
or effects that merely resemble it win.
"""

from __future__ import annotations

import traceback
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from types import MappingProxyType

import numpy as np

from diagnosis.machine.around import Identity, MeasuredBody, Started, around
from diagnosis.machine.force_places import ForcedSimulation, ForcePlace
from diagnosis.machine.machine_protocol import (
    KNOWN_START,
    Real,
    RecordedCase,
    RecordOfMachine,
    Role,
    UnknownStart,
    Weighing,
    check_record,
)
from diagnosis.machine.plant_effect import Change, PlantEffect, wrong_values
from ident.data.arrays import lock
from ident.data.units import written_unit
from plant.effects.search_space import Candidate

# Parameters, effects, inputs (T, U) and, where a start is unknown, its states -> outputs (T, Y). What says
# its names as well is a `diagnosis.machine.simulation.Simulation`.
Simulate = Callable[..., Real]

# Effects that are looked for together, as long as something of interest is left. Chosen: a machine of which
# nothing else is known may lack more than one at each of its parts.
_MOST_EFFECTS = 5
# Share of its motion that a good model of a real machine may miss, where nobody has stated it. Chosen:
# doubled, effects that carry a tenth of the motion are no longer named.
_USUAL_MODEL_ERROR = 0.05
# Largest relative tolerance of a value: beyond it, nothing is stated.
_LARGEST_TOLERANCE = 10
# Advice beside an error of a trial's values; with those stated it is an error of the program.
OF_TRIAL = "; of values it cannot take, return nan"
# In noise deviations: beyond any record, and its square is still a number.
RUNAWAY = 1e12
# What a simulation may raise where a trial runs away; any other error is one of the simulation.
_NUMERICAL = (ArithmeticError, RuntimeWarning, np.linalg.LinAlgError)


class SimulationError(ValueError):
    """A simulation that ended with an error which is not numerical, or gave outputs of another shape.

    reason : what happened, to follow "the simulation". parameters, changes : with which it was run.
    """

    def __init__(
        self, message: str, reason: str, parameters: Mapping[str, float], changes: Sequence[Change]
    ) -> None:
        super().__init__(message)
        self.reason = reason
        self.parameters = parameters
        self.changes = tuple(changes)


def place_of(error: BaseException, file: str = "") -> str:
    """The last line of a user's file on the way to an error, as " (FILE, line N)"; "" where there is none.

    file : that file, spelt as Python was given it; by default the one that is called first, beside those of
    this package.
    """
    # The first frame is whoever caught the error.
    frames = traceback.extract_tb(error.__traceback__)[1:]
    package = str(Path(__file__).parent)
    called = [frame for frame in frames if str(Path(frame.filename).parent) != package]
    if not called:
        return ""
    of_file = [frame for frame in called if frame.filename == (file or called[0].filename)]
    if not of_file:
        return ""
    return f" ({Path(of_file[-1].filename).name}, line {of_file[-1].lineno})"


def is_number(value: object) -> bool:
    """Whether a value is a finite number, of Python or NumPy."""
    return isinstance(value, (int, float, np.integer, np.floating)) and bool(np.isfinite(value))


@dataclass(frozen=True, eq=False)
class Plant:
    """A simulation of one's own with what is known about its parameters and outputs.

    simulation : (parameters, effects, inputs (T, U)) -> outputs (T, Y)
        `parameters` has every stated parameter, `effects` name -> parameter -> value of those to include.
        It must be a function of its arguments alone. Further columns may follow the outputs, for effects
        around it (`with_effects`).
    parameters : name -> stated value
    tolerances : name -> relative standard deviation of the nominal parameter
        Parameters without one are exact; those with one are listed as "wrong_NAME", a ratio, from three
        tolerances on. A value fitted to these same records is no knowledge beside them: give it a tolerance
        of 1 or more, and it moves freely.
    output_names : (Y,)
    noise : (Y,). Noise standard deviations, from repeats of an experiment where there are any.
    effects : tuple of PlantEffect
    model_error : float or None. Share of the motion (RMS of an output about its mean) that the simulation may
        miss even with the right effects: no simulation of a real machine reaches its noise, and with zero
        here what is left over makes the answer "unknown". None: zero where the simulation with the right
        effects does reach the noise, else 0.05; a smaller gap that no effect explains is then "unknown".
    dt_s : float. Sampling period, for pages; `with_effects` states it.
    inactive : effect -> what it needs to be tried, as `with_effects` states it; not tried is not ruled out.
    start : name -> standard deviation (around zero) of a state at the start of a record that nobody knows
        Beside a model error it is fitted for every record; the simulation takes the states (name -> value) as
        a fourth argument.
    settled : inputs, outputs -> outputs as they would be from the start that fits the record best, which is
        in these inputs, where a simulation knows that itself; every fit and every residual is of these.
    untracked : the simulation without what holds it near a record, which is in these inputs; None: nothing
        does.
    units : output -> unit, of outputs whose names do not end with it.
    forced : the simulation with forces at places of its own, for where the error lies; None: a force is what
        is added to an input.
    input_names : of the inputs, for pages; inputs behind these only hold a simulation near its record.
    """

    simulation: Simulate
    parameters: Mapping[str, float]
    tolerances: Mapping[str, float]
    output_names: tuple[str, ...]
    noise: Real
    effects: tuple[PlantEffect, ...] = ()
    model_error: float | None = None
    dt_s: float = float("nan")
    start: Mapping[str, float] = field(default_factory=dict)
    inactive: Mapping[str, str] = field(default_factory=dict)
    settled: Callable[[Real, Real], Real] | None = None
    untracked: Simulate | None = None
    units: Mapping[str, str] = field(default_factory=dict)
    input_names: tuple[str, ...] = ()
    forced: ForcedSimulation | None = None

    def __post_init__(self) -> None:
        lock(self, "noise")
        object.__setattr__(self, "effects", tuple(self.effects))
        object.__setattr__(self, "output_names", tuple(self.output_names))
        for key in ("parameters", "tolerances", "start", "inactive", "units"):
            object.__setattr__(self, key, MappingProxyType(dict(getattr(self, key))))
        for name, spread in self.start.items():
            if not 0 < spread < np.inf:
                raise ValueError(f"plant: spread of {name} at the start must be positive; got {spread}")
        count = len(self.output_names)
        if self.noise.shape != (count,) or not np.all(self.noise > 0):
            raise ValueError(
                f"plant: needs one noise level above zero per output ({count}); got {self.noise}"
            )
        if self.model_error is not None and not self.model_error >= 0:
            raise ValueError(f"plant: model_error must not be negative; got {self.model_error}")
        for key, value in self.parameters.items():
            if not is_number(value):
                raise ValueError(f"plant: parameter {key} must be a finite number; got {value!r}")
        for key, tolerance in self.tolerances.items():
            if key not in self.parameters:
                raise ValueError(f"plant: tolerance of {key}, which is no parameter of it")
            if not is_number(tolerance) or not 0 < tolerance <= _LARGEST_TOLERANCE:
                raise ValueError(
                    f"plant: tolerance of {key} must be between 0 and 10 (a share of the value); "
                    f"got {tolerance!r}"
                )
        for effect in self.effects:
            if not isinstance(effect, PlantEffect):
                raise ValueError(f"plant: effects must be PlantEffect; got {effect!r}")
        names = [effect.name for effect in self.effects]
        for name in names:
            if names.count(name) > 1:
                raise ValueError(f"plant: effect {name} is listed twice")

    @property
    def missing(self) -> tuple[PlantEffect, ...]:
        """Everything that may be named."""
        return (*self.effects, *wrong_values(self.tolerances))

    @cached_property
    def value_candidates(self) -> dict[str, str]:
        """Name among the candidates -> parameter, for every stated value with a tolerance.

        It is the parameter's own name, or "wrong_NAME", by which a diagnosis names it, where an effect is
        called so.
        """
        effects = {effect.name for effect in self.effects}
        return {f"wrong_{name}" if name in effects else name: name for name in self.tolerances}

    @cached_property
    def weighing(self) -> Weighing:
        """How its residuals are weighed, beside the usual model error where none is stated."""
        is_stated = self.model_error is not None
        model_error = _USUAL_MODEL_ERROR if self.model_error is None else float(self.model_error)
        listed = tuple(kind.id for kind in self.missing)
        return Weighing(listed, model_error, _MOST_EFFECTS, is_stated)

    @property
    def description(self) -> Plant:
        """The plant itself: with the values and effects of a repair it is the repaired machine."""
        return self

    @property
    def body(self) -> MeasuredBody | None:
        """Whose motion is among the inputs."""
        places = (effect.place for effect in self.effects)
        return next((place for place in places if isinstance(place, MeasuredBody)), None)

    def value(self, key: str) -> float:
        """Stated value of a parameter."""
        return self.parameters[key]

    def scaled(self, factors: Mapping[str, float]) -> Plant:
        """The plant with its parameters multiplied by these factors (name -> factor)."""
        moved = {key: value * factors.get(key, 1.0) for key, value in self.parameters.items()}
        return replace(self, parameters=moved)

    @property
    def unknown_start(self) -> UnknownStart:
        """Unknown starts of the states that are named as such, where there is a model error; else none."""
        spread = np.array([*self.start.values()] if self.weighing.model_error > 0 else [])
        return replace(
            KNOWN_START,
            state_spread=spread,
            zero_outputs=np.zeros((0, self.noise.size)),
            state_per_zero=np.zeros((spread.size, 0)),
            guess=lambda record: np.zeros(spread.size),
            responses=None if spread.size else KNOWN_START.responses,
        )

    def torque_response(self, samples: int) -> None:
        """None: nobody says where a torque would act."""

    def force_places(self, inputs: int) -> tuple[ForcePlace, ...]:
        """(F,) places of the simulation's own; else every one of its input columns; none where the motion is
        an input and the force an output."""
        if self.forced is not None:
            return self.forced.places
        if self.body is not None:
            return ()
        names = self.input_names or tuple(f"input {k + 1}" for k in range(inputs))
        return tuple(ForcePlace(name, self.unit(name), command=k) for k, name in enumerate(names))

    def pushed(self, inputs: Real, forces: Real) -> Real:
        """(T, Y) outputs of the simulation as stated under inputs (T, U) and forces (T, F) at the places.

        Not a number throughout where the simulation ends with an error: forces lead where nobody has been.
        """
        try:
            with np.errstate(all="ignore"):  # forces may drive it away
                if self.forced is not None:
                    return self.forced.simulate(self.parameters, inputs, forces)
                pushed = np.array(inputs, dtype=np.float64)
                pushed[:, : forces.shape[1]] += forces
                return self.simulated(())(pushed)
        except (*_NUMERICAL, SimulationError):
            return np.full((len(inputs), self.noise.size), np.nan)

    def other_coordinates(self, outputs: Real) -> dict[str, Real]:
        """Nothing: the positions of a simulation of one's own are its outputs (T, Y)."""
        return {}

    def unit(self, name: str) -> str:
        """Unit of an output or input as stated, else as its name ends with it; "" where neither says it."""
        return self.units.get(name, "") or written_unit(name)

    def simulator(self, effects: Sequence[Change]) -> Callable[..., Real]:
        """Inputs (T, U) -> outputs (T, Y); where a trial of a fit runs away, a large finite number.

        Further arguments: states (S,) and zeros (Z,) at the start, and `first_row` of the log that the record
        is a part of. Neglected: a simulation is not told it, so that what drifts begins anew with every part.
        """
        runaway = RUNAWAY * self.noise
        at_rest = self.simulated(effects)

        def outputs(
            inputs: Real, states: Real | None = None, zeros: Real | None = None, first_row: int = 0
        ) -> Real:
            run = self.simulated(effects, states) if self.start and states is not None else at_rest
            try:
                with np.errstate(all="ignore"):  # of a trial that runs away
                    simulated = run(inputs)
                    if self.settled is not None and np.all(np.isfinite(simulated)):
                        simulated = self.settled(inputs, simulated)
            except _NUMERICAL:
                simulated = np.full((len(inputs), runaway.size), np.nan)
            return np.clip(np.where(np.isnan(simulated), runaway, simulated), -runaway, runaway)

        return outputs

    def replayed(self, effects: Sequence[Change]) -> Callable[..., Real]:
        """Inputs (T, U) -> outputs (T, Y), from the recorded start on under the commands alone: nothing holds
        the simulation near its record, and no start is fitted."""
        return replace(self, simulation=self.untracked or self.simulation, settled=None).simulator(effects)

    def simulated(self, effects: Sequence[Change], states: Real | None = None) -> Callable[[Real], Real]:
        """Inputs (T, U) -> outputs (T, Y) as the simulation gives them, listed effects around it.

        Parameters
        ----------
        effects : sequence of Change
            Those that act: of the simulation itself, around it, and values that are wrong.
        states : (S,) or None
            States at the start that are named in `start`; None: zeros.

        Raises
        ------
        SimulationError
            One line: a shape that does not fit, an error of the simulation that is not numerical (those it
            raises as they are).
        """
        # A wrong value is another parameter.
        multiplied = {kind.id: str(kind.multiplies) for kind in wrong_values(self.tolerances)}
        ratios = {multiplied[e.id]: e.values["ratio"] for e in effects if e.id in multiplied}
        if ratios:
            further = [e for e in effects if e.id not in multiplied]
            return self.scaled(ratios).simulated(further, states)

        # What acts around the simulation, and what it is told.
        inside = {effect.id: effect.values for effect in effects}
        acting = []
        for kind in self.effects:
            if kind.place is not None and kind.name in inside:
                acting.append((kind.law, kind.place, inside.pop(kind.name)))
        key = (
            Identity(self.simulation),
            tuple(self.parameters.items()),
            tuple((name, tuple(values.items())) for name, values in inside.items()),
        )
        at_rest = (0.0,) * len(self.start)
        start = at_rest if states is None else tuple(float(value) for value in states)

        def run_from(start: tuple[float, ...], inputs: Real) -> Real:
            begins = (dict(zip(self.start, start, strict=True)),) if self.start else ()
            try:
                outputs = self.simulation(self.parameters, inside, inputs, *begins)
                if np.iscomplexobj(outputs):
                    raise ValueError("complex outputs")
                outputs = np.asarray(outputs, dtype=np.float64)
            except _NUMERICAL:
                raise
            except (Exception, SystemExit) as error:
                reason = " ".join(f"ended with {type(error).__name__}: {error}".split()) + place_of(error)
                message = f"{self._at(effects)} the simulation {reason}{OF_TRIAL}"
                raise SimulationError(message, reason, self.parameters, effects) from error
            return self._checked(outputs, len(inputs), effects)

        started = Started(partial(run_from, start), partial(run_from, at_rest), key, start)
        wrapped = around(started, acting)
        return lambda inputs: wrapped(inputs)[:, : self.noise.size]

    def _checked(self, outputs: Real, samples: int, effects: Sequence[Change]) -> Real:
        """Outputs (T, Y or more), of one output (T,) too. Raises SimulationError for another shape."""
        expected = (samples, self.noise.size)
        if outputs.shape == (samples,) and self.noise.size == 1:
            return outputs[:, None]
        if outputs.ndim != 2 or len(outputs) != samples or outputs.shape[1] < self.noise.size:
            turned = "; transpose it" if outputs.shape == expected[::-1] else ""
            reason = f"must give outputs {expected}; got {outputs.shape}{turned}"
            message = f"{self._at(effects)} the simulation {reason}"
            raise SimulationError(message, reason, self.parameters, effects)
        return outputs

    def _at(self, effects: Sequence[Change]) -> str:
        """Where an error arose: "plant: with mass 2 and friction {...}"."""
        values = ", ".join(f"{key} {value:.6g}" for key, value in self.parameters.items())
        added = " and ".join(f"{effect.id} {dict(effect.values)}" for effect in effects)
        return f"plant: with {values}" + (f" and {added}" if added else "")

    def candidates(self, experiments: Sequence[RecordOfMachine]) -> tuple[Candidate, ...]:
        """Search spaces of everything that may be named, whatever the records: ranges are stated."""
        return tuple(candidate for kind in self.missing for candidate in kind.candidates())


@dataclass(frozen=True, eq=False)
class PlantExperiment:
    """One record of a plant.

    name : str
    role : "estimation" or "validation" (kept as "held_out")
        Validation records fit no parameter.
    input : (T, U), of a single one (T,) too.
    output : (T, Y) as measured, of a single one (T,) too.
    missing : rows whose outputs say nothing.
    first_row : of the log that the record is a part of.
    beside : name -> (T,) signals of the log that the simulation does not use, as a load.

    Raises ValueError, one line: shapes that do not fit, a value that is not finite, too few samples.
    """

    name: str
    role: Role
    input: Real
    output: Real
    missing: tuple[int, ...] = ()
    first_row: int = 0
    beside: Mapping[str, Real] = field(default_factory=dict)

    def __post_init__(self) -> None:
        lock(self, "input", "output")
        for name, signal in self.beside.items():
            if np.shape(signal) != (len(self.output),) or not np.all(np.isfinite(signal)):
                raise ValueError(
                    f"experiment {self.name}: {name} beside the outputs must be finite and "
                    f"({len(self.output)},); got {np.shape(signal)}"
                )
        for key, signal in (("input", self.input), ("output", self.output)):
            object.__setattr__(self, key, signal[:, None] if signal.ndim == 1 else signal)
        check_record(self)


@dataclass(frozen=True, eq=False, repr=False)
class PlantCase(RecordedCase[PlantExperiment]):
    """A plant as its makers know it, and what it did.

    Raises ValueError if a role has no experiment, a name comes twice, an output is constant (a dead sensor),
    the plant lists no effect, or the simulation does not give the same finite outputs twice.
    """

    name: str
    plant: Plant
    experiments: tuple[PlantExperiment, ...]

    def __post_init__(self) -> None:
        super().__post_init__()
        for e in self.experiments:
            check_record(e, self.plant.output_names)
            still = self.plant.body.resting(e.input) if self.plant.body else np.zeros(1)
            # Of a record that rests throughout all is kept.
            if not np.all(still):
                object.__setattr__(e, "missing", tuple(np.flatnonzero(still)))
        if not self.plant.effects:
            raise ValueError("plant: lists no effect that may be missing")
        run = self.plant.simulated(())
        for e in self.experiments:
            where = f"case {self.name}, experiment {e.name}"
            try:
                first = run(e.input)
                second = run(e.input)
            except ValueError as error:
                raise ValueError(f"{where}: {str(error).removesuffix(OF_TRIAL)}") from error
            except _NUMERICAL as error:
                raise ValueError(f"{where}: the simulation as stated ended with {error!r}") from error
            if not np.all(np.isfinite(first)):
                raise ValueError(f"{where}: the simulation as stated does not give finite outputs")
            if not np.array_equal(first, second):
                differ = float(np.max(np.abs(first - second)))
                raise ValueError(
                    f"{where}: two simulations as stated differ by up to {differ:.3g}; is something random?"
                )

    def without_failing(self, error: SimulationError) -> tuple[PlantCase, str]:
        """The case without the candidate that a simulation failed with, and a sentence that says so.

        Of several effects it is the first that fails alone, else the last; without effects the stated value
        that was moved by most of its tolerances. Raises the error where nothing was changed or nothing is
        left.
        """
        plant = self.plant
        if error.changes:
            failing = next((change for change in error.changes if self._fails(change)), error.changes[-1]).id
        else:
            failing = f"wrong_{self._most_moved(error)}"

        # A value that is not judged stays as it is stated.
        multiplied = {kind.id: str(kind.multiplies) for kind in wrong_values(plant.tolerances)}
        value = multiplied.get(failing, failing.removeprefix("wrong_"))
        effects = tuple(effect for effect in plant.effects if effect.name != failing)
        tolerances = dict(plant.tolerances)
        if len(effects) == len(plant.effects):
            tolerances.pop(value, None)
        if not effects:
            raise error
        needs = "a simulation that runs with it"
        reduced = replace(
            plant, effects=effects, tolerances=tolerances, inactive={**plant.inactive, failing: needs}
        )
        sentence = f"{failing} is left out, the simulation fails with it: it {error.reason}"
        return replace(self, plant=reduced), sentence

    def _most_moved(self, error: SimulationError) -> str:
        """The stated value that was moved by most of its tolerances; raises the error where none was."""
        plant = self.plant
        tolerances_off = {}
        for key, tolerance in plant.tolerances.items():
            if error.parameters[key] != plant.parameters[key]:
                ratio = max(error.parameters[key] / plant.parameters[key], np.finfo(float).tiny)
                tolerances_off[key] = abs(np.log(ratio)) / tolerance
        if not tolerances_off:
            raise error
        return max(tolerances_off, key=lambda key: tolerances_off[key])

    def _fails(self, change: Change) -> bool:
        """Whether the simulation as stated fails in some record with this effect alone."""
        run = self.plant.simulator([change])
        for e in self.estimation:
            try:
                run(e.input)
            except SimulationError:
                return True
        return False

    @property
    def machine(self) -> Plant:
        """The plant, which answers what fits and evidence ask (`SimulatedMachine`)."""
        return self.plant

    @property
    def outputs(self) -> tuple[str, ...]:
        """(Y,) names of the outputs."""
        return self.plant.output_names

    @property
    def units(self) -> Mapping[str, str]:
        """Output -> unit, of outputs whose names do not end with it."""
        return self.plant.units

    def with_noise(self, noise: Real) -> PlantCase:
        """The case with other noise standard deviations of the outputs (Y,)."""
        return replace(self, plant=replace(self.plant, noise=noise))

    @property
    def model_error(self) -> float:
        """Share of the motion that the simulation may miss, stated or usual."""
        return self.plant.weighing.model_error

    @property
    def dt_s(self) -> float:
        """Sampling period, s; nan where nobody stated it."""
        return self.plant.dt_s

    @property
    def steps(self) -> Real:
        """(Y,) zeros: quantisation is an effect of one's own plant like any other."""
        return np.zeros(len(self.plant.output_names))
