"""Find poles of a plant outside the unit circle, from logs of a loop that is closed around it.

A predictor of the output from its own past and the input,

    y = M y + N u + e,    M and N on one GOBF basis, each at least a sample late,

is stable even where the plant is not, and is fitted by least squares; it is unbiased in a loop where e is
white. The plant is G = N / (1 - M), so its poles outside the circle are zeros of 1 - M there.

The poles of the basis start at those zeros, mirrored into the circle, over and over (Steiglitz and McBride,
IEEE TAC 10(4), 1965); then a descent moves them to the least squares of e, and the criterion of the order
chooses how many there are. A zero counts as an unstable pole where it lies outside the circle beyond doubt,
to first order in the noise. Neglected: friction in the input, which `ident.friction` takes off first.

`Regression`, of another file, holds the records made ready for a fit: inputs u (2, N), outputs y (N,) of all
records; `project` fits a basis to it; `Refined` is the end of a descent (poles, residual sum of squares rss).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from ident.basis.functions import basis_response
from ident.basis.model import GobfModel
from ident.basis.options import IdentOptions
from ident.basis.poles import NO_POLES, Poles
from ident.basis.structure import Structure, filter_input
from ident.checks.prior_tests import ROUGH
from ident.data.arrays import ComplexArray, RealArray
from ident.data.record import Record
from ident.fit.least_squares import Regression, project
from ident.fit.refinement import Refined
from ident.fit.regression import prepare, prepare_inputs, thinned
from ident.search.order_selection import OrderSelection
from ident.search.pole_search import PoleSearch

# Numbers of real poles and pairs that are tried; the criterion of the order chooses. A balanced arm has one
# unstable real pole and a stable one, and four flexible modes are the most that the loops of the tests show.
# With two modes at most the tests of loops and unstable plants do not move.
STRUCTURES = ((2, 0), (2, 1), (2, 2), (2, 3), (2, 4))
# Rounds in which zeros take the place of poles: a limit of work, the best one counts. Five are enough for the
# tests; chosen as twice that.
MOST_ROUNDS = 10
# A pole is unstable if it lies so many standard deviations outside the circle: a stable one on the circle is
# taken for unstable once in three million logs. With 2.5 or 10 no test of unstable plants moves.
LEAST_DEVIATIONS = 5.0
# A pole is unstable if its growth takes at most the longest record over this number as its time constant:
# slower growth looks like an integrator and drift. Halved or doubled, no test of unstable plants moves.
LEAST_TIME_CONSTANTS = 1.0
# Largest modulus of a pole of the basis: a time constant of ten million samples, longer than any record.
LARGEST_MODULUS = 1 - 1e-7
# Step of the differences at a zero, as a share of its distance from the circle: poles of the basis are at
# least that far away, so the slopes are right to 1e-4.
DIFFERENCE_SHARE = 0.01
# Singular values of the regression below this share of the largest are rounding (1e-16 and a margin of four
# digits), and get no variance.
SMALLEST_SEEN = 1e-12


def find_unstable(records: Sequence[Record], options: IdentOptions | None = None) -> Poles:
    """Mirror images of the unstable poles that records of a closed loop show.

    Parameters
    ----------
    records : sequence of Record
        Of one input and one output.
    options : IdentOptions, optional
        Of the fit to come, which takes the poles by `options.with_unstable`. Here only the delay of the input
        and the size of the part of long records that is searched count.

    Returns
    -------
    Poles
        1 / conj(p) of every pole p outside the circle beyond doubt; empty where there is none.

    Raises
    ------
    ValueError
        A record has several inputs or outputs, or records differ in sampling time or are too short.
    """
    options = options or IdentOptions()
    predictor_records = [_with_output(record, options.input_delay_samples) for record in records]
    part, _ = thinned(predictor_records, options.search_samples)
    start = _predictor_poles(_prepared(part))
    data = _prepared(predictor_records)
    end = PoleSearch(data, IdentOptions()).descend(start, "predictor", ROUGH)
    return _significant(data, end.poles)


def quick_poles(records: Sequence[Record], options: IdentOptions | None = None) -> Poles:
    """Poles between a stable input and output with a direct term, found without a global search.

    Parameters
    ----------
    records : sequence of Record
        Of one input and one output.
    options : IdentOptions, optional
        Only the size of the part of long records that is searched counts.

    Returns
    -------
    Poles
        Zeros of 1 - M of the predictor, polished on the response from input to output; those are taken out
        again that the criterion of the order does not mind.

    Raises
    ------
    ValueError
        A record has several inputs or outputs, or there is none, or sampling times differ (`prepare_inputs`).
        That signals move is not checked.
    """
    options = options or IdentOptions()
    part, _ = thinned(records, options.search_samples)
    # The predictor's terms are a sample late; the next input makes the input of the same sample one of them.
    data = _prepared([_with_output(record, -1) for record in part])
    denominator = _predictor(data, _predictor_poles(data)).denominator
    start = _inside(denominator.zeros())
    structure = Structure(feedthrough=True, estimate_offset=True, estimate_initial_state=True)
    search = PoleSearch(prepare(part, structure), IdentOptions(feedthrough=True))
    polished = search.descend(start, "loop", ROUGH)
    return OrderSelection(search).pruned(polished).poles


def _predictor_poles(data: Regression) -> Poles:
    """Poles of the predictor's basis, in the structure that the criterion of the order chooses.

    `data` : the predictor's records. Too few samples are not refused: N ln J then rewards the largest
    structure.
    """
    log_samples = float(np.log(data.n_samples))

    def criterion(end: Refined) -> float:
        """N ln J + (free numbers) ln N: lower is better; minus infinity where nothing is left (J = 0)."""
        numbers = data.n_parameters(end.poles.order)
        return float(data.n_samples * np.log(end.rss) + numbers * log_samples)

    starts = [_mirrored_often(data, n_real, n_pairs) for n_real, n_pairs in STRUCTURES]
    ends = [PoleSearch(data, IdentOptions()).descend(start, "predictor", ROUGH) for start in starts]
    return min(ends, key=criterion).poles


def _with_output(record: Record, delay_samples: int) -> Record:
    """Record whose inputs are its output and its delayed input (T, 2): what the predictor is made of.

    `delay_samples` : of the input; -1: the next input, whose last value is repeated. Raises ValueError where
    the record has several inputs or outputs.
    """
    record.refuse_several()
    output = record.output[:, 0]
    command = record.input[:, 0]
    if delay_samples < 0:
        command = np.append(command[1:], command[-1])
    else:
        command = filter_input(command, 0, delay_samples)
    predicted_from = np.column_stack([output, command])
    return replace(record, input=predicted_from, input_names=("output", "input"), input_units=())


def _prepared(records: Sequence[Record]) -> Regression:
    """Regression of the predictor: records may begin in motion and at any offset.

    Raises ValueError without records, or where sampling times differ (`prepare_inputs`).
    """
    return prepare_inputs(records, Structure(estimate_offset=True, estimate_initial_state=True))


class _Predictor(NamedTuple):
    """Best predictor on a basis.

    denominator : 1 - M, a model with direct term 1 and coefficients (B,)
    numerator : coefficients (B,) of N
    rss : residual sum of squares
    """

    denominator: GobfModel
    numerator: RealArray
    rss: float


def _predictor(data: Regression, poles: Poles) -> _Predictor:
    """Best predictor on the basis of these poles, by linear least squares.

    `data` : with the output's past and the input as its two inputs (not checked); B poles, one at least. What
    the data do not show gets coefficients of zero.
    """
    fitted = project(data, poles)
    of_output, of_input = fitted.coefficients(data.y)[: 2 * poles.order].reshape(2, -1)
    denominator = GobfModel(poles, -of_output, data.dt_s, 1.0)
    return _Predictor(denominator, of_input, float(fitted.residual @ fitted.residual))


def _mirrored_often(data: Regression, n_real: int, n_pairs: int) -> Poles:
    """Poles of the best of `MOST_ROUNDS` rounds, in each of which zeros of 1 - M take the poles' place.

    The start is spread evenly, in logarithm, over decays and frequencies that records of this length show; it
    is chosen, the rounds move it. Length and number of samples are not checked.
    """
    # From half the longest record to three samples (1 / 0.3) as time constants.
    slowest_per_s = 2 / (data.longest * data.dt_s)
    fastest_per_s = 0.3 / data.dt_s
    poles = Poles.from_continuous(
        decay_per_s=np.geomspace(slowest_per_s, fastest_per_s, n_real + 2)[1:-1],
        # A mode has to turn round in the record: 8 radians or more.
        omega_rad_s=np.geomspace(4 * slowest_per_s, fastest_per_s, n_pairs + 2)[1:-1],
        # Wide enough to see modes beside it; chosen.
        zeta=[0.3] * n_pairs,
        dt_s=data.dt_s,
    )
    best_poles = poles
    least_rss = np.inf
    for _ in range(MOST_ROUNDS):
        predictor = _predictor(data, poles)
        if predictor.rss < least_rss:
            least_rss = predictor.rss
            best_poles = poles
        mirrored = _inside(predictor.denominator.zeros())
        # A zero at infinity was left out: its mirror image is at the origin.
        poles = mirrored.appended(Poles(np.zeros(poles.order - mirrored.order)))
    return best_poles


def _inside(zeros: ComplexArray) -> Poles:
    """Zeros (n,) as poles of a basis: those outside the circle mirrored into it, those on it moved just
    inside.

    Only the real ones and the upper one of each pair are taken; a zero at infinity or nan is not one
    (`denominator.zeros` leaves it out).
    """
    modulus = np.maximum(np.abs(zeros), np.finfo(np.float64).tiny)
    mirrored = np.minimum(np.minimum(modulus, 1 / modulus), LARGEST_MODULUS)
    return _poles(zeros / modulus * mirrored)


def _poles(values: ComplexArray) -> Poles:
    """Poles of which `values` (n,) has the real ones, and of each pair at least the upper one.

    Raises ValueError (`Poles`) where one is not inside the circle; lower ones and nan are left out.
    """
    is_real = values.imag == 0
    is_upper = values.imag > 0
    return Poles(values[is_real].real, values[is_upper])


def _significant(data: Regression, poles: Poles) -> Poles:
    """Mirror images of the zeros of 1 - M that are poles outside the circle beyond doubt.

    To first order a zero p moves by -d(1 - M)(p) / (1 - M)'(p). The errors dM and dN are those of a fit whose
    poles are free, too: of a basis with every pole twice, whose span has all their first-order changes. A
    zero that N shares, be it by chance, is no pole: the residue N / (1 - M)' of G has to differ from zero
    beyond doubt, too. `poles` : of the predictor, B of them. Empty where the samples are too few for the
    coefficients; nothing is raised.
    """
    predictor = _predictor(data, poles)
    zeros = predictor.denominator.zeros()
    double = poles.doubled()
    fitted = project(data, double, poles)
    # Independent samples of the residual that are left after the coefficients.
    degrees = data.colour(fitted.residual).effective_samples - 2 * double.order
    if not degrees > 0:
        return NO_POLES
    # Errors of the coefficients of M and N, (2 B, directions) each: one column per independent unit error.
    noise_std = np.sqrt(predictor.rss / degrees)
    errors = np.linalg.pinv(fitted.triangle, rcond=SMALLEST_SEEN) * noise_std
    errors_of_m = errors[: double.order]
    errors_of_n = errors[double.order : 2 * double.order]

    mirror_images = []
    is_outside = (np.abs(zeros) > 1) & (zeros.imag >= 0)
    for zero in zeros[is_outside]:
        # Value, first and second derivative (3, B) of basis functions at the zero, from differences: they are
        # analytic outside the circle.
        step = DIFFERENCE_SHARE * (np.abs(zero) - 1)
        points = zero + step * np.arange(-1, 2)
        weights = np.array([[0, 1, 0], [-0.5, 0, 0.5], [1, -2, 1]]) / step ** np.arange(3)[:, None]
        basis = weights @ basis_response(poles, points)
        double_basis = weights @ basis_response(double, points)
        _, denominator_slope, denominator_curvature = basis @ predictor.denominator.coefficients
        numerator, numerator_slope, _ = basis @ predictor.numerator

        # How the zero moves with each error, and the residue with it, as a share of itself.
        denominator_errors = -double_basis @ errors_of_m
        numerator_errors = double_basis @ errors_of_n
        zero_moves = -denominator_errors[0] / denominator_slope
        numerator_moves = numerator_errors[0] + numerator_slope * zero_moves
        slope_moves = denominator_errors[1] + denominator_curvature * zero_moves
        residue_moves = numerator_moves / numerator - slope_moves / denominator_slope

        growth = float(np.log(np.abs(zero)))
        growth_std = float(np.linalg.norm((zero_moves / zero).real))
        least_growth = max(LEAST_DEVIATIONS * growth_std, LEAST_TIME_CONSTANTS / data.longest)
        residue_is_sure = LEAST_DEVIATIONS * np.linalg.norm(residue_moves) < 1
        if growth > least_growth and residue_is_sure:
            mirror_images.append(1 / zero.conjugate())
    return _poles(np.array(mirror_images, dtype=np.complex128))
