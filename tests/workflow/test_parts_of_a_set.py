"""A channel whose uncertainty set has several parts: every user of the set takes them all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from benchmarks.closed_loop_machines.judge import worst_of
from ident.friction import RateMember
from tests.workflow import report_examples as example
from workflow.config.design_file import DesignFile
from workflow.describe.uncertainty import uncertainty_numbers
from workflow.engine.run_directory import RunDirectory
from workflow.report.pages import write_report
from workflow.tasks.design_source import load_sources
from workflow.tasks.results import RunResults, UncertainChannel, UncertaintyResult
from workflow.tasks.uncertainty import uncertain_channel


def in_two_parts(run: RunDirectory) -> UncertainChannel:
    """The control channel of an example run, its set made one of two parts: as it is, and half the gain."""
    results = RunResults(run)
    found = results.uncertainty.channels[0]
    identified = results.identify.channels[0]
    poles = identified.model.poles
    half = replace(found.posterior, mean=0.5 * found.posterior.mean)
    parts = RateMember(found.posterior, poles, None, 0.3), RateMember(half, poles, 0.3, None)
    return uncertain_channel(
        found.method,
        found.level,
        found.posterior,
        identified,
        found.frequency.omega_rad_s,
        members=parts,
        tests=found.tests,
        poles=poles,
        linear=found.posterior,
        linear_poles=poles,
    )


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> RunDirectory:
    made = example.build_run(tmp_path_factory.mktemp("parts") / "run", example.config())
    others = RunResults(made).uncertainty.channels[1:]
    made.save_stage("uncertainty", UncertaintyResult((in_two_parts(made), *others)), "00")
    return made


def test_every_part_is_a_plant_to_design_for(run: RunDirectory) -> None:
    config = example.config()
    plants = RunResults(run).uncertainty.plants(config)
    label = config.control_channel.label
    names = [f"{label}, slow rate below 0.3 rad/s", f"{label}, slow rate above 0.3 rad/s"]
    assert [plant.name for plant in plants] == names
    omega = np.geomspace(1.0, 10.0, 5)
    np.testing.assert_allclose(plants[1].at(omega).centre, 0.5 * plants[0].at(omega).centre, rtol=1e-9)


def test_a_design_for_a_run_takes_every_part(run: RunDirectory) -> None:
    alone = [source.plant.name for source in load_sources([run.path], DesignFile())]
    assert [name.split(", ")[1] for name in alone] == [
        "slow rate below 0.3 rad/s",
        "slow rate above 0.3 rad/s",
    ]


@pytest.mark.slow
def test_ellipses_of_a_file_enclose_those_of_every_part(run: RunDirectory) -> None:
    channel = RunResults(run).uncertainty.channels[0]
    omega = channel.frequency.omega_rad_s
    for member in channel.members:
        part = member.posterior.at(omega, channel.level)
        for edge in (part.centre[:, None] + part.ellipse().boundary(40)).T:
            assert channel.enclosing.contains(edge).all()


def test_numbers_for_programs_tell_the_parts(run: RunDirectory) -> None:
    (other,) = uncertainty_numbers(RunResults(run).uncertainty.channels[0])["others"]
    assert other["about"] == "slow rate above 0.3 rad/s"
    assert set(other) == {"about", "bands"}


def test_a_machine_is_held_to_the_least_of_what_its_parts_state() -> None:
    one = {"modulus": 0.6, "gain_up": 3.0, "gain_down": 0.1, "phase_rad": 0.9, "delay_s": 0.02}
    other = {
        "modulus": 0.5,
        "gain_up": {"$float": "inf"},
        "gain_down": 0.2,
        "phase_rad": 1.0,
        "delay_s": 0.01,
    }
    verdicts = [
        {"worst_margins": margins, "bandwidth_rad_s": bandwidth}
        for margins, bandwidth in ((one, 20.0), (other, 30.0))
    ]
    least = {"modulus": 0.5, "gain_up": 3.0, "gain_down": 0.2, "phase_rad": 0.9, "delay_s": 0.01}
    assert worst_of(verdicts) == {"worst_margins": least, "bandwidth_rad_s": 20.0}


@pytest.mark.slow
def test_the_page_shows_every_part(run: RunDirectory) -> None:
    page = write_report(RunResults(run), example.config()).read_text(encoding="utf-8")
    assert "The set has 2 parts" in page
    assert "slow rate above 0.3 rad/s" in page
