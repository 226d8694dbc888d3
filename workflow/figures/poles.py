"""Pole map in the z-plane, with lines of constant damping and of constant frequency."""

from __future__ import annotations

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ident.basis.model import GobfModel
from workflow.figures import style
from workflow.figures.bands import Complex, Real

_DAMPINGS = (0.02, 0.1, 0.3, 0.6)
_HOLLOW: dict[str, Any] = {"ls": "none", "mfc": "none"}


@style.drawing("poles")
def draw_poles(
    model: GobfModel, name: str = "", closed_loop: Complex | None = None, zeros: Complex | None = None
) -> Figure:
    """Poles of a model, its known ones at z = 1, those of a loop around it (n,): whole circle and near z = 1.

    zeros (k,): the model's, drawn as circles where given.
    """
    poles = np.concatenate([model.stable_poles.values, model.unstable_poles])
    figure, (whole, near) = style.panels(5.6, 1, 2)
    turn = np.linspace(0, 2 * np.pi, 361)
    angle = np.concatenate([np.linspace(0, 0.3, 120), np.linspace(0.301, np.pi, 160)])
    for axes in (whole, near):
        axes.plot(np.cos(turn), np.sin(turn), color="#333333", lw=1.0)
        for zeta in _DAMPINGS:
            z = _constant_damping(zeta, angle)
            for side in (z, z.conj()):
                axes.plot(side.real, side.imag, color="#b5b5b5", lw=0.7, ls=(0, (3, 2)))
        if closed_loop is not None:
            squares = {"marker": "s", "ms": 5.5, "mec": style.PREDICTED, "mew": 1.4}
            label = "closed loop, nominal plant"
            axes.plot(closed_loop.real, closed_loop.imag, **_HOLLOW, **squares, label=label)
        if zeros is not None:
            circles = {"marker": "o", "ms": 7, "mec": style.MEASURED, "mew": 1.3}
            axes.plot(zeros.real, zeros.imag, **_HOLLOW, **circles, label="zeros")
        crosses = {"ls": "none", "marker": "x", "ms": 7, "mew": 1.8, "color": style.MODEL}
        axes.plot(poles.real, poles.imag, **crosses, label="identified basis poles")
        if model.integrators:
            label = f"integrator (x {model.integrators})"
            axes.plot([1], [0], ls="none", marker="*", ms=10, color=style.REFERENCE, label=label)
        axes.set_aspect("equal")
        axes.set(xlabel="real part of z [1]", ylabel="imaginary part of z [1]")
    whole.set(xlim=(-1.1, 1.1), ylim=(-1.1, 1.1))
    what = "Poles" if zeros is None else "Poles, zeros"
    where = f": {style.plain(name, 13)}" if name else ""
    whole.set_title(f"{what}{where} (sampled every {model.dt_s * 1e3:.4g} ms)")
    corner = _near_corner(poles)
    near.set(xlim=(1 - corner, 1 + 0.12 * corner), ylim=(-0.12 * corner, corner))
    near.set_title("Near z = 1 (dashed: damping, dotted: frequency)")
    _frequency_arcs(near, corner, model.dt_s)
    _name_dampings(near, corner)
    return figure


def _near_corner(poles: Complex) -> float:
    """Side of the close-up: room around the slowest lightly damped pair, else around the slowest poles."""
    upper = poles[(poles.imag > 1e-9) & (np.abs(poles) > 0.05)]
    log = np.log(upper)
    light = np.abs(upper[-log.real < 0.4 * np.abs(log)] - 1.0)
    away = np.abs(poles - 1.0)
    away = light if light.size else away[away > 1e-9]
    return float(np.clip(1.7 * away.min(), 0.02, 0.9)) if away.size else 0.5


def _constant_damping(zeta: float, angle: Real) -> Complex:
    return np.asarray(np.exp((-zeta / np.sqrt(1 - zeta**2) + 1j) * angle))


def _name_dampings(axes: Axes, corner: float) -> None:
    """Damping ratios where their lines leave the close-up."""
    angle = np.linspace(1e-4, np.pi, 6000)
    for number, zeta in enumerate(_DAMPINGS):
        z = _constant_damping(zeta, angle)
        # Neighbouring lines lie close together: their labels stand at two heights.
        share = 0.93 - 0.07 * (number % 2)
        inside = (z.real > 1 - 0.93 * corner) & (z.imag < share * corner) & (z.imag >= 0)
        leaves = int(np.argmin(inside)) if not inside.all() else angle.size - 1
        _label(axes, z[max(leaves - 1, 0)], f"{zeta:g}", fontsize=8.5, color="#555555")


def _frequency_arcs(axes: Axes, corner: float, dt_s: float) -> None:
    """Lines of constant undamped frequency at round numbers of rad/s."""
    most = corner / dt_s / 3
    power = 10.0 ** np.floor(np.log10(most))
    step = float(max(step for step in (1, 2, 5) if step * power <= most * (1 + 1e-12)) * power)
    zeta = np.linspace(0, 0.999, 200)
    for omega in (step, 2 * step, 3 * step):
        z = np.exp((-zeta + 1j * np.sqrt(1 - zeta**2)) * omega * dt_s)
        axes.plot(z.real, z.imag, color="#b5b5b5", lw=0.7, ls=(0, (1, 2)))
        _label(axes, z[int(0.78 * zeta.size)], f"{omega:.4g} rad/s", fontsize=8, color="#666666")


def _label(axes: Axes, z: complex, text: str, **look: Any) -> None:
    box = {"facecolor": "white", "lw": 0, "pad": 0.7, "alpha": 0.85}
    axes.annotate(text, (z.real, z.imag), ha="center", va="center", bbox=box, **look)
