"""What the host of the repository runs: workflows that parse, and commands of theirs that are here."""

import os
import re
import tomllib
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def steps_of(path: Path) -> list[dict[str, Any]]:
    """Steps of all jobs of a workflow, in order."""
    yaml = pytest.importorskip("yaml")
    jobs = yaml.safe_load(path.read_text(encoding="utf-8"))["jobs"]
    return [step for job in jobs.values() for step in job["steps"]]


def targets_of_make() -> set[str]:
    """Names that `make` can be asked for."""
    text = (ROOT / "Makefile").read_text(encoding="utf-8")
    return set(re.findall(r"^([a-z-]+):", text, re.MULTILINE))


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_commands_of_a_workflow_are_here(path):
    commands = [step["run"] for step in steps_of(path) if "run" in step]
    for command in commands:
        for line in command.strip().splitlines():
            program, *arguments = line.split()
            if program == "make":
                wanted = {word for word in arguments if "=" not in word}
                assert wanted, line
                assert wanted <= targets_of_make(), line
            else:
                assert os.access(ROOT / program, os.X_OK), line


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_actions_are_pinned_to_a_major_version_and_no_registry_is_named(path):
    for step in steps_of(path):
        assert ("run" in step) != ("uses" in step)
        if "uses" in step:
            assert re.fullmatch(r"actions/[a-z-]+@v\d+", step["uses"])
    text = path.read_text(encoding="utf-8")
    # Neither an action nor a package comes from an address of its own.
    assert "://" not in text


def test_tests_run_on_every_python_that_is_promised():
    yaml = pytest.importorskip("yaml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    promised = [
        version
        for line in project["classifiers"]
        for version in re.findall(r"^Programming Language :: Python :: (3\.\d+)$", line)
    ]
    workflow = yaml.safe_load((ROOT / ".github" / "workflows" / "tests.yml").read_text(encoding="utf-8"))
    assert workflow["jobs"]["tests"]["strategy"]["matrix"]["python"] == promised
    # In YAML 1.1 the key `on` is the truth value.
    assert workflow[True] == ["push", "pull_request"]
    assert {"run": ".ci/run"}.items() <= steps_of(ROOT / ".github" / "workflows" / "tests.yml")[-1].items()


def test_the_site_that_is_published_is_the_one_that_is_built():
    settings = (ROOT / "mkdocs.yml").read_text(encoding="utf-8")
    built = re.search(r"^site_dir: (\S+)$", settings, re.MULTILINE)
    uploaded = [step["with"]["path"] for step in steps_of(WORKFLOWS[0]) if "upload" in step.get("uses", "")]
    assert WORKFLOWS[0].name == "site.yml"
    assert uploaded == [built[1]]


def test_the_citation_and_the_package_agree():
    yaml = pytest.importorskip("yaml")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert citation["version"] == project["version"]
    assert citation["license"] == project["license"]
    assert citation["title"] == project["name"]
    # The changelog has a section of this version, with its date.
    changelog = (ROOT / "CHANGELOG.md").read_text(encoding="utf-8")
    assert f"## {project['version']} ({citation['date-released']})" in changelog


def test_questions_to_somebody_who_reports_can_be_parsed():
    yaml = pytest.importorskip("yaml")
    for path in (ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml"):
        form = yaml.safe_load(path.read_text(encoding="utf-8"))
        assert {"name", "description", "body"} <= form.keys(), path.name
        assert all(part["attributes"]["label"] for part in form["body"]), path.name
