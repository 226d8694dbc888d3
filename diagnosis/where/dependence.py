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

from diagnosis.machine.around import MeasuredBody
from diagnosis.machine.machine_protocol import CaseOfMachine, Real
from diagnosis.where.findings import Alternative, Dependence, Quantity, Shape
from diagnosis.where.missing_force import ForcedRecord, MissingForces, missing_forces
from ident.data.units import written_unit

Integer = npt.NDArray[np.int64]

# Inner intervals of a spline: a ripple of three periods over the range is followed. Chosen; with twice as
# many the penalty takes over and shares of the series move by less than 0.01.
_INTERVALS = 10
# Those of a curve of the time, which also follows what swells ten times in a log.
_INTERVALS_OF_TIME = 40
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
# Points at which a curve is told: what a picture of it needs.
_POINTS = 25
# Standard errors of a difference by which one dependence explains more than another.
_DIFFER = 2.0
# Singular values of normal equations, over the largest, that are rounding.
_ROUNDING = 1e-13
# Energies below this are zero: it keeps a ratio finite.
_NO_ENERGY = 1e-300

# Units of positions; an output without a unit is taken for one.
_POSITIONS = ("rad", "m", "deg", "mm", "")
# Units of speeds: theirs over a second.
_SPEEDS = tuple(f"{unit}/s" for unit in _POSITIONS if unit)


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

    through, at : whether it goes through the machine's response at its place `at`, or through the reading of
        output `at`. name, unit : of the place or output, and of the force or reading. of_place : the motion
        of the place itself. of_others : all else that is tried.
    """

    acts: Literal["force", "reading"]
    through: Literal["machine", "output"]
    at: int
    name: str
    unit: str
    of_place: tuple[_Variable, ...]
    of_others: tuple[_Variable, ...]

    @property
    def variables(self) -> tuple[_Variable, ...]:
        """Everything that is tried for it."""
        return (*self.of_place, *self.of_others)

    @property
    def where(self) -> tuple[str, int]:
        """What the response to it depends on."""
        return self.through, self.at


# What acts, and the variable that it is a curve of.
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
    findings: list[Dependence] = []
    taken: list[_Pair] = []
    while len(findings) < _MOST:
        left = [pair for pair in pairs if pair not in taken]
        possible = regressions.beyond_chance(left, taken, deviations)
        if not possible:
            break
        best = _preferred(possible)
        findings.append(regressions.finding(best, taken, possible))
        taken.append(best.pair)
    return tuple(findings)


@dataclass(frozen=True, eq=False)
class _Tried:
    """A dependence that explains more than chance.

    total, constant_total : energies that it, and a constant force at its place, take off the error.
    gained : (B,) the same of the dependence by block, every record over its own energy.
    curve, constant : regressions on both, and on the constant force alone.
    """

    pair: _Pair
    total: float
    constant_total: float
    gained: Real
    curve: _Judged
    constant: _Judged


def _preferred(possible: Sequence[_Tried]) -> _Tried:
    """The dependence that explains most, of one at least.

    An error of a reading has to explain more than a force does, beyond two standard errors: a machine that
    follows stiffly shows the one as the other, and forces are what machines have.
    """
    best_dependence = max(possible, key=lambda dependence: dependence.total)
    as_good_forces = [
        dependence
        for dependence in possible
        if dependence.pair[0].acts == "force" and not _explains_more(best_dependence, dependence)
    ]
    if best_dependence.pair[0].acts == "reading" and as_good_forces:
        return max(as_good_forces, key=lambda dependence: dependence.total)
    return best_dependence


def _explains_more(first: _Tried, second: _Tried) -> bool:
    """Whether one explains more than another beyond two standard errors of the difference by block."""
    difference = first.gained - second.gained
    return float(np.sum(difference)) > _DIFFER * _deviation(difference)


def _deviation(gained: Real) -> float:
    """Standard deviation of the sum of energies by block (B,), blocks taken as independent."""
    return float(np.sqrt(gained.size) * np.std(gained, ddof=1))


class _Regressions:
    """Regressions of the residuals of all records on forces and readings that depend on variables.

    Rows of all records together, in their order, are N.
    """

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
            [np.full(len(target), 1 / max(float(np.sum(target**2)), _NO_ENERGY)) for target in self._targets]
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
        possible = []
        for pair in pairs:
            where = pair[0].where
            if where not in constants:
                constants[where] = self._judge(taken, where)
            constant = constants[where]
            curve = self._judge([*taken, pair], where)
            # A constant force that predicts a record worse than none does is none there.
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
                possible.append(_Tried(pair, total, constant_total, gained, curve, constant))
        return possible

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
        """A regression on curves of these pairs together, and a constant at a place.

        Of the last pair a straight line or a jump stands in place of its curve where `shape` says so. The
        penalty is the one that is best on data not fitted to.
        """
        if not pairs and constant_at is None:
            rows = np.concatenate([np.sum(target**2, axis=1) for target in self._targets])
            return _Judged(np.zeros(0), np.zeros((0, 0)), rows)
        bases: list[_Basis] = []
        acts: list[tuple[str, int]] = []
        if constant_at is not None:
            bases.append(_constant(self._forced.records))
            acts.append(constant_at)
        for k, (place, variable) in enumerate(pairs):
            is_last = k == len(pairs) - 1
            bases.append(_basis(variable, shape if is_last else "curve"))
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
        strengths = _PENALTIES if np.any(penalty) else (0.0,)
        judged = [self._cross_validated(columns, folds, strength * penalty) for strength in strengths]
        return min(judged, key=lambda regression: float(np.sum(regression.left)))

    def _responses(self, place: tuple[str, int], functions: Real, record: ForcedRecord) -> Real:
        """(T, K, Y) whitened residuals of a record by functions (T, K) at a place."""
        through, at = place
        if through == "machine":
            return self._forced.response_to(at, functions, record)
        return self._forced.response_to_reading(at, functions, record)

    def _sums(self, columns: Sequence[Real]) -> list[_Fold]:
        """Sums of every fold, from columns (T, K, Y) of every record."""
        count = max(int(np.max(fold)) for fold in self._folds) + 1
        size = columns[0].shape[1]
        folds = [_Fold(np.zeros((size, size)), np.zeros(size)) for _ in range(count)]
        for fold, target, of_record in zip(self._folds, self._targets, columns, strict=True):
            for k in np.unique(fold):
                inside = fold == k
                flat = np.moveaxis(of_record[inside], 1, 0).reshape(size, -1)
                folds[k].gram[:] += flat @ flat.T
                folds[k].moment[:] += flat @ target[inside].ravel()
        return folds

    def _cross_validated(self, columns: Sequence[Real], folds: Sequence[_Fold], penalty: Real) -> _Judged:
        """A regression on all data, judged fold by fold by those on the others.

        columns : (T, K, Y) of every record. penalty : (K, K).
        """
        gram = np.sum([fold.gram for fold in folds], axis=0)
        moment = np.sum([fold.moment for fold in folds], axis=0)
        without = [_solved(gram - fold.gram + penalty, moment - fold.moment) for fold in folds]
        left = []
        for fold, target, of_record in zip(self._folds, self._targets, columns, strict=True):
            values = np.array(without)[fold]
            predicted = np.einsum("tky,tk->ty", of_record, values)
            left.append(np.sum((target - predicted) ** 2, axis=1))
        rows = np.concatenate(left)
        # Covariance of penalised least squares: s^2 H^-1 G H^-1 with H = G + penalty.
        scale = np.sqrt(np.maximum(np.diag(gram + penalty), _NO_ENERGY))
        scaled = (gram + penalty) / np.outer(scale, scale)
        inverse = np.linalg.pinv(scaled, rcond=_ROUNDING, hermitian=True) / np.outer(scale, scale)
        scatter = float(np.sum(rows)) / max(rows.size - len(moment), 1)
        return _Judged(_solved(gram + penalty, moment), scatter * inverse @ gram @ inverse, rows)

    def finding(self, best: _Tried, taken: Sequence[_Pair], possible: Sequence[_Tried]) -> Dependence:
        """The best of the possible dependences in numbers, with its curve at points.

        taken : pairs whose curves were fitted with it and come before it.
        """
        acts, variable = best.pair
        low, high = np.quantile(np.concatenate(variable.values), (_ENDS, 1 - _ENDS))
        at = np.linspace(low, high, _POINTS)
        drawn = np.concatenate([np.ones((at.size, 1)), _basis(variable, "curve").at(at)], axis=1)
        curve = best.curve
        # Coefficients of the curve are the constant, which comes first, and the last ones.
        functions = drawn.shape[1] - 1
        columns = [0, *range(curve.coefficients.size - functions, curve.coefficients.size)]
        covariance = curve.covariance[np.ix_(columns, columns)]
        errors = np.sqrt(np.maximum(np.sum((drawn @ covariance) * drawn, axis=1), 0.0))
        shape, slope, slope_error = self._shape(best, taken)
        as_good = [other for other in possible if other is not best and not _explains_more(best, other)]
        as_good.sort(key=lambda other: -other.total)
        alternatives = []
        for other in as_good[:_MOST]:
            place, another = other.pair
            alternatives.append(
                Alternative(place.name, another.quantity, another.of, another.unit, self._share(other.total))
            )
        return Dependence(
            place=acts.name,
            acts=acts.acts,
            quantity=variable.quantity,
            of=variable.of,
            unit=variable.unit,
            own=variable in acts.of_place,
            value_unit=acts.unit,
            centres=tuple(at.tolist()),
            values=tuple((drawn @ curve.coefficients[columns]).tolist()),
            standard_errors=tuple(errors.tolist()),
            share=self._share(best.total),
            constant_share=self._share(best.constant_total),
            judged_on="logs" if self._on_logs else "blocks",
            shape=shape,
            slope=slope,
            slope_error=slope_error,
            beside=len(taken) > 0,
            also=tuple(alternatives),
        )

    def _share(self, energy: float) -> float:
        """Share of the error's energy above noise, 0 to 1."""
        return float(np.clip(energy / self._error, 0.0, 1.0))

    def _shape(self, best: _Tried, taken: Sequence[_Pair]) -> tuple[Shape, float | None, float | None]:
        """What explains nine tenths of what the curve does, with its slope or height and standard error."""
        explains = best.total - best.constant_total
        simple: Sequence[Shape] = ("line", "jump") if best.pair[1].jumps else ("line",)
        pairs = [*taken, best.pair]
        parts = {shape: self._judge(pairs, best.pair[0].where, shape) for shape in simple}
        gains = {shape: float(np.sum(best.constant.left - part.left)) for shape, part in parts.items()}
        shape = max(gains, key=lambda name: gains[name])
        if gains[shape] < _SAME * explains:
            return "curve", None, None
        judged = parts[shape]
        return shape, float(judged.coefficients[-1]), float(np.sqrt(judged.covariance[-1, -1]))


