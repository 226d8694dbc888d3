"""Controllers in an engineer's numbers: what is read off reproduces the controller; what is fixed stays."""

import re

import numpy as np
import pytest

from control_design import Outcome, Specification, SpecificationError, SynthesisOptions, certify, synthesise
from control_design.controllers.c_code import c_header
from control_design.controllers.controller import Controller
from control_design.controllers.engineers_numbers import (
    LARGEST_ERROR,
    ControllerNumbers,
    LowPassNumbers,
    NotchNumbers,
    PidNumbers,
    engineers_numbers,
)
from control_design.synthesis.synthesis import synthesise_near

from .plants import uncertain_hub

_QUICK = SynthesisOptions(
    starts=2, grid_points=60, mode_points=30, exchange_rounds=1, dense_points=1500, sufficient_gamma=0.97
)
_WISH = {"bandwidth_rad_s": 2.0, "effort_limit": 60.0}


def _controller(specification: Specification, x: np.ndarray, dt_s: float, scale_rad_s: float) -> Controller:
    return Controller(*specification.cascade(dt_s, scale_rad_s).state_space(x), dt_s)


def _inside(specification: Specification, dt_s: float, scale_rad_s: float, rng) -> np.ndarray:
    """Free parameters within their bounds."""
    x = []
    for part in specification.cascade(dt_s, scale_rad_s).sections:
        x += [rng.uniform(max(low, -2.0), min(high, 2.0)) for low, high in part.bounds()]
    return np.array(x)


@pytest.mark.parametrize("structure", ["p", "pi", "pd", "pid"])
@pytest.mark.parametrize("notches", [0, 2])
@pytest.mark.parametrize("low_pass", [None, {}])
def test_what_is_read_off_a_structure_is_the_structure_and_its_response(structure, notches, low_pass):
    rng = np.random.default_rng(3)
    specification = Specification(structure=structure, notches=[{}] * notches, low_pass=low_pass)
    for dt_s in (1e-4, 0.01):
        scale_rad_s = rng.uniform(0.01, 0.3) / dt_s
        x = _inside(specification, dt_s, scale_rad_s, rng)
        law = _controller(specification, x, dt_s, scale_rad_s)
        found = engineers_numbers(law)
        assert found.pid.structure == structure
        assert len(found.notches) == notches
        assert len(found.low_passes) == (low_pass is not None)
        assert not found.factors
        omega = np.geomspace(1e-3 * scale_rad_s, 0.9 * np.pi / dt_s, 300)
        exact = law.response(omega, with_delay=False)
        np.testing.assert_allclose(found.response(omega), exact, rtol=LARGEST_ERROR)


def test_a_pid_is_the_textbook_formula_by_the_trapezoidal_rule():
    """Kp (1 + 1/(Ti s) + Td s/(Tf s + 1)) with s = (2/dt)(z - 1)/(z + 1), term by term."""
    dt_s, kp, ti_s, td_s, tf_s = 0.002, -3.0, 0.4, 0.05, 0.004
    fixed = {"kp": kp, "ti_s": ti_s, "td_s": td_s, "tf_s": tf_s}
    law = _controller(Specification(structure="pid", fixed=fixed), np.zeros(0), dt_s, 50.0)
    omega = np.geomspace(0.1, 1500.0, 100)
    z = np.exp(1j * omega * dt_s)
    s = 2 / dt_s * (z - 1) / (z + 1)
    expected = kp * (1 + 1 / (ti_s * s) + td_s * s / (tf_s * s + 1))
    np.testing.assert_allclose(law.response(omega, with_delay=False), expected, rtol=1e-9)
    found = engineers_numbers(law).pid
    assert found.structure == "pid"
    assert [found.kp, found.ti_s, found.td_s, found.tf_s] == pytest.approx([kp, ti_s, td_s, tf_s], rel=1e-9)


