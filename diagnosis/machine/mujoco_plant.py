"""A MuJoCo model (MJCF) as a plant: its values are nominal parameters, what it has none of may be missing.

    arm = MujocoArm.from_file("arm.xml", outputs=("shoulder", "elbow"), dt_s=0.01)
    experiments = [PlantExperiment(name, role, np.column_stack([commands, angles]), angles), ...]
    plant = arm.plant(experiments, noise)
    found = diagnose(PlantCase("arm", plant, experiments))
    text = arm.repaired(plant, found.rig, found.repair)  # MJCF

Every effect is an edit of the model, so that the repaired file holds it (docs/simulators.md has the list).
What MJCF does not know stands in it as <numeric name="SENSOR.gain">, "SENSOR.offset",
"ACTUATOR.dead_zone" and "JOINT.stribeck" and is read from there. So is the tolerance of a value,
"tolerance.shoulder.damping"; others have a usual one (`TOLERANCES`).
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from diagnosis.machine.force_places import ForcedSimulation, ForcePlace
from diagnosis.machine.machine_protocol import Real
from diagnosis.machine.mujoco_edits import DEAD_ZONE, STRIBECK
from diagnosis.machine.mujoco_forces import FORCE_NAMES
from diagnosis.machine.mujoco_model import MujocoModel
from diagnosis.machine.mujoco_quantities import Quantities
from diagnosis.machine.mujoco_simulation import MujocoSimulation
from diagnosis.machine.own_plant import Plant, PlantExperiment
from diagnosis.machine.plant_effect import Change, PlantEffect

# Last parts of the names of <numeric>s in a file on which MuJoCo does not act.
_IGNORED = (".gain", ".offset", f".{DEAD_ZONE}", f".{STRIBECK}", *(f".{name}" for name in FORCE_NAMES))
# Relative standard deviations where the file has no <numeric name="tolerance.NAME">, by a name's last part.
# Chosen: masses are weighed, inertias and stiffnesses are drawn, friction and lateness are known from a data
# sheet at best. Twice as much lets a value move twice as far before it is a finding.
TOLERANCES = {
    "mass": 0.03,
    "inertia": 0.05,
    "frictionloss": 0.2,
    "damping": 0.2,
    "armature": 0.1,
    "stiffness": 0.05,
    "drag": 0.2,
    "hardening_spring": 0.05,
    "gain": 0.02,
    "kp": 0.02,
    "kv": 0.02,
    "dead_zone": 0.2,
    "forcerange": 0.1,
    "lag": 0.2,
    "delay": 0.2,
    # Inertia goes with the square of a stretch: half its tolerance.
    "stretch_x": 0.025,
    "stretch_y": 0.025,
    "stretch_z": 0.025,
}
# Relative standard deviation of all other values: gravity and the gains of sensors. Chosen, as above.
_OTHER_TOLERANCE = 0.01
# An effect is looked for if its largest start moves a record by more than so many noise deviations somewhere:
# three are reached by noise in one of four hundred samples. Chosen.
_SEEN_NOISE_DEVIATIONS = 3.0
# And if it moves the record by more than this share of the model error: what makes less is never named.
# Chosen: a fit may enlarge the largest start by 1 / 0.6 (`mujoco_quantities`).
_SEEN_OF_MODEL_ERROR = 0.5
# A stated value is looked for if it shows when it is wrong by this factor; a value that is off by more would
# be known to be. Chosen.
_WRONG_FACTOR = 3.0
# Records that are simulated for that, the first ones. Chosen: a simulation of each for every quantity.
_RECORDS_LOOKED_AT = 2
# Where an effect at its least size changes more than this share of what it changes at its largest start, it
# is the model's steps that change the record. Chosen: its least size should be next to nothing.
_UNSTABLE_SHARE = 0.5
# Rate of the tracking over the largest speed over the travel: a motion through the travel and back at full
# speed has an angular frequency of twice that, so the tracking is slower than what commands do. Chosen.
_TRACKING_OF_MOTION = 0.5
# Rate of the tracking over the rate at which an inverted joint falls: at one it would stand without a rate of
# its own, above it is drawn back. Chosen.
_TRACKING_OF_FALL = 1.5


@dataclass(frozen=True, eq=False)
class MujocoArm(MujocoModel):
    """A model whose values are nominal parameters, and whose missing ones are effects."""

    def quantities(self, experiments: Sequence[PlantExperiment]) -> dict[str, PlantEffect]:
        """Everything that may be off or missing, by name, with ranges that the experiments say."""
        return Quantities(self, experiments).by_name()

    @property
    def force_places(self) -> tuple[ForcePlace, ...]:
        """(J,) the joints whose position is measured, each with the first actuator that moves it."""
        moved_by = [actuator.target for actuator in self.spec.actuators]
        places = []
        for joint in self.tracked:
            slides = self.spec.joint(joint.name).type == mujoco.mjtJoint.mjJNT_SLIDE
            command = moved_by.index(joint.name) if joint.name in moved_by else None
            places.append(ForcePlace(joint.name, "N" if slides else "N m", joint.column, command))
        return tuple(places)

    def tracking(self, experiments: Sequence[PlantExperiment]) -> float:
        """Rate [rad/s] at which a simulation is drawn to the measured joints, see `tracking_rad_s`.

        It is half the largest speed over the travel, and enough to hold every joint against gravity: more
        than the rate sqrt(m g l / J) at which the joint with all behind it falls, as a pendulum upside down.
        """
        model = self.nominal
        data = mujoco.MjData(model)
        mujoco.mj_forward(model, data)
        motions = Quantities(self, experiments).motions
        fastest = 0.0
        for tracked in self.tracked:
            motion = motions[tracked.name]
            fastest = max(fastest, _TRACKING_OF_MOTION * motion.speed / motion.travel)
            if self.spec.joint(tracked.name).type != mujoco.mjtJoint.mjJNT_HINGE:
                continue
            joint = model.joint(tracked.name)
            body = joint.bodyid[0]
            axis = data.xaxis[joint.id]
            weight = np.linalg.norm(np.cross(axis, model.opt.gravity)) * float(model.body_subtreemass[body])
            lever = np.linalg.norm(np.cross(axis, data.subtree_com[body] - data.xanchor[joint.id]))
            falls_rad_s = float(np.sqrt(weight * lever / tracked.inertia))
            fastest = max(fastest, _TRACKING_OF_FALL * falls_rad_s)
        return fastest

    def repaired(
        self,
        plant: Plant,
        repaired: Plant,
        effects: Sequence[Change],
        records: Sequence[PlantExperiment] = (),
        folder: Path | None = None,
    ) -> str:
        """MJCF of the model with the values of a repaired plant and with effects.

        Parameters
        ----------
        plant : Plant
            As stated, made by `plant`.
        repaired : Plant
            The same with other values (`Diagnosis.rig`).
        effects : sequence of Change
            Effects and ratios of values (`Diagnosis.repair`).
        records : sequence of PlantExperiment
            To replay, each with a keyframe "start of NAME".
        folder : Path or None
            Where the text will be written, from which it finds its meshes and textures; None: by their
            absolute paths.

        Returns
        -------
        str
            Its first lines, a comment, list what was changed. Raises ValueError where MuJoCo does not compile
            it.
        """
        assert isinstance(plant.simulation, MujocoSimulation)
        values: dict[str, Any] = dict(repaired.parameters)
        for change in effects:
            name = change.id.removeprefix("wrong_")
            sizes = tuple(change.values.values())
            values[name] = values[name] * sizes[0] if name in values else sizes
        changed = {name: value for name, value in values.items() if value != plant.parameters.get(name)}

        spec = plant.simulation.edited(changed, self.spec)
        model = _compiled_with_poses(spec, self.nominal)
        _note_what_is_ignored(spec)
        for e in records:
            data = plant.simulation.began(model, e.input)
            # A file that was repaired before may have a start of this record.
            present = spec.key(f"start of {e.name}")
            if present is not None:
                spec.delete(present)
            spec.add_key(name=f"start of {e.name}", qpos=data.qpos, qvel=data.qvel, act=data.act)
        spec.compile()
        _point_to_assets(spec, folder)
        lines = [*_said_of_values(plant, changed), *_said_of_delays(model)]
        # "--" ends a comment of XML.
        listed = "\n".join(lines).replace("--", "- -")
        return f"<!-- Changed by flexlink diagnose:\n{listed}\n-->\n{spec.to_xml()}"

    def plant(
        self,
        experiments: Sequence[PlantExperiment],
        noise: Real,
        *,
        model_error: float = 0.0,
        named: Sequence[str] = (),
    ) -> Plant:
        """The arm with everything that its model has as nominal parameters and all else as effects.

        Parameters
        ----------
        experiments : sequence of PlantExperiment
            input (T, U + Y) commands, then outputs as measured; output (T, Y).
        noise : (Y,)
            Noise standard deviations of the outputs, in SI units.
        model_error : float
            Share of the motion that commands make; beside the tracking that is less than all of it.
        named : sequence of str
            Patterns that choose quantities which are tried by name only.

        Returns
        -------
        Plant
            Quantities that do not show in the first records are exact if stated, else left out.

        Raises
        ------
        ValueError
            One line: in a record the model as stated runs away.
        """
        quantities = {}
        for name, quantity in self.quantities(experiments).items():
            if quantity.tried == "always" or any(fnmatchcase(name, pattern) for pattern in named):
                quantities[name] = quantity
        simulation = MujocoSimulation(self, quantities, noise)
        stated = simulation.parameters
        for experiment in experiments:
            if not np.all(np.isfinite(simulation(stated, {}, experiment.input))):
                raise ValueError(
                    f"experiment {experiment.name}: the model as stated runs away (MuJoCo meets an infinite "
                    "position, speed or acceleration): check the timestep, units of the commands, and stiff "
                    "or negative springs"
                )
        tolerances = {}
        for name in stated:
            usual = TOLERANCES.get(name.rpartition(".")[2], _OTHER_TOLERANCE)
            tolerances[name] = simulation.tolerances.get(name, usual)
        motion_error = model_error * simulation.commanded(stated, experiments)

        # What shows: stated values that are wrong, effects at their largest start.
        visibility = _Visibility.of(simulation, experiments[:_RECORDS_LOOKED_AT], motion_error)
        shown = {
            name for name, value in stated.items() if visibility.of_value(name, _WRONG_FACTOR * value) > 0
        }
        unstable = []
        for effect in simulation.effects:
            change = visibility.of_effect(effect, at_its_least=False)
            if change == 0:
                continue
            # What changes as much at next to no size is the simulation: its steps are too coarse for it.
            if visibility.of_effect(effect, at_its_least=True) > _UNSTABLE_SHARE * change:
                unstable.append(effect.name)
            else:
                shown.add(effect.name)

        inactive = self._not_applicable(quantities)
        for name in stated:
            if name not in shown and tolerances[name] > 0:
                inactive[f"wrong_{name}"] = "records in which it shows"
        for name in unstable:
            inactive[name] = "smaller steps of the model (timestep)"
        places = self.force_places
        return Plant(
            simulation,
            stated,
            {name: value for name, value in tolerances.items() if value > 0 and name in shown},
            self.outputs,
            noise,
            tuple(effect for effect in simulation.effects if effect.name in shown),
            motion_error,
            self.dt_s,
            inactive=inactive,
            settled=simulation.settled,
            untracked=MujocoSimulation(replace(self, tracking_rad_s=0.0), quantities, noise, settles=False),
            units=self.units,
            forced=ForcedSimulation(places, simulation.forced) if places else None,
            input_names=self.inputs,
        )

    def _not_applicable(self, quantities: Mapping[str, PlantEffect]) -> dict[str, str]:
        """Quantity that this model cannot have -> what it needs, by name."""
        model = self.nominal
        needs = {}
        for link in set(model.body_weldid) - {0}:
            body = model.body(link).name
            needs[f"{body}.payload"] = f"a <site> in the body {body}, where a load may be"
        for actuator in self.inputs:
            needs[f"{actuator}.gain"] = "an actuator whose gain is fixed, affine or a muscle's"
            needs[f"{actuator}.lag"] = "an actuator without dynamics or with those of a filter"
        return {name: need for name, need in sorted(needs.items()) if name not in quantities}


@dataclass(frozen=True, eq=False)
class _Visibility:
    """How much quantities change records.

    Parameters
    ----------
    simulation : MujocoSimulation
    records : sequence of PlantExperiment
    as_stated : list of (T, Y)
        Outputs of the simulation as stated, for each record.
    least_share : float
        Of the motion of an output (its standard deviation): a change of less does not count.
    """

    simulation: MujocoSimulation
    records: Sequence[PlantExperiment]
    as_stated: Sequence[Real]
    least_share: float

    @classmethod
    def of(
        cls, simulation: MujocoSimulation, records: Sequence[PlantExperiment], model_error: float
    ) -> _Visibility:
        """That of a simulation in these records; model_error: share of the motion that it may miss."""
        as_stated = [simulation(simulation.parameters, {}, e.input) for e in records]
        return cls(simulation, records, as_stated, _SEEN_OF_MODEL_ERROR * model_error)

    def of_value(self, name: str, value: float) -> float:
        """Largest change of an output over its noise (RMS) by a value; 0 where it shows in no record."""
        return self._change({name: value}, {})

    def of_effect(self, effect: PlantEffect, *, at_its_least: bool) -> float:
        """Largest change of an output over its noise (RMS) by an effect, with the parameters behind its size
        at the start that changes most; 0 where it shows in no record.

        at_its_least : with its size at the end of the range where it is next to nothing; else at its largest
        start.
        """
        size, *further = effect.parameters
        # A large size changes most if the effect grows with it, else a small one.
        start_place = -1 if effect.grows else 0
        values = {size.name: size.starts[start_place]}
        if at_its_least:
            values[size.name] = size.low if effect.grows else size.high
        for parameter in further:
            values[parameter.name] = parameter.starts[start_place]
        return self._change({}, {effect.name: values})

    def _change(self, parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]]) -> float:
        """Largest RMS of a change over the noise, of records in which it is large and reaches above noise.

        Infinite where a trial runs away: that shows, whatever its size.
        """
        noise = self.simulation.noise
        largest = 0.0
        for e, before in zip(self.records, self.as_stated, strict=True):
            values = {**self.simulation.parameters, **parameters}
            change = self.simulation(values, effects, e.input) - before
            if not np.all(np.isfinite(change)):
                return np.inf
            rms = np.sqrt(np.mean(change**2, axis=0))
            matters = rms > self.least_share * np.std(e.output, axis=0)
            reaches_above_noise = np.max(np.abs(change), axis=0) > _SEEN_NOISE_DEVIATIONS * noise
            if np.any(matters & reaches_above_noise):
                largest = max(largest, float(np.max(rms / noise)))
        return largest


def _compiled_with_poses(spec: Any, stated: Any) -> Any:
    """The edited spec compiled (mujoco.MjModel), its keyframes with a place for added joints.

    spec : mujoco.MjSpec, changed in place. stated : mujoco.MjModel before the edits. An added joint, within a
    backlash, stands in its zero; MuJoCo itself would fill up the end of a pose that is too short.
    """
    poses = [np.array(key.qpos) for key in spec.keys]
    model = spec.compile()
    for key, pose in zip(spec.keys, poses, strict=True):
        if not len(pose) == stated.nq < model.nq:
            continue
        whole = np.array(model.qpos0)
        for k in range(stated.njnt):
            joint = stated.joint(k)
            first = joint.qposadr[0]
            size = joint.qpos0.size
            place = model.joint(joint.name).qposadr[0]
            whole[place : place + size] = pose[first : first + size]
        key.qpos = whole
    return model


def _note_what_is_ignored(spec: Any) -> None:
    """Write into a <text> of the spec which of its numbers MuJoCo does not act on, if there are any."""
    names = [numeric.name for numeric in spec.numerics if not numeric.name.startswith("tolerance.")]
    ignored = [name for name in names if name.endswith(_IGNORED)]
    if ignored:
        note = spec.text("flexlink") or spec.add_text(name="flexlink")
        note.data = f"MuJoCo does not act on {', '.join(ignored)}"


def _point_to_assets(spec: Any, folder: Path | None) -> None:
    """Let the spec find its meshes and textures from a folder; None: by their absolute paths."""
    meshes = [*spec.meshes, *spec.hfields, *spec.skins]
    for attribute, assets in (("meshdir", meshes), ("texturedir", spec.textures)):
        in_files = any(asset.file or any(getattr(asset, "cubefiles", ())) for asset in assets)
        if not in_files:
            setattr(spec, attribute, "")
            continue
        # A model that is no file says nothing about where its assets are.
        if not spec.modelfiledir:
            continue
        absolute_path = Path(spec.modelfiledir, getattr(spec, attribute)).resolve()
        path = str(absolute_path)
        if folder is not None:
            try:
                path = os.path.relpath(absolute_path, folder.resolve())
            except ValueError:  # on another drive
                path = str(absolute_path)
        setattr(spec, attribute, Path(path).as_posix())


def _said_of_values(plant: Plant, changed: Mapping[str, Any]) -> list[str]:
    """Lines for the head of a repaired file: what values (numbers or tuples of them) were changed to."""
    lines = []
    for name, value in changed.items():
        now = ", ".join(f"{number:.6g}" for number in np.ravel(value))
        lines.append(f"  {name}: {plant.parameters.get(name, 0.0):.6g} to {now}")
    if any(name.endswith((".sensor_gain", ".sensor_offset")) for name in changed):
        lines.append("  Of a sensor: reading = gain * value + offset. MuJoCo does not apply it.")
    return lines or ["  nothing"]


def _said_of_delays(model: Any) -> list[str]:
    """Lines for the head of a repaired file: what a replay of the compiled model has to fill in before."""
    lines = []
    for kind, history in (("Ctrl", model.actuator_history), ("Sensor", model.sensor_history)):
        late = np.flatnonzero(history[:, 0])
        if late.size > 0:
            places = ", ".join(map(str, late))
            lines.append("  Of a delay: a keyframe holds no past values, so a replay would start with zeros.")
            lines.append(
                f"  After mj_resetDataKeyframe: mj_init{kind}History of {places}, with the first value."
            )
    return lines
