"""Every picture: title, units on the axes, a legend that hides nothing, no text cut off, same bytes twice."""

import itertools
import re
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from types import SimpleNamespace

import control
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure

from control_design.controllers.controller import Controller
from ident.data.distortion import distortion_of
from ident.data.record import Record
from ident.uncertainty import FrequencyUncertainty
from plant import paper_link
from tests.workflow import report_examples as example
from workflow.describe.run_page import page_of_run
from workflow.excite.drawing import draw_excitation
from workflow.excite.experiment import ExperimentLimits, plan_experiment
from workflow.figures import style
from workflow.figures.bands import (
    degrees_near,
    envelope,
    extremes,
    outline,
    response_band,
    smooth_grid,
    unwrapped_degrees,
)
from workflow.figures.bode import draw_bode, draw_distortion
from workflow.figures.closed_loop import draw_closed_loop
from workflow.figures.description import Picture
from workflow.figures.gap_answer import draw_waterfall
from workflow.figures.gap_records import draw_residual_spectra
from workflow.figures.matplotlib_figure import drawable, figure_of, house_style, saved
from workflow.figures.poles import draw_poles
from workflow.figures.records import draw_records
from workflow.figures.sensitivity import draw_sensitivities, sensitivity_curves
from workflow.figures.subjects import RunView
from workflow.figures.validation import draw_repeat_scatter
from workflow.report import rendering
from workflow.tasks.results import LoopCheck, LoopRuns, RunRecord, RunResults

OMEGA = np.unique(np.concatenate([np.geomspace(0.3, np.pi / example.DT_S, 150), 14 + np.linspace(-2, 2, 41)]))
HOSTILE = "a_$very$_<b>long</b> name & 漢 of a column that goes on and on and on"


@cache
def pictures(name: str = "hub", unit: str = "V") -> Mapping[str, Figure]:
    """All pictures of a run's page, every name of the user's like `name`; and one with such a unit."""
    settings = example.config(
        outputs=(f"{name}_rad", f"{name} m"),
        labels=(name, f"{name} tip"),
        records=(name, f"{name} 2", f"{name} fresh"),
        input_name=f"{name} u",
    )
    with tempfile.TemporaryDirectory() as folder:
        run = RunResults(example.build_run(Path(folder) / "run", settings))
        view = RunView(settings, run, run.run.manifest())
        first, parts = page_of_run(view)
        page = rendering.render_page("report.html.j2", title="", first=first, parts=parts, study=False)
    asked = settings.specification
    curves = sensitivity_curves(example.plant(), example.controller(), asked, OMEGA, input_unit=unit)
    drawn = {stem: made.picture for stem, made in page.pictures.items() if "-2-" not in stem}
    drawn["units"] = draw_sensitivities(curves, level=0.95)
    return {stem: figure_of(picture) for stem, picture in drawn.items()}


def frequency() -> FrequencyUncertainty:
    return example.posterior(example.model()).at(OMEGA)


def bode_picture(title: str = "hub") -> Picture:
    return draw_bode(frequency(), title, "rad / V", model=example.model())


def poles_picture() -> Picture:
    return draw_poles(example.model(), "hub")


def panels(figure: Figure) -> list:
    """The axes that show something; colour bars have no labels."""
    return [axes for axes in figure.axes if axes.get_visible() and axes.get_xlim() != (0.0, 1.0)]


def has_titles_units_and_a_legend(figure: Figure) -> None:
    assert any(axes.get_title(loc="left") for axes in panels(figure))
    labels = [label for axes in panels(figure) for label in (axes.get_xlabel(), axes.get_ylabel()) if label]
    assert labels
    for label in labels:
        assert re.search(r"\[.+\]", label), f"no unit in {label!r}"
    # Every panel of a row or column is labelled by itself or by the one it shares the axis with.
    for axes in panels(figure):
        assert any(other.get_xlabel() for other in axes.get_shared_x_axes().get_siblings(axes))
        assert any(other.get_ylabel() for other in axes.get_shared_y_axes().get_siblings(axes)) or any(
            other.get_ylabel() for other in panels(figure) if same_row(other, axes)
        )
    assert len(figure.legends) == 1
    assert figure.legends[0].get_texts()


