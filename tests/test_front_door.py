"""The front door: every example in it runs, everything it names is there, and importing it costs nothing."""

import doctest
import inspect
import os
import pydoc
import re
import subprocess
import sys
from dataclasses import replace
from functools import cache
from importlib import import_module
from pathlib import Path

import control
import numpy as np
import pytest
from docstring_parser import DocstringStyle, parse
from matplotlib.figure import Figure
from numpy.random import default_rng
from scipy.signal import dlti, lfilter, lti
from threadpoolctl import threadpool_info, threadpool_limits

import flexlink
from flexlink.summaries import SUMMARIES
from ident.data.shown import Shown
from tests.workflow.diagnosis_examples import KnownAnswer, write_case

ROOT = Path(__file__).resolve().parents[1]
GUIDE = ROOT / "docs" / "from_python.md"
RESULTS = {"Identification", "Uncertainty", "SynthesisResult", "Certificate", "LoopRun", "Simulation"}
RESULTS |= {"MultivariableResult", "MultivariableCertificate", "Comparison"}
FLAGS = doctest.ELLIPSIS | doctest.NORMALIZE_WHITESPACE


def example_record() -> flexlink.Record:
    """A mode of 20 rad/s and damping ratio 0.05 behind noise of 0.01."""
    rng = np.random.default_rng(0)
    u = flexlink.prbs(9, 4, 1.0, 2000)
    b, a = (
        [0.0, 0.01, 0.01],
        np.poly(flexlink.Poles.from_continuous(omega_rad_s=[20], zeta=[0.05], dt_s=0.01).values),
    )
    return flexlink.Record(u, lfilter(b, a.real, u) + 0.01 * rng.standard_normal(u.size), 0.01)


def example_plant() -> flexlink.UncertainPlant:
    """A slow real pole, known exactly."""
    return flexlink.UncertainPlant(control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01), name="motor")


def example_specification() -> flexlink.Specification:
    return flexlink.Specification(bandwidth_rad_s=1.0, integrator=True, controller_order=2)


def example_two_joints() -> flexlink.Record:
    """Two inputs and two outputs of one mode, 30 rad/s, that both motors drive and both sensors see."""
    rng = np.random.default_rng(2)
    u = rng.standard_normal((1000, 2))
    poles = flexlink.Poles.from_continuous(omega_rad_s=[30.0], zeta=[0.05], dt_s=0.01)
    seen, driven, shape = [1.0, 0.4], [1.0, -0.3], [1.0, 0.5]
    y = 0.01 * rng.standard_normal((1000, 2))
    for row, sensor in enumerate(seen):
        for column, motor in enumerate(driven):
            coefficients = [sensor * motor * part for part in shape]
            y[:, row] += flexlink.GobfModel(poles, coefficients, dt_s=0.01).simulate(u[:, column])
    return flexlink.Record(u, y, 0.01)


def example_joint_plant() -> flexlink.MultivariablePlant:
    """The plant of that record, with its uncertainty from 0.6 rad/s on: a period of the record's length."""
    found = flexlink.identify_mimo(example_two_joints(), n_real=0, n_pairs=1)
    posterior = flexlink.matrix_posterior(example_two_joints(), found)
    ball = flexlink.ResponseBall.of(posterior, lowest_rad_s=0.6)
    return flexlink.MultivariablePlant("two joints", found.to_control(), ball)


def example_joint_specification() -> flexlink.MultivariableSpecification:
    joint = flexlink.Specification(modulus_margin=0.3, effort_limit=1.0)
    return flexlink.MultivariableSpecification(joints=(joint, joint), controller_order=2)


def example_case() -> flexlink.Case:
    """The paper's link with a joint that rubs, which its maker does not know."""
    rig, rubbing = flexlink.paper_link(), flexlink.effect("coulomb_friction", torque_Nm=0.05)
    experiments = []
    for name, role, amplitude_V in (("a", "estimation", 6.0), ("b", "held_out", 4.0)):
        voltage = flexlink.prbs(8, 4, amplitude_V, 600)
        run = flexlink.simulate(rig, voltage, [rubbing], rng=default_rng(int(amplitude_V)))
        experiments.append(flexlink.Experiment(name, role, run.voltage_V, run.output))
    return flexlink.Case("arm", rig, tuple(experiments))


@cache
def example_spread() -> flexlink.Uncertainty:
    return flexlink.uncertainty(flexlink.identify(example_record(), n_pairs=1, n_real=0))


# What examples of docstrings may use; the site shows these functions beside them.
GIVEN = {
    "control": control,
    "flexlink": flexlink,
    "np": np,
    "default_rng": default_rng,
    "example_record": example_record,
    "example_plant": example_plant,
    "example_specification": example_specification,
    "example_two_joints": example_two_joints,
    "example_joint_plant": example_joint_plant,
    "example_joint_specification": example_joint_specification,
    "example_case": example_case,
}


@pytest.mark.parametrize(
    "module",
    [
        "__init__",
        "models",
        "design",
        "machines",
        "comparison",
        "pictures",
        "tables",
        # A whole diagnosis, as the tutorial of the student is in CI.
        pytest.param("causes", marks=pytest.mark.long),
    ],
)
def test_examples_run(module, monkeypatch):
    monkeypatch.chdir(ROOT)
    found = import_module("flexlink" if module == "__init__" else f"flexlink.{module}")
    runner, finder = doctest.DocTestRunner(optionflags=FLAGS), doctest.DocTestFinder()
    shown = (
        {name: vars(found)[name] for name in getattr(found, "__all__", ())} if module != "__init__" else {}
    )
    for name, thing in (shown or {module: found}).items():
        for test in finder.find(thing, name, module=False, globs=dict(GIVEN)):
            runner.run(test)
    assert runner.tries > 0
    assert runner.failures == 0


