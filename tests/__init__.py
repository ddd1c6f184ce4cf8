"""The library's acceptance tests: what users rely on, by public names alone."""