def same_row(one, other) -> bool:
    return one.get_subplotspec().rowspan == other.get_subplotspec().rowspan


def test_pictures_of_a_planned_experiment():
    limits = ExperimentLimits(
        band_Hz=(0.5, 90.0), dt_s=0.005, duration_s=40.0, peak_V=24.0, rig=paper_link(), noise_std_rad=1e-3
    )
    plan = plan_experiment(limits, seed=1, realisations=2)
    steady = np.tile(plan.voltages_V, 2)  # a gain of one, as it stands
    records = [Record(u[:, None], u[:, None], 0.005, name=str(k)) for k, u in enumerate(steady[0])]
    for picture in (draw_excitation(plan), draw_distortion(distortion_of(records), ("V", "rad"))):
        figure = figure_of(picture)
        has_titles_units_and_a_legend(figure)
        is_whole(figure)


@pytest.mark.parametrize(
    "names",
    [
        pytest.param((), marks=pytest.mark.long),
        # Longer names and units need more room than plain ones.
        pytest.param((HOSTILE, HOSTILE), marks=pytest.mark.slow),
    ],
    ids=["plain", "hostile"],
)
def test_titles_units_and_a_legend_nothing_cut_off_and_nothing_overlapping(names):
    for figure in pictures(*names).values():
        has_titles_units_and_a_legend(figure)
        is_whole(figure)


def test_a_response_at_other_frequencies_is_no_part_of_a_bode_picture():
    posterior = example.posterior(example.model())
    elsewhere = posterior.at(OMEGA[-5:])
    picture = draw_bode(posterior.at(OMEGA[:10]), "hub", "rad / V", empirical=elsewhere)
    has_titles_units_and_a_legend(figure_of(picture))


def is_whole(figure: Figure) -> None:
    with house_style():
        figure.draw_without_rendering()
        renderer = figure.canvas.get_renderer()
    page = figure.bbox
    words = [
        *(axes.title for axes in panels(figure)),
        *(axes._left_title for axes in panels(figure)),
        *(axis.label for axes in panels(figure) for axis in (axes.xaxis, axes.yaxis)),
        *figure.legends[0].get_texts(),
    ]
    boxes = [(text.get_text(), text.get_window_extent(renderer)) for text in words if text.get_text()]
    slack = 1.5  # pixels: glyphs overhang their advance a little
    for text, box in boxes:
        assert box.x0 >= page.x0 - slack, text
        assert box.x1 <= page.x1 + slack, text
        assert box.y0 >= page.y0 - slack, text
        assert box.y1 <= page.y1 + slack, text
    for (one, first), (other, second) in itertools.combinations(boxes, 2):
        overlap = (
            min(first.x1, second.x1) - max(first.x0, second.x0),
            min(first.y1, second.y1) - max(first.y0, second.y0),
        )
        assert min(overlap) <= slack, f"{one!r} overlaps {other!r}"
    legend = figure.legends[0].get_window_extent(renderer)
    for axes in panels(figure):
        assert not legend.overlaps(axes.get_window_extent(renderer)), "the legend hides a panel"


@pytest.mark.parametrize("draw", [pytest.param(bode_picture, marks=pytest.mark.long), poles_picture])
def test_same_bytes_twice_and_no_date(draw):
    first, second = saved(draw(), ("pdf", "png")), saved(draw(), ("pdf", "png"))
    assert first == second
    assert b"CreationDate" not in first["pdf"]
    assert first["png"].startswith(b"\x89PNG")


def test_global_settings_are_left_alone():
    before = dict(mpl.rcParams)
    saved(poles_picture(), ("png",))
    assert dict(mpl.rcParams) == before


