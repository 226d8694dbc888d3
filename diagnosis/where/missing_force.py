"""The force that a simulation lacks, as a function of time, and the residuals that are linear in it.

Residuals of a simulation are the missing force filtered by the machine: against an angle they show a blurred
dependence. A pulse of force at a place gives the machine's response; the force whose response is the residual
is found with it, and simulated, so that a machine whose response depends on its pose is followed as well.
What this simulation shows beyond the linear response is taken off the residuals. Any curve of any variable is
then a linear regression, without another simulation.

Residuals and responses are then whitened: in proportion to what a force that no curve explains would leave.

Neglected: effects that the machine has between a force and its response beyond the simulation (a lag, a
play).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.fft import irfft, next_fast_len, rfft
from scipy.optimize import linear_sum_assignment
from scipy.sparse.linalg import LinearOperator, lsqr

from diagnosis.machine.force_places import ForcePlace
from diagnosis.machine.machine_protocol import CaseOfMachine, Real, RecordOfMachine

# A residual is followed to this share of its RMS, or to the noise: a real log is never explained to its
# noise, and a finer force is one of noise. Chosen; a curve needs a tenth at most.
_FOLLOWED = 0.05
# Iterations of least squares for one force: each holds about one more frequency. Chosen; twice as many change
# shares of the series by less than 0.01.
_ITERATIONS = 80
# Times the noise at which a record is followed: an eighth of noise more than there is. Chosen.
_ENOUGH = 1.1
# Rounds of simulation and correction: an arm that is held near its record is followed in two, one that falls
# freely in six. Chosen; each is two simulations at most of a record.
_ROUNDS = 12
# Parts of a correction that are tried where all of it leads away: a free run bends where it goes far.
_PARTS = (1.0, 0.5, 0.25)
# A round that leaves more than this part of the error was the last. Chosen: a free run that comes back to the
# record gains little at first.
_GAINS = 0.99
# Part of the missing force, RMS, that no curve explains. Chosen: measured forces repeat to a tenth; with
# three times as much shares of the series change by less than 0.05.
_UNEXPLAINED = 0.05
# Rows of one unknown force: slower than what a machine shows within its own period as a rule. Chosen.
_ROWS_PER_FORCE = 10
# Unknown forces in a record at all places, at most: their decomposition takes a second. Chosen.
_MOST_FORCES = 150
# Of them at each place at least: a begin and an end.
_FEWEST_FORCES = 2
# Part of a record in which a pulse is early: by then it has moved what is near its place. Chosen.
_EARLY = 10
# Directions of less than this part of the largest are rounding.
_ALIKE = 1e-6
# Energy over that of noise below which a direction is left as it is.
_NOTHING = 1e-4
# Values of a record that are looked at, of all outputs; a longer one is looked at every few rows. Chosen: a
# curve has sixteen numbers; with twice as many seven joints take twice the time.
_MOST_VALUES = 6000
# Where in a record pulses of force are tried, as shares of its length: at its begin, and in another pose.
_PULSES_AT = (0.0, 0.25, 0.5)
# Rows at the begin of a record whose forces stand for a start that nobody knows: position, speed and a state
# between them, in each place.
_START_ROWS = 3


@dataclass(frozen=True, eq=False)
class Whitening:
    """A symmetric matrix (T Y, T Y) that takes some directions off by some part.

    basis (T Y, R): orthonormal columns. taken (R,): parts, 0 to 1.
    """

    basis: Real
    taken: Real

    def of(self, signals: Real) -> Real:
        """Signals (T, K, Y) without these parts."""
        rows, count, outputs = signals.shape
        flat = np.moveaxis(signals, 1, 2).reshape(rows * outputs, count)
        flat = flat - self.basis @ (self.taken[:, None] * (self.basis.T @ flat))
        return np.moveaxis(flat.reshape(rows, outputs, count), 2, 1)

    def passes(self, weights: Real, outputs: int) -> Real:
        """(Y,) energy that white noise of one keeps in rows of weights (T,)."""
        lost = np.sum(self.basis**2 * (1 - (1 - self.taken) ** 2), axis=1).reshape(len(weights), outputs)
        return np.asarray(np.sum((1 - lost) * weights[:, None], axis=0))


@dataclass(frozen=True, eq=False)
class ForcedRecord:
    """One record with the force that its simulation lacks.

    Levels of the outputs are noise and a twentieth of the residuals' RMS together: a record is followed to
    that.

    Parameters
    ----------
    name : str
    residuals : (T / step, Y) array
        Over the levels of the outputs and whitened: linear in the missing force, and the rest that no force
        at the places makes. Rows that are missing are zero before that.
    forces : (T, F) array
        Missing forces at the places, in their units; zero where the simulation could not be made to follow.
    motion : (T, Y) array
        Outputs in their units as the forced simulation gives them, with less noise than measured.
    weights : (T / step,) array
        One, and zero in rows that are missing, of the rows that are looked at.
    step : int
        Every how many rows are looked at: residuals and responses are of these.
    whitening : Whitening
        Of residuals and of what curves do to them.
    noise_energies : (Y,) array
        Energy of the sensor noise in the whitened residuals of each output.
    """

    name: str
    residuals: Real
    forces: Real
    motion: Real
    weights: Real
    step: int
    whitening: Whitening
    noise_energies: Real


@dataclass(frozen=True, eq=False)
class MissingForces:
    """Places of a machine, its responses to forces there, and records with the forces that they lack.

    Parameters
    ----------
    places : tuple of ForcePlace
        (F,) places that move some output.
    responses : (F, T, Y) array
        Outputs over their levels after a force of one over the first sample.
    reading_responses : (Y, T, Y) array
        Residuals over the levels where one output reads one unit more in the first row.
    records : tuple of ForcedRecord
    """

    places: tuple[ForcePlace, ...]
    responses: Real
    reading_responses: Real
    records: tuple[ForcedRecord, ...]

    @property
    def share_of_places(self) -> Real:
        """(F,) how far the missing forces of each place move the outputs, over the largest; one where there
        are none."""
        moved = _slow_rms([record.forces for record in self.records]) * _gains(self.responses)
        largest = float(np.max(moved, initial=0.0))
        return np.asarray(moved / largest) if largest > 0 else np.ones(moved.size)

    def response_to(self, place: int, forces: Real, record: ForcedRecord) -> Real:
        """(T / step, K, Y) whitened residuals of a record under each of the forces (T, K) at a place."""
        moved = _convolved(forces, self.responses[place])[:: record.step]
        return record.whitening.of(moved * record.weights[:, None, None])

    def response_to_reading(self, output: int, errors: Real, record: ForcedRecord) -> Real:
        """(T / step, K, Y) whitened residuals of a record where an output reads more by each of the errors
        (T, K), in its unit."""
        moved = _convolved(errors, self.reading_responses[output])[:: record.step]
        return record.whitening.of(moved * record.weights[:, None, None])


def missing_forces(case: CaseOfMachine, residuals: Mapping[str, Real]) -> MissingForces:
    """Forces at the machine's places that make its simulation follow the records.

    Parameters
    ----------
    case : CaseOfMachine
    residuals : record -> (T, Y) array
        (measured - model) / noise of every record, whichever model of the machine made them.

    Returns
    -------
    MissingForces
        Without places where none moves an output; without forces in records that the simulation, pushed,
        follows no better.
    """
    missed = {name: np.asarray(e, dtype=np.float64) * case.noise for name, e in residuals.items()}
    missed_rms = np.sqrt(np.mean(np.concatenate([*missed.values()]) ** 2, axis=0))
    levels = np.hypot(case.noise, _FOLLOWED * missed_rms)
    places, responses = _responses(case, missed_rms, levels)

    # The force of every record, and what its simulation gives beyond the linear response.
    forces: dict[str, Real] = {}
    nonlinear: dict[str, Real] = {}
    weights: dict[str, Real] = {}
    for record in case.experiments:
        name = record.name
        weights[name] = np.ones(len(record.output))
        weights[name][list(getattr(record, "missing", ()))] = 0.0
        forces[name], nonlinear[name] = _force_of(
            case, record, missed[name], weights[name], responses, levels
        )

    force_rms = _slow_rms([*forces.values()])
    records = []
    for record in case.experiments:
        name = record.name
        moved = _response_to_all(responses, forces[name]) + nonlinear[name]
        # A long record is looked at every few rows.
        step = -(-len(record.output) * levels.size // _MOST_VALUES)
        looked_at = weights[name][::step]
        whitening = _whitening(responses, force_rms, looked_at, step)
        linear_residuals = (missed[name] / levels - nonlinear[name])[::step] * looked_at[:, None]
        records.append(
            ForcedRecord(
                name=name,
                residuals=whitening.of(linear_residuals[:, None])[:, 0],
                forces=forces[name],
                motion=record.output - missed[name] + levels * moved,
                weights=looked_at,
                step=step,
                whitening=whitening,
                noise_energies=(case.noise / levels) ** 2 * whitening.passes(looked_at, levels.size),
            )
        )
    return MissingForces(places, responses, _reading_responses(case, missed_rms, levels), tuple(records))


def _responses(case: CaseOfMachine, missed_rms: Real, levels: Real) -> tuple[tuple[ForcePlace, ...], Real]:
    """Places that move an output, and (F, T, Y) responses over the levels to one unit over the first sample.

    missed_rms (Y,): of the residuals in the outputs' units; a pulse moves the outputs about as far, so that
    contacts answer as they do to what is missing. The mean over some begins of the longest record stands for
    a response that depends on the pose.
    """
    longest = max(case.experiments, key=lambda record: len(record.output))
    all_places = case.machine.force_places(longest.input.shape[1])
    rows = len(longest.output)
    if not all_places:
        return (), np.zeros((0, rows, levels.size))
    without_force = case.machine.pushed(longest.input, np.zeros((rows, len(all_places))))
    places = []
    responses = []
    for k, place in enumerate(all_places):

        def moved(begin: int, pulse: float, at: int = k) -> Real:
            """(T - begin, Y) over the levels, from a pulse in one row on."""
            forces = np.zeros((rows, len(all_places)))
            forces[begin, at] = pulse
            return (case.machine.pushed(longest.input, forces) - without_force)[begin:] / levels

        pulse = 1.0 if place.command is None else _largest(longest.input[:, place.command])
        furthest = float(np.max(np.abs(moved(0, pulse)), initial=0.0))
        if not 0 < furthest < np.inf:
            continue
        pulse *= float(np.max(missed_rms / levels)) / furthest
        total = np.zeros((rows, levels.size))
        count = np.zeros((rows, 1))
        for share in _PULSES_AT:
            begin = int(share * rows)
            response = moved(begin, pulse) / pulse
            if np.all(np.isfinite(response)):
                total[: rows - begin] += response
                count[: rows - begin] += 1
        if np.any(total):
            motion = _moved_most(total) if place.motion is None else place.motion
            places.append(ForcePlace(place.name, place.unit, motion, place.command))
            responses.append(total / np.maximum(count, 1))
    if not places:
        return (), np.zeros((0, rows, levels.size))
    of_places = np.array(responses)
    if any(place.motion is None for place in all_places):
        places = _paired(places, of_places * levels)
    return tuple(places), of_places


def _reading_responses(case: CaseOfMachine, missed_rms: Real, levels: Real) -> Real:
    """(Y, T, Y) residuals over the levels where an output reads one unit more in the first row.

    A simulation that is held near what was measured, whose inputs hold the outputs behind the commands,
    follows the wrong reading; others do not know of it. missed_rms (Y,): size of the wrong reading.
    """
    machine = case.machine
    longest = max(case.experiments, key=lambda record: len(record.output))
    rows, outputs = longest.output.shape
    responses = np.zeros((outputs, rows, outputs))
    responses[:, 0] = np.eye(outputs)
    commands = len(machine.input_names)
    # Of inputs that nobody has named all are commands.
    is_held = commands > 0 and longest.input.shape[1] == commands + outputs
    if is_held:
        no_forces = np.zeros((rows, len(machine.force_places(commands))))
        as_read = machine.pushed(longest.input, no_forces)
        middle = rows // 2
        for k in range(outputs):
            misread = np.array(longest.input)
            misread[middle, commands + k] += missed_rms[k]
            moved = (machine.pushed(misread, no_forces) - as_read)[middle:] / missed_rms[k]
            if np.all(np.isfinite(moved)):
                responses[k, : rows - middle] -= moved
    return np.asarray(responses / levels)


def _largest(signal: Real) -> float:
    """Largest size of a command (T,), one where it is zero throughout."""
    return float(np.max(np.abs(signal))) or 1.0


def _moved_most(response: Real) -> int:
    """Column of the output (T, Y), over its level, that a pulse moves most."""
    return int(np.argmax(np.max(np.abs(response), axis=0)))


def _paired(places: Sequence[ForcePlace], responses: Real) -> list[ForcePlace]:
    """Places with the outputs that move where they act, from responses (F, T, Y) in the outputs' units.

    Of joints in coordinates of their own, an inverse inertia has no permutation with a larger trace. Where
    there are fewer outputs than places, or commands that are no forces, several may share an output.
    """
    early = max(responses.shape[1] // _EARLY, 2)
    early_motion = np.sum(responses[:, :early], axis=1)
    largest = np.max(np.abs(responses), axis=(0, 1))
    early_motion = early_motion / np.where(largest > 0, largest, 1.0)
    rows, columns = linear_sum_assignment(-early_motion)
    output_of = dict(zip(rows.tolist(), columns.tolist(), strict=True))
    return [
        ForcePlace(place.name, place.unit, output_of.get(k, place.motion), place.command)
        for k, place in enumerate(places)
    ]


def _force_of(
    case: CaseOfMachine, record: RecordOfMachine, missed: Real, weights: Real, responses: Real, levels: Real
) -> tuple[Real, Real]:
    """(T, F) forces that make the simulation follow a record, and (T, Y), over the levels, what their
    simulation gives beyond their linear response; zeros where it follows no better with them.

    missed : (T, Y) in the outputs' units. weights : (T,) zero in rows that are missing. responses : (F, T, Y)
    over the levels (Y,).
    """
    rows, outputs = missed.shape
    forces = np.zeros((rows, len(responses)))
    nonlinear = np.zeros((rows, outputs))
    if not len(responses):
        return forces, nonlinear
    target = missed / levels * weights[:, None]
    # The RMS of what is followed: noise where the residual is small, a share of it where it is large.
    enough = _ENOUGH * np.sqrt(target.size)
    without_force = case.machine.pushed(record.input, forces)
    left = target
    error = float(np.linalg.norm(target))
    for _ in range(_ROUNDS):
        if error <= enough:
            break
        step = _deconvolved(left, weights, responses, enough / error)
        error_before = error
        # The first part of the step that comes nearer is taken.
        for part in _PARTS:
            trial = forces + part * step
            moved = (case.machine.pushed(record.input, trial) - without_force) / levels
            left_by_trial = target - moved * weights[:, None]
            error_of_trial = float(np.linalg.norm(left_by_trial))
            if error_of_trial < error:
                forces = trial
                left = left_by_trial
                error = error_of_trial
                nonlinear = moved - _response_to_all(responses, forces)
                break
        if not error < _GAINS * error_before:
            break
    return forces, nonlinear


def _deconvolved(target: Real, weights: Real, responses: Real, tolerance: float) -> Real:
    """(T, F) forces whose linear response is the target (T, Y) to a relative tolerance, or as near as some
    iterations come; the slowest parts first, as least squares by conjugate gradients takes them."""
    rows, outputs = target.shape
    places = len(responses)
    n = next_fast_len(2 * rows - 1, real=True)
    spectra = rfft(responses[:, :rows], n, axis=1)

    def forward(x: Real) -> Real:
        """Outputs of forces."""
        of_forces = rfft(x.reshape(rows, places).T, n, axis=1)
        outputs_of = irfft(np.einsum("fw,fwy->wy", of_forces, spectra), n, axis=0)[:rows]
        return np.asarray(outputs_of * weights[:, None]).ravel()

    def backward(y: Real) -> Real:
        """The adjoint: forces of outputs."""
        of_outputs = rfft(y.reshape(rows, outputs) * weights[:, None], n, axis=0)
        forces_of = irfft(np.einsum("wy,fwy->wf", of_outputs, np.conj(spectra)), n, axis=0)[:rows]
        return np.asarray(forces_of).ravel()

    # Places in units of their own: a force of one in each moves the outputs about as far.
    scale = np.tile(1 / np.sqrt(np.sum(responses**2, axis=(1, 2))), rows)
    operator = LinearOperator(
        (rows * outputs, rows * places),
        matvec=lambda x: forward(np.ravel(x) * scale),
        rmatvec=lambda y: backward(np.ravel(y)) * scale,
        dtype=np.float64,
    )
    solution, *_ = lsqr(operator, target.ravel(), atol=0.0, btol=tolerance, conlim=0.0, iter_lim=_ITERATIONS)
    return np.asarray(solution * scale).reshape(rows, places)


def _slow_rms(forces: Sequence[Real]) -> Real:
    """(F,) RMS of the missing forces (T, F) of all records, each as means over some rows: without the noise
    that a force of single rows holds."""
    means = []
    for of_record in forces:
        parts = np.array_split(of_record, max(len(of_record) // _ROWS_PER_FORCE, 1))
        means += [np.mean(part, axis=0) for part in parts]
    return np.asarray(np.sqrt(np.mean(np.square(means), axis=0)))


def _gains(responses: Real) -> Real:
    """(F,) sizes of responses (F, T, Y)."""
    return np.asarray(np.sqrt(np.sum(responses**2, axis=(1, 2))))


def _whitening(responses: Real, force_rms: Real, weights: Real, step: int) -> Whitening:
    """What makes noise, beside the traces of unknown forces and of an unknown start, white.

    A machine that drifts integrates the smallest force: without this all of its error is drift, and no curve
    explains it. Forces that no curve explains are triangles over some rows each, independent, of a share of
    `force_rms` (F,), what is missing; forces in the first rows, of any size, stand for the start. The
    covariance of a record, beside its start, is C = I + N N', N their responses. With the singular values s
    of N and its left vectors U, C^(-1/2) = I - U (1 - (1 + s^2)^(-1/2)) U'. weights: of every `step`-th row.
    """
    outputs = responses.shape[2]
    if not len(responses):
        return Whitening(np.zeros((len(weights) * outputs, 0)), np.zeros(0))
    rows = (len(weights) - 1) * step + 1
    most_forces = max(_MOST_FORCES // len(responses), _FEWEST_FORCES)
    count = int(np.clip(rows // _ROWS_PER_FORCE, _FEWEST_FORCES, most_forces))
    nodes = np.linspace(0, rows - 1, count)
    triangles = np.array([np.interp(np.arange(rows), nodes, row) for row in np.eye(count)]).T
    # What is not explained moves the outputs about as far from each place as from the one that misses most.
    gains = _gains(responses)
    unexplained = _UNEXPLAINED * float(np.max(force_rms * gains))

    def of_all(forces: Real) -> Real:
        """(T / step Y, K F) responses over their gains to forces (T, K) at every place."""
        by_place = [
            _convolved(forces, response / gain)[::step]
            for response, gain in zip(responses, gains, strict=True)
        ]
        together = np.concatenate(by_place, axis=1) * weights[:, None, None]
        return np.asarray(np.moveaxis(together, 1, 2).reshape(len(weights) * outputs, -1))

    # Directions of the start are taken off as a whole, those of unknown forces as far as these explain them.
    of_start = of_all(np.eye(rows, _START_ROWS))
    lengths = np.maximum(np.linalg.norm(of_start, axis=0), np.finfo(float).tiny)
    start, sizes, _ = np.linalg.svd(of_start / lengths, full_matrices=False)
    start = start[:, sizes > _ALIKE * sizes[0]]
    of_forces = unexplained * of_all(triangles)
    of_forces -= start @ (start.T @ of_forces)
    energies, turned = np.linalg.eigh(of_forces.T @ of_forces)
    is_visible = energies > max(_NOTHING, _ALIKE**2 * float(energies[-1]))
    basis = of_forces @ (turned[:, is_visible] / np.sqrt(energies[is_visible]))
    taken = 1 - 1 / np.sqrt(1 + energies[is_visible])
    return Whitening(np.concatenate([start, basis], axis=1), np.append(np.ones(start.shape[1]), taken))


def _response_to_all(responses: Real, forces: Real) -> Real:
    """(T, Y) over the levels, of forces (T, F) at all places together."""
    moved = np.zeros((len(forces), responses.shape[2]))
    for k, response in enumerate(responses):
        moved += _convolved(forces[:, [k]], response)[:, 0]
    return moved


def _convolved(forces: Real, response: Real) -> Real:
    """(T, K, Y) of each of the forces (T, K) through one response (T', Y), T' >= T."""
    rows = len(forces)
    n = next_fast_len(2 * rows - 1, real=True)
    spectra = rfft(forces, n, axis=0)[:, :, None] * rfft(response[:rows], n, axis=0)[:, None]
    return np.asarray(irfft(spectra, n, axis=0)[:rows])
