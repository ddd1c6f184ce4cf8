"""A model of fishing boats that share a lake."""


class Boat:
    """Goes fishing every year and lives on the income."""

    def __init__(self, lake, name):
        self.lake = lake
        self.name = name
        self.cash = 2

    def choose_catch(self):
        """Decide how many fish to take."""
        return self.lake.fish // 8  # an eighth of the stock

    def go_out(self):
        """Fish for a year. Going out costs 1, and each fish earns 1."""
        catch = min(self.choose_catch(), self.lake.fish)
        self.lake.fish -= catch
        self.cash += catch - 1


class Lake:
    """Holds up to 20 fish and any number of boats."""

    def __init__(self):
        self.year = 0
        self.fish = 12
        self.boats = []
        self.launched = 0
        self.launch()
        self.launch()

    def launch(self):
        """Add a boat."""
        self.boats.append(Boat(self, f"boat_{self.launched}"))
        self.launched += 1

    def lay_up(self, boat):
        """Remove a boat."""
        self.boats.remove(boat)

    def update_year(self):
        """Simulate one year."""
        for boat in list(self.boats):
            boat.go_out()
            if boat.cash <= 0:
                self.lay_up(boat)
        self.fish = min(20, self.fish + self.fish // 2)
        if self.fish > 12:  # a large stock attracts another boat
            self.launch()
        self.year += 1
