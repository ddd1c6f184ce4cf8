"""A model of a bakery. It contains no reinforcement learning."""

from random import Random


class Bakery:
    """Bakes in the morning, sells until noon, and gives away the loaves that are left."""

    def __init__(self, seed=None):
        self.random = Random(seed)
        self.day = 0
        self.asked = 40  # loaves that customers asked for yesterday
        self.loaves = 0  # on the shelf
        self.price = 3.0
        self.cash = 0.0

    def choose_batch(self):
        """Decide how many loaves to bake."""
        return self.asked  # expects the demand of yesterday

    def set_price(self):
        """Set the price of the day."""
        self.price = 3.5 if self.day % 7 == 5 else 3.0  # a higher price on Saturdays

    def sell(self):
        """Sell to the customers of the day; a higher price attracts fewer of them."""
        self.asked = self.random.randint(20, 60) - int(20 * (self.price - 3.0))
        self.cash += self.price * min(self.asked, self.loaves)

    def update_day(self):
        """Simulate one day."""
        self.loaves = self.choose_batch()
        self.cash -= 1.0 * self.loaves
        self.set_price()
        self.sell()
        self.day += 1
