"""Pictures of a run for several joints: steps, matrix response with its balls, worst cases, records that were
kept back, mode shapes."""

from __future__ import annotations

import numpy as np

from control_design.plants.multivariable import tustin_s
from control_design.plants.scaled_bound import BoundRows, scaled_bound
from control_design.specification.multivariable import gram
from workflow.figures import style
from workflow.figures.bands import Real, envelope, outline
from workflow.figures.description import Picture, new_picture, small_multiples
from workflow.figures.subjects import AnyRunView
from workflow.figures.validation import draw_free_run

# Lower end of a band that reaches 0, as a share of its middle: a log axis has no 0.
_LOWEST = 1e-2
# Smallest frequency of the singular values, over the Nyquist frequency.
_LOW = 1e-3


# Weights by what the legend calls them.
_MEANING = {
    "tracking": "tracking: weighted S",
    "effort": "effort: weighted K S",
    "modulus": "modulus margin times S",
}


@style.drawing("joint-steps")
def draw_joint_steps(run: AnyRunView) -> Picture | None:
    """Outputs and commands of every joint: the operating points as identified as lines, all others as their
    range."""
    loop = run.results.closed_loop
    if loop.time_s is None or loop.reference is None:
        return None
    joints = run.config.joints
    picture, grid = new_picture(4.6, 2, len(joints), squeeze=False, sharex="col")
    for k, joint in enumerate(joints):
        for panel, name, signal in zip(
            grid[:, k], (joint.output, joint.input), ("output", "command"), strict=True
        ):
            lines = np.stack([getattr(loop_run, signal)[:, k] for loop_run in loop.runs])
            panel.fill_between(*envelope(loop.time_s, lines), **style.ACHIEVED_BAND, label="all runs")
            for number, (loop_run, line) in enumerate(zip(loop.runs, lines, strict=True)):
                if loop_run.condition == loop.runs[0].condition:
                    look = style.ACHIEVED_LINE | {"label": None if number else "as identified"}
                    panel.plot(*outline(loop.time_s, line), **look)
            panel.set(ylabel=style.two_lines(name, run.results.records.unit(name)))
        steps = outline(loop.time_s, loop.reference[:, k], hold=True)
        grid[0, k].plot(*steps, **style.REFERENCE_STEPS, label="reference")
        limit = joint.input_limit
        if limit is not None and np.max(np.abs(lines)) > 0.5 * limit:
            grid[1, k].axhline(limit, **style.LIMIT_LINE, label="limit of the actuator")
            grid[1, k].axhline(-limit, **style.LIMIT_LINE)
        grid[1, k].set(xlabel="time [s]")
    return picture


@style.drawing("matrix-response")
def draw_matrix_response(run: AnyRunView) -> Picture:
    """Size of every channel with its ball, one curve per operating point."""
    points = run.results.identify.points
    joints = run.config.joints
    n = len(joints)
    picture, grid = new_picture(2.1 * n + 0.5, n, n, squeeze=False, sharex=True)
    for i, output in enumerate(joints):
        for j, source in enumerate(joints):
            panel = grid[i, j]
            for number, point in enumerate(points):
                # centre (F, Y, U), radius (F,), output_factor (Y, Y) and input_factor (F, U, U), at the
                # frequencies omega_rad_s (F,).
                shown = point.shown
                size = np.abs(shown.centre[:, i, j])
                # Every member of the ball deviates in this channel by at most that much.
                off = (
                    shown.radius
                    * np.linalg.norm(shown.output_factor[i])
                    * np.linalg.norm(shown.input_factor[:, :, j], axis=1)
                )
                omega = shown.omega_rad_s
                is_first = number == 0
                # A log axis has no 0.
                low = np.maximum(size - off, _LOWEST * size)
                panel.fill_between(omega, low, size + off, **style.BAND, label="ball" if is_first else None)
                line_label = "model, per point" if is_first else None
                panel.plot(omega, size, **style.MODEL_LINE, label=line_label)
                panel.set(xlim=(omega[0], omega[-1]))
            panel.set(xscale="log", yscale="log")
            panel.set_title(style.plain(f"{source.input} to {output.output}", 60), size=9.5)
            unit = style.ratio_unit(
                run.results.records.unit(output.output), run.results.records.unit(source.input)
            )
            if j == 0:
                panel.set(ylabel=f"|G| [{style.plain(unit, 16)}]")
            if i == n - 1:
                panel.set(xlabel="frequency [rad/s]")
    return picture


