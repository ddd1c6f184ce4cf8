"""A sweep and a search over the hyperparameters of a learner."""
