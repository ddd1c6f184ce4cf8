"""The value of plans for the greenhouse, by their cost and their horizon."""