def _solved(gram: Real, moment: Real) -> Real:
    """Coefficients (K,); those of columns without energy are zero."""
    scale = np.sqrt(np.maximum(np.diag(gram), 0.0))
    scale[scale == 0] = 1.0
    scaled = gram / np.outer(scale, scale)
    return np.asarray(np.linalg.lstsq(scaled, moment / scale, rcond=_ROUNDING)[0] / scale)


def _penalty(bases: Sequence[_Basis], energies: Sequence[Real]) -> Real:
    """(K, K) of all bases, each in proportion to the mean energy (K,) of its columns over all folds."""
    energy = np.sum(energies, axis=0)
    penalty = np.zeros((energy.size, energy.size))
    first = 0
    for basis in bases:
        columns = slice(first, first + len(basis.rough))
        size = float(np.trace(basis.rough))
        if size > 0:
            penalty[columns, columns] = basis.rough * (float(np.sum(energy[columns])) / size)
        first += len(basis.rough)
    return penalty


def _scatter(energies: Real, rows: Sequence[int]) -> float:
    """Standard deviation of the energy of noise that has these energies (N, Y) in records of so many rows."""
    return float(np.sqrt(2 * np.sum(energies**2 / np.array(rows)[:, None])))


def _are_logs(case: CaseOfMachine) -> bool:
    """Whether the records are several logs, each from its begin."""
    records = case.experiments
    return len(records) > 1 and all(getattr(record, "first_row", 0) == 0 for record in records)


