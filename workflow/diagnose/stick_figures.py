"""Rigid bodies that move as stick figures, measured, stated and repaired: one SVG without a script."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from diagnosis.answer import Diagnosis
from diagnosis.fit.residual import pooled_rms
from diagnosis.machine.machine_protocol import Real
from workflow.figures import gap_style

_FRAMES, _LONGEST_S = 100, 12.0
_WIDTH, _HEIGHT, _EDGE = 640.0, 300.0, 16.0
# Share of the measured figure's size that a run may leave it by and is still drawn.
_BEYOND = 0.5


def moving_figures(found: Diagnosis) -> Markup | None:
    """Of the validation record that the first picture shows; None: no bodies, or joints that nobody measures.

    Seen along the axis (x, y or z of the world) in which the bodies move and reach least.
    """
    runs, case = found.replays, found.case
    figure = getattr(getattr(case.machine.description, "untracked", None), "stick_figure", None)
    if not runs or figure is None:
        return None
    worst = max(case.held_out, key=lambda e: pooled_rms(found.residuals_before[e.name]))
    T = len(worst.output)
    at = np.unique(np.linspace(0, T - 1, min(T, _FRAMES)).astype(int))
    outputs: dict[str, Real] = {"measured": worst.output}
    outputs.update((model, run[worst.name]) for model, run in runs.items())
    figures = {model: figure(run[at]) for model, run in outputs.items()}
    if figures["measured"] is None:
        return None
    (flat, scale, seen), seconds = _flat(figures), min(T * case.dt_s, _LONGEST_S)
    colours: dict[str, str] = {
        "measured": gap_style.PALE,
        **{m: str(gap_style.MODELS[m]["color"]) for m in runs},
    }
    paths = "".join(
        _path(flat[model], colours[model], 9.0 if model == "measured" else 3.0, seconds) for model in flat
    )
    return Markup(
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="Stick figures, measured and '
        f'simulated, {seconds:.3g} s of motion">{paths}{_frame(scale, seen, T * case.dt_s, seconds)}</svg>'
    )


def _flat(figures: Mapping[str, Real]) -> tuple[dict[str, Real], float, str]:
    """(F, L, 2, 3) [m] -> (F, L, 2, 2) in the picture, one scale [1/m] for all; axes across and up."""
    measured = figures["measured"]
    reach = np.ptp(measured.reshape(-1, 3), axis=0)
    kept = sorted(np.argsort(reach + np.ptp(measured.reshape(len(measured), -1, 3), axis=0).max(axis=0))[1:])
    size = float(np.max(reach)) or 1.0
    low, high = measured.reshape(-1, 3).min(axis=0), measured.reshape(-1, 3).max(axis=0)
    # A free run may fall over, far away from what was measured.
    near = {
        model: np.clip(np.nan_to_num(one, nan=1e6), low - _BEYOND * size, high + _BEYOND * size)[..., kept]
        for model, one in figures.items()
    }
    every = np.concatenate([one.reshape(-1, 2) for one in near.values()])
    first, wide = every.min(axis=0), np.ptp(every, axis=0)
    scale = float(np.min((np.array([_WIDTH, _HEIGHT]) - 2 * _EDGE) / np.maximum(wide, 1e-3 * size)))
    middle = np.array([_WIDTH, _HEIGHT]) / 2
    up = np.array([1.0, -1.0])
    flat = {model: middle + up * scale * (one - first - wide / 2) for model, one in near.items()}
    return flat, scale, "".join("xyz"[k] for k in kept)


def _frame(scale: float, seen: str, lasts_s: float, seconds: float) -> str:
    """A length to measure by, the axes of the world that are seen, and a bar that fills as time goes by."""
    length = 10.0 ** np.floor(np.log10(0.25 * _WIDTH / scale))
    length *= max(step for step in (1, 2, 5) if step * length <= 0.25 * _WIDTH / scale)
    x, y, end = _EDGE, _HEIGHT - _EDGE, _EDGE + length * scale
    faster = f", shown {lasts_s / seconds:.2g} times faster" if lasts_s > 1.01 * seconds else ""
    right = _WIDTH - _EDGE
    ink, words = 'stroke="#555" stroke-width="1.5" fill="none"', 'fill="#555" font-size="12"'
    return (
        f'<path d="M{x} {y - 4}v4H{end:.1f}v-4" {ink}/><text x="{x}" y="{y - 8}" {words}>{length:g} m</text>'
        f'<path d="M{x} {y - 70}v40h40" {ink}/><text x="{x + 44}" y="{y - 26}" {words}>{seen[0]}</text>'
        f'<text x="{x - 4}" y="{y - 76}" {words}>{seen[1]}</text>'
        f'<text x="{right}" y="{y - 8}" {words} text-anchor="end">0 to {lasts_s:.3g} s{faster}</text>'
        f'<path d="M{right - 160} {y}h160" stroke="#ddd" stroke-width="4"/>'
        f'<rect x="{right - 160}" y="{y - 2}" width="0" height="4" fill="#555"><animate '
        f'attributeName="width" from="0" to="160" dur="{seconds:.4g}s" repeatCount="indefinite"/></rect>'
    )


def _path(lines: Real, colour: str, width: float, seconds: float) -> str:
    """lines: (F, L, 2, 2)"""
    frames = ["".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in one) for one in lines]
    return (
        f'<path d="{frames[0]}" fill="none" stroke="{colour}" stroke-width="{width:g}" '
        f'stroke-linecap="round">'
        f'<animate attributeName="d" dur="{seconds:.4g}s" repeatCount="indefinite" '
        f'values="{";".join(frames)}"/></path>'
    )
