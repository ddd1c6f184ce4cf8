"""EnergyPlus, in the same process and by its own C interface: two rooms, an agent for the heater of each."""
