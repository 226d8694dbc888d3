"""Any order's reach, whole responses and the reference filter: found, told, written beside the controller."""

import ctypes
import re
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import scipy.io

from control_design.analysis.certificate import certify
from control_design.analysis.joint_coverage import JointCoverage
from control_design.convex.reference_filter import ReferenceFilter
from control_design.plants.plant_set import UncertainPlant
from control_design.specification import RationalWeight, Specification
from control_design.specification.requirement import LoopFunction, SpecificationItem
from control_design.synthesis.joint_synthesis import JointDesign
from control_design.synthesis.synthesis_options import SynthesisOptions
from control_design.synthesis.synthesis_result import Outcome
from ident.checks.residual_tests import conditions_of
from ident.data.finding import FindingKind, finding
from ident.uncertainty import FrequencyUncertainty
from ident.uncertainty.nominal import NominalAgreement
from tests.compiler import compiled, needs_compiler
from tests.control_design.plants import uncertain_hub
from tests.workflow import report_examples as example
from workflow.config.design_options import AchievableOptions, CertificateOptions, ReferenceFilterSettings
from workflow.describe.design import (
    any_order,
    calibration,
    design_verdict,
    reference_filter,
    run_verdict,
    sampled,
)
from workflow.describe.run import bandwidth_numbers
from workflow.describe.uncertainty import untold_below_rad_s
from workflow.engine.errors import InputError
from workflow.tasks import design as task, results as stored
from workflow.tasks.exports import filter_file, law_bytes
from workflow.text.sentences.certificate import not_checked, requirement
from workflow.text.sentences.design import order_advice


def spec(**changes) -> Specification:
    wish = {"bandwidth_rad_s": 0.1, "modulus_margin": 0.5, "controller_order": 1}
    return Specification.model_validate(wish | changes)


@pytest.mark.parametrize(
    ("count", "total", "expected"),
    [
        # Solutions of |p - x/n| = z sqrt(p (1 - p)/n); the first row is z^2/(n + z^2) at the other end.
        (0, 10, (0.0, 0.2775328)),
        (5, 10, (0.2365931, 0.7634069)),
        (10, 10, (0.7224672, 1.0)),
        (2999, 3000, (0.9981144, 0.9999412)),
    ],
)
def test_shares_of_sampled_responses_have_wilson_intervals(count, total, expected):
    joint = replace(example.sampled_responses(0.9).joint, draws=total, coverage_given=count / total)
    found = task.joint_numbers(stored.SampledResponses(replace(joint, stable_share=count / total)))
    assert found["held_interval"] == found["stable_interval"] == pytest.approx(expected, abs=1e-6)


def test_words_of_the_achievable_performance():
    found = example.achievable(0.8)
    words = any_order(found, 0.88, 4)
    # The bound is 0.798: 9.32 % of 0.88 lie above it.
    assert "order 4 reaches γ = 0.88 (needed: 1 or less); a higher order can gain at most 9.4 %" in words
    assert "gains less than 0.5 %" in any_order(found, 0.8, 4)
    below = any_order(found, 0.797, 4)
    assert "is approximate" in below
    assert "gain" not in below
    assert task.bracket_numbers(found, 0.88)["above_percent"] == pytest.approx(10.0)
    assert "some controller of a higher order reaches γ = 0.8" in any_order(found, float("inf"), 4)
    assert any_order(stored.AchievablePerformance(), 0.88, 4) == ""


def test_advice_on_the_order():
    assert "controller_order = 3 may be too low" in order_advice(example.achievable(0.8).bracket, 1.2, 3)
    assert "a higher order is not enough" in order_advice(example.achievable(1.1).bracket, 1.2, 3)
    assert order_advice(stored.AchievablePerformance().bracket, 1.2, 3) == ""


