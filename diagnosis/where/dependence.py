"""On which variable the error depends: a missing force, or an error of a reading, as a curve of one variable.

Every place of a machine at which a force may act, and every output, is tried with every variable that the
logs hold: position, speed, acceleration, command, time, positions of the other joints, signals beside. A
curve is a cubic spline whose second differences are penalised (Eilers and Marx 1996), for a speed with a jump
at zero. It is drawn on some logs and judged on the others, in turn; of one log, on blocks. What a force that
is constant explains is no dependence.

Rigs, MuJoCo models, FMUs, Python simulations and torques of a measured motion by this one function.

Neglected: curves of two variables; standard errors of a curve hold what scatters about it, taken as white
over the samples that the machine forgets nothing in.

Source: P. Eilers, B. Marx, "Flexible smoothing with B-splines and penalties", Statistical Science 11(2),
1996.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.interpolate import BSpline
from scipy.signal import savgol_filter
from scipy.stats import norm

from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.where.findings import Alternative, Dependence, Quantity, Shape
from diagnosis.where.missing_force import ForcedRecord, MissingForces, missing_forces
from ident.data.units import written_unit

Integer = npt.NDArray[np.int64]

# Inner intervals of a spline: a ripple of three periods over the range is followed; of the time also what
# swells ten times in a log. Chosen; with twice as many the penalty takes over and shares of the series move
# by less than 0.01.
_INTERVALS, _INTERVALS_OF_TIME = 10, 40
# Cubic: two derivatives of a force are continuous, as of what bends.
_DEGREE = 3
# Strengths of the penalty that are tried, over the mean energy of a basis function.
_PENALTIES = (1e-10, 1e-8, 1e-6, 1e-4, 1e-2, 1.0)
# Folds of logs, or of blocks of one log, each of which is judged by curves drawn on the others. Chosen: eight
# of ten parts of the data draw as good a curve as all of them.
_FOLDS = 5
# Blocks of all logs whose scatter tells whether a share is more than chance. Chosen: a deviation of so many
# is known to a sixth.
_BLOCKS = 24
# A dependence that explains less of the error, or of what a constant force leaves of it, is not told. Chosen:
# with half of it second causes are told that are errors of stated values.
_LEAST_SHARE = 0.1
# A place whose missing force moves the outputs less than this part of what the first does is not tried.
# Chosen: its energy is a hundredth.
_LEAST_PLACE = 0.1
# Standard errors, by the scatter of blocks, by which it has to explain more than a constant force. What is no
# cause makes predictions of other logs worse, not better by chance: two are enough. Chosen.
_BEYOND = 2.0
# Dependences that are told, and alternatives to each. Chosen; what a third explains is below a tenth as a
# rule.
_MOST = 2
# A straight line or a jump that explains this part of what the curve does is what the curve is.
_SAME = 0.9
# Samples of the parabola that smooths a motion before its rate is taken, at least five. Chosen: dry friction
# turns round in less than that many rows.
_SMOOTHED = 7
# Part of the largest speed below which its sign is not told from rest. Chosen: a tenth of what moves slowly.
_STILL = 0.01
# Ends of a curve: shares of the samples that lie below and above are not drawn.
_ENDS = 0.01
# Points at which a curve is told.
_POINTS = 25

# Units of positions and of speeds; an output without a unit is taken for a position.
_POSITIONS, _SPEEDS = ("rad", "m", "deg", "mm", ""), ("rad/s", "m/s", "deg/s")


@dataclass(frozen=True, eq=False)
class _Variable:
    """A variable with its values (T,) in every record, in their order; inner intervals of its curve."""

    quantity: Quantity
    of: str
    unit: str
    values: tuple[Real, ...]
    intervals: int = _INTERVALS

    @property
    def jumps(self) -> bool:
        """Whether a force may jump where it changes sign, as dry friction does."""
        return self.quantity == "speed"


@dataclass(frozen=True, eq=False)
class _Acts:
    """What depends on a variable: a force at a place of the machine, or the error of an output's reading.

    own : the motion of the place itself. others : all else that is tried.
    """

    acts: Literal["force", "reading"]
    through: Literal["machine", "output"]
    at: int
    name: str
    unit: str
    own: tuple[_Variable, ...]
    others: tuple[_Variable, ...]

    @property
    def variables(self) -> tuple[_Variable, ...]:
        return (*self.own, *self.others)

    @property
    def where(self) -> tuple[str, int]:
        """What the response to it depends on."""
        return self.through, self.at


_Pair = tuple[_Acts, _Variable]


@dataclass(frozen=True, eq=False)
class _Basis:
    """Functions (T, K) of every record, their values at points, and (K, K) what makes them rough."""

    functions: tuple[Real, ...]
    rough: Real
    at: Callable[[Real], Real]


@dataclass(frozen=True, eq=False)
class _Fold:
    """Sums of one part of the data: gram (K, K) of the columns, moment (K,) with the residuals."""

    gram: Real
    moment: Real


@dataclass(frozen=True, eq=False)
class _Judged:
    """A regression judged on data that it was not fitted to.

    coefficients (K,) on all data, covariance (K, K). left : (N,) of every row of all records, squared and
    summed over the outputs, by regressions on the other folds.
    """

    coefficients: Real
    covariance: Real
    left: Real


def dependences(
    case: CaseOfMachine, residuals: Mapping[str, Real], dt_s: float, level: float
) -> tuple[Dependence, ...]:
    """What the error depends on: the best two variables, the second by what the first leaves.

    Parameters
    ----------
    case : RecordedCase
    residuals : record -> (T, Y) array
        (measured - model) / noise of every record.
    dt_s : float
        Sampling period.
    level : float
        Chance that any dependence is found in logs that hold only noise.

    Returns
    -------
    tuple of Dependence
        At most two, the larger share first; empty where nothing explains a tenth of the error beyond chance.
    """
    forced = missing_forces(case, residuals)
    return _best_two(case, forced, _acting(case, forced, dt_s), level)


def _best_two(
    case: CaseOfMachine, forced: MissingForces, acting: Sequence[_Acts], level: float
) -> tuple[Dependence, ...]:
    """The best dependence, and the best of what it leaves; `level` is shared by everything that is tried."""
    regressions = _Regressions(case, forced)
    pairs = [(acts, variable) for acts in acting for variable in acts.variables]
    deviations = float(norm.isf(level / max(len(pairs), 1)))
    found: list[Dependence] = []
    taken: list[_Pair] = []
    while len(found) < _MOST:
        tried = regressions.beyond_chance([pair for pair in pairs if pair not in taken], taken, deviations)
        if not tried:
            break
        best = _preferred(tried)
        found.append(regressions.told(best, taken, tried))
        taken.append(best.pair)
    return tuple(found)


@dataclass(frozen=True, eq=False)
class _Tried:
    """A dependence that explains more than chance.

    total, constant_total : energies that it, and a constant force at its place, take off the error.
    gained : (B,) the same of the dependence by block, every record over its own energy.
    """

    pair: _Pair
    total: float
    constant_total: float
    gained: Real
    curve: _Judged
    constant: _Judged


def _preferred(tried: Sequence[_Tried]) -> _Tried:
    """The one that explains most.

    An error of a reading has to explain more than a force does, beyond two standard errors: a machine that
    follows stiffly shows the one as the other, and forces are what machines have.
    """
    most = max(tried, key=lambda one: one.total)
    forces = [one for one in tried if one.pair[0].acts == "force" and not _more(most, one)]
    if most.pair[0].acts == "reading" and forces:
        return max(forces, key=lambda one: one.total)
    return most


def _more(one: _Tried, other: _Tried) -> bool:
    """Whether one explains more than another beyond two standard errors of the difference by block."""
    return float(np.sum(one.gained - other.gained)) > 2 * _deviation(one.gained - other.gained)


def _deviation(gained: Real) -> float:
    """Standard deviation of the sum of energies by block (B,), blocks taken as independent."""
    return float(np.sqrt(gained.size) * np.std(gained, ddof=1))


class _Regressions:
    """Regressions of the residuals of all records on forces and readings that depend on variables."""

    def __init__(self, case: CaseOfMachine, forced: MissingForces) -> None:
        self._forced = forced
        self._folds, self._on_logs = _folds(case, forced.records)
        self._targets = [record.residuals for record in forced.records]
        rows = sum(len(target) for target in self._targets)
        self._blocks = np.arange(rows) * _BLOCKS // rows

        # What is no error of the model: noise, and by how much its energy scatters.
        noise = np.array([record.noise_energies for record in forced.records])
        energy = float(sum(np.sum(target**2) for target in self._targets))
        self._error = energy - float(np.sum(noise))
        self._noise_scatter = _scatter(noise, [len(target) for target in self._targets])
        self._weights = np.concatenate(
            [np.full(len(target), 1 / max(float(np.sum(target**2)), 1e-300)) for target in self._targets]
        )

    def beyond_chance(
        self, pairs: Sequence[_Pair], taken: Sequence[_Pair], deviations: float
    ) -> list[_Tried]:
        """Dependences that explain a tenth of the error, and of what a constant force leaves of it.

        By more than so many standard deviations of the noise's energy, and by more than its scatter by block.
        """
        if not self._error > 0:
            return []
        before = self._judge(taken, None).left
        constants: dict[tuple[str, int], _Judged] = {}
        found = []
        for pair in pairs:
            where = pair[0].where
            if where not in constants:
                constants[where] = self._judge(taken, where)
            constant, curve = constants[where], self._judge([*taken, pair], where)
            without = self._less_by_record(before, constant.left)
            total = float(np.sum(before - curve.left))
            constant_total = float(np.sum(before - without))
            varies = total - constant_total
            least = _LEAST_SHARE * (self._error - max(constant_total, 0.0))
            by_block = self._by_block(without - curve.left)
            if (
                total >= _LEAST_SHARE * self._error
                and varies >= max(least, deviations * self._noise_scatter)
                and np.sum(by_block) > _BEYOND * _deviation(by_block)
            ):
                gained = self._by_block(before - curve.left)
                found.append(_Tried(pair, total, constant_total, gained, curve, constant))
        return found

    def _less_by_record(self, rows: Real, other: Real) -> Real:
        """(N,) of either energies of rows, record by record those that are less."""
        ends = np.cumsum([len(target) for target in self._targets])[:-1]
        pairs = zip(np.split(rows, ends), np.split(other, ends), strict=True)
        return np.concatenate([a if np.sum(a) < np.sum(b) else b for a, b in pairs])

    def _by_block(self, rows: Real) -> Real:
        """(B,) sums of energies (N,) of rows over those of their records: logs that move more weigh no
        more."""
        return np.bincount(self._blocks, rows * self._weights, minlength=_BLOCKS).astype(np.float64)

    def _judge(
        self, pairs: Sequence[_Pair], constant_at: tuple[str, int] | None, shape: Shape = "curve"
    ) -> _Judged:
        """Curves of these pairs together, and a constant at a place; of the last pair a straight line or a
        jump in place of its curve where `shape` says so. The penalty that is best on data not fitted to."""
        bases, acts = list[_Basis](), list[tuple[str, int]]()
        if constant_at is not None:
            bases.append(_constant(self._forced.records))
            acts.append(constant_at)
        if not pairs and constant_at is None:
            rows = np.concatenate([np.sum(target**2, axis=1) for target in self._targets])
            return _Judged(np.zeros(0), np.zeros((0, 0)), rows)
        for k, (place, variable) in enumerate(pairs):
            bases.append(_basis(variable, shape if k == len(pairs) - 1 else "curve"))
            acts.append(place.where)
        columns = []
        for r, record in enumerate(self._forced.records):
            parts = [
                self._responses(place, basis.functions[r], record)
                for place, basis in zip(acts, bases, strict=True)
            ]
            columns.append(np.concatenate(parts, axis=1))
        folds = self._sums(columns)
        penalty = _penalty(bases, [np.diag(fold.gram) for fold in folds])
        least: _Judged | None = None
        for strength in _PENALTIES if any(np.any(basis.rough) for basis in bases) else (0.0,):
            judged = self._cross_validated(columns, folds, strength * penalty)
            if least is None or np.sum(judged.left) < np.sum(least.left):
                least = judged
        assert least is not None
        return least

    def _responses(self, place: tuple[str, int], functions: Real, record: ForcedRecord) -> Real:
        """(T, K, Y) whitened residuals of a record by functions (T, K) at a place."""
        through, at = place
        if through == "machine":
            return self._forced.response_to(at, functions, record)
        return self._forced.response_to_reading(at, functions, record)

    def _sums(self, columns: Sequence[Real]) -> list[_Fold]:
        """Of every fold; columns (T, K, Y) of every record."""
        count, size = max(int(np.max(fold)) for fold in self._folds) + 1, columns[0].shape[1]
        found = [_Fold(np.zeros((size, size)), np.zeros(size)) for _ in range(count)]
        for fold, target, of_record in zip(self._folds, self._targets, columns, strict=True):
            for k in np.unique(fold):
                here = of_record[fold == k]
                flat = np.moveaxis(here, 1, 0).reshape(size, -1)
                found[k].gram[:] += flat @ flat.T
                found[k].moment[:] += flat @ target[fold == k].ravel()
        return found

    def _cross_validated(self, columns: Sequence[Real], folds: Sequence[_Fold], penalty: Real) -> _Judged:
        gram = np.sum([fold.gram for fold in folds], axis=0)
        moment = np.sum([fold.moment for fold in folds], axis=0)
        without = [_solved(gram - fold.gram + penalty, moment - fold.moment) for fold in folds]
        left = []
        for fold, target, of_record in zip(self._folds, self._targets, columns, strict=True):
            values = np.array(without)[fold]
            predicted = np.einsum("tky,tk->ty", of_record, values)
            left.append(np.sum((target - predicted) ** 2, axis=1))
        rows = np.concatenate(left)
        scale = np.sqrt(np.maximum(np.diag(gram + penalty), 1e-300))
        inverse = np.linalg.pinv((gram + penalty) / np.outer(scale, scale), rcond=1e-13, hermitian=True)
        inverse /= np.outer(scale, scale)
        scatter = float(np.sum(rows)) / max(rows.size - len(moment), 1)
        return _Judged(_solved(gram + penalty, moment), scatter * inverse @ gram @ inverse, rows)

    def told(self, best: _Tried, taken: Sequence[_Pair], tried: Sequence[_Tried]) -> Dependence:
        """The finding, with its curve at points, beside what is taken, which comes before it."""
        acts, variable = best.pair
        low, high = np.quantile(np.concatenate(variable.values), (_ENDS, 1 - _ENDS))
        at = np.linspace(low, high, _POINTS)
        drawn = np.concatenate([np.ones((at.size, 1)), _basis(variable, "curve").at(at)], axis=1)
        curve = best.curve
        # Its coefficients are the constant, which comes first, and the last.
        kept = [0, *range(curve.coefficients.size - drawn.shape[1] + 1, curve.coefficients.size)]
        covariance = curve.covariance[np.ix_(kept, kept)]
        errors = np.sqrt(np.maximum(np.sum((drawn @ covariance) * drawn, axis=1), 0.0))
        shape, slope, slope_error = self._shape(best, taken)
        also = [one for one in tried if one is not best and not _more(best, one)]
        also.sort(key=lambda one: -one.total)
        return Dependence(
            place=acts.name,
            acts=acts.acts,
            quantity=variable.quantity,
            of=variable.of,
            unit=variable.unit,
            own=variable in acts.own,
            value_unit=acts.unit,
            centres=tuple(at.tolist()),
            values=tuple((drawn @ curve.coefficients[kept]).tolist()),
            standard_errors=tuple(errors.tolist()),
            share=self._share(best.total),
            constant_share=self._share(best.constant_total),
            judged_on="logs" if self._on_logs else "blocks",
            shape=shape,
            slope=slope,
            slope_error=slope_error,
            beside=len(taken) > 0,
            also=tuple(
                Alternative(acts.name, other.quantity, other.of, other.unit, self._share(one.total))
                for one in also[:_MOST]
                for acts, other in [one.pair]
            ),
        )

    def _share(self, energy: float) -> float:
        """Of the error's energy above noise, 0 to 1."""
        return float(np.clip(energy / self._error, 0.0, 1.0))

    def _shape(self, best: _Tried, taken: Sequence[_Pair]) -> tuple[Shape, float | None, float | None]:
        """What explains nine tenths of what the curve does, with its slope or height and standard error."""
        explains = best.total - best.constant_total
        simple: Sequence[Shape] = ("line", "jump") if best.pair[1].jumps else ("line",)
        parts = {shape: self._judge([*taken, best.pair], best.pair[0].where, shape) for shape in simple}
        gains = {shape: float(np.sum(best.constant.left - one.left)) for shape, one in parts.items()}
        shape = max(gains, key=lambda one: gains[one])
        if gains[shape] < _SAME * explains:
            return "curve", None, None
        judged = parts[shape]
        return shape, float(judged.coefficients[-1]), float(np.sqrt(judged.covariance[-1, -1]))


