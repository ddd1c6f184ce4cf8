"""A simulation with files and global generators, which a fork must not disturb."""

import os
import random
import shutil
import tempfile
from pathlib import Path

import numpy as np

from tests.worlds.models import decision

choose = decision()


class Archive:
    """Does something random with a file between decisions; its log holds all that it reads."""

    def __init__(self, days=12):
        self.days = days

    def reset(self, seed=None):
        self.seed, self.log = seed, []
        self.chance = random.Random(seed)
        random.seed(seed)
        np.random.seed(seed)
        self.files = []
        self.numbers = []
        self.folder = tempfile.mkdtemp()

    def close(self):
        """Branches do not come here, and so leave the folder to the environment."""
        shutil.rmtree(self.folder)

    def run(self):
        with tempfile.NamedTemporaryFile("w+", dir=self.folder, delete=False) as self.named:
            Path(self.folder, "0").write_text(
                "".join(f"{line} " * 3 + "\n" for line in range(3000))
            )
            try:
                # what is found by its name is every branch's alike
                for _ in range(self.chance.randrange(6)):
                    self.open()
                self.numbers.append(os.open(Path(self.folder, "0"), os.O_RDWR))
                for day in range(self.days):
                    self.log.append(
                        (day, choose(), random.random(), random.gauss(0, 1), np.random.random())
                    )
                    for _ in range(self.chance.randrange(4)):
                        self.chance.choice(DEEDS)(self)
                self.look()
            finally:
                while self.files:
                    self.files.pop().close()
                while self.numbers:
                    os.close(self.numbers.pop())

    def open(self):
        path = Path(self.folder, str(self.chance.randrange(3)))
        mode = self.chance.choice(["r+", "a+", "w+", "a", "r"])
        self.files.append(open(path, mode if path.exists() else "w+"))  # noqa: SIM115 - closed later

    def open_nameless(self):
        self.files.append(tempfile.TemporaryFile("w+"))  # noqa: SIM115

    def write(self):
        file = self.any_file()
        if file.writable():
            file.write(f"{self.log[-1]}\n" * self.chance.randrange(1, 400))
        if self.chance.random() < 0.5:
            file.flush()

    def read(self):
        file = self.any_file()
        if file.readable():
            self.log.append((file.read(self.chance.randrange(9000)), file.tell()))

    def seek(self):
        file = self.any_file()
        file.seek(0 if self.chance.random() < 0.5 else self.chance.randrange(2000))

    def duplicate(self):
        self.numbers.append(os.dup(self.chance.choice(self.numbers)))

    def use_numbers(self):
        for number in self.numbers:
            self.log.append(os.read(number, self.chance.randrange(50)))
            if self.chance.random() < 0.3:
                os.write(number, repr(self.log[0]).encode())

    def forget(self):
        if self.files:
            self.files.pop(self.chance.randrange(len(self.files))).close()

    def look(self):
        self.log.append((sorted(os.listdir(self.folder)), Path(self.named.name).exists()))

    def any_file(self):
        return self.chance.choice([*self.files, self.named])


DEEDS = [
    Archive.open_nameless, Archive.write, Archive.write, Archive.read, Archive.read, Archive.seek,
    Archive.duplicate, Archive.use_numbers, Archive.forget,
]  # fmt: skip


def left(env, number=0):
    """Play what is left of an episode. Returns its log."""
    over = False
    while not over:
        over = env.step(3)[2]
    return env.unwrapped.simulation.log
