"""A heated room as a co-simulation unit (FMI 2 and FMI 3), with a thermostat that learns."""
