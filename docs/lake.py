"""A lake and its boats, written to understand a commons."""


class Boat:
    """Goes out every year, and lives on what it brings home."""

    def __init__(self, lake, name):
        self.lake = lake
        self.name = name
        self.cash = 2

    def choose_catch(self):
        """Decide how many fish to take."""
        return self.lake.fish // 8  # one part in eight

    def go_out(self):
        """Fish for a year: going out costs 1, each fish earns 1."""
        catch = min(self.choose_catch(), self.lake.fish)
        self.lake.fish -= catch
        self.cash += catch - 1


class Lake:
    """Has room for 20 fish, and for any number of boats."""

    def __init__(self):
        self.year = 0
        self.fish = 12
        self.boats = []
        self.launched = 0
        self.launch()
        self.launch()

    def launch(self):
        """One boat more."""
        self.boats.append(Boat(self, f"boat_{self.launched}"))
        self.launched += 1

    def lay_up(self, boat):
        """One boat less."""
        self.boats.remove(boat)

    def update_year(self):
        """Let a year go by."""
        for boat in list(self.boats):
            boat.go_out()
            if boat.cash <= 0:
                self.lay_up(boat)
        self.fish = min(20, self.fish + self.fish // 2)
        if self.fish > 12:  # so many fish tempt somebody
            self.launch()
        self.year += 1
