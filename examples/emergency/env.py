"""The department as an environment: a nurse, two doctors and a bed manager decide.

**Agents.** ``nurse_0`` chooses the class of each patient; the nurses are one agent. ``doctor_0``
(the senior) and ``doctor_1`` choose the next patient. ``beds_0`` assigns beds: one call of the
model is for all who wait, and each of these is a decision, in the order of the rule.

**Observations.** The same for each decision: who it is about, who waits, and the time of day.

**Rewards.** For all agents, the negative cost of waiting since the agent's previous decision.

**Chance.** Each patient has a random generator, and a doctor draws the class and the treatment from
it when the patient is seen. So a patient is the same in each run of a seed, and a planner does not
foresee the treatments of those who wait. It foresees the next arrival, and the ends of what has
begun, because SimPy has scheduled them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, ClassVar, Final

import numpy as np
from gymnasium.spaces import Box, Discrete
from numpy.typing import NDArray

from simenv_marl import (
    RULE,
    TRUNCATED,
    SimulationInterface,
    Streams,
    aec_env,
    difference,
    make_step,
    parallel_env,
)

from .model import BEDS, CLASSES, COMPLAINTS, DAY, PACES, Department, Doctor, Patient

AGENTS: Final = ["nurse_0", *(f"doctor_{number}" for number in range(len(PACES))), "beds_0"]
"""The names of the agents."""

PLACES: Final = sum(BEDS.values())
"""The number of beds: the most patients among whom a doctor can choose."""

ASKED: Final = ["wait", *sorted(BEDS)]
"""What a patient without a bed can get, by action."""

_STATE: Final = (
    "hours since 8 o'clock",
    *(f"patients of class {one} without a bed" for one in CLASSES),
    *(f"patients of class {one} in a bed, waiting" for one in CLASSES),
    *(f"free beds, {kind}" for kind in BEDS),
)


# -- what agents observe ---------------------------------------------------------------------------


def state(department: Department) -> list[float]:
    """Return what all agents know of the department, as ``_STATE`` lists it."""
    queues = (department.lobby, department.ready)
    return [
        department.clock.now / 60,
        *(sum(one.category == wanted for one in queue) for queue in queues for wanted in CLASSES),
        *(department.free.count(kind) for kind in BEDS),
    ]


def waited(patient: Patient, department: Department) -> float:
    """Return for how long a patient has been in the department, in minutes."""
    return department.clock.now - patient.arrived


def describe(patient: Patient, department: Department) -> str:
    """Return a patient in words."""
    name = f"no. {patient.number}, class {patient.category}, {patient.complaint}"
    return f"{name}, here for {waited(patient, department):.0f} minutes"


def display(department: Department) -> dict[str, float]:
    """Return what people and language models read about the department."""
    return {label: round(value, 1) for label, value in zip(_STATE, state(department), strict=True)}


def look_at_ready(doctor: Doctor, ready: Sequence[Patient]) -> NDArray[np.float32]:
    """Observe the class and the minutes of each patient who can be called."""
    rows = np.zeros((PLACES, 2))
    rows[: len(ready)] = [(one.category, waited(one, doctor.department)) for one in ready]
    return np.array([*state(doctor.department), *rows.ravel()], np.float32)


def look_at_patient(patient: Patient, department: Department) -> NDArray[np.float32]:
    """Observe the class, the minutes and the complaint of a patient."""
    complaint = [patient.complaint == name for name in COMPLAINTS]
    about = [patient.category, waited(patient, department), *complaint]
    return np.array([*state(department), *about], np.float32)


def _space(parts: int) -> Box:
    return Box(0, np.inf, (len(_STATE) + parts,), np.float32)


_PATIENT_LABELS: Final = [
    *_STATE,
    "class",
    "minutes in the department",
    *(f"complaint: {name}" for name in COMPLAINTS),
]


# -- the decisions ---------------------------------------------------------------------------------


def assign(
    patients: Sequence[Patient],
    kinds: Sequence[str | None],
    department: Department,
    waiting: Sequence[Patient],
    free: Sequence[str],
) -> dict[Patient, str]:
    """Make an assignment of the answers: a dict from patients to kinds of beds.

    The rule does not know the answers for others. A patient to whom it gives a bed that is taken
    gets another free one, if there is one.
    """
    left, assigned = list(free), {}
    for patient, kind in zip(patients, kinds, strict=True):
        if left and kind in BEDS:
            assigned[patient] = kind if kind in left else left[0]
            left.remove(assigned[patient])
    return assigned


def open_beds(
    patient: Patient,
    department: Department,
    waiting: Sequence[Patient],
    free: Sequence[str],
    *,
    _answers: Sequence[Any],
) -> list[bool]:
    """Return which of ``ASKED`` are possible, after the answers for the patients before."""
    rule = department.assign_beds(list(waiting), list(free)) if RULE in _answers else {}
    before = waiting[: len(_answers)]
    kinds = [
        rule.get(one) if answer is RULE else answer
        for one, answer in zip(before, _answers, strict=True)
    ]
    taken = list(assign(before, kinds, department, waiting, free).values())
    return [True, *(free.count(kind) > taken.count(kind) for kind in ASKED[1:])]


triage = make_step(
    agent="nurse_0",
    observation_space=_space(len(_PATIENT_LABELS) - len(_STATE)),
    observation_space_mapping=lambda department, patient: look_at_patient(patient, department),
    observation_labels=_PATIENT_LABELS,
    action_space=Discrete(len(CLASSES)),
    action_space_mapping=dict(enumerate(CLASSES)),
    rule_action_mapping={category: action for action, category in enumerate(CLASSES)},
    action_labels=["urgent", "acute", "light"],
    reward_mapping=difference(lambda department: -department.cost()),
    question=lambda department, patient: f"Which class has the patient with {patient.complaint}?",
    display_mapping=display,
)

call = make_step(
    agent=lambda doctor: f"doctor_{doctor.number}",
    observation_space=_space(2 * PLACES),
    observation_space_mapping=look_at_ready,
    observation_labels=[
        *_STATE,
        *(f"{what}, patient {n + 1}" for n in range(PLACES) for what in ("class", "minutes")),
    ],
    action_space=Discrete(PLACES),
    choices=lambda doctor, ready: ready,
    action_labels=lambda doctor, ready: {
        action: describe(one, doctor.department) for action, one in enumerate(ready)
    },
    reward_mapping=difference(lambda doctor: -doctor.department.cost()),
    question="Whom do you treat next?",
    display_mapping=lambda doctor: display(doctor.department),
)

beds = make_step(
    agent="beds_0",
    split=lambda department, waiting, free: waiting,
    gather=assign,
    part=lambda assigned, patient: assigned.get(patient),
    observation_space=_space(len(_PATIENT_LABELS) - len(_STATE)),
    observation_space_mapping=look_at_patient,
    observation_labels=_PATIENT_LABELS,
    action_space=Discrete(len(ASKED)),
    action_space_mapping=dict(enumerate(ASKED)),
    action_mask_mapping=open_beds,
    rule_action_mapping={None: 0} | {kind: ASKED.index(kind) for kind in BEDS},
    action_labels=["wait", *(f"a {kind} bed" for kind in ASKED[1:])],
    reward_mapping=difference(lambda patient, department: -department.cost()),
    question=lambda patient, department: f"Which bed for {describe(patient, department)}?",
    display_mapping=lambda patient, department: display(department),
)


# -- the environments ------------------------------------------------------------------------------


class EmergencySimulation(SimulationInterface):
    """The department for a day.

    Attributes:
        streams: The random generators of all sources of chance.
        department: The department of the current episode.
    """

    points: ClassVar[Any] = {
        Department.triage: triage,
        Doctor.call_next: call,
        Department.assign_beds: beds,
    }

    def reset(self, seed: int | None = None) -> None:
        """Open an empty department."""
        self.streams = Streams(seed)
        self.department = Department(self.streams)

    def run(self) -> Any:
        """Run SimPy's loop for a day. The department does not close, so the limit truncates."""
        self.department.clock.run(until=DAY)
        return TRUNCATED

    def time(self) -> float:
        """Return SimPy's clock, in minutes."""
        return float(self.department.clock.now)

    def reseed(self, seed: int) -> None:
        """Draw another future."""
        self.streams.reseed(seed)


def cost(simulation: Any) -> float:
    """Return the cost of waiting: the metric of comparisons."""
    return float(simulation.department.cost())


def env(**options: Any) -> Any:
    """Make the AEC environment of all agents."""
    return aec_env(EmergencySimulation, **{"possible_agents": AGENTS, **options})


def rounds(**options: Any) -> Any:
    """Make the parallel environment of all agents."""
    return parallel_env(EmergencySimulation, **{"possible_agents": AGENTS, **options})