@pytest.mark.parametrize(
    "path", [pytest.param(GUIDE, marks=pytest.mark.slow), ROOT / "README.md"], ids=lambda path: path.name
)
def test_documents_run(path, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    result = doctest.testfile(str(path), module_relative=False, optionflags=FLAGS)
    assert result.attempted > 0
    assert result.failed == 0


def test_a_case_of_a_simulator_is_read_as_the_command_reads_it(tmp_path):
    (tmp_path / "motor.py").write_text(
        'INPUTS, OUTPUTS = ("voltage_V",), ("level",)\nPARAMETERS = {"gain": 2.0}\n'
        'def simulate(parameters, effects, inputs):\n    return parameters["gain"] * inputs\n'
    )
    rows = [f"{0.01 * k:.2f},{k % 7},{2.2 * (k % 7) + 0.01 * (k % 3):.2f}" for k in range(300)]
    (tmp_path / "run.csv").write_text("\n".join(["time_s,voltage_V,level", *rows]))
    (tmp_path / "motor.toml").write_text('python = "motor.py"\nlog = "run.csv"\nmodel_error = 0.02\n')
    case = flexlink.load_case(tmp_path / "motor.toml")
    assert (case.name, case.model_error, case.outputs) == ("motor", 0.02, ("level",))
    assert sum(len(e.output) for e in case.experiments) == 300
    first, *roles = repr(case).splitlines()
    assert re.fullmatch(r"PlantCase 'motor': \d records of level, \d+ candidate effects", first)
    assert str(len(case.plant.missing)) in first
    assert [sum(map(int, re.findall(r"(\d+) samples", role))) for role in roles] == [
        sum(len(e.output) for e in records) for records in (case.estimation, case.held_out)
    ]
    with pytest.raises(ValueError, match="no case is there"):
        flexlink.load_case(tmp_path / "other")


def test_a_diagnosis_credits_everything_that_the_repaired_model_holds(tmp_path):
    friction = {"name": "coulomb_friction", "torque_Nm": 0.05}
    delay = {"name": "input_delay", "delay_s": 0.02}
    case = flexlink.load_case(write_case(tmp_path / "arm", friction, delay), "rig_uncertain.toml")
    answer = KnownAnswer((friction, delay))(case)
    found = replace(answer, combination=("coulomb_friction",), ambiguous_with=("input_delay", "backlash"))
    first, *others = repr(found).splitlines()
    assert first == (
        f"Model error / noise: {found.gap_before:.1f} nominal, {found.gap_refit:.1f} re-estimated, "
        f"{found.gap_after:.3f} with coulomb friction and input delay"
    )
    assert "  not excluded: backlash" in others
    delayed = found.table().set_index("effect").loc["input_delay"]
    assert (
        f"  input delay: present with probability {delayed['present']:.2g}, in the repaired model" in others
    )
    assert delayed["main_cause"] == answer.probabilities["input_delay"]


@pytest.mark.slow
def test_ellipses_that_miss_the_model_are_in_doubt_and_so_is_their_certificate():
    """Four real poles cannot be this mode, whose response no ellipse around them has then to hold."""
    system = control.tf([10 / 15 / 100], [1 / 15, 1]) * control.tf([1.6, 1.6, 1600], [1, 1.6, 1600])
    plant = control.sample_system(control.ss(system), 0.01, "zoh")
    rng = np.random.default_rng(3)
    u = rng.choice([-5.0, 5.0], 2000)
    y = control.forced_response(plant, np.arange(2000) * 0.01, u).outputs
    record = flexlink.Record(u, y + 0.002 * rng.standard_normal(2000), 0.01)
    law, asked = flexlink.Controller([[1.0]], [[0.02]], [[1.0]], [[0.0]], 0.01), flexlink.Specification()
    poles = {"fixed_poles": flexlink.Poles(real=[0.9] * 4), "n_real": 0, "n_pairs": 0}
    for how, doubted in ((poles, True), ({"n_real": 1, "n_pairs": 1}, False)):
        found = flexlink.identify(record, integrators=0, **how)
        spread = flexlink.uncertainty(found)
        certificate = flexlink.certify(law, spread, asked)
        first = repr(certificate).splitlines()[0]
        assert certificate.certified
        assert ("the ellipses are in doubt" in first) == doubted
        for said in (spread, certificate):
            assert bool(said.warnings) == ("! the nominal model lies outside" in repr(said)) == doubted
    noisy = lfilter([1.0], [1.0, -1.9, 0.95], rng.standard_normal(2000))  # a line that order 1 cannot whiten
    record = flexlink.Record(u, y + 0.002 * noisy, 0.01)
    found = flexlink.identify(record, integrators=0, n_real=1, n_pairs=1)
    assert flexlink.uncertainty(found).report.ar_coefficients  # as the command: the data decide
    spread = flexlink.uncertainty(found, coloured_noise=True, max_ar_order=1)
    assert "the ellipses, and what is certified for them, may be too small" in repr(spread)
    assert "may be too small" in repr(flexlink.certify(law, spread, asked))


def test_every_name_has_an_example_and_says_its_parameters_and_what_it_returns():
    """A reference page is whole: numpydoc sections, a type beside every name, an example of each."""
    for name in flexlink.__all__:
        thing = getattr(flexlink, name)
        described = parse(inspect.cleandoc(thing.__doc__), DocstringStyle.NUMPYDOC)
        assert described.examples, name
        if hasattr(thing, "model_fields"):
            continue  # settings: the site has a table of their fields
        listed = {
            part.strip().lstrip("*") for entry in described.params for part in entry.arg_name.split(",")
        }
        # Settings by keyword are fields of the options that stand beside them.
        asked = set(inspect.signature(thing).parameters) - {"settings"}
        assert asked <= listed, f"{name}: {asked - listed}"
        assert all(entry.description for entry in described.params), name
        if inspect.isfunction(thing):
            assert described.many_returns, name


def test_every_name_is_there_and_shown_in_an_example():
    shown = GUIDE.read_text(encoding="utf-8")
    named = set()
    for module in ("models", "comparison", "design", "machines", "causes", "pictures", "tables"):
        found = import_module(f"flexlink.{module}")
        named |= set(found.__all__)
        shown += "".join(vars(found)[name].__doc__ for name in found.__all__)
    assert named == set(flexlink.__all__)
    for name in flexlink.__all__:
        assert f"`{name}`" in flexlink.__doc__
        assert name in RESULTS or f"flexlink.{name}" in shown


def test_it_hands_on_the_classes_of_the_packages_and_changes_none():
    """Asked in a process of its own: here everything has been used already."""
    code = """
import control_design.controllers.controller as controller, control_design.plants.plant_set as plants
import ident.basis.model as model, ident.basis.poles as poles, ident.data.record as record
import diagnosis.machine.case as case, ident.data.shown as shown
kinds = {"Record": record, "UncertainPlant": plants, "Controller": controller, "GobfModel": model,
         "Poles": poles, "Case": case, "Experiment": case}
kinds = {name: getattr(module, name) for name, module in kinds.items()}
before = {kind: dict(vars(kind)) for kind in (*kinds.values(), shown.Shown)}
import flexlink
for name in flexlink.__all__:
    getattr(flexlink, name)
repr(flexlink.Record([1.0, 2.0], [1.0, 3.0], 0.01))
for name, kind in kinds.items():
    assert getattr(flexlink, name) is kind, name
for kind, content in before.items():
    assert dict(vars(kind)) == content, kind
"""
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)


