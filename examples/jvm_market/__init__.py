"""A market town in Java: a model beyond a pair of pipes, as environments."""
