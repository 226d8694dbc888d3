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

# Last parts of numbers in a file that MuJoCo does not act on.
_IGNORED = (".gain", ".offset", f".{DEAD_ZONE}", f".{STRIBECK}", *(f".{name}" for name in FORCE_NAMES))
# Relative standard deviations where the file has no <numeric name="tolerance.NAME">, by a name's last part.
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
    **dict.fromkeys(("stretch_x", "stretch_y", "stretch_z"), 0.025),  # inertia goes with the square
}
_ELSE = 0.01  # gravity, sensors
# Noise deviations that the largest start of an effect has to move a record by to be looked for, and the
# share of the model error that it has to make: what makes less is never named.
_SEEN, _INTERESTS = 3.0, 0.5
# The factor by which a stated value is wrong at that; records that are simulated for it.
_WRONG, _LOOKED_AT = 3.0, 2
# Of the rate at which an inverted joint falls.
_HELD = 1.5


@dataclass(frozen=True, eq=False)
class MujocoArm(MujocoModel):
    """A model whose values are nominal parameters, and whose missing ones are effects."""

    def quantities(self, experiments: Sequence[PlantExperiment]) -> dict[str, PlantEffect]:
        """Everything that may be off or missing, by name."""
        return Quantities(self, experiments).by_name()

    @property
    def force_places(self) -> tuple[ForcePlace, ...]:
        """The joints whose position is measured, each with the first actuator that moves it."""
        moved_by = [one.target for one in self.spec.actuators]
        found = []
        for column, joint, _ in self.tracked:
            slides = self.spec.joint(joint).type == mujoco.mjtJoint.mjJNT_SLIDE
            command = moved_by.index(joint) if joint in moved_by else None
            found.append(ForcePlace(joint, "N" if slides else "N m", column, command))
        return tuple(found)

    def tracking(self, experiments: Sequence[PlantExperiment]) -> float:
        """Half the largest speed over the travel [rad/s], and enough to hold every joint against gravity."""
        model, data = self.nominal, mujoco.MjData(self.nominal)
        mujoco.mj_forward(model, data)
        fastest, sizes = 0.0, Quantities(self, experiments).motions
        for _, name, inertia in self.tracked:
            joint = model.joint(name)
            _, travel, speed = sizes[name]
            axis, body = data.xaxis[joint.id], joint.bodyid[0]
            pull = np.linalg.norm(np.cross(axis, model.opt.gravity)) * float(model.body_subtreemass[body])
            arm = np.linalg.norm(np.cross(axis, data.subtree_com[body] - data.xanchor[joint.id]))
            turns = self.spec.joint(name).type == mujoco.mjtJoint.mjJNT_HINGE
            falls = np.sqrt(pull * arm / inertia) if turns else 0.0
            fastest = max(fastest, 0.5 * speed / travel, _HELD * float(falls))
        return fastest

    def repaired(
        self,
        plant: Plant,
        repaired: Plant,
        effects: Sequence[Change],
        records: Sequence[PlantExperiment] = (),
        folder: Path | None = None,
    ) -> str:
        """MJCF of the model with the values of a repaired plant (`Diagnosis.rig`) and effects (`repair`).

        records : to replay, each with a keyframe "start of NAME". folder : where it will be written, from
        which it finds its meshes and textures; None: by their absolute paths.
        """
        values: dict[str, Any] = dict(repaired.parameters)
        for change in effects:
            size, name = tuple(change.values.values()), change.id.removeprefix("wrong_")
            values[name] = values[name] * size[0] if name in values else size
        assert isinstance(plant.simulation, MujocoSimulation)
        changed = {k: v for k, v in values.items() if v != plant.parameters.get(k)}
        spec = plant.simulation.edited(changed, self.spec)
        poses = [np.array(key.qpos) for key in spec.keys]
        model, before = spec.compile(), self.nominal
        # A joint within a backlash stands in the middle of a pose, and MuJoCo fills up its end.
        for key, pose in zip(spec.keys, poses, strict=True):
            if len(pose) == before.nq < model.nq:
                whole = np.array(model.qpos0)
                for joint in (before.joint(j) for j in range(before.njnt)):
                    first, size = joint.qposadr[0], joint.qpos0.size
                    at = model.joint(joint.name).qposadr[0]
                    whole[at : at + size] = pose[first : first + size]
                key.qpos = whole
        names = [one.name for one in spec.numerics if not one.name.startswith("tolerance.")]
        if ignored := [name for name in names if name.endswith(_IGNORED)]:
            note = spec.text("flexlink") or spec.add_text(name="flexlink")
            note.data = f"MuJoCo does not act on {', '.join(ignored)}"
        for e in records:
            data = plant.simulation.began(model, e.input)
            spec.add_key(name=f"start of {e.name}", qpos=data.qpos, qvel=data.qvel, act=data.act)
        spec.compile()
        meshes, textures = ([*spec.meshes, *spec.hfields, *spec.skins], spec.textures)
        for key, assets in (("meshdir", meshes), ("texturedir", textures)):
            there = Path(spec.modelfiledir, getattr(spec, key)).resolve()
            try:
                at = os.path.relpath(there, folder.resolve()) if folder else str(there)
            except ValueError:  # on another drive
                at = str(there)
            read = any(one.file or any(getattr(one, "cubefiles", ())) for one in assets)
            if spec.modelfiledir or not read:
                setattr(spec, key, Path(at).as_posix() if read else "")
        # "--" ends a comment of XML.
        said = []
        for name, size in changed.items():
            now = ", ".join(f"{value:.6g}" for value in np.ravel(size))
            said.append(f"  {name}: {plant.parameters.get(name, 0.0):.6g} to {now}")
        if any(name.endswith((".sensor_gain", ".sensor_offset")) for name in changed):
            said.append("  Of a sensor: reading = gain * value + offset. MuJoCo does not apply it.")
        said = said or ["  nothing"]
        for what, past in (("Ctrl", model.actuator_history), ("Sensor", model.sensor_history)):
            if late := ", ".join(map(str, np.flatnonzero(past[:, 0]))):
                said.append(
                    "  Of a delay: a keyframe holds no past values, so a replay would start with zeros."
                )
                said.append(
                    f"  After mj_resetDataKeyframe: mj_init{what}History of {late}, with the first value."
                )
        listed = "\n".join(said).replace("--", "- -")
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

        experiments : input (T, U + Y) commands, then outputs as measured; output (T, Y).
        model_error : share of the motion that commands make; beside the tracking that is less than all of it.
        named : patterns that choose quantities which are tried by name only.
        """
        there = self.quantities(experiments)
        every = {
            name: one
            for name, one in there.items()
            if one.tried == "always" or any(fnmatchcase(name, pattern) for pattern in named)
        }
        simulation = MujocoSimulation(self, every, noise)
        stated = simulation.parameters
        usual = {name: TOLERANCES.get(name.rpartition(".")[2], _ELSE) for name in stated}
        tolerances = {**usual, **simulation.tolerances}
        share = model_error * simulation.commanded(stated, experiments)
        records = experiments[:_LOOKED_AT]
        as_stated = [simulation(stated, {}, e.input) for e in records]

        def seen(parameters: Mapping[str, float], effects: Mapping[str, Mapping[str, float]]) -> float:
            """Size over noise of what they change; 0 where that shows in no record."""
            most = 0.0
            for e, before in zip(records, as_stated, strict=True):
                moved = simulation({**stated, **parameters}, effects, e.input) - before
                rms = np.sqrt(np.mean(moved**2, axis=0))
                large = rms > _INTERESTS * share * np.std(e.output, axis=0)
                if np.any(large & (np.max(np.abs(moved), axis=0) > _SEEN * noise)):
                    most = max(most, float(np.max(rms / noise)))
            return most

        moving = {self.nominal.body(k).name for k in set(self.nominal.body_weldid) - {0}}
        needs = {f"{name}.payload": f"a <site> in the body {name}, where a load may be" for name in moving}
        for one in self.spec.actuators:
            needs[f"{one.name}.gain"] = "an actuator whose gain is fixed, affine or a muscle's"
            needs[f"{one.name}.lag"] = "an actuator without dynamics or with those of a filter"
        missing = simulation.effects
        shown = {name for name, value in stated.items() if seen({name: _WRONG * value}, {})}
        unstable = set[str]()
        for one in missing:
            size, *more = one.parameters
            starts = {p.name: p.starts[-1 if one.grows else 0] for p in more}
            least, largest = (size.low, size.starts[-1]) if one.grows else (size.high, size.starts[0])
            if change := seen({}, {one.name: {size.name: largest, **starts}}):
                # What changes as much at next to no size is the simulation: its steps are too coarse for it.
                alike = seen({}, {one.name: {size.name: least, **starts}}) > 0.5 * change
                (unstable if alike else shown).add(one.name)
        silent = [f"wrong_{name}" for name in stated if name not in shown and tolerances[name] > 0]
        return Plant(
            simulation,
            stated,
            {name: value for name, value in tolerances.items() if value > 0 and name in shown},
            self.outputs,
            noise,
            tuple(effect for effect in missing if effect.name in shown),
            share,
            self.dt_s,
            inactive={
                **{name: need for name, need in sorted(needs.items()) if name not in every},
                **dict.fromkeys(silent, "records in which it shows"),
                **dict.fromkeys(unstable, "smaller steps of the model (timestep)"),
            },
            settled=simulation.settled,
            untracked=MujocoSimulation(replace(self, tracking_rad_s=0.0), every, noise, settles=False),
            units=self.units,
            forced=ForcedSimulation(places, simulation.forced) if (places := self.force_places) else None,
            input_names=self.inputs,
        )
