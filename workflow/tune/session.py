"""What `flexlink tune` computes: settings of the page into designs, their curves and files."""

from __future__ import annotations

import math
import re
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import lru_cache, reduce
from operator import itemgetter
from pathlib import Path
from typing import Any, Literal, get_args

import control
import numpy as np
import tomlkit

from control_design.analysis.certificate import certify, loop_margins
from control_design.analysis.closed_loop import ClosedLoopTrajectory, step_metrics
from control_design.analysis.joint_coverage import at_level
from control_design.analysis.margins import Margins
from control_design.analysis.stability import closed_loop_poles
from control_design.analysis.worst_case import PlantData, WorstCase, worst_of
from control_design.controllers.controller import Controller
from control_design.controllers.engineers_numbers import engineers_numbers
from control_design.plants.ellipses import Real
from control_design.plants.frequency_grid import checked_grid
from control_design.plants.plant_set import Mode, UncertainPlant, modes_of
from control_design.specification import GIVES_WAY, Specification, SpecificationError
from control_design.specification.structure import order_of_structure
from control_design.synthesis.synthesis import synthesise_near
from ident.uncertainty import ResponsePosterior
from workflow.commands.design import at_one_bandwidth, design_controller, load_asked, of_run
from workflow.config.design_file import DesignFile, PlantSection, read_design_file
from workflow.config.run_config import RunConfig
from workflow.config.settings import check
from workflow.engine import storage
from workflow.engine.errors import InputError
from workflow.engine.randomness import stage_rng
from workflow.figures.bands import smooth_grid
from workflow.figures.sensitivity import sensitivity_curves
from workflow.figures.subjects import unit_of
from workflow.tasks.design import bracket_numbers, find_bracket, find_design
from workflow.tasks.design_source import level_can_change
from workflow.tasks.exports import gain_unit_of
from workflow.tasks.loop_sensitivity import settling_samples
from workflow.tasks.results import DesignResult
from workflow.tasks.sampled_plant import FINITE, realise, simulate_plant
from workflow.tasks.simulated_rig import converter_steps
from workflow.text.formats import bound, si, unit
from workflow.text.sentences.certificate import LIMITS_NOT_LOOKED_AT, certificate_reason, limited_loops
from workflow.tune.rows import tune_rows
from workflow.tune.views import FrictionStep, bode, line, roots, short

# A setting beside those of the specification: level of the ellipses.
CONFIDENCE = "confidence"
# Names of directories that a user may save into.
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,60}")
# Factors of the last controller's gain that are tried for settings that have no design yet: two octaves
# either way, an eighth of an octave apart.
_GAINS = np.geomspace(0.25, 4.0, 33)
# Posterior samples whose steps are shown.
_SAMPLES = 15
# Fewest and most samples of a step and its disturbance: a run's, as far as an answer comes soon.
_STEP_SAMPLES = 200, 1 << 14
# Share of the Nyquist frequency where pictures over frequency begin, or lower.
_SHOWN = 1e-4
# Distance from 0 up to which the Nyquist curve is shown.
_NEAR = 3.0
# A worst case larger than this is none: an ellipse that reaches -1 gives an infinite one.
_UNBOUNDED = 1e200
# Modes of a smaller damping ratio get frequencies of their own: others are as wide as the usual grid's steps.
_LIGHTLY_DAMPED = 0.3
# Least damping ratio that frequencies around a mode are chosen by: a smaller peak is narrower than they tell.
_LEAST_DAMPING = 1e-3
# Frequencies of the pictures over frequency, and more of them at each mode: a curve as smooth as the screen.
_FREQUENCIES = 150
# Frequencies at each mode of these pictures.
_AT_MODE = 12
# Frequencies of the Nyquist curve, which bends at each of them.
_NYQUIST_FREQUENCIES = 400
# Frequencies at each mode of the Nyquist curve: a mode is a circle there.
_NYQUIST_AT_MODE = 30
# Pictures over frequency begin at the bandwidth divided by this, or lower: tracking is seen in it.
_BELOW_BANDWIDTH = 30
# Ellipses that are drawn along it.
_ELLIPSES = 60
# Corners of each of them.
_CORNERS = 24


# The page's control of a setting, by the type in the JSON schema of the specification.
_KINDS = {"boolean": "switch", "enum": "choice", "integer": "count", "number": "number"}
# Ends of its range, by the names of the schema.
_ENDS = {"minimum": "ge", "exclusiveMinimum": "gt", "maximum": "le", "exclusiveMaximum": "lt"}

