"""Pictures of a run for several joints: steps, matrix response with its balls, worst cases, records that were
kept back, mode shapes."""

from __future__ import annotations

import numpy as np

from control_design.plants.multivariable import tustin_s
from control_design.plants.scaled_bound import BoundRows, scaled_bound
from control_design.specification.multivariable import gram
from ident.checks.validation import FreshFit
from workflow.figures import style
from workflow.figures.bands import Real, envelope, outline
from workflow.figures.description import Picture, new_picture, small_multiples
from workflow.figures.subjects import AnyRunView
from workflow.figures.validation import draw_free_run
from workflow.joints.results import PointModel

# Lower end of a band that reaches 0, as a share of its middle: a log axis has no 0.
_LOWEST = 1e-2
# Smallest frequency of the requirements, over the Nyquist frequency.
_LOW = 1e-3
# Share of an actuator's limit from which on its command is shown with the limit: half of the panel.
_NEAR_LIMIT = 0.5

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
    records = run.results.records
    # The first condition of every point is the machine as it was identified.
    as_identified = loop.runs[0].condition
    picture, grid = new_picture(4.6, 2, len(joints), squeeze=False, sharex="col")
    for k, joint in enumerate(joints):
        output_panel, command_panel = grid[:, k]
        outputs = np.stack([loop_run.output[:, k] for loop_run in loop.runs])
        commands = np.stack([loop_run.command[:, k] for loop_run in loop.runs])
        signals = (
            (output_panel, joint.output, outputs),
            (command_panel, joint.input, commands),
        )
        for panel, name, lines in signals:
            band = envelope(loop.time_s, lines)
            panel.fill_between(*band, **style.ACHIEVED_BAND, label="all runs")
            for number, loop_run in enumerate(loop.runs):
                if loop_run.condition != as_identified:
                    continue
                # One entry of the legend for all of these lines.
                label = None if number else "as identified"
                line = outline(loop.time_s, lines[number])
                panel.plot(*line, **style.ACHIEVED_LINE, label=label)
            panel.set(ylabel=style.two_lines(name, records.unit(name)))

        steps = outline(loop.time_s, loop.reference[:, k], hold=True)
        output_panel.plot(*steps, **style.REFERENCE_STEPS, label="reference")

        # A limit that the command stays far below would only flatten the command.
        limit = joint.input_limit
        largest_command = np.max(np.abs(commands))
        if limit is not None and largest_command > _NEAR_LIMIT * limit:
            command_panel.axhline(limit, **style.LIMIT_LINE, label="limit of the actuator")
            command_panel.axhline(-limit, **style.LIMIT_LINE)
        command_panel.set(xlabel="time [s]")
    return picture


@style.drawing("matrix-response")
def draw_matrix_response(run: AnyRunView) -> Picture:
    """Size of every channel with its ball, one curve per operating point."""
    points = run.results.identify.points
    records = run.results.records
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
                left = np.linalg.norm(shown.output_factor[i])
                right = np.linalg.norm(shown.input_factor[:, :, j], axis=1)
                deviation = shown.radius * left * right
                omega = shown.omega_rad_s
                # A log axis has no 0.
                low = np.maximum(size - deviation, _LOWEST * size)
                high = size + deviation
                # One entry of the legend for all points.
                band_label = None
                line_label = None
                if number == 0:
                    band_label = "ball"
                    line_label = "model, per point"
                panel.fill_between(omega, low, high, **style.BAND, label=band_label)
                panel.plot(omega, size, **style.MODEL_LINE, label=line_label)
                panel.set(xlim=(omega[0], omega[-1]))
            panel.set(xscale="log", yscale="log")
            channel = f"{source.input} to {output.output}"
            panel.set_title(style.plain(channel, 60), size=9.5)
            output_unit = records.unit(output.output)
            input_unit = records.unit(source.input)
            unit = style.ratio_unit(output_unit, input_unit)
            # A column shares its frequencies, a row its outputs.
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
        left = np.linalg.norm(shown.output_factor, 2)
        right = np.linalg.norm(shown.input_factor, 2, axis=(1, 2))
        deviation = shown.radius * left * right
        curves = (
            (sizes[:, 0], style.MODEL_LINE, "largest"),
            (sizes[:, -1], style.PREDICTED_LINE, "smallest"),
        )
        for size, line, label in curves:
            # One entry of the legend for all points, and one for both bands.
            band_label = None
            line_label = None
            if number == 0:
                line_label = label
                if label == "smallest":
                    band_label = "over the ball"
            # A log axis has no 0.
            low = np.maximum(size - deviation, _LOWEST * size)
            high = size + deviation
            panel.fill_between(omega, low, high, **style.BAND, label=band_label)
            panel.plot(omega, size, **line, label=line_label)
    panel.set(xscale="log", yscale="log")
    panel.set(xlim=(omega[0], omega[-1]), xlabel="frequency [rad/s]")

    # Columns of a unit each have no common one: that of the first joint is stated.
    first = run.config.joints[0]
    records = run.results.records
    unit = style.ratio_unit(records.unit(first.output), records.unit(first.input))
    panel.set(ylabel=f"singular value [{style.plain(unit, 16)}]")
    return picture