def test_importing_it_imports_nothing_else():
    code = "import sys, flexlink; assert not {'numpy', 'ident', 'matplotlib', 'control'} & set(sys.modules)"
    subprocess.run([sys.executable, "-c", code], cwd=ROOT, check=True)
    with pytest.raises(AttributeError, match="nothing_of_ours"):
        _ = flexlink.nothing_of_ours


@pytest.mark.parametrize(
    ("inner", "call"),
    [
        ("flexlink.causes.chain.diagnose", lambda: flexlink.diagnose(None)),
        ("flexlink.models.identify_records", lambda: flexlink.identify(example_record())),
        (
            "ident.response_uncertainty.tangent",
            lambda: flexlink.uncertainty(flexlink.identify(example_record(), n_pairs=1), [example_record()]),
        ),
        (
            "flexlink.design.synthesis.synthesise",
            lambda: flexlink.synthesise(example_plant(), example_specification()),
        ),
        (
            "flexlink.design.certificate.certify",
            lambda: flexlink.certify(TF, example_plant(), example_specification()),
        ),
    ],
)
def test_long_calls_run_on_one_thread(inner, call, monkeypatch):
    def threads(*_args, **_more):
        raise RuntimeError(max(library["num_threads"] for library in threadpool_info()))

    monkeypatch.setattr(inner, threads)
    with threadpool_limits(2):
        with pytest.raises(RuntimeError, match=r"^1$"):
            call()
        assert max(library["num_threads"] for library in threadpool_info()) == 2


@pytest.mark.parametrize("integrators", [0, 1])
def test_the_one_column_of_a_record_is_a_signal(integrators):
    record, given = example_record(), flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    poles = flexlink.Poles.from_continuous(omega_rad_s=[20.0], zeta=[0.05], dt_s=0.01)
    model = flexlink.GobfModel(poles, [0.3, 0.1], feedthrough=0.5, dt_s=0.01, integrators=integrators)
    spread = flexlink.uncertainty(flexlink.identify(record, n_pairs=1, n_real=0))
    for run in (
        lambda u: flexlink.regressor(poles, u),
        model.simulate,
        spread.simulate,
        lambda u: flexlink.simulate(flexlink.paper_link(), u).output,
        lambda u: flexlink.simulate_loop(given, example_plant(), u).measured,
    ):
        np.testing.assert_array_equal(run(record.input), run(record.input[:, 0]))
    with pytest.raises(ValueError, match=r"u must be \(T,\), one input; got shape \(9, 2\)"):
        flexlink.regressor(poles, np.ones((9, 2)))


def test_warnings_print_as_sentences():
    rng = np.random.default_rng(3)
    record, u = example_record(), rng.standard_normal((1000, 2))
    y = lfilter([0.0, 1.0], [1.0, -0.5], u[:, 0]) + lfilter([1.0], [1.0, -0.95], rng.standard_normal(1000))
    for found in (
        flexlink.identify(record, n_pairs=0, n_real=1),
        flexlink.identify_mimo(flexlink.Record(u, y, 0.01), n_pairs=0, n_real=1),
    ):
        assert found.warnings
        for warning in found.warnings:
            assert str(warning) == repr(warning)
            assert f"! {warning}" in repr(found)
            assert "Finding" not in str(warning)


def test_results_show_draw_and_convert():
    record, plant, asked = example_record(), example_plant(), example_specification()
    found = flexlink.identify(record, n_pairs=1, n_real=0)
    spread = flexlink.uncertainty(found)
    given = flexlink.Controller([[1.0]], [[0.05]], [[1.0]], [[0.0]], dt_s=0.01)
    certificate = flexlink.certify(given, plant, asked)
    run = flexlink.simulate_loop(given, plant, [1.0] * 100)
    machine = flexlink.simulate(flexlink.paper_link(), record.input[:100, 0])
    for result in (record, found, found.model, spread, certificate, run, machine):
        assert "object at" not in repr(result)
        assert result._repr_html_().startswith("<p><b>")
        assert isinstance(result.plot(), Figure)
        assert result.plot()._repr_svg_().endswith("</svg>\n")
        assert len(result.table()) > 0
    assert "mode" in found._repr_html_().partition("<table")[2]
    assert certificate.items[0].requirement in certificate._repr_html_().partition("<table")[2]
    assert "Certified" in repr(certificate)
    assert isinstance(flexlink.plot(found.model), Figure)
    np.testing.assert_allclose(found.to_control().poles(), found.model.to_control().poles())
    assert spread.to_control().dt == record.dt_s
    assert type(record.slice(0, 10)) is flexlink.Record
    for call in (flexlink.plot, flexlink.bode, flexlink.table):
        with pytest.raises(TypeError, match="int"):
            call(1)