def test_hostile_text_is_drawn_as_it_is():
    text = style.plain(HOSTILE.replace(" ", "\n", 1))
    assert "\n" not in text
    assert "$very$" in text  # no formula: the house style parses none
    assert "漢" in text  # a browser knows it
    assert "漢" not in drawable(text)  # not in the font of a file: a box, no warning
    assert "\x07" not in style.plain("a\x07b")
    assert len(text) == 60
    assert style.two_lines("torque_Nm", "") == "torque_Nm\n[as logged]"
    assert style.two_lines("torque_Nm", "N m") == "torque_Nm\n[N m]"


def test_gain_and_phase_bands_hold_what_is_in_the_ellipse():
    rng = np.random.default_rng(1)
    found = frequency()
    band = response_band(found)
    ellipse = found.ellipse()
    angle = rng.uniform(0, 2 * np.pi, (2000, OMEGA.size))
    radius = np.sqrt(rng.uniform(0, 1, (2000, OMEGA.size)))
    members = found.centre + ellipse.direction * radius * (
        ellipse.semi_major * np.cos(angle) + 1j * ellipse.semi_minor * np.sin(angle)
    )
    assert np.all(np.abs(members) <= band.gain_high * (1 + 1e-9))
    assert np.all(np.abs(members) >= band.gain_low * (1 - 1e-9))
    # The ends are reached: the largest of 2000 members comes within a few per cent of the band's width.
    width = band.gain_high - band.gain_low
    assert np.all(np.abs(members).max(axis=0) > band.gain_high - 0.1 * width)
    phase = degrees_near(members, np.broadcast_to(band.phase_deg, members.shape))
    inside = band.gain_low > 0
    # 128 boundary points miss the extreme phase by less than 0.2 % of the swing.
    swing = band.phase_high_deg - band.phase_low_deg
    assert np.all((phase <= band.phase_high_deg + 0.002 * swing)[:, inside])
    assert np.all((phase >= band.phase_low_deg - 0.002 * swing)[:, inside])


def test_phase_is_the_whole_circle_where_the_ellipse_holds_the_origin():
    covariance = np.broadcast_to(np.eye(2), (2, 2, 2))
    found = FrequencyUncertainty(np.array([1.0, 2.0]), np.array([0.1 + 0j, 10.0 + 0j]), covariance, 0.01)
    band = response_band(found)
    assert band.gain_low[0] == 0
    assert band.phase_high_deg[0] - band.phase_low_deg[0] == 360
    assert band.phase_high_deg[1] - band.phase_low_deg[1] < 60


def test_phase_starts_where_engineers_expect_it():
    omega = np.geomspace(0.01, 100, 400)
    double = 1 / (1j * omega) ** 2 / (1j * omega / 5 + 1)
    phase = unwrapped_degrees(double)
    assert phase[0] == pytest.approx(-180, abs=1)
    assert phase[-1] == pytest.approx(-270, abs=5)


@pytest.mark.parametrize("samples", [1, 2, 5, 600, 1777, 2100, 2101, 12345])
def test_outline_and_envelope_keep_extremes_and_ends(samples):
    time, signals = np.arange(samples) * 0.1, np.random.default_rng(samples).standard_normal((4, samples))
    for (t, *ends), every in ((outline(time, signals[0]), signals[0]), (envelope(time, signals), signals)):
        assert (t[0], t[-1]) == (time[0], time[-1])
        assert (ends[0].min(), ends[-1].max()) == (every.min(), every.max())
        assert np.all(np.diff(t) > 0)
        assert t.size <= 3 * 700
    t, low, high = envelope(time, signals)
    assert np.all(np.interp(time, t, low) <= signals + 1e-12)
    assert np.all(np.interp(time, t, high) >= signals - 1e-12)


WIDTH_PT, HEIGHT_PT, LINE_PT = 300.0, 110.0, 1.4  # of a panel with two columns and its lines


