"""What is said of the place of a model error follows from its numbers."""

from dataclasses import replace

import pytest

from diagnosis.where.findings import (
    AmplitudeFinding,
    BandGap,
    Concentration,
    ExperimentGap,
    LinearCorrection,
    PartGap,
    SensorGap,
    Where,
)
from workflow.describe.where import (
    Floor,
    amplitude_words,
    at_length,
    concentration_words,
    experiments_words,
    frequency_range,
    in_short,
    linear_words,
    mostly,
    share_words,
)

NOISE, THRESHOLD = Floor(0.0), Floor(0.05)
PART = PartGap(5.0, (4.9, 5.1), 0.5, (0.45, 0.55), 1e-4, True, 0.01)
QUIET = replace(PART, gap_rms=0.0, share=0.0, share_interval=(0.0, 0.0), found=False)


def experiment(name: str, size: float, found: bool = True) -> ExperimentGap:
    gap = replace(PART, gap_rms=size, interval=(0.95 * size, 1.05 * size), found=found)
    return ExperimentGap(f"logs/{name}.csv", gap, (gap,))


def bands(*shares: float) -> tuple[BandGap, ...]:
    edges = (0.0, 2.0, 10.0, 40.0)
    return tuple(
        BandGap("hub_angle", edges[k], edges[k + 1], replace(PART, share=share))
        for k, share in enumerate(shares)
    )


def place(*shares: float, **parts) -> Where:
    parts = {"experiments": (experiment("a", 5.0), experiment("b", 5.0)), **parts}
    return Where(
        PART, (SensorGap("hub_angle", replace(PART, share=1.0)),), bands=bands(*shares), level=0.05, **parts
    )


def test_sizes_at_a_threshold_hold_it_and_those_over_noise_do_not():
    assert NOISE.times(3.0) == 3.0
    assert THRESHOLD.times(3.0) == pytest.approx(10.0**0.5)
    assert THRESHOLD.times(0.0) == 1.0


@pytest.mark.parametrize(
    ("share", "half_width", "said"),
    [(0.9, 0.02, "90 %"), (0.997, 0.02, "practically all"), (0.9, 0.2, "at least 70 %")],
)
def test_a_share_is_said_as_surely_as_it_is_known(share, half_width, said):
    assert concentration_words(Concentration(2.0, 10.0, share, half_width)) == said


def test_all_is_not_claimed_of_less():
    assert [share_words(share) for share in (0.994, 0.995)] == ["99 %", "practically all"]


@pytest.mark.parametrize(
    ("low", "high", "said"),
    [(0.0, 2.0, "below 2 Hz"), (10.0, 40.0, "above 10 Hz"), (2.0, 10.0, "between 2 and 10 Hz")],
)
def test_a_range_at_an_end_is_open(low, high, said):
    assert frequency_range(low, high, place(0.3, 0.3, 0.4)) == said


def test_most_of_an_error_is_placed_only_where_a_narrow_band_has_it():
    assert mostly(place(0.05, 0.9, 0.05)) == "mostly between 2 and 10 Hz"
    assert mostly(place(0.3, 0.3, 0.4)) == ""


@pytest.mark.parametrize(
    ("sizes", "named", "alike"),
    [
        ([5.0, 5.2, 5.1], [], True),  # no difference that intervals allow to speak of
        ([2.0, 9.0, 5.0], ["b most", "a least"], False),
        ([5.0, 0.0, 5.0], ["but b "], False),
        ([0.0, 9.0, 0.0], ["Only b shows"], False),
    ],
)
def test_experiments_are_named_where_they_differ(sizes, named, alike):
    experiments = tuple(
        experiment(name, size, found=size > 0) for name, size in zip("abc", sizes, strict=True)
    )
    words = experiments_words(place(0.3, 0.3, 0.4, experiments=experiments), NOISE)
    assert all(one in words for one in named)
    assert ("about equally" in words) == alike


@pytest.mark.parametrize(
    ("share", "linear"), [(0.95, True), (0.9, True), (0.7, None), (0.49, False), (0.0, False)]
)
def test_a_cause_is_called_linear_or_not_only_where_a_correction_tells(share, linear):
    words = linear_words(LinearCorrection(share, (0.0, 1.0)))
    assert (words == "") == (linear is None)
    assert ("acts linearly" in words, "is not linear" in words) == (linear is True, linear is False)


def test_growth_with_the_voltage_is_not_said_against_a_linear_correction():
    faster = AmplitudeFinding(("logs/weak.csv", "logs/strong.csv"), 2.0, 4.0, 2.0, (1.8, 2.2), "faster", True)
    linear = LinearCorrection(0.95, (0.9, 1.0))
    assert "4 times as large; it grows faster" in amplitude_words(faster, None)
    assert amplitude_words(faster, linear) == ""
    assert "2 times the voltage (weak to strong)" in amplitude_words(replace(faster, growth="linear"), linear)
    assert amplitude_words(replace(faster, growth="undecided"), None) == ""
    assert amplitude_words(None, None) == ""


def test_nothing_is_said_where_nothing_lies():
    still = ExperimentGap("a", QUIET, (QUIET,))
    nothing = Where(QUIET, (SensorGap("hub_angle", QUIET),), (still,), (), level=0.05)
    assert at_length(nothing, NOISE, "nominal parameters") == ()
    assert "sensor noise" in in_short(nothing, NOISE)
    assert "the threshold" in in_short(nothing, THRESHOLD)