def _solved(gram: Real, moment: Real) -> Real:
    """Coefficients (K,); those of columns without energy are zero."""
    scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale[scale == 0] = 1.0
    scaled = gram / np.outer(scale, scale)
    return np.asarray(np.linalg.lstsq(scaled, moment / scale, rcond=1e-13)[0] / scale)


def _penalty(bases: Sequence[_Basis], energies: Sequence[Real]) -> Real:
    """(K, K) of all bases, each in proportion to the mean energy (K,) of its columns over all folds."""
    energy = np.sum(energies, axis=0)
    found, first = np.zeros((energy.size, energy.size)), 0
    for basis in bases:
        here = slice(first, first + len(basis.rough))
        size = float(np.trace(basis.rough))
        if size > 0:
            found[here, here] = basis.rough * (float(np.sum(energy[here])) / size)
        first += len(basis.rough)
    return found


def _scatter(energies: Real, rows: Sequence[int]) -> float:
    """Standard deviation of the energy of noise that has these energies (N, Y) in records of so many rows."""
    return float(np.sqrt(2 * np.sum(energies**2 / np.array(rows)[:, None])))


def _are_logs(case: CaseOfMachine) -> bool:
    """Whether the records are several logs, each from its begin."""
    records = case.experiments
    return len(records) > 1 and all(getattr(one, "first_row", 0) == 0 for one in records)


