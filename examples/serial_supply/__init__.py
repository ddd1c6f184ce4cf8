"""An unmodified supply chain of stockpyl with a known optimum, and cooperative learners for it."""
