"""Sensitivity functions: nominal, worst case over the ellipses, and what the specification allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import distance_to_minus_one, largest_disturbance_gain
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import Specification
from control_design.specification.requirement import LoopFunction
from workflow.figures import style
from workflow.figures.bands import Real
from workflow.figures.description import Panel, Picture, small_multiples
from workflow.figures.subjects import RunView
from workflow.text.formats import share


@dataclass(frozen=True, eq=False)
class SensitivityCurve:
    """One closed-loop gain over frequency: nominal and worst (F,), limit (F,) with nan where nothing is asked
    for.

    exact: whether `worst` is the exact maximum over the ellipse or an upper bound of it.
    """

    symbol: str
    meaning: str
    unit: str
    omega_rad_s: Real
    nominal: Real
    worst: Real
    limit: Real
    exact: bool = True


def sensitivity_curves(
    plant: UncertainPlant,
    controller: Controller,
    specification: Specification,
    omega_rad_s: Real,
    *,
    input_unit: str = "",
    output_unit: str = "",
    performance_unit: str = "",
) -> tuple[SensitivityCurve, ...]:
    """|S|, |KS|, |T| and |Gp S| at omega (F,), which must not hold 0.

    Exact over the ellipses, but for |Gp S| of a performance channel: there the largest |Gp| times the largest
    |S|, which is an upper bound because the two ellipses are not independent.
    """
    omega = np.asarray(omega_rad_s, dtype=np.float64)
    ellipses = plant.at(omega)
    performance = None if plant.performance is None else plant.performance.at(omega)
    gain = controller.response(omega)
    nominal = 1 / np.abs(1 + gain * ellipses.centre)
    worst = 1 / np.maximum(distance_to_minus_one(gain, ellipses), 1e-300)
    worst_gs = largest_disturbance_gain(gain, ellipses)

    def curve(
        function: LoopFunction, symbol: str, meaning: str, unit: str, centre: Real, high: Real
    ) -> SensitivityCurve:
        weight = specification.magnitude(plant, omega, function)
        limit = np.divide(1.0, weight, out=np.full_like(weight, np.nan), where=weight > 0)
        exact = function is not LoopFunction.DISTURBANCE or performance is None
        return SensitivityCurve(symbol, meaning, unit, omega, centre, high, limit, exact)

    size = np.abs(gain)
    effort_unit = style.ratio_unit(input_unit, output_unit)
    disturbance_unit = style.ratio_unit(performance_unit or output_unit, input_unit)
    if performance is None:
        symbol = "|G S|"
        where = "output"
        disturbance = np.abs(ellipses.centre) * nominal, worst_gs
    else:
        symbol = "|Gp S|"
        where = "performance output"
        disturbance = np.abs(performance.centre) * nominal, performance.farthest() * worst
    to_error = "reference or disturbance to error"
    to_command = "measurement noise to command"
    through = np.abs(gain * ellipses.centre) * nominal, size * worst_gs
    return (
        curve(LoopFunction.SENSITIVITY, "|S|", to_error, "1", nominal, worst),
        curve(LoopFunction.EFFORT, "|K S|", to_command, effort_unit, size * nominal, size * worst),
        curve(LoopFunction.COMPLEMENTARY, "|T|", "reference to output", "1", *through),
        curve(LoopFunction.DISTURBANCE, symbol, f"input to {where}", disturbance_unit, *disturbance),
    )


def curves_of(run: RunView, omega_rad_s: Real | None = None) -> tuple[SensitivityCurve, ...]:
    """The curves of a run, at frequencies (F,) of one's own or at those that show its loop."""
    return sensitivity_curves(
        run.plant,
        run.controller,
        run.specification,
        run.loop_grid if omega_rad_s is None else omega_rad_s,
        input_unit=run.input_unit,
        output_unit=run.output_unit,
        performance_unit="" if run.performance is None else run.performance.units[1],
    )


@style.drawing("sensitivities")
def draw_run(run: RunView) -> Picture:
    """Closed-loop gains of a run, its first lightly damped modes marked."""
    modes = enumerate(run.control.light[:4], 1)
    marks = [(mode.omega_rad_s, f"mode {number}") for number, (_, mode) in modes]
    return draw_sensitivities(curves_of(run), level=run.level, marks=marks)


def draw_sensitivities(
    curves: Sequence[SensitivityCurve], *, level: float, marks: Sequence[tuple[float, str]] = ()
) -> Picture:
    """One panel per closed-loop gain; `marks` are frequencies [rad/s] with a word, e.g. the first mode."""
    picture, panels = small_multiples(len(curves), 2, 2.7, 0.8, sharex=True)
    for panel, curve in zip(panels, curves, strict=True):
        draw_curve(panel, curve, level)
        note = "" if curve.exact else " (band: upper bound)"
        panel.set_title(f"{curve.symbol}: {curve.meaning}{note}", size=9.5)
        for at, word in marks:
            if curve.omega_rad_s[0] < at < curve.omega_rad_s[-1]:
                style.tag_below(panel, at, word)
    for panel in panels[-2:]:
        panel.set(xlabel="frequency [rad/s]")
    return picture


def draw_curve(panel: Panel, curve: SensitivityCurve, level: float) -> None:
    """Draw a closed-loop gain over frequency: nominal, worst case over the ellipses, and limit.

    level: probability of the ellipses, for the legend. A worst case that is not finite leaves a gap.
    """
    omega = curve.omega_rad_s
    finite = np.where(np.isfinite(curve.worst) & (curve.worst < 1e200), curve.worst, np.nan)
    panel.fill_between(omega, curve.nominal, finite, **style.BAND)
    panel.plot(omega, finite, color=style.UNCERTAIN, lw=1.2, label=f"over the {share(level)} ellipses")
    panel.plot(omega, curve.nominal, **style.PREDICTED_LINE, label="nominal")
    if np.any(np.isfinite(curve.limit)):
        panel.plot(omega, curve.limit, **style.LIMIT_LINE, label="specification: stay below")
    panel.set(xscale="log", yscale="log", xlim=(omega[0], omega[-1]), ylim=_range(curve))
    panel.set(ylabel=f"{curve.symbol} [{style.plain(curve.unit, 16)}]")


def _range(curve: SensitivityCurve) -> tuple[float, float]:
    """At most six decades below the top, so that an integrator does not flatten everything else."""
    values = np.concatenate([curve.nominal, curve.worst, curve.limit])
    can_be_drawn = np.isfinite(values) & (values > 0) & (values < 1e200)
    values = values[can_be_drawn]
    if not values.size:
        return 0.1, 10.0
    top = 2.0 * min(values.max(), 300 * float(curve.nominal.max()))
    return max(float(values.min()) / 1.5, top * 1e-6), float(top)