def _folds(case: CaseOfMachine, records: Sequence[ForcedRecord]) -> tuple[list[Integer], bool]:
    """(T,) fold of every row of every record, and whether the folds are logs.

    Parts of one log are blocks: of a variable like the time no part holds what another one does.
    """
    if _are_logs(case):
        count = min(len(records), 2 * _FOLDS)
        return [np.full(len(one.residuals), k % count) for k, one in enumerate(records)], True
    rows = sum(len(one.residuals) for one in records)
    blocks = np.arange(rows) * (2 * _FOLDS) // rows % _FOLDS
    ends = np.cumsum([len(one.residuals) for one in records])[:-1]
    return [np.asarray(part) for part in np.split(blocks, ends)], False


def _constant(records: Sequence[ForcedRecord]) -> _Basis:
    functions = tuple(np.ones((len(one.motion), 1)) for one in records)
    return _Basis(functions, np.zeros((1, 1)), lambda values: np.ones((values.size, 1)))


def _basis(variable: _Variable, shape: Shape) -> _Basis:
    """A spline of a variable, beside a constant; or the variable itself ("line"), or its sign ("jump")."""
    everything = np.concatenate(variable.values)
    low, high = float(np.min(everything)), float(np.max(everything))
    still = _STILL * max(-low, high)

    def jump(values: Real) -> Real:
        return np.clip(values / still, -1.0, 1.0)[:, None]

    step = (high - low) / variable.intervals
    knots = low + step * np.arange(-_DEGREE, variable.intervals + _DEGREE + 1)
    count = variable.intervals + _DEGREE

    def curve(values: Real) -> Real:
        inside = np.clip(values, low, high)
        functions = BSpline.design_matrix(inside, knots, _DEGREE, extrapolate=True).toarray()
        return np.concatenate([functions, jump(values)], axis=1) if variable.jumps else functions

    if shape == "line":
        return _Basis(tuple(v[:, None] for v in variable.values), np.zeros((1, 1)), lambda v: v[:, None])
    if shape == "jump":
        return _Basis(tuple(jump(v) for v in variable.values), np.zeros((1, 1)), jump)
    second = np.diff(np.eye(count), 2, axis=0)
    rough = np.zeros((count + variable.jumps, count + variable.jumps))
    rough[:count, :count] = second.T @ second
    return _Basis(tuple(curve(v) for v in variable.values), rough, curve)


