"""`flexlink design` on plants that were not identified here: files in, certificates and complaints out."""

import json

import control
import numpy as np
import pytest
import scipy.io

from control_design import Controller
from control_design.convex.reference_filter import ReferenceFilter
from ident import GobfModel, Poles
from ident.basis.model_files import ModelFile
from ident.data.frequency_uncertainty import FrequencyUncertainty

DT_S = 0.05
# A loose search: these tests are about files, not about the last percent of gamma.
QUICK = """
[synthesis]
starts = 1
agreeing_starts = 1
exchange_rounds = 1
dense_points = 1000
sufficient_gamma = 0.95
"""
WISH = """
[specification]
bandwidth_rad_s = 0.7
modulus_margin = 0.4
effort_limit = 20.0
controller_order = 3
"""


def arm(gain: float = 1.0, mode_rad_s: float = 12.0) -> control.StateSpace:
    """A lag and a light mode, sampled."""
    mode = control.tf([mode_rad_s**2], [1.0, 0.1 * mode_rad_s, mode_rad_s**2])
    return control.sample_system(control.ss(control.tf([gain], [0.5, 1.0]) * mode), DT_S)


def document(system: control.StateSpace) -> dict[str, object]:
    matrices = {name: np.asarray(getattr(system, name)).tolist() for name in "ABCD"}
    return {**matrices, "dt_s": system.dt}


def write_json(path, content) -> None:
    path.write_text(json.dumps(content))


def write_response(path, *, spread=0.02, seed=1, header=True, order=None) -> None:
    """Response of `arm` with noise of relative standard deviation `spread`, and its variances."""
    omega = np.geomspace(0.1, 60.0, 60)
    value = arm()(np.exp(1j * omega * DT_S))
    noise = np.random.default_rng(seed).standard_normal((2, omega.size))
    sd = spread * np.abs(value)
    value = value + sd * (noise[0] + 1j * noise[1])
    rows = [
        f"{w!r},{g.real!r},{g.imag!r},{s**2!r},{s**2!r}"
        for w, g, s in zip(omega.tolist(), value.tolist(), sd.tolist(), strict=True)
    ]
    if order is not None:
        rows = [rows[index] for index in order]
    path.write_text("\n".join(["omega_rad_s,real,imag,variance_real,variance_imag", *rows]) + "\n")


def write_repeats(path, repeats=8) -> None:
    omega = np.repeat(np.geomspace(0.1, 60.0, 40), repeats)
    noise = np.random.default_rng(3).standard_normal((2, omega.size))
    value = arm()(np.exp(1j * omega * DT_S)) * (1 + 0.01 * (noise[0] + 1j * noise[1]))
    rows = [f"{w!r},{g.real!r},{g.imag!r}" for w, g in zip(omega.tolist(), value.tolist(), strict=True)]
    path.write_text("\n".join(["omega_rad_s,real,imag", *rows]) + "\n")


def model_file(*, ellipses=True) -> ModelFile:
    """A GOBF model with a lag and a mode, and ellipses of 3 %."""
    poles = Poles(np.array([0.9]), np.array([np.exp((-0.6 + 11.9j) * DT_S)]))
    model = GobfModel(poles, np.array([0.2, 0.05, 0.02]), DT_S, output_name="hub")
    if not ellipses:
        return ModelFile(model)
    omega = np.geomspace(0.05, 60.0, 150)
    centre = model.frequency_response(omega)
    covariance = (0.03 * np.abs(centre))[:, None, None] ** 2 / 6 * np.eye(2)
    return ModelFile(model, FrequencyUncertainty(omega, centre, covariance, DT_S))


@pytest.fixture
def wish(tmp_path):
    """A design file made of the usual wishes and more, beside a file of `arm`."""
    write_json(tmp_path / "arm.json", document(arm()))

    def write(more: str = "", wishes: str = WISH):
        path = tmp_path / "wish.toml"
        path.write_text(wishes + more + QUICK)
        return path

    return write


def numbers(answer, code=0):
    return answer.document(code)["numbers"]


