"""Policies of the pension fund, in eight worlds."""
