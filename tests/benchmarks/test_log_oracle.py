"""A few of the thousand logs of the oracle; each is another one for another number."""

import pytest

from benchmarks import log_oracle
from tests.ident.generated_logs import generated


@pytest.mark.parametrize(
    "text_share",
    [pytest.param(1.0, marks=pytest.mark.slow), pytest.param(0.0, marks=pytest.mark.long)],
    ids=["text", "others"],
)
def test_no_log_is_misread_in_silence_and_every_hint_helps(tmp_path, text_share):
    count = 20 if text_share else 2  # which take a process each
    logs = [generated(4711, number, text_share) for number in range(count)]
    found = [(log.kind, *log_oracle.outcome(log, tmp_path)) for log in logs]
    assert [one for one in found if one[1] not in (*log_oracle.GOOD, log_oracle.HINT)] == []
    assert sum(one[1] == log_oracle.HINT for one in found) <= 0.05 * count
    assert {"right", "asked"} <= {one[1] for one in found} or not text_share
