"""The sentence of every finding: each kind has one, of its values, in the words of whoever speaks."""

import re
from inspect import signature

import pytest
import typer.main
from click import Context

from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.data.finding import FindingKind, finding
from workflow.cli import app
from workflow.config.uncertainty_options import UncertaintyOptions
from workflow.text.findings.sentences import SENTENCES, words
from workflow.text.options import OPTIONS, speaking
from workflow.text.sentences.records import unexplained_logs

# One value for every name that any sentence asks for.
VALUES = {
    "in_header": "s", "dt_s": 1.0, "own_s": 0.013, "a": 0.9999999, "integrators": 0, "omega_rad_s": 12.3456,
    "zeta": 0.0234, "fewest_periods": 3.0, "largest_zeta": 0.6, "low_rad_s": 1.0, "high_rad_s": 10.0,
    "limit_rad_s": 60.123, "time_constant_s": 49.73, "longest_s": 5.0, "n_samples": 800, "unknowns": 90,
    "worth": 123.4, "inputs": "['a', 'b']", "rank": 1, "count": 2, "record": "r<1>", "signal": "output",
    "name": "y", "input": "u", "output": "y", "share": 0.4234, "drift": 1.234, "mean": 50.0123, "std": 1.23,
    "prior": "what_was_stated = 2", "refused": True, "imposed": True, "needed": True, "columns": 3,
    "statistic": 12.34, "limit": 9.21, "level": 0.99, "accepted": 1, "enough": 1, "one_less": 2, "order": 4,
    "free_poles": "0.998, 0.9 +- 0.1j", "other_delay": 2, "delay": 14, "delay_ms": 70.0, "low": 14,
    "high": 14, "order_without": 6, "gain": 83.21, "partial": False, "poles": 2, "fit_percent": -0.123,
    "half_power_Hz": 0.512, "unpredictable_share": 0.0123, "predictable_share": 0.0016, "passed": False,
    "probability": 1e-4, "max_lag": 25, "lag": 7, "correlation": 0.314, "precedes_input": True,
    "noise_order": 0, "independent": True, "friction": False, "observer": False, "why": "clean",
    "stated": False, "chi_square": 222.22, "degrees_of_freedom": 224, "expected_low": 178.0,
    "expected_high": 276.12, "n": 60, "outside": 9, "expected": 6, "worst_rad_s": 50.123,
    "worst_distance": 3.21, "least_percent": 90.0, "most_percent": 95.0, "explained_percent": 12.3,
    "relative_std": 0.0342, "rms": 4.0012, "unit": "V", "percent": 2.345, "samples": 4000, "rows": 12,
    "line": 7, "value": -9999.0, "place": "line 7", "period": 4096.0, "units": "deg and rad", "missing": 12,
    "jitter": 0.0421, "cell": "(3.25)",
    "too_narrow": 0.0015, "faithful_rad_s": 93.62, "from_Hz": 0.2, "to_Hz": 31.62, "parity": "odd",
    "trend": "falls", "lines": 61, "n_records": 2, "n_amplitudes": 2, "times": 1.5, "most_from_Hz": 16.2,
    "most_to_Hz": 22.0, "chance_percent": 0.81, "shift_percent": -0.65, "shift_from_Hz": 16.2,
    "shift_to_Hz": 22.0, "gain_percent": 4.86, "gain_from_Hz": 2.2, "gain_to_Hz": 2.9, "reference": "r",
    "like": "degrees and radians", "of": "deg", "options": "--scale y=57.3",
    "nyquist_rad_s": 1571.0, "largest_below": 1.2, "gain_at_high": 0.0063, "gain_at_nyquist": 0.0007,
    "largest_above": 0.0063, "largest_above_rad_s": 400.0, "direct_term": 0.000366,
    "outside_percent": 51.0, "at_rad_s": 12.0, "same": False, "step_s": 0.002, "repeats": False,
    "level_std": 0.02, "ratio": 1.4, "fewest": 6, "most": 13, "from_rad_s": 143.2,
}  # fmt: skip
# Other values that lead to other words.
OTHERWISE = {
    "SLOW_BOUND": [{"integrators": 1}],
    "TIME_UNIT": [{"in_header": ""}, {"in_header": "ms", "dt_s": 2e-6}],
    "UNIT_OF_LOOP": [{"options": "--scale y=57.3 --unit y=rad"}],
    "UNIT_OF_REFERENCE": [{"same": True, "options": "--reference y --unit y=deg"}],
    "REFERENCE_STILL": [{"record": ""}],
    "REPAIRED": [{"missing": 0}],
    "SKIPPED_ROWS": [{"rows": 1}],
    "CONTROLLER_PERIOD": [{"reference": ""}, {"repeats": True}],
    "TWO_STAGE": [{"least_in_loop_percent": 84.2, "most_in_loop_percent": 90.1}],
    "UNTRIED_FRICTION": [{"speed": True}],
    "REMOTE_FRICTION": [{"ratio": 0.0}],
    "OPPOSITE": [{"options": "--scale y=-1 --unit y=rad"}],
    "WRAPS": [{"name": "hub angle", "period": 2 * 3.141592653589793}],
    "NUISANCE": [{"needed": False}],
    "INTEGRATORS": [{"accepted": 0}, {"refused": False}],
    "DELAY": [{"other_delay": 1}],
    "DEAD_TIME": [{"delay": 1, "low": 1, "high": 2}, {"partial": True}],
    "RELATIVE_DEGREE": [{"imposed": False}],
    "WHITENESS": [{"passed": True}, {"probability": 0.0}],
    "INDEPENDENCE": [
        {"passed": True, "precedes_input": False, "probability": p} for p in (0.48, 0.9961, 1.0)
    ],
    "NOT_WHITE": [
        {"independent": False},
        {"noise_order": 8},
        {"noise_order": 8, "independent": False, "friction": True},
        {"observer": True},
        {"observer": True, "independent": False},
    ],
    "DIRECT": [{"why": "small", "times": 0.42}, {"why": "spoilt", "stated": True}],
    "CHI_SQUARE": [{"chi_square": 100.0}, {"chi_square": 400.0}],
    "ASSUMED_OUTSIDE": [{"integrators": 1}, {"largest_above": 0.5, "largest_above_rad_s": 620.0}],
    "DISTORTED": [{"trend": "grows"}, {"parity": "both", "trend": "unknown"}, {"parity": "unknown"}],
    "ONE_REALISATION": [{"lines": 0}],
    "NOT_PERIODIC": [{"from_Hz": 0.0, "to_Hz": 0.0}],
    "REPEATED": [{"n_amplitudes": 1}],
    "AMPLITUDE_EFFECT": [{"shift_percent": 0.65, "gain_percent": 0.0}, {"gain_percent": -5.6}],
}