def _folds(case: CaseOfMachine, records: Sequence[ForcedRecord]) -> tuple[list[Integer], bool]:
    """(T,) fold of every row of every record, and whether the folds are logs.

    Parts of one log are blocks: of a variable like the time no part holds what another one does.
    """
    if _are_logs(case):
        count = min(len(records), 2 * _FOLDS)
        return [np.full(len(record.residuals), k % count) for k, record in enumerate(records)], True
    lengths = [len(record.residuals) for record in records]
    rows = sum(lengths)
    # Two blocks of every fold, far apart.
    blocks = np.arange(rows) * (2 * _FOLDS) // rows % _FOLDS
    ends = np.cumsum(lengths)[:-1]
    return [np.asarray(part) for part in np.split(blocks, ends)], False


def _constant(records: Sequence[ForcedRecord]) -> _Basis:
    """The basis of a constant."""
    functions = tuple(np.ones((len(record.motion), 1)) for record in records)
    return _Basis(functions, np.zeros((1, 1)), lambda values: np.ones((values.size, 1)))


def _basis(variable: _Variable, shape: Shape) -> _Basis:
    """A spline of a variable, beside a constant; or the variable itself ("line"), or its sign ("jump")."""
    everything = np.concatenate(variable.values)
    low = float(np.min(everything))
    high = float(np.max(everything))
    still = _STILL * max(-low, high)

    def jump(values: Real) -> Real:
        return np.clip(values / still, -1.0, 1.0)[:, None]

    step = (high - low) / variable.intervals
    knots = low + step * np.arange(-_DEGREE, variable.intervals + _DEGREE + 1)
    count = variable.intervals + _DEGREE

    def curve(values: Real) -> Real:
        inside = np.clip(values, low, high)
        functions = BSpline.design_matrix(inside, knots, _DEGREE, extrapolate=True).toarray()
        if variable.jumps:
            functions = np.concatenate([functions, jump(values)], axis=1)
        return functions

    if shape == "line":
        return _Basis(tuple(v[:, None] for v in variable.values), np.zeros((1, 1)), lambda v: v[:, None])
    if shape == "jump":
        return _Basis(tuple(jump(v) for v in variable.values), np.zeros((1, 1)), jump)
    # A jump is not rough: only the spline's second differences are penalised.
    second_differences = np.diff(np.eye(count), 2, axis=0)
    columns = count + 1 if variable.jumps else count
    rough = np.zeros((columns, columns))
    rough[:count, :count] = second_differences.T @ second_differences
    return _Basis(tuple(curve(v) for v in variable.values), rough, curve)


