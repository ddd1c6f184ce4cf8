"""Studies: larger questions to the examples, each in a folder of its own with its command."""