def test_a_number_that_is_enough_on_the_grid_and_not_proved_says_so():
    """Of an unstable loop nothing is proved: an effort of .0005 where 1 is allowed was said to be not met."""
    effort = SpecificationItem("effort", "hub", 1.0, 5e-4, "", met=False, bound=np.inf)
    assert requirement(effort).endswith("NOT met (enough on the grid, but not proved for all frequencies)")
    distance = SpecificationItem("modulus margin", "hub", 0.5, 0.6, "", met=False, bound=0.0)
    assert distance.only_unproved
    missed = replace(effort, achieved=1.2), replace(distance, achieved=0.4), replace(effort, bound=None)
    proved = replace(effort, met=True, bound=1.0)
    assert not any(item.only_unproved for item in (*missed, proved))


def test_verdict_of_a_missed_specification_says_whether_a_higher_order_helps():
    design = stored.DesignResult(SimpleNamespace(gamma=1.2), met=False, reason="gamma 1.2")
    rest = stored.CertifyResult(None, certified=False, reason=""), stored.ClosedLoopResult()
    words = run_verdict(design, *rest, example.achievable(0.8), 3)
    assert words.startswith("specification not met: gamma 1.2; controller_order = 3 may be too low")
    assert run_verdict(design, *rest, stored.AchievablePerformance(), 3) == "specification not met: gamma 1.2"
    lost = replace(design, synthesis=SimpleNamespace(gamma=float("inf")))
    assert "does not prove that none exists" in run_verdict(lost, *rest, example.achievable(0.8), 3)


def test_a_verdict_says_that_nobody_looked_for_friction_and_that_linear_plants_have_none():
    design = stored.DesignResult(SimpleNamespace(gamma=0.9), met=True, reason="")
    certify = stored.CertifyResult(None, certified=True, reason="")
    check = SimpleNamespace(
        settled_draws=20, draws=20, friction=None, machine="identified", waits_for_friction=False
    )

    def verdict(**changed):
        loop = SimpleNamespace(check=SimpleNamespace(**(vars(check) | changed)))
        return run_verdict(design, certify, loop)

    assert verdict() == "certified: every requirement is met, and all 20 closed-loop runs settle"
    settling = stored.SettlingRange((0.1, 0.2, 0.4), (7.2, 1.3, None), 30.0)
    friction = SimpleNamespace(settling=replace(settling, times_s=(7.2, 1.3, 2.0)), times_slower=0.0)
    assert verdict(friction=friction, machine="simulated") == verdict()  # that arm has its friction
    assert verdict(friction=friction) == verdict() + " (linear; with dry friction in 1.3 to 7.2 s)"
    friction.settling = settling
    assert verdict(friction=friction).endswith(" (linear; with dry friction in 1.3 to over 30 s)")
    friction.settling = replace(settling, times_s=(None, None, None))
    assert verdict(friction=friction) == verdict() + " (linear; with dry friction not in 30 s)"
    friction.times_slower = 2.5
    assert verdict(friction=friction).endswith("; slower than the recorded loop with friction: 2.5 times")
    doubt = finding(FindingKind.UNTRIED_FRICTION, output="enc")
    words = run_verdict(design, certify, SimpleNamespace(check=check), conditions=[doubt])
    assert words.startswith(verdict() + ". But dry friction was not identified")
    assert words.endswith('set response = "without friction" in [channels.uncertainty]')
    asked = Specification(bandwidth_rad_s=16.0, lowest_bandwidth_rad_s=1.6)
    lower = replace(design, specification=Specification(bandwidth_rad_s=7.43))
    words = run_verdict(lower, certify, SimpleNamespace(check=check), asked=asked)
    assert "every requirement is met for a bandwidth of 7.43 rad/s (specified: 1.6 to 16), and" in words
    plants = [SimpleNamespace(bandwidth_rad_s=8.7), SimpleNamespace(bandwidth_rad_s=8.5)]
    proved = replace(certify, certificate=SimpleNamespace(plants=plants))
    numbers = bandwidth_numbers(lower, proved, asked)
    assert numbers == {"specified": 16.0, "designed_for": 7.43, "reached": 8.5}
    for bandwidths in ((3.0, np.nan), (np.nan, 3.0)):  # one nominal loop is unstable
        plants = [SimpleNamespace(bandwidth_rad_s=bandwidth) for bandwidth in bandwidths]
        proved = replace(certify, certificate=SimpleNamespace(plants=plants))
        assert bandwidth_numbers(lower, proved, asked)["reached"] is None
    given = SimpleNamespace(certified=True, plants=[]), ""
    assert design_verdict(lower, *given, asked).startswith("bandwidth_rad_s = 16 was not met")
    soft = Specification(effort_limit=2.2, highest_effort_limit=8.8, mode_peak_ratio=1.0)
    less = replace(design, specification=Specification(effort_limit=2.31, mode_peak_ratio=1.0))
    words = run_verdict(less, certify, SimpleNamespace(check=check), asked=soft)
    assert "every requirement is met, with effort_limit = 2.31 in place of 2.2, and" in words
    assert run_verdict(less, certify, SimpleNamespace(check=check), asked=less.specification) == verdict()
    white = {"noise_order": 8, "independent": True, "friction": False, "predictable_share": 0.3}
    small, widened = (finding(FindingKind.NOT_WHITE, **white, observer=known) for known in (False, True))
    lag = finding(FindingKind.NOT_INDEPENDENT, lag=3)
    outside = [NominalAgreement(share, 7.0, 12.0).doubt for share in (49.0, 51.0)]
    assert conditions_of([lag, small, *outside[0], widened, *outside[1]]) == [small, *outside[0]]
    words = run_verdict(design, certify, SimpleNamespace(check=check), conditions=[small, *outside[0]])
    assert words.startswith(verdict() + ". But the residuals are not white, even after a noise model of")
    assert ". Also, the nominal model lies outside 51 % of its own ellipses, most near 12 rad/s" in words


