"""Examples of environments made with ``simenv_marl``."""
