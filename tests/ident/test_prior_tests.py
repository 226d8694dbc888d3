"""What users state as known is judged by the data: true statements pass, wrong ones are refused by name."""

from dataclasses import replace

import numpy as np
import pytest
import scipy.signal

from ident import IdentOptions, identify
from ident.data.finding import FindingKind
from tests.ident.benchmark_plants import DT_S, as_record, p1, p1_friction
from tests.ident.findings import kinds, only

OMEGA = np.geomspace(0.1, 600, 400)
KNOWN = {"integrators": 2, "relative_degree": 2, "n_real": 0, "n_pairs": 1}


def relative_error(truth, model):
    return np.sqrt(np.mean(np.abs(model.frequency_response(OMEGA) / truth.response(OMEGA) - 1) ** 2))


def refused(result):
    return {test.prior: test.refused for test in result.prior_tests}


def delayed(truth, samples, seed):
    """The same plant behind a delay of whole samples, with fresh noise."""
    noise = truth.noise_std * np.random.default_rng(seed).normal(size=truth.clean.size)
    clean = np.concatenate([np.zeros(samples), truth.clean[: truth.clean.size - samples]])
    return as_record(truth.record.input[:, 0], clean + noise)


@pytest.mark.parametrize("orders", [{"n_real": 0, "n_pairs": 1}, {}])
def test_true_structure_is_accepted_and_brings_the_model_to_the_bound(orders):
    """Cramer-Rao bound with the structure known: 0.013 over 0.1-600 rad/s, without it 0.97."""
    errors = []
    for seed in range(3):
        truth = p1(seed)
        result = identify([truth.record], IdentOptions(integrators=2, relative_degree=2, **orders))
        assert refused(result) == {"integrators = 2": False, "relative_degree = 2": False}
        asked = {FindingKind.INTEGRATORS, FindingKind.RELATIVE_DEGREE}
        assert not asked & kinds(result.warnings)
        assert asked < kinds(result.verdicts)
        assert (result.structure.relative_degree, result.model.integrators) == (2, 2)
        assert result.tangent_optimality < 1e-3
        u, y = truth.record.input[:, 0], truth.record.output[:, 0]
        np.testing.assert_allclose(y - result.model.simulate(u), result.residuals[0], atol=1e-9)
        errors.append(relative_error(truth, result.model))
    assert np.median(errors) < 0.02


def test_a_wrong_integrator_is_refused_and_the_right_number_named():
    truth = p1_friction(0)
    result = identify([truth.record], IdentOptions(**KNOWN))
    assert refused(result) == {"integrators = 2": True, "relative_degree = 2": False}
    assert only(result.warnings, FindingKind.INTEGRATORS)["accepted"] == 1
    assert FindingKind.RELATIVE_DEGREE not in kinds(result.warnings)
    # Kept all the same, and the mode at 15 rad/s is lost: that is what the warning is for.
    assert result.model.integrators == 2
    assert relative_error(truth, result.model) > 0.5
    right = identify([truth.record], IdentOptions(**(KNOWN | {"integrators": 1, "n_real": 1})))
    assert not any(refused(right).values())
    assert relative_error(truth, right.model) < 0.05


def test_an_integrator_that_a_zero_cancels_is_refused():
    """With the order from the data a zero near z = 1 makes up for one integrator too many."""
    truth = p1_friction(0)
    result = identify([truth.record], IdentOptions(integrators=2))
    assert result.model.poles.real.size == 3  # two zeros for the integrators, the pole of friction
    assert refused(result) == {"integrators = 2": True}
    assert FindingKind.SPARE_INTEGRATORS in kinds(result.warnings)


def test_a_pole_too_many_does_not_speak_against_a_true_integrator():
    result = identify([p1(0).record], IdentOptions(integrators=2, n_real=1, n_pairs=1))
    assert refused(result) == {"integrators = 2": False}


def test_too_large_a_relative_degree_is_refused_but_kept():
    result = identify([p1(0).record], IdentOptions(**(KNOWN | {"relative_degree": 3})))
    assert refused(result) == {"integrators = 2": False, "relative_degree = 3": True}
    assert result.structure.relative_degree == 3
    warning = only(result.warnings, FindingKind.RELATIVE_DEGREE)
    assert (warning["prior"], warning["one_less"], warning["imposed"]) == ("relative_degree = 3", 2, True)


