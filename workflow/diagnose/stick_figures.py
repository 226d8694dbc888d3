"""Rigid bodies that move as stick figures, measured, stated and repaired: one SVG without a script."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from markupsafe import Markup

from diagnosis.answer import Diagnosis
from diagnosis.fit.residual import pooled_rms
from diagnosis.machine.machine_protocol import Real
from workflow.figures import gap_style

# Frames of the animation at most. Chosen: each costs the page a path for every figure, and a hundred in
# twelve seconds still look like motion.
_FRAMES = 100
# Longest animation [s]; a longer record is shown faster. Chosen: about how long one looks at it.
_LONGEST_S = 12.0
# Width of the picture [px of the SVG's viewBox]: that of a column of the page.
_WIDTH = 640.0
# Height of the picture [px]: about half of the width, so that it leaves room for what it belongs to.
_HEIGHT = 300.0
# Free space around the figures and the scale [px]: half of the widest line and of a letter.
_EDGE = 16.0
# Share of the measured figure's size that a run may leave it by and is still drawn. Chosen: larger, and one
# run that falls over makes the measured figure small.
_BEYOND = 0.5
# Where a run that is not a number is drawn [m]: far outside, so that it is cut at the picture's end.
_FAR_OUTSIDE_M = 1e6
# Smallest width or height that the scale goes by, as a share of the figure's size: a figure that moves along
# one line only has none across.
_THINNEST = 1e-3
# Width of the measured figure's lines [px]: broad, as it lies beneath.
_MEASURED_PX = 9.0
# Width of a model's lines [px]: a third of it, so that both are seen where they agree.
_MODEL_PX = 3.0
# Length of the scale at most, as a share of the picture's width: beside the axes and the bar of time.
_LONGEST_SCALE = 0.25
# Playing faster than this is said: 1 % nobody sees.
_NOTICEABLY_FASTER = 1.01


def moving_figures(diagnosis: Diagnosis) -> Markup | None:
    """An animated SVG of the bodies in the validation record that the first picture of the page shows.

    They are seen along the axis (x, y or z of the world) in which they move and reach least.

    Returns
    -------
    Markup or None
        None: the machine has no bodies, or joints that nobody measures.
    """
    case = diagnosis.case
    runs = diagnosis.replays
    figure = getattr(getattr(case.machine.description, "untracked", None), "stick_figure", None)
    if not runs or figure is None:
        return None

    worst = max(case.held_out, key=lambda e: pooled_rms(diagnosis.residuals_before[e.name]))
    n_samples = len(worst.output)
    n_frames = min(n_samples, _FRAMES)
    rows = np.unique(np.linspace(0, n_samples - 1, n_frames).astype(int))
    figures = {"measured": figure(worst.output[rows])}
    for model, run in runs.items():
        figures[model] = figure(run[worst.name][rows])
    if figures["measured"] is None:
        return None

    flat, scale_px_m, axes_seen = _flat(figures)
    record_s = n_samples * case.dt_s
    shown_s = min(record_s, _LONGEST_S)
    # The measured figure comes first and so lies beneath the models.
    paths = [_path(flat["measured"], gap_style.PALE, _MEASURED_PX, shown_s)]
    for model in runs:
        colour = str(gap_style.MODELS[model]["color"])
        paths.append(_path(flat[model], colour, _MODEL_PX, shown_s))
    drawn = "".join(paths)
    around = _frame(scale_px_m, axes_seen, record_s, shown_s)
    return Markup(
        f'<svg viewBox="0 0 {_WIDTH:.0f} {_HEIGHT:.0f}" role="img" aria-label="Stick figures, measured and '
        f'simulated, {shown_s:.3g} s of motion">{drawn}{around}</svg>'
    )


def _flat(figures: Mapping[str, Real]) -> tuple[dict[str, Real], float, str]:
    """Figures in the picture, all at one scale.

    Parameters
    ----------
    figures : mapping
        Model -> (F, L, 2, 3) [m]: ends of L lines in F frames, in the world; "measured" is one of them.

    Returns
    -------
    flat : dict
        Model -> (F, L, 2, 2) [px].
    scale : float
        px per m.
    axes : str
        The two axes of the world that are seen, across and up.
    """
    points = figures["measured"].reshape(-1, 3)
    reach = np.ptp(points, axis=0)
    # A figure may be long in an axis and stay where it is in it: what moves counts beside what reaches.
    measured = figures["measured"]
    measured_points = measured.reshape(len(measured), -1, 3)
    moved = np.ptp(measured_points, axis=0).max(axis=0)
    seen = sorted(np.argsort(reach + moved)[1:])

    # A free run may fall over, far away from what was measured: it is cut at the picture's end.
    size = float(np.max(reach)) or 1.0
    low = points.min(axis=0) - _BEYOND * size
    high = points.max(axis=0) + _BEYOND * size
    near = {}
    for model, lines in figures.items():
        # A simulation that ran away is drawn at the edge.
        finite = np.nan_to_num(lines, nan=_FAR_OUTSIDE_M)
        near[model] = np.clip(finite, low, high)[..., seen]

    every = np.concatenate([lines.reshape(-1, 2) for lines in near.values()])
    corner = every.min(axis=0)
    extent = np.ptp(every, axis=0)
    room = np.array([_WIDTH, _HEIGHT]) - 2 * _EDGE
    scale = float(np.min(room / np.maximum(extent, _THINNEST * size)))
    middle = np.array([_WIDTH, _HEIGHT]) / 2
    # An SVG counts downwards.
    up = np.array([1.0, -1.0])
    flat = {}
    for model, lines in near.items():
        about_middle = lines - corner - extent / 2
        flat[model] = middle + up * scale * about_middle
    names_seen = "".join("xyz"[k] for k in seen)
    return flat, scale, names_seen


def _frame(scale: float, axes_seen: str, record_s: float, shown_s: float) -> str:
    """A length to measure by, the axes of the world that are seen, and a bar that fills as time goes by.

    Parameters
    ----------
    scale : float
        px per m.
    axes_seen : str
        Across and up, "xz".
    record_s, shown_s : float
        Length of the record and of the animation [s].
    """
    # The longest round length (1, 2 or 5 times a power of ten) that has room.
    longest_m = _LONGEST_SCALE * _WIDTH / scale
    length = 10.0 ** np.floor(np.log10(longest_m))
    length *= max(step for step in (1, 2, 5) if step * length <= longest_m)
    x = _EDGE
    y = _HEIGHT - _EDGE
    end = x + length * scale
    right = _WIDTH - _EDGE
    faster = ""
    if record_s > _NOTICEABLY_FASTER * shown_s:
        faster = f", shown {record_s / shown_s:.2g} times faster"
    # A scale in metres and the axes seen on the left; on the right a bar that fills while the motion runs.
    ink = 'stroke="#555" stroke-width="1.5" fill="none"'
    words = 'fill="#555" font-size="12"'
    return (
        f'<path d="M{x} {y - 4}v4H{end:.1f}v-4" {ink}/><text x="{x}" y="{y - 8}" {words}>{length:g} m</text>'
        f'<path d="M{x} {y - 70}v40h40" {ink}/><text x="{x + 44}" y="{y - 26}" {words}>{axes_seen[0]}</text>'
        f'<text x="{x - 4}" y="{y - 76}" {words}>{axes_seen[1]}</text>'
        f'<text x="{right}" y="{y - 8}" {words} text-anchor="end">0 to {record_s:.3g} s{faster}</text>'
        f'<path d="M{right - 160} {y}h160" stroke="#ddd" stroke-width="4"/>'
        f'<rect x="{right - 160}" y="{y - 2}" width="0" height="4" fill="#555"><animate '
        f'attributeName="width" from="0" to="160" dur="{shown_s:.4g}s" repeatCount="indefinite"/></rect>'
    )


def _path(lines: Real, colour: str, width_px: float, shown_s: float) -> str:
    """An animated path through the frames of one figure, lines (F, L, 2, 2) [px]."""
    frames = []
    for frame in lines:
        segments = [f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for (a, b), (c, d) in frame]
        frames.append("".join(segments))
    values = ";".join(frames)
    return (
        f'<path d="{frames[0]}" fill="none" stroke="{colour}" stroke-width="{width_px:g}" '
        f'stroke-linecap="round">'
        f'<animate attributeName="d" dur="{shown_s:.4g}s" repeatCount="indefinite" '
        f'values="{values}"/></path>'
    )