def fitted_response():
    """A model of one mode, 20 rad/s, fitted to its exact response."""
    omega = np.geomspace(1.0, 300.0, 60)
    response = 1 / (1 - (omega / 20) ** 2 + 0.1j * omega / 20)
    data = flexlink.FrequencyUncertainty(omega, response, np.tile(1e-4 * np.eye(2), (60, 1, 1)), dt_s=0.005)
    return flexlink.identify_frf(data, flexlink.IdentOptions(n_real=0, n_pairs=1))


def test_a_fitted_response_shows_draws_and_converts_as_other_results(tmp_path):
    fitted = fitted_response()
    for text in (repr(fitted), str(fitted), f"{fitted}", repr([fitted])):
        assert "mode at 20 rad/s" in text
        assert "inside 100 % of 60 ellipses, 1 to 300 rad/s" in text
        assert "object at" not in text
    assert fitted._repr_html_().startswith("<p><b>")
    assert isinstance(fitted.plot(), Figure)
    row = fitted.table().iloc[0]
    assert (row["omega_rad_s"], row["zeta_std"]) == (
        fitted.model.poles.omega_rad_s(0.005)[0],
        fitted.zeta_std[0],
    )
    fitted.save(tmp_path / "fitted.json")
    assert (tmp_path / "fitted.json").stat().st_size > 100
    np.testing.assert_array_equal(fitted.to_control().A, fitted.model.to_control().A)
    # A plant of it has its ellipses, and what already is an uncertainty is not estimated again.
    assert flexlink.UncertainPlant(fitted).uncertainty is fitted.posterior
    with pytest.raises(ValueError, match=r"brings its uncertainty: fitted\.posterior"):
        flexlink.uncertainty(fitted)


def test_every_public_result_prints():
    """Every class of results has its sentences; a result without any prints as an object, never fails."""
    for name in flexlink.__all__:
        getattr(flexlink, name)

    def derived(kind):
        for child in kind.__subclasses__():
            yield child
            yield from derived(child)

    ours = {
        kind
        for kind in derived(Shown)
        if kind.__module__.split(".")[0] in {"control_design", "diagnosis", "flexlink", "ident", "plant"}
    }
    abstract = {"FittedRecords"}  # its two kinds are shown
    without = {kind.__name__ for kind in ours if not any(k.__name__ in SUMMARIES for k in kind.__mro__)}
    assert without == abstract

    class Own(Shown):
        pass

    assert "Own object" in repr(Own())

    fitted = fitted_response()
    repeats = flexlink.FrfRepeats(np.repeat(fitted.omega_rad_s, 3), np.repeat(fitted.response.centre, 3))
    found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    intervals = flexlink.pole_intervals(fitted.posterior, fitted.model.poles)
    for result in (
        fitted, fitted.posterior, fitted.response, fitted.search, fitted.order_table, fitted.verdicts,
        repeats, found.search, found.structure, intervals, found.model.poles,
    ):  # fmt: skip
        assert "object at" not in repr(result).splitlines()[0]


def test_tables_say_what_the_results_say():
    record, plant = example_record(), example_plant()
    found = flexlink.identify(record, n_pairs=1, n_real=0)
    row = found.table().iloc[0]
    assert row["omega_rad_s"] == found.model.poles.omega_rad_s(0.01)[0] == 2 * np.pi * row["frequency_Hz"]
    spread = flexlink.uncertainty(found)
    rows = spread.table()
    assert (rows["gain_low"] <= rows["gain"]).all()
    assert (rows["gain"] <= rows["gain_high"]).all()
    again = flexlink.Record.from_table(record.table(), "u", "y", time="time_s")
    np.testing.assert_array_equal(again.output, record.output)
    with pytest.raises(ValueError, match="index holds no times"):
        flexlink.Record.from_table(record.table(), "u", "y")
    with pytest.raises(ValueError, match="no column 'v'"):
        flexlink.Record.from_table(record.table(), "v", "y", time="time_s")
    result = flexlink.synthesise(plant, example_specification(), flexlink.SynthesisOptions(starts=1))
    assert result.table().columns.to_list() == ["plant", "weight", "omega_rad_s", "value"]


def test_responses_of_any_origin_on_one_plot():
    record, plant = example_record(), example_plant()
    found = flexlink.identify(record, n_pairs=1, n_real=0)
    measured = flexlink.empirical_frf([record])
    system = found.to_control()
    figure = flexlink.bode(found, flexlink.uncertainty(found), measured, plant, system)
    lines = figure.axes[0].get_lines()
    # The system of python-control is the identified model.
    np.testing.assert_allclose(lines[4].get_ydata(), lines[0].get_ydata(), rtol=1e-6)
    np.testing.assert_array_equal(lines[2].get_xdata(), measured.omega_rad_s)
    with pytest.raises(ValueError, match="a name for each response; got 2 responses and 1 names"):
        flexlink.bode(found, plant, names=["one"])
    with pytest.raises(TypeError, match="discrete time"):
        flexlink.bode(control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]]))