def _acting(case: CaseOfMachine, forced: MissingForces, dt_s: float) -> tuple[_Acts, ...]:
    """Everything that may depend on a variable, with the variables that are tried for it."""
    machine = case.machine
    names = list(machine.output_names)
    units = [case.units.get(name) or written_unit(name) for name in names]
    motions = [record.motion for record in forced.records]
    of_output = [
        _moving(name, unit, [motion[:, k] for motion in motions], dt_s)
        for k, (name, unit) in enumerate(zip(names, units, strict=True))
    ]
    common = _common(case, dt_s)
    body = getattr(machine, "body", None)
    if body is not None:
        inputs = [record.input for record in case.experiments]
        called = machine.input_names or [f"input {k + 1}" for k in range(inputs[0].shape[1])]
        place, speed = called[body.position], called[body.speed]
        given = (
            _Variable("position", place, written_unit(place), tuple(u[:, body.position] for u in inputs)),
            *_moving(speed, written_unit(speed) or "m/s", [u[:, body.speed] for u in inputs], dt_s)[1:],
        )
        return tuple(
            _Acts("force", "output", k, name, unit, given, common)
            for k, (name, unit) in enumerate(zip(names, units, strict=True))
        )

    coordinates = [machine.other_coordinates(motion) for motion in motions]
    derived = tuple(
        _Variable("position", name, written_unit(name), tuple(one[name] for one in coordinates))
        for name in coordinates[0]
    )
    found = []
    missing = forced.share_of_places
    for at, place in enumerate(forced.places):
        if missing[at] < _LEAST_PLACE:
            continue
        own = () if place.motion is None else of_output[place.motion]
        others = derived or tuple(
            of_output[k][0]
            for k, unit in enumerate(units)
            if k != place.motion and unit in _POSITIONS and of_output[k]
        )
        commands = _commands(case, place.command)
        found.append(
            _Acts("force", "machine", at, place.name, place.unit, own, (*commands, *others, *common))
        )
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        found.append(_Acts("reading", "output", k, name, unit, of_output[k], common))
    return tuple(found)


