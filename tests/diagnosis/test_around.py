"""What is kept between simulations: an answer is the same whatever was simulated before it."""

from dataclasses import replace

import numpy as np
import pytest

from diagnosis import Plant, PlantExperiment, with_effects
from diagnosis.machine.around import Actuator, Body, Remembered, Sensor
from diagnosis.machine.plant_effect import Change

DT_S = 0.01
N_SAMPLES = 300
FORCE = np.sin(0.05 * np.arange(N_SAMPLES))
VISCOUS = 0.09  # force per speed, against a mass of 1


def slide(parameters, effects, inputs, viscous=0.0):
    """Position (T, 1) of a mass 1 / g under the force in column 0 times the gain in column 1."""
    speed = np.zeros(len(inputs))
    position = np.zeros(len(inputs))
    for k in range(1, len(inputs)):
        force, gain = inputs[k - 1]
        pull = gain * force - viscous * speed[k - 1]
        speed[k] = speed[k - 1] + DT_S * parameters["g"] * pull
        position[k] = position[k - 1] + DT_S * speed[k]
    return position[:, None]


def record(gain):
    return np.column_stack([FORCE, np.full(N_SAMPLES, gain)])


def sliding(records, simulation=slide):
    """The mass with viscous friction of its body listed."""
    plant = Plant(simulation, {"g": 1.0}, {"g": 0.1}, ("x_m",), np.array([1e-4]))
    found = [
        PlantExperiment(f"{k}", "estimation", u, simulation({"g": 1.0}, {}, u)) for k, u in enumerate(records)
    ]
    return with_effects(plant, ["viscous_friction"], found, dt_s=DT_S, body=Body("x_m"))


RUB = [Change("viscous_friction", {"coefficient": VISCOUS})]


@pytest.mark.parametrize("gain", [1.0, 0.2, -1.0])
def test_the_order_of_records_does_not_change_what_friction_does(gain):
    """Friction is a force beside the scaled one: its response is that of the scaled column."""
    first, second = record(1.0), record(gain)
    alone = sliding([second]).simulated(RUB)(second)
    plant = sliding([first, second])
    plant.simulated(RUB)(first)
    np.testing.assert_array_equal(plant.simulated(RUB)(second), alone)
    # With the friction in the equation: as a force at the input it is VISCOUS per gain.
    truth = slide({"g": 1.0}, {}, second, VISCOUS * abs(gain))
    free = slide({"g": 1.0}, {}, second)
    assert np.linalg.norm(alone - truth) < 2e-3 * np.linalg.norm(truth - free)


def test_records_of_other_loads_and_parameters_have_their_own_response():
    """A second input that is a mass, and a parameter that moves: each answer is that of a fresh plant."""

    def loaded(parameters, effects, inputs):
        return slide(
            {"g": parameters["g"] / inputs[0, 1]}, {}, np.column_stack([inputs[:, 0], np.ones(N_SAMPLES)])
        )

    light, heavy = record(1.0), record(4.0)
    used = sliding([light, heavy], loaded)
    for factor in (1.0, 0.5):
        for inputs in (light, heavy, light):
            found = used.scaled({"g": factor}).simulated(RUB)(inputs)
            fresh = sliding([light, heavy], loaded).scaled({"g": factor}).simulated(RUB)(inputs)
            np.testing.assert_array_equal(found, fresh)


def test_another_simulation_around_the_same_body_is_simulated_anew():
    """`replayed` puts the same body around the simulation that nothing holds near its record."""
    inputs = record(1.0)

    def held(parameters, effects, inputs):
        return 0.5 * slide(parameters, effects, inputs)

    plant = replace(sliding([inputs], held), untracked=slide)
    plant.simulated(RUB)(inputs)
    free_run = plant.replayed(RUB)(inputs)
    np.testing.assert_array_equal(free_run, sliding([inputs]).simulator(RUB)(inputs))


def looped(parameters, effects, inputs):
    """Position and command (T, 2): a mass whose drive gets command times the gain in column 2."""
    position, speed = 0.0, 0.0
    found = np.zeros((len(inputs), 2))
    for k, (reference, added, gain) in enumerate(inputs):
        command = 40 * (reference - position) - 8 * speed
        found[k] = position, command
        speed += DT_S * (gain * (command + added) - speed * abs(speed))
        position += DT_S * speed
    return found


@pytest.mark.parametrize("gain", [0.4, 2.0])
def test_the_order_of_records_does_not_change_a_drive_inside_a_loop(gain):
    reference = np.random.default_rng(6).uniform(-1, 1, 12).repeat(25)

    def inputs(gain):
        return np.column_stack([reference, np.zeros(N_SAMPLES), np.full(N_SAMPLES, gain)])

    def plant():
        records = [
            PlantExperiment(f"{g}", "estimation", inputs(g), looped({}, {}, inputs(g))[:, :1])
            for g in (1.0, gain)
        ]
        listed = Plant(looped, {}, {}, ("x",), np.array([1e-4]))
        return with_effects(listed, ["actuator_gain"], records, dt_s=DT_S, actuator=Actuator(1, drive=1))

    weak = [Change("actuator_gain", {"relative_error": -0.4})]
    used = plant()
    used.simulated(weak)(inputs(1.0))
    np.testing.assert_array_equal(used.simulated(weak)(inputs(gain)), plant().simulated(weak)(inputs(gain)))


@pytest.mark.parametrize(
    ("where", "words"),
    [
        ({"sensor": Sensor(7)}, "sensor is output 7; those there are, from 0 on: x_m"),
        ({"sensor": Sensor(-1)}, "sensor is output -1"),
        ({"body": Body(-1)}, "column -1; columns count from 0 on"),
        ({"body": Body(3)}, "column 3 of a simulation that returns"),
        ({"actuator": Actuator(0, drive=-2)}, "column -2"),
        ({"actuator": Actuator(5)}, "no input 5; the records have 2"),
    ],
)
def test_a_place_that_is_not_there_is_refused(where, words):
    plant = Plant(slide, {"g": 1.0}, {}, ("x_m",), np.array([1e-4]))
    inputs = record(1.0)
    found = [PlantExperiment("a", "estimation", inputs, slide({"g": 1.0}, {}, inputs))]
    with pytest.raises(ValueError, match=words):
        with_effects(plant, "all", found, dt_s=DT_S, **where)


def test_effects_without_any_record_are_refused():
    plant = Plant(slide, {"g": 1.0}, {}, ("x_m",), np.array([1e-4]))
    with pytest.raises(ValueError, match="at least one experiment"):
        with_effects(plant, "all", [], dt_s=DT_S)


def test_what_is_remembered_is_computed_once_and_forgotten_in_its_turn():
    remembered, computed = Remembered(), []
    for key in (*range(20), 19, 0):
        assert remembered.value(key, lambda key=key: computed.append(key) or key) == key
    # Twenty, none for the second 19, and the first again, which the later ones have pushed out.
    assert computed == [*range(20), 0]