@pytest.mark.parametrize("frequency_hz", [3.0, 22.9, 90.0])
def test_a_notch_has_its_depth_at_its_frequency_and_its_width_in_discrete_time(frequency_hz):
    """Also at 90 of 100 Hz, where a notch that were not warped would sit at 57 Hz."""
    dt_s, depth_db, width_hz = 0.005, 14.0, 2.0
    notch = {"frequency_hz": frequency_hz, "depth_db": depth_db, "width_hz": width_hz}
    law = _controller(
        Specification(structure="p", fixed={"kp": 1.0}, notches=[notch]), np.zeros(0), dt_s, 40.0
    )

    def gain(hertz):
        return np.abs(law.response(2 * np.pi * np.atleast_1d(hertz), with_delay=False))

    assert gain(frequency_hz)[0] == pytest.approx(10 ** (-depth_db / 20), rel=1e-9)
    around = np.linspace(0.5 * frequency_hz, min(1.5 * frequency_hz, 99.0), 4001)
    assert around[np.argmin(gain(around))] == pytest.approx(frequency_hz, abs=2e-3 * frequency_hz)
    # Where half of the power that it takes off is gone: two frequencies that lie as far apart as was asked.
    half_power = np.sqrt((1 + 10 ** (-depth_db / 10)) / 2)
    fine = np.linspace(frequency_hz - 1.5 * width_hz, min(frequency_hz + 1.5 * width_hz, 99.9), 200_001)
    inside = fine[gain(fine) < half_power]
    assert inside[-1] - inside[0] == pytest.approx(width_hz, rel=1e-4)


def test_a_low_pass_has_its_corner_in_discrete_time():
    low_pass = {"frequency_hz": 60.0, "damping": 0.6}
    law = _controller(
        Specification(structure="p", fixed={"kp": 1.0}, low_pass=low_pass), np.zeros(0), 0.005, 40.0
    )
    at_corner = law.response(np.array([2 * np.pi * 60.0]), with_delay=False)[0]
    assert abs(at_corner) == pytest.approx(1 / (2 * 0.6), rel=1e-9)
    assert np.angle(at_corner) == pytest.approx(-np.pi / 2, rel=1e-9)


def test_any_controller_has_factors_that_are_its_response():
    rng = np.random.default_rng(8)
    for order in range(1, 9):
        for integrator in (False, True):
            specification = Specification(controller_order=max(order, 1 + integrator), integrator=integrator)
            cascade = specification.cascade(0.004, 30.0)
            law = Controller(*cascade.state_space(rng.standard_normal(cascade.parameters)), 0.004)
            found = engineers_numbers(law)
            omega = np.geomspace(0.1, 700.0, 200)
            exact = law.response(omega, with_delay=False)
            np.testing.assert_allclose(found.response(omega), exact, rtol=LARGEST_ERROR)


def test_factors_of_a_general_controller_are_called_what_they_are():
    """Built from a lead, a notch whose zeros and poles are apart, and a low-pass."""
    dt_s = 0.001
    parts = Specification(controller_order=7, integrator=True).cascade(dt_s, 2.0 / dt_s)
    # In p = tan(pi f dt): corners of 5 and 40 Hz, zeros at 20 and poles at 25 Hz, a low-pass at 150 Hz.
    zero, pole, low, high, corner = np.tan(np.pi * dt_s * np.array([5.0, 40.0, 20.0, 25.0, 150.0]))
    x = [
        *(1.0, zero),
        *(1.0, 2 * 0.1 * low, low**2, np.log(2 * 0.5 * high), 2 * np.log(high)),
        *(0.0, 1.0, zero / 2, np.log(pole + corner), np.log(pole * corner)),
        *(0.0, 0.0, corner**2, np.log(2 * 0.7 * corner), 2 * np.log(corner)),
    ]
    found = engineers_numbers(Controller(*parts.state_space(np.array(x)), dt_s))
    assert found.pid.structure == "pid"
    assert found.pid.tf_s == pytest.approx(dt_s / 2 / pole)
    (notch,) = found.factors
    assert notch.kind == "notch"
    assert notch.zeros[0].frequency_hz == pytest.approx(20.0)
    assert notch.poles[0].frequency_hz == pytest.approx(25.0)
    assert notch.depth_db > 0
    assert [low_pass.order for low_pass in found.low_passes] == [1, 2]