def _acting(case: CaseOfMachine, forced: MissingForces, dt_s: float) -> tuple[_Acts, ...]:
    """Everything that may depend on a variable, with the variables that are tried for it."""
    machine = case.machine
    names = list(machine.output_names)
    units = [case.units.get(name) or written_unit(name) for name in names]
    common = _common(case, dt_s)
    body = getattr(machine, "body", None)
    if body is not None:
        return _acting_on_known_motion(case, body, units, common, dt_s)

    motions = [record.motion for record in forced.records]
    of_output = [
        _moving(names[k], units[k], [motion[:, k] for motion in motions], dt_s) for k in range(len(names))
    ]
    by_record = [machine.other_coordinates(motion) for motion in motions]
    derived = tuple(
        _Variable("position", name, written_unit(name), tuple(coordinates[name] for coordinates in by_record))
        for name in by_record[0]
    )
    acting = []
    missing = forced.share_of_places
    for at, place in enumerate(forced.places):
        if missing[at] < _LEAST_PLACE:
            continue
        of_place = () if place.motion is None else of_output[place.motion]
        positions = derived
        if not positions:
            # Positions of all other outputs stand for what the machine does not compute of them.
            positions = tuple(
                of_output[k][0]
                for k, unit in enumerate(units)
                if k != place.motion and unit in _POSITIONS and of_output[k]
            )
        tried_beside = (*_commands(case, place.command), *positions, *common)
        acting.append(_Acts("force", "machine", at, place.name, place.unit, of_place, tried_beside))
    for k, (name, unit) in enumerate(zip(names, units, strict=True)):
        acting.append(_Acts("reading", "output", k, name, unit, of_output[k], common))
    return tuple(acting)