def test_achievable_performance_not_asked_for_or_impossible_says_why():
    off = AchievableOptions.model_validate({"compute": False})
    assert "compute = false" in str(task.find_bracket([example.plant()], spec(), off).reason)
    on = AchievableOptions.model_validate({})
    impossible = task.find_bracket([example.plant()], spec(bandwidth_rad_s=1e4), on)
    assert impossible.bracket is None
    assert "Nyquist" in str(impossible.reason)


def test_whole_responses_agree_with_drawing_them_here():
    options = CertificateOptions.model_validate({"joint_draws": 400})
    found = task.certify_asked(
        example.controller(), [example.plant()], spec(), options, np.random.default_rng(3)
    )
    certificate, numbers = found.certificate, task.joint_numbers(found.sampled)
    # Here: the same posterior, drawn with other numbers; gamma on a grid of its own.
    uncertain, law = example.posterior(example.model()), example.controller()
    omega = np.geomspace(1e-3, np.pi / example.DT_S, 3000)
    drawn = uncertain.sample(np.random.default_rng(11), 200)
    loop = uncertain.response_of(drawn, omega) * law.response(omega)
    weight = spec().magnitude(example.plant(), omega, LoopFunction.SENSITIVITY)
    gamma = np.max(weight / np.abs(1 + loop), axis=1)
    # Both are shares of about all draws: 1 % is two draws of 200.
    assert abs(np.mean(gamma <= certificate.gamma) - numbers["held_share"]) < 0.02
    assert numbers["stable_share"] == 1.0
    low, high = numbers["stable_interval"]
    assert low == pytest.approx(400 / (400 + 1.959963985**2))
    assert high == 1.0


