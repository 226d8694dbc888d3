"""The page: its numbers are the stages', it fetches nothing, escapes everything, suits every outcome."""

import html
import re
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from control_design.analysis.stability import ModeChange
from control_design.controllers.c_code import Dialect
from control_design.convex.reference_filter import ReferenceFilter
from control_design.plants.plant_set import Mode
from ident.data.finding import FindingKind, finding
from tests.workflow import report_examples as example
from workflow.describe.closed_loop import not_the_arm
from workflow.describe.design import design_verdict
from workflow.describe.friction import friction_range
from workflow.describe.run import summarise
from workflow.engine.run_directory import RunDirectory
from workflow.figures.style import drawings
from workflow.report.pages import write_report
from workflow.tasks import pipeline
from workflow.tasks.exports import Logged
from workflow.tasks.results import ClosedLoopResult, ReferenceFilterResult, RunResults
from workflow.text.findings.sentences import words
from workflow.text.formats import at_least, at_most, bound
from workflow.text.sentences.certificate import not_checked
from workflow.text.sentences.design import lowered
from workflow.text.templates import environment

ATTACK = "<script>alert(1)</script>"


class Page(HTMLParser):
    """Tags with their attributes, and the text outside styles, script and pictures."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self._parts: list[str] = []
        self._inside: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        if tag in ("style", "script", "svg"):
            self._inside.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if self._inside and self._inside[-1] == tag:
            self._inside.pop()

    def handle_data(self, data: str) -> None:
        if not self._inside:
            self._parts.append(data)

    @property
    def text(self) -> str:
        return " ".join(" ".join(self._parts).split())


@pytest.fixture(scope="module")
def drawn(tmp_path_factory) -> RunDirectory:
    settings = example.config()
    run = example.build_run(tmp_path_factory.mktemp("report") / "run", settings)
    write_report(RunResults(run), settings)
    return run


def page_for(path: Path, settings, **how) -> Page:
    run = example.build_run(path / "run", settings, **how)
    return Page(write_report(RunResults(run), settings).read_text(encoding="utf-8"))


def text_of(run: RunDirectory, settings) -> str:
    return Page(write_report(RunResults(run), settings).read_text(encoding="utf-8")).text


def test_page_and_pictures_are_written(drawn):
    names = {path.name for path in drawn.figures_path.iterdir()}
    families = {re.sub(r"(-\d.*)?\.(svg|png)$", "", name) for name in names}
    # Other pages have the rest; distortion is drawn of periodic records.
    elsewhere = (
        "gap_", "pareto", "excitation", "distortion", "log", "response", "joint-", "matrix-", "mode-",
        "singular-values",
    )  # fmt: skip
    assert families == {name for name in drawings() if not name.startswith(elsewhere)}
    text = drawn.report_path.read_text(encoding="utf-8")
    page = Page(text)
    assert sum(tag == "figure" for tag, _ in page.tags) == len(names)
    assert len(text) < 500_000


def is_one_file(text: str) -> None:
    """The page fetches nothing, runs its own script only; ids are unique, every reference has its target."""
    tags = Page(text).tags
    assert text.count("<script") == 1
    script = environment().get_template("page.js").render()
    assert f"<script>\n{script}</script>" in text
    for tag, attributes in tags:
        assert tag not in ("link", "iframe", "object", "embed", "base"), tag
        for name, value in attributes.items():
            if name in ("src", "href", "xlink:href", "data", "action", "poster", "srcset"):
                assert value.startswith(("#", "data:image/")), (tag, name, value[:60])
            assert not name.startswith("on")
    assert "@import" not in text
    assert not re.search(r"url\((?!#)", text)
    ids = [value for _, attributes in tags if (value := attributes.get("id"))]
    assert len(ids) == len(set(ids))
    references = set(re.findall(r'href="#([^"]+)"', text)) | set(re.findall(r"url\(#([^)]+)\)", text))
    assert references <= set(ids)


def test_page_is_one_file_that_fetches_nothing(drawn):
    is_one_file(drawn.report_path.read_text(encoding="utf-8"))


@pytest.mark.slow
def test_same_bytes_twice(drawn):
    """Pictures of an earlier report go."""
    first = drawn.report_path.read_bytes()
    pictures = {path.name: path.read_bytes() for path in drawn.figures_path.iterdir()}
    (drawn.figures_path / "old-3-gone.svg").write_text("<svg/>")
    write_report(RunResults(drawn), example.config())
    assert drawn.report_path.read_bytes() == first
    assert {path.name: path.read_bytes() for path in drawn.figures_path.iterdir()} == pictures


def test_numbers_on_the_page_are_the_stages_numbers(drawn):
    text = Page(drawn.report_path.read_text(encoding="utf-8")).text
    results = RunResults(drawn)
    for channel in results.identify.channels:
        for mode in channel.modes:
            assert f"{mode.frequency_Hz:.4g} {mode.omega_rad_s:.4g} {mode.damping:.3g}" in text
        for name, fit in channel.fit_percent["validation"].items():
            assert f"{fit:.3g} % ({name})" in text
    for spread in results.uncertainty.channels:
        for band in spread.bands:
            assert f"{band.median_radius_percent:.3g}" in text
        for test in spread.tests:
            assert words(test.finding) in text
    certificate = results.certify.certificate
    worst = certificate.plants[0].worst_margins
    assert at_least(worst.modulus) in text
    assert at_least(np.degrees(worst.phase_rad)) in text
    assert at_least(1e3 * worst.delay_s) in text
    for item in certificate.items:
        assert bound(item.achieved, item.at_least) in text
    # Responses were sampled in a stage of their own, and the page says that instead.
    opened = not_checked(certificate, sampled=True, friction=True)
    assert "all frequencies together: checked on models drawn from the posterior, not certified" in opened
    for line in opened:
        assert line[1:] in text
    loop = results.closed_loop.check
    assert f"{loop.predicted.rise_time_s:.4g}" in text
    assert f"{max(run.overshoot_percent for run in loop.achieved):.3g}" in text
    manifest = drawn.manifest()
    assert "ab" * 32 in text
    assert manifest["versions"]["numpy"] in text


def test_a_certified_run_says_so_and_why(drawn):
    page = Page(drawn.report_path.read_text(encoding="utf-8"))
    assert "Certified, but the loop takes damping from a mode" in page.text
    assert "The mode at 2.23 Hz loses damping: 0.05 in open loop, 0.037 in closed loop" in page.text
    assert "All 3 runs on the simulated arm settle" in page.text
    assert "The certificate covers linear dynamics at the recorded amplitudes: the 95 % ellipses" in page.text
    assert any((attributes.get("class") or "").split() == ["verdict", "plain"] for _, attributes in page.tags)


def test_an_uncertified_run_says_what_is_missed(unbuilt, tmp_path):
    page = page_for(tmp_path, example.config(), gain=4.0)
    assert "Not certified: 2 of 4 requirements missed" in page.text
    assert re.search(
        r"modulus margin, worst case: 0\.\d+ against 0\.5 at [\d.]+ rad/s \([\d.]+ Hz\): NOT met", page.text
    )
    assert "is the active constraint" in page.text
    assert "gain may rise by" in page.text
    assert not any("certified" in (attributes.get("class") or "").split() for _, attributes in page.tags)


def test_an_unstable_loop_has_no_margins_and_a_line_of_its_own_for_what_is_not_proved(unbuilt, tmp_path):
    run = example.build_run(tmp_path / "run", example.config(), gain=400.0)
    text = text_of(run, example.config())
    assert "gain may rise by" not in text
    assert re.search(r"the nominal loop is unstable \(largest pole radius [1-9][\d.]*\)", text)
    opened = not_checked(RunResults(run).certify.certificate, sampled=False)
    assert opened[0].endswith("not proved: the loop is not robustly stable on the dense grid")


def test_a_certificate_does_not_hide_a_loop_that_does_not_settle(unbuilt, tmp_path):
    page = page_for(tmp_path, example.config(), settled=1)
    assert "Certified, but the simulated loop does not settle" in page.text
    assert "2 of 3 runs on the simulated arm did not settle" in page.text
    assert not any("certified" in (attributes.get("class") or "").split() for _, attributes in page.tags)


def test_without_a_controller_the_page_still_tells_the_rest(unbuilt, tmp_path):
    page = page_for(tmp_path, example.config(), impossible=True)
    assert "Not certified: there is no controller" in page.text
    assert "lies beyond the Nyquist frequency" in page.text
    assert "There is no controller to certify." in page.text
    assert "was to be optimised" in page.text
    run = RunDirectory.open(tmp_path / "run")
    assert not list(run.figures_path.glob("nyquist*"))
    assert list(run.figures_path.glob("bode*"))


def test_without_validation_data_the_page_warns(unbuilt, tmp_path):
    page = page_for(tmp_path, example.config(validation=False), scatter=False)
    assert "There is no validation record: the model was not tested on new data." in page.text
    assert "; on validation data:" not in page.text
    assert "this one was used in the fit" in page.text
    assert not list((tmp_path / "run" / "figures").glob("repeats*"))


@pytest.mark.parametrize(
    ("chosen", "words"),
    [
        pytest.param({}, "Structures tried", marks=pytest.mark.long),
        pytest.param({"n_real": 1}, "n_real = 1 was specified", marks=pytest.mark.long),
        ({"n_real": 1, "n_pairs": 2}, "n_real = 1 and n_pairs = 2 were specified"),
    ],
)
def test_the_page_says_who_chose_the_order(unbuilt, tmp_path, chosen, words):
    settings = example.config(channels=1)
    options = settings.channels[0].identification.model_copy(update=chosen)
    channel = settings.channels[0].model_copy(update={"identification": options})
    assert words in page_for(tmp_path, settings.model_copy(update={"channels": (channel,)})).text


def change_loop(run, **changes):
    """The closed-loop stage with some of its results exchanged."""
    loop = RunResults(run).closed_loop.check
    run.save_stage("closed_loop", ClosedLoopResult(check=replace(loop, **changes)), "x")


def test_a_command_beyond_the_records_and_an_error_that_stays_are_told(unbuilt, tmp_path):
    settings = example.config()
    run = example.build_run(tmp_path / "run", settings)
    records = RunResults(run).records.of_role("estimation")
    seen = max(float(np.max(np.abs(item.record.input))) for item in records)
    words = "times the largest input in the records of the fit"
    predicted = RunResults(run).closed_loop.check.predicted
    for factor, left, told in ((1.4, 0.01, False), (7.0, -0.2, True)):
        change_loop(run, predicted=replace(predicted, peak_command=factor * seen, disturbance_left=left))
        text = text_of(run, settings)
        assert (f"{factor:.2g} {words}" in text) == told
        assert ("leaves 40 % of the reference step as error" in text) == told
        assert ("integrator = true" in text) == told


@pytest.mark.slow
def test_a_design_that_takes_damping_from_a_mode_says_so(unbuilt, tmp_path):
    settings = example.config()
    run = example.build_run(tmp_path / "run", settings)
    results = RunResults(run)
    own_rad_s = results.identify.modes_rad_s[0]
    other_rad_s = 2 * np.pi * 33.0  # of the nominal plant, where it describes what no mode explains
    for omega_rad_s, before, after, told in (
        (own_rad_s, 0.02, 0.011, True),
        (own_rad_s, 0.02, 0.0199, False),
        (own_rad_s, 0.02, 0.4, False),
        (other_rad_s, 0.02, 0.011, False),
    ):
        certificate = results.certify.certificate
        change = ModeChange(Mode(omega_rad_s, before), Mode(1.03 * omega_rad_s, after))
        plant = replace(
            certificate.plants[0], mode_changes=(ModeChange(Mode(9.0, 0.1), Mode(9.0, 0.3)), change)
        )
        changed = replace(results.certify, certificate=replace(certificate, plants=(plant,)))
        run.save_stage("certify", changed, "x")
        at_Hz = omega_rad_s / (2 * np.pi)
        lost = f"mode at {at_Hz:.3g} Hz loses damping: 0.02 in open loop, 0.011 in closed loop"
        text, summary = text_of(run, settings), summarise(RunResults(run), settings)
        assert (f"The {lost}" in text) == ("the loop takes damping from a mode" in text) == told
        assert ("Certified: all 4 requirements are met" in text) == (not told)
        assert (lost in summary.verdict) == told
        changes = summary.numbers["certificate"]["plants"][0]["mode_changes"]
        assert changes[1]["closed_loop"]["zeta"] == after
        design = design_verdict(results.design, changed.certificate, "")
        # A design from a plant alone has no identified modes to compare with.
        assert (lost in design) == (after == 0.011)
    doubt, spread = finding(FindingKind.UNTRIED_FRICTION, output="enc"), results.uncertainty
    doubted = tuple(replace(channel, advice=(doubt,)) for channel in spread.channels)
    run.save_stage("uncertainty", replace(spread, channels=doubted), "x")
    text, summary = text_of(run, settings), summarise(RunResults(run), settings)
    assert "Certified, but the ellipses are in doubt" in text
    assert "Certified: all 4 requirements are met" not in text
    told = summary.numbers["certificate_conditions"]
    assert [words[:31] for words in told] == ["dry friction was not identified"]
    assert "But dry friction was not identified" in summary.verdict


def test_a_mode_of_several_plants_is_named_once_where_it_loses_most(tmp_path):
    run = example.build_run(tmp_path / "run", example.config())
    results = RunResults(run)
    certificate = results.certify.certificate
    before, after = Mode(2 * np.pi * 12.6, 0.02), 2 * np.pi * 13.0
    changes = [ModeChange(before, Mode(after, zeta)) for zeta in (0.015, 0.004, 0.01)]
    plants = [
        replace(certificate.plants[0], plant=f"load {k}", mode_changes=(change, change))
        for k, change in enumerate(changes)
    ]
    said_of = design_verdict(results.design, replace(certificate, plants=tuple(plants)), "")
    assert said_of.count("the mode at 12.6 Hz loses damping") == 1
    assert "load 1: the mode at 12.6 Hz loses damping: 0.02 in open loop, 0.004 in closed loop" in said_of


def test_a_real_arm_of_one_channel_is_not_said_to_have_run(unbuilt, tmp_path):
    page = page_for(tmp_path, example.config(machine="identified", channels=1))
    assert "Channel hub" not in page.text
    assert not list((tmp_path / "run" / "figures").glob("*-2-*"))
    assert "Nothing was run on the real machine here." in page.text
    assert "The controller has not run on the real machine." in page.text
    assert "on the simulated arm settle" not in page.text
    assert "Sensitivity measured on the arm" not in page.text
    assert "The loop under other conditions" not in page.text


def test_hostile_names_are_escaped(tmp_path):
    quote = '"><img src=x onerror=alert(1)>'
    settings = example.config(
        title=ATTACK,
        outputs=(f"{ATTACK}_rad", quote),
        labels=("hub --> $x$ ${y}", "tip & <b>tip</b>".replace("/", "|")),
        records=("prbs <i>1", "&lt;b&gt;", "--> fresh"),
        input_name=f"{{{{ 7 * 7 }}}} {quote}",
        notes=(ATTACK, "{% raw %}"),
        channels=1,
    )
    run = example.build_run(tmp_path / "run", settings)
    text = write_report(RunResults(run), settings).read_text(encoding="utf-8")
    assert ATTACK not in text
    assert "<img src=x" not in text
    is_one_file(text)
    page = Page(text)
    assert not any(tag in ("b", "i", "img") for tag, _ in page.tags)
    assert ATTACK in page.text  # shown as it was written
    assert "{{ 7 * 7 }}" in page.text  # no template runs inside user text
    assert "{% raw %}" in page.text
    for path in run.figures_path.iterdir():
        assert re.fullmatch(r"[a-z0-9-]+\.(svg|png)", path.name)


@pytest.mark.slow
def test_sensitivity_on_the_arm_is_compared_and_friction_named(tmp_path, unbuilt):
    """A smaller peak at small excitation is put down to friction, and predicted where that was identified; a
    large gap is a warning."""
    page = page_for(tmp_path, example.config())
    assert "Peak of |S|: predicted" in page.text
    assert re.search(r"from nominal \[%\].*[+-]0\.4\d? ", page.text)
    assert "for references from 0.002 rad to 0.2 rad (rms)" in page.text
    assert "Below 0.01 rad friction changes the peak by more than 5 %" in page.text
    assert "2 of 3 peaks measured on the arm lie in their predicted intervals" in page.text
    assert "Reference steps below 0.0013 rad (0.00120 to 0.00140) do not move the arm" in page.text
    assert "payload 200 %" in page.text
    assert "something <else>" in page.text
    run = RunDirectory.open(tmp_path / "run")
    change_loop(run, friction=None)
    text = text_of(run, example.config())
    assert "the peak is 12 % lower than predicted: dry friction takes" in text
    loop = RunResults(run).closed_loop.check
    offs = zip(loop.sensitivity.measured, (9.0, 0.1), strict=True)
    rows = tuple(replace(row, off_nominal_percent=off) for row, off in offs)
    sensitivity = replace(loop.sensitivity, measured=rows)
    conditions = tuple(replace(row, settled=False) for row in loop.conditions)
    change_loop(run, sensitivity=sensitivity, conditions=conditions)
    text = text_of(run, example.config())
    assert "The loop on the arm is not the predicted one" in text
    assert "dry friction takes" not in text
    assert "The loop does not settle with: payload 200 % and push at the tip." in text


def test_page_tells_of_any_order_whole_responses_and_reference_filter(tmp_path, unbuilt):
    settings = example.config()
    run = example.build_run(tmp_path / "run", settings)
    text = text_of(run, settings)
    gamma = RunResults(run).design.gamma
    # Made up: the bound for any order, and a worst case of the ellipses that holds for 990 of 1000 draws.
    assert f"Order 1 reaches γ = {at_most(gamma, 4)} (needed: 1 or less); a higher order" in text
    assert "(lower bound for any order: 0.788)" in text
    assert "a controller with γ = 0.79 was found" in text
    assert re.search(r"share of 1000 samples worst case of the 95 % ellipses [\d.]+ 99 % ", text)
    assert "99 % (98.17 % to 99.46 %)" in text
    assert "All frequencies together: checked on models drawn from the posterior" in text
    assert "Reference filter" not in text
    filtered = ReferenceFilter(
        A=np.array([[0.9]]), B=np.array([[0.1]]), C=np.array([[1.0]]), D=np.array([[0.0]]), dt_s=example.DT_S,
        error_before=0.95, error_after=0.19, worst_rad_s=3.0,
    )  # fmt: skip
    with run.locked():
        run.save_stage("reference_filter", ReferenceFilterResult(filtered), "x")
    text = text_of(run, settings)
    assert "0.19 with it, 0.95 without, 5 times smaller" in text


def test_friction_range_says_which_bound_holds_and_which_way_friction_moves_the_peak():
    check = SimpleNamespace(
        tolerance_percent=5.0, certified_peak=1.676, nominal_peak=1.51, certified_from=0.001,
        linear_from=None, sizes=np.array([0.1, 0.01]), low=np.array([1.2, 1.0]), high=np.array([1.3, 1.1]),
    )  # fmt: skip
    told = friction_range(check, "rad")
    assert "predicted to be at most 5 % above the certified 1.676 for references from 0.001 rad" in told
    assert "1.51, is lowered by friction by more than 5 %, even at the largest size" in told
    check.nominal_peak = 1.1
    assert "1.1, is raised by friction" in friction_range(check, "rad")


def test_a_lowered_bandwidth_says_which_of_the_three_is_which():
    asked = SimpleNamespace(bandwidth_rad_s=19.0, lowest_bandwidth_rad_s=3.0)
    found = SimpleNamespace(bandwidth_rad_s=8.82)
    told = lowered(asked, found, [], 12.2)
    assert told.startswith("bandwidth_rad_s = 19 was not met; ")
    assert told.endswith("designed for 8.82 rad/s; reaches at least 12.2 rad/s")
    assert lowered(asked, asked, [], 12.2) == ""


@pytest.mark.parametrize(
    ("delay", "scales"),
    [
        pytest.param(0, (1.0, 1.0), marks=pytest.mark.long),
        pytest.param(1, (57.3, -2.0), marks=pytest.mark.slow),
    ],
)
def test_two_lines_typed_give_the_margins_of_the_certificate(
    delay, scales, tmp_path, undrawn, monkeypatch, capsys
):
    """With the files of the run, also where they are in other columns than the model."""
    own = replace(example.controller(), computational_delay_samples=delay)
    monkeypatch.setattr(example, "controller", lambda gain=1.5: own)
    logged = Logged((scales[0],), (scales[1],), "columns as logged")
    monkeypatch.setattr(Logged, "of", classmethod(lambda cls, config, records: logged))
    settings = example.config()
    specification = settings.specification.model_copy(update={"computational_delay_samples": delay})
    settings = settings.model_copy(update={"specification": specification})
    run = example.build_run(tmp_path / "run", settings)
    pipeline._keep_files(RunResults(run), settings, Dialect())
    text = write_report(RunResults(run), settings).read_text(encoding="utf-8")

    typed, printed = re.search(r'<pre class="typed">(.*?)</pre>\s*<pre>(.*?)</pre>', text, re.S).groups()
    assert len(html.unescape(typed).splitlines()) == 2
    monkeypatch.chdir(run.path)
    exec(html.unescape(typed), {})

    def read(table):
        rows = (line.split() for line in table.strip().splitlines())
        return {name: [float(value) for value in values] for name, *values in rows}

    found = read(capsys.readouterr().out)
    for name, values in read(printed).items():
        assert found[name] == pytest.approx(values, rel=2e-4), name
    nominal = RunResults(run).certify.certificate.plants[0].nominal_margins
    known = [nominal.gain_up, np.degrees(nominal.phase_rad), nominal.modulus]
    assert found["K_with_delay"] == pytest.approx(known, rel=5e-3)
    if delay == 0:
        assert found["K_without_delay"] == found["K_with_delay"]
    else:
        assert min(np.subtract(found["K_without_delay"], known)) > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    ("delay", "words"), [(0, "Controller (K, without computational delay)"), (1, "Controller (K_with_delay)")]
)
def test_captions_say_where_the_delay_is(delay, words, tmp_path, undrawn, monkeypatch):
    own = replace(example.controller(), computational_delay_samples=delay)
    monkeypatch.setattr(example, "controller", lambda gain=1.5: own)
    settings = example.config()
    specification = settings.specification.model_copy(update={"computational_delay_samples": delay})
    text = page_for(tmp_path, settings.model_copy(update={"specification": specification})).text
    assert words in text
    assert ("K_with_delay = K_without_delay * control.tf([1], [1, 0], 0.01)" in text) == (delay == 1)
    assert ("K = control.zpk(" in text) == (delay == 0)


@pytest.mark.parametrize("place", [*(pytest.param(k, marks=pytest.mark.long) for k in (0, 1)), 2])
def test_the_first_screen_says_why_a_measurement_lies_above_the_specification(place, tmp_path, undrawn):
    """|S| is measured beside a certificate for linear plants: payload and friction are not in it."""
    settings = example.config()
    effects = ({"name": "tip_payload", "mass_kg": 0.02},)
    loop = settings.closed_loop.model_copy(update={"effects": effects})
    settings = settings.model_copy(update={"closed_loop": loop})
    run = example.build_run(tmp_path / "run", settings)
    check = RunResults(run).closed_loop.check
    rows = [
        *check.sensitivity.measured,
        replace(check.sensitivity.measured[0], name="arm of the closed-loop check"),
    ]
    higher = rows[place].magnitude.copy()
    line = int(np.argmin(np.abs(rows[place].omega_rad_s - 20.0)))
    higher[line] = 2.2  # the modulus margin of 0.5 allows 2
    rows[place] = replace(rows[place], magnitude=higher)
    changed = replace(check, sensitivity=replace(check.sensitivity, measured=tuple(rows)))
    run.save_stage("closed_loop", ClosedLoopResult(check=changed), "00")

    text = text_of(run, settings)
    screen = text[: text.index("Margins and certificate")]
    why = [
        "as identified: it has friction, or the model is not right",
        "as identified at small references, where dry friction weighs more",
        "with tip_payload (mass_kg = 0.02): the records were made without",
    ][place]
    at = rows[place].omega_rad_s[line]
    assert f"The certificate does not cover the arm {why}. Measured |S| is 2.2 at {at:.3g} rad/s" in screen
    assert screen.count("The certificate does not cover") == 1


def test_what_is_measured_counts_beyond_its_noise():
    omega = np.array([1.0, 2.0, 4.0, 8.0])
    peak = example.beyond_the_trial(np.zeros(400), np.zeros(400))[0].measured[0]
    row = replace(peak, omega_rad_s=omega, magnitude=np.array([0.5, 0.75, 1.3, 1.5]), std=np.full(4, 0.01))
    assert row.beyond(np.array([1.0, 1.0, 1.0, 1.3])) == 2  # by the largest factor
    assert row.beyond(np.array([0.48, 1.0, 1.5, 1.6])) is None  # two standard deviations
    assert row.beyond_bandwidth(1.9) is None
    assert row.beyond_bandwidth(2.1) == 1
    rows = SimpleNamespace(sensitivity=SimpleNamespace(measured=(row, row, replace(row, name="other"))))
    effects = [{"name": "tip_payload"}]
    assert not_the_arm(None, 5.0, effects) == not_the_arm(rows, 1.9, effects) == ""
    assert not_the_arm(rows, 2.1, effects).endswith("and with tip_payload")