def test_state_space_with_stated_uncertainty(flexlink, wish, tmp_path):
    """JSON and MAT give one controller, certified between grid points, and true for members of the set."""
    system = arm()
    variables = {"A": system.A, "B": system.B, "C": system.C, "D": system.D, "Ts": DT_S}
    scipy.io.savemat(tmp_path / "arm.mat", variables)
    spec = wish("[uncertainty]\nmultiplicative = 0.1\n")
    found = []
    for name in ("arm.json", "arm.mat"):
        out = tmp_path / f"controller_{name}.json"
        answer = flexlink("design", tmp_path / name, "--spec", spec, "--out", out, "--json")
        found.append((numbers(answer), Controller.from_json(out.read_text())))
    assert np.array_equal(found[0][1].A, found[1][1].A)
    verdict = found[0][0]["certificate"]["plants"][0]
    assert verdict["all_frequencies"]["proved"] is True
    law = found[0][1].to_control(include_delay=True)
    z = np.exp(1j * np.geomspace(0.01, np.pi / DT_S, 3000) * DT_S)
    for factor in (0.9, 1.0, 1.1):
        assert np.all(np.abs(control.feedback(law * arm(), factor).poles()) < 1)
        assert np.max(np.abs(1 / (1 + factor * law(z) * arm()(z)))) <= verdict["worst_peak_sensitivity"]


def test_design_says_how_far_it_is_from_any_order_and_brings_its_reference_filter(flexlink, wish, tmp_path):
    more = (
        "[uncertainty]\nmultiplicative = 0.1\n[reference_filter]\ncorner_rad_s = 2.0\ndense_points = 1000\n"
    )
    out = tmp_path / "law.json"
    answer = flexlink("design", tmp_path / "arm.json", "--spec", wish(more), "--out", out, "--json")
    found = numbers(answer)
    achievable, gamma = found["achievable_performance"], found["design"]["synthesis"]["gamma"]
    assert achievable["floor"] <= achievable["reached"] <= gamma
    assert achievable["above_percent"] == pytest.approx(100 * (gamma / achievable["reached"] - 1))
    assert "a bound, not a distribution" in found["sampled_responses"]["reason"]
    filtered = found["reference_filter"]
    assert filtered["error_after"] < filtered["error_before"]
    beside = tmp_path / "law_reference_filter.json"
    assert found["files"] == [str(out), str(beside)]
    assert np.array_equal(ReferenceFilter.from_json(beside.read_text()).A, filtered["A"])
    table = {row["label"]: row["value"] for row in answer.document()["table"]}
    assert "lower bound for any order" in table["controller order"]
    assert "times smaller" in table["model matching"]


def test_model_without_uncertainty_says_what_its_certificate_holds_for(flexlink, wish, tmp_path):
    found = numbers(flexlink("design", tmp_path / "arm.json", "--spec", wish(), "--json"))
    assert "exactly this model" in found["plants"][0]["remarks"][0]
    assert found["certificate"]["plants"][0]["stated"] is False


@pytest.mark.parametrize("ending", ["json", pytest.param("mat", marks=pytest.mark.long)])
def test_exported_model_brings_its_ellipses(flexlink, wish, tmp_path, ending):
    path = tmp_path / f"model.{ending}"
    path.write_bytes(model_file().to_json().encode() if ending == "json" else model_file().to_mat())
    found = numbers(flexlink("design", path, "--spec", wish(), "--json"))
    verdict = found["certificate"]["plants"][0]
    assert verdict["plant"] == "hub"
    assert verdict["own_grid_rad_s"] == pytest.approx([0.05, 60.0])


@pytest.mark.slow
def test_measured_response_on_its_own_grid_and_fitted(flexlink, wish, tmp_path):
    """With a model given for the poles and with a fitted one."""
    write_response(tmp_path / "frf.csv")
    fit = 'fit = { n_real = 1, n_pairs = 1 }\nbetween_points = "nothing"\n'
    for more, origin, proved in (
        ('nominal = "arm.json"\n', "measured response", True),
        (fit, "measured response, poles of a fitted model", False),
    ):
        spec = wish(f"[plant]\ndt_s = {DT_S}\n{more}")
        found = numbers(flexlink("design", tmp_path / "frf.csv", "--spec", spec, "--json"))
        assert found["plants"][0]["origin"] == origin
        assert found["certificate"]["plants"][0]["all_frequencies"]["proved"] is proved