Handler = Callable[[Mapping[str, Any]], dict[str, Any]]


_Structure = Literal["p", "pi", "pd", "pid"]
# Structures of a controller with a fixed order.
_STRUCTURES: tuple[_Structure, ...] = get_args(_Structure)
# Settings that follow from one of these structures.
_SET_BY_STRUCTURE = ("controller_order", "integrator")


class SupersededError(Exception):
    """A newer design was asked for."""


class TuningSession:
    """Plants as read, and the last design. Settings are keys of the specification by name, and `confidence`.

    A design is that of `flexlink design` with the same settings and seed. One runs at a time: a newer one
    ends it. Everything returned is JSON-able.
    """

    def __init__(self, paths: Sequence[Path], file: DesignFile, out: Path, seed: int) -> None:
        self.paths = tuple(paths)
        self.out = out
        self.seed = seed
        sources, self.file, specification = load_asked(paths, file)
        run = of_run(self.paths)
        self.specification = at_one_bandwidth(specification, run)
        self._plants = [source.plant for source in sources]
        self._units = sources[0].units
        self.drawable = all(level_can_change(plant) for plant in self._plants)
        self._last = None if run is None else run.design.controller
        self._performance_unit = ""
        config = sources[0].config
        if run is not None and isinstance(config, RunConfig) and config.performance_index is not None:
            performance_output = config.channels[config.performance_index].output
            self._performance_unit = run.records.unit(performance_output)
        # Overshoot, settling time and command are those of the run's reference step, through its filter.
        self.step_size = 1.0
        self.filter = None
        self._friction: FrictionStep | None = None
        if run is not None and run.run.stage_file("closed_loop") and run.closed_loop.check is not None:
            self.step_size = run.closed_loop.check.reference_step
            self.filter = run.reference_filter.filter
            friction = run.identify.friction
            if friction is not None and isinstance(config, RunConfig):
                steps = converter_steps(config.closed_loop)
                self._friction = FrictionStep(friction, self.step_size, steps)
        self.output_unit = self._units[1]
        self.step_words = si(self.step_size, self.output_unit or "in the unit of the output", 4)
        # Number of the newest design that was asked for: an older one ends when it sees another.
        self._newest = 0
        self._designing = threading.Lock()

    # -- settings --------------------------------------------------------------------------------------------

    def settings(self) -> list[dict[str, Any]]:
        """What the page has a control for: name, kind, description, unit, value, range."""
        fields = {**Specification.model_json_schema()["properties"]}
        for limit in GIVES_WAY.values():
            del fields[limit]
        settings = []
        for name, field in fields.items():
            setting = _control(name, field, getattr(self.specification, name))
            if setting is None:
                continue
            if name in _SET_BY_STRUCTURE:
                setting["set_by_structure"] = {
                    structure: _words_of_structure(self.specification, structure, name)
                    for structure in _STRUCTURES
                }
            settings.append(setting)
        if self.drawable:
            words = "confidence of each ellipse: share of the probability inside"
            about = {"name": CONFIDENCE, "kind": "number", "words": words, "value": self._plants[0].level}
            # Below one half an ellipse holds less than it leaves out; near 1 it grows without end.
            settings.append(about | {"ge": 0.5, "lt": 0.9999})
        return [setting | {"unit": unit_of(setting["name"], *self._units)} for setting in settings]

    def _read(self, values: Mapping[str, Any]) -> tuple[Specification, list[UncertainPlant], float | None]:
        """Specification, plants and level of the ellipses of these settings. Raises InputError."""
        stated = dict(values)
        level = stated.pop(CONFIDENCE, None) if self.drawable else None
        if level is not None:
            level = check(PlantSection, {"level": level}, source=CONFIDENCE).level
        document = self.specification.model_dump(mode="json", exclude_unset=True) | stated
        if document.get("structure", "biquads") != "biquads":
            # The page has a slider and a switch for what follows from such a structure.
            for key in _SET_BY_STRUCTURE:
                document.pop(key, None)
        specification = check(Specification, document, source="settings")
        plants = self._plants if level is None else [at_level(plant, level) for plant in self._plants]
        return specification, plants, level

    def completed(self, values: Mapping[str, Any]) -> DesignFile:
        """The design file of these settings. Raises InputError: one line naming the key."""
        specification, _, level = self._read(values)
        plant = self.file.plant
        if level is not None:
            # What the page sets replaces what the file says; all else stands as it was written.
            sections = plant.model_dump(exclude_unset=True) | {"level": level}
            plant = PlantSection.model_validate(sections, context={"base": Path()})
        return self.file.model_copy(update={"specification": specification, "plant": plant})

    # -- designs ---------------------------------------------------------------------------------------------

    def scaled(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The last controller, times the gain that suits these settings best; nothing is certified."""
        specification, plants, _ = self._read(values)
        last = self._last
        if last is None:
            raise InputError("no design yet: wait for the first")

        # Worst case of every gain, on a grid that is coarse enough to answer while a slider moves.
        plant_data = [PlantData.build(plant, specification, _grid(plant, last, 120, 20)) for plant in plants]
        responses = [last.response(data.ellipses.omega_rad_s, with_delay=False) for data in plant_data]
        ranked = []
        for gain in _GAINS.tolist():
            worst_cases = []
            for data, response in zip(plant_data, responses, strict=True):
                law_response = gain * response
                worst_cases.append(
                    WorstCase(
                        data.ellipses.omega_rad_s,
                        data.ellipses,
                        law_response * data.delay,
                        data.weighted(law_response),
                    )
                )
            largest = [np.max(worst_of(worst_case.values)) for worst_case in worst_cases]
            gamma = max(map(float, largest))
            ranked.append((gamma, abs(math.log(gain)), gain, worst_cases))

        # The best one whose loop is stable; of two equal ones the one that changes less.
        for gamma, _, gain, worst_cases in sorted(ranked, key=itemgetter(0, 1)):
            law = replace(last, C=gain * last.C, D=gain * last.D, anti_windup_gain=None)
            is_stable = [np.all(np.abs(closed_loop_poles(law, plant)) < 1) for plant in plants]
            if all(is_stable):
                margins = [
                    loop_margins(law, plant, worst_case)[1:3]
                    for plant, worst_case in zip(plants, worst_cases, strict=True)
                ]
                numbers = {"gain": gain, "gamma": gamma, "certified": None}
                at_limits = LIMITS_NOT_LOOKED_AT
                seen = self._seen(law, plants, specification, gamma, margins, at_limits, settles=False)
                return {**_finite(numbers), **seen}
        raise InputError("no gain keeps the last controller stable with these settings")

    def near(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """A design that is sought from the last controller alone, with its certificate.

        It comes sooner than `design`, and is seldom worse. Empty where that leads nowhere.
        """
        if self._last is None or self.file.certificate.calibrate:
            return {}
        design = self.design(values, self._last)
        return design if design["plants"] else {}

    def design(self, values: Mapping[str, Any], like: Controller | None = None) -> dict[str, Any]:
        """A new design with its certificate.

        Parameters
        ----------
        values : mapping of str to value
            Settings of the page.
        like : Controller, optional
            The search begins there and nowhere else; None: the whole search of `flexlink design`.

        Returns
        -------
        dict
            Numbers, curves of each plant, and in one line how it stands; without plants where there is no
            controller.

        Raises
        ------
        SupersededError
            A newer design is asked for meanwhile.
        """
        asked = self.completed(values)
        specification, plants, _ = self._read(values)
        self._newest += 1
        number = self._newest

        def still(*_: object) -> None:
            if number != self._newest:
                raise SupersededError

        with self._designing:
            still()
            options = asked.synthesis
            rng = stage_rng(self.seed, "design")
            if like is None:
                design = find_design(
                    plants, specification, options, asked.certificate, rng, still, advise=False
                )
            else:
                try:
                    near = synthesise_near(like, plants, specification, options, rng=rng, progress=still)
                except SpecificationError as impossible:
                    return {"certified": False, "gamma": None, "reason": str(impossible), "plants": []}
                design = DesignResult(near, near.gamma <= 1.0, "")
            still()
            law = design.controller
            used = design.specification or specification
            numbers: dict[str, Any] = {"certified": False, "gamma": None, "reason": design.reason}
            if design.synthesis is not None:
                active = next(iter(design.synthesis.blocking), None)
                words = ""
                if active is not None:
                    words = f"{active.weight} of {active.plant} at {active.omega_rad_s:.4g} rad/s"
                numbers |= {"gamma": design.synthesis.gamma, "active": words}
            if law is None:
                return {**_finite(numbers), "plants": []}
            certificate = certify(law, plants, used, between_own_points=asked.plant.between_points)
            still()
            self._last = law
        margins = [(verdict.worst_margins, verdict.bandwidth_rad_s) for verdict in certificate.plants]
        at_limits = limited_loops(certificate)
        seen = self._seen(law, plants, used, certificate.gamma, margins, at_limits)
        items = []
        for item in certificate.items:
            # With one plant there is nothing to tell apart.
            of_plant = f" ({item.plant})" if len(plants) > 1 else ""
            direction = "≥ " if item.at_least else "≤ "
            achieved = bound(item.achieved, item.at_least)
            items.append(
                {
                    "requirement": item.requirement + of_plant,
                    "required": direction + si(item.required, item.unit, 4),
                    "achieved": unit(achieved, item.unit),
                    "met": item.met,
                }
            )
        numbers |= {"certified": certificate.certified, "gamma": certificate.gamma, "items": items}
        return {**_finite(numbers), **seen, "reason": certificate_reason(certificate)}

    def bound(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """What a controller of any order could reach with these settings."""
        specification, plants, _ = self._read(values)
        bracket = find_bracket(plants, specification, self.file.achievable_performance)
        numbers = bracket_numbers(bracket, None)
        return _finite({name: numbers[name] for name in ("reached", "floor", "reason")})

    def save(self, values: Mapping[str, Any], name: str) -> dict[str, Any]:
        """Design file and controller files into `out`/name, the latter by `flexlink design`.

        Raises InputError for a name that is none, or one that is taken.
        """
        if not isinstance(name, str) or not _NAME.fullmatch(name):
            raise InputError(f"name {str(name)[:40]!r}: expected letters, digits, '.', '_' and '-'")
        directory = self.out / name
        asked = self.completed(values)
        if directory.exists():
            raise InputError(f"{directory}: already there; choose another name")
        path = directory / "design.toml"
        directory.mkdir(parents=True)
        storage.write_text(path, toml_of(asked))
        with self._designing:
            done = design_controller(self.paths, read_design_file(path), out=directory, seed=self.seed)
        files = [str(path), *done.numbers["files"]]
        return {"directory": str(directory), "files": files, "certified": done.certified}

    def cancel(self) -> None:
        """End a design that runs, at its next step."""
        self._newest += 1

    # -- curves ----------------------------------------------------------------------------------------------

    def _seen(
        self,
        law: Controller,
        plants: Sequence[UncertainPlant],
        specification: Specification,
        gamma: float,
        margins: Sequence[tuple[Margins, float]],
        at_limits: str,
        *,
        settles: bool = True,
    ) -> dict[str, Any]:
        """Numbers (words, value) and curves of a loop.

        margins: over the ellipses of each plant, with its bandwidth [rad/s]. at_limits: what is said of the
        loop at the controller's limits. settles: settling times with friction are wanted, too, which take a
        dozen simulations.
        """
        runs = [self._steps(law, plant) for plant in plants]
        friction = ""
        if self._friction is not None and settles:
            friction = self._friction.settling(law, self._reference_step(law, plants[0]))
        numbers = engineers_numbers(law)
        if numbers is not None:
            numbers = replace(numbers, gain_unit=gain_unit_of(*self._units))
        worst_margins = reduce(Margins.worse, [worst for worst, _ in margins])
        rows = tune_rows(
            gamma,
            worst_margins,
            min(bandwidth for _, bandwidth in margins),
            [step_metrics(nominal) for nominal, *_ in runs],
            input_unit=self._units[0],
            order=law.order,
            numbers=numbers,
            friction=friction,
            limits=at_limits,
        )
        curves = []
        for plant, (nominal, *drawn) in zip(plants, runs, strict=True):
            y = nominal.measured
            # The step until it hardly moves: beyond its settling to 2 %.
            distance = np.abs(y - y[-1])
            away = np.flatnonzero(distance > 0.01 * self.step_size)
            # A step that settles within a few samples would be a jump without a shape.
            shown = 40
            if away.size:
                shown = max(shown, int(1.5 * (away[-1] + 1)))
            shown = min(y.size, shown)
            friction_curves = []
            if self._friction is not None:
                friction_curves = self._friction.curves(law, shown, self._reference_step(law, plant))
            step_curves = {
                "end": float(nominal.time_s[shown - 1]),
                "nominal": line(nominal, shown),
                "samples": [line(run, shown) for run in drawn],
                "friction": friction_curves,
            }
            grid = _shown_grid(law, plant, specification)
            curves.append(
                {
                    "name": plant.name,
                    "gains": _gains(law, plant, specification, self._units, self._performance_unit),
                    "nyquist": _nyquist(law, plant),
                    "bode": bode(law, plant, grid, self._units),
                    "roots": roots(law, plant),
                    "step": step_curves,
                }
            )
        return {"numbers": [(row.name, row.text) for row in rows], "plants": curves}

    def _reference_step(self, law: Controller, plant: UncertainPlant) -> Real:
        """The reference step (T,) as the loop gets it: through the run's filter, where there is one.

        It lasts as long as the loop on the nominal model needs.
        """
        radius = float(np.max(np.abs(closed_loop_poles(law, plant)), initial=0.0))
        step = np.full(settling_samples(radius, *_STEP_SAMPLES) // 2, self.step_size)
        return step if self.filter is None else self.filter.filtered(step)

    def _steps(self, law: Controller, plant: UncertainPlant) -> list[ClosedLoopTrajectory]:
        """The reference step on the nominal model, or, where there is a posterior, on its mean and on models
        drawn from it; as a run predicts it (`workflow.tasks.closed_loop`)."""
        reference = self._reference_step(law, plant)
        step = np.full(reference.size, self.step_size)
        models = [plant.nominal]
        if isinstance(plant.uncertainty, ResponsePosterior):
            models = _models(plant.uncertainty, self.seed)
        runs = [simulate_plant(law, model, reference, clip=FINITE) for model in models]
        return [replace(run, reference=step) for run in runs]


@lru_cache(maxsize=8)
def _models(posterior: ResponsePosterior, seed: int) -> list[control.StateSpace]:
    """The mean, and models drawn from the posterior, the same at every call."""
    drawn = posterior.sample(stage_rng(seed, "tune"), _SAMPLES)
    return [realise(posterior, coefficients) for coefficients in (posterior.mean, *drawn)]


def _grid(plant: UncertainPlant, law: Controller, n_log: int, per_mode: int) -> Real:
    """Frequencies that show a loop: denser around its modes; a plant's own where it is known there only."""
    if plant.own_grid is not None:
        return plant.own_grid[plant.own_grid > 0]
    modes = (*plant.modes, *modes_of(closed_loop_poles(law, plant), plant.dt_s))
    light = []
    for mode in modes:
        if mode.zeta < _LIGHTLY_DAMPED and mode.omega_rad_s < plant.nyquist_rad_s:
            light.append(Mode(mode.omega_rad_s, max(abs(mode.zeta), _LEAST_DAMPING)))
    return checked_grid(plant, light, n_log, per_mode)


def _shown_grid(law: Controller, plant: UncertainPlant, specification: Specification) -> Real:
    """Frequencies of pictures, rad/s: from a thirtieth of the bandwidth on, or lower."""
    omega = _grid(plant, law, _FREQUENCIES, _AT_MODE)
    lowest = _SHOWN * plant.nyquist_rad_s
    if specification.bandwidth_rad_s:
        lowest = min(lowest, specification.bandwidth_rad_s / _BELOW_BANDWIDTH)
    return omega[omega >= lowest]


def _gains(
    law: Controller,
    plant: UncertainPlant,
    specification: Specification,
    units: tuple[str, str] = ("", ""),
    performance_unit: str = "",
) -> list[dict[str, Any]]:
    """Closed-loop gains of a plant with their units.

    units: of input and output; performance_unit: of the output that is wanted, where it is another one; ""
    where nobody stated them.
    """
    if plant.performance is not None and not performance_unit:
        performance_unit = "?"
    curves = sensitivity_curves(
        plant,
        law,
        specification,
        _shown_grid(law, plant, specification),
        input_unit=units[0],
        output_unit=units[1],
        performance_unit=performance_unit,
    )
    drawn = []
    for curve in curves:
        # A gap in the curve where the worst case has no bound.
        worst = np.where(curve.worst < _UNBOUNDED, curve.worst, np.nan)
        drawn.append(
            {
                "symbol": curve.symbol,
                "meaning": curve.meaning,
                "unit": curve.unit,
                "x": short(curve.omega_rad_s),
                "nominal": short(curve.nominal),
                "worst": short(worst),
                "limit": short(curve.limit),
            }
        )
    return drawn


def _nyquist(law: Controller, plant: UncertainPlant) -> dict[str, Any]:
    """Loop K G of the centres and outlines of its ellipses, as far as they are near the origin."""
    grid = _grid(plant, law, _NYQUIST_FREQUENCIES, _NYQUIST_AT_MODE)
    # A plant that is known on a grid of its own has nothing between its points.
    if plant.own_grid is None:
        grid = smooth_grid(grid, lambda omega: law.response(omega) * plant.at(omega).centre)
    ellipses = plant.at(grid)
    k = law.response(grid)
    loop = k * ellipses.centre
    # Ellipses at some of the frequencies, evenly spread over the part that is seen.
    at = np.flatnonzero(np.abs(loop) < _NEAR)
    if at.size:
        evenly = np.linspace(0, at.size - 1, _ELLIPSES).astype(int)
        at = at[np.unique(evenly)]
    turn = np.exp(2j * np.pi * np.arange(_CORNERS) / _CORNERS)
    part = ellipses.subset(at)
    major = part.semi_major[:, None] * turn.real
    minor = part.semi_minor[:, None] * turn.imag
    about_centre = part.direction[:, None] * (major + 1j * minor)
    outline = k[at, None] * (part.centre[:, None] + about_centre)
    # The curve goes on a little beyond the picture's end, so that it does not stop in sight.
    line = np.where(np.abs(loop) < 2 * _NEAR, loop, np.nan)
    return {
        "re": short(line.real),
        "im": short(line.imag),
        "ellipses": [[short(ellipse.real), short(ellipse.imag)] for ellipse in outline],
    }


def _words_of_structure(specification: Specification, structure: _Structure, key: str) -> str:
    """What a structure has in place of a setting, "structure pid has order 4", with the notches and low-pass
    of the specification; key: one of `_SET_BY_STRUCTURE`."""
    if key == "integrator":
        article = "an" if structure in ("pi", "pid") else "no"
        return f"structure {structure} has {article} integrator"
    of_structure = specification.model_copy(update={"structure": structure})
    return f"structure {structure} has order {order_of_structure(of_structure)}"


def _control(name: str, schema: Mapping[str, Any], value: Any) -> dict[str, Any] | None:
    """The page's control of a field by its JSON schema; None for a pair or a weight, which stays as it is.

    Returns
    -------
    dict or None
        `name`, `words` (the description, which every field has), `value`, `optional`, `kind` (a value of
        `_KINDS`); where the schema has them `unasked` (what an optional field is set to that is not asked
        for), `choices` and the ends of the range, by the values of `_ENDS`.
    """
    # An optional field is "anyOf": its type first, then null or the constant that stands for "not asked".
    parts = schema.get("anyOf", [schema])
    setting: dict[str, Any] = {"name": name, "words": schema["description"], "value": value}
    setting["optional"] = {"type": "null"} in parts
    if "const" in parts[-1]:
        setting |= {"optional": True, "unasked": parts[-1]["const"]}
    type_name = "enum" if "enum" in parts[0] else parts[0].get("type", "")
    kind = _KINDS.get(type_name)
    if kind is None:
        return None
    if kind == "choice":
        setting["choices"] = parts[0]["enum"]
    setting["kind"] = kind
    for schema_name, page_name in _ENDS.items():
        if schema_name in parts[0]:
            setting[page_name] = parts[0][schema_name]
    return setting


def toml_of(file: DesignFile) -> str:
    """A design file as TOML; `read_design_file` reads the same settings back."""
    document = tomlkit.document()
    for name in DesignFile.model_fields:
        section = getattr(file, name)
        if section is not None:
            # A section that is left out would be the run's own: it stands here even where all is default. In
            # it, what is stated and nothing else: a level or a delay that is stated at its default is kept,
            # one that is not stated is that of the plant's file or sought in the data.
            document[name] = section.model_dump(mode="json", exclude_unset=True, exclude_none=True)
    return tomlkit.dumps(document)


def _finite(numbers: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers for JSON, which has neither infinity nor nan: None in place of them."""
    finite = {}
    for name, value in numbers.items():
        is_number = not isinstance(value, float) or math.isfinite(value)
        finite[name] = value if is_number else None
    return finite
