"""Examples of what simulations become with ``simenv_marl``; each is a package of its own."""
