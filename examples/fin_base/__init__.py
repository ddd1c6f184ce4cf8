"""Blocks for models of financial entities, and a pension fund that is built on them."""
