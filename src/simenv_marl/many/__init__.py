"""Policies in the model, in one simulation or in many at once."""
