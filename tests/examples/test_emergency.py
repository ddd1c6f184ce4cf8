"""The emergency department: its model, its decisions, and doctors that plan."""

import random
import subprocess
import sys
from pathlib import Path

import pytest
from examples.emergency import model, plan
from examples.emergency.env import AGENTS, ASKED, EmergencySimulation, assign, env, rounds
from examples.emergency.model import DAY, LIGHT, URGENT, Department, Patient

from simenv_marl import RULE, Streams, joint_env, simulate, single_env, turn_env

ROOT = Path(__file__).parents[2]


def history(department):
    """All that happened to patients, and the costs."""
    fields = ("number", "complaint", "arrived", "category", "bed", "work", "wait", "interruptions")
    patients = [[getattr(one, field) for field in fields] for one in department.patients]
    return patients, department.cost()


def plain(seed, streams=Streams):
    department = Department(streams(seed))
    department.clock.run(until=DAY)
    return department


def turns(world, seed, choose):
    """Step through an AEC environment. Yields each agent, with its info."""
    world.reset(seed=seed)
    for agent in world.agent_iter():
        *_, terminated, truncated, info = world.last()
        is_over = terminated or truncated
        if not is_over:
            yield agent, info
        world.step(None if is_over else choose(agent, info))


def in_rounds(world):
    world.reset(seed=3)
    while world.agents:
        world.step(dict.fromkeys(world.agents, RULE))


def in_steps(world):
    world.reset(seed=3)
    while not any(world.step(RULE)[2:4]):
        pass


VIEWS = {
    "aec": (env, lambda world: list(turns(world, 3, lambda *_: RULE))),
    "parallel": (rounds, in_rounds),
    "turn": (lambda: turn_env(EmergencySimulation), in_steps),
    "joint": (lambda: joint_env(EmergencySimulation, possible_agents=AGENTS), in_steps),
    **{
        agent: (lambda agent=agent: single_env(EmergencySimulation, agent=agent), in_steps)
        for agent in AGENTS
    },
}


@pytest.mark.parametrize("view", VIEWS)
def test_emergency_envs_with_rule_actions_run_like_the_model_without_env(view):
    make, run = VIEWS[view]
    world = make()
    run(world)
    assert history(world.unwrapped.simulation.department) == history(plain(3))
    assert history(simulate(EmergencySimulation, seed=3).department) == history(plain(3))


# -- the model ------------------------------------------------------------------------------------


def test_emergency_urgent_patient_interrupts_a_light_treatment(monkeypatch):
    monkeypatch.setattr(model, "PACES", model.PACES[:1])  # one doctor
    monkeypatch.setattr(model, "COMPLAINTS", {"light": (0, 0, 1), "urgent": (1, 0, 0)})
    monkeypatch.setattr(model, "MINUTES", {URGENT: 40.0, LIGHT: 300.0})
    monkeypatch.setattr(Department, "_arrivals", lambda self: (event for event in ()))
    department = Department(Streams(0))
    light, urgent = Patient(0, "light", 0.0), Patient(1, "urgent", 20.0)
    department.clock.process(department._visit(light))
    department.clock.run(until=20)
    department.clock.process(department._visit(urgent))
    department.clock.run(until=30)
    (doctor,) = department.doctors
    assert doctor.patient is urgent
    assert light.interruptions == 1
    assert list(department.ready) == [light]
    left = light.work
    while doctor.patient is urgent:
        department.clock.step()
    assert doctor.patient is light
    begin = department.clock.now
    while doctor.patient is light:
        department.clock.step()
    assert department.clock.now - begin == pytest.approx(left)  # the rest of the treatment
    assert urgent.interruptions == 0


def test_emergency_treatments_are_interrupted_on_usual_days():
    days = [plain(seed) for seed in range(10)]
    assert sum(one.interruptions for day in days for one in day.patients) >= 3


def test_emergency_arrivals_and_treatments_do_not_depend_on_decisions():
    def last(agent, info):
        return int(info["action_mask"].nonzero()[0][-1]) if "action_mask" in info else RULE

    world = env()
    list(turns(world, 5, last))
    changed, by_rule = world.simulation.department, plain(5)
    assert [one.arrived for one in changed.patients] == [one.arrived for one in by_rule.patients]
    both = zip(changed.patients, by_rule.patients, strict=True)
    seen = [(one, other) for one, other in both if None not in (one.work, other.work)]
    assert all(one.category == other.category for one, other in seen)
    assert any(one.wait != other.wait for one, other in seen)


# -- the decisions --------------------------------------------------------------------------------