def _acting_on_known_motion(
    case: CaseOfMachine, body: MeasuredBody, units: Sequence[str], common: tuple[_Variable, ...], dt_s: float
) -> tuple[_Acts, ...]:
    """Forces as outputs of a motion that is given: each is a curve of that motion, and of what is common.

    body : whose position and speed are inputs. units : of the outputs.
    """
    machine = case.machine
    inputs = [record.input for record in case.experiments]
    columns = machine.input_names or [f"input {k + 1}" for k in range(inputs[0].shape[1])]
    place = columns[body.position]
    speed = columns[body.speed]
    position = _Variable("position", place, written_unit(place), tuple(u[:, body.position] for u in inputs))
    # Speed and acceleration: the position was measured, and is not counted from the speed.
    rates = _moving(speed, written_unit(speed) or "m/s", [u[:, body.speed] for u in inputs], dt_s)[1:]
    return tuple(
        _Acts("force", "output", k, name, units[k], (position, *rates), common)
        for k, name in enumerate(machine.output_names)
    )


def _moving(name: str, unit: str, values: Sequence[Real], dt_s: float) -> tuple[_Variable, ...]:
    """Position, speed and acceleration of an output (T,) of every record, those that vary; of one that is no
    motion, its value.

    The position of an output that is a speed is counted from the begin of its record.
    """
    if unit in _POSITIONS:
        motion: dict[Quantity, list[Real]] = {
            "position": list(values),
            "speed": [_rate(v, dt_s, 1) for v in values],
            "acceleration": [_rate(v, dt_s, 2) for v in values],
        }
        base = unit
    elif unit in _SPEEDS:
        motion = {
            "position": [np.cumsum(v) * dt_s for v in values],
            "speed": list(values),
            "acceleration": [_rate(v, dt_s, 1) for v in values],
        }
        base = unit.removesuffix("/s")
    else:
        return (_Variable("value", name, unit, tuple(values)),)
    unit_of = {"position": base, "speed": f"{base}/s", "acceleration": f"{base}/s²"}
    return tuple(
        _Variable(quantity, name, unit_of[quantity] if base else "", tuple(signals))
        for quantity, signals in motion.items()
        if _varies(signals)
    )


def _rate(values: Real, dt_s: float, order: int) -> Real:
    """(T,) derivative of a signal, by a parabola (or cubic) through the samples about each.

    A second derivative takes four samples more; of a short record all of them, an odd number.
    """
    window = min(_SMOOTHED + 4 * (order - 1), len(values) - 1 + len(values) % 2)
    return np.asarray(savgol_filter(values, window, order + 1, deriv=order, delta=dt_s))


def _commands(case: CaseOfMachine, column: int | None) -> tuple[_Variable, ...]:
    """The command of a place, where there is one that varies."""
    if column is None:
        return ()
    names = case.machine.input_names
    name = names[column] if column < len(names) else f"input {column + 1}"
    values = tuple(record.input[:, column] for record in case.experiments)
    if not _varies(values):
        return ()
    return (_Variable("command", name, written_unit(name), values),)


def _common(case: CaseOfMachine, dt_s: float) -> tuple[_Variable, ...]:
    """Time since the log began, and signals that all logs hold beside inputs and outputs."""
    records = case.experiments
    time = tuple(
        dt_s * (getattr(record, "first_row", 0) + np.arange(len(record.output), dtype=np.float64))
        for record in records
    )
    # Of one log everything is a function of the time: none that is finer than the blocks.
    intervals = _INTERVALS_OF_TIME if _are_logs(case) else _INTERVALS
    variables = [_Variable("time", "", "s", time, intervals)]
    beside = [getattr(record, "beside", {}) for record in records]
    for name in beside[0]:
        if not all(name in columns for columns in beside):
            continue
        values = tuple(columns[name] for columns in beside)
        if _varies(values):
            variables.append(_Variable("beside", name, written_unit(name), values))
    return tuple(variables)


def _varies(values: Sequence[Real]) -> bool:
    """Whether a variable takes more than one value in the records together."""
    return float(np.ptp(np.concatenate(list(values)))) > 0
