"""One case: rig, experiments, hidden effects sized to a wanted gap, records, and the answer."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, TypeVar

import numpy as np

from validation.blind.inputs import Planned, plan_experiments
from validation.blind.rigs import Rig, draw_rig, draw_tolerances, log_uniform, rounded, stated
from validation.blind.sizes import NOT_TOGETHER, PARAMETRIC, Sizable, Table, sizable
from validation.blind.truth import LISTED, UNLISTED, Clean, OutOfBoundsError, Real, Truth

S = TypeVar("S", bound=str)
Sort = Literal["none", "faint", "clear", "pair", "unlisted"]
# Sorts of cases.
SORTS: tuple[Sort, ...] = ("none", "faint", "clear", "pair", "unlisted")
# Shares of a set of cases. The sets this resembles say nothing about the next one's mix; nor does this.
SHARES: dict[Sort, float] = {"none": 0.25, "clear": 0.25, "faint": 0.17, "pair": 0.17, "unlisted": 0.16}
# Wanted largest gap over the noise.
RANGES: dict[Sort, tuple[float, float]] = {
    "faint": (0.3, 1.5),
    "clear": (3.0, 20.0),
    "pair": (2.5, 12.0),
    "unlisted": (3.0, 20.0),
}
# A parametric effect among uncertain nominals is this many tolerances large.
_TOLERANCES = (4.0, 8.0)
# Distance from the wanted gap, in its logarithm, that is close enough. Chosen: the size is drawn anyway.
_CLOSE_ENOUGH = 0.12
# Largest gap in records of the fit over that in held-out ones, at least.
_SHARE_IN_ESTIMATION = 0.25
# Draws of a rig and partners until a case is given up.
_TRIES = 40


@dataclass(frozen=True, eq=False)
class Record:
    """A planned experiment as it ran.

    Attributes
    ----------
    plan : Planned
    voltage_V : (T,) array
        As commanded.
    measured : (T, 2) array
        Hub angle and tip, with noise, in the digits of the file.
    ratio, rms : (2,) arrays
        Rms of the gap of each output, over its noise and in its unit.
    before, after : (T, 2) arrays
        Residuals over the noise, of the true rig without the effects and with them.
    """

    plan: Planned
    voltage_V: Real
    measured: Real
    ratio: Real
    rms: Real
    before: Real
    after: Real


@dataclass(frozen=True, eq=False)
class BlindCase:
    """What is shown (stated rig, tolerances, records) and what is sealed (answer)."""

    stated: Rig
    tolerances: dict[str, float]
    records: tuple[Record, ...]
    answer: dict[str, Any]


def sorts_of(shares: Mapping[S, float], n_cases: int, only: S | None, slack: float = 0.0) -> list[S]:
    """Sorts of the cases: each as often as its share, by largest remainders, so that it holds for few too.

    slack: what a number may lack of a whole one by rounding.
    """
    if n_cases < 1:
        raise ValueError(f"the number of cases must be at least 1; got {n_cases}")
    mix = shares if only is None else {only: 1.0}
    wanted = {sort: share * n_cases + slack for sort, share in mix.items()}
    sorts = [sort for sort, number in wanted.items() for _ in range(int(number))]
    return sorts + sorted(wanted, key=lambda sort: -(wanted[sort] % 1))[: n_cases - len(sorts)]


def schedule(
    n_cases: int, rng: np.random.Generator, only: Sort | None = None
) -> list[tuple[Sort, bool, str]]:
    """(sort, exact nominal?, first effect) of every case; every effect comes before one comes twice.

    only: nothing but cases of this sort.
    """
    decks: dict[str, list[str]] = {}
    plan = []
    for k, sort in enumerate(sorts_of(SHARES, n_cases, only)):
        names = UNLISTED if sort == "unlisted" else LISTED
        deck = decks.setdefault(sort, [])
        if not deck:
            deck += [names[i] for i in rng.permutation(len(names))]
        plan.append((sort, k % 2 == 0, "" if sort == "none" else deck.pop()))
    return [plan[i] for i in rng.permutation(n_cases)]


def make_case(sort: Sort, exact: bool, first_effect: str, rng: np.random.Generator) -> BlindCase:
    """Draw rigs, partners and sizes until the gap is as wanted.

    Raises ValueError if forty draws do not suffice.
    """
    pool = UNLISTED if sort == "unlisted" else LISTED
    for attempt in range(_TRIES):
        rig = draw_rig(rng)
        tolerances = {} if exact else draw_tolerances(rng)
        # An effect that cannot be of the wanted size on any of these rigs gives way to another one.
        name = first_effect if attempt < _TRIES // 4 else str(rng.choice(pool))
        try:
            plans = plan_experiments(Truth(rig), rng)
            effects = _effects(sort, name, pool, rig, plans, tolerances, rng)
            if effects is None:
                continue
            records = _run(rig, effects, plans, rng)
            if not _seen_where_fitted(records):
                continue
        except OutOfBoundsError:
            continue
        shown = stated(rig, tolerances, rng) if tolerances else rig
        return BlindCase(shown, tolerances, records, _answer(sort, rig, tolerances, effects, records))
    raise ValueError(f"no rig found on which {first_effect or sort} has the wanted size")


def _seen_where_fitted(records: tuple[Record, ...]) -> bool:
    """A cause that only held-out records show cannot be found in the others."""
    largest = dict.fromkeys(("estimation", "held_out"), 0.0)
    for record in records:
        role = record.plan.role
        largest[role] = max(largest[role], float(np.max(record.ratio)))
    return largest["estimation"] >= _SHARE_IN_ESTIMATION * largest["held_out"]


def _effects(
    sort: Sort,
    name: str,
    pool: tuple[str, ...],
    rig: Rig,
    plans: tuple[Planned, ...],
    tolerances: dict[str, float],
    rng: np.random.Generator,
) -> list[Table] | None:
    """Effects that a case hides, sized to the wanted gap; None where one of them cannot have its size."""
    if sort == "none":
        return []
    names = [name]
    if sort == "pair":
        partners = [n for n in pool if n != name and {n, name} not in NOT_TOGETHER]
        names.append(str(rng.choice(partners)))
    low, high = RANGES[sort]
    effects = []
    for effect_name in names:
        wanted = log_uniform(rng, low, high)
        open_size = sizable(effect_name, rig, plans, rng)
        if tolerances and effect_name in PARAMETRIC:
            entry = _many_tolerances(effect_name, open_size, rig, plans, tolerances, (low, high), rng)
        else:
            # At its largest size an effect may stay below the wanted gap, but for a faint one.
            entry = _sized(open_size, rig, plans, wanted, low if sort != "faint" else wanted)
        if entry is None:
            return None
        effects.append(entry)
    return effects


def _sized(
    open_size: Sizable, rig: Rig, plans: tuple[Planned, ...], wanted: float, enough: float
) -> Table | None:
    """The effect at which the largest gap ratio is as wanted (secant in logarithms), or at least enough."""
    nominal = _Nominal(rig, plans)
    measured: list[tuple[float, float]] = []
    size = open_size.first
    for _ in range(9):
        ratio = nominal.largest_ratio([open_size.at(size)])
        measured.append((float(np.log(size)), float(np.log(max(ratio, 1e-6)))))
        miss = float(np.log(wanted)) - measured[-1][1]
        if abs(miss) < _CLOSE_ENOUGH or (size >= open_size.largest and ratio >= enough):
            return open_size.at(size)
        if size >= open_size.largest and miss > 0:
            return None
        slope = 1.0
        if len(measured) > 1:
            (x0, y0), (x1, y1) = measured[-2:]
            slope = (y1 - y0) / (x1 - x0) if x1 != x0 else 1.0
        step = np.clip(miss / np.clip(slope, 0.3, 4.0), -3.0, 2.0)
        size = float(min(np.exp(measured[-1][0] + step), open_size.largest))
    return None


def _many_tolerances(
    name: str,
    open_size: Sizable,
    rig: Rig,
    plans: tuple[Planned, ...],
    tolerances: dict[str, float],
    bounds: tuple[float, float],
    rng: np.random.Generator,
) -> Table | None:
    """A parametric effect several tolerances large, if its gap then lies between the bounds."""
    spread = float(np.sqrt(sum(tolerances[key] ** 2 for key in PARAMETRIC[name])))
    entry = open_size.at(spread * rng.uniform(*_TOLERANCES))
    ratio = _Nominal(rig, plans).largest_ratio([entry])
    return entry if bounds[0] <= ratio <= 2 * bounds[1] else None


class _Nominal:
    """Records of the rig without effects, kept while sizes are tried."""

    def __init__(self, rig: Rig, plans: Sequence[Planned]) -> None:
        self.rig = rig
        self.plans = plans
        self.truth = Truth(rig)
        self._records: dict[str, Clean] = {}

    def largest_ratio(self, effects: list[Table]) -> float:
        """Largest rms of the gap over its noise, over records and outputs."""
        machine = Truth(self.rig, effects)
        largest = 0.0
        for plan in self.plans:
            record = machine.record(plan.voltage_V, plan.feedback)
            model = self.truth.record(record.voltage_V) if plan.feedback else self._open_loop(plan)
            gap = record.measured(np.zeros((record.voltage_V.size, 2))) - np.column_stack(
                [model.hub_angle_rad, model.tip_m]
            )
            largest = max(largest, float(np.max(np.sqrt(np.mean((gap / machine.noise) ** 2, axis=0)))))
        return largest

    def _open_loop(self, plan: Planned) -> Clean:
        if plan.name not in self._records:
            self._records[plan.name] = self.truth.record(plan.voltage_V)
        return self._records[plan.name]


def _run(
    rig: Rig, effects: list[Table], plans: tuple[Planned, ...], rng: np.random.Generator
) -> tuple[Record, ...]:
    """The experiments as they run on the machine with its effects, and their gaps to the machine without."""
    machine = Truth(rig, effects)
    nominal = Truth(rig)
    records = []
    for plan in plans:
        noise = rng.standard_normal((plan.voltage_V.size, 2)) * machine.noise
        clean = machine.record(plan.voltage_V, plan.feedback, noise[:, 0])
        # Six digits, as in the file: what is scored is what was shown.
        measured = np.array([[rounded(v, 6) for v in row] for row in clean.measured(noise).tolist()])
        without = nominal.record(clean.voltage_V)
        model = np.column_stack([without.hub_angle_rad, without.tip_m])
        oracle = np.column_stack([clean.hub_angle_rad, np.clip(clean.tip_m, -clean.clip_m, clean.clip_m)])
        gap = clean.measured(np.zeros_like(noise)) - model
        rms = np.sqrt(np.mean(gap**2, axis=0))
        records.append(
            Record(
                plan,
                clean.voltage_V,
                measured,
                rms / machine.noise,
                rms,
                (measured - model) / machine.noise,
                (measured - oracle) / machine.noise,
            )
        )
    return tuple(records)


def _answer(
    sort: Sort, rig: Rig, tolerances: dict[str, float], effects: list[Table], records: tuple[Record, ...]
) -> dict[str, Any]:
    """The label of a case: as the answer files of labelled cases, and what only a sealed label needs."""
    largest = max(float(np.max(record.ratio)) for record in records)
    unlisted = sort == "unlisted"
    verdict = "none"
    severity = "none"
    if effects:
        verdict = "unknown" if unlisted else "effect"
        severity = "clear" if largest >= 3 else "subtle"
    answer: dict[str, Any] = {
        "verdict": verdict,
        "severity": severity,
        "max_ratio": round(largest, 3),
        "sort": sort,
        "nominal": "uncertain" if tolerances else "exact",
        "effects": [
            {"name": e["name"], "parameters": {k: v for k, v in e.items() if k != "name"}} for e in effects
        ]
        if not unlisted
        else [],
        "unlisted": effects if unlisted else [],
    }
    pooled = {}
    for role in ("estimation", "held_out"):
        mine = [r for r in records if r.plan.role == role]
        pooled[f"{role}_gap_before"] = _pooled([r.before for r in mine])
        pooled[f"{role}_gap_after_oracle"] = _pooled([r.after for r in mine])
    answer["pooled_gap"] = pooled
    answer["experiments"] = {
        r.plan.name: {
            "hub_ratio": round(float(r.ratio[0]), 3),
            "tip_ratio": round(float(r.ratio[1]), 3),
            "hub_rms_rad": rounded(float(r.rms[0])),
            "tip_rms_m": rounded(float(r.rms[1])),
        }
        for r in records
    }
    answer["true_rig"] = rig
    return answer


def _pooled(parts: list[Real]) -> float:
    return round(float(np.sqrt(np.mean(np.concatenate([p.ravel() for p in parts]) ** 2))), 4)
