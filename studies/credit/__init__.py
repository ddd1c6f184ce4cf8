"""Credit assignment, by branches and by returns."""
