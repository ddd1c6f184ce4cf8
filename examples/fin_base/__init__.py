"""Building blocks for models of financial entities, and two models built on them: a pension fund, a debt collector."""
