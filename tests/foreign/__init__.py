"""Somebody else's package: it has never heard of decision points."""
