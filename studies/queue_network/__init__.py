"""Two queues in a row, with a learner for each, which has a clock of its own."""