def farthest_pt(x, y, line_x, line_y, scale=None):
    """Largest distance [pt] of points (N,) from a drawn line (M,), both scaled to a panel."""
    if scale is None:
        scale = np.array([WIDTH_PT / np.ptp(x), HEIGHT_PT / np.ptp(y)])
    points, ends = np.column_stack([x, y]) * scale, np.column_stack([line_x, line_y]) * scale
    way = np.diff(ends, axis=0)
    worst = 0.0
    for part in np.array_split(points, max(points.shape[0] // 200, 1)):
        off = part[:, None] - ends[:-1]
        along = np.clip(np.sum(off * way, axis=2) / np.maximum(np.sum(way**2, axis=1), 1e-300), 0, 1)
        worst = max(worst, np.linalg.norm(off - along[..., None] * way, axis=2).min(axis=1).max())
    return worst


def light_mode(samples, period):
    """A step that a light mode of this period, in samples, rides on."""
    k = np.arange(samples)
    return 1 - np.exp(-k / (samples / 6)) * (0.8 + 0.2 * np.cos(2 * np.pi * k / period))


@pytest.mark.parametrize(
    "signal",
    [
        light_mode(700, 13.7),
        light_mode(1110, 8.3),
        light_mode(4100, 41.0),
        light_mode(5000, 5.1),
        np.repeat(np.random.default_rng(1).choice([-1.0, 1.0], 300), 9),
        np.cumsum(np.random.default_rng(2).standard_normal(3000)),
    ],
    ids=["fast", "faster", "slow", "aliased", "binary", "walk"],
)
def test_a_thinned_curve_is_drawn_where_the_full_one_is(signal):
    time = 0.01 * np.arange(signal.size)
    assert farthest_pt(time, signal, *outline(time, signal)) < LINE_PT / 2
    # Between any two samples of the drawn line the full one is near, too.
    t, y = outline(time, signal)
    middle = (t[:-1] + t[1:]) / 2, (y[:-1] + y[1:]) / 2
    assert farthest_pt(*middle, time, signal) < LINE_PT


def test_a_thinned_command_is_held_as_the_full_one():
    k = np.arange(1500)
    command = np.where(k < 100, 0.0, 9.0 * np.exp(-k / 90) * np.cos(k / 7) + 0.3)
    t, u = outline(0.01 * k, command, hold=True)
    held = u[np.searchsorted(t, 0.01 * k, side="right") - 1]
    assert np.max(np.abs(held - command)) < 1e-3 * np.ptp(command)
    assert t.size < k.size


def test_dots_of_a_long_record_keep_a_light_mode():
    """4096 lines, of which three are a resonance: one dot in three hundred would miss it."""
    omega = np.linspace(0.1, 300.0, 4096)
    size = np.abs(1 / (40.0**2 - omega**2 + 2j * 3e-4 * 40.0 * omega))
    index = extremes(omega, size, np.geomspace(0.1, 300.0, 151))
    assert size[index].max() == size.max()
    assert index.size <= 302
    assert {0, omega.size - 1} <= set(extremes(omega, omega, np.array([0.1, 300.0])).tolist())


@pytest.mark.parametrize("zeta", [0.05, 3e-3, 2e-4])
def test_a_locus_is_smooth_at_a_resonance(zeta):
    """An integrator with a mode, its circle of any size: no corner, and no chord that is seen."""

    def locus(omega):
        s = 1j * omega
        return 3.0 / s + 4.0 * zeta * s * 40.0 / (s**2 + 2 * zeta * 40.0 * s + 40.0**2)

    grid = np.unique(np.concatenate([np.geomspace(0.1, 600, 300), 40 * (1 + zeta * np.linspace(-8, 8, 15))]))
    fine = smooth_grid(grid, locus)
    assert np.all(np.isin(grid, fine))
    drawn = locus(fine)
    scale_pt = 400 / 4.0  # of a panel that is four units wide
    full = locus(40 * (1 + zeta * np.linspace(-15, 15, 2000)))
    full = full[np.abs(full) < 3]
    line = drawn[np.abs(drawn) < 4]
    scale = np.full(2, scale_pt)
    assert farthest_pt(full.real, full.imag, line.real, line.imag, scale) < LINE_PT / 2
    rough = locus(grid)
    if zeta < 0.01:
        assert farthest_pt(full.real, full.imag, rough.real, rough.imag, scale) > LINE_PT
    before, after = np.diff(drawn)[:-1], np.diff(drawn)[1:]
    large = (np.abs(before) + np.abs(after)) * scale_pt > 6
    large &= np.abs(drawn[1:-1]) < 3
    assert np.max(np.abs(np.angle(after / before))[large], initial=0.0) < 0.15
    assert fine.size < 1500


def test_the_step_is_shown_until_it_has_settled():
    """The linear runs stop at the disturbance; a line with friction goes on until it has settled."""
    check = example.loop_check(example.config(machine="identified"), 3)
    late = np.append(check.reference[:400], np.full(700, 0.5))
    labels = {"output": ("y", "rad"), "command": ("u", "V")}
    shown = {"others": check.achieved_runs, "disturbance": check.disturbance}
    ends = []
    for settled_s, friction in ((0.0, ()), (2.5, ()), (3.4, ()), (8.0, (late,))):
        picture = draw_closed_loop(
            check.time_s, check.reference, check.predicted_runs, labels, **shown,
            settled_s=settled_s, with_friction=friction,
        )  # fmt: skip
        figure = figure_of(picture)
        ends.append(figure.axes[0].get_xlim()[1])
        first = max(line.get_xdata()[-1] for line in figure.axes[0].lines if "predicted" in line.get_label())
        assert first < 4.0  # where the disturbance begins
    assert ends[0] < 4.0
    step_s = 0.4
    assert ends[1] > step_s + 2.5
    assert ends[2] == pytest.approx(4.0)
    assert ends[3] == pytest.approx(step_s + 1.15 * 8.0)


@pytest.mark.slow
def test_margins_in_the_picture_are_those_of_the_loop():
    known = example.plant().nominal * example.controller().to_control(include_delay=True)
    gain, phase, *_ = control.stability_margins(control.frd(known, np.geomspace(0.3, 300, 2000)))
    words = " ".join(
        text.get_text() for text in pictures(HOSTILE, HOSTILE)["bode-loop"].legends[0].get_texts()
    )
    said = [float(re.search(f"{name} margin ([-.0-9]+)", words)[1]) for name in ("phase", "gain")]
    assert said == pytest.approx([phase, 20 * np.log10(gain)], rel=0.02)


@pytest.mark.parametrize(("n", "D"), [(1, 0.0), (4, 0.0), (4, 2.0), (7, -1.0)])
def test_a_law_to_copy_is_the_law(n, D):
    rng, z = np.random.default_rng(n), np.exp(1j * np.array([0.01, 0.3, 2.0]))
    A, *BC = (rng.standard_normal(shape) for shape in ((n, n), (n, 1), (1, n)))
    law = Controller(A / (1.5 * np.sqrt(n)), *BC, [[D]], 0.01)
    found, known = RunView.forms(law), law.to_control()(z)
    rows = found["sos"] @ np.kron(np.eye(2), z ** -np.arange(3)[:, None])
    np.testing.assert_allclose(np.prod(rows[:, :3] / rows[:, 3:], axis=0), known, rtol=1e-8)
    np.testing.assert_allclose(control.tf(found["num"], found["den"], 0.01)(z), known, rtol=1e-8)
    np.testing.assert_allclose(control.zpk(found["z"], found["p"], found["k"], 0.01)(z), known, rtol=1e-8)


def test_sensitivity_curves_bound_every_member():
    rng = np.random.default_rng(3)
    plant = example.plant()
    gain = example.controller().response(OMEGA)
    curves = sensitivity_curves(plant, example.controller(), example.config().specification, OMEGA)
    s, ks, t, gps = curves
    ellipse, performance = plant.at(OMEGA), plant.performance.at(OMEGA)
    for _ in range(300):
        angle, radius = rng.uniform(0, 2 * np.pi, OMEGA.size), rng.uniform(0, 1, OMEGA.size)
        member = ellipse.points(radius * np.cos(angle), radius * np.sin(angle))
        other = performance.points(radius * np.sin(angle), radius * np.cos(angle))
        size = np.abs(1 / (1 + gain * member))
        assert np.all(size <= s.worst * (1 + 1e-9))
        assert np.all(np.abs(gain) * size <= ks.worst * (1 + 1e-9))
        assert np.all(np.abs(gain * member) * size <= t.worst * (1 + 1e-6))
        assert np.all(np.abs(other) * size <= gps.worst * (1 + 1e-9))
    assert not gps.exact


LABELS = {"output": ("hub", "rad"), "performance": ("tip", "m"), "command": ("voltage", "V")}


def loop_figure(loop: LoopCheck, others: LoopRuns) -> Figure:
    signals, more = (
        (loop.time_s, loop.reference, loop.predicted_runs),
        {"machine": "arm", "command_limit": 24.0},
    )
    return figure_of(draw_closed_loop(*signals, LABELS, others=others, **more))


def test_a_run_that_leaves_the_scene_does_not_flatten_the_others():
    loop = example.loop_check(example.config(), 3)
    runs = loop.achieved_runs
    wild = LoopRuns(runs.output * 1e6, runs.command * 1e6, runs.performance * 1e6, runs.limited)
    low, high = loop_figure(loop, wild).axes[0].get_ylim()
    assert high - low < 10 * np.ptp(loop.predicted_runs.output)


def test_missing_records_are_refused():
    used = RunRecord(example.record([example.model()], "prbs", 1), "estimation", None, "")
    with pytest.raises(ValueError, match="no record"):
        draw_records([], ["u"], ["y"])
    with pytest.raises(ValueError, match="no output column 'wrong'; there is"):
        draw_records([used], [example.INPUT], ["hub_angle_rad", "wrong"])
    with pytest.raises(ValueError, match="no band"):
        draw_repeat_scatter([], name="hub")


def test_stabilisation_marks_say_what_the_record_says():
    plot = example.stabilisation_plot()
    _, right = pictures()["order-1-hub"].axes
    marks = {
        line.get_label(): len(line.get_xdata())
        for line in right.lines
        if not line.get_label().startswith("_")
    }
    assert marks["stable and significant"] == int(np.count_nonzero(plot.stable & plot.needed))
    assert marks["stable, not significant"] == int(np.count_nonzero(plot.stable & ~plot.needed))
    columns = [line.get_xdata()[0] for line in right.lines if line.get_label().startswith("_")]
    np.testing.assert_allclose(columns, [mode.omega_rad_s for mode in plot.columns()])


@pytest.mark.parametrize(("model_error", "floor", "repaired"), [(0.05, 5.0, 0.02), (0.0, 1.0, 0.97)])
def test_every_gap_is_inside_its_panel(model_error, floor, repaired):
    gaps = {"stated": 28.0, "refit": 21.0, "repaired": repaired}
    case, both = SimpleNamespace(model_error=model_error), {"a": gaps, "b": gaps}
    found = SimpleNamespace(gaps=gaps, gap_by_experiment=both, noise_floor=floor, case=case)
    right = figure_of(draw_waterfall(found)).axes[1]
    low, high = right.get_xlim()
    drawn = np.concatenate([np.atleast_1d(line.get_xdata()) for line in right.lines])
    # What leaves nothing beyond noise is drawn at a twentieth of the floor: the axis is logarithmic.
    assert np.min(drawn) == pytest.approx(max(repaired, floor / 20))
    assert low < np.min(drawn)
    assert high > np.max(drawn)


def test_spectra_of_every_output_are_inside_the_shared_panel():
    rng = np.random.default_rng(3)
    sizes = np.array([0.1, 30.0])
    outputs = {"a": sizes * rng.standard_normal((600, 2))}
    case = SimpleNamespace(dt_s=0.01, outputs=("hub_angle_rad", "tip_m"))
    found = SimpleNamespace(case=case, models=("stated",), residuals={"stated": outputs})
    for axes in figure_of(draw_residual_spectra(found)).axes:
        low, high = axes.get_ylim()
        power = axes.lines[0].get_ydata()
        assert low < np.min(power)
        assert high > np.max(power)
