"""Pole map in the z-plane, with lines of constant damping and of constant frequency."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from workflow.figures import style
from workflow.figures.bands import Complex
from workflow.figures.registry import drawing
from workflow.figures.subjects import ChannelView

_DAMPINGS = (0.02, 0.1, 0.3, 0.6)


@drawing("poles")
def draw_channel(channel: ChannelView, with_zeros: bool = False) -> Figure:
    """Poles of a channel, with its zeros if asked for, and those of the loop around it if there is one."""
    model = channel.found.model
    return draw_poles(
        model.dt_s,
        identified=model.poles.values,
        integrators=model.integrators,
        closed_loop=channel.closed_loop,
        zeros=channel.zeros if with_zeros else None,
        name=channel.name,
    )


def draw_poles(
    dt_s: float,
    *,
    identified: Complex,
    integrators: int = 0,
    closed_loop: Complex | None = None,
    others: Sequence[tuple[str, Complex]] = (),
    zeros: Complex | None = None,
    name: str = "",
) -> Figure:
    """Identified poles (n,), known poles at z = 1, and closed-loop poles (m,), whole circle and near z = 1.

    `others` are further named sets, e.g. those of a second channel; zeros (k,) are the model's, circles.
    """
    known = np.ones(1 if integrators else 0, dtype=np.complex128)
    with style.house_style():
        figure = style.new_figure(5.6)
        whole, near = figure.subplots(1, 2)
        for axes in (whole, near):
            _damping_lines(axes)
            if closed_loop is not None:
                axes.plot(
                    closed_loop.real,
                    closed_loop.imag,
                    ls="none",
                    marker="s",
                    ms=5.5,
                    mfc="none",
                    mec=style.PREDICTED,
                    mew=1.4,
                    label="closed loop, nominal plant",
                )
            for index, (label, poles) in enumerate(others):
                axes.plot(
                    poles.real,
                    poles.imag,
                    ls="none",
                    marker="+1"[index % 2],
                    ms=8,
                    color=style.MEASURED,
                    label=style.plain(label),
                )
            if zeros is not None:
                axes.plot(
                    zeros.real,
                    zeros.imag,
                    ls="none",
                    marker="o",
                    ms=7,
                    mfc="none",
                    mec=style.MEASURED,
                    mew=1.3,
                    label="zeros",
                )
            axes.plot(
                identified.real,
                identified.imag,
                ls="none",
                marker="x",
                ms=7,
                mew=1.8,
                color=style.MODEL,
                label="identified basis poles",
            )
            if known.size:
                axes.plot(
                    [1],
                    [0],
                    ls="none",
                    marker="*",
                    ms=10,
                    color=style.REFERENCE,
                    label=f"integrator (x {integrators})",
                )
            axes.set_aspect("equal")
            axes.set_xlabel("real part of z [1]")
            axes.set_ylabel("imaginary part of z [1]")
        whole.set_xlim(-1.1, 1.1)
        whole.set_ylim(-1.1, 1.1)
        what = "Poles" if zeros is None else "Poles, zeros"
        where = f": {style.plain(name, 13)}" if name else ""
        whole.set_title(f"{what}{where} (sampled every {dt_s * 1e3:.4g} ms)")
        corner = _near_corner(np.concatenate([identified, known]))
        near.set_xlim(1 - corner, 1 + 0.12 * corner)
        near.set_ylim(-0.12 * corner, corner)
        near.set_title("Near z = 1 (dashed: damping, dotted: frequency)")
        _frequency_arcs(near, corner, dt_s)
        _name_dampings(near, corner)
        style.finish(figure, whole, columns=5)
    return figure


def _near_corner(poles: Complex) -> float:
    """Side of the close-up: holds the slowest lightly damped pair with room around it, else the slowest
    poles."""
    upper = poles[(poles.imag > 1e-9) & (np.abs(poles) > 0.05)]
    log = np.log(upper)
    light = np.abs(upper[-log.real < 0.4 * np.abs(log)] - 1.0)
    away = np.abs(poles - 1.0)
    away = away[away > 1e-9]
    if light.size:
        return float(np.clip(1.7 * light.min(), 0.02, 0.9))
    return float(np.clip(1.7 * away.min(), 0.02, 0.9)) if away.size else 0.5


def _damping_lines(axes: Axes) -> None:
    turn = np.linspace(0, 2 * np.pi, 361)
    axes.plot(np.cos(turn), np.sin(turn), color="#333333", lw=1.0)
    angle = np.concatenate([np.linspace(0, 0.3, 120), np.linspace(0.301, np.pi, 160)])
    for zeta in _DAMPINGS:
        z = np.exp((-zeta / np.sqrt(1 - zeta**2) + 1j) * angle)
        for side in (z, z.conj()):
            axes.plot(side.real, side.imag, color="#b5b5b5", lw=0.7, ls=(0, (3, 2)))


def _name_dampings(axes: Axes, corner: float) -> None:
    """Damping ratios where their lines leave the close-up."""
    angle = np.linspace(1e-4, np.pi, 6000)
    for number, zeta in enumerate(_DAMPINGS):
        z = np.exp((-zeta / np.sqrt(1 - zeta**2) + 1j) * angle)
        share = 0.93 - 0.07 * (
            number % 2
        )  # neighbouring lines lie close together: their labels stand at two heights
        inside = (z.real > 1 - 0.93 * corner) & (z.imag < share * corner) & (z.imag >= 0)
        leaves = int(np.argmin(inside)) if not inside.all() else angle.size - 1
        point = z[max(leaves - 1, 0)]
        axes.annotate(
            f"{zeta:g}",
            (point.real, point.imag),
            ha="center",
            va="center",
            fontsize=8.5,
            color="#555555",
            bbox={"facecolor": "white", "lw": 0, "pad": 0.8},
        )


def _frequency_arcs(axes: Axes, corner: float, dt_s: float) -> None:
    """Lines of constant undamped frequency at round numbers of rad/s."""
    step = _round_down(corner / dt_s / 3)
    zeta = np.linspace(0, 0.999, 200)
    for k in (1, 2, 3):
        omega = k * step
        z = np.exp((-zeta + 1j * np.sqrt(1 - zeta**2)) * omega * dt_s)
        axes.plot(z.real, z.imag, color="#b5b5b5", lw=0.7, ls=(0, (1, 2)))
        middle = z[int(0.78 * zeta.size)]
        axes.annotate(
            f"{omega:.4g} rad/s",
            (middle.real, middle.imag),
            fontsize=8,
            color="#777777",
            ha="center",
            va="center",
            bbox={"facecolor": "white", "lw": 0, "pad": 0.6, "alpha": 0.8},
        )


def _round_down(value: float) -> float:
    power = 10.0 ** np.floor(np.log10(value))
    return float(max(step for step in (1, 2, 5) if step * power <= value * (1 + 1e-12)) * power)
