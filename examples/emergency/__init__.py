"""An emergency department in SimPy: interrupts, three kinds of decisions, and plans."""
