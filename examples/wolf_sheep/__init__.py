"""Mesa's wolves and sheep, unmodified, with one policy that all sheep share."""