def test_pictures_take_axes_scales_and_frequencies():
    axes, omega = Figure().subplots(2, 3), np.array([1.0, 10.0, 40.0])
    law, plant, z = flexlink.Controller.proportional(0.5, 0.01), example_plant(), np.exp(0.01j * omega)
    loop = 0.5 / z * 0.1 / (z - 0.9)  # a sample of computational delay
    more = {"omega_rad_s": omega}
    flexlink.bode(plant, law, ax=axes[:, 0], dB=True, Hz=True, **more)
    flexlink.nyquist(plant, law, ax=axes[0, 1], **more)
    flexlink.nichols(flexlink.certify(law, plant, example_specification()), ax=axes[1, 1], **more)
    flexlink.step(plant, law, ax=axes[:, 2])
    bode, nyquist, nichols, step = (at.lines[0].get_xydata().T for at in axes.T.ravel()[[0, 2, 3, 4]])
    np.testing.assert_allclose(bode, [omega / (2 * np.pi), 20 * np.log10(abs(loop * 2))])
    np.testing.assert_allclose(nyquist, [loop.real, loop.imag])
    np.testing.assert_allclose(nichols, [np.degrees(np.angle(loop)), 20 * np.log10(abs(loop))])
    assert step[1, -1] == pytest.approx(1 / 3, rel=0.02)  # 0.5 / (1 + 0.5)
    assert flexlink.bode(law, **more).axes[0].lines[0].get_ydata() == pytest.approx(0.5)
    with pytest.raises(ValueError, match="expected 2 axes, one for each panel; got 3"):
        flexlink.bode(plant, law, ax=axes[0])


TF = control.tf([0.1, 0.05], [1.0, -1.5, 0.6], 0.01)
OMEGA = np.array([20.0, 1.0, 5.0])


def _by_hand(omega):
    z = np.exp(1j * omega * 0.01)
    return (0.1 * z + 0.05) / (z**2 - 1.5 * z + 0.6)


@pytest.mark.parametrize(
    "system",
    [TF, control.ss(TF), control.zpk([-0.5], [0.75 - 0.19364916731j, 0.75 + 0.19364916731j], 0.1, 0.01),
     dlti([0.1, 0.05], [1.0, -1.5, 0.6], dt=0.01), flexlink.UncertainPlant(TF)],
    ids=["tf", "ss", "zpk", "scipy", "own"],
)  # fmt: skip
def test_systems_of_other_packages_are_plants_and_controllers(system):
    line = flexlink.bode(system).axes[0].get_lines()[0]
    np.testing.assert_allclose(line.get_ydata(), np.abs(_by_hand(line.get_xdata())), rtol=1e-6)
    asked = flexlink.Specification(bandwidth_rad_s=1.0, modulus_margin=0.3)
    own = flexlink.certify(flexlink.Controller.proportional(0.2, 0.01), flexlink.UncertainPlant(TF), asked)
    given = flexlink.certify(control.tf([0.2], [1.0], 0.01), system, asked)
    modulus = [each.plants[0].nominal_margins.modulus for each in (own, given)]
    assert modulus[1] == pytest.approx(modulus[0], rel=1e-9)
    # The delay of the specification is in the loop: |1 + 0.2 z^-1 G| on a grid.
    omega = np.geomspace(1e-2, np.pi / 0.01, 20000)
    loop = 0.2 * np.exp(-1j * omega * 0.01) * _by_hand(omega)
    assert modulus[1] == pytest.approx(np.min(np.abs(1 + loop)), rel=1e-5)


def test_a_measured_response_is_drawn_and_stands_beside_a_model():
    frd = control.frd(_by_hand(OMEGA), OMEGA, 0.01)
    line = flexlink.bode(frd, names="measured").axes[0].get_lines()[0]
    np.testing.assert_array_equal(line.get_xdata(), np.sort(OMEGA))
    np.testing.assert_allclose(line.get_ydata(), np.abs(_by_hand(np.sort(OMEGA))))
    for plant in (flexlink.UncertainPlant(TF, uncertainty=frd), flexlink.UncertainPlant(frd, nominal=TF)):
        np.testing.assert_array_equal(plant.own_grid, np.sort(OMEGA))


def test_a_time_response_of_python_control_is_a_record():
    u = np.r_[np.ones(20), -np.ones(30)]
    record = flexlink.Record(control.forced_response(TF, inputs=u), name="simulated", input_names="voltage_V")
    np.testing.assert_array_equal(record.input[:, 0], u)
    expected = lfilter([0.1, 0.05], [1.0, -1.5, 0.6], np.r_[0.0, u[:-1]])
    np.testing.assert_allclose(record.output[:, 0], expected)
    assert record.dt_s == pytest.approx(0.01)
    assert record.input_names == ("voltage_V",)


def test_one_name_may_stand_by_itself(tmp_path):
    (tmp_path / "log.csv").write_text("t_s,voltage_V,angle\n0,1,0\n0.1,1,2\n0.2,0,3\n")
    record = flexlink.Record.from_file(tmp_path / "log.csv", "voltage_V", "angle", time="t_s")
    assert (record.input_names, record.output_names) == (("voltage_V",), ("angle",))
    assert flexlink.Record([1.0, 2.0], [3.0, 4.0], 0.1, output_names="angle").output_names == ("angle",)
    table = record.table()
    again = flexlink.Record.from_table(table, ["voltage_V"], ["angle"], time="time_s")
    assert again.output_names == ("angle",)


TWO = control.ss(np.eye(2) / 2, np.eye(2), np.eye(2), np.zeros((2, 2)), 0.01)