def test_auto_imposes_the_largest_relative_degree_that_is_not_refused():
    truth = p1(2)
    result = identify([truth.record], IdentOptions(integrators=2, relative_degree="auto"))
    assert result.structure.relative_degree == 2
    assert refused(result) == {
        "integrators = 2": False,
        "relative_degree = 1": False,
        "relative_degree = 2": False,
        "relative_degree = 3": True,
    }
    assert [test.imposed for test in result.prior_tests] == [True, True, True, False]
    assert (result.verdicts[-1].values["refused"], result.verdicts[-1].values["imposed"]) == (True, False)
    assert FindingKind.RELATIVE_DEGREE not in kinds(result.warnings)
    assert relative_error(truth, result.model) < 0.03


def test_a_direct_term_is_missed():
    rng = np.random.default_rng(0)
    u = rng.normal(size=600)
    y = scipy.signal.lfilter([0.2, 0.5], [1, -0.9], u) + 0.05 * rng.normal(size=600)
    result = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=0, relative_degree=1))
    assert refused(result) == {"relative_degree = 1": True}
    assert result.warnings[-1].kind is FindingKind.DIRECT_TERM
    auto = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=0, relative_degree="auto"))
    assert auto.structure.relative_degree == 1


def test_a_relative_degree_above_the_number_of_poles_is_not_imposed():
    rng = np.random.default_rng(0)
    u = rng.normal(size=600)
    y = scipy.signal.lfilter([0, 0.5], [1, -0.9], u) + 0.05 * rng.normal(size=600)
    result = identify([as_record(u, y)], IdentOptions(n_pairs=0, relative_degree=4))
    assert result.structure.relative_degree == 1
    assert FindingKind.TOO_FEW_POLES in kinds(result.warnings)


def test_fixed_poles_are_judged():
    truth = p1_friction(1)
    true_pole = float(np.exp(-0.3 * DT_S))
    options = {"n_real": 0, "n_pairs": 1, "integrators": 1}
    right = identify([truth.record], IdentOptions(fixed_poles=((true_pole, 0.0),), **options))
    assert refused(right) == {"integrators = 1": False, "fixed_poles": False}
    wrong = identify([truth.record], IdentOptions(fixed_poles=((0.95, 0.0),), **options))
    assert refused(wrong)["fixed_poles"]
    assert str(only(wrong.warnings, FindingKind.FIXED_POLES)["free_poles"]).startswith("0.998")
    mode = np.exp((-0.015 + 1j * np.sqrt(1 - 0.015**2)) * 15 * DT_S)
    known = IdentOptions(fixed_poles=((mode.real, mode.imag),), n_real=1, n_pairs=0, integrators=1)
    (test,) = [test for test in identify([truth.record], known).prior_tests if test.prior == "fixed_poles"]
    assert not test.refused
    assert test.degrees_of_freedom == 2
    # Real poles cannot come near the mode, free or fixed: pairs in their place can.
    laguerre = IdentOptions(fixed_poles=[0.95] * 4, n_real=0, n_pairs=0, integrators=1)
    assert refused(identify([truth.record], laguerre))["fixed_poles"]


def test_how_poles_are_written():
    pair = (0.95, 0.2)
    for given in ([0.9, [*pair]], [0.9, complex(*pair)], [(0.9, 0.0), pair], [0.9, 0.95 + 0.2j, 0.95 - 0.2j]):
        assert IdentOptions(fixed_poles=given).fixed_poles == ((0.9, 0.0), pair)
    with pytest.raises(ValueError, match=r"a number for a real pole .* \[0.9, \[0.95, 0.2\]\]"):
        IdentOptions(fixed_poles={"real": [0.9]})


def test_delays_are_judged():
    rng = np.random.default_rng(0)
    u = rng.normal(size=800)
    y = scipy.signal.lfilter([0, 0, 0, 0.5], [1, -0.8], u) + 0.01 * rng.normal(size=800)
    for delay in (1, 2, 3):
        options = IdentOptions(n_real=1, n_pairs=0, input_delay_samples=delay)
        result = identify([as_record(u, y)], options)
        assert refused(result) == {f"input_delay_samples = {delay}": delay != 2}
        if delay != 2:
            assert only(result.warnings, FindingKind.DELAY)["other_delay"] == 2
    untold = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=0))
    assert untold.prior_tests == ()
    stated = identify([as_record(u, y)], IdentOptions(n_real=1, n_pairs=0, input_delay_samples=0))
    assert refused(stated) == {"input_delay_samples = 0": True}