def sentences(**more):
    return [
        words(finding(kind, **(VALUES | other | more)))
        for kind in FindingKind
        for other in ({}, *OTHERWISE.get(kind.name, ()))
    ]


# Values that are names or places: a sentence that takes one says it.
NAMES = {
    "record",
    "name",
    "output",
    "input",
    "signal",
    "inputs",
    "reference",
    "place",
    "cell",
    "units",
    "unit",
}


def test_every_kind_has_its_sentences():
    for sentence in sentences():
        assert len(sentence.split()) > 6
        assert "\n" not in sentence
        assert not re.search(r"\b(None|nan|True|False)\b|[{}]|  |&\w+;", sentence)


@pytest.mark.parametrize("kind", FindingKind, ids=lambda kind: kind.name.lower())
def test_a_sentence_names_what_it_is_about(kind):
    """Signs that a page escapes, too."""
    sentence = words(finding(kind, **VALUES))
    for name in NAMES & set(signature(SENTENCES[kind]).parameters):
        if (kind, name) != (FindingKind.CONTROLLER_PERIOD, "reference"):  # whether there is one
            assert str(VALUES[name]) in sentence


def every_sentence():
    priors = ("integrators = 2", "fixed_poles", "input_delay_samples = 3", "relative_degree = 2")
    return [one for prior in priors for one in sentences(prior=prior, friction=True)]


def options_of(command):
    group = typer.main.get_command(app)
    _, found, _ = group.resolve_command(Context(group), [command])
    return {name for parameter in found.params for name in parameter.opts}


KEYS = {
    key for settings in (IdentOptions, EmbeddingOptions, UncertaintyOptions) for key in settings.model_fields
}


@pytest.mark.parametrize("command", OPTIONS)
def test_hints_of_a_command_name_its_own_options(command):
    elsewhere = re.compile(
        r"\w+( = \S+)? \(in a configuration of flexlink run\)|uncertainty\.method = 'records'"
    )
    with speaking(command):
        told = every_sentence()
    named = {name for sentence in told for name in re.findall(r"--[a-z][a-z-]*", sentence)}
    assert named <= options_of(command)
    # Every option that the table knows is really an option, and the sentences reach most of them.
    assert {text.split()[0] for text in OPTIONS[command].values()} <= options_of(command)
    assert {"--delay", "--feedthrough", "--noise-order", "--zeta-max", "--response"} <= named
    for sentence in told:
        rest = elsewhere.sub("", sentence)
        assert not {key for key in KEYS if "_" in key} & set(re.findall(r"\w+", rest)), sentence


def test_hints_of_a_configuration_name_its_keys():
    told = KEYS | {"time_unit", "resample_s", "controller_period_s", "flexlink"}
    for sentence in every_sentence():
        if "in a configuration)" in sentence or "--unit" in sentence:
            continue  # doubts about columns name both ways themselves
        assert "--" not in sentence, sentence
        assert set(re.findall(r"\b([a-z]+(?:_[a-zA-Z]+)+)\b", sentence)) <= told, sentence


def test_a_loop_that_no_model_explains_is_told_about_dry_friction():
    """Where nobody looked for friction: with the option of the command that refuses."""
    with speaking("identify"):
        refused = unexplained_logs("enc", "its best fit to one is 49 %", friction_known=False)
    assert "dry friction is a common cause: if 'enc' is the position" in refused
    assert '(--response "without friction")' in refused
    assert "as recorded" not in refused
    looked = unexplained_logs("enc", "its best fit to one is 49 %", friction_known=True)
    assert "common cause" not in looked
    assert "as recorded" not in looked  # it would have a wrong damping