@style.drawing("singular-values")
def draw_singular_values(run: AnyRunView) -> Picture:
    """Largest and smallest gain of the plant over all directions of its inputs, with the ball, per point."""
    picture, grid = new_picture(2.9, 1, 1, squeeze=False)
    panel = grid[0, 0]
    for number, point in enumerate(run.results.identify.points):
        shown = point.shown
        omega = shown.omega_rad_s
        sizes = np.linalg.svd(shown.centre, compute_uv=False)
        # Weyl: no singular value moves by more than the largest one of the deviation.
        off = shown.radius * np.linalg.norm(shown.output_factor, 2)
        off = off * np.linalg.norm(shown.input_factor, 2, axis=(1, 2))
        for each, line, label in (
            (sizes[:, 0], style.MODEL_LINE, "largest"), (sizes[:, -1], style.PREDICTED_LINE, "smallest")
        ):  # fmt: skip
            panel.fill_between(
                omega, np.maximum(each - off, _LOWEST * each), each + off, **style.BAND,
                label=None if number or label == "largest" else "over the ball",
            )  # fmt: skip
            panel.plot(omega, each, **line, label=None if number else label)
    panel.set(xscale="log", yscale="log", xlim=(omega[0], omega[-1]), xlabel="frequency [rad/s]")
    first = run.config.joints[0]
    unit = style.ratio_unit(run.results.records.unit(first.output), run.results.records.unit(first.input))
    panel.set(ylabel=f"singular value [{style.plain(unit, 16)}]")
    return picture


@style.drawing("joint-requirements")
def draw_joint_requirements(run: AnyRunView) -> Picture | None:
    """Largest singular value of every weighted function, the worst over balls and operating points."""
    law = run.results.design.controller
    if law is None:
        return None
    asked = run.config.specification()
    top = 0.999 * np.pi / law.dt_s
    omega = np.geomspace(_LOW * top, top, 300)
    s = tustin_s(omega, law.dt_s)
    K = law.response(omega, with_delay=False).reshape(-1, *law.D.shape)
    largest: dict[str, Real] = {}
    for point in run.results.identify.points:
        plant = point.plant(run.config.identification.gain_error)
        G, seen, entering = plant.blocks(omega, law.computational_delay_samples)
        for name, (of, weights) in asked.weights(plant.inputs, plant.outputs).items():
            size = gram(weights, s)
            none = np.zeros_like(size)
            on_y, on_u = (size, none) if of == "y" else (none, size)
            worst = scaled_bound(BoundRows(G, seen, entering, on_y, on_u, False), K).gamma
            largest[name] = np.maximum(largest.get(name, np.zeros(omega.size)), worst)
    picture, grid = new_picture(2.9, 1, 1, squeeze=False)
    panel = grid[0, 0]
    colours = (style.MODEL, style.PREDICTED, style.ACHIEVED)
    for (name, gamma), colour in zip(largest.items(), colours, strict=False):
        finite = np.where(np.isfinite(gamma), gamma, np.nan)
        panel.plot(omega, finite, color=colour, lw=1.4, label=_MEANING.get(name, name))
    panel.axhline(1.0, **style.LIMIT_LINE, label="stay below")
    panel.set(xscale="log", xlim=(omega[0], omega[-1]), ylim=(0, None))
    panel.set(xlabel="frequency [rad/s]")
    panel.set(ylabel="worst case [1]")
    return picture


@style.drawing("joint-validation")
def draw_joint_validation(run: AnyRunView) -> Picture | None:
    """Every output, measured and simulated, of the record that the model meets worst of those kept back."""
    records = [(point, fits) for point in run.results.identify.points for fits in point.fresh]
    if not records:
        return None
    point, fits = min(records, key=lambda each: min(fit.fit_percent for fit in each[1]))
    picture, grid = new_picture(4.2, 2, len(fits), squeeze=False, sharex="col", height_ratios=[1.5, 1.0])
    for k, (fit, name) in enumerate(zip(fits, point.model.output_names, strict=True)):
        time_s = np.asarray(np.arange(fit.residual.size) * point.model.dt_s)
        draw_free_run(grid[:, k], time_s, fit, 2 * point.noise_std[k])
        grid[0, k].set_title(f"{style.plain(name, 20)}: fit {fit.fit_percent:.1f} %")
        unit = run.results.records.unit(name)
        for panel, words in zip(grid[:, k], (name, "residual"), strict=True):
            panel.set(ylabel=style.two_lines(words, unit))
    return picture


@style.drawing("mode-shapes")
def draw_mode_shapes(run: AnyRunView) -> Picture | None:
    """Which joint moves how much in each mode of the first operating point."""
    point = run.results.identify.points[0]
    shaped = [(omega, zeta, moved) for omega, zeta, moved in point.modes if moved is not None]
    # A single joint moves as its shape does.
    if not shaped or len(run.config.joints) == 1:
        return None
    picture, panels = small_multiples(len(shaped), min(len(shaped), 3), 2.1, 0.6, sharey=True)
    for panel, (omega, zeta, moved) in zip(panels, shaped, strict=True):
        panel.bars(np.arange(moved.size), moved, 0.5, color=style.MODEL)
        panel.axhline(0.0, color="#444444", lw=0.8)
        panel.x.named = [(k, style.plain(joint.output, 16)) for k, joint in enumerate(run.config.joints)]
        panel.set_title(f"{omega / (2 * np.pi):.3g} Hz, damping {zeta:.2g}", size=9.5)
        panel.set(ylim=(-1.15, 1.15))
    panels[0].set(ylabel="motion [largest = 1]")
    return picture