def test_what_has_no_such_numbers_has_none():
    assert engineers_numbers(Controller.proportional(0.0, 0.01)) is None
    # A pole at z = -1 is at infinity in the Tustin plane.
    alternating = Controller([[-1.0]], [[1.0]], [[1.0]], [[0.0]], 0.01, anti_windup_gain=[[-0.5]])
    assert engineers_numbers(alternating) is None


def test_the_constants_of_the_c_header_are_the_controller():
    notches = [{"frequency_hz": 22.9, "depth_db": 10.0}, {}]
    specification = Specification(structure="pid", notches=notches, low_pass={})
    x = _inside(specification, 0.005, 20.0, np.random.default_rng(4))
    law = _controller(specification, x, 0.005, 20.0)
    header = c_header(law, prefix="hub")
    given = {name: float(value) for name, value in re.findall(r"#define HUB_(\w+) (\S+)", header)}
    assert given["NOTCH_2_HZ"] == 22.9 or given["NOTCH_1_HZ"] == 22.9
    rebuilt = ControllerNumbers(
        dt_s=0.005,
        pid=PidNumbers("pid", given["KP"], given["TI_S"], given["TD_S"], given["TF_S"]),
        gain=given["KP"],
        integrators=1,
        notches=tuple(
            NotchNumbers(*(given[f"NOTCH_{k}_{name}"] for name in ("HZ", "DEPTH_DB", "WIDTH_HZ", "DAMPING")))
            for k in (1, 2)
        ),
        low_passes=(LowPassNumbers(given["LOW_PASS_1_HZ"], 2, given["LOW_PASS_1_DAMPING"]),),
    )
    omega = np.geomspace(0.1, 600.0, 200)
    np.testing.assert_allclose(rebuilt.response(omega), law.response(omega, with_delay=False), rtol=1e-9)
    comment = header[: header.index("*/")]
    assert "notch: 22.9 Hz, 10 dB deep" in comment


def test_a_design_keeps_what_is_fixed_and_is_certified():
    plant = uncertain_hub(0.03)
    specification = Specification(
        **_WISH,
        structure="pid",
        fixed={"ti_s": 2.0},
        notches=[{"frequency_hz": 2.4, "depth_db": 10.0}],
        low_pass={},
    )
    result = synthesise([plant], specification, _QUICK, rng=np.random.default_rng(1))
    assert certify(result.controller, [plant], specification).certified
    found = engineers_numbers(result.controller)
    assert found.structure == "PID, 1 notch, low-pass"
    assert found.pid.ti_s == pytest.approx(2.0, rel=1e-9)
    assert found.notches[0].frequency_hz == pytest.approx(2.4, rel=1e-9)
    assert found.notches[0].depth_db == pytest.approx(10.0, rel=1e-9)
    assert result.controller.order == specification.controller_order == 6


