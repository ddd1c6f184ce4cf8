"""A bakery, written to understand a trade. Nothing here knows of reinforcement learning."""

from random import Random


class Bakery:
    """Bakes in the morning, sells until noon, and gives away what is left."""

    def __init__(self, seed=None):
        self.random = Random(seed)
        self.day = 0
        self.asked = 40  # for so many loaves the customers asked yesterday
        self.loaves = 0  # on the shelf
        self.price = 3.0
        self.cash = 0.0

    def choose_batch(self):
        """Decide how many loaves to bake."""
        return self.asked  # what was wanted yesterday will be wanted today

    def set_price(self):
        """Decide on the price of the day, and put it up."""
        self.price = 3.5 if self.day % 7 == 5 else 3.0  # dearer on Saturdays

    def sell(self):
        """Sell to whoever comes; the dearer, the fewer."""
        self.asked = self.random.randint(20, 60) - int(20 * (self.price - 3.0))
        self.cash += self.price * min(self.asked, self.loaves)

    def update_day(self):
        """Let a day go by."""
        self.loaves = self.choose_batch()
        self.cash -= 1.0 * self.loaves
        self.set_price()
        self.sell()
        self.day += 1
