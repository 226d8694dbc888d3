"""docs/own_plant.md runs as it stands, and the page it writes says what was found."""

import doctest
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from workflow.diagnose.advice import advice_words
from workflow.diagnose.following import following
from workflow.diagnose.pages import plant_page, remains_of

GUIDE = Path(__file__).resolve().parents[2] / "docs" / "own_plant.md"
DT_S, SAMPLES = 0.01, 500


def _motor():
    """Records of a motor whose equations are not those of the page: ten steps a sample, Euler."""
    rng = np.random.default_rng(4)

    def levels(amplitude):
        return amplitude * rng.uniform(-1, 1, SAMPLES // 20).repeat(20)[:, None]

    def measured(voltage):
        late = np.concatenate([np.zeros(33), voltage[:, 0].repeat(10)])
        w, found = 0.0, []
        for k, u in enumerate(late[: 10 * SAMPLES]):
            if k % 10 == 0:
                found.append(w)
            w += DT_S / 10 / 0.195 * (10.2 * u - w - 0.001 * w * abs(w))
        return np.array(found)[:, None] + 0.4 + 0.05 * rng.standard_normal((SAMPLES, 1))

    return {"levels": levels, "measured": measured}


@pytest.mark.slow
def test_the_guide_runs_and_its_page_says_what_was_found(tmp_path, faults_seen):
    given = {"DT_S": DT_S, "folder": tmp_path, **_motor()}
    test = doctest.DocTestParser().get_doctest(GUIDE.read_text(), given, GUIDE.name, str(GUIDE), 0)
    result = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE).run(test, clear_globs=False)
    assert (result.failed, result.attempted > 8) == (0, True)
    page = (tmp_path / "motor.html").read_text()
    for section in ("gap", "where", "which", "closure", "remains", "unchecked"):
        assert f'<section id="{section}">' in page
    # Measured, gap, four of where, probabilities, partial answers, spectra.
    assert page.count("<figure>") == 9
    assert faults_seen(tmp_path / "motor.html") == []
    words = " ".join(re.sub(r"<[^>]+>", " ", page).split())
    found = test.globs["found"]
    assert "a delay of the command" in words
    assert "output offset" in words
    presence = 100 * found.presence("input_delay")
    delay_s = found.repair[0].values["delay_s"]
    assert f"a delay of the command ({presence:.3g} %, {delay_s:.3g} s)" in words.lower()
    assert f"{found.rig.parameters['time_constant_s']:.5g} s" in words
    assert "less noise than specified" not in words
    unsampled = replace(found, case=replace(found.case, plant=replace(found.case.plant, dt_s=np.nan)))
    with pytest.raises(ValueError, match=r"state the plant's sampling period \(Plant\(dt_s=...\)\)"):
        remains_of(unsampled)
    quiet = replace(found, noise_below_stated=(("speed_rad_s", 0.05, 0.5),))
    page = " ".join(re.sub(r"<[^>]+>", " ", plant_page(quiet, advice_words(quiet, following(quiet)))).split())
    assert page.count("the noise they show is used: speed 0.05 rad/s (specified: 0.5 rad/s).") == 1
    # Of two effects of the repaired model the one that may carry less than the threshold is not left out.
    doubtful = tuple(replace(e, presence=0.24) if e.name == "output_offset" else e for e in found.effects)
    beside = replace(found.shares, small=("output_offset",))
    alone = replace(found, combination=("input_delay",), effects=doubtful, shares=beside, ambiguous_with=())
    page = " ".join(re.sub(r"<[^>]+>", " ", plant_page(alone, advice_words(alone, following(alone)))).split())
    assert page.count("; the repaired model also has output offset (not certain: 24 %)") == 1
    assert "With the effects added, every experiment is below the threshold of" in page