def test_a_controller_of_which_all_is_fixed_is_checked_as_it_is():
    plant = uncertain_hub(0.03)
    found = synthesise([plant], Specification(**_WISH, structure="pd"), _QUICK, rng=np.random.default_rng(1))
    pid = engineers_numbers(found.controller).pid
    typed = {"kp": pid.kp, "td_s": pid.td_s, "tf_s": pid.tf_s}
    again = synthesise(
        [plant], Specification(**_WISH, structure="pd", fixed=typed), _QUICK, rng=np.random.default_rng(1)
    )
    assert again.outcome is Outcome.MET_ON_GRID
    assert again.gamma == pytest.approx(found.gamma, rel=1e-6)
    asked = Specification(**_WISH, structure="pd", fixed=typed)
    near = synthesise_near(found.controller, [plant], asked, _QUICK, rng=np.random.default_rng(1))
    assert near.gamma == again.gamma
    turned = typed | {"kp": -pid.kp}
    unstable = synthesise(
        [plant], Specification(**_WISH, structure="pd", fixed=turned), _QUICK, rng=np.random.default_rng(1)
    )
    assert unstable.outcome is Outcome.NOT_CONVERGED
    assert unstable.blocking[0].weight == "stability of the nominal loop"


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"structure": "pid", "fixed": {"ti_s": 0.0}}, "fixed.ti_s: input should be greater than 0"),
        ({"structure": "pid", "notches": [{"depth_db": -3.0}]}, "depth_db: input should be greater than 0"),
        ({"structure": "pid", "notches": [{"frequency_hz": 3.0}] * 2}, "two notches at one frequency"),
        ({"structure": "pd", "fixed": {"ti_s": 0.1}}, "structure 'pd' has none"),
        ({"structure": "pi", "fixed": {"td_s": 0.1}}, "structure 'pi' has none"),
        ({"notches": [{}]}, "structure 'biquads' has none"),
        ({"structure": "p", "fixed": {"kp": 0.0}}, "kp must not be 0"),
        ({"structure": "pid", "controller_order": 4}, "leave controller_order out"),
        ({"structure": "pid", "integrator": False}, "leave integrator out"),
        ({"structure": "pid", "low_pass": {"order": 1}}, "take order = 2"),
        ({"structure": "pid", "notches": [{"width_hz": 1.0, "damping": 0.1}]}, "not both"),
        ({"structure": "pid", "notches": [{"hertz": 1.0}]}, "unknown key"),
    ],
)
def test_parameters_that_contradict_are_refused_in_one_line(fields, words):
    with pytest.raises(ValueError, match=re.escape(words)) as refused:
        Specification(**fields)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("fields", "words"),
    [
        ({"notches": [{"frequency_hz": 120.0}]}, "must be below half of the controller's rate, 100 Hz"),
        ({"notches": [{"frequency_hz": 10.0, "width_hz": 19.5}]}, "too wide for a notch at 10 Hz"),
        ({"low_pass": {"frequency_hz": 100.0}}, "low_pass: frequency_hz = 100 must be below"),
        ({"fixed": {"tf_s": 0.002}}, "fixed.tf_s = 0.002 s is faster than the sample: at least 0.0025 s"),
    ],
)
def test_parameters_that_the_rate_cannot_have_are_refused(fields, words):
    with pytest.raises(SpecificationError, match=re.escape(words)):
        Specification(structure="pid", **fields).refuse_sampling(0.005)
    # At a faster rate they are possible.
    Specification(structure="pid", controller_dt_s=0.0005, **fields).refuse_sampling(0.005)


def test_a_gain_has_its_unit_and_a_number_at_its_limit_is_said_to_be_there():
    pid = PidNumbers("pid", 2.0, ti_s=0.5, td_s=0.01, tf_s=0.1)
    numbers = ControllerNumbers(
        0.01, pid, 2.0, 1, notches=(NotchNumbers(5.0, 10.0, 0.2, 0.02),), gain_unit="V/rad"
    )
    rows = dict(numbers.rows())
    assert rows["PID"].startswith("Kp = 2 V/rad, Ti = 0.5 s")
    assert rows["PID"].endswith("Td/Tf at the least of a free one, 0.1")
    assert "(damping 0.02, the least of a free one)" in rows["notch"]
    # Away from the limits, and without units, nothing is said.
    free = ControllerNumbers(
        0.01, PidNumbers("pd", 2.0, td_s=0.1, tf_s=0.1), 2.0, 0, notches=(NotchNumbers(5.0, 10.0, 0.2, 0.1),)
    )
    assert dict(free.rows())["PD"] == "Kp = 2, Td = 0.1 s, Tf = 0.1 s"
    assert "least" not in str(free.rows())
    law = Controller([[1.0]], [[0.02]], [[1.0]], [[0.5]], dt_s=0.01, gain_unit="Nm/rad")
    assert "PI: Kp = 0.49 Nm/rad" in c_header(law)
    assert Controller.from_json(law.to_json()).gain_unit == "Nm/rad"