@pytest.mark.parametrize(
    ("system", "message"),
    [
        (control.tf([1.0], [1.0, 1.0]), r"continuous time.*control\.sample_system\(system, dt_s, 'zoh'\)"),
        (control.ss([[-1.0]], [[1.0]], [[1.0]], [[0.0]], 0), r"control\.sample_system"),
        (control.tf([0.1], [1.0, -0.9], True), r"dt = True.*system\.dt = dt_s"),
        (control.tf([0.1], [1.0, -0.9], None), r"dt = None.*system\.dt = dt_s"),
        (TWO, r"2 inputs and 2 outputs; take one channel.*system\[0, 0\]"),
        (control.tf([1.0, 0.0, 0.0], [1.0, 0.5], 0.01), r"more zeros than poles.*num no longer than den"),
        (lti([1.0], [1.0, 1.0]), r"continuous time"),
        ("hub", r"is a str; expected a discrete system"),
        (control.frd([1.0, 2j], [1.0, 2.0]), r"continuous time|no poles: identify it with flex"),
    ],
)
def test_systems_that_cannot_be_used_are_refused_with_what_to_do(system, message):
    given = flexlink.Controller.proportional(0.1, 0.01)
    for call in (
        lambda: flexlink.UncertainPlant(system),
        lambda: flexlink.certify(given, system, example_specification()),
        lambda: flexlink.certify(system, example_plant(), example_specification()),
        lambda: flexlink.bode(system),
        lambda: flexlink.bode(TF, system),
        lambda: flexlink.synthesise([system], example_specification()),
        lambda: flexlink.youla_bracket(system, example_specification()),
        lambda: flexlink.simulate_loop(system, example_plant(), [1.0] * 3),
    ):
        with pytest.raises((ValueError, TypeError), match=message) as raised:
            call()
        assert "\n" not in str(raised.value)


def test_another_sampling_time_is_refused_with_what_to_do():
    slow = control.tf([0.1], [1.0, -0.9], 0.02)
    with pytest.raises(ValueError, match=r"0\.02.*0\.01|0\.01.*0\.02"):
        flexlink.certify(slow, example_plant(), example_specification())
    with pytest.raises(ValueError, match=r"0\.02.*sample"):
        flexlink.certify(control.tf([0.1], [1.0], 0.01), [example_plant(), slow], example_specification())
    with pytest.raises(ValueError, match=r"0\.02.*sample"):
        flexlink.simulate_loop(slow, example_plant(), [1.0] * 3)


def test_what_needs_its_keyword_is_shown_with_it():
    with pytest.raises(ValueError, match=r"expected UncertainPlant\(plant, name=\.\.\., uncertainty=\.\.\."):
        flexlink.UncertainPlant(example_plant().nominal, "motor", None)
    with pytest.raises(ValueError, match=r"expected step\(result, controller, ax=\.\.\., time_s=\.\.\."):
        flexlink.step(example_plant(), None, 3)
    with pytest.raises(ValueError, match=r"expected identify\(records, options, \.\.\.\)"):
        flexlink.identify()


@pytest.mark.parametrize("n_samples", [12, 22, 23])
def test_a_record_too_short_for_an_uncertainty_is_refused_with_what_helps(n_samples):
    rng = np.random.default_rng(1)
    u = rng.standard_normal(n_samples)
    y = lfilter([0.0, 0.5], [1.0, -0.5], u) + 0.01 * rng.standard_normal(n_samples)
    found = flexlink.identify(flexlink.Record(u, y, 0.01), n_real=1, n_pairs=0)
    with pytest.raises(
        ValueError, match=rf"{n_samples} samples are too few.*at least 24.*prior_missed_mode = 0"
    ):
        flexlink.uncertainty(found)
    assert flexlink.uncertainty(found, prior_missed_mode=0).dt_s == 0.01
    longer = flexlink.Record(np.tile(u, 2), np.tile(y, 2), 0.01)
    assert flexlink.uncertainty(flexlink.identify(longer, n_real=1, n_pairs=0)).dt_s == 0.01


def test_every_function_refuses_an_unknown_keyword_in_one_line():
    functions = list(filter(inspect.isfunction, (getattr(flexlink, name) for name in flexlink.__all__)))
    assert len(functions) > 25
    for each in functions:
        if not hasattr(each, "registry") and not any(
            one.kind is one.VAR_KEYWORD for one in inspect.signature(each).parameters.values()
        ):
            with pytest.raises(
                ValueError, match=f"^{each.__name__}: unknown keyword quite_unheard_of [(].*[)]$"
            ):
                each(quite_unheard_of=1)