def test_without_calibration_the_ellipses_keep_their_level(monkeypatch):
    def calibrate(law, plants, specification, *, rng, coverage, draws):
        return JointCoverage(coverage, draws, 0.9, 0.99, 0.95, 0.88, 0.9, 0.4, 0.998, 0.99)

    monkeypatch.setattr("control_design.analysis.certificate.calibrate", calibrate)
    monkeypatch.setattr("workflow.tasks.design.joint_coverage", calibrate)
    found = {}
    for wanted in (False, True):
        options = CertificateOptions.model_validate({"calibrate": wanted, "joint_draws": 100})
        found[wanted] = task.certify_asked(
            example.controller(), [example.plant()], spec(), options, np.random.default_rng(1)
        )
    kept, raised = found[False], found[True]
    assert kept.certificate == certify(example.controller(), [example.plant()], spec())
    assert raised.certificate.gamma > kept.certificate.gamma, "ellipses of 99 % are larger"
    assert not raised.certified, "99 % of the draws are stable, and 99.9 % are an item"
    assert (kept.sampled.calibrated, raised.sampled.calibrated) == (False, True)
    assert "calibrate = true" in calibration(kept.sampled)
    assert "certified over ellipses of 99 %" in calibration(raised.sampled)
    assert "all frequencies together: checked on models" in "".join(
        not_checked(kept.certificate, sampled=True)
    )
    left = "".join(not_checked(kept.certificate, sampled=False))
    assert "all frequencies together: the ellipses hold" in left


def test_calibration_is_designed_for(monkeypatch):
    asked = []
    result = SimpleNamespace(gamma=0.9, outcome=Outcome.MET_ON_GRID, blocking=())

    def plain(plants, specification, options, *, rng, progress):
        asked.append("plain")
        return specification, result

    def jointly(plants, specification, options, *, rng, progress, first=None):
        asked.append("jointly")
        return JointDesign(result, (), 10_000, (7, 2), True)

    monkeypatch.setattr("workflow.tasks.design.synthesise_giving_way", plain)
    monkeypatch.setattr("workflow.tasks.design.synthesise_jointly", jointly)
    exact = UncertainPlant(example.model().to_control(), name="exact")
    options = CertificateOptions.model_validate({"calibrate": True})
    rng, how = np.random.default_rng(1), SynthesisOptions()
    jointly_said = task.find_design([example.plant()], spec(), how, options, rng).jointly
    assert jointly_said == "2 of 10000 models drawn from the posterior are unstable (enough are stable)"
    assert task.find_design([exact], spec(), how, options, rng).jointly is None
    kept = CertificateOptions.model_validate({})
    assert task.find_design([example.plant()], spec(), how, kept, rng).jointly is None
    # The joint design begins with the plain one.
    assert asked == ["plain", "jointly", "plain", "plain"]


@pytest.mark.parametrize(
    "open_",
    [
        pytest.param({}, marks=pytest.mark.slow),
        pytest.param({"bandwidth_rad_s": 4.0, "lowest_bandwidth_rad_s": 2.0}, marks=pytest.mark.long),
    ],
)
def test_a_missed_specification_says_what_would_meet_it(open_):
    """A modulus margin near one leaves no bandwidth: the reason names a smaller one, and typed it is met."""
    asked = {"effort_limit": 1.5, "modulus_margin": 0.95, "controller_order": 3, "bandwidth_rad_s": 2.0}
    how, options = SynthesisOptions(), CertificateOptions.model_validate({})

    def found(wish):
        wish = Specification.model_validate(wish)
        return task.find_design([uncertain_hub(0.03)], wish, how, options, np.random.default_rng(0))

    missed = found(asked | open_)
    assert not missed.met
    key, value = re.search(r"; (\w+) = ([\d.]+) would meet it", missed.reason).groups()
    met = found(asked | open_ | {key: float(value)})
    assert met.met
    assert "would meet" not in met.reason
    wish = met.specification
    assert task.certify_asked(
        met.controller, [uncertain_hub(0.03)], wish, options, np.random.default_rng(0)
    ).certified


