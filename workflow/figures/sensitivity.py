"""Sensitivity functions: nominal, worst case over the ellipses, and what the specification allows."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from matplotlib.figure import Figure

from control_design.controllers.controller import Controller
from control_design.plants.ellipses import distance_to_minus_one, largest_disturbance_gain
from control_design.plants.plant_set import UncertainPlant
from control_design.requirement import LoopFunction
from control_design.specification import Specification
from workflow.figures import style
from workflow.figures.bands import Real
from workflow.figures.registry import drawing
from workflow.figures.subjects import RunView


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
    gain = controller.response(omega)
    distance = np.maximum(distance_to_minus_one(gain, ellipses), 1e-300)
    worst_s = 1 / distance
    centre_s = 1 / np.abs(1 + gain * ellipses.centre)
    complementary = specification.magnitude(plant, omega, LoopFunction.COMPLEMENTARY)
    tracking = specification.magnitude(plant, omega, LoopFunction.SENSITIVITY)
    effort = specification.magnitude(plant, omega, LoopFunction.EFFORT)
    performance = plant.performance_at(omega)
    worst_gs_own = largest_disturbance_gain(gain, ellipses)
    if performance is None:
        centre_gs, worst_gs, exact = np.abs(ellipses.centre) * centre_s, worst_gs_own, True
    else:
        centre_gs, worst_gs, exact = (
            np.abs(performance.centre) * centre_s,
            performance.farthest() * worst_s,
            False,
        )
    damping = specification.magnitude(plant, omega, LoopFunction.DISTURBANCE)
    centre_t = np.abs(gain * ellipses.centre) * centre_s

    def ceiling(weight: Real) -> Real:
        return np.where(weight > 0, 1 / np.where(weight > 0, weight, 1.0), np.nan)

    effort_unit = style.ratio_unit(input_unit, output_unit)
    disturbance_unit = style.ratio_unit(performance_unit or output_unit, input_unit)
    centre_ks, worst_ks = np.abs(gain) * centre_s, np.abs(gain) * worst_s
    worst_t = np.abs(gain) * worst_gs_own
    symbol, where = ("|G S|", "output") if performance is None else ("|Gp S|", "performance output")
    to_error, to_output = "reference or disturbance to error", "reference to output"
    to_command, from_input = "measurement noise to command", f"input to {where}"
    return (
        SensitivityCurve("|S|", to_error, "1", omega, centre_s, worst_s, ceiling(tracking)),
        SensitivityCurve("|K S|", to_command, effort_unit, omega, centre_ks, worst_ks, ceiling(effort)),
        SensitivityCurve("|T|", to_output, "1", omega, centre_t, worst_t, ceiling(complementary)),
        SensitivityCurve(
            symbol, from_input, disturbance_unit, omega, centre_gs, worst_gs, ceiling(damping), exact
        ),
    )


def curves_of(run: RunView, omega_rad_s: Real | None = None) -> tuple[SensitivityCurve, ...]:
    """The curves of a run, at frequencies (F,) of one's own or at those that show its loop."""
    return sensitivity_curves(
        run.plant,
        run.synthesis_or_raise.controller,
        run.config.specification,
        run.loop_grid if omega_rad_s is None else omega_rad_s,
        input_unit=run.input_unit,
        output_unit=run.output_unit,
        performance_unit="" if run.performance is None else run.performance.units[1],
    )


@drawing("sensitivities")
def draw_run(run: RunView) -> Figure:
    """Closed-loop gains of a run, its first lightly damped modes marked."""
    modes = enumerate(run.control.light[:4], 1)
    marks = [(mode.omega_rad_s, f"mode {number}") for number, (_, mode) in modes]
    return draw_sensitivities(curves_of(run), level=run.level, marks=marks)


def draw_sensitivities(
    curves: Sequence[SensitivityCurve], *, level: float, marks: Sequence[tuple[float, str]] = ()
) -> Figure:
    """One panel per closed-loop gain; `marks` are frequencies [rad/s] with a word, e.g. the first mode."""
    with style.house_style():
        rows = -(-len(curves) // 2)
        figure = style.new_figure(2.7 * rows + 0.8)
        grid = figure.subplots(rows, 2, squeeze=False, sharex=True)
        for axes in grid.ravel()[len(curves) :]:
            axes.set_visible(False)
        for axes, curve in zip(grid.ravel(), curves, strict=False):
            finite = np.where(np.isfinite(curve.worst) & (curve.worst < 1e200), curve.worst, np.nan)
            axes.fill_between(curve.omega_rad_s, curve.nominal, finite, **style.BAND)
            axes.plot(
                curve.omega_rad_s,
                finite,
                color=style.UNCERTAIN,
                lw=1.2,
                label=f"over the {100 * level:.4g} % ellipses",
            )
            axes.plot(
                curve.omega_rad_s, curve.nominal, **style.PREDICTED_LINE, label="nominal (ellipse centres)"
            )
            if np.any(np.isfinite(curve.limit)):
                axes.plot(
                    curve.omega_rad_s, curve.limit, **style.LIMIT_LINE, label="specification: stay below"
                )
            axes.set_xscale("log")
            axes.set_yscale("log")
            note = "" if curve.exact else " (band: upper bound)"
            axes.set_title(f"{curve.symbol}: {curve.meaning}{note}", fontsize=9.5)
            axes.set_ylabel(f"{curve.symbol} [{style.plain(curve.unit, 16)}]")
            axes.set_ylim(*_range(curve))
            axes.set_xlim(curve.omega_rad_s[0], curve.omega_rad_s[-1])
            for omega, word in marks:
                if curve.omega_rad_s[0] < omega < curve.omega_rad_s[-1]:
                    axes.axvline(omega, color="#888888", lw=0.8, ls=":")
                    style.tag_below(axes, omega, word)
        for axes in grid[-1]:
            axes.set_xlabel("frequency [rad/s]")
        figure.align_ylabels()
        style.finish(figure, grid.ravel()[: len(curves)], columns=4)
    return figure


def _range(curve: SensitivityCurve) -> tuple[float, float]:
    """At most six decades below the top, so that an integrator does not flatten everything else."""
    parts = [curve.nominal, curve.worst, curve.limit[np.isfinite(curve.limit)]]
    values = np.concatenate([part[np.isfinite(part) & (part > 0) & (part < 1e200)] for part in parts])
    if not values.size:
        return 0.1, 10.0
    top = 2.0 * min(values.max(), 300 * max(float(np.median(curve.nominal)), float(curve.nominal.max())))
    return max(float(values.min()) / 1.5, top * 1e-6), float(top)