def test_every_class_refuses_an_unknown_keyword_in_one_line():
    classes = list(filter(inspect.isclass, (getattr(flexlink, name) for name in flexlink.__all__)))
    assert len(classes) > 25
    for each in classes:
        with pytest.raises(ValueError, match=f"^{each.__name__}: .*quite_unheard_of") as caught:
            each(quite_unheard_of=1)
        assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: flexlink.Record(u=[1.0, 2.0], dt_s=0.1), "give y"),
        (lambda: flexlink.Record(u=[1.0, 2.0], y=[1.0, 2.0]), "dt_s"),
        (lambda: flexlink.Record(u=[1.0, 2.0], y=[1.0], dt_s=0.1), "equally long"),
        (lambda: flexlink.identify(example_record(), pairs=1), "pairs"),
        (lambda: flexlink.identify(example_record(), flexlink.IdentOptions(), n_pairs=1), "not both"),
        (lambda: flexlink.synthesise(TF, None, startz=1), "SynthesisOptions: unknown key startz .*starts"),
        (lambda: flexlink.certify(None, TF, ndense=9), "certify: unknown keyword ndense .*n_dense"),
        (lambda: flexlink.Controller(dt=0.1), "Controller: unknown keyword dt .did you mean dt_s"),
        (lambda: flexlink.Poles(reel=[0.5]), "Poles: unknown keyword reel .did you mean real"),
        (lambda: flexlink.GobfModel(flexlink.Poles(real=[0.8]), [1.0], 1000), "did you mean 1/1000"),
        (lambda: flexlink.Controller.proportional(0.1, 250), r"mean 1/250.*it is 0\.004"),
        (lambda: flexlink.UncertainPlant(control.tf([0.1], [1, -0.9], 250)), "did you mean 1/250"),
        (lambda: flexlink.simulate(flexlink.paper_link(), [1.0], dt_s=100.0), "did you mean 1/100"),
        (lambda: flexlink.Record([1.0], [1.0], 0.1, unit="V"), "Record: unknown keyword unit"),
        (lambda: flexlink.prbs(8, 4, 6.0, 500, sed=1), "did you mean seed|known keywords"),
        (lambda: flexlink.effect("magic"), "unknown effect 'magic'"),
        (lambda: flexlink.effect("viscous_friction", c=1.0), "known: coefficient_Nms"),
        (lambda: flexlink.Specification(bandwith_rad_s=1.0), "did you mean bandwidth_rad_s"),
        (lambda: flexlink.YoulaOptions(zzz=3), "known keys: dense_points"),
        (lambda: flexlink.RationalWeight(numerator=[1.0]), "missing key denominator"),
        (lambda: flexlink.MultivariableOptions(starts=0), "starts: .*got 0"),
        (lambda: flexlink.identify([1.0]), r"flexlink\.Record\(u=u"),
        (lambda: flexlink.identify(np.ones(9), np.ones(9)), r"flexlink\.Record\(u=u"),
        (lambda: flexlink.identify(np.ones(9), np.ones(9), 0.1), r"^identify: expected .*Record\(u=u"),
        (lambda: flexlink.simulate(), r"^simulate: expected simulate\(rig, "),
        (lambda: flexlink.uncertainty(example_record()), "result of flexlink.identify"),
        (lambda: flexlink.uncertainty(None, level=0.9), r"spread\.at"),
        (lambda: flexlink.simulate_loop(TF, flexlink.paper_link(), [1.0]), "SampledArm"),
        (lambda: flexlink.Record([1.0], [1.0], "5ms"), "a positive number of seconds; got '5ms'"),
        (lambda: flexlink.MultivariablePlant("two", control.ss(TF), 3.0), r"a ResponseBall, .*\.of\("),
        (lambda: flexlink.Record([1.0], [1.0], dt=0.1), "Record: unknown keyword dt .did you mean dt_s"),
        (lambda: flexlink.identify(example_record(), order=4), "order .did you mean n_real and n_pairs"),
        (lambda: flexlink.Specification(order=4), "order .did you mean controller_order"),
        (lambda: flexlink.synthesise(TF, None, order=4), r"Specification\(controller_order=\.\.\.\)"),
        (lambda: flexlink.Record.from_file("log.csv", "u", "y", Time="t"), "unknown keyword Time .*time"),
        (lambda: example_spread().at([1e6]), r"from 0 to pi / dt_s = 314\.159; got 1e\+06"),
        (lambda: example_spread().at(5.0), r"got a number: give \[5\]"),
        (
            lambda: flexlink.SampledArm(flexlink.paper_link(), dt=0.01),
            "unknown keyword dt .did you mean dt_s",
        ),
        (
            lambda: flexlink.SampledArm([], flexlink.paper_link()),
            "rig is of type list, expected Rig: Sampled",
        ),
        (
            lambda: flexlink.SampledArm(flexlink.paper_link(), np.random.default_rng(1)),
            r"effects is of type Generator, expected a list: SampledArm\(rig, effects, rng, dt_s",
        ),
        (
            lambda: flexlink.SampledArm(flexlink.paper_link(), dt_s="5ms"),
            "dt_s is of type str, expected a num",
        ),
        (lambda: flexlink.Rig(length_m=1.0), "^Rig: length_m: unknown key .did you mean link.length_m"),
        (lambda: flexlink.Rig(links={}), "^Rig: links: unknown key .*link"),
        (
            lambda: flexlink.simulate([1.0], flexlink.paper_link()),
            "rig is of type list, expected Rig: simulate",
        ),
        (
            lambda: flexlink.identify(example_record(), 4),
            "options is of type int, expected IdentOptions or No",
        ),
        (
            lambda: flexlink.GobfModel([1.0], flexlink.Poles(real=[0.5]), 0.1),
            "poles is of type list, expected",
        ),
        (lambda: flexlink.Record(0.1, np.ones(9), np.ones(9)), r"dt_s must be .*got values of shape \(9,\)"),
        (lambda: flexlink.diagnose("examples/gap_case"), r"case is of type str, .*flexlink\.load_case"),
        (
            lambda: flexlink.Specification(3.0),
            r"fields are given by name, as Specification\(bandwidth_rad_s=",
        ),
        (lambda: flexlink.paper_link(dt_s=0.01), "unknown keyword dt_s .it takes no arguments"),
    ],
)
def test_what_is_wrong_is_said_in_one_line(call, message):
    with pytest.raises(ValueError, match=message) as caught:
        call()
    assert "\n" not in str(caught.value)


def test_an_unstable_loop_is_called_so_and_has_no_margins():
    """A sign turned round, in one channel and in two."""
    wrong = control.tf([-0.5, 0.45], [1.0, -1.0], 0.01)
    found = flexlink.certify(wrong, example_plant(), flexlink.Specification(bandwidth_rad_s=1.0))
    assert repr(found).splitlines()[0].startswith("Not certified: the nominal loop of 'motor' is UNSTABLE")
    assert np.isnan(list(vars(found.plants[0].worst_margins).values())).all()
    assert np.isnan(found.plants[0].bandwidth_rad_s)
    assert found.table()["achieved"].isna().all()
    both = control.append(control.ss(TF), control.ss(TF))
    joint = flexlink.Specification(modulus_margin=0.3)
    wanted = flexlink.MultivariableSpecification(joints=(joint, joint), controller_order=2)
    given = flexlink.Controller(np.zeros((1, 1)), np.zeros((1, 2)), np.zeros((2, 1)), -3 * np.eye(2), 0.01)
    matrix = flexlink.certify_multivariable(given, flexlink.MultivariablePlant("two", both), wanted)
    assert "UNSTABLE" in repr(matrix)


