"""An emergency department in SimPy.

A nurse assigns a class to each patient who arrives. The patient waits for a bed, and in the bed for
a doctor. An urgent patient interrupts the treatment of a light one. A nurse cleans the bed.

``python -m examples.emergency.model`` simulates 50 days, and prints the waiting times by class.
"""

from collections.abc import Generator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import simpy

DAY: Final = 12 * 60.0  # in minutes, the unit of all times; it begins at 8 o'clock
RATES: Final = 3 * [3.5] + 4 * [5.5] + 5 * [4.0]  # of patients, by hour
URGENT, ACUTE, LIGHT = CLASSES = (1, 2, 3)
COSTS: Final = {URGENT: 8.0, ACUTE: 2.0, LIGHT: 1.0}  # of a minute without treatment
MINUTES: Final = {URGENT: 40.0, ACUTE: 30.0, LIGHT: 6.0}  # of a treatment, in the mean
UNMONITORED: Final = 1.5  # the factor for urgent patients in plain beds
PACES: Final = ((1.0, 1.0, 1.0), (1.6, 1.2, 1.0))  # the factors of both doctors, by class
BEDS: Final = {"monitored": 2, "plain": 6}
NURSES, CLEANING = 2, 10.0
SHARES: Final = (0.15, 0.25, 0.3, 0.3)  # of the complaints
COMPLAINTS: Final = {  # with the probabilities of the classes
    "chest pain": (0.5, 0.4, 0.1),
    "abdominal pain": (0.15, 0.6, 0.25),
    "injury": (0.05, 0.35, 0.6),
    "cough": (0.0, 0.1, 0.9),
}


class Generators(dict[Any, np.random.Generator]):
    """Random generators by name, which are made when they are first used."""

    def __init__(self, seed: int) -> None:
        self.seed = seed

    def __missing__(self, name: Any) -> np.random.Generator:
        return self.setdefault(name, np.random.default_rng([self.seed, *repr(name).encode()]))


@dataclass(eq=False)
class Patient:
    """A patient. A doctor finds out the true class; before that, it is what the nurse says."""

    number: int
    complaint: str
    arrived: float
    category: int = 0
    bed: str = ""
    work: float | None = None  # None: no doctor has seen the patient
    wait: float = 0.0  # for the first doctor
    interruptions: int = 0

    def cost(self) -> float:
        """Return the cost of a minute of waiting, in the mean until a doctor knows more."""
        expected = np.dot([*COSTS.values()], COMPLAINTS[self.complaint])
        return float(expected) if self.work is None else COSTS[self.category]


class Doctor:
    """A doctor. The resource is the attention, which one patient has at a time."""

    def __init__(self, department: "Department", number: int) -> None:
        self.number, self.pace, self.department = number, PACES[number], department
        self.attention = simpy.PreemptiveResource(department.clock)
        self.patient: Patient | None = None

    def call_next(self, ready: list[Patient]) -> Patient:
        """Choose the next patient: by class, and the first who came."""
        return ready[0]


