"""Models of any origin on one validation record: the same plant gives the same fit whoever made the model."""

import re

import control
import matplotlib as mpl
import numpy as np
import pytest
from matplotlib.figure import Figure
from scipy.signal import dlti, lfilter, lti

import flexlink

DT_S = 0.01
# A mode of 20 rad/s with damping ratio 0.05, sampled with a held input.
CONTINUOUS = control.tf([400.0], [1.0, 2.0, 400.0])
PLANT = control.sample_system(CONTINUOUS, DT_S, "zoh")
PLANT_SS = control.ss(PLANT)
NUMERATOR, DENOMINATOR = PLANT.num[0][0], PLANT.den[0][0]


def record(noise=0.0, seed=0, n_samples=1200, first=200):
    """A log whose machine moves already when it begins; from rest with first = 0."""
    u = flexlink.prbs(9, 4, 1.0, n_samples, start=np.random.default_rng(seed))
    b = np.r_[np.zeros(DENOMINATOR.size - NUMERATOR.size), NUMERATOR]
    y = lfilter(b, DENOMINATOR, u) + noise * np.random.default_rng(seed + 50).standard_normal(n_samples)
    return flexlink.Record(u[first:], y[first:], DT_S, output_names="angle", output_units=("rad",))


def test_the_plant_explains_all_in_whatever_form_it_is_given():
    impulse = lfilter(np.r_[0.0, NUMERATOR], DENOMINATOR, np.eye(1, 700)[0])
    seen = record(seed=1, first=0)
    forms = {
        "tf": PLANT,
        "ss": PLANT_SS,
        "continuous": CONTINUOUS,
        "scipy": dlti(NUMERATOR, DENOMINATOR, dt=DT_S),
        "scipy, continuous": lti([400.0], [1.0, 2.0, 400.0]),
        "numbers": (NUMERATOR, DENOMINATOR, DT_S),
        "impulse response": impulse,
        "identified": flexlink.identify(seen, n_pairs=1, n_real=0),
        "arx": flexlink.arx(seen, 2, 2),
        "armax": flexlink.armax(seen, 2, 2, 0),
        "oe": flexlink.oe(seen, 2, 2),
        "n4sid": flexlink.n4sid(seen, 2),
    }
    table = flexlink.compare(record(), *forms.values(), names=list(forms)).table().set_index("name")
    # The impulse response ends where a thousandth of the motion is left.
    assert (table["fit_percent"] > 99.5).all()
    assert table["order"].drop("impulse response").eq(2).all()
    timed = table["fit_s"].notna()
    assert set(table.index[timed]) == {"identified", "arx", "armax", "oe", "n4sid"}


def test_a_noise_model_predicts_from_sample_to_sample_what_no_free_run_explains():
    """Equation noise: the ARX structure is the true one."""
    rng = np.random.default_rng(7)
    u = rng.choice([-1.0, 1.0], 4000)
    y = lfilter(np.r_[0.0, NUMERATOR], DENOMINATOR, u) + lfilter(
        [0.02], DENOMINATOR, rng.standard_normal(4000)
    )
    log = flexlink.Record(u, y, DT_S)
    seen, fresh = log.slice(0, 2500), log.slice(2500, 4000)
    models = flexlink.arx(seen, 2, 2), flexlink.n4sid(seen, 2), flexlink.oe(seen, 2, 2), PLANT
    table = flexlink.compare(fresh, *models).table().set_index("name")
    assert (table["one_step_percent"] - table["fit_percent"])[["ARX", "N4SID"]].min() > 10
    # What is left of the prediction is the noise itself.
    noise_share = 0.02 / np.std(fresh.output)
    assert table.loc["ARX", "one_step_percent"] == pytest.approx(100 * (1 - noise_share), abs=1)
    assert table.loc["OE", "one_step_percent"] == pytest.approx(table.loc["OE", "fit_percent"], abs=0.1)
    assert np.isnan(table.loc["TransferFunction", "one_step_percent"])


