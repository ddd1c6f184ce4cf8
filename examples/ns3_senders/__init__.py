"""Senders in ns-3 that share a bottleneck and learn their sending rates."""
