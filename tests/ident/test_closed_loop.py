"""Closed-loop logs: bias of the direct method, two-stage without it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import signal

from ident.basis.options import EmbeddingOptions, IdentOptions
from ident.closed_loop import two_stage
from ident.data.record import Record
from ident.one_input import identify
from ident.uncertainty.conditions import combine_posteriors, record_posteriors
from ident.uncertainty.embedding import tangent

DT = 0.01
B, A, GAIN = [0.0, 0.06, 0.05], [1.0, -1.62, 0.72], 1.5
OMEGA = np.geomspace(1.0, 250.0, 60)
TRUTH = signal.freqz(B, A, worN=OMEGA * DT)[1]
OPTIONS = IdentOptions(n_real=0, n_pairs=1, estimate_offset=False, estimate_initial_state=False)
# One mode and no other: what a mode that might be missing adds to the ellipses is tested elsewhere.
BOUNDS = EmbeddingOptions(fir_length=20, coloured_noise=True, prior_missed_mode=0.0)


def log(rng, noise=0.3, n=3000):
    r = rng.standard_normal(n)
    e = noise * signal.lfilter([1.0], [1.0, -0.7], rng.standard_normal(n))
    closed = np.polyadd(A, GAIN * np.asarray(B))
    y = signal.lfilter(B, closed, r) + signal.lfilter(A, closed, e)
    u = r - GAIN * y
    return Record(
        "log", u[:, None], y[:, None], DT, ("u",), ("y",), reference=r[:, None], reference_names=("r",)
    )


def test_two_stage_is_free_of_the_direct_method_s_bias():
    records = [log(np.random.default_rng([1, seed])) for seed in range(4)]
    stage = two_stage(records, OPTIONS, BOUNDS)
    assert all(record.reference is None for record in stage.records)
    # The noise-free input itself is known here: S r with S = A / (A + g B).
    closed = np.polyadd(A, GAIN * np.asarray(B))
    ideal = signal.lfilter(A, closed, records[0].reference[:, 0])
    error = np.linalg.norm(stage.records[0].input[:, 0] - ideal) / np.linalg.norm(ideal)
    assert error < 0.06
    assert np.linalg.norm(records[0].input[:, 0] - ideal) / np.linalg.norm(ideal) > 5 * error

    def bounds(used, coloured_noise):
        options = BOUNDS.model_copy(update={"coloured_noise": coloured_noise})
        return tangent(used, identify(used, OPTIONS).model, options).at(OMEGA)

    weak = np.abs(TRUTH) < 0.3
    # The direct method without a noise model; a true noise model would free it of its bias, too.
    opened, direct = bounds(stage.records, True), bounds(records, False)
    assert np.abs(opened.centre - TRUTH)[weak].mean() < 0.5 * np.abs(direct.centre - TRUTH)[weak].mean()
    assert opened.contains(TRUTH)[weak].mean() > 0.8
    assert direct.contains(TRUTH).mean() < 0.5
    # Every record has its own estimate of S, and each holds the truth.
    truth = signal.freqz(A, closed, worN=OMEGA * DT)[1]
    assert not np.array_equal(stage.sensitivities[0].mean, stage.sensitivities[1].mean)
    assert np.mean([one.at(OMEGA).contains(truth) for one in stage.sensitivities]) > 0.8


def test_bounds_of_combined_records_cover_where_the_loop_gain_is_large():
    combined_hits = []
    for seed in range(6):
        records = [log(np.random.default_rng([5, seed, i]), n=1500) for i in range(5)]
        stage = two_stage(records, OPTIONS, BOUNDS)
        model = identify(stage.records, OPTIONS).model
        combined = combine_posteriors(
            record_posteriors(stage.records, model, BOUNDS), small_sample_level=0.95
        )
        combined_hits.append(combined.at(OMEGA).contains(TRUTH))
    # Few independent frequencies in a smooth response: 6 runs tell coverage to about 10 %.
    assert np.mean(combined_hits) > 0.85


def test_records_without_reference_are_refused():
    record = log(np.random.default_rng(4), n=100)
    bare = Record("b", record.input, record.output, DT, ("u",), ("y",))
    with pytest.raises(ValueError, match="exactly one reference"):
        two_stage([bare], OPTIONS)
