"""Models that tests share; ``docs/contributing.md`` says which one to use for which test."""