class Department:
    """The department. ``streams`` has a random generator for each source of chance."""

    def __init__(self, streams: Any) -> None:
        self.streams, self.clock = streams, simpy.Environment()
        self.patients: list[Patient] = []
        self.lobby: dict[Patient, Any] = {}  # who waits for a bed, with an event
        self.ready: dict[Patient, Any] = {}  # who waits for a doctor
        self.free = [kind for kind, number in BEDS.items() for _ in range(number)]
        self.nurses = simpy.PriorityResource(self.clock, NURSES)
        self.doctors = [Doctor(self, number) for number in range(len(PACES))]
        self._cost, self._rate, self._booked = 0.0, 0.0, 0.0
        self.clock.process(self._arrivals())

    def triage(self, patient: Patient) -> int:
        """Choose the class of a patient: the most probable one."""
        return 1 + int(np.argmax(COMPLAINTS[patient.complaint]))

    def assign_beds(self, waiting: list[Patient], free: list[str]) -> dict[Patient, str]:
        """Assign free beds by class and arrival: monitored ones to urgent patients if possible."""
        left, assigned = list(free), {}
        for patient in waiting[: len(free)]:
            wanted = "monitored" if patient.category == URGENT else "plain"
            assigned[patient] = wanted if wanted in left else left[0]
            left.remove(assigned[patient])
        return assigned

    def cost(self) -> float:
        """Return the cost of waiting so far."""
        return self._cost + self._rate * (self.clock.now - self._booked)

    def _change(self, rate: float) -> None:
        self._cost, self._booked = self.cost(), self.clock.now
        self._rate += rate

    def _arrivals(self) -> Generator[Any, Any, None]:
        chance, most = self.streams["arrivals"], max(RATES)
        while True:
            yield self.clock.timeout(chance.exponential(60 / most))
            if chance.random() * most < RATES[int(self.clock.now // 60)]:
                complaint = self.streams["complaints"].choice([*COMPLAINTS], p=SHARES)
                patient = Patient(len(self.patients), str(complaint), self.clock.now)
                self.patients.append(patient)
                self.clock.process(self._visit(patient))

    def _visit(self, patient: Patient) -> Generator[Any, Any, None]:
        chance = self.streams["patient", patient.number]
        self._change(patient.cost())
        with self.nurses.request(priority=0) as nurse:
            yield nurse
            yield self.clock.timeout(chance.uniform(2, 6))
            patient.category = self.triage(patient)
        turn = self.lobby[patient] = self.clock.event()
        self._fill_beds()
        patient.bed = yield turn
        while patient.work != 0:
            doctor = self._interruptible(patient)
            if doctor is None:
                turn = self.ready[patient] = self.clock.event()
                self._call()
                doctor = yield turn
            yield from self._treat(patient, doctor, chance)
        with self.nurses.request(priority=1) as nurse:
            yield nurse
            yield self.clock.timeout(CLEANING)
        self.free = sorted([*self.free, patient.bed])
        self._fill_beds()

    def _treat(self, patient: Patient, doctor: Doctor, chance: Any) -> Generator[Any, Any, None]:
        self._change(-patient.cost())
        doctor.patient, category = patient, patient.category
        if patient.work is None:
            patient.wait = self.clock.now - patient.arrived
            patient.category = int(chance.choice(CLASSES, p=COMPLAINTS[patient.complaint]))
            patient.work = float(chance.gamma(4.0, MINUTES[patient.category] / 4.0))
            if patient.category == URGENT and patient.bed == "plain":
                patient.work *= UNMONITORED
        pace, begin = doctor.pace[patient.category - 1], self.clock.now
        priority = min(category, patient.category)
        with doctor.attention.request(priority, preempt=priority == URGENT) as turn:
            try:
                yield turn
                yield self.clock.timeout(patient.work * pace)
                patient.work = 0.0
            except simpy.Interrupt:
                patient.work = max(1.0, patient.work - (self.clock.now - begin) / pace)
                patient.interruptions += 1
                self._change(patient.cost())
        if doctor.patient is patient:
            doctor.patient = None
            self._call()

    def _interruptible(self, patient: Patient) -> Doctor | None:
        """Return the doctor that an urgent patient interrupts, if all doctors are busy."""
        busy = [doctor for doctor in self.doctors if doctor.attention.users]
        if patient.category != URGENT or len(busy) < len(self.doctors):
            return None
        return next((one for one in busy if one.attention.users[0].priority == LIGHT), None)

    def _fill_beds(self) -> None:
        waiting = sorted(self.lobby, key=lambda one: (one.category, one.number))
        if waiting and self.free:
            for patient, bed in self.assign_beds(waiting, self.free).items():
                self.free.remove(bed)
                self.lobby.pop(patient).succeed(bed)

    def _call(self) -> None:
        for doctor in self.doctors:
            if self.ready and doctor.patient is None:
                ready = sorted(self.ready, key=lambda one: (one.category, one.number))
                doctor.patient = doctor.call_next(ready)
                self.ready.pop(doctor.patient).succeed(doctor)


if __name__ == "__main__":
    days = [Department(Generators(seed)) for seed in range(50)]
    for day in days:
        day.clock.run(until=DAY)
    seen = [patient for day in days for patient in day.patients if patient.work is not None]
    for name, category in {"urgent": URGENT, "acute": ACUTE, "light": LIGHT}.items():
        waits = [patient.wait for patient in seen if patient.category == category]
        mean, most = np.mean(waits), np.quantile(waits, 0.9)
        print(f"{name}: {len(waits)} waited {mean:.0f} minutes, one in ten over {most:.0f}")
    print(f"interrupts: {sum(patient.interruptions for patient in seen)}")
    print(f"cost of a day: {np.mean([day.cost() for day in days]):.0f}")
