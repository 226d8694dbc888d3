"""Frequency responses under the names that analysers, programs and people give their columns."""

import numpy as np
import pytest

from ident.data.frequency_uncertainty import FrequencyUncertainty
from ident.data.frf_records import FrfRepeats
from ident.data.record_files import read_table
from ident.data.response_columns import DoubtError, has_response, response_columns

OMEGA = 2 * np.pi * np.array([1.0, 3.0, 9.0, 20.0])
TRUE = 5.0 / (1j * OMEGA / 20 + 1) ** 3
HZ, DB, DEG = OMEGA / 2 / np.pi, 20 * np.log10(np.abs(TRUE)), np.rad2deg(np.angle(TRUE))
GAIN, RAD, RE, IM = np.abs(TRUE), np.angle(TRUE), TRUE.real, TRUE.imag


def write(path, head, *columns, separator=",", before="", decimal="."):
    rows = [
        separator.join(f"{value:.9g}".replace(".", decimal) for value in row)
        for row in zip(*columns, strict=True)
    ]
    path.write_text(before + "\n".join([head, *rows]) + "\n", encoding="utf-8")
    return path


# Of analysers (Bode 100, AP300, Moku), drives, FOC tools, MATLAB, and people.
STYLES = {
    "bode100": ("Frequency (Hz);Trace 1: Gain: Magnitude (dB);Trace 1: Gain: Phase (°)", (HZ, DB, DEG), ";"),
    "turned": ("Frequency (Hz)\tPhase (deg)\tGain (dB)", (HZ, DEG, DB), "\t"),
    "foc": ("freq_hz,H_real,H_imag,mag_db,phase_deg", (HZ, RE, IM, DB, DEG), ","),
    "moku": ("Frequency (Hz), Channel A Magnitude (dB), Channel A Phase (deg)", (HZ, DB, DEG), ","),
    "ap300": ("Freq(Hz),Mag(dB),Phase(deg)", (HZ, DB, DEG), ","),
    "german": ("f [Hz];Betrag [dB];Phase [°]", (HZ, DB, DEG), ";"),
    "matlab": ("Frequency (rad/s),Magnitude (abs),Phase (deg)", (OMEGA, GAIN, DEG), ","),
    "ratio": ("w [rad/s],|G| [rad/V],arg(G) [rad]", (OMEGA, GAIN, RAD), ","),
    "complex": ("omega,Re(G),Im(G)", (OMEGA, RE, IM), ","),
    "kilohertz": ("frequencyKHz,gainDb,phaseDeg", (HZ / 1e3, DB, DEG), ","),
    "revolutions": ("freq_rpm,gain_dB,phase_rad", (60 * HZ, DB, RAD), ","),
    "capitals": ("FREQ_HZ,GAIN_DB,PHASE_DEG,COHERENCE", (HZ, DB, DEG, 0 * HZ + 0.99), ","),
    "units only": ("Hz,dB,deg", (HZ, DB, DEG), ","),
    "spelled": ("frequency in Hz,gain in dB,phase in degrees", (HZ, DB, DEG), ","),
    "own": ("frequency_Hz,gain,phase_rad", (HZ, GAIN, RAD), ","),
}


@pytest.mark.parametrize("style", STYLES)
@pytest.mark.parametrize("ending", [".csv", ".txt"])
def test_names_of_all_kinds_are_read_by_their_units(style, ending, tmp_path):
    head, columns, separator = STYLES[style]
    found = FrfRepeats.from_csv(write(tmp_path / f"a{ending}", head, *columns, separator=separator))
    np.testing.assert_allclose(found.omega_rad_s, OMEGA, rtol=1e-7)
    np.testing.assert_allclose(found.response, TRUE, rtol=1e-6)


def test_units_below_the_names_and_decimal_commas(tmp_path):
    head = "Frequenz;Betrag;Phase\nkHz;dB;°"
    path = write(tmp_path / "a.csv", head, HZ / 1e3, DB, DEG, separator=";", decimal=",")
    np.testing.assert_allclose(FrfRepeats.from_csv(path).response, TRUE, rtol=1e-6)


