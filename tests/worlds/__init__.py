"""Models, definitions and players that the tests share."""
