"""Fig. 1: the error surface of a second-order resonant system, its minima counted, and DIRECT on it.

The paper shows the surface in one window and says that a local search will not do. Here minima are counted on
grids of growing fineness, those at the window's border apart from those inside (a valley that leaves the
window has its lowest point at the border, and that is no minimum), and every border point is followed
downhill. Then every DIRECT variant searches from the paper's raw box and from our logarithmic coordinates.
"""

from __future__ import annotations

import typing
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.signal import cont2discrete, lfilter

from ident.basis.model import GobfModel
from ident.basis.options import Algorithm, IdentOptions
from ident.basis.poles import Poles
from ident.data.arrays import RealArray
from ident.data.record import Record
from ident.fit.least_squares import fit
from ident.fit.problem import PoleProblem
from ident.fit.refinement import refine
from ident.fit.regression import prepare
from ident.one_input import identify
from ident.search.direct import minimise
from ident.search.error_surface import ErrorSurface, error_surface
from ident.search.pole_search import PoleSearch
from plant.excitation import prbs
from validation.paper.machines import EXAMPLE_SAMPLES, SNR_DB, SimulationExample
from validation.paper.settings import DT_S, N_PAIRS, N_REAL, PaperSettings
from workflow.engine.randomness import stage_rng

# Variants of DIRECT that are compared.
VARIANTS: tuple[Algorithm, ...] = tuple(name for name in typing.get_args(Algorithm) if "DIRECT" in name)
# Coordinates of the search that are compared.
COORDINATES: tuple[typing.Literal["raw", "log"], ...] = ("raw", "log")

# The window of the paper's Fig. 1. Its axis says gamma_1 from -1 to -0.9988: that is Wahlberg's -gamma.
BETA_WINDOW = (0.98, 1.0)
GAMMA_WINDOW = (0.9988, 1.0)
# A resonance in the middle of that window.
RESONANCE_RAD_S = 28.0
# Its damping ratio.
RESONANCE_ZETA = 0.002
# The output's variance: the top of the figure's J axis.
OUTPUT_VARIANCE = 0.04
# Two ends of descents are one minimum, and a search succeeded, when their cost agrees to this fraction.
SAME_COST = 2e-3


@dataclass(frozen=True)
class MinimaCount:
    """Grid points lower than all neighbours, on an n x n grid: inside the window, and at its border."""

    n_points: int
    inside: int
    border: int


@dataclass(frozen=True, eq=False)
class SearchShares:
    """Searches (of `searches`) that end in the global minimum after one descent from DIRECT's best point.

    hits[(problem, coordinates, variant)]; problems are "order 2" and "order 4".
    """

    searches: int
    evaluations: int
    hits: dict[tuple[str, str, str], int]

    def share_percent(self, problem: str, coordinates: str) -> float:
        """Over all variants together."""
        chosen = [n for (p, c, _), n in self.hits.items() if p == problem and c == coordinates]
        return 100.0 * sum(chosen) / (len(chosen) * self.searches)


@dataclass(frozen=True, eq=False)
class SurfaceStudy:
    """What Fig. 1 shows.

    `descended` of the window's border minima, followed downhill, reach the global minimum in `reached` cases;
    mean_square_minimum is its J.
    """

    surface: ErrorSurface
    counts: tuple[MinimaCount, ...]
    descended: int
    reached: int
    mean_square_minimum: float
    pole: tuple[float, float]
    shares: SearchShares


def resonant_record(rng: np.random.Generator) -> Record:
    """PRBS on w^2 / (s^2 + 2 z w s + w^2), held input, output of variance 0.04, white noise at 30 dB."""
    square = RESONANCE_RAD_S**2
    system = np.array([square]), np.array([1.0, 2 * RESONANCE_ZETA * RESONANCE_RAD_S, square])
    numerator, denominator, _ = cont2discrete(system, DT_S)
    signs = prbs(11, 1, 1.0, EXAMPLE_SAMPLES, rng)
    y = lfilter(numerator[0], denominator, signs)
    scale = np.sqrt(OUTPUT_VARIANCE) / np.std(y)
    noise = np.sqrt(OUTPUT_VARIANCE) * 10 ** (-SNR_DB / 20) * rng.standard_normal(y.size)
    return Record(scale * signs[:, None], (scale * y + noise)[:, None], DT_S, name="resonance")


def true_pair() -> Poles:
    """The resonance as a discrete pole pair."""
    return Poles.from_continuous(omega_rad_s=[RESONANCE_RAD_S], zeta=[RESONANCE_ZETA], dt_s=DT_S)