def test_repeated_measurements(flexlink, wish, tmp_path):
    write_repeats(tmp_path / "repeats.csv")
    spec = wish(f'[plant]\ndt_s = {DT_S}\nellipses = "fitted"\nfit = {{ n_real = 1, n_pairs = 1 }}\n')
    found = numbers(flexlink("design", tmp_path / "repeats.csv", "--spec", spec, "--json"))
    assert found["certified"] is True
    assert found["plants"][0]["origin"] == "model fitted to a measured response"
    assert found["certificate"]["plants"][0]["all_frequencies"]["proved"] is True


def test_several_plants_share_one_controller(flexlink, wish, tmp_path):
    systems, out = {"light": arm(1.0, 12.0), "heavy": arm(0.8, 9.0)}, tmp_path / "controller.json"
    files = [tmp_path / f"{name}.json" for name in systems]
    for file, system in zip(files, systems.values(), strict=True):
        write_json(file, document(system))
    found = numbers(flexlink("design", *files, "--spec", wish(), "--out", out, "--json"))
    assert [verdict["plant"] for verdict in found["certificate"]["plants"]] == ["light", "heavy"]
    law = Controller.from_json(out.read_text()).to_control(include_delay=True)
    for system in systems.values():
        assert np.all(np.abs(control.feedback(law * system, 1).poles()) < 1)


def test_integrating_plant_when_told(flexlink, wish, tmp_path):
    turning = control.sample_system(control.ss(control.tf([1.0], [0.2, 1.0, 0.0])), DT_S)
    write_json(tmp_path / "hub.json", document(turning))
    spec = wish("[plant]\nintegrators = 1\n[uncertainty]\nmultiplicative = 0.1\n")
    assert numbers(flexlink("design", tmp_path / "hub.json", "--spec", spec, "--json"))["certified"] is True


@pytest.mark.slow
def test_order_too_low_is_said_with_what_a_higher_one_reaches(flexlink, wish, tmp_path):
    """Exit code 3: there is a best point, its certificate says no, and the file says so too."""
    wishes = WISH.replace("0.7", "3.0").replace("controller_order = 3", "controller_order = 1")
    out = tmp_path / "controller.json"
    answer = flexlink("design", tmp_path / "arm.json", "--spec", wish("", wishes), "--out", out, "--json")
    found = numbers(answer, code=3)
    assert answer.err.count("\n") == 1
    assert "not certified" in answer.err
    assert "controller_order = 1 may be too low" in answer.err
    assert found["certified"] is False
    assert "NOT CERTIFIED" in Controller.from_json(out.read_text()).name


def test_too_fast_for_any_order_is_said(flexlink, wish, tmp_path, monkeypatch):
    """A zero at +2 rad/s: refused before optimising, with the bandwidth that is left."""
    from control_design.synthesis.order_search import OrderSearch

    def never(self):
        raise AssertionError("the optimiser was started")

    monkeypatch.setattr(OrderSearch, "run", never)
    system = control.sample_system(control.ss(control.tf([-1.0, 2.0], [1.0, 3.0, 2.0])), DT_S)
    write_json(tmp_path / "zero.json", document(system))
    spec = wish("", WISH.replace("0.7", "5.0"))
    answer = flexlink("design", tmp_path / "zero.json", "--spec", spec)
    assert answer.code == 3
    assert "non-minimum-phase zero" in answer.err
    # |W1| at the zero: (0.4 x 2 + 5 sqrt(2 - 0.16))/(2 + ...) against 1; solved for the bandwidth by hand.
    assert "impossible by a factor 3.7" in answer.err
    assert "bandwidth_rad_s = 5, at most 0.88" in answer.err