@style.drawing("joint-requirements")
def draw_joint_requirements(run: AnyRunView) -> Picture | None:
    """Largest singular value of every weighted function, the worst over balls and operating points."""
    law = run.results.design.controller
    if law is None:
        return None
    asked = run.config.specification()
    # Just below the Nyquist frequency, where the bilinear variable has no value.
    top = 0.999 * np.pi / law.dt_s
    omega = np.geomspace(_LOW * top, top, 300)
    s = tustin_s(omega, law.dt_s)
    K = law.response(omega, with_delay=False).reshape(-1, *law.D.shape)
    largest: dict[str, Real] = {}
    for point in run.results.identify.points:
        plant = point.plant(run.config.identification.gain_error)
        G, seen, entering = plant.blocks(omega, law.computational_delay_samples)
        weights_by_name = asked.weights(plant.inputs, plant.outputs)
        for name, (weighted_signal, weights) in weights_by_name.items():
            # Each requirement by itself: it weighs outputs or inputs, and nothing of the other.
            size = gram(weights, s)
            nothing = np.zeros_like(size)
            on_outputs = nothing
            on_inputs = size
            if weighted_signal == "y":
                on_outputs = size
                on_inputs = nothing
            # The uncertainty keeps its size: the worst-case gain.
            rows = BoundRows(G, seen, entering, on_outputs, on_inputs, together=False)
            worst = scaled_bound(rows, K).gamma
            before = largest.get(name, np.zeros(omega.size))
            largest[name] = np.maximum(before, worst)
    picture, grid = new_picture(2.9, 1, 1, squeeze=False)
    panel = grid[0, 0]
    colours = (style.MODEL, style.PREDICTED, style.ACHIEVED)
    for (name, gamma), colour in zip(largest.items(), colours, strict=False):
        # A bound that is not finite is a gap in its curve.
        finite = np.where(np.isfinite(gamma), gamma, np.nan)
        meaning = _MEANING.get(name, name)
        panel.plot(omega, finite, color=colour, lw=1.4, label=meaning)
    panel.axhline(1.0, **style.LIMIT_LINE, label="stay below")
    panel.set(xscale="log", xlim=(omega[0], omega[-1]), ylim=(0, None))
    panel.set(xlabel="frequency [rad/s]")
    panel.set(ylabel="worst case [1]")
    return picture


@style.drawing("joint-validation")
def draw_joint_validation(run: AnyRunView) -> Picture | None:
    """Every output, measured and simulated, of the record that the model meets worst of those kept back."""
    points = run.results.identify.points
    records = [(point, fits) for point in points for fits in point.fresh]
    if not records:
        return None

    def worst_fit_percent(record: tuple[PointModel, tuple[FreshFit, ...]]) -> float:
        return min(fit.fit_percent for fit in record[1])

    point, fits = min(records, key=worst_fit_percent)
    picture, grid = new_picture(4.2, 2, len(fits), squeeze=False, sharex="col", height_ratios=[1.5, 1.0])
    for k, (fit, name) in enumerate(zip(fits, point.model.output_names, strict=True)):
        signal_panel, residual_panel = grid[:, k]
        time_s = np.asarray(np.arange(fit.residual.size) * point.model.dt_s)
        # Two standard deviations hold 95 % of what is noise alone.
        draw_free_run(grid[:, k], time_s, fit, 2 * point.noise_std[k])
        short_name = style.plain(name, 20)
        signal_panel.set_title(f"{short_name}: fit {fit.fit_percent:.1f} %")
        unit = run.results.records.unit(name)
        signal_panel.set(ylabel=style.two_lines(name, unit))
        residual_panel.set(ylabel=style.two_lines("residual", unit))
    return picture


@style.drawing("mode-shapes")
def draw_mode_shapes(run: AnyRunView) -> Picture | None:
    """Which joint moves how much in each mode of the first operating point."""
    point = run.results.identify.points[0]
    joints = run.config.joints
    shaped = [(omega, zeta, moved) for omega, zeta, moved in point.modes if moved is not None]
    # A single joint moves as its shape does.
    if not shaped or len(joints) == 1:
        return None
    joint_names = [(k, style.plain(joint.output, 16)) for k, joint in enumerate(joints)]
    panels_in_a_row = min(len(shaped), 3)
    picture, panels = small_multiples(len(shaped), panels_in_a_row, 2.1, 0.6, sharey=True)
    for panel, (omega, zeta, moved) in zip(panels, shaped, strict=True):
        places = np.arange(moved.size)
        panel.bars(places, moved, 0.5, color=style.MODEL)
        panel.axhline(0.0, color="#444444", lw=0.8)
        panel.x.named = joint_names
        frequency_Hz = omega / (2 * np.pi)
        panel.set_title(f"{frequency_Hz:.3g} Hz, damping {zeta:.2g}", size=9.5)
        # Shapes are scaled to a largest motion of 1.
        panel.set(ylim=(-1.15, 1.15))
    panels[0].set(ylabel="motion [largest = 1]")
    return picture
