"""Pole-zero map in the z-plane, with lines of constant damping and of constant frequency."""

from __future__ import annotations

from typing import Any

import numpy as np

from ident.basis.model import GobfModel
from workflow.figures import style
from workflow.figures.bands import Complex
from workflow.figures.description import Panel, Picture, new_picture
from workflow.figures.ticks import linear_ticks
from workflow.tasks.results import Intervals
from workflow.text.formats import share

# Damping ratios whose lines are drawn: from a light mode of metal to an almost aperiodic pair. Chosen.
_DAMPINGS = (0.02, 0.1, 0.3, 0.6)
# Of a pole's real part times the period: e^-7 is a thousandth, where a line meets the origin.
_DECAYED = 7.0
# Where along its visible part a line bears its value: lines of small damping lie close together.
_NAMED_AT = {"0.02": 0.85, "0.1": 0.7, "0.3": 0.6}
# The same of all other lines: in their middle.
_ELSE_AT = 0.5
# Poles and zeros, so that one is seen within the other.
_HOLLOW: dict[str, Any] = {"ls": "none", "mfc": "none"}


@style.drawing("poles")
def draw_poles(
    model: GobfModel,
    name: str = "",
    closed_loop: Complex | None = None,
    intervals: Intervals | None = None,
) -> Picture:
    """Poles and zeros of a model, and its known poles at z = 1: whole circle, and near z = 1.

    Parameters
    ----------
    model : GobfModel
    name : str
        For the title.
    closed_loop : (n,) complex array, optional
        Poles of a loop around it.
    intervals : Intervals, optional
        Of its poles: the area that frequency and damping of a mode leave is filled.
    """
    poles = np.concatenate([model.stable_poles.values, model.unstable_poles])
    zeros = model.zeros()
    picture, panels = new_picture(5.6, 1, 2)
    whole, near = panels
    corner = _near_corner(poles)
    whole.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    # The axes pass through z = 1, near the edge of the enlarged view.
    margin = 0.12 * corner
    near.set(xlim=(1 - corner, 1 + margin), ylim=(-margin, corner))
    turn = np.exp(1j * np.linspace(0, 2 * np.pi, 361))
    for panel in panels:
        panel.set(equal=True, xlabel="real part of z [1]", ylabel="imaginary part of z [1]")
        panel.grid_lines = [False, False]
        panel.plot(turn.real, turn.imag, color="#333333", lw=1.0)
        _grid(panel, model.dt_s, named=panel is near)
        if intervals is not None:
            label = f"{share(intervals.level)} intervals"
            areas = [np.column_stack([area.real, area.imag]) for area in _areas(intervals, model.dt_s)]
            panel.fill(areas, **style.BAND | {"lw": 1.5}, label=label)
        for at, marker, colour, label in (
            (closed_loop, "s", style.PREDICTED, "closed loop, nominal"),
            (zeros, "o", style.MEASURED, "zeros"),
            (poles, "x", style.MODEL, "identified basis poles"),
        ):
            if at is not None:
                look = {"marker": marker, "ms": 6.5, "mec": colour, "mew": 1.5, "label": label}
                panel.plot(at.real, at.imag, **_HOLLOW, **look)
        if model.integrators:
            label = f"integrator (x {model.integrators})"
            panel.plot([1], [0], ls="none", marker="*", ms=10, color=style.REFERENCE, label=label)
    whole.set_title(f"Poles, zeros: {style.plain(name or 'model', 13)} ({model.dt_s * 1e3:.4g} ms)")
    near.set_title("Near z = 1 (dashed: damping, dotted: frequency)")
    return picture