def test_emergency_action_masks_follow_from_patients_and_free_beds():
    legal, chance = {agent: set() for agent in AGENTS}, random.Random(1)
    world = env()

    def choose(agent, info):
        mask = info.get("action_mask", [1, 1, 1])
        legal[agent].add(tuple(map(int, mask)))
        return chance.choice([action for action, is_legal in enumerate(mask) if is_legal])

    for agent, info in turns(world, 7, choose):
        department = world.simulation.department
        if agent.startswith("doctor"):
            number = len(department.ready)
            assert info["action_mask"].tolist() == [1] * number + [0] * (8 - number)
        elif agent == "beds_0":
            assert info["action_mask"][0]  # to wait
            for action, kind in enumerate(ASKED[1:], start=1):
                assert info["action_mask"][action] <= (kind in department.free)
    assert legal["beds_0"] >= {(1, 0, 1), (1, 1, 0)}


@pytest.mark.parametrize("first", [0, 1, 2, RULE])
def test_emergency_bed_is_given_to_one_patient_only(first):
    class Full(EmergencySimulation):
        def run(self):
            free = ["monitored", "plain"]
            self.waiting = [Patient(number, "cough", 0.0, LIGHT) for number in range(3)]
            self.assigned = self.department.assign_beds(self.waiting, free)

    world = single_env(Full, agent="beds_0")
    _, info = world.reset(seed=0)
    _, _, _, _, info = world.step(first)
    taken = {0: "wait", 1: "monitored", 2: "plain", RULE: "plain"}[first]
    assert info["action_mask"].tolist() == [1, *(kind != taken for kind in ASKED[1:])]
    world.step(RULE)
    world.step(RULE)
    kinds = list(world.unwrapped.simulation.assigned.values())
    assert len(set(kinds)) == len(kinds)
    if first == 0:
        assert world.unwrapped.simulation.waiting[0] not in world.unwrapped.simulation.assigned


def test_emergency_rule_assigns_the_beds_that_are_left():
    patients = [Patient(number, "cough", 0.0, LIGHT) for number in range(3)]
    given = assign(patients, ["plain", "plain", None], None, patients, ["monitored", "plain"])
    assert given == {patients[0]: "plain", patients[1]: "monitored"}


def test_emergency_question_and_display_describe_each_decision():
    texts = {}

    def note(observation, *, _decision):
        texts.setdefault(_decision.agent, []).append(
            (_decision.question, _decision.action_labels, _decision.display)
        )
        return RULE

    simulate(EmergencySimulation, dict.fromkeys(AGENTS, note), seed=7)
    question, labels, shown = texts["nurse_0"][0]
    assert question.startswith("Which class has the patient with ")
    assert list(labels.values()) == ["urgent", "acute", "light"]
    assert shown["free beds, plain"] == 6
    question, labels, _ = texts["beds_0"][0]
    assert question.startswith("Which bed for no. 0, class ")
    assert list(labels.values()) == ["wait", "a monitored bed", "a plain bed"]
    question, labels, _ = max(texts["doctor_0"], key=lambda text: len(text[1]))
    assert question == "Whom do you treat next?"
    assert len(labels) > 2
    assert all(", here for " in label for label in labels.values())


# -- planning -------------------------------------------------------------------------------------


@pytest.mark.thorough
def test_emergency_doctors_that_plan_are_not_worse_than_the_rule(capsys):
    found = plan.main(["--seeds", "3", "--first", "2", "--futures", "2", "--horizon", "45"])
    assert "standard error" in capsys.readouterr().out
    row = found.summary(metric="cost").loc["doctors plan"]
    assert row["difference_low"] <= 0  # costs


@pytest.mark.thorough
def test_emergency_simulate_and_evaluate_find_the_same_gain():
    seeds, options = [1], {"futures": 2, "horizon": 45.0}
    found = plan.compare(seeds, **options).summary(metric="cost")
    assert plan.gains(seeds, **options) == [pytest.approx(-found["difference"]["doctors plan"])]


def test_emergency_reseed_draws_new_treatments_of_waiting_patients():
    def work(seed):
        simulation = EmergencySimulation()
        simulation.reset(seed=1)
        simulation.department.clock.run(until=60)
        simulation.reseed(seed)
        simulation.department.clock.run(until=DAY)
        return history(simulation.department)

    assert work(5) == work(5) != work(6)


def test_emergency_model_runs_without_an_environment():
    assert history(plain(0, model.Generators)) == history(plain(0, model.Generators))
    command = [sys.executable, "-m", "examples.emergency.model"]
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    assert [line.partition(" ")[0] for line in said.splitlines()[:3]] == [
        "urgent:",
        "acute:",
        "light:",
    ]