def test_no_stable_start_means_no_controller(flexlink, wish, tmp_path, monkeypatch):
    """The solver finds nothing: said so, nothing written."""
    from control_design.synthesis.order_search import OrderResult, OrderSearch

    monkeypatch.setattr(OrderSearch, "run", lambda self: OrderResult(None, (), ()))
    monkeypatch.setattr(OrderSearch, "quick", lambda self, *_, **__: (OrderResult(None, (), ()), False))
    out = tmp_path / "controller.json"
    answer = flexlink("design", tmp_path / "arm.json", "--spec", wish(), "--out", out)
    assert answer.code == 3
    assert "there is no controller" in answer.err
    assert not out.exists()


# -- what is refused: one line, exit code 2


@pytest.mark.parametrize(
    ("wishes", "words"),
    [
        ("sensitivity_weight = { numerator = [1.0], denominator = [1.0, -2.0] }", "weight is unstable"),
        ("structure = 'pid'\nintegrator = true\ncontroller_order = 1", "leave controller_order out"),
        (
            "structure = 'pid'\nfixed = { ti_s = 0.0 }",
            "specification.fixed.ti_s: input should be greater",
        ),
        (
            "structure = 'pid'\nnotches = [{ depth_db = -3.0 }]",
            "notches[0].depth_db: input should be",
        ),
        ("structure = 'pd'\nfixed = { ti_s = 0.5 }", "structure 'pd' has none"),
        ("structure = 'pid'\nfixed = { tf_s = 0.001 }", "faster than the sample: at least 0.025 s"),
        (
            "structure = 'pid'\nnotches = [{ frequency_hz = 12.0 }]",
            "notch 1: frequency_hz = 12 must be below half of the controller's rate, 10 Hz",
        ),
        (
            "structure = 'pid'\nnotches = [{ frequency_hz = 2.0 }, { frequency_hz = 2.0 }]",
            "two notches at one frequency, 2 Hz",
        ),
        ("bandwith_rad_s = 1.0", "did you mean bandwidth_rad_s"),
        ("[uncertainty]\nmultiplicative = { numerator = [1.0], denominator = [1.0, -2.0] }", "unstable"),
        ("[uncertainty]\nmultiplicative = { numerator = [1.0], denominator = [1.0, 0.0] }", "imaginary axis"),
        ("[uncertainty]\nmultiplicative = -0.1", "must be positive"),
        ("[uncertainty]\nmultiplicative = 0.1\nadditive = 0.1", "either multiplicative or additive"),
        ("[plant]\nintegrators = 1", "0 of its poles at z = 1"),
        ("[plant]\nfit = { integrators = 1 }", "say integrators in [plant] itself"),
        ("[reference_filter]\norder = 1", "either corner_rad_s or model"),
        (
            "[reference_filter]\ncorner_rad_s = 100.0",
            "wish.toml: reference_filter.corner_rad_s: 100 lies beyond the Nyquist",
        ),
        ("[reference_filter]\nmodel = { numerator = [1.0, 1.0], denominator = [1.0] }", "improper"),
        ("[certificate]\njoint_draws = 5", "joint_draws must be 0 or at least 100"),
        ("[certificate]\njoint_coverage = 1.0", "joint_coverage"),
        ("[certificate]\njoint_draws = 0\ncalibrate = true", "calibrate needs joint_draws"),
        ("[achievable_performance]\ncompute = true\nreal_pole = 3", "did you mean real_poles"),
        ("[specification]\nbandwidth_rad_s = 1.0\n[uncertanty]\nmultiplicative = 0.1", "uncertanty"),
    ],
)
def test_design_file_is_refused(refused, tmp_path, wishes, words):
    write_json(tmp_path / "arm.json", document(arm()))
    (tmp_path / "wish.toml").write_text(wishes + "\n")
    assert words in refused("design", tmp_path / "arm.json", "--spec", tmp_path / "wish.toml")


def changed(**changes):
    return {**document(arm()), **changes}