def test_a_comparison_draws_on_the_callers_axes_with_labels_beside_the_curves():
    log = record(noise=0.05)
    with mpl.rc_context({"lines.linewidth": 3.5}):
        axes = Figure().subplots()
        found = flexlink.compare(
            log, PLANT, (0.9 * NUMERATOR, DENOMINATOR, DT_S), names=["true", "low"],
            ax=axes, title="Two gains", from_s=1.0, to_s=3.0,
        )  # fmt: skip
    assert axes.get_title() == "Two gains"
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("time [s]", "angle [rad]")
    measured, *runs = axes.get_lines()
    assert measured.get_linewidth() == 3.5
    np.testing.assert_allclose(measured.get_xdata()[[0, -1]], [1.0, 3.0])
    assert [text.get_text() for text in axes.texts] == [
        "measured", *(f"{model.name}: {model.fit_percent:.1f} %" for model in found.models)
    ]  # fmt: skip
    assert [text.get_color() for text in axes.texts[1:]] == [run.get_color() for run in runs]
    places = sorted(text.xy[1] for text in axes.texts)
    assert min(np.diff(places)) > 0
    assert isinstance(found.plot(), Figure)
    assert "true: " in repr(found)
    assert isinstance(flexlink.plot(found), Figure)
    with pytest.raises(ValueError, match=r"goes from 0 to 9\.99 s"):
        found.plot(from_s=50.0)


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: flexlink.compare(PLANT, PLANT), r"TransferFunction; expected a validation record.*bode"),
        (lambda: flexlink.compare(record()), "expected models after the record"),
        (lambda: flexlink.compare(record(), 3), r"model 1 is a int; expected an identification"),
        (lambda: flexlink.compare(record(), PLANT, record()), "model 2 is a Record; expected an ident"),
        (lambda: flexlink.compare(record(), PLANT, names=["a", "b"]), "2 names of 1 models"),
        (lambda: flexlink.compare(record(), ([1.0], [1.0, 0.5])), r"tuple of 2; expected \(num, den, dt_s\)"),
        (lambda: flexlink.compare(record(), ([1.0], [1.0, 0.5], 0.02)), "dt_s = 0.02, .* has 0.01"),
        (lambda: flexlink.compare(record(), np.ones(5000)), "impulse response of 5000 samples"),
        (lambda: flexlink.compare(record(), control.frd([1.0, 2.0], [1.0, 2.0], DT_S)), "frd"),
        (lambda: flexlink.compare(record(), control.append(PLANT_SS, PLANT_SS)), "2 inputs"),
        (lambda: flexlink.n4sid(record(), 0), "order must be a whole number, at least 1; got 0"),
        (lambda: flexlink.n4sid(record(), 4, block_rows=4), "block_rows .*at least 5; got 4"),
        (lambda: flexlink.n4sid(record().slice(0, 100), 2), "100 samples are too few for 20 block rows"),
        (lambda: flexlink.arx([1.0], 2, 2), r"flexlink\.Record\(u=u"),
        (lambda: flexlink.oe(record(), 2), r"expected oe\(record, nb, nf, delay_samples=\.\.\.\)"),
    ],
)
def test_what_cannot_be_compared_is_refused_in_one_line(call, message):
    with pytest.raises(ValueError, match=message) as raised:
        call()
    assert "\n" not in str(raised.value)


def test_models_print_what_they_are():
    seen = record(noise=0.01)
    assert re.match(r"ARX model of order 2, dt = 0\.01 s", repr(flexlink.arx(seen, 2, 2)))
    assert re.match(r"N4SID model of order 2", repr(flexlink.n4sid(seen, 2)))
    omega = np.array([5.0, 20.0, 60.0])
    for model in (flexlink.oe(seen, 2, 2), flexlink.n4sid(seen, 2)):
        z = np.exp(1j * omega * DT_S)
        np.testing.assert_allclose(model.to_control()(z), model.frequency_response(omega), rtol=1e-8)
