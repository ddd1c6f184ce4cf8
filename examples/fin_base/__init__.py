"""Building blocks for financial models, and two such models: a pension fund, a debt collector."""