@pytest.mark.slow
def test_several_records_in_mid_run_are_judged_alike():
    """Unknown initial states and biases beside the structure, a search on a part of the records."""
    truth = p1(5, 4000)
    pieces = [truth.record.slice(1000, 2500), truth.record.slice(2500, 4000)]
    pieces = [replace(piece, output=piece.output + bias) for piece, bias in zip(pieces, (1, -1), strict=True)]
    options = IdentOptions(**KNOWN, search_samples=1600)
    result = identify(pieces, options)
    assert result.structure.estimate_initial_state
    assert not any(refused(result).values())
    assert relative_error(truth, result.model) < 0.03
    assert refused(identify(pieces, IdentOptions(**(KNOWN | {"relative_degree": 3}))))["relative_degree = 3"]


def test_noise_free_data_speak_against_nothing_true():
    truth = p1(0)
    result = identify([as_record(truth.record.input[:, 0], truth.clean)], IdentOptions(**KNOWN))
    assert not any(refused(result).values())
    assert relative_error(truth, result.model) < 1e-5


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"relative_degree": 2, "feedthrough": True}, "feedthrough = false"),
        ({"relative_degree": 2, "fixed_poles": ((-0.5, 0.0),)}, r"fixed_poles has \[-0.5, 0\]"),
        ({"relative_degree": 4, "n_real": 1, "n_pairs": 1}, "needs at least that many poles.*got 3"),
        ({"relative_degree": 0}, "relative_degree"),
        ({"relative_degree": "some"}, "relative_degree"),
    ],
)
def test_impossible_settings_are_refused(options, message):
    with pytest.raises(ValueError, match=message):
        IdentOptions(**options)


@pytest.mark.parametrize(
    ("colour", "runs"),
    [
        pytest.param(0.9, 1, marks=pytest.mark.slow),
        *(pytest.param(c, 10, marks=pytest.mark.long) for c in (0.0, 0.9)),
    ],
)
def test_error_rates_of_the_verdicts(colour, runs):
    """True priors pass in 95 % of the records at least, wrong ones never; white and AR(1) noise of equal
    power.

    Measured over 40 seeds: one of 80 records with a true prior refused in white noise, two in AR(1) 0.9.
    """
    seeds = range(runs)

    def record(truth, seed):
        white = np.random.default_rng(1000 + seed).normal(size=truth.clean.size + 500)
        noise = scipy.signal.lfilter([np.sqrt(1 - colour**2)], [1, -colour], white)[500:]
        return as_record(truth.record.input[:, 0], truth.clean + truth.noise_std * noise)

    counts = {"true": 0, "wrong": 0}
    for seed in seeds:
        plain, friction = record(p1(seed), seed), record(p1_friction(seed), seed)
        counts["true"] += any(refused(identify([plain], IdentOptions(**KNOWN))).values())
        one = IdentOptions(**(KNOWN | {"integrators": 1, "n_real": 1}))
        counts["true"] += any(refused(identify([friction], one)).values())
        counts["wrong"] += refused(identify([friction], IdentOptions(**KNOWN)))["integrators = 2"]
        three = IdentOptions(**(KNOWN | {"relative_degree": 3}))
        counts["wrong"] += refused(identify([plain], three))["relative_degree = 3"]
    assert counts["true"] <= 0.05 * 2 * len(seeds)
    assert counts["wrong"] == 2 * len(seeds)


def test_what_the_program_chose_is_not_called_specified():
    """The wrong integrator and delay of a slow plant: refused where somebody states them, else not judged."""
    truth = p1_friction(0)
    wrong = {"integrators": 2, "input_delay_samples": 3, "n_real": 0, "n_pairs": 1}
    stated = identify([truth.record], IdentOptions(**wrong))
    assert refused(stated)["integrators = 2"]
    assert "input_delay_samples = 3" in refused(stated)
    chosen = identify([truth.record], IdentOptions(n_real=0, n_pairs=1).model_copy(update=wrong))
    assert refused(chosen) == {}
    judged = {FindingKind.INTEGRATORS, FindingKind.SPARE_INTEGRATORS, FindingKind.DELAY}
    assert not judged & (kinds(chosen.verdicts) | kinds(chosen.warnings))
    # It is the same model; of a mix only what was stated is judged.
    assert chosen.rss == pytest.approx(stated.rss, rel=1e-9)
    mixed = IdentOptions(integrators=2, n_real=0, n_pairs=1).model_copy(update={"input_delay_samples": 3})
    assert set(refused(identify([truth.record], mixed))) == {"integrators = 2"}


def test_a_copy_keeps_what_was_stated():
    stated = IdentOptions(integrators=1)
    copy = stated.with_delay_stated().model_copy(update={"n_real": 2})
    assert [copy.is_stated(key) for key in ("integrators", "input_delay_samples", "n_real")] == [
        True,
        False,
        False,
    ]
    assert not copy.delay_left_to_data
