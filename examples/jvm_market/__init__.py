"""A market town in Java: environments from a model in another process, connected by pipes."""