@pytest.mark.parametrize("fails", ["design", "certificate"])
def test_a_hint_that_was_not_designed_and_certified_is_not_given(monkeypatch, fails):
    """A quick design that meets a larger limit is no answer where the whole one or its certificate fails."""
    quick = SimpleNamespace(gamma=0.5, outcome=Outcome.MET_ON_GRID, blocking=())
    whole = SimpleNamespace(gamma=1.2, outcome=Outcome.NOT_MET, blocking=(), controller="law")
    tried = []

    def widest(plants, specification, options, *, rng, progress=None):
        tried.append(specification.effort_limit)
        first = len(tried) == 1 or fails == "design"
        return specification, whole if first else SimpleNamespace(**{**vars(whole), "gamma": 0.9})

    verdict = SimpleNamespace(certified=False)
    monkeypatch.setattr("workflow.tasks.design.synthesise", lambda *_, **__: quick)
    monkeypatch.setattr("workflow.tasks.design.synthesise_giving_way", widest)
    monkeypatch.setattr("workflow.tasks.design.certify_asked", lambda *_, **__: verdict)
    options = CertificateOptions.model_validate({})

    def design():
        tried.clear()
        asked = spec().model_copy(update={"effort_limit": 10.0, "bandwidth_rad_s": None})
        return task.find_design(
            [example.plant()], asked, SynthesisOptions(), options, np.random.default_rng(0)
        )

    assert "would meet" not in design().reason
    # The design that missed, and two whole ones with larger limits.
    assert tried == [10.0, 18.0, 36.0]
    if fails == "certificate":
        verdict.certified = True
        assert design().reason.endswith("effort_limit = 18 would meet it")


def test_words_of_sampled_responses():
    def words(found):
        return sampled(found, task.joint_numbers(found))

    found = example.sampled_responses(0.9)
    assert "of 1000 models drawn from the posterior" in words(found)
    assert "99 % stay within the worst case" in words(found)
    assert "98.17 % to 99.46 % with 95 % confidence" in words(found)
    assert "100 % give a stable loop" in words(found)
    assert words(stored.SampledResponses()) == ""
    lost = replace(found, joint=replace(found.joint, gamma_given=float("inf")))
    assert "no worst case of the ellipses" in words(lost)


def test_what_cannot_be_drawn_says_why():
    exact = UncertainPlant(example.model().to_control(), name="exact")
    assert "nothing to draw" in str(task.undrawable([exact]))
    omega = np.array([1.0, 2.0, 5.0])
    measured = example.posterior(example.model()).at(omega, 0.95)
    own = UncertainPlant(example.model().to_control(), name="measured", uncertainty=measured)
    assert "its own frequencies only" in str(task.undrawable([own]))
    assert task.undrawable([example.plant()]) is None
    found = task.certify_asked(
        example.controller(), [exact], spec(), CertificateOptions.model_validate({}), np.random.default_rng(1)
    )
    assert found.certificate.joint is None
    assert "no uncertainty is specified" in sampled(found.sampled, {})


def test_model_of_a_corner_is_a_power_of_a_lag():
    settings = ReferenceFilterSettings.model_validate({"corner_rad_s": 3.0, "model_order": 3})
    s = 1j * np.array([0.1, 3.0, 20.0])
    assert settings.reference_model.at(s) == pytest.approx(1 / (s / 3 + 1) ** 3)


def test_weight_of_a_reference_filter_is_for_steps_unless_said():
    steps = ReferenceFilterSettings.model_validate({"corner_rad_s": 3.0}).error_weight
    assert np.abs(steps.at(1j * np.array([0.0, 3e4]))) == pytest.approx([100.0, 1.0])
    settings = ReferenceFilterSettings.model_validate({"corner_rad_s": 3.0, "weight": "flat"})
    assert settings.error_weight is None
    # Of a model given as it is, the corner is where |1/(s/5 + 1)| has fallen by 3 dB: 5 rad/s.
    lag = {"numerator": [1.0], "denominator": [0.2, 1.0]}
    weight = ReferenceFilterSettings.model_validate({"model": lag}).error_weight
    assert weight.numerator[1] == pytest.approx(5.0, rel=0.01)
    given = ReferenceFilterSettings.model_validate({"corner_rad_s": 3.0, "weight": lag}).error_weight
    assert given.denominator == (0.2, 1.0)


