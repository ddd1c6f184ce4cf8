"""EnergyPlus in the same process, through its C API: two rooms, with one agent for each heater."""
