"""Mesa's unmodified wolf-sheep model, with one policy shared by all sheep."""