def test_answer_of_the_model_settles_as_it_should():
    lag = RationalWeight(numerator=(1.0,), denominator=(0.5, 1.0))
    step = task.model_answer(lag, np.ones(400), example.DT_S)
    time = np.arange(400) * example.DT_S
    # Tustin's map of a lag of 50 samples: the step enters half a sample early.
    assert step == pytest.approx(1 - np.exp(-(time + example.DT_S / 2) / 0.5), abs=1e-3)


@pytest.fixture(scope="module")
def filtered() -> stored.ReferenceFilterResult:
    settings = ReferenceFilterSettings.model_validate(
        {"corner_rad_s": 1.0, "grid_points": 60, "mode_points": 20, "dense_points": 1000}
    )
    return task.find_filter(example.controller(), [example.plant()], settings)


def test_reference_filter_of_an_unstable_loop_is_a_reason_and_a_bad_pole_an_error():
    settings = ReferenceFilterSettings.model_validate({"corner_rad_s": 1.0})
    result = task.find_filter(example.controller(500.0), [example.plant()], settings)
    assert result.filter is None
    assert reference_filter(result).startswith("no reference filter: plant 'hub'")
    assert task.find_filter(example.controller(), [example.plant()], None).reason is None
    late = ReferenceFilterSettings.model_validate({"corner_rad_s": 1.0, "poles_rad_s": [900.0]})
    with pytest.raises(InputError, match=r"reference_filter\.poles_rad_s: 900 is not between"):
        task.find_filter(example.controller(), [example.plant()], late)


def test_filter_files(filtered, tmp_path):
    found = filtered.filter
    assert filter_file(Path("k.json")) == Path("k_reference_filter.json")
    again = ReferenceFilter.from_json(law_bytes(found, ".JSON").decode())
    assert np.array_equal(again.A, found.A)
    mat = scipy.io.loadmat(BytesIO(law_bytes(found, ".mat")))
    assert np.array_equal(mat["B"], found.B)
    assert mat["dt_s"].item() == found.dt_s


@needs_compiler
def test_reference_filter_in_c_agrees_to_1e_12(filtered, tmp_path):
    found = filtered.filter
    code = compiled(law_bytes(found, ".c").decode(), tmp_path)
    code.reference_filter_step.restype = ctypes.c_double
    code.reference_filter_step.argtypes = [ctypes.c_void_p, ctypes.c_double]
    state = ctypes.create_string_buffer(8 * (found.order + 4))
    code.reference_filter_reset(state)
    reference = np.repeat(np.random.default_rng(5).standard_normal(40), 25)
    answer = np.array([code.reference_filter_step(state, value) for value in reference])
    assert np.max(np.abs(answer - found.filtered(reference))) < 1e-12


def test_a_verdict_says_up_to_where_the_logs_tell_nothing():
    omega = np.array([0.1, 1.0, 10.0, 100.0])
    covariance = np.array([400.0, 4.0, 0.01, 4.0])[:, None, None] * np.eye(2)
    found = FrequencyUncertainty(omega, np.array([2.0, 2.0, 2.0, 1.0]) + 0j, covariance, 0.01)
    assert untold_below_rad_s(found) == 1.0
    assert untold_below_rad_s(replace(found, covariance=covariance / 1e6)) == 0.0
    assert untold_below_rad_s(replace(found, covariance=covariance * 1e6)) == 100.0
    design = stored.DesignResult(SimpleNamespace(gamma=1.2), met=False, reason="gamma 1.2")
    rest = stored.CertifyResult(None, certified=False, reason="NOT met"), stored.ClosedLoopResult()
    for met, begins in ((False, "specification not met: gamma 1.2; "), (True, "not certified: NOT met; ")):
        words = run_verdict(replace(design, met=met), *rest, example.achievable(0.8), 3, 1.0)
        assert words.startswith(f"{begins}below 1 rad/s (0.159 Hz) the logs do not show the response")
        assert "flexlink excite" in words