def study_surface(settings: PaperSettings, report: Callable[[float, str], None]) -> SurfaceStudy:
    """Surface, counts, descents, searches."""
    record = resonant_record(stage_rng(settings.seed, "paper", "surface"))
    structure = _from_rest(0, 1).structure()
    model = GobfModel(true_pair(), np.zeros(2), DT_S)

    def on_grid(n: int) -> ErrorSurface:
        # The circle itself is no stable pole; the last grid line stands a millionth inside.
        beta = np.linspace(BETA_WINDOW[0], BETA_WINDOW[1] - 1e-6, n)
        gamma = np.linspace(GAMMA_WINDOW[0], GAMMA_WINDOW[1] - 1e-6, n)
        return error_surface([record], model, structure, coordinates="raw", first=beta, second=gamma)

    surface = on_grid(settings.surface_points)
    counts = []
    for index, n in enumerate(settings.grids):
        report(0.3 * index / len(settings.grids), f"minima on {n} x {n} points")
        counts.append(_count(surface if n == settings.surface_points else on_grid(n)))
    search = PoleSearch(prepare([record], structure), _from_rest(0, 1))
    best = search.descend(true_pair(), "truth")
    starts = [point for point in surface.local_minima() if not _inside(surface, *point)]
    ends = [
        refine(search.data, _pair(surface.first[i], surface.second[j]), search.bounds).rss for i, j in starts
    ]
    shares = count_hits(settings, lambda fraction, text: report(0.3 + 0.7 * fraction, text))
    gamma = abs(complex(true_pair().pairs[0])) ** 2
    return SurfaceStudy(
        surface=surface,
        counts=tuple(counts),
        descended=len(ends),
        reached=sum(end <= best.rss * (1 + SAME_COST) for end in ends),
        mean_square_minimum=best.rss / record.n_samples,
        pole=(float(2 * true_pair().pairs[0].real / (1 + gamma)), gamma),
        shares=shares,
    )


def _count(surface: ErrorSurface) -> MinimaCount:
    minima = surface.local_minima()
    inside = sum(_inside(surface, i, j) for i, j in minima)
    return MinimaCount(surface.first.size, inside, len(minima) - inside)


def _inside(surface: ErrorSurface, i: int, j: int) -> bool:
    return 0 < i < surface.first.size - 1 and 0 < j < surface.second.size - 1


def _pair(beta: float, gamma: float) -> Poles:
    real = beta * (1 + gamma) / 2
    return Poles([], [complex(real, np.sqrt(gamma - real**2))])  # type: ignore[arg-type]


def _from_rest(n_real: int, n_pairs: int) -> IdentOptions:
    """The paper's regression (21): basis functions and nothing else."""
    return IdentOptions(n_real=n_real, n_pairs=n_pairs, estimate_offset=False, estimate_initial_state=False)


def count_hits(settings: PaperSettings, report: Callable[[float, str], None]) -> SearchShares:
    """Every variant from both boxes on `searches` records of each problem."""
    hits: dict[tuple[str, str, str], int] = {}
    example = SimulationExample()
    for number in range(settings.searches):
        report(number / settings.searches, f"DIRECT variants, record {number + 1}")
        rng = stage_rng(settings.seed, "paper", "searches", str(number))
        problems = {
            "order 2": (resonant_record(rng), _from_rest(0, 1)),
            "order 4": (example.trial(rng).fitted, _from_rest(N_REAL, N_PAIRS)),
        }
        for problem, (record, options) in problems.items():
            costs = _costs(record, options, settings.evaluations)
            best = min(*costs.values(), identify([record], options).rss)
            for (coordinates, variant), cost in costs.items():
                key = problem, coordinates, variant
                hits.setdefault(key, 0)
                if cost <= best * (1 + SAME_COST):
                    hits[key] += 1
    return SearchShares(settings.searches, settings.evaluations, hits)


def _costs(record: Record, options: IdentOptions, evaluations: int) -> dict[tuple[str, str], float]:
    """Cost at the end of the descent from DIRECT's best point, by coordinates and variant."""
    data = prepare([record], options.structure())
    costs: dict[tuple[str, str], float] = {}
    for coordinates in COORDINATES:
        for variant in VARIANTS:
            poles = direct_alone(PoleSearch(data, _searched(options, coordinates, variant)), evaluations)
            # Downhill with the same bounds for both: what differs is where the search was made.
            costs[coordinates, variant] = refine(data, poles, PoleSearch(data, options).bounds).rss
    return costs


def direct_alone(search: PoleSearch[PoleProblem], evaluations: int) -> Poles:
    """The paper's search: the best point DIRECT looked at; no descent."""
    options = search.options
    space = search.space(options.n_real or 0, options.n_pairs or 0)
    cost = search.data.candidate_cost(space, search.fixed, search.fixed)
    points, costs = minimise(cost.log, space.dimension, options.algorithm, evaluations)
    return space.poles(points[int(np.argmin(costs))])


def paper_recipe(record: Record, evaluations: int) -> GobfModel:
    """GOBF as the paper found it: DIRECT in the raw box (x, beta, gamma), least squares there, no descent."""
    options = _searched(_from_rest(N_REAL, N_PAIRS), "raw", "GN_DIRECT")
    data = prepare([record], options.structure())
    poles = direct_alone(PoleSearch(data, options), evaluations)
    return GobfModel(
        poles,
        fit(data, poles).coefficients[0],
        record.dt_s,
        input_name=record.input_names[0],
        output_name=record.output_names[0],
    )


def _searched(
    options: IdentOptions, coordinates: typing.Literal["raw", "log"], variant: Algorithm
) -> IdentOptions:
    """Options with other coordinates and another algorithm of the search."""
    return options.model_copy(update={"coordinates": coordinates, "algorithm": variant})


def slices(surface: ErrorSurface, gammas: Sequence[float]) -> list[tuple[float, RealArray]]:
    """(gamma, J over beta) on the grid lines nearest to the given gammas."""
    slices_at = []
    for gamma in gammas:
        j = int(np.argmin(np.abs(surface.second - gamma)))
        slices_at.append((float(surface.second[j]), surface.mean_square[:, j]))
    return slices_at


def minima_along(values: RealArray) -> int:
    """Interior local minima of a sampled curve."""
    inner = values[1:-1]
    return int(np.count_nonzero((inner < values[:-2]) & (inner < values[2:])))