def _moving(name: str, unit: str, values: Sequence[Real], dt_s: float) -> tuple[_Variable, ...]:
    """Position, speed and acceleration of an output (T,) of every record; of one that is no motion, its
    value.

    The position of an output that is a speed is counted from the begin of its record.
    """
    if unit in _POSITIONS:
        found: dict[Quantity, list[Real]] = {
            "position": list(values),
            "speed": [_rate(v, dt_s, 1) for v in values],
            "acceleration": [_rate(v, dt_s, 2) for v in values],
        }
        base = unit
    elif unit in _SPEEDS:
        found = {
            "position": [np.cumsum(v) * dt_s for v in values],
            "speed": list(values),
            "acceleration": [_rate(v, dt_s, 1) for v in values],
        }
        base = unit.removesuffix("/s")
    else:
        return (_Variable("value", name, unit, tuple(values)),)
    of = {"position": base, "speed": f"{base}/s", "acceleration": f"{base}/s²"}
    return tuple(
        _Variable(quantity, name, of[quantity] if base else "", tuple(every))
        for quantity, every in found.items()
        if _varies(every)
    )


def _rate(values: Real, dt_s: float, order: int) -> Real:
    """(T,) derivative of a signal, by a parabola (or cubic) through the samples about each."""
    window = min(_SMOOTHED + 4 * (order - 1), len(values) - 1 + len(values) % 2)
    return np.asarray(savgol_filter(values, window, order + 1, deriv=order, delta=dt_s))


