"""Pole-zero map in the z-plane, with lines of constant damping and of constant frequency."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator

from ident.basis.model import GobfModel
from workflow.figures import style
from workflow.figures.bands import Complex
from workflow.tasks.results import Intervals
from workflow.text.formats import share

_DAMPINGS = (0.02, 0.1, 0.3, 0.6)
_HOLLOW: dict[str, Any] = {"ls": "none", "mfc": "none"}


@style.drawing("poles")
def draw_poles(
    model: GobfModel,
    name: str = "",
    closed_loop: Complex | None = None,
    intervals: Intervals | None = None,
) -> Figure:
    """Poles and zeros of a model, its known poles at z = 1: whole circle and near z = 1.

    closed_loop (n,): poles of a loop around it. intervals: of the poles; the area that frequency and damping
    of a mode leave is filled.
    """
    poles, zeros = np.concatenate([model.stable_poles.values, model.unstable_poles]), model.zeros()
    figure, panels = style.panels(5.6, 1, 2)
    whole, near = panels
    corner = _near_corner(poles)
    whole.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    near.set(xlim=(1 - corner, 1 + 0.12 * corner), ylim=(-0.12 * corner, corner))
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 361))
    for axes in panels:
        axes.set(aspect="equal", xlabel="real part of z [1]", ylabel="imaginary part of z [1]")
        axes.grid(visible=False)
        axes.plot(turn.real, turn.imag, color="#333333", lw=1.0)
        _grid(axes, model.dt_s, named=axes is near)
        if intervals is not None:
            label = f"{share(intervals.level)} intervals of a pole"
            for area in _areas(intervals, model.dt_s):
                axes.fill(area.real, area.imag, **style.BAND | {"lw": 1.5}, label=label)
        for at, marker, colour, label in (
            (closed_loop, "s", style.PREDICTED, "closed loop, nominal plant"),
            (zeros, "o", style.MEASURED, "zeros"),
            (poles, "x", style.MODEL, "identified basis poles"),
        ):
            if at is not None:
                look = {"marker": marker, "ms": 6.5, "mec": colour, "mew": 1.5, "label": label}
                axes.plot(at.real, at.imag, **_HOLLOW, **look)
        if model.integrators:
            label = f"integrator (x {model.integrators})"
            axes.plot([1], [0], ls="none", marker="*", ms=10, color=style.REFERENCE, label=label)
    whole.set_title(f"Poles, zeros: {style.plain(name or 'model', 13)} ({model.dt_s * 1e3:.4g} ms)")
    near.set_title("Near z = 1 (dashed: damping, dotted: frequency)")
    return figure


def _areas(intervals: Intervals, dt_s: float) -> list[Complex]:
    """Outlines in z of what the intervals of modes and real poles leave, those that the records tell."""
    along, ones = np.linspace(0, 1, 25), np.ones(25)
    found = []
    for mode in intervals.modes:
        if mode.told:
            (w0, w1), (d0, d1) = mode.omega_rad_s, mode.damping
            omega = np.concatenate([w0 + along * (w1 - w0), w1 * ones, w1 - along * (w1 - w0), w0 * ones])
            zeta = np.concatenate([d0 * ones, d0 + along * (d1 - d0), d1 * ones, d1 - along * (d1 - d0)])
            upper = np.exp((-zeta + 1j * np.sqrt(np.maximum(1 - zeta**2, 0.0))) * omega * dt_s)
            found += [upper, upper.conj()]
    real = [np.exp(-np.array(ends) * dt_s) for ends in intervals.real_poles_per_s]
    return found + [ends.astype(np.complex128) for ends in real if np.all(np.isfinite(ends))]


def _near_corner(poles: Complex) -> float:
    """Side of the close-up: room around the slowest lightly damped pair, else around the slowest poles."""
    upper = poles[(poles.imag > 1e-9) & (np.abs(poles) > 0.05)]
    log = np.log(upper)
    light = np.abs(upper[-log.real < 0.4 * np.abs(log)] - 1.0)
    away = np.abs(poles - 1.0)
    away = light if light.size else away[away > 1e-9]
    return float(np.clip(1.7 * away.min(), 0.02, 0.9)) if away.size else 0.5


def _grid(axes: Axes, dt_s: float, *, named: bool) -> None:
    """Lines of constant damping and of constant undamped frequency [rad/s] inside the circle, as contours."""
    x, y = np.meshgrid(*(np.linspace(*ends, 150) for ends in (axes.get_xlim(), axes.get_ylim())))
    z = np.where(np.hypot(x, y) < 1, x + 1j * np.abs(y) + 1e-12j, np.nan)
    s = np.log(z) / dt_s
    rounds = MaxNLocator(5, steps=[1, 2, 5]).tick_values(0, float(np.nanmax(np.abs(s[:, :75]))))[1:4]
    for value, levels, dashes, words in (
        (-s.real / np.abs(s), _DAMPINGS, "--", "{:g}"),
        (np.abs(s), rounds, ":", "{:.4g} rad/s"),
    ):
        lines = axes.contour(x, y, value, levels, colors="#b5b5b5", linewidths=0.7, linestyles=dashes)
        if named:
            axes.clabel(lines, fmt=words.format, fontsize=8, colors="#666666")
