"""The measured arm of the examples: its certified margins, and zeros that follow from its physics."""

from types import SimpleNamespace

import numpy as np
import pandas as pd
import pytest

from tests.golden import margins
from workflow.config.run_config import load_config
from workflow.engine.progress import Progress
from workflow.tasks.identification import identify_channels
from workflow.tasks.records import make_records
from workflow.tasks.stage import StageInput


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_margins_of_a_measured_arm_stay(tmp_path, monkeypatch, flexlink_data):
    """In CI those of the default arm: `tests/workflow/test_readme.py`. Of all examples: `make frozen`."""
    monkeypatch.setenv("FLEXLINK_DATA", str(flexlink_data))
    off = margins.moved("slfr_krauss_2009", margins.measure("slfr_krauss_2009", tmp_path / "out"))
    assert not off, f"measured against golden: {off}; if meant, rerun python -m tests.golden.margins"


@pytest.mark.slow
def test_zeros_of_the_hub_are_the_modes_of_the_arm_with_the_hub_held(monkeypatch, flexlink_data):
    """Physics that the identification has not seen: drive and angle of one shaft are collocated, so the
    response has its zeros where the arm swings with the shaft held, and the free decays were recorded like
    that."""
    monkeypatch.setenv("FLEXLINK_DATA", str(flexlink_data))
    config, _ = load_config(margins.ROOT / "examples" / "slfr_krauss_2009.toml")
    results = SimpleNamespace()
    stage = StageInput(config.model_copy(update={"channels": config.channels[:1]}), results, Progress())
    results.records = make_records(stage)
    (hub,) = identify_channels(stage).channels
    zeros = hub.model.to_control().zeros()
    zeros = np.log(zeros[np.abs(zeros) > 0.5].astype(complex)) / hub.model.dt_s
    found_Hz = np.abs(zeros[zeros.imag > 1.0]) / (2 * np.pi)
    decay = pd.read_csv(flexlink_data / "slfr_krauss_2009" / "free_decay_hub_held_rep1.csv")
    swing = decay["accel_counts"].to_numpy(float)
    swing = np.hanning(swing.size) * (swing - swing.mean())
    frequency_Hz = np.fft.rfftfreq(16 * swing.size, 0.002)
    spectrum = np.abs(np.fft.rfft(swing, 16 * swing.size))
    # Measured 2.1 % and 1.7 % apart; the held hub is no ideal clamp (it slipped in one decay), and the gain
    # at a zero is all noise, so twice that is allowed.
    for low, high, share in ((1.5, 4.0, 0.04), (15.0, 21.0, 0.035)):
        inside = (frequency_Hz > low) & (frequency_Hz < high)
        held_Hz = frequency_Hz[inside][np.argmax(spectrum[inside])]
        assert np.min(np.abs(found_Hz - held_Hz)) < share * held_Hz, (held_Hz, found_Hz)