def _commands(case: CaseOfMachine, column: int | None) -> tuple[_Variable, ...]:
    """The command of a place, where it varies."""
    if column is None:
        return ()
    names = case.machine.input_names
    name = names[column] if column < len(names) else f"input {column + 1}"
    values = tuple(record.input[:, column] for record in case.experiments)
    return (_Variable("command", name, written_unit(name), values),) if _varies(values) else ()


def _common(case: CaseOfMachine, dt_s: float) -> tuple[_Variable, ...]:
    """Time since the log began, and signals that all logs hold beside inputs and outputs."""
    records = case.experiments
    time = tuple(
        dt_s * (getattr(one, "first_row", 0) + np.arange(len(one.output), dtype=np.float64))
        for one in records
    )
    # Of one log everything is a function of the time: none that is finer than the blocks.
    intervals = _INTERVALS_OF_TIME if _are_logs(case) else _INTERVALS
    found = [_Variable("time", "", "s", time, intervals)]
    held = [getattr(one, "beside", {}) for one in records]
    for name in held[0]:
        if all(name in one for one in held) and _varies([one[name] for one in held]):
            found.append(_Variable("beside", name, written_unit(name), tuple(one[name] for one in held)))
    return tuple(found)


def _varies(values: Sequence[Real]) -> bool:
    """Whether a variable takes more than one value in the records together."""
    return float(np.ptp(np.concatenate(list(values)))) > 0