@pytest.mark.parametrize("harder", [0, 1])
def test_of_several_joints_the_one_that_is_worst_is_named(harder):
    """Two motors that do not touch each other; one has twice the gain, or the only bandwidth."""
    motor = control.ss([[0.9]], [[1.0]], [[0.1]], [[0.0]], 0.01)
    plant = flexlink.MultivariablePlant("two", control.append(motor, motor))
    joint = flexlink.Specification(modulus_margin=0.3, effort_limit=10.0)
    faster = joint.model_copy(update={"bandwidth_rad_s": 5.0})
    wanted = flexlink.MultivariableSpecification(joints=(joint, joint), controller_order=2)
    gains = 0.25 * np.diag(1.0 + (np.arange(2) == harder))
    given = control.ss([], [], [], gains, 0.01)
    found = flexlink.certify_multivariable(given, plant, wanted)
    assert found.verdicts[0].worst_joint == {"effort": harder, "modulus": harder}
    assert f"(largest at joints[{harder}], " in repr(found)
    asked = wanted.model_copy(update={"joints": (faster, joint)[:: 1 - 2 * harder]})
    quick = flexlink.MultivariableOptions(rounds=1, steps=1)
    designed = flexlink.synthesise_multivariable(plant, asked, quick)
    assert re.search(rf"tracking: .* against 1 \(joints\[{harder}\] of 'two' at ", repr(designed))
    with pytest.raises(ValueError, match="2 joints needed for 2 inputs and 2 outputs; got 1"):
        flexlink.certify_multivariable(given, plant, wanted.model_copy(update={"joints": (joint,)}))


def test_without_uncertainty_the_certificate_is_of_the_nominal_plant_and_says_so():
    found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    asked = flexlink.Specification(modulus_margin=0.3)
    given = flexlink.Controller.proportional(0.05, 0.01)
    spread = flexlink.uncertainty(found, flexlink.EmbeddingOptions(prior_missed_mode=0.0))
    for plant, nominal in ((found, True), (found.to_control(), True), (spread, False)):
        certificate = flexlink.certify(given, plant, asked)
        assert certificate.nominal_only is nominal
        assert ("nominal plant only" in repr(certificate)) is nominal
        assert (certificate.table()["about"] == "nominal loop").all() == nominal


def test_the_order_given_reaches_the_uncertainty():
    record = example_record()
    given = flexlink.uncertainty(flexlink.identify(record, n_pairs=1, n_real=0))
    assert given.report.probability_no_remainder == 0
    chosen = flexlink.uncertainty(flexlink.identify(record, max_pairs=1, max_real=0))
    assert chosen.report.probability_no_remainder > 0
    assert not given.missed_mode_suspected  # the record has one mode: nothing speaks for another
    assert "may be missing" not in repr(given)


def test_fixed_poles_are_taken_in_every_form():
    poles = flexlink.Poles(real=[0.8], pairs=[0.9 + 0.3j])
    for form in (poles, poles.values, [0.8, 0.9 + 0.3j], [(0.8, 0.0), (0.9, 0.3)]):
        fixed = flexlink.IdentOptions(fixed_poles=form, n_real=0, n_pairs=0).fixed()
        np.testing.assert_array_equal(fixed.values, poles.values)
    outside = flexlink.IdentOptions(unstable_poles=[1.1]).unstable()
    np.testing.assert_array_equal(outside.values, [1 / 1.1])


@pytest.mark.parametrize("kind", ["IdentOptions", "EmbeddingOptions", "Specification", "SynthesisOptions",
    "YoulaOptions", "RationalWeight", "MultivariableOptions", "MultivariableSpecification"])  # fmt: skip
def test_help_of_options_lists_every_field(kind):
    options = getattr(flexlink, kind)
    for name, field in options.model_fields.items():
        assert re.search(rf"^    {name}( = .+)?: {re.escape(field.description)}$", options.__doc__, re.M)


def test_error_surface_and_bracket_have_table_print_and_picture():
    found = flexlink.identify(example_record(), n_pairs=1, n_real=0)
    for coordinates in ("log", "raw"):
        surface = flexlink.error_surface(found, n_points=9, coordinates=coordinates)
        assert isinstance(surface.plot(), Figure)
        assert len(surface.table()) == 81
        assert repr(surface).startswith("Error surface")
    coarse = flexlink.YoulaOptions(grid_points=60, dense_points=1000)
    bracket = flexlink.youla_bracket(example_plant(), example_specification(), coarse)
    assert bracket.table()["inscribed"][0] == bracket.floor
    with pytest.raises(TypeError, match="there is one of Certificate, "):
        flexlink.plot(bracket)


def test_a_plant_module_of_the_users_own_is_not_taken_for_ours(tmp_path):
    (tmp_path / "plant.py").write_text("raise RuntimeError('not ours')\n")
    for arguments in (
        ["-c", "import flexlink; flexlink.paper_link()"],
        ["-c", "from flexlink.__main__ import main; from plant.presets import paper_link"],
    ):
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=tmp_path,
            env={**os.environ, "PYTHONPATH": f".{os.pathsep}{Path(flexlink.__file__).parents[1]}"},
            capture_output=True,
            text=True,
            check=False,
        )
        assert done.returncode == 0, done.stderr


def test_the_help_of_settings_is_one_screen_of_ordinary_types():
    for kind in (flexlink.Specification, flexlink.SynthesisOptions, flexlink.YoulaOptions):
        told = pydoc.plain(pydoc.render_doc(kind))
        assert len(told.splitlines()) <= 45  # lines of a screen, with an example
        assert not re.search("Annotated|FieldInfo|model_|pydantic_", told.partition("Method resolution")[0])
        assert all(re.search(rf"^ \|  {name}\b.*: \S", told, re.MULTILINE) for name in kind.model_fields)