def _areas(intervals: Intervals, dt_s: float) -> list[Complex]:
    """Outlines in z of what the intervals of modes and real poles leave, those that the records tell."""
    along = np.linspace(0, 1, 25)
    ones = np.ones(25)
    outlines = []
    for mode in intervals.modes:
        if mode.told:
            (w0, w1) = mode.omega_rad_s
            (d0, d1) = mode.damping
            # Round the rectangle of frequency and damping, side by side.
            omega_up = w0 + along * (w1 - w0)
            omega_down = w1 - along * (w1 - w0)
            zeta_up = d0 + along * (d1 - d0)
            zeta_down = d1 - along * (d1 - d0)
            omega = np.concatenate([omega_up, w1 * ones, omega_down, w0 * ones])
            zeta = np.concatenate([d0 * ones, zeta_up, d1 * ones, zeta_down])
            # An interval of the damping may reach beyond 1, where a pair is two real poles.
            turned = np.sqrt(np.maximum(1 - zeta**2, 0.0))
            upper = np.exp((-zeta + 1j * turned) * omega * dt_s)
            outlines += [upper, upper.conj()]
    real = [np.exp(-np.array(ends) * dt_s) for ends in intervals.real_poles_per_s]
    finite = [ends for ends in real if np.all(np.isfinite(ends))]
    return outlines + [ends.astype(np.complex128) for ends in finite]


def _near_corner(poles: Complex) -> float:
    """Side of the close-up: room around the slowest lightly damped pair, else around the slowest poles."""
    is_upper = (poles.imag > 1e-9) & (np.abs(poles) > 0.05)
    upper = poles[is_upper]
    log = np.log(upper)
    is_light = -log.real < 0.4 * np.abs(log)
    distances = np.abs(upper[is_light] - 1.0)
    if not distances.size:
        distances = np.abs(poles - 1.0)
        is_no_integrator = distances > 1e-9
        distances = distances[is_no_integrator]
    if not distances.size:
        return 0.5
    return float(np.clip(1.7 * distances.min(), 0.02, 0.9))


def _grid(panel: Panel, dt_s: float, *, named: bool) -> None:
    """Lines of constant damping and of constant undamped frequency [rad/s] inside the circle.

    named: with their values, where they are in view.
    """
    fastest = float(np.pi / dt_s)
    along = np.linspace(0.0, 1.0, 120)
    left, right = panel.x.limits()
    low, high = panel.y.limits()
    # The largest frequency in view decides which frequencies are round ones here.
    middle = (left + right) / 2
    corners = [complex(x, y) for x in (left, middle) for y in (low, high) if x or y]
    corner = np.array(corners)
    # Poles outside the circle have no such lines: the corner is taken back to the circle.
    distance = np.abs(corner)
    inside = np.where(distance < 1, corner, corner / np.maximum(distance, 1e-12))
    # Of a pole z, |log z| / dt is its frequency; the offset keeps z = 0 finite.
    fastest_seen = np.max(np.abs(np.log(inside + 1e-12))) / dt_s
    reach = min(fastest, float(fastest_seen))
    rounds = linear_ticks(0.0, reach, 5, (1.0, 2.0, 5.0, 10.0)).places[1:4]
    look: dict[str, Any] = {"color": "#b5b5b5", "lw": 0.7}

    # Upper halves of all lines in z, with their dashes and their values.
    lines = []
    for damping in _DAMPINGS:
        turned = np.sqrt(1 - damping**2)
        # Up to the negative real axis.
        omega = fastest / turned * along
        line = np.exp((-damping + 1j * turned) * omega * dt_s)
        lines.append((line, "--", f"{damping:g}"))
    for omega in rounds:
        not_decayed = along * omega * dt_s <= _DECAYED
        damping = along[not_decayed]
        turned = np.sqrt(1 - damping**2)
        pole = omega * dt_s * (-damping + 1j * turned)
        # Beyond the Nyquist frequency a line would come back from below the real axis.
        below_nyquist = pole.imag <= np.pi
        lines.append((np.exp(pole[below_nyquist]), ":", f"{omega:.4g} rad/s"))
    for line, dashes, words in lines:
        for half in (line, line.conj()):
            panel.plot(half.real, half.imag, ls=dashes, **look)
        if named:
            in_width = (line.real > left) & (line.real < right)
            in_height = (line.imag > max(low, 0.0)) & (line.imag < high)
            seen = np.flatnonzero(in_width & in_height)
            if seen.size:
                place = line[seen[int(_NAMED_AT.get(words, _ELSE_AT) * seen.size)]]
                panel.words(words, place.real, place.imag, horizontal="center")
