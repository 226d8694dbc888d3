"""A run directory keeps what its configuration states and leaves open what that leaves open.

So a run that goes on, a study on it and a design from it put the same questions to the data.
"""

import shutil
import tomllib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ident.basis.options import LEFT_OPEN, IdentOptions
from tests.workflow.command import FAST_ARM, ROOT
from tests.workflow.test_resume import NAMES, plain_page, stage_bytes
from workflow.commands.run import run_from_files
from workflow.config.run_config import RunConfig, load_config
from workflow.config.settings import check
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.run_directory import RunDirectory
from workflow.joints import JointsConfig
from workflow.kinds import load_any
from workflow.study.points import load_base
from workflow.study.settings import StudyConfig, with_values
from workflow.tasks.pipeline import config_of, identify_only
from workflow.tasks.results import RunResults
from workflow.tasks.stages import STAGES

__all__ = ["plain_page"]

DEAD_TIME_SAMPLES = 5
CONFIGURATION = """
[source]
kind = "files"
dt_s = 0.01
records = [{ path = "log.csv" }]

[[channels]]
input = "u_V"
output = "y_rad"

[channels.identification]
max_real = 2
max_pairs = 1

[specification]
bandwidth_rad_s = 1.0
modulus_margin = 0.4
controller_order = 2
"""
QUICK = """
[synthesis]
starts = 1
agreeing_starts = 1
exchange_rounds = 1
dense_points = 800
grid_points = 60

[certificate]
joint_draws = 100

[closed_loop]
draws = 1

[achievable_performance]
compute = false
"""


def with_log(folder: Path, more: str = "", log_seed: int = 3) -> Path:
    """A configuration beside the log of a first-order machine with dead time."""
    folder.mkdir(exist_ok=True)
    rng = np.random.default_rng(log_seed)
    u = np.repeat(rng.choice([-1.0, 1.0], 160), 5)
    y = np.zeros(u.size)
    for k in range(DEAD_TIME_SAMPLES + 1, u.size):
        y[k] = 0.95 * y[k - 1] + 0.05 * u[k - 1 - DEAD_TIME_SAMPLES]
    y += 0.01 * rng.standard_normal(u.size)
    (folder / "log.csv").write_text(storage.csv_text({"u_V": u, "y_rad": y}))
    (folder / "arm.toml").write_text(CONFIGURATION + more)
    return folder / "arm.toml"


def dotted_keys(value: Any, where: str = "") -> Iterator[str]:
    """Keys of a nested document, but those below `effects`, whose own types fill them in."""
    if isinstance(value, Mapping):
        for name, item in value.items():
            if name != "effects":
                yield f"{where}.{name}"
                yield from dotted_keys(item, f"{where}.{name}")
    elif isinstance(value, list):
        for index, item in enumerate(value):
            yield from dotted_keys(item, f"{where}[{index}]")


EXAMPLES = ("default_arm", "daisy_robot_arm", "slfr_krauss_2009", "two_joint_arm")


@pytest.mark.parametrize(
    "path", [FAST_ARM, *(ROOT / "examples" / f"{name}.toml" for name in EXAMPLES)], ids=lambda path: path.stem
)
def test_a_stored_configuration_has_the_keys_of_its_file(path, monkeypatch, request):
    text = path.read_text()
    if "FLEXLINK_DATA" in text:
        monkeypatch.setenv("FLEXLINK_DATA", str(request.getfixturevalue("flexlink_data")))
    config, _ = load_any(path)
    document = config.to_document()
    written = set(dotted_keys(tomllib.loads(text)))
    planned = {key for key in written if key.startswith(".source.plan")}
    if planned:
        kept = {key for key in dotted_keys(document) if not key.startswith(".source.records")}
        assert kept == {key for key in written - planned if not key.startswith(".source.records")}
    else:
        assert set(dotted_keys(document)) == written
    again = type(config).from_document(document, source="config.json")
    assert again == config
    assert again.to_document() == document
    assert tomllib.loads(again.to_toml()).keys() == document.keys()


@pytest.mark.parametrize("key", LEFT_OPEN)
def test_a_default_that_is_stated_is_another_question_to_the_data(key, tmp_path):
    default = IdentOptions.model_fields[key].get_default()
    stated = f"{key} = {list(default) if default == () else default}\n"
    open_, _ = load_config(with_log(tmp_path / "open"))
    (tmp_path / "open" / "stated.toml").write_text(
        CONFIGURATION.replace("max_pairs = 1\n", f"max_pairs = 1\n{stated}")
    )
    closed, _ = load_config(tmp_path / "open" / "stated.toml")
    for config, there in ((open_, False), (closed, True)):
        again = RunConfig.from_document(config.to_document(), source="config.json")
        assert again.channels[0].identification.states(key) is there
    different = [stage.name for stage in STAGES if stage.settings(open_) != stage.settings(closed)]
    assert different == ["identify"]


