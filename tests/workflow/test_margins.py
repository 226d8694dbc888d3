"""Regression test on closed-loop margins: an example, end to end, against `tests/golden/margins.toml`."""

import numpy as np
import pandas as pd
import pytest

from tests.golden import margins
from workflow.config.run_config import load_config
from workflow.engine.run_directory import RunDirectory
from workflow.tasks.results import RunResults


@pytest.mark.slow
@pytest.mark.usefixtures("undrawn")
def test_margins_stay_and_zeros_of_the_hub_are_the_modes_of_the_arm_with_the_hub_held(
    tmp_path, monkeypatch, flexlink_data
):
    """Physics that the identification has not seen: drive and angle of one shaft are collocated, so the
    response has its zeros where the arm swings with the shaft held, and the free decays were recorded like
    that. Margins of the other examples: `make frozen`."""
    monkeypatch.setenv("FLEXLINK_DATA", str(flexlink_data))
    off = margins.moved("slfr_krauss_2009", margins.measure("slfr_krauss_2009", tmp_path / "out"))
    assert not off, f"measured against golden: {off}; if meant, rerun python -m tests.golden.margins"
    config, _ = load_config(margins.ROOT / "examples" / "slfr_krauss_2009.toml")
    plant = RunResults(RunDirectory.open(tmp_path / "out")).uncertainty.plant(config)
    zeros = np.log(plant.zeros[np.abs(plant.zeros) > 0.5].astype(complex)) / plant.dt_s
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