def test_variances_stand_beside_any_form(tmp_path):
    path = write(
        tmp_path / "a.csv", "freq_hz,mag_db,phase_deg,variance_real,variance_imag", HZ, DB, DEG, HZ, HZ
    )
    found = FrequencyUncertainty.from_csv(path, 0.001)
    np.testing.assert_allclose(found.centre, TRUE, rtol=1e-6)
    np.testing.assert_allclose(found.covariance[:, 1, 1], HZ)


@pytest.mark.parametrize(
    ("head", "columns", "asked"),
    [
        ("Frequency,Gain (dB),Phase (deg)", (HZ, DB, DEG), "'Frequency' Hz or rad/s"),
        ("Frequency (Hz),Magnitude,Phase (deg)", (HZ, DB, DEG), "'Magnitude' a factor or in dB"),
        ("Frequency (Hz),gain,Phase (deg)", (HZ, DB, DEG), "'gain' a factor or in dB"),
        ("Frequency (Hz),Gain (dB),Phase", (HZ, DB, DEG), "'Phase' rad or degrees"),
        ("Frequency (Hz),Gain (dBV),Phase (deg)", (HZ, DB, DEG), "Unit 'dbv' is not known"),
        ("Frequency (Hz),Gain (%),Phase (deg)", (HZ, DB, DEG), "Unit '%' is not known"),
        ("Frequency (Hz),Gain (dB),Phase (grad)", (HZ, DB, DEG), "Unit 'grad' is not known"),
        ("Frequency (Hz),Gain (dB),Phase lag (deg)", (HZ, DB, -DEG), "without phase"),
        ("Frequency (Hz),Gain (dB)", (HZ, DB), "without phase"),
        ("freq_hz,H_real,H_imag,mag_db,phase_deg", (HZ, RE, IM, DB, -DEG), "line 2: .* contradict"),
        ("freq_hz,Ch1 (dB),Ch2 (dB),phase_deg", (HZ, 0 * DB, DB, DEG), "line 2: .* contradict"),
        ("freq_hz,A_re,A_im,B_re,B_im", (HZ, RE, IM, IM, RE), "both real parts"),
    ],
)  # fmt: skip
def test_what_is_not_said_is_asked(head, columns, asked, tmp_path):
    path = write(tmp_path / "a.csv", head, *columns)
    assert has_response(read_table(path))
    with pytest.raises(DoubtError, match=asked) as raised:
        FrfRepeats.from_csv(path)
    assert str(path) in str(raised.value)
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize(
    "head", ["time_s,freq_hz,gain_dB,phase_deg", "t,u_V,y,z", "f_N,u_V,re_x,im", "frequency,amp,q,r"]
)
def test_logs_over_time_are_none(head, tmp_path):
    assert response_columns(read_table(write(tmp_path / "a.csv", head, HZ, DB, DEG, DEG))) is None


@pytest.mark.parametrize(
    ("counts", "hint"),
    [
        ((1, 1, 1, 1), r"one sweep: .*give variance_real, variance_imag or a stated uncertainty$"),
        ((2, 2, 2, 2), r"are 2 repeats: .* at least 3, or pool_neighbours = 1$"),
        ((3, 1, 1, 3), r"is 1 measurement: .* at least 3, or pool_neighbours = 1$"),
        ((1, 1, 1, 2), r"is 1 measurement: .* at least 3; give variance_real, variance_imag or a stated"),
    ],
)
def test_hints_about_few_repeats_mend_it(counts, hint, tmp_path):
    rng = np.random.default_rng(0)
    repeats = FrfRepeats(
        np.repeat(OMEGA, counts), np.repeat(TRUE, counts) + 0.01 * rng.standard_normal(sum(counts))
    )
    with pytest.raises(ValueError, match=hint) as raised:
        repeats.mean(0.001)
    if "pool_neighbours" in str(raised.value):
        assert repeats.mean(0.001, pool_neighbours=int(str(raised.value)[-1])).omega_rad_s.size == OMEGA.size