def test_only_settings_that_the_data_decide_about_can_be_asked_whether_they_were_stated():
    assert not IdentOptions().states(*LEFT_OPEN)
    with pytest.raises(ValueError, match="max_pairs: not one of input_delay_samples"):
        IdentOptions(max_pairs=2).states("max_pairs")


def test_a_key_that_is_refused_where_it_is_stated_is_not_stated_by_the_stored_configuration(tmp_path):
    """A reference model of its own goes without the order of the usual one, which has a default."""
    more = "[reference_filter]\nmodel = { numerator = [4.0], denominator = [1.0, 4.0, 4.0] }\n"
    config, _ = load_config(with_log(tmp_path, more))
    assert RunConfig.from_document(config.to_document(), source="config.json") == config


def test_the_data_decide_about_the_dead_time_in_a_run_that_is_continued(tmp_path):
    config, text = load_config(with_log(tmp_path))
    identify_only(config, tmp_path / "run", config_text=text)
    kept = config_of(RunDirectory.open(tmp_path / "run"))
    study = StudyConfig.model_validate({"axes": [{"key": "closed_loop.draws", "values": [1]}]})
    bases = [
        load_base(study, tmp_path / "study.toml", base).config
        for base in (tmp_path / "run", tmp_path / "arm.toml")
    ]
    for other in (kept, *bases):
        assert other.to_document() == config.to_document()
    identify_only(kept, tmp_path / "again")
    assert stage_bytes(tmp_path / "again") == stage_bytes(tmp_path / "run")
    model = RunResults(RunDirectory(tmp_path / "again")).identify.channels[0].model
    assert model.input_delay_samples == DEAD_TIME_SAMPLES


@pytest.mark.slow
def test_a_run_cut_after_any_stage_ends_with_the_same_bytes(tmp_path, plain_page):
    whole = tmp_path / "run"
    run_from_files(with_log(tmp_path, QUICK), whole)
    delay = RunResults(RunDirectory(whole)).identify.channels[0].model.input_delay_samples
    assert delay == DEAD_TIME_SAMPLES
    for number, name in enumerate(NAMES[:-1]):
        cut = tmp_path / f"after {name}" / "run"
        shutil.copytree(whole, cut)
        for later in NAMES[number + 1 :]:
            RunDirectory(cut).stage_file(later).unlink()
        for file in ("model.json", "controller.json", "report.html"):
            (cut / file).unlink()
        run_from_files(None, cut, resume=True)
        for path in (path for path in whole.rglob("*") if path.is_file()):
            if path.name not in ("manifest.json", "lock"):
                assert (cut / path.relative_to(whole)).read_bytes() == path.read_bytes(), (name, path.name)


def test_a_run_directory_whose_defaults_count_as_stated_is_refused(tmp_path):
    config, text = load_config(with_log(tmp_path))
    run = RunDirectory(tmp_path / "run")
    with run.writing():
        run.begin_run(config_text=text, config=config.with_defaults(), seed=0, inputs={})
    manifest = run.manifest_path.read_text()
    now = run.manifest()["layout"]
    run.manifest_path.write_text(manifest.replace(f'"layout": {now}', f'"layout": {now - 1}'))
    with pytest.raises(InputError, match="written by another version of flexlink; start a new run"):
        run_from_files(None, tmp_path / "run", resume=True)


def test_one_entry_of_a_list_that_is_not_stated_can_be_set():
    defaults = {"source": {"rms_V": [0.2, 0.3], "samples": 8000}, "run": {"seed": 1}}
    changed = with_values({"source": {"kind": "x"}}, {"source.rms_V[1]": 0.5, "run.seed": 2}, defaults)
    assert changed == {"source": {"kind": "x", "rms_V": [0.2, 0.5]}, "run": {"seed": 2}}
    with pytest.raises(ValueError, match=r"source\.rms_V has 2 entries"):
        with_values({}, {"source.rms_V[2]": 0.5}, defaults)


def test_one_setting_of_the_joints_search_leaves_the_others():
    config, _ = load_any(ROOT / "examples" / "two_joint_arm.toml")
    assert isinstance(config, JointsConfig)
    document = with_values(config.to_document(), {"design.search.starts": 2})
    changed = check(JointsConfig, document, source="study", context={"may_be_gone": True})
    usual = config.design.search.model_dump() | {"starts": 2}
    assert changed.design.search.model_dump() == usual
