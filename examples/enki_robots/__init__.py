"""E-pucks in Enki that sweep an arena in pairs."""