@pytest.mark.parametrize(
    ("content", "words"),
    [
        ({"A": 1}, "no B in it"),
        ({key: value for key, value in document(arm()).items() if key != "dt_s"}, "no dt_s in it"),
        (changed(dt_s=-1.0), "one positive number"),
        (changed(B=[[1.0, 0.0], [0.0, 1.0], [0.0, 0.0]]), "B is 3x2, expected 3x1"),
        (changed(A=[[1.0, "x"], [0.0, 1.0]]), "matrix of real numbers"),
        (changed(C=[[1.0, float("nan"), 0.0]]), "not finite"),
        (document(control.ss([[1.0]], [[0.1]], [[1.0]], [[0.0]], DT_S)), "1 of its poles at z = 1 (int"),
        (
            document(control.ss([[0.6, -0.8], [0.8, 0.6]], [[1.0], [0.0]], [[1.0, 0.0]], [[0.0]], DT_S)),
            "on the unit circle away from z = 1",
        ),
        ({"format": "flexlink-controller-1"}, "holds a controller"),
        ([1, 2], "expected a JSON object"),
    ],
)
def test_state_space_is_refused(refused, wish, tmp_path, content, words):
    write_json(tmp_path / "plant.json", content)
    line = refused("design", tmp_path / "plant.json", "--spec", wish())
    assert words in line
    assert "plant.json" in line


def test_measured_response_is_refused(refused, wish, tmp_path):
    path = tmp_path / "frf.csv"
    write_response(path)
    assert "write dt_s in [plant]" in refused("design", path, "--spec", wish())
    spec = wish(f"[plant]\ndt_s = {DT_S}\n")
    write_response(path, order=[1])
    assert "one frequency is no response" in refused("design", path, "--spec", spec)
    header = "omega_rad_s,real,imag,variance_real,variance_imag,covariance_real_imag\n"
    path.write_text(header + "0.1,1,0,1e-4,1e-4,0\n0.2,1,0,1e-4,1e-4,5e-4\n0.3,1,0,1e-4,1e-4,0\n")
    line = refused("design", path, "--spec", spec)
    assert "not positive semidefinite (first at omega = 0.2 rad/s)" in line
    path.write_text(header.replace("_real_imag", "") + "0.1,1,0,1e-4,1e-4,0\n0.2,1,0,1e-4,1e-4,0\n")
    assert "line 1: unknown column 'covariance'" in refused("design", path, "--spec", spec)
    path.write_text("omega_rad_s,real,imag\n0.1,1,0\n0.1,1,0.1\n0.2,1,0\n")
    assert "there are 2 repeats" in refused("design", path, "--spec", spec)


def test_covariance_of_an_exported_model_is_checked(refused, wish, tmp_path):
    content = json.loads(model_file().to_json())
    content["ellipses"]["covariance"][7] = [[1e-4, 5e-4], [5e-4, 1e-4]]
    write_json(tmp_path / "model.json", content)
    line = refused("design", tmp_path / "model.json", "--spec", wish())
    assert "not positive semidefinite (first at omega = " in line


def test_sources_that_do_not_go_together_are_refused(refused, wish, tmp_path):
    write_json(tmp_path / "slow.json", changed(dt_s=0.1))
    both = (tmp_path / "arm.json", tmp_path / "slow.json")
    assert "sampling time 0.1 s" in refused("design", *both, "--spec", wish())
    assert "given twice" in refused("design", both[0], both[0], "--spec", wish())
    write_json(tmp_path / "other.json", document(arm(0.8)))
    assert "no specification for all" in refused("design", both[0], tmp_path / "other.json")
    assert "give --spec FILE" in refused("design", both[0])
    (tmp_path / "model.json").write_text(model_file().to_json())
    spec = wish("[uncertainty]\nmultiplicative = 0.1\n")
    assert "brings its own ellipses" in refused("design", tmp_path / "model.json", "--spec", spec)
    assert "is a source" in refused("design", both[0], "--spec", spec, "--out", both[0])
    assert "the ending is not one of" in refused("design", spec, "--spec", spec)
    assert "no such file" in refused("design", tmp_path / "absent.json", "--spec", spec)
    (tmp_path / "broken.mat").write_bytes(b"nothing")
    assert "not a MATLAB .mat file" in refused("design", tmp_path / "broken.mat", "--spec", spec)
