"""Senders in ns-3 that share a bottleneck, and learn at which rate to send."""
