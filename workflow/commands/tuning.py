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
from workflow.commands.tuning_views import FrictionStep, bode, line, roots, short
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
from workflow.text.templates import rows_of, said

CONFIDENCE = "confidence"  # a setting beside those of the specification: level of the ellipses
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,60}")
_GAINS = np.geomspace(0.25, 4.0, 33)  # of the last controller, tried for settings that have no design yet
_SAMPLES = 15  # posterior samples whose steps are shown
_STEP_SAMPLES = 200, 1 << 14  # of two steps: a run's, as far as an answer comes soon
_SHOWN = 1e-4  # share of the Nyquist frequency where pictures over frequency begin, or lower
_NEAR = 3.0  # distance from 0 up to which the Nyquist curve is shown
_ELLIPSES, _CORNERS = 60, 24


# Of a setting in the JSON schema of the specification: the page's control, and ends of its range.
_KINDS = {"boolean": "switch", "enum": "choice", "integer": "count", "number": "number"}
_ENDS = {"minimum": "ge", "exclusiveMinimum": "gt", "maximum": "le", "exclusiveMaximum": "lt"}

Handler = Callable[[Mapping[str, Any]], dict[str, Any]]


_Structure = Literal["p", "pi", "pd", "pid"]
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
        self.paths, self.out, self.seed = tuple(paths), out, seed
        sources, self.file, specification = load_asked(paths, file)
        found = of_run(self.paths)
        self.specification = at_one_bandwidth(specification, found)
        self._plants, self._units = [source.plant for source in sources], sources[0].units
        self.drawable = all(level_can_change(plant) for plant in self._plants)
        self._last = None if found is None else found.design.controller
        self._performance_unit = ""
        config = sources[0].config
        if found is not None and isinstance(config, RunConfig) and config.performance_index is not None:
            performance_output = config.channels[config.performance_index].output
            self._performance_unit = found.records.unit(performance_output)
        # Overshoot, settling time and command are those of the run's reference step, through its filter.
        self.step_size, self.filter = 1.0, None
        self._friction: FrictionStep | None = None
        if found is not None and found.run.stage_file("closed_loop") and found.closed_loop.check is not None:
            self.step_size = found.closed_loop.check.reference_step
            self.filter = found.reference_filter.filter
            friction = found.identify.friction
            if friction is not None and isinstance(config, RunConfig):
                steps = converter_steps(config.closed_loop)
                self._friction = FrictionStep(friction, self.step_size, steps)
        self.output_unit = self._units[1]
        self.step_words = si(self.step_size, self.output_unit or "in the unit of the output", 4)
        self._newest, self._designing = 0, threading.Lock()

    # -- settings --------------------------------------------------------------------------------------------

    def settings(self) -> list[dict[str, Any]]:
        """What the page has a control for: name, kind, description, unit, value, range."""
        fields = {**Specification.model_json_schema()["properties"]}
        for limit in GIVES_WAY.values():
            del fields[limit]
        found = [_control(name, field, getattr(self.specification, name)) for name, field in fields.items()]
        for one in found:
            if one is not None and one["name"] in _SET_BY_STRUCTURE:
                one["set_by_structure"] = {
                    structure: _words_of_structure(self.specification, structure, one["name"])
                    for structure in _STRUCTURES
                }
        if self.drawable:
            words = "confidence of each ellipse: share of the probability inside"
            about = {"name": CONFIDENCE, "kind": "number", "words": words, "value": self._plants[0].level}
            found.append(about | {"ge": 0.5, "lt": 0.9999})
        return [one | {"unit": unit_of(one["name"], *self._units)} for one in found if one is not None]

    def _read(self, values: Mapping[str, Any]) -> tuple[Specification, list[UncertainPlant], float | None]:
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
            plant = PlantSection.model_validate(
                plant.model_dump(exclude_unset=True) | {"level": level}, context={"base": Path()}
            )
        return self.file.model_copy(update={"specification": specification, "plant": plant})

    # -- designs ---------------------------------------------------------------------------------------------

    def scaled(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """The last controller, times the gain that suits these settings best; nothing is certified."""
        specification, plants, _ = self._read(values)
        if (last := self._last) is None:
            raise InputError("no design yet: wait for the first")
        data = [PlantData.build(p, specification, _grid(p, last, 120, 20)) for p in plants]
        k = [last.response(one.ellipses.omega_rad_s, with_delay=False) for one in data]
        ranked = []
        for gain in _GAINS.tolist():
            worst = [
                WorstCase(d.ellipses.omega_rad_s, d.ellipses, gain * v * d.delay, d.weighted(gain * v))
                for d, v in zip(data, k, strict=True)
            ]
            gamma = max(float(np.max(worst_of(one.values))) for one in worst)
            ranked.append((gamma, abs(math.log(gain)), gain, worst))
        for gamma, _, gain, worst in sorted(ranked, key=itemgetter(0, 1)):
            law = replace(last, C=gain * last.C, D=gain * last.D, anti_windup_gain=None)
            if all(np.all(np.abs(closed_loop_poles(law, plant)) < 1) for plant in plants):
                margins = [loop_margins(law, p, one)[1:3] for p, one in zip(plants, worst, strict=True)]
                numbers = {"gain": gain, "gamma": gamma, "certified": None}
                at_limits = said("limits_not_looked_at")
                seen = self._seen(law, plants, specification, gamma, margins, at_limits, settles=False)
                return {**_finite(numbers), **seen}
        raise InputError("no gain keeps the last controller stable with these settings")

    def near(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """As `design`, from the last controller alone: soon, and seldom worse. Empty where that leads
        nowhere."""
        if self._last is None or self.file.certificate.calibrate:
            return {}
        found = self.design(values, self._last)
        return found if found["plants"] else {}

    def design(self, values: Mapping[str, Any], like: Controller | None = None) -> dict[str, Any]:
        """A new design with its certificate, `like` a controller or whole. Raises SupersededError where a
        newer one is asked for."""
        asked = self.completed(values)
        specification, plants, _ = self._read(values)
        self._newest += 1
        number = self._newest

        def still(*_: object) -> None:
            if number != self._newest:
                raise SupersededError

        with self._designing:
            still()
            options, rng = asked.synthesis, stage_rng(self.seed, "design")
            if like is None:
                found = find_design(
                    plants, specification, options, asked.certificate, rng, still, advise=False
                )
            else:
                try:
                    near = synthesise_near(like, plants, specification, options, rng=rng, progress=still)
                except SpecificationError as impossible:
                    return {"certified": False, "gamma": None, "reason": str(impossible), "plants": []}
                found = DesignResult(near, near.gamma <= 1.0, "")
            still()
            law, used = found.controller, found.specification or specification
            numbers: dict[str, Any] = {"certified": False, "gamma": None, "reason": found.reason}
            if found.synthesis is not None:
                active = next(iter(found.synthesis.blocking), None)
                words = active and f"{active.weight} of {active.plant} at {active.omega_rad_s:.4g} rad/s"
                numbers |= {"gamma": found.synthesis.gamma, "active": words or ""}
            if law is None:
                return {**_finite(numbers), "plants": []}
            certificate = certify(law, plants, used, between_own_points=asked.plant.between_points)
            still()
            self._last = law
        margins = [(verdict.worst_margins, verdict.bandwidth_rad_s) for verdict in certificate.plants]
        at_limits = said("limited_loops", certificate)
        seen = self._seen(law, plants, used, certificate.gamma, margins, at_limits)
        items = [
            {
                "requirement": item.requirement + (f" ({item.plant})" if len(plants) > 1 else ""),
                "required": ("≥ " if item.at_least else "≤ ") + si(item.required, item.unit, 4),
                "achieved": unit(bound(item.achieved, item.at_least), item.unit),
                "met": item.met,
            }
            for item in certificate.items
        ]
        numbers |= {"certified": certificate.certified, "gamma": certificate.gamma, "items": items}
        return {**_finite(numbers), **seen, "reason": said("certificate_reason", certificate)}

    def bound(self, values: Mapping[str, Any]) -> dict[str, Any]:
        """What a controller of any order could reach with these settings."""
        specification, plants, _ = self._read(values)
        found = bracket_numbers(find_bracket(plants, specification, self.file.achievable_performance), None)
        return _finite({name: found[name] for name in ("reached", "floor", "reason")})

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
        """Numbers (words, value) and curves of a loop. margins: over the ellipses of each plant, with its
        bandwidth [rad/s]. at_limits: what is said of the loop at the controller's limits. settles: settling
        times with friction are wanted, too, which take a dozen simulations."""
        runs = [self._steps(law, plant) for plant in plants]
        friction = ""
        if self._friction is not None and settles:
            friction = self._friction.settling(law, self._given(law, plants[0]))
        numbers = engineers_numbers(law)
        if numbers is not None:
            numbers = replace(numbers, gain_unit=gain_unit_of(*self._units))
        table = rows_of(
            "summary/tune.j2",
            gamma=gamma,
            margins=reduce(Margins.worse, [worst for worst, _ in margins]),
            bandwidth_rad_s=min(bandwidth for _, bandwidth in margins),
            steps=[step_metrics(nominal) for nominal, *_ in runs],
            unit=self._units[0],
            order=law.order,
            limits=at_limits,
            friction=friction,
            numbers=numbers,
        )
        curves = []
        for plant, (nominal, *drawn) in zip(plants, runs, strict=True):
            y = nominal.measured
            # The step until it hardly moves: beyond its settling to 2 %.
            away = np.flatnonzero(np.abs(y - y[-1]) > 0.01 * self.step_size)
            shown = min(y.size, max(40, int(1.5 * (away[-1] + 1)) if away.size else 40))
            curves.append(
                {
                    "name": plant.name,
                    "gains": _gains(law, plant, specification, self._units, self._performance_unit),
                    "nyquist": _nyquist(law, plant),
                    "bode": bode(law, plant, _shown_grid(law, plant, specification), self._units),
                    "roots": roots(law, plant),
                    "step": {
                        "end": float(nominal.time_s[shown - 1]),
                        "nominal": line(nominal, shown),
                        "samples": [line(run, shown) for run in drawn],
                        "friction": []
                        if self._friction is None
                        else self._friction.curves(law, shown, self._given(law, plant)),
                    },
                }
            )
        return {"numbers": table[0].rows, "plants": curves}

    def _given(self, law: Controller, plant: UncertainPlant) -> Real:
        """The reference step (T,) as long as the loop on the nominal model needs, through the run's filter if
        it has one."""
        radius = float(np.max(np.abs(closed_loop_poles(law, plant)), initial=0.0))
        step = np.full(settling_samples(radius, *_STEP_SAMPLES) // 2, self.step_size)
        return step if self.filter is None else self.filter.filtered(step)

    def _steps(self, law: Controller, plant: UncertainPlant) -> list[ClosedLoopTrajectory]:
        """The reference step on the nominal model, and on models drawn from the posterior where there is one;
        as a run predicts it (`workflow.tasks.closed_loop`)."""
        given = self._given(law, plant)
        step = np.full(given.size, self.step_size)
        models = [plant.nominal]
        if isinstance(plant.uncertainty, ResponsePosterior):
            models = _models(plant.uncertainty, self.seed)
        runs = [simulate_plant(law, model, given, clip=FINITE) for model in models]
        return [replace(run, reference=step) for run in runs]


@lru_cache(maxsize=8)
def _models(posterior: ResponsePosterior, seed: int) -> list[control.StateSpace]:
    """The mean, and models drawn from the posterior, the same at every call."""
    drawn = posterior.sample(stage_rng(seed, "tune"), _SAMPLES)
    return [realise(posterior, one) for one in (posterior.mean, *drawn)]


def _grid(plant: UncertainPlant, law: Controller, n_log: int, per_mode: int) -> Real:
    """Frequencies that show a loop: denser around its modes; a plant's own where it is known there only."""
    if plant.own_grid is not None:
        return plant.own_grid[plant.own_grid > 0]
    modes = (*plant.modes, *modes_of(closed_loop_poles(law, plant), plant.dt_s))
    light = [Mode(m.omega_rad_s, max(abs(m.zeta), 1e-3)) for m in modes if m.zeta < 0.3]
    return checked_grid(plant, [m for m in light if m.omega_rad_s < plant.nyquist_rad_s], n_log, per_mode)


def _shown_grid(law: Controller, plant: UncertainPlant, specification: Specification) -> Real:
    """Frequencies of pictures, rad/s: from a thirtieth of the bandwidth on, or lower."""
    omega = _grid(plant, law, 150, 12)
    lowest = min(_SHOWN * plant.nyquist_rad_s, (specification.bandwidth_rad_s or math.inf) / 30)
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
    return [
        {
            "symbol": one.symbol,
            "meaning": one.meaning,
            "unit": one.unit,
            "x": short(one.omega_rad_s),
            "nominal": short(one.nominal),
            "worst": short(np.where(one.worst < 1e200, one.worst, np.nan)),
            "limit": short(one.limit),
        }
        for one in curves
    ]


def _nyquist(law: Controller, plant: UncertainPlant) -> dict[str, Any]:
    """Loop K G of the centres and outlines of its ellipses, as far as they are near the origin."""
    grid = _grid(plant, law, 400, 30)
    if plant.own_grid is None:
        grid = smooth_grid(grid, lambda omega: law.response(omega) * plant.at(omega).centre)
    ellipses = plant.at(grid)
    k = law.response(grid)
    loop = k * ellipses.centre
    near = np.flatnonzero(np.abs(loop) < _NEAR)
    at = near[np.unique(np.linspace(0, near.size - 1, _ELLIPSES).astype(int))] if near.size else near
    turn = np.exp(2j * np.pi * np.arange(_CORNERS) / _CORNERS)
    part = ellipses.subset(at)
    major, minor = part.semi_major[:, None] * turn.real, part.semi_minor[:, None] * turn.imag
    outline = k[at, None] * (part.centre[:, None] + part.direction[:, None] * (major + 1j * minor))
    line = np.where(np.abs(loop) < 2 * _NEAR, loop, np.nan)
    return {
        "re": short(line.real),
        "im": short(line.imag),
        "ellipses": [[short(one.real), short(one.imag)] for one in outline],
    }


def _words_of_structure(specification: Specification, structure: _Structure, key: str) -> str:
    """What a structure has in place of a setting, "structure pid has order 4", with the notches and low-pass
    of the specification; key: one of `_SET_BY_STRUCTURE`."""
    if key == "integrator":
        return f"structure {structure} has {'an' if structure in ('pi', 'pid') else 'no'} integrator"
    of_structure = specification.model_copy(update={"structure": structure})
    return f"structure {structure} has order {order_of_structure(of_structure)}"


def _control(name: str, schema: Mapping[str, Any], value: Any) -> dict[str, Any] | None:
    """The page's control of a field by its JSON schema; None for a pair or a weight, which stays as it is."""
    parts = schema.get("anyOf", [schema])
    found: dict[str, Any] = {"name": name, "words": schema["description"], "value": value}
    found["optional"] = {"type": "null"} in parts
    if "const" in parts[-1]:
        found |= {"optional": True, "unasked": parts[-1]["const"]}
    kind = _KINDS.get("enum" if "enum" in parts[0] else parts[0].get("type", ""))
    if kind is None:
        return None
    if kind == "choice":
        found["choices"] = parts[0]["enum"]
    return {
        **found,
        "kind": kind,
        **{short: parts[0][long] for long, short in _ENDS.items() if long in parts[0]},
    }


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
    return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in numbers.items()}
